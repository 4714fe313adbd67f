//! transforms.json scenes that are read.

use super::write::{refused, warned};
use glam::DVec3;
use gsscale::dataset::model::{Lens, RawScene, Split};
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::dataset::transforms::{looks_like_transforms, read_transforms};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

pub fn frame(name: &str) -> Value {
    json!({"file_path": name, "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]})
}

/// A scene folder with one transforms.json: the given keys and frames.
pub fn scene(top: Value, frames: Vec<Value>) -> TempDir {
    let folder = TempDir::new().unwrap();
    write(folder.path(), "transforms.json", top, frames);
    folder
}

pub fn write(folder: &Path, name: &str, mut top: Value, frames: Vec<Value>) {
    top["frames"] = Value::Array(frames);
    fs::write(folder.join(name), top.to_string()).unwrap();
}

pub fn size() -> Value {
    json!({"w": 640, "h": 480, "fl_x": 500.0})
}

fn png(path: &Path, width: u32, height: u32) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbImage::new(width, height).save(path).unwrap();
}

pub fn read(folder: &Path) -> RawScene {
    read_scene(folder, &ReadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

#[test]
fn a_nerfstudio_scene() {
    let top = json!({
        "camera_model": "OPENCV", "w": 640.0, "h": 480, "fl_x": 500.0, "fl_y": 510.0, "cx": 321.0, "cy": 239.0,
        "k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "k3": null, "k4": 0, "ply_file_path": "sparse_pc.ply",
        "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]], "applied_scale": 0.5
    });
    let mut first = frame("./images/b.jpg");
    first["mask_path"] = "masks/b.png".into();
    let folder = scene(top, vec![first, frame("images/a.jpg")]);
    fs::write(folder.path().join("sparse_pc.ply"), "ply").unwrap();
    assert!(looks_like_transforms(folder.path()));
    let found = read(folder.path());
    let names: Vec<_> = found.views.iter().map(|v| v.name.as_str()).collect();
    assert_eq!((names, found.warnings.len()), (vec!["images/a.jpg", "images/b.jpg"], 0));
    assert_eq!(found.points_path, Some(folder.path().join("sparse_pc.ply")));
    let view = &found.views[1];
    assert_eq!(view.image_path, folder.path().join("images/b.jpg"));
    assert_eq!(view.mask_path, Some(folder.path().join("masks/b.png")));
    assert_eq!(view.split, None);
    let i = view.intrinsics;
    assert_eq!((i.width, i.height, i.fx, i.fy, i.cx, i.cy), (640, 480, 500.0, 510.0, 321.0, 239.0));
    assert_eq!(i.lens, Lens::Radial([0.1, 0.2, 0.3, 0.4, 0.0, 0.0, 0.0, 0.0]));
    // Camera at (1, 2, 3) looking down -z; 1e-12 for a few roundings.
    assert!((view.pose.centre() - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
    let ahead = view.pose.rotation * DVec3::new(1.0, 3.0, -7.0) + view.pose.translation;
    assert!((ahead - DVec3::new(0.0, -1.0, 10.0)).length() < 1e-12, "{ahead}");
}

#[test]
fn frames_override_the_top_level() {
    let mut own = frame("b.png");
    for (key, value) in [("w", json!(320)), ("h", json!(200)), ("camera_angle_x", json!(1.0)), ("k1", json!(0.5))] {
        own[key] = value;
    }
    let mut fisheye = frame("c.png");
    fisheye["camera_model"] = "OPENCV_FISHEYE".into();
    fisheye["k1"] = 0.25.into();
    let folder = scene(size(), vec![frame("a.png"), own, fisheye]);
    let views = read(folder.path()).views;
    assert_eq!((views[0].intrinsics.fx, views[0].intrinsics.lens), (500.0, Lens::Pinhole));
    let i = views[1].intrinsics;
    // 160 / tan(0.5), to the last bits of a tangent.
    assert!((i.fx - 160.0 / 0.5f64.tan()).abs() < 1e-9 && i.fx == i.fy, "{i:?}");
    assert_eq!((i.width, i.cx, i.cy), (320, 160.0, 100.0));
    assert_eq!(i.lens, Lens::Radial([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]));
    assert_eq!(views[2].intrinsics.lens, Lens::Fisheye([0.25, 0.0, 0.0, 0.0]));
}

#[test]
fn a_blender_scene_takes_sizes_from_the_photos_and_the_split_from_the_files() {
    let folder = TempDir::new().unwrap();
    for (set, ending) in [("train", "png"), ("val", "png"), ("test", "JPG")] {
        let top = json!({"camera_angle_x": 0.5});
        let frames = vec![frame(&format!("./{set}/r_1")), frame(&format!("./{set}/r_0"))];
        write(folder.path(), &format!("transforms_{set}.json"), top, frames);
        for i in 0..2 {
            let written = folder.path().join(format!("{set}/r_{i}.{}", ending.to_lowercase()));
            png(&written, 80, 60);
            fs::rename(&written, folder.path().join(format!("{set}/r_{i}.{ending}"))).unwrap();
        }
    }
    let found = read(folder.path());
    let views: Vec<_> = found.views.iter().map(|v| (v.name.as_str(), v.split)).collect();
    let (train, test) = (Some(Split::Train), Some(Split::Test));
    // Where the case of a name does not count, the first ending that is tried finds the photo.
    let [first, second] = if folder.path().join("TEST").exists() {
        ["test/r_0.jpg", "test/r_1.jpg"]
    } else {
        ["test/r_0.JPG", "test/r_1.JPG"]
    };
    assert_eq!(views, [(first, test), (second, test), ("train/r_0.png", train), ("train/r_1.png", train)]);
    warned(&found, &["transforms_val.json", "not read"]);
    let i = found.views[0].intrinsics;
    assert_eq!((i.width, i.height, i.cx, i.cy), (80, 60, 40.0, 30.0));
    assert!((i.fx - 40.0 / 0.25f64.tan()).abs() < 1e-9); // the last bits of a tangent
    // Without a test file the val file is the test set.
    fs::remove_file(folder.path().join("transforms_test.json")).unwrap();
    let found = read(folder.path());
    assert_eq!(found.views[2].name, "val/r_0.png");
    assert_eq!((found.views[2].split, found.warnings.len()), (test, 0));
    // A file named by its path is read alone.
    let alone = read(&folder.path().join("transforms_train.json"));
    assert!(alone.views.len() == 2 && alone.views.iter().all(|v| v.split.is_none()));
}

#[test]
fn split_files_win_over_the_single_one_and_say_so() {
    let folder = scene(size(), vec![frame("a.png")]);
    write(folder.path(), "transforms_train.json", size(), vec![frame("b.png")]);
    let found = read(folder.path());
    assert_eq!(found.views[0].name, "b.png");
    warned(&found, &["transforms.json", "not read"]);
}

#[test]
fn lists_of_file_names_prescribe_the_split() {
    let mut top = size();
    top["train_filenames"] = json!(["images/a.png", "./images/b.png"]);
    top["val_filenames"] = json!(["images/c.png"]);
    top["test_filenames"] = json!(["images/d.png"]);
    let frames: Vec<_> = ["a", "b", "c", "d"].iter().map(|n| frame(&format!("images/{n}.png"))).collect();
    let folder = scene(top.clone(), frames.clone());
    let found = read(folder.path());
    let views: Vec<_> = found.views.iter().map(|v| (v.name.as_str(), v.split)).collect();
    let (train, test) = (Some(Split::Train), Some(Split::Test));
    assert_eq!(views, [("images/a.png", train), ("images/b.png", train), ("images/d.png", test)]);
    warned(&found, &["1 view left out", "'images/c.png'"]);
    top.as_object_mut().unwrap().remove("test_filenames");
    let folder = scene(top.clone(), frames.clone());
    assert_eq!(read(folder.path()).views[2].split, test);
    // An empty list is none.
    top["test_filenames"] = json!([]);
    assert_eq!(read(scene(top.clone(), frames.clone()).path()).views[2].split, test);
    top["val_filenames"] = json!(["images/a.png"]);
    let folder = scene(top, frames);
    refused(read_transforms(folder.path(), &ReadOptions::default()), "transforms.json", &["train_filenames", "a.png"]);
}

#[test]
fn matrixcity_rotations_are_scaled_and_its_frames_numbered() {
    let s = 0.01;
    let rot_mat = json!([[s, 0, 0, 1], [0, 0, -s, 2], [0, s, 0, 3], [0, 0, 0, 1]]);
    let folder = scene(size(), vec![json!({"frame_index": 12, "rot_mat": rot_mat})]);
    let views = read(folder.path()).views;
    assert_eq!(views[0].name, "0012.png");
    assert!((views[0].pose.centre() - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12); // a few roundings
    assert!((views[0].pose.rotation.determinant() - 1.0).abs() < 1e-12);
}

#[test]
fn invalid_poses_are_dropped_by_name() {
    let mut frames: Vec<_> = ["a.png", "b.png", "c.png", "d.png"].map(frame).into();
    frames[1]["transform_matrix"][0][3] = Value::Null; // how some writers put NaN
    frames[2]["transform_matrix"][0][0] = json!(2.0);
    frames[3]["transform_matrix"][0][0] = json!(-1.0);
    let found = read(scene(size(), frames).path());
    assert_eq!(found.views.len(), 1);
    warned(&found, &["3 views left out", "'b.png', 'c.png', 'd.png'"]);
}

#[test]
fn photos_are_found_in_another_image_folder() {
    let folder = scene(json!({"camera_angle_x": 0.5}), vec![frame("images/a.png"), frame("images/b.png")]);
    png(&folder.path().join("images_2/a.png"), 40, 30);
    png(&folder.path().join("images_2/images/b.png"), 20, 15);
    let options = ReadOptions { images: Some("images_2".into()), ..ReadOptions::default() };
    let views = read_transforms(folder.path(), &options).unwrap().views;
    assert_eq!(views[0].image_path, folder.path().join("images_2/a.png"));
    assert_eq!((views[0].name.as_str(), views[0].intrinsics.width), ("images/a.png", 40));
    assert_eq!((views[1].name.as_str(), views[1].intrinsics.width), ("images/b.png", 20));
    // The usual folder does not change names that already say where the photo is.
    png(&folder.path().join("r/c.png"), 16, 12);
    png(&folder.path().join("images/d.png"), 8, 6);
    write(folder.path(), "transforms.json", json!({"camera_angle_x": 0.5}), vec![frame("r/c"), frame("d")]);
    let options = ReadOptions { images: Some("images".into()), ..ReadOptions::default() };
    let views = read_transforms(folder.path(), &options).unwrap().views;
    let found: Vec<_> = views.iter().map(|v| (v.name.as_str(), v.intrinsics.width)).collect();
    assert_eq!(found, [("d.png", 8), ("r/c.png", 16)]);
}

/// Numbers in pixels are of the photo that a frame names, whatever smaller one is trained on.
#[test]
fn without_a_stated_size_pixels_are_of_the_named_photo() {
    let folder = scene(json!({"fl_x": 80.0, "cx": 48.0}), vec![frame("images/a.png")]);
    png(&folder.path().join("images_2/a.png"), 48, 32);
    let smaller = ReadOptions { images: Some("images_2".into()), ..ReadOptions::default() };
    refused(read_transforms(folder.path(), &smaller), "transforms.json", &["a.png", "w and h", "--images"]);
    png(&folder.path().join("images/a.png"), 96, 64);
    let found = read_scene(folder.path(), &smaller).unwrap();
    let k = found.views[0].intrinsics;
    assert_eq!((k.width, k.height, k.fx, k.cx), (96, 64, 80.0, 48.0));
    assert_eq!(found.views[0].image_path, folder.path().join("images_2/a.png"));
    // An angle holds for any size.
    fs::remove_file(folder.path().join("images/a.png")).unwrap();
    write(folder.path(), "transforms.json", json!({"camera_angle_x": 1.0}), vec![frame("images/a.png")]);
    assert_eq!(read_scene(folder.path(), &smaller).unwrap().views[0].intrinsics.width, 48);
}

#[test]
fn missing_photos_matter_only_while_their_size_is_unknown() {
    assert_eq!(read(scene(size(), vec![frame("gone")]).path()).views[0].name, "gone.png");
    let folder = scene(json!({"camera_angle_x": 0.5}), vec![frame("a.png"), frame("gone")]);
    png(&folder.path().join("a.png"), 40, 30);
    let refusal = read_transforms(folder.path(), &ReadOptions::default());
    refused(refusal, "transforms.json", &["1 photo is missing", "'gone.png'", "--allow-missing"]);
    let options = ReadOptions { allow_missing: true, ..ReadOptions::default() };
    let found = read_transforms(folder.path(), &options).unwrap();
    assert_eq!(found.views.len(), 1);
    warned(&found, &["1 view left out", "'gone.png'"]);
}

#[test]
fn a_ply_that_is_not_there_is_a_warning() {
    let mut top = size();
    top["ply_file_path"] = "points.ply".into();
    let found = read(scene(top, vec![frame("a.png")]).path());
    assert_eq!(found.points_path, None);
    warned(&found, &["points.ply", "does not exist"]);
}
