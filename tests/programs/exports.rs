//! Scenes as other programs export them are the same scene as a COLMAP model; what a folder of photos alone is told; and a run whose own
//! export fails.

use crate::support::scenes::{TextModel, stderr};
use crate::support::workdir::{EVAL, TRAIN, Workdir, says};
use glam::DVec3;
use gsscale::dataset::model::RawView;
use gsscale::dataset::read::{ReadOptions, read_scene};
use std::fs;

#[test]
fn exports_of_other_programs_are_the_scene_of_the_model_and_train() {
    let work = Workdir::city(12, 96, 64, 500);
    let scene = work.scene();
    let mut model = TextModel::of(&scene);
    // Off centre, so that a principal point in other units or from another corner shows.
    (model.pinhole[2], model.pinhole[3]) = (50.0, 30.5);
    model.pinhole[1] = model.pinhole[0];
    model.write(&scene);
    let of_colmap = read_scene(&scene, &ReadOptions::default()).unwrap();
    fs::remove_dir_all(scene.join("sparse")).unwrap();
    for (name, file) in [
        ("transforms", "transforms.json"),
        ("opensfm", "reconstruction.json"),
        ("odm", "opensfm/reconstruction.json"),
        ("reality-capture", "cameras.csv"),
    ] {
        match name {
            "transforms" => model.write_transforms(&scene),
            "reality-capture" => model.write_reality_capture(&scene.join(file)),
            _ => model.write_reconstruction(&scene.join(file)),
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
        // The points too, which formats keep in files of their own.
        work.run(name, "--steps 2");
        assert_eq!(work.count(name, "gaussians"), of_colmap.points.positions.len() as u64, "{name}");
        fs::remove_file(scene.join(file)).unwrap();
    }
}

#[test]
fn the_levels_of_a_sog_are_measured_and_charted() {
    let work = Workdir::city(24, 96, 72, 2000);
    work.run("out", "--steps 300 --export sog --test-every 6");
    // The folder lies in that of its run, which names the scene and its held-out photos.
    let page = "--page levels.html --device cpu";
    let report = work.json_of(EVAL, &format!("out/point_cloud_sog/lod-meta.json {page} --renders pictures"));
    let levels = report["levels"].as_array().unwrap();
    let of = |level: usize, part: &str| levels[level]["test"][part].as_f64().unwrap();
    let exact = work.psnr("out");
    // Codes of a byte cost a few tenths of a decibel, and each level more than the one before.
    assert!(levels.len() == 4 && (of(0, "psnr") - exact).abs() < 0.3, "{exact} {report}");
    for level in 1..4 {
        assert!(of(level, "psnr") < of(level - 1, "psnr") && of(level, "ssim") < of(level - 1, "ssim"), "{report}");
    }
    assert_eq!((&report["test"], &report["gaussians"]), (&levels[0]["test"], &levels[0]["gaussians"]));
    let (html, psnr) = (work.text("levels.html"), format!("{:.2}", of(3, "psnr")));
    assert!(["PSNR by level", "<svg", &psnr].iter().all(|part| html.contains(part)), "{html}");
    assert!(work.files("pictures/level_3").len() > 1);

    // A PLY in the folder of its run has the run's held-out photos as well.
    let report = work.json_of(EVAL, "out/point_cloud.ply --device cpu");
    // Values of the PLY are those of the run but for quaternions, which are normalised.
    let off = ["psnr", "ssim"]
        .map(|key| report["test"][key].as_f64().unwrap() - work.summary("out")["test"][key].as_f64().unwrap());
    assert!(off.iter().all(|off| off.abs() < 2e-3) && report["levels"].is_null(), "{report}");
    work.refuses_with(EVAL, &format!("out {page}"), &["has no levels of detail"]);
}

#[test]
fn photos_without_poses_are_told_how_to_get_them() {
    let work = Workdir::city(3, 32, 24, 100);
    work.remove("scene/sparse");
    for photos in [work.scene(), work.path("scene/images")] {
        let output = work.command(TRAIN, "--out out").arg(&photos).output().unwrap();
        let told = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{told}");
        says(&told, &["3 photos, but no camera poses", "pycolmap", "OpenDroneMap", "Metashape", "RealityScan"]);
        // The command holds the path as it was given.
        assert!(told.contains(&format!("gsscale-poses {}\n", photos.display())), "{told}");
        assert!(!work.exists("out"));
    }
}

#[test]
fn a_run_in_memory_whose_export_fails_has_its_report_and_can_be_resumed() {
    let work = Workdir::city(12, 96, 64, 500);
    // A folder stands where the file is to be written.
    fs::create_dir_all(work.path("out/point_cloud.spz")).unwrap();
    let keys = "--steps 20 --export spz --commit-every 0 --quiet --device cpu --overwrite";
    work.refuses(&format!("scene --out out {keys}"), &["point_cloud.spz", "could not be written"]);
    let done = work.summary("out");
    assert!(done["finished"] == false && done["test"]["psnr"].is_number() && done["export"].is_null(), "{done}");
    assert!(work.exists("out/report.html"));
    let before = work.ply("out");
    work.remove("out/point_cloud.spz");
    work.train("--resume out --quiet");
    assert!(work.exists("out/point_cloud.spz") && work.summary("out")["finished"] == true && work.ply("out") == before);
}

#[test]
fn clean_results_and_the_start_view_are_those_of_any_budget() {
    let work = Workdir::city(4, 96, 64, 500);
    work.run("out", "--steps 40 --export spz,sog --export-clean on");
    let left_out = work.count("out", "gaussians_left_out");
    let (kept, meta) = work.gaussians("out/point_cloud.ply");
    assert_eq!(kept.rows() as u64 + left_out, work.count("out", "gaussians"));
    for export in [&work.summary("out")["export"], &work.summary("out")["more_exports"][0]] {
        assert_eq!(export["gaussians"].as_u64(), Some(kept.rows() as u64), "{export}");
    }
    let said = stderr(&work.succeeds(EVAL, "out"));
    assert!(said.contains(&format!("the file lacks {left_out} Gaussian")), "{said}");
    work.run("whole", "--steps 40 --export-clean off");
    assert!(!stderr(&work.succeeds(EVAL, "whole")).contains("the file lacks"));
    let whole = work.gaussians("whole/point_cloud.ply").0;
    assert!(left_out > 0 && 2 * left_out < whole.rows() as u64, "{left_out} Gaussians that one of three photos sees");
    assert_eq!(whole.rows() as u64, work.count("whole", "gaussians"));
    work.run("paged", "--steps 40 --export-clean on --page-rows 64 --spill-dir pages --frames 12 --threads 1");
    work.run("rows", "--steps 40 --export-clean on --page-rows 64 --threads 2");
    for name in ["point_cloud.ply", "point_cloud.settings.json"] {
        assert!(work.bytes(&format!("paged/{name}")) == work.bytes(&format!("rows/{name}")), "{name}");
    }

    // The start view is a photo that was trained on, in the axes of the viewer: half a turn about z from those of the file.
    let start = &work.json("out/point_cloud.settings.json")["cameras"][0]["initial"];
    let to_dataset = &work.json("out/point_cloud.transform.json")["file_to_dataset"];
    let in_dataset = |name: &str| {
        let of = |i: usize| start[name][i].as_f64().unwrap();
        let file = [-of(0), -of(1), of(2), 1.0];
        DVec3::from_array([0, 1, 2].map(|i| (0..4).map(|j| to_dataset[i][j].as_f64().unwrap() * file[j]).sum::<f64>()))
    };
    let (position, target) = (in_dataset("position"), in_dataset("target"));
    let scene = read_scene(&work.scene(), &ReadOptions::default()).unwrap();
    // Rounded to f32 in the local frame, whose unit is about that of the flight.
    let off = 1e-5 * meta.scene_radius.max(1.0);
    let at = |(_, view): &(usize, &RawView)| (view.pose.centre() - position).length() < off;
    let (number, view) = scene.views.iter().enumerate().find(at).expect("a photo stands there");
    assert_ne!(number % 8, 0, "every eighth photo is held out");
    let seen = view.pose.rotation * target + view.pose.translation;
    assert!(seen.x.abs() + seen.y.abs() < 10.0 * off && seen.z > 0.0, "the target is before the photo: {seen}");
}

/// Of one training photo, no Gaussian is seen by two.
#[test]
fn a_clean_result_that_would_be_empty_is_whole() {
    let work = Workdir::city(2, 96, 64, 300);
    let output =
        work.output(TRAIN, "scene --out out --steps 20 --test-every 2 --export-clean on --export spz --device cpu");
    says(&stderr(&output), &["fewer than two photos see each of the", "all are kept"]);
    assert!(output.status.success());
    let rows = work.gaussians("out/point_cloud.ply").0.rows() as u64;
    assert_eq!((rows, work.count("out", "gaussians_left_out")), (work.count("out", "gaussians"), 0));
}

#[test]
fn exports_of_an_earlier_step_and_exports_that_come_too_late_are_told() {
    let work = Workdir::city(4, 96, 64, 300);
    work.run("out", "--steps 10 --export spz --keep-checkpoint --device cpu");
    let told = |flags: &str| {
        let output = work.output(TRAIN, flags);
        assert!(output.status.success());
        stderr(&output)
    };
    assert!(!told("--resume out").contains("no effect"));
    let late = told("--resume out --export spz,sog");
    says(&late, &["files of a finished run are not written again", "gsscale-ckpt import out/point_cloud.ply"]);
    let before = work.bytes("out/point_cloud.spz");
    says(&told("--resume out --steps 20 --export ply"), &["out/point_cloud.spz shows an earlier step"]);
    assert!(work.bytes("out/point_cloud.spz") == before);
}
