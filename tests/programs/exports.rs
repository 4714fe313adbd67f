//! Scenes as other programs export them train to the pictures of the same scene as a COLMAP model; what a folder of photos alone is told;
//! and a run whose own export fails.

use crate::support::scenes::{TextModel, city, stderr, summary, text, train};
use gsscale::dataset::read::{ReadOptions, read_scene};
use std::fs;
use std::path::Path;
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
