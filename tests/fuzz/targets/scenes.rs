//! COLMAP models, transforms.json, OpenSfM's reconstruction.json, RealityCapture's CSV, and the names in all of them.

use super::{split_mode, with_mode};
use crate::Target;
use crate::scene_folder::{read_and_check, scratch, stays_in};
use gsscale::dataset::paths::{MAX_NAME_BYTES, read_name};
use std::path::Path;
use tempfile::TempDir;

#[allow(dead_code)] // other tests use all of it
#[path = "../../inputs/readers/write.rs"]
mod write;

const MEMORY: [u64; 2] = [2 << 20, 60];
const FILES: [&str; 3] = ["cameras", "images", "points3D"];

/// The three files of a model, whose first image has this name.
fn model_files(name: &[u8], extension: &str) -> [Vec<u8>; 3] {
    let mut model = write::model(20);
    model.images.truncate(3);
    if extension == "bin" {
        model.images[0].name = name.to_vec();
        return [model.cameras_bin(), model.images_bin(), model.points_bin()];
    }
    model.images[0].name = b"NAME".to_vec();
    let images = model.images_txt();
    let (before, after) = images.split_once("NAME").unwrap();
    let images = [before.as_bytes(), name, after.as_bytes()].concat();
    [model.cameras_txt().into_bytes(), images, model.points_txt().into_bytes()]
}

fn scene_of(files: &[Vec<u8>; 3], extension: &str) -> TempDir {
    let scene = scratch();
    let model = scene.path().join("sparse/0");
    std::fs::create_dir_all(&model).unwrap();
    std::fs::create_dir(scene.path().join("images")).unwrap();
    for (name, bytes) in FILES.iter().zip(files) {
        std::fs::write(model.join(format!("{name}.{extension}")), bytes).unwrap();
    }
    scene
}

/// The first byte selects the model file that the rest replaces.
fn run_model(input: &[u8], extension: &str) {
    let ((mode, rest), mut files) = (split_mode(input), model_files(b"b.jpg", extension));
    files[usize::from(mode % 3)] = rest.to_vec();
    read_and_check(scene_of(&files, extension).path());
}

fn model_seeds(extension: &str) -> Vec<Vec<u8>> {
    model_files(b"b.jpg", extension).iter().zip(0..).map(|(file, mode)| with_mode(mode, file)).collect()
}

pub fn colmap_binary() -> Target {
    let run = |input: &[u8]| run_model(input, "bin");
    let seeds = model_seeds("bin");
    Target { name: "colmap_binary", run, seeds, words: &["../", "\0"], cases: 3_000, memory: MEMORY }
}

pub fn colmap_text() -> Target {
    let run = |input: &[u8]| run_model(input, "txt");
    let seeds = model_seeds("txt");
    let words = &["OPENCV", "FOV", "FULL_OPENCV", "# Number of images: 9\n", "\n\n", "\u{feff}", "../", "\t", " "];
    Target { name: "colmap_text", run, seeds, words, cases: 3_000, memory: MEMORY }
}

fn frame(name: &str, rest: &str) -> String {
    format!(
        r#"{{"file_path": "images/{name}.png", "mask_path": "masks/{name}.png", {rest} "transform_matrix": [[1, 0, 0, 0.5],
        [0, 0, -1, 2], [0, 1, 0, 1e1], [0, 0, 0, 1]]}}"#
    )
}

pub fn transforms() -> Target {
    let frames = [frame("a", ""), frame("b", "\"fl_y\": 501.5, \"k1\": 0.01,"), frame("c", "\"w\": null,")].join(", ");
    let nerfstudio = format!(
        r#"{{"camera_model": "OPENCV", "w": 640, "h": 480.0, "camera_angle_x": 0.9, "fl_x": 500, "cx": 320, "k1": 0.01,
        "train_filenames": ["images/a.png", "images/b.png"], "test_filenames": ["images/c.png"], "ply_file_path": "p.ply",
        "frames": [{frames}]}}"#
    );
    let plain = format!(r#"{{"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": [{frames}]}}"#);
    let city = r#"{"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": [{"frame_index": 0, "rot_mat": [[0.01, 0, 0, 1],
        [0, 0.01, 0, 2], [0, 0, 0.01, 3], [0, 0, 0, 1]]}]}"#;
    let words =
        &["null", "[[[[[[[[", "{\"a\":", "\"frames\"", "\"../x\"", "1e400", "\"is_fisheye\": true,", "OPENCV_FISHEYE"];
    let seeds = [nerfstudio.as_str(), &plain, city].map(|text| text.as_bytes().to_vec()).to_vec();
    Target { name: "transforms", run: run_transforms, seeds, words, cases: 4_000, memory: MEMORY }
}

fn run_transforms(input: &[u8]) {
    let scene = scratch();
    std::fs::create_dir(scene.path().join("images")).unwrap();
    std::fs::write(scene.path().join("images/a.png"), b"\x89PNG\r\n\x1a\n").unwrap();
    std::fs::write(scene.path().join("p.ply"), b"ply\n").unwrap();
    std::fs::write(scene.path().join("transforms.json"), input).unwrap();
    read_and_check(scene.path());
}

