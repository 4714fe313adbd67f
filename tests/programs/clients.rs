//! Other programs read what gsscale writes, and gsscale reads what they write: plyfile, pycolmap, TensorBoard's reader,
//! splat-transform. A test runs where its client is installed, and elsewhere prints why it was skipped.
//!
//! `GSSCALE_PYTHON` names a Python that has the packages (`pip install plyfile pycolmap tensorboard`), `GSSCALE_NODE_BIN`
//! a folder with `splat-transform` (`npm install @playcanvas/splat-transform@3.7.0`, then `node_modules/.bin`). `.ci/run` installs all
//! but pycolmap.

use crate::support::scenes::{city, eval, stderr, text, train};
use gsscale::dataset::read::{ReadOptions, read_scene};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// The Python that can import `module`; `None` after a printed skip.
fn python_with(module: &str) -> Option<String> {
    let python = std::env::var("GSSCALE_PYTHON").unwrap_or_else(|_| "python3".to_string());
    let imported = Command::new(&python).args(["-c", &format!("import {module}")]).output();
    if imported.is_ok_and(|output| output.status.success()) {
        return Some(python);
    }
    println!("SKIPPED: {python} cannot import {module} (GSSCALE_PYTHON names another interpreter)");
    None
}

/// Runs a script and parses the JSON that it prints last.
fn run_script(python: &str, script: &str, args: &[&Path]) -> Value {
    let output = Command::new(python).args(["-c", script]).args(args).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let out = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(out.lines().last().unwrap()).unwrap()
}

