//! COLMAP scenes that are refused, with file, place and remedy.

use super::write::{Model, model, refused, scene_folder, scene_with};
use gsscale::base::error::InputResult;
use gsscale::dataset::colmap::{ReadOptions, read_colmap};
use gsscale::dataset::model::RawScene;
use gsscale::dataset::read::read_scene;
use std::fs;
use std::path::Path;

fn read(scene: &Path) -> InputResult<RawScene> {
    read_colmap(scene, &ReadOptions::default())
}

/// Reads the changed model from both formats; both must refuse.
#[track_caller]
fn refused_in_both(m: &Model, stem: &str, parts: &[&str]) {
    for is_binary in [true, false] {
        let (scene, _) = scene_with(m, is_binary);
        let (extension, place) = if is_binary { ("bin", "byte ") } else { ("txt", "line ") };
        let error = refused(read(scene.path()), &format!("{stem}.{extension}"), parts);
        assert!(error.place.contains(place), "{error} says no place");
    }
}

#[test]
fn counts_beyond_the_file_are_refused_before_anything_is_allocated() {
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        for count in [u64::MAX, 1 << 60, 1 << 32, 1_000] {
            let (scene, folder) = scene_with(&model(4), true);
            let mut bytes = fs::read(folder.join(name)).unwrap();
            bytes[..8].copy_from_slice(&count.to_le_bytes());
            fs::write(folder.join(name), bytes).unwrap();
            refused(read(scene.path()), name, &["byte 0", &count.to_string(), "bytes follow"]);
        }
    }
    // The count of 2D points of the first image, and of track elements of the first point.
    let m = model(4);
    for (name, at) in [("images.bin", 8 + 4 + 56 + 4 + "d.jpg".len() + 1), ("points3D.bin", 8 + 8 + 24 + 3 + 8)] {
        for count in [u64::MAX, 1 << 59, 5_000] {
            let (scene, folder) = scene_with(&m, true);
            let mut bytes = fs::read(folder.join(name)).unwrap();
            bytes[at..at + 8].copy_from_slice(&count.to_le_bytes());
            fs::write(folder.join(name), bytes).unwrap();
            refused(read(scene.path()), name, &[&format!("byte {at}"), "bytes follow"]);
        }
    }
}

#[test]
fn truncated_files_are_refused_wherever_they_end() {
    let m = model(6);
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let (scene, folder) = scene_with(&m, true);
        let whole = fs::read(folder.join(name)).unwrap();
        for length in 0..whole.len() {
            fs::write(folder.join(name), &whole[..length]).unwrap();
            let error = refused(read(scene.path()), name, &["byte "]);
            assert!(error.remedy.contains("damaged or cut short"), "{error}");
        }
    }
}

#[test]
fn names_that_leave_the_image_folder_are_refused() {
    for name in
        ["../a.jpg", "x/../../a.jpg", "/etc/passwd", "C:\\a.jpg", "..\\a.jpg", "\\\\host\\a.jpg", "a\u{1b}[2J.jpg"]
    {
        let mut m = model(1);
        m.images[2].name = name.into();
        refused_in_both(&m, "images", &["name"]);
    }
    for name in [&b""[..], b".", b"./", b"a\n.jpg", &[b'a'; 5000]] {
        let mut m = model(1);
        m.images[2].name = name.to_vec();
        let (scene, _) = scene_with(&m, true);
        refused(read(scene.path()), "images.bin", &["byte ", "name"]);
    }
}

#[test]
fn two_views_of_one_name_are_refused() {
    let mut m = model(1);
    m.images[2].name = b".//b.jpg".to_vec();
    for is_binary in [true, false] {
        let (scene, _) = scene_with(&m, is_binary);
        let file = if is_binary { "images.bin" } else { "images.txt" };
        refused(read(scene.path()), file, &["image 'b.jpg'", "two views"]);
    }
}

#[test]
fn cameras_that_contradict_are_refused() {
    let mut m = model(1);
    m.images[1].camera = 99;
    refused_in_both(&m, "images", &["image 'a b.jpg'", "camera 99"]);
    let mut m = model(1);
    m.cameras[1].id = 1;
    refused_in_both(&m, "cameras", &["camera 1", "second definition"]);
}

#[test]
fn camera_models_that_cannot_be_used_are_refused_by_name() {
    let others = [
        (7, "FOV"),
        (10, "THIN_PRISM_FISHEYE"),
        (11, "RAD_TAN_THIN_PRISM_FISHEYE"),
        (12, "SIMPLE_DIVISION"),
        (13, "DIVISION"),
        (14, "SIMPLE_FISHEYE"),
        (15, "FISHEYE"),
        (16, "EUCM"),
        (17, "EQUIRECTANGULAR"),
    ];
    for id in others {
        let mut m = model(1);
        m.cameras[1].model = id;
        refused_in_both(&m, "cameras", &[id.1, "not supported", "camera 7", "image_undistorter"]);
    }
    let mut m = model(1);
    m.cameras[1].model = (-3, "PINHOLE_CAMERA");
    refused_in_both(&m, "cameras", &["unknown"]);
}

