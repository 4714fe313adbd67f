//! OpenSfM's `reconstruction.json` and RealityCapture's CSV: lenses, what is refused, and the words of errors.

use super::write::{HEADER, refused, scene_folder, warned};
use gsscale::dataset::model::{Lens, RawScene};
use gsscale::dataset::read::{ReadOptions, read_scene};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

fn shot(camera: &str) -> Value {
    json!({ "rotation": [0.0, 0.0, 0.5], "translation": [1, 2, 3], "camera": camera })
}

fn camera(lens: &str, more: Value) -> Value {
    let mut camera =
        json!({ "projection_type": lens, "width": 400, "height": 300, "focal": 0.5, "focal_x": 0.5, "focal_y": 0.6 });
    camera.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    camera
}

fn write_json(folder: &Path, value: &Value) {
    fs::write(folder.join("reconstruction.json"), value.to_string()).unwrap();
}

fn read(folder: &Path) -> gsscale::base::error::InputResult<RawScene> {
    read_scene(folder, &ReadOptions::default())
}

/// The lens that is read for this camera, and fx, fy, cx, cy.
fn lens_of(camera: Value) -> (Lens, [f64; 4]) {
    let scene = scene_folder();
    write_json(scene.path(), &json!([{ "cameras": { "c": camera }, "shots": { "a.jpg": shot("c") } }]));
    let i = read(scene.path()).unwrap().views[0].intrinsics;
    (i.lens, [i.fx, i.fy, i.cx, i.cy])
}