fn small_run(folder: &Path, more: &[&str]) -> (PathBuf, PathBuf) {
    let scene = city(folder, 12, 96, 64, 400);
    let out = folder.join("run");
    let keys = ["--steps", "30", "--log-every", "5", "--eval-every", "10", "--quiet", "--device", "cpu"];
    let output = train(&[&[text(&scene), "--out", text(&out)], &keys[..], more].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    (scene, out)
}

/// The held-out PSNR of a PLY.
fn psnr_of(ply: &Path, scene: &Path) -> f64 {
    let output = eval(&[text(ply), text(scene), "--device", "cpu"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    report["test"]["psnr"].as_f64().unwrap()
}

#[test]
fn plyfile_reads_results_and_writes_what_is_evaluated_alike() {
    let Some(python) = python_with("plyfile") else { return };
    let folder = TempDir::new().unwrap();
    let (scene, out) = small_run(folder.path(), &["--up", "keep"]);
    let script = "
import sys, json, numpy, plyfile
ply = plyfile.PlyData.read(sys.argv[1])
rows = ply['vertex'].data
for order, name in [('>', 'big.ply'), ('=', 'ascii.ply')]:
    copy = plyfile.PlyData([plyfile.PlyElement.describe(rows, 'vertex')], text=name == 'ascii.ply', byte_order=order,
                           comments=ply.comments)
    copy.write(sys.argv[2] + '/' + name)
print(json.dumps({'rows': len(rows), 'names': list(rows.dtype.names), 'comments': ply.comments,
                  'finite': bool(all(numpy.isfinite(rows[n]).all() for n in rows.dtype.names))}))";
    let ply = out.join("point_cloud.ply");
    let read = run_script(&python, script, &[&ply, folder.path()]);
    assert!(read["rows"].as_u64() > Some(300) && read["finite"] == true, "{read}");
    let names: Vec<&str> = read["names"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    for name in ["x", "opacity", "f_dc_0", "scale_2", "rot_3"] {
        assert!(names.contains(&name), "{names:?}");
    }
    // The comments are the file's own, not those of an element.
    assert!(read["comments"].as_array().is_some_and(|comments| !comments.is_empty()), "{read}");
    let ours = psnr_of(&ply, &scene);
    // Text holds f32 in as many digits as numpy prints, which is enough to read them back.
    for name in ["big.ply", "ascii.ply"] {
        let theirs = psnr_of(&folder.path().join(name), &scene);
        assert!((theirs - ours).abs() < 1e-4, "{name}: {theirs} dB, {ours} dB in our file");
    }
}

#[test]
fn pycolmap_reads_and_writes_the_models_that_we_write_and_read() {
    let Some(python) = python_with("pycolmap") else { return };
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 6, 96, 64, 300);
    let before = read_scene(&scene, &ReadOptions::default()).unwrap();
    let script = "
import sys, json, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
model.write_text(sys.argv[2])
print(json.dumps({'images': sorted(image.name for image in model.images.values()), 'points': len(model.points3D),
                  'cameras': [str(camera.model_name) for camera in model.cameras.values()]}))";
    let (theirs, model) = (folder.path().join("theirs"), scene.join("sparse/0"));
    std::fs::create_dir_all(theirs.join("sparse/0")).unwrap();
    std::fs::create_dir(theirs.join("images")).unwrap();
    let read = run_script(&python, script, &[&model, &theirs.join("sparse/0")]);
    let names: Vec<&str> = before.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(read["images"], serde_json::json!(names));
    assert_eq!(read["points"].as_u64(), Some(before.points.positions.len() as u64));
    let after = read_scene(&theirs, &ReadOptions::default()).unwrap();
    assert_eq!(after.points.positions.len(), before.points.positions.len());
    for (a, b) in before.views.iter().zip(&after.views) {
        assert_eq!((&a.name, a.intrinsics), (&b.name, b.intrinsics));
        // Text with 17 digits, and quaternions that pycolmap normalises.
        assert!((a.pose.translation - b.pose.translation).length() < 1e-12);
        assert!((a.pose.rotation - b.pose.rotation).to_cols_array().iter().all(|x| x.abs() < 1e-12));
    }
}

#[test]
fn tensorboard_reads_curves_and_pictures() {
    let Some(python) = python_with("tensorboard") else { return };
    let folder = TempDir::new().unwrap();
    let (_, out) = small_run(folder.path(), &["--log", "tensorboard"]);
    let script = "
import sys, json
from tensorboard.backend.event_processing import event_accumulator
events = event_accumulator.EventAccumulator(sys.argv[1], size_guidance={'images': 0, 'scalars': 0})
events.Reload()
tags = events.Tags()
curve = lambda tag: [[event.step, event.value] for event in events.Scalars(tag)]
picture = events.Images(tags['images'][0])[0] if tags['images'] else None
print(json.dumps({'train': curve('psnr/train'), 'test': curve('psnr/test'), 'images': tags['images'],
                  'picture': picture and [picture.step, picture.width, picture.height,
                                          picture.encoded_image_string[:4].decode('latin1')]}))";
    let read = run_script(&python, script, &[&out.join("tensorboard")]);
    let steps = |tag: &str| -> Vec<u64> {
        read[tag].as_array().unwrap().iter().map(|point| point[0].as_u64().unwrap()).collect()
    };
    assert_eq!(steps("train"), [5, 10, 15, 20, 25, 30]);
    assert_eq!(steps("test"), [10, 20, 30], "the evaluation after the last step belongs to the curve");
    // Two of twelve photos are held out: render beside photo.
    assert_eq!(read["images"].as_array().unwrap().len(), 2, "{read}");
    assert_eq!(read["picture"], serde_json::json!([30, 192, 64, "\u{89}PNG"]));
}

/// The program; `None` after a printed skip.
fn splat_transform() -> Option<PathBuf> {
    let folder = std::env::var_os("GSSCALE_NODE_BIN").map(PathBuf::from);
    let program = folder.map_or("splat-transform".into(), |folder| folder.join("splat-transform"));
    if Command::new(&program).arg("--version").output().is_ok_and(|output| output.status.success()) {
        return Some(program);
    }
    println!("SKIPPED: {} does not run (GSSCALE_NODE_BIN names its folder)", program.display());
    None
}

/// Rows of a PLY.
fn rows_of(ply: &Path) -> u64 {
    let bytes = std::fs::read(ply).unwrap();
    let header = String::from_utf8_lossy(&bytes[..bytes.len().min(4096)]).into_owned();
    header.lines().find_map(|line| line.strip_prefix("element vertex ")).unwrap().trim().parse().unwrap()
}

#[test]
fn splat_transform_reads_results() {
    let Some(program) = splat_transform() else { return };
    let folder = TempDir::new().unwrap();
    let (scene, out) = small_run(folder.path(), &["--up", "keep", "--export", "spz"]);
    let (ply, copy) = (out.join("point_cloud.ply"), folder.path().join("copy.ply"));
    let output = Command::new(&program).args(["-w", text(&ply), text(&copy)]).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(rows_of(&copy), rows_of(&ply));
    // It keeps f32 as they are, but forgets our comments: the city lies at its origin.
    assert!((psnr_of(&copy, &scene) - psnr_of(&ply, &scene)).abs() < 0.01);
    // SPZ rounds colours to 1/255 and scales to 6 %: half a decibel on a picture of some 20 dB.
    let from_spz = folder.path().join("from_spz.ply");
    // It takes the axes of an SPZ for those of a PLY. Ours are those of the specification: right, up, back.
    let spz = out.join("point_cloud.spz");
    let output = Command::new(&program).args(["-w", text(&spz), "-r", "180,0,0", text(&from_spz)]).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(rows_of(&from_spz), rows_of(&ply));
    assert!((psnr_of(&from_spz, &scene) - psnr_of(&ply, &scene)).abs() < 0.5);
}

#[test]
fn splat_transform_reads_streamed_sogs() {
    let Some(program) = splat_transform() else { return };
    let folder = TempDir::new().unwrap();
    let (scene, out) = small_run(folder.path(), &["--up", "keep", "--export", "sog"]);
    let sog = out.join("point_cloud_sog");
    let tree: Value = serde_json::from_slice(&std::fs::read(sog.join("lod-meta.json")).unwrap()).unwrap();
    let names: Vec<&str> = tree["filenames"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    let environment = tree["environment"].as_str();
    let convert = |level: usize| {
        let copy = folder.path().join(format!("{level}.ply"));
        let of_level = names.iter().filter(|name| name.starts_with(&format!("{level}_")));
        let files: Vec<PathBuf> = of_level.chain(&environment).map(|name| sog.join(name)).collect();
        let mut command = Command::new(&program);
        let output = command.arg("-w").args(&files).arg(&copy).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        (rows_of(&copy), psnr_of(&copy, &scene))
    };
    let giants = environment.map_or(0, |name| {
        let meta: Value = serde_json::from_slice(&std::fs::read(sog.join(name)).unwrap()).unwrap();
        meta["count"].as_u64().unwrap()
    });
    // Of a whole folder it takes the finest level.
    let copy = folder.path().join("whole.ply");
    let output = Command::new(&program).args(["-w", text(&sog.join("lod-meta.json")), text(&copy)]).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(Some(rows_of(&copy)), tree["counts"][0].as_u64());
    let whole = psnr_of(&out.join("point_cloud.ply"), &scene);
    let levels: Vec<(u64, f64)> = (0..4).map(convert).collect();
    for (level, (rows, _)) in levels.iter().enumerate() {
        assert_eq!(Some(rows - giants), tree["counts"][level].as_u64());
    }
    // Scales of 256 values, colours of 256, harmonics of a few centres: half a decibel on a picture of some 20 dB.
    assert!((levels[0].1 - whole).abs() < 0.5, "{levels:?} of {whole}");
    assert!(levels.is_sorted_by(|a, b| a.1 > b.1) && levels[1].1 > whole - 4.0, "{levels:?} of {whole}");
}
