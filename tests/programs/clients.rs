//! Other programs read what gsscale writes, and gsscale reads what they write: plyfile, pycolmap, TensorBoard's reader,
//! splat-transform. A test runs where its client is installed, and elsewhere prints why it was skipped.
//!
//! `GSSCALE_PYTHON` names a Python that has the packages (`pip install plyfile pycolmap tensorboard`), `GSSCALE_NODE_BIN`
//! a folder with `splat-transform` (`npm install @playcanvas/splat-transform@3.7.0`, then `node_modules/.bin`). `.ci/run` installs
//! them.

use crate::support::workdir::{Workdir, succeeded};
use gsscale::dataset::read::{ReadOptions, read_scene};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The Python that can import `module`; `None` after a printed skip.
pub(super) fn python_with(module: &str) -> Option<String> {
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
    let output = succeeded(Command::new(python).args(["-c", script]).args(args).output().unwrap());
    let out = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(out.lines().last().unwrap()).unwrap()
}

/// A city and a run on it, in `run`.
fn small_run(more: &str) -> Workdir {
    let work = Workdir::city(12, 96, 64, 400);
    work.run("run", &format!("--steps 30 --log-every 5 --eval-every 10 {more}"));
    work
}

/// The held-out PSNR of a PLY.
fn psnr_of(work: &Workdir, ply: &str) -> f64 {
    work.eval_psnr(&format!("{ply} scene --device cpu"))
}

#[test]
fn plyfile_reads_results_and_writes_what_is_evaluated_alike() {
    let Some(python) = python_with("plyfile") else { return };
    let work = small_run("--up keep");
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
    let ply = "run/point_cloud.ply";
    let read = run_script(&python, script, &[&work.path(ply), &work.path("")]);
    assert!(read["rows"].as_u64() > Some(300) && read["finite"] == true, "{read}");
    let names: Vec<&str> = read["names"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    for name in ["x", "opacity", "f_dc_0", "scale_2", "rot_3"] {
        assert!(names.contains(&name), "{names:?}");
    }
    // The comments are the file's own, not those of an element.
    assert!(read["comments"].as_array().is_some_and(|comments| !comments.is_empty()), "{read}");
    let ours = psnr_of(&work, ply);
    // Text holds f32 in as many digits as numpy prints, which is enough to read them back.
    for name in ["big.ply", "ascii.ply"] {
        let theirs = psnr_of(&work, name);
        assert!((theirs - ours).abs() < 1e-4, "{name}: {theirs} dB, {ours} dB in our file");
    }
}

#[test]
fn pycolmap_reads_and_writes_the_models_that_we_write_and_read() {
    let Some(python) = python_with("pycolmap") else { return };
    let work = Workdir::city(6, 96, 64, 300);
    let scene = work.scene();
    let before = read_scene(&scene, &ReadOptions::default()).unwrap();
    let script = "
import sys, json, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
model.write_text(sys.argv[2])
print(json.dumps({'images': sorted(image.name for image in model.images.values()), 'points': len(model.points3D),
                  'cameras': [str(camera.model_name) for camera in model.cameras.values()]}))";
    let (theirs, model) = (work.path("theirs"), scene.join("sparse/0"));
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
    let work = small_run("--log tensorboard");
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
    let read = run_script(&python, script, &[&work.path("run/tensorboard")]);
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

fn convert(work: &Workdir, program: &Path, flags: &str) {
    succeeded(Command::new(program).arg("-w").args(flags.split(' ')).current_dir(work.path("")).output().unwrap());
}

fn rows_of(work: &Workdir, ply: &str) -> u64 {
    work.gaussians(ply).0.rows() as u64
}

#[test]
fn splat_transform_reads_results() {
    let Some(program) = splat_transform() else { return };
    let work = small_run("--up keep --export spz");
    let ply = "run/point_cloud.ply";
    convert(&work, &program, &format!("{ply} copy.ply"));
    // It takes the axes of an SPZ for those of a PLY. Ours are those of the specification: right, up, back.
    convert(&work, &program, "run/point_cloud.spz -r 180,0,0 from_spz.ply");
    // It refuses settings of viewers that are not theirs. Without harmonics a page takes a second.
    let page = "-H 0 run/page.html --viewer-settings run/point_cloud.settings.json -i 1 -g cpu";
    convert(&work, &program, &format!("{ply} {page}"));
    let start = &work.json("run/point_cloud.settings.json")["cameras"][0]["initial"];
    assert!(work.text("run/page.html").contains(&start["fov"].to_string()), "{start}");
    // It keeps f32 as they are, but forgets our comments: the city lies at its origin. SPZ rounds colours to 1/255 and scales to 6 %:
    // half a decibel on a picture of some 20 dB.
    for (file, off) in [("copy.ply", 0.01), ("from_spz.ply", 0.5)] {
        assert_eq!(rows_of(&work, file), rows_of(&work, ply), "{file}");
        assert!((psnr_of(&work, file) - psnr_of(&work, ply)).abs() < off, "{file}");
    }
}

#[test]
fn splat_transform_reads_streamed_sogs() {
    let Some(program) = splat_transform() else { return };
    let work = small_run("--up keep --export sog");
    let sog = "run/point_cloud_sog";
    let tree = work.json(&format!("{sog}/lod-meta.json"));
    let names: Vec<&str> = tree["filenames"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    let environment = tree["environment"].as_str();
    let level = |level: usize| {
        let of_level = names.iter().filter(|name| name.starts_with(&format!("{level}_")));
        let files: Vec<String> = of_level.chain(&environment).map(|name| format!("{sog}/{name}")).collect();
        convert(&work, &program, &format!("{} {level}.ply", files.join(" ")));
        (rows_of(&work, &format!("{level}.ply")), psnr_of(&work, &format!("{level}.ply")))
    };
    let giants = environment.map_or(0, |name| work.json(&format!("{sog}/{name}"))["count"].as_u64().unwrap());
    // Of a whole folder it takes the finest level.
    convert(&work, &program, &format!("{sog}/lod-meta.json whole.ply"));
    assert_eq!(Some(rows_of(&work, "whole.ply")), tree["counts"][0].as_u64());
    let whole = psnr_of(&work, "run/point_cloud.ply");
    let levels: Vec<(u64, f64)> = (0..4).map(level).collect();
    for (level, (rows, _)) in levels.iter().enumerate() {
        assert_eq!(Some(rows - giants), tree["counts"][level].as_u64());
    }
    // Scales of 256 values, colours of 256, harmonics of a few centres: half a decibel on a picture of some 20 dB.
    assert!((levels[0].1 - whole).abs() < 0.5, "{levels:?} of {whole}");
    assert!(levels.is_sorted_by(|a, b| a.1 > b.1) && levels[1].1 > whole - 4.0, "{levels:?} of {whole}");
}