#[test]
fn lenses_of_opensfm_are_those_of_opencv() {
    let k = json!({ "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "p1": 0.01, "p2": 0.02, "c_x": 0.25, "c_y": -0.1 });
    // The longer side is 400: 0.5 is 200 pixels, and 0.25 is 100 pixels from the middle.
    let (off, middle) = ([200.0, 240.0, 300.0, 110.0], [200.0, 200.0, 200.0, 150.0]);
    for (name, lens, numbers) in [
        ("brown", Lens::Radial([0.1, 0.2, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0]), off),
        ("perspective", Lens::Radial([0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), middle),
        ("", Lens::Radial([0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), middle),
        ("fisheye", Lens::Fisheye([0.1, 0.2, 0.0, 0.0]), middle),
        ("fisheye_opencv", Lens::Fisheye([0.1, 0.2, 0.3, 0.4]), off),
    ] {
        assert_eq!(lens_of(camera(name, k.clone())), (lens, numbers), "{name}");
    }
    let plain = camera("fisheye624", json!({ "k1": 0.1, "s0": 0.0 }));
    assert_eq!(lens_of(plain).0, Lens::Fisheye([0.1, 0.0, 0.0, 0.0]));
}

#[test]
fn bad_reconstructions_are_refused_by_place() {
    let good = json!([{ "cameras": { "c": camera("brown", json!({})) }, "shots": { "a.jpg": shot("c") } }]);
    for (pointer, value, words) in [
        ("/0/cameras/c/projection_type", json!("spherical"), &["camera \"c\"", "spherical"][..]),
        ("/0/cameras/c/focal_x", json!(0), &["camera \"c\"", "focal length"]),
        ("/0/cameras/c/width", json!(-4), &["camera \"c\"", "0 x 300"]),
        ("/0/shots/a.jpg/camera", json!("d"), &["shot \"a.jpg\"", "its camera \"d\""]),
        ("/0/shots/a.jpg/rotation", json!([1, 2]), &["line 1 column", "shot \"a.jpg\""]),
        ("/0/shots/a.jpg/translation", json!([1e300, 0, 0]), &["no view is left"]),
        ("/0/shots", json!({ "../a.jpg": shot("c") }), &["climbs out"]),
        ("/0/shots", json!({}), &["no photo with a pose"]),
        ("/0/shots", json!({ "b/a.jpg": shot("c"), "b//a.jpg": shot("c") }), &["two views"]),
        ("/0", json!({ "shots": {} }), &["missing field `cameras`"]),
    ] {
        let mut bad = good.clone();
        *bad.pointer_mut(pointer).unwrap() = value;
        let scene = scene_folder();
        write_json(scene.path(), &bad);
        refused(read(scene.path()), "reconstruction.json", words);
    }
}

#[test]
fn the_largest_reconstruction_is_read() {
    let scene = scene_folder();
    let part = |shots: Value| json!({ "cameras": { "c": camera("brown", json!({})) }, "shots": shots });
    let (one, two) = (json!({ "a.jpg": shot("c") }), json!({ "b.jpg": shot("c"), "c.jpg": shot("c") }));
    write_json(scene.path(), &json!([part(one), part(two)]));
    let read = read(scene.path()).unwrap();
    assert_eq!(read.views.len(), 2);
    warned(&read, &["2 reconstructions", "2 of 3 photos"]);
}

/// A folder with a photo a.png of 40x30 pixels, and this CSV.
fn csv(text: &str) -> TempDir {
    let scene = scene_folder();
    image::RgbImage::new(40, 30).save(scene.path().join("images/a.png")).unwrap();
    fs::write(scene.path().join("poses.csv"), text).unwrap();
    scene
}

#[test]
fn a_csv_of_reality_capture_is_read_by_its_columns() {
    let scene = csv(&format!("\u{feff}#cameras 1\n{HEADER}\na.png,1,2,3,0,0,0,18,0.1,-0.05,0.1,0.2,0.3,0,0.01,0.02\n"));
    let view = &read(scene.path()).unwrap().views[0];
    assert_eq!(view.pose.centre().to_array(), [1.0, 2.0, 3.0]);
    let i = view.intrinsics;
    // Half of 36 mm, and a tenth and a twentieth of the longer side from the middle.
    assert_eq!([i.fx, i.fy, i.cx, i.cy], [20.0, 20.0, 24.0, 13.0]);
    assert_eq!(i.lens, Lens::Radial([0.1, 0.2, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0]));
    let short = csv("#name,alt,x,y,f,heading,pitch,roll\na.png,3,1,2,18,0,0,0\n");
    let view = &read(short.path()).unwrap().views[0];
    assert_eq!((view.pose.centre().to_array(), view.intrinsics.lens), ([1.0, 2.0, 3.0], Lens::Pinhole));
}

#[test]
fn bad_lines_of_a_csv_are_refused_by_number() {
    let good = "a.png,1,2,3,0,0,0,18,0,0,0,0,0,0,0,0";
    for (line, words) in [
        ("a.png,1,x,3,0,0,0,18,0,0,0,0,0,0,0,0", &["line 3", "\"x\" in column 'y'"][..]),
        ("a.png,1,2", &["line 3", "3 cells"]),
        ("a.png,1,2,3,0,0,0,0,0,0,0,0,0,0,0,0", &["line 3", "focal length"]),
        ("a.png,1,2,3,0,0,0,18,0,0,0,0,0,0.5,0,0", &["line 3", "Brown3"]),
        ("../c.png,1,2,3,0,0,0,18,0,0,0,0,0,0,0,0", &["line 3", "climbs out"]),
        ("b.png,1,2,3,0,0,0,18,0,0,0,0,0,0,0,0", &["1 photo is missing", "'b.png'"]),
        (good, &["two views"]),
    ] {
        refused(read(csv(&format!("{HEADER}\n{good}\n{line}\n")).path()), "poses.csv", words);
    }
    let infinite = good.replacen("1,2,3", "1,inf,3", 1);
    refused(read(csv(&format!("{HEADER}\n{infinite}\n")).path()), "poses.csv", &["no view is left"]);
    refused(read(csv("#name,x,y,alt,heading,pitch,roll\na.png,1,2,3,0,0,0\n").path()), "poses.csv", &["no column 'f'"]);
    let two = csv(&format!("{HEADER}\n{good}\n"));
    fs::copy(two.path().join("poses.csv"), two.path().join("old.csv")).unwrap();
    let error = read(two.path()).unwrap_err().to_string();
    assert!(error.contains("two CSV files") && error.contains("old.csv"), "{error}");
    assert_eq!(read(&two.path().join("poses.csv")).unwrap().views.len(), 1);
}
