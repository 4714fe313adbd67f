//! Scenes as other programs export them train to the pictures of the same scene as a COLMAP model; what a folder of photos alone is told;
//! and a run whose own export fails.

use crate::support::scenes::{TextModel, city, stderr, summary, text, train};
use gsscale::dataset::read::{ReadOptions, read_scene};
use std::fs;
use std::path::Path;
use std::process::Command;
use tempfile::TempDir;

/// Trains a few steps and returns the pixels of the held-out pictures, render beside photo.
fn trained(scene: &Path, out: &Path) -> Vec<u8> {
    let keys = ["--steps", "40", "--refine-start", "10", "--refine-every", "10", "--quiet", "--device", "cpu"];
    let output = train(&[&[text(scene), "--out", text(out)], &keys[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let mut files: Vec<_> =
        fs::read_dir(out.join("renders/test")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.retain(|file| file.extension().is_some_and(|e| e == "png"));
    files.sort();
    assert!(files.len() > 1);
    files.iter().flat_map(|file| image::open(file).unwrap().into_rgb8().into_raw()).collect()
}

#[test]
fn exports_of_other_programs_train_to_the_same_pictures() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 500);
    let mut model = TextModel::of(&scene);
    // Off centre, so that a principal point in other units or from another corner shows.
    (model.pinhole[2], model.pinhole[3]) = (50.0, 30.5);
    model.pinhole[1] = model.pinhole[0];
    model.write(&scene);
    let colmap = trained(&scene, &folder.path().join("colmap"));
    let of_colmap = read_scene(&scene, &ReadOptions::default()).unwrap();
    fs::remove_dir_all(scene.join("sparse")).unwrap();
    for (name, file) in
        [("opensfm", "reconstruction.json"), ("odm", "opensfm/reconstruction.json"), ("reality-capture", "cameras.csv")]
    {
        match file.ends_with("json") {
            true => model.write_reconstruction(&scene.join(file)),
            false => model.write_reality_capture(&scene.join(file)),
        }
        let read = read_scene(&scene, &ReadOptions::default()).unwrap();
        assert_eq!(read.views.len(), of_colmap.views.len());
        for (a, b) in of_colmap.views.iter().zip(&read.views) {
            assert!(b.name.ends_with(&a.name) && a.image_path == b.image_path, "{a:?} {b:?}");
            // Roundings of some ten operations in f64, and of angles in degrees.
            let turn = (a.pose.rotation - b.pose.rotation).to_cols_array();
            assert!(turn.iter().all(|x| x.abs() < 1e-13), "{name}: {turn:?}");
            assert!((a.pose.translation - b.pose.translation).length() < 1e-11, "{name}");
            let [i, j] = [a, b].map(|v| [v.intrinsics.fx, v.intrinsics.fy, v.intrinsics.cx, v.intrinsics.cy]);
            assert!(i.iter().zip(j).all(|(i, j)| (i - j).abs() < 1e-10), "{name}: {i:?} {j:?}");
        }
        // The cameras differ in last bits of f64, some in the last of f32, which grow with the steps: a few pixels by a level.
        let pictures = trained(&scene, &folder.path().join(name));
        assert_eq!(pictures.len(), colmap.len());
        let apart: u64 = pictures.iter().zip(&colmap).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        let mean = apart as f64 / colmap.len() as f64;
        assert!(mean < 0.2, "{name}: {mean} levels apart");
        fs::remove_file(scene.join(file)).unwrap();
    }
}

#[test]
fn the_levels_of_a_sog_are_measured_and_charted() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 96, 72, 2000);
    let out = folder.path().join("out");
    let args = "--steps 300 --export sog --test-every 6 --device cpu";
    let args: Vec<&str> = args.split(' ').collect();
    let output = train(&[&[text(&scene), "--out", text(&out)], &args[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let eval = |args: &[&str]| Command::new(env!("CARGO_BIN_EXE_gsscale-eval")).args(args).output().unwrap();
    let (sog, page) = (out.join("point_cloud_sog/lod-meta.json"), folder.path().join("levels.html"));
    let pictures = folder.path().join("pictures");
    // The folder lies in that of its run, which names the scene and its held-out photos.
    let options = ["--page", text(&page), "--renders", text(&pictures), "--device", "cpu"];
    let output = eval(&[&[text(&sog)], &options[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let levels = report["levels"].as_array().unwrap();
    let of = |level: usize, part: &str| levels[level]["test"][part].as_f64().unwrap();
    let exact = summary(&out)["test"]["psnr"].as_f64().unwrap();
    // Codes of a byte cost a few tenths of a decibel, and each level more than the one before.
    assert!(levels.len() == 4 && (of(0, "psnr") - exact).abs() < 0.3, "{exact} {report}");
    for level in 1..4 {
        assert!(of(level, "psnr") < of(level - 1, "psnr") && of(level, "ssim") < of(level - 1, "ssim"), "{report}");
    }
    assert_eq!((&report["test"], &report["gaussians"]), (&levels[0]["test"], &levels[0]["gaussians"]));
    let html = fs::read_to_string(&page).unwrap();
    let psnr = format!("{:.2}", of(3, "psnr"));
    assert!(["PSNR by level", "<svg", &psnr].iter().all(|part| html.contains(part)), "{html}");
    assert!(pictures.join("level_3").read_dir().unwrap().count() > 1);

    // A PLY in the folder of its run has the run's held-out photos as well.
    let output = eval(&[text(&out.join("point_cloud.ply")), "--device", "cpu"]);
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let off = report["test"]["psnr"].as_f64().unwrap() - exact;
    // Values of the PLY are those of the run but for quaternions, which are normalised.
    assert!(off.abs() < 0.01 && report["levels"].is_null(), "{report}");

    let refused = eval(&[text(&out), "--page", text(&page), "--device", "cpu"]);
    let said = stderr(&refused);
    assert!(!refused.status.success() && said.contains("has no levels of detail") && said.contains("remedy"), "{said}");
}

#[test]
fn photos_without_poses_are_told_how_to_get_them() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 3, 32, 24, 100);
    fs::remove_dir_all(scene.join("sparse")).unwrap();
    let out = folder.path().join("out");
    for photos in [scene.clone(), scene.join("images")] {
        let output = train(&[text(&photos), "--out", text(&out)]);
        let told = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{told}");
        for part in ["3 photos, but no camera poses", "colmap mapper", "OpenDroneMap", "Metashape", "RealityScan"] {
            assert!(told.contains(part), "{part}: {told}");
        }
        // The commands of COLMAP hold the paths as they were given.
        assert!(told.contains(&format!("--image_path {} ", scene.join("images").display())), "{told}");
        assert!(!out.exists());
    }
}

#[test]
fn a_run_in_memory_whose_export_fails_has_its_report_and_can_be_resumed() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 500);
    let out = folder.path().join("out");
    let spz = out.join("point_cloud.spz");
    // A folder stands where the file is to be written.
    fs::create_dir_all(&spz).unwrap();
    let keys = ["--steps", "20", "--export", "spz", "--commit-every", "0", "--quiet", "--device", "cpu", "--overwrite"];
    let output = train(&[&[text(&scene), "--out", text(&out)], &keys[..]].concat());
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("point_cloud.spz") && said.contains("could not be written"), "{said}");
    let done = summary(&out);
    assert!(done["finished"] == false && done["test"]["psnr"].is_number() && done["export"].is_null(), "{done}");
    assert!(out.join("report.html").is_file());
    let ply = || fs::read(out.join("point_cloud.ply")).unwrap();
    let before = ply();
    fs::remove_dir(&spz).unwrap();
    let resumed = train(&["--resume", text(&out), "--quiet"]);
    assert!(resumed.status.success() && spz.is_file(), "{}", stderr(&resumed));
    assert!(summary(&out)["finished"] == true && ply() == before);
}
