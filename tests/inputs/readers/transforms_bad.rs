//! transforms.json scenes that are refused, with file, key and remedy.

use super::transforms_good::{frame, scene, size, write};
use super::write::refused;
use gsscale::base::error::InputError;
use gsscale::dataset::read::{ReadOptions, read_scene};
use serde_json::{Value, json};
use std::fs;
use tempfile::TempDir;

#[track_caller]
fn refused_json(text: &str, parts: &[&str]) -> InputError {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("transforms.json"), text).unwrap();
    refused(read_scene(folder.path(), &ReadOptions::default()), "transforms.json", parts)
}

#[track_caller]
fn refused_scene(top: Value, frames: Vec<Value>, parts: &[&str]) {
    let folder = scene(top, frames);
    refused(read_scene(folder.path(), &ReadOptions::default()), "transforms.json", parts);
}

#[test]
fn broken_json_is_refused_by_line() {
    refused_json("", &["line 1"]);
    refused_json("{\n\"frames\": [\n", &["line 3"]);
    refused_json("{\"w\": Nan0}", &["line 1 column 7"]);
    refused_json("{\"w\": 1e999, \"frames\": []}", &["line 1"]);
    refused_json(&"[".repeat(100_000), &["line 1 column 128"]);
    refused_json(&"{\"a\":".repeat(100_000), &["line 1"]);
    refused_json("{\"a\": \"\u{1}\"}", &["line 1"]);
    refused_json("[1, 2]", &["not an object"]);
    refused_json("{}", &["frames", "missing"]);
    refused_json("{\"frames\": {}}", &["frames", "not an array"]);
    refused_json("{\"frames\": []}", &["frames", "no frames"]);
    refused_json("{\"frames\": [1]}", &["frames[0]", "not an object"]);
}

#[test]
fn keys_of_the_wrong_kind_are_refused_by_name() {
    let with = |key: &str, value: Value| {
        let mut f = frame("b.png");
        f[key] = value;
        vec![frame("a.png"), f]
    };
    let cases = [
        ("file_path", json!(7), "not a string"),
        ("file_path", Value::Null, "missing"),
        ("w", json!("wide"), "not a number"),
        ("w", json!(0), "number of pixels"),
        ("w", json!(10.5), "number of pixels"),
        ("h", json!(-480), "number of pixels"),
        ("h", json!(1e300), "number of pixels"),
        ("fl_x", json!([500]), "not a number"),
        ("fl_x", json!(0), "focal length"),
        ("fl_x", json!(-1), "focal length"),
        ("fl_x", json!(1e300), "focal length"),
        ("cx", json!(1e9), "principal point"),
        ("cy", json!(-1e9), "principal point"),
        ("k1", json!("0.1"), "not a number"),
        ("k4", json!(0.1), "not defined"),
        ("mask_path", json!(1), "not a string"),
        ("camera_model", json!(1), "not a string"),
        ("camera_model", json!("EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        ("transform_matrix", Value::Null, "missing"),
        ("transform_matrix", json!("x"), "not an array"),
        ("transform_matrix", json!([[1, 0, 0, 0]]), "4 x 4"),
        ("transform_matrix", json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), "4 x 4"),
        ("transform_matrix", json!([["a", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "4 x 4"),
    ];
    for (key, value, part) in cases {
        refused_scene(size(), with(key, value), &[&format!("frames[1].{key}"), part]);
    }
    let mut top = size();
    top["ply_file_path"] = json!(3);
    refused_scene(top, vec![frame("a.png")], &["ply_file_path", "not a string"]);
    refused_scene(json!({"w": 640, "h": 480}), vec![frame("a.png")], &["fl_x", "no focal length"]);
    for angle in [0.0, -1.0, 3.2, 1e9] {
        let top = json!({"w": 640, "h": 480, "camera_angle_x": angle});
        refused_scene(top, vec![frame("a.png")], &["camera_angle_x", "field of view"]);
    }
    let top = json!({"w": 640, "h": 480, "fl_x": 500, "is_fisheye": true, "p1": 0.1});
    refused_scene(top, vec![frame("a.png")], &["p1", "OPENCV_FISHEYE"]);
    let top = json!({"w": 70_000, "h": 480, "fl_x": 500});
    refused_scene(top, vec![frame("a.png")], &["70000 x 480"]);
}

#[test]
fn paths_that_leave_the_folder_are_refused() {
    for path in ["../a.png", "images/../../a.png", "/etc/passwd", "C:/a.png", "..\\a.png", "a\u{0}.png", "", "."] {
        refused_scene(size(), vec![frame(path)], &["frames[0].file_path", "name"]);
        let mut f = frame("a.png");
        f["mask_path"] = path.into();
        refused_scene(size(), vec![f], &["frames[0].mask_path", "name"]);
        let mut top = size();
        top["ply_file_path"] = path.into();
        refused_scene(top, vec![frame("a.png")], &["ply_file_path", "name"]);
    }
}

#[test]
fn duplicates_and_scenes_without_a_view_are_refused() {
    refused_scene(size(), vec![frame("a.png"), frame("./a.png")], &["two views", "'a.png'"]);
    let mut f = frame("a.png");
    f["transform_matrix"][0][0] = json!(5);
    refused_scene(size(), vec![f], &["frames", "no view is left"]);
    let folder = TempDir::new().unwrap();
    write(folder.path(), "transforms_train.json", size(), vec![frame("a.png")]);
    write(folder.path(), "transforms_test.json", size(), vec![frame("a.png")]);
    refused(read_scene(folder.path(), &ReadOptions::default()), "transforms_train.json", &["two views", "'a.png'"]);
}

#[test]
fn a_photo_whose_header_cannot_be_read_is_refused_by_name() {
    for bytes in [&b""[..], b"not a picture", b"\x89PNG\r\n\x1a\n\0\0\0"] {
        let folder = scene(json!({"camera_angle_x": 0.5}), vec![frame("a.png")]);
        fs::write(folder.path().join("a.png"), bytes).unwrap();
        refused(read_scene(folder.path(), &ReadOptions::default()), "a.png", &["size cannot be read"]);
    }
}