fn reconstruction(name: &str) -> String {
    format!(
        r#"[{{"cameras": {{"c": {{"projection_type": "brown", "width": 640, "height": 480, "focal_x": 0.8, "focal_y": 0.81,
        "c_x": 0.01, "k1": -0.1, "p1": 0.001}}, "d": {{"projection_type": "fisheye", "width": 64, "height": 48, "focal": 0.5}}}},
        "shots": {{{name}: {{"rotation": [0.1, -3, 1e-9], "translation": [1, 2.5, 3e1], "camera": "c", "scale": 1.0}},
        "b.jpg": {{"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "d", "gps_position": [1, 2, 3]}}}},
        "points": {{"1": {{"color": [1.0, 2.0, 300.0], "coordinates": [0.5, 1e16, 2]}}, "2": {{"coordinates": [1, 2, 3]}}}}}},
        {{"cameras": {{}}, "shots": {{}}}}]"#
    )
}

pub fn opensfm() -> Target {
    let words =
        &["null", "[[[[[[[[", "{\"a\":", "\"shots\"", "\"../x\"", "1e400", "perspective", "spherical", "fisheye624"];
    let seeds = [reconstruction("\"a.jpg\""), "[]".to_string()].map(String::into_bytes).to_vec();
    Target { name: "opensfm", run: run_opensfm, seeds, words, cases: 4_000, memory: MEMORY }
}

fn run_opensfm(input: &[u8]) {
    let scene = scratch();
    std::fs::create_dir(scene.path().join("opensfm")).unwrap();
    std::fs::write(scene.path().join("opensfm/reconstruction.json"), input).unwrap();
    read_and_check(scene.path());
}

const CSV_HEADER: &str = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2";

pub fn reality_capture() -> Target {
    let whole = format!("\u{feff}{CSV_HEADER}\r\na.png,1,2,3e1,-170.5,89,-22.7,14.2,-9.4e-4,2e-4,3e-3,0,0,0,0,0\r\n");
    let short = "#cameras 1\n#name,x,y,alt,heading,pitch,roll,f\na.png,1,2,3,0,0,0,20\nb.png,1,2,3,0,0,0,20\n";
    let words = &["nan", "inf", "1e400", "../", ",,", "\"", "#name", "\u{feff}", "\r", ";"];
    let seeds = [whole, short.to_string()].map(String::into_bytes).to_vec();
    Target { name: "reality_capture", run: run_reality_capture, seeds, words, cases: 4_000, memory: MEMORY }
}

fn run_reality_capture(input: &[u8]) {
    let scene = scratch();
    // The header of a picture of 64x48 pixels.
    let header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x40\0\0\0\x30\x08\x02\0\0\0\xad\x5e\xe8\xb6";
    std::fs::write(scene.path().join("a.png"), header).unwrap();
    std::fs::write(scene.path().join("cameras.csv"), input).unwrap();
    read_and_check(scene.path());
}

/// A name in every place where a file may contain one.
pub fn image_names() -> Target {
    let names =
        ["images/0001.png", "cam1/x/a b.jpg", "..\\..\\a", "C:\\a.jpg", "./x//y", "~/.ssh/id", "\\\\host\\share\\a"];
    let words = &[
        "..",
        "/",
        "\\",
        "C:",
        "\0",
        ".",
        "//?/",
        "\u{202e}",
        "\u{2215}",
        "%2e%2e%2f",
        "NUL",
        "a:",
        "\n",
        "~",
        "\u{feff}",
    ];
    let seeds = names.map(|name| name.as_bytes().to_vec()).to_vec();
    Target { name: "image_names", run: run_name, seeds, words, cases: 1_000, memory: [3 << 20, 200] }
}

fn run_name(input: &[u8]) {
    let name = String::from_utf8_lossy(input);
    let folder = Path::new("/data/scene");
    for base in ["", "pose/all"] {
        let Ok(read) = read_name(base, &name) else { continue };
        for tail in read.tails() {
            assert!(stays_in(folder, &folder.join(tail)), "{tail:?}");
            assert!(tail.len() <= MAX_NAME_BYTES + base.len() + 1 && !tail.contains('\\'));
            assert!(!tail.chars().any(char::is_control));
            assert_eq!(read_name("", tail).map(|n| (n.name, n.outside)), Ok((tail.to_string(), None)));
        }
    }
    for extension in ["bin", "txt"] {
        read_and_check(scene_of(&model_files(input, extension), extension).path());
    }
    let text = serde_json::json!({
        "w": 64, "h": 48, "fl_x": 60, "ply_file_path": name,
        "frames": [{"file_path": name, "mask_path": name,
            "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}],
    });
    run_transforms(text.to_string().as_bytes());
    run_opensfm(reconstruction(&serde_json::json!(name).to_string()).as_bytes());
    run_reality_capture(format!("{CSV_HEADER}\n{name},1,2,3,0,0,0,20,0,0,0,0,0,0,0,0\n").as_bytes());
}
