//! COLMAP scenes that are read.

use super::write::{Cam, Img, Model, model, scene_folder, scene_with, warned};
use glam::{DMat3, DVec3};
use gsscale::dataset::colmap::{ReadOptions, looks_like_colmap, read_colmap};
use gsscale::dataset::model::{Lens, RawScene};
use gsscale::dataset::read::read_scene;
use std::fs;
use std::path::Path;

fn read(scene: &Path) -> RawScene {
    read_colmap(scene, &ReadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

#[test]
fn binary_and_text_say_the_same() {
    let m = model(12);
    let (bin, _) = scene_with(&m, true);
    let (txt, _) = scene_with(&m, false);
    let (from_bin, from_txt) = (read(bin.path()), read(txt.path()));
    assert_eq!(from_bin.points, from_txt.points);
    assert_eq!(from_bin.warnings, Vec::<String>::new());
    assert_eq!(from_txt.warnings, Vec::<String>::new());
    for (a, b) in from_bin.views.iter().zip(&from_txt.views) {
        assert_eq!((&a.name, a.intrinsics, a.pose), (&b.name, b.intrinsics, b.pose));
    }
    let names: Vec<_> = from_bin.views.iter().map(|v| v.name.as_str()).collect();
    assert_eq!(names, ["a b.jpg", "b.jpg", "d.jpg", "sub/c.png"]);
    assert_eq!(from_bin.views[3].image_path, bin.path().join("images/sub/c.png"));
    let radial = from_bin.views[3].intrinsics;
    assert_eq!(radial.lens, Lens::Radial([0.1, -0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]));
    assert_eq!((radial.width, radial.height, radial.fx, radial.fy), (320, 200, 300.0, 300.0));
    assert_eq!(from_bin.points.positions[5], [5.0, 0.25, -1.5]);
    assert_eq!(from_bin.points.colors[5], [5, 2, 3]);
    assert_eq!(from_bin.points_path, None);
}

#[test]
fn poses_are_world_to_camera_and_quaternions_are_normalised() {
    let mut m = model(1);
    // A quarter turn about z, of length 3: x goes to y.
    m.images = vec![Img {
        quat: [3.0, 0.0, 0.0, 3.0],
        translation: [1.0, 2.0, 3.0],
        camera: 1,
        name: b"a.jpg".to_vec(),
        observations: 0,
    }];
    let (scene, _) = scene_with(&m, true);
    let pose = read(scene.path()).views[0].pose;
    let want = DMat3::from_cols(DVec3::Y, -DVec3::X, DVec3::Z);
    // 1e-15: one rounding of numbers of size 1.
    assert!((pose.rotation - want).to_cols_array().iter().all(|x| x.abs() < 1e-15), "{}", pose.rotation);
    assert_eq!(pose.translation, DVec3::new(1.0, 2.0, 3.0));
    assert!((pose.rotation * pose.centre() + pose.translation).length() < 1e-14);
    // Components whose squares overflow are still a direction.
    m.images[0].quat = [1e200, 0.0, 0.0, 1e200];
    let (scene, _) = scene_with(&m, true);
    assert_eq!(read(scene.path()).views[0].pose, pose);
}

#[test]
fn every_place_is_searched_and_the_largest_model_wins() {
    for place in ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."] {
        let scene = scene_folder();
        assert!(!looks_like_colmap(scene.path()));
        model(3).write_txt(&scene.path().join(place));
        assert!(looks_like_colmap(scene.path()), "{place}");
        let found = read_scene(scene.path(), &ReadOptions::default()).unwrap();
        assert_eq!((found.views.len(), found.warnings.len()), (4, 0));
    }
    for is_binary in [true, false] {
        let scene = scene_folder();
        let mut small = model(1);
        small.images.truncate(2);
        let write = |m: &Model, place: &str| {
            let folder = scene.path().join(place);
            if is_binary { m.write_bin(&folder) } else { m.write_txt(&folder) }
        };
        write(&small, "sparse/0");
        write(&model(2), "sparse/1");
        write(&small, "sparse/2");
        let found = read(scene.path());
        assert_eq!((found.views.len(), found.points.positions.len()), (4, 2));
        warned(&found, &["3 COLMAP models", "1 has the most images (4)"]);
    }
}

#[test]
fn a_broken_model_beside_a_good_one_is_skipped() {
    let scene = scene_folder();
    model(2).write_bin(&scene.path().join("sparse/1"));
    let broken = scene.path().join("sparse/0");
    model(2).write_bin(&broken);
    fs::write(broken.join("images.bin"), (1u64 << 60).to_le_bytes()).unwrap();
    let found = read(scene.path());
    assert_eq!(found.views.len(), 4);
    warned(&found, &["sparse/0", "is skipped", "1152921504606846976 images"]);
}

#[test]
fn unused_files_and_other_folders_do_no_harm() {
    let (scene, folder) = scene_with(&model(2), true);
    for name in ["rigs.bin", "frames.bin", "project.ini"] {
        fs::write(folder.join(name), b"\xff\xffnot looked at").unwrap();
    }
    fs::create_dir(scene.path().join("sparse/empty")).unwrap();
    fs::write(scene.path().join("sparse/notes.txt"), "x").unwrap();
    assert_eq!(read(scene.path()).warnings, Vec::<String>::new());
    fs::rename(scene.path().join("images"), scene.path().join("photos_2")).unwrap();
    let options = ReadOptions { images: Some("photos_2".into()), ..ReadOptions::default() };
    let found = read_colmap(scene.path(), &options).unwrap();
    assert_eq!(found.views[1].image_path, scene.path().join("photos_2/b.jpg"));
}

#[test]
fn no_points_is_a_warning() {
    let (scene, folder) = scene_with(&model(2), true);
    fs::remove_file(folder.join("points3D.bin")).unwrap();
    let found = read(scene.path());
    assert!(found.points.positions.is_empty());
    warned(&found, &["no points3D file"]);
    fs::write(folder.join("points3D.ply"), "ply").unwrap();
    let found = read(scene.path());
    assert_eq!((found.points_path, found.warnings.len()), (Some(folder.join("points3D.ply")), 0));
    let (scene, _) = scene_with(&model(0), true);
    warned(&read(scene.path()), &["holds no points"]);
}

#[test]
fn a_few_bad_points_are_dropped_and_counted() {
    let mut m = model(300);
    m.points[17].position[1] = f64::NAN;
    m.points[200].position[2] = f64::NEG_INFINITY;
    m.points[201].position[0] = 1e12; // finite: for the loader to judge
    for is_binary in [true, false] {
        let (scene, _) = scene_with(&m, is_binary);
        let found = read(scene.path());
        assert_eq!(found.points.positions.len(), 298);
        assert_eq!(found.points.colors.len(), 298);
        assert!(found.points.positions.contains(&[1e12, 0.25, -1.5]));
        warned(&found, &["2 of 300 points"]);
    }
}

#[test]
fn a_view_without_a_pose_is_left_out_by_name() {
    for (quat, x) in [([f64::NAN; 4], 0.0), ([0.0; 4], 0.0), ([1.0, 0.0, 0.0, 0.0], f64::INFINITY)] {
        for is_binary in [true, false] {
            let mut m = model(2);
            (m.images[3].quat, m.images[3].translation[0]) = (quat, x);
            let (scene, _) = scene_with(&m, is_binary);
            let found = read(scene.path());
            assert_eq!(found.views.len(), 3);
            warned(&found, &["images.", "1 view left out", "'b.jpg'"]);
        }
    }
}

#[test]
fn text_files_from_other_systems_are_read() {
    let m = model(3);
    let (scene, folder) = scene_with(&m, false);
    fs::write(folder.join("cameras.txt"), format!("\u{feff}{}", m.cameras_txt().replace('\n', "\r\n"))).unwrap();
    // No newline at the end, and no comments at all.
    let images: Vec<_> = m.images_txt().lines().skip(1).map(str::to_string).collect();
    fs::write(folder.join("images.txt"), images.join("\r\n")).unwrap();
    // A track longer than the line buffer.
    let long = " 1 2".repeat(30_000);
    let points: Vec<_> =
        m.points_txt().lines().map(|l| if l.starts_with('#') { l.into() } else { format!("{l}{long}") }).collect();
    fs::write(folder.join("points3D.txt"), points.join("\n")).unwrap();
    let found = read(scene.path());
    assert_eq!((found.views.len(), found.points.positions.len(), found.warnings.len()), (4, 3, 0));
}

/// As programs built by Microsoft's compiler write it.
#[test]
fn what_is_no_number_in_a_text_file_costs_its_record_alone() {
    let mut m = model(200);
    m.points[3].position[1] = f64::NAN;
    m.images[3].translation[0] = f64::NAN;
    let (scene, folder) = scene_with(&m, false);
    let points = m.points_txt().replace("NaN", "-nan(ind)").replacen(" 0.7", " 1.#QNAN", 1);
    fs::write(folder.join("points3D.txt"), points).unwrap();
    fs::write(folder.join("images.txt"), m.images_txt().replace("NaN", "-nan(ind)")).unwrap();
    let found = read(scene.path());
    assert_eq!((found.views.len(), found.points.positions.len()), (3, 199));
    warned(&found, &["images.txt", "1 view left out"]);
}

/// Nerfstudio's folders have both.
#[test]
fn a_transforms_json_beside_a_model_is_named() {
    let (scene, _) = scene_with(&model(2), false);
    fs::write(scene.path().join("transforms.json"), "{}").unwrap();
    let found = read_scene(scene.path(), &ReadOptions::default()).unwrap();
    warned(&found, &["transforms.json is not read", "COLMAP"]);
}

#[test]
fn a_text_file_shorter_than_its_comment_says_is_warned_about() {
    let m = model(5);
    let (scene, folder) = scene_with(&m, false);
    let short: Vec<_> = m.points_txt().lines().take(4).map(str::to_string).collect();
    fs::write(folder.join("points3D.txt"), short.join("\n")).unwrap();
    warned(&read(scene.path()), &["says 5 points", "holds 3"]);
}

#[test]
fn bytes_after_the_last_record_are_warned_about() {
    let m = model(5);
    let (scene, folder) = scene_with(&m, true);
    fs::write(folder.join("images.bin"), [m.images_bin(), vec![0; 9]].concat()).unwrap();
    warned(&read(scene.path()), &["images.bin", "9 bytes after the last record"]);
}

#[test]
fn every_usable_camera_model_is_read_from_both_formats() {
    let p = [500.0, 501.0, 320.0, 240.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8];
    let one = [500.0, 320.0, 240.0, 0.1, 0.2];
    let radial = |k: &[f64]| Lens::Radial(std::array::from_fn(|i| k.get(i).copied().unwrap_or(0.0)));
    let fisheye = |k: &[f64]| Lens::Fisheye(std::array::from_fn(|i| k.get(i).copied().unwrap_or(0.0)));
    let cases = [
        ((0, "SIMPLE_PINHOLE"), &one[..3], Lens::Pinhole),
        ((1, "PINHOLE"), &p[..4], Lens::Pinhole),
        ((2, "SIMPLE_RADIAL"), &one[..4], radial(&[0.1])),
        ((3, "RADIAL"), &one[..5], radial(&[0.1, 0.2])),
        ((4, "OPENCV"), &p[..8], radial(&[0.1, 0.2, 0.3, 0.4])),
        ((5, "OPENCV_FISHEYE"), &p[..8], fisheye(&[0.1, 0.2, 0.3, 0.4])),
        ((6, "FULL_OPENCV"), &p[..12], radial(&p[4..])),
        ((8, "SIMPLE_RADIAL_FISHEYE"), &one[..4], fisheye(&[0.1])),
        ((9, "RADIAL_FISHEYE"), &one[..5], fisheye(&[0.1, 0.2])),
    ];
    for (id, params, lens) in cases {
        let mut m = model(1);
        m.cameras[0] = Cam { id: 1, model: id, size: (640, 480), params: params.to_vec() };
        for is_binary in [true, false] {
            let (scene, _) = scene_with(&m, is_binary);
            let i = read(scene.path()).views[0].intrinsics;
            let fy = if params.len() >= 4 && params[1] == 501.0 { 501.0 } else { 500.0 };
            assert_eq!((i.fx, i.fy, i.cx, i.cy, i.lens), (500.0, fy, 320.0, 240.0, lens), "{id:?}");
        }
    }
}