#[test]
fn cameras_with_impossible_numbers_are_refused() {
    for focal in [0.0, -500.0, f64::NAN, f64::INFINITY, 1e-9, 1e30] {
        let mut m = model(1);
        m.cameras[1].params[0] = focal;
        refused_in_both(&m, "cameras", &["camera 7", "focal length", "gsscale-poses"]);
    }
    for size in [(0, 480), (640, 0), (1 << 40, 480), (640, 65_536)] {
        let mut m = model(1);
        m.cameras[0].size = size;
        refused_in_both(&m, "cameras", &["camera 1", "pixels"]);
    }
    for (param, value) in [(2, f64::NAN), (3, 1e9)] {
        let mut m = model(1);
        m.cameras[0].params[param] = value;
        refused_in_both(&m, "cameras", &["camera 1", "principal point"]);
    }
    let mut m = model(1);
    m.cameras[1].params[4] = f64::INFINITY;
    refused_in_both(&m, "cameras", &["camera 7", "distortion"]);
}

#[test]
fn too_many_points_that_are_not_finite_are_refused() {
    let mut m = model(100);
    m.points[3].position[0] = f64::NAN;
    for is_binary in [true, false] {
        let (scene, _) = scene_with(&m, is_binary);
        assert_eq!(read(scene.path()).unwrap().points.positions.len(), 99); // exactly 1 %
    }
    m.points[50].position[0] = f64::INFINITY;
    refused_in_both(&m, "points3D", &["2 of 100 points", "1 %"]);
}

#[test]
fn scenes_without_a_view_are_refused() {
    let mut m = model(1);
    m.images.clear();
    let (scene, _) = scene_with(&m, true);
    refused(read(scene.path()), "images.bin", &["no images"]);
    let mut m = model(1);
    m.images.iter_mut().for_each(|i| i.quat = [0.0; 4]);
    let (scene, _) = scene_with(&m, false);
    refused(read(scene.path()), "images.txt", &["no view is left", "without a usable pose", "'b.jpg'"]);
}

#[test]
fn a_missing_scene_model_or_image_folder_is_named() {
    let scene = scene_folder();
    let options = ReadOptions::default();
    let name = scene.path().file_name().unwrap().to_str().unwrap();
    refused(read(scene.path()), name, &["no COLMAP model", "sparse/*"]);
    refused(read_scene(scene.path(), &options), name, &["sparse/*", "transforms.json"]);
    refused(read_scene(&scene.path().join("nowhere"), &options), "nowhere", &["check the path"]);
    fs::write(scene.path().join("a.txt"), "x").unwrap();
    refused(read_scene(&scene.path().join("a.txt"), &options), "a.txt", &["a scene is a folder"]);
    model(1).write_bin(&scene.path().join("sparse"));
    fs::remove_dir(scene.path().join("images")).unwrap();
    refused(read_scene(scene.path(), &options), "images", &["image folder", "--images"]);
}

#[test]
fn text_that_is_not_a_model_is_refused_by_line() {
    let m = model(3);
    let cases = [
        ("cameras.txt", m.cameras_txt().replace("640 480", "640 tall"), "line 4", "\"tall\""),
        ("cameras.txt", m.cameras_txt().replace(" 240", ""), "line 4", "4 parameters, not 3"),
        ("cameras.txt", m.cameras_txt().replace(" 240", " 240 1 2"), "line 4", "4 parameters, not 5"),
        ("cameras.txt", "1\n".into(), "line 1", "ends before the camera model"),
        ("images.txt", m.images_txt().replace(" 1 b.jpg", " 1"), "line 8", "image's name"),
        ("images.txt", m.images_txt().replace("1.5 -1", "1.5"), "line 5", "triples"),
        (
            "images.txt",
            m.images_txt().lines().filter(|l| !l.contains(".5 1.5")).collect::<Vec<_>>().join("\n"),
            "line",
            "triples",
        ),
        ("images.txt", format!("1 {}", "x".repeat(20_000)), "line 1", "longer than"),
        ("points3D.txt", m.points_txt().replace("0.7", "x"), "line 2", "reprojection error"),
        ("points3D.txt", m.points_txt().replace(" 2 3 ", " 2 300 "), "line 2", "blue"),
        ("points3D.txt", m.points_txt().replace("11 1 0.25", "11"), "line 3", ""),
    ];
    for (name, text, line, part) in cases {
        let (scene, folder) = scene_with(&m, false);
        fs::write(folder.join(name), text).unwrap();
        refused(read(scene.path()), name, &[line, part]);
    }
    let (scene, folder) = scene_with(&m, false);
    fs::write(folder.join("cameras.txt"), b"1 PINHOLE 640 48\xff 1 1 1 1\n").unwrap();
    refused(read(scene.path()), "cameras.txt", &["line 1", "48\\\\xFF"]);
}
