//! Whole runs through the real binaries: the same bits for any number of threads, the same quality far from the origin,
//! the same metrics from the PLY alone, and an early stop that loses nothing.

use crate::support::scenes::{TextModel, city, eval, psnr, stderr, summary, text, told, train};
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::densify::strategy::StrategyName;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::events::EventKind;
use gsscale::train::start::first_scene::{Prepared, prepare};
use gsscale::train::state::trainer::Trainer;
use std::path::Path;
use tempfile::TempDir;

/// Densification rounds, resets and SH raises all happen within 300 steps.
const BUSY: &[&str] =
    &["--steps", "300", "--refine-start", "100", "--refine-every", "50", "--reset-every", "200", "--sh-every", "100"];

fn run(scene: &Path, out: &Path, more: &[&str]) {
    let mut args = vec![text(scene), "--out", text(out), "--quiet"];
    args.extend(more);
    let output = train(&args);
    assert!(output.status.success(), "{}", stderr(&output));
}

#[test]
fn one_and_two_threads_give_the_same_bytes() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 160, 112, 1500);
    let files: Vec<Vec<u8>> = ["1", "2", "2"]
        .iter()
        .enumerate()
        .map(|(i, threads)| {
            let out = folder.path().join(format!("run{i}"));
            run(&scene, &out, &[BUSY, &["--threads", threads]].concat());
            std::fs::read(out.join("point_cloud.ply")).unwrap()
        })
        .collect();
    assert!(files[0] == files[1], "one thread and two threads differ");
    assert!(files[1] == files[2], "two runs of the same command differ");
    let gaussians = summary(&folder.path().join("run0"))["gaussians"].as_u64().unwrap();
    assert_ne!(gaussians, 1500, "no densification round changed anything, so the test shows little");
}

/// With few photos the schedule ends before the run, and a resumed run keeps it.
#[test]
fn the_schedule_of_few_photos_ends_before_the_run() {
    let folder = TempDir::new().unwrap();
    let (scene, out) = (city(folder.path(), 4, 48, 32, 200), folder.path().join("run"));
    let flags = ["--out", text(&out), "--device", "cpu", "--test-every", "0", "--keep-checkpoint"];
    let flags = [&flags[..], &["--schedule", "run-length", "--strategy", "long-axis"]].concat();
    let said = told(&train(&[&[text(&scene), "--steps", "700"], &flags[..]].concat()));
    assert!(said.contains("4 to train on") && said.contains("until step 600"), "{said}");
    let key = |name: &str| {
        let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
        config.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(" = ").map(str::to_string)).unwrap()
    };
    // A fifth of the schedule's 600 steps is without rounds, not of the run's 700.
    let wanted =
        |steps: &str| assert_eq!([key("steps"), key("schedule-steps"), key("refine-stop")], [steps, "600", "480"]);
    wanted("700");
    let resumed = train(&["--resume", text(&out), "--steps", "750", "--quiet"]);
    assert!(resumed.status.success(), "{}", stderr(&resumed));
    wanted("750");
}

#[test]
fn every_global_change_is_an_event_in_order() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 400);
    let config = TrainConfig {
        steps: 60,
        sh_degree: 2,
        sh_every: 20,
        refine_start: 5,
        refine_every: 10,
        refine_stop: 50,
        reset_every: 30,
        strategy: StrategyName::Default,
        ..TrainConfig::default()
    };
    let Prepared { dataset, columns, sh_degree_start } = prepare(&scene, &config).unwrap();
    let options = RunOptions { sh_degree_start, ..RunOptions::new(&config, dataset.scene_scale) };
    let targets = TargetCache::new(&dataset.views, 1 << 24, 1).unwrap();
    let mut trainer = Trainer::new(columns, &dataset, Box::new(CpuRenderer::new()), options).unwrap();
    let mut degrees = Vec::new();
    for _ in 0..config.steps {
        trainer.step(&dataset, &targets).unwrap();
        degrees.push(trainer.render_options().sh_degree);
    }
    // The SH degree follows gsplat: step / 20, at most 2.
    assert!(degrees.iter().enumerate().all(|(step, &d)| usize::from(d) == (step / 20).min(2)), "{degrees:?}");
    let events: Vec<(u32, char)> = trainer.events().events().iter().map(|e| (e.step, letter(e.kind))).collect();
    let want = [(10, 'd'), (19, 's'), (20, 'd'), (30, 'd'), (30, 'r'), (39, 's'), (40, 'd')];
    assert_eq!(events, want);
}

fn letter(kind: EventKind) -> char {
    match kind {
        EventKind::Densify(_) | EventKind::LongAxis(_) | EventKind::Relocate(_) => 'd',
        EventKind::ResetOpacity { .. } => 'r',
        EventKind::RaiseShDegree { .. } => 's',
    }
}

#[test]
fn the_image_cache_changes_no_bit() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 16, 96, 64, 400);
    let mut files = Vec::new();
    for (i, cache) in ["1GiB", "1KiB"].iter().enumerate() {
        let out = folder.path().join(format!("run{i}"));
        run(&scene, &out, &["--steps", "40", "--image-cache", cache]);
        files.push(std::fs::read(out.join("point_cloud.ply")).unwrap());
    }
    assert!(files[0] == files[1]);
}

#[test]
fn utm_offsets_cost_no_quality() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 160, 112, 1500);
    let steps = ["--steps", "300", "--strategy", "none"];
    let here = folder.path().join("here");
    run(&scene, &here, &steps);
    let mut model = TextModel::of(&scene);
    model.shift([500_000.0, 4_600_000.0, 120.0]);
    model.write(&scene);
    let far = folder.path().join("far");
    run(&scene, &far, &steps);
    // The documented bound is 0.05 dB; f64 subtraction leaves differences of some 1e-9 of the scene.
    let (here_db, far_db) = (psnr(&here), psnr(&far));
    assert!((here_db - far_db).abs() < 0.05, "{here_db} dB at the origin, {far_db} dB at UTM coordinates");
    // The offset is far more than 1,000 radii of this small scene: the PLY stays in local coordinates, and evaluation
    // knows the offset.
    let output = eval(&[text(&far), text(&scene)]);
    assert!(output.status.success(), "{}", stderr(&output));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let again = report["test"]["psnr"].as_f64().unwrap();
    // Positions and scales are rounded to f32 in the PLY.
    assert!((again - far_db).abs() < 1e-2, "{again} dB from the PLY, {far_db} dB in the run");
}

#[test]
fn evaluating_the_ply_gives_the_runs_numbers() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 160, 112, 1500);
    let out = folder.path().join("run");
    run(&scene, &out, &[BUSY, &["--test-every", "6"]].concat());
    let output = eval(&[text(&out), text(&scene)]);
    assert!(output.status.success(), "{}", stderr(&output));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    for key in ["psnr", "ssim"] {
        let (run, again) = (summary(&out)["test"][key].as_f64().unwrap(), report["test"][key].as_f64().unwrap());
        // Positions and scales pass through f32 in dataset coordinates: differences of 1e-7 of the scene.
        assert!((run - again).abs() < 2e-3, "{key}: {run} in the run, {again} from the PLY");
    }
    assert_eq!(report["test"]["views"], summary(&out)["test"]["views"]);
    assert_eq!(summary(&out)["test"]["views"], 4);
}

#[test]
fn training_can_start_from_a_trained_ply() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 160, 112, 1500);
    let first = folder.path().join("first");
    run(&scene, &first, &["--steps", "400", "--strategy", "none"]);
    let second = folder.path().join("second");
    let ply = first.join("point_cloud.ply");
    run(&scene, &second, &["--steps", "10", "--strategy", "none", "--init-ply", text(&ply)]);
    // Ten steps with fresh moments cannot undo 400; a start from points would be some 10 dB lower.
    assert!(psnr(&second) > psnr(&first) - 1.5, "{} after {}", psnr(&second), psnr(&first));
}

#[test]
fn the_bands_of_a_trained_ply_stay_in_use() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 160, 112, 1500);
    let first = folder.path().join("first");
    run(&scene, &first, &["--steps", "400", "--strategy", "none", "--sh-every", "50"]);
    let second = folder.path().join("second");
    let ply = first.join("point_cloud.ply");
    run(&scene, &second, &["--steps", "1", "--strategy", "none", "--init-ply", text(&ply)]);
    // One step of Adam without history moves every value by its learning rate; without the bands the loss would be
    // several decibels.
    assert!(psnr(&second) > psnr(&first) - 0.7, "{} after {}", psnr(&second), psnr(&first));
    let output = eval(&[text(&second), text(&scene)]);
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let again = report["test"]["psnr"].as_f64().unwrap();
    // Rounding in the PLY.
    assert!((again - psnr(&second)).abs() < 2e-3, "{again} from the PLY, {} in the run", psnr(&second));
}

#[test]
fn transforms_json_trains_like_the_colmap_model() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 16, 96, 64, 400);
    let steps = ["--steps", "60", "--strategy", "none"];
    let colmap = folder.path().join("colmap");
    run(&scene, &colmap, &steps);
    TextModel::of(&scene).write_transforms(&scene);
    std::fs::remove_dir_all(scene.join("sparse")).unwrap();
    let json = folder.path().join("json");
    run(&scene, &json, &steps);
    assert_eq!(summary(&json)["gaussians"], summary(&colmap)["gaussians"]);
    assert_eq!(summary(&json)["test"]["views"], 2);
    // The same scene to the rounding of f64 poses, which f32 training may amplify.
    assert!((psnr(&json) - psnr(&colmap)).abs() < 0.05, "{} and {}", psnr(&json), psnr(&colmap));
    let output = eval(&[text(&json), text(&scene.join("transforms.json"))]);
    assert!(output.status.success(), "{}", stderr(&output));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    // Rounding on the way through the PLY.
    assert!((report["test"]["psnr"].as_f64().unwrap() - psnr(&json)).abs() < 2e-3);
}

#[test]
fn an_interrupt_finishes_the_step_and_writes_the_scene() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 16, 96, 64, 400);
    let out = folder.path().join("run");
    let child = std::process::Command::new(env!("CARGO_BIN_EXE_gsscale-train"))
        .args([text(&scene), "--out", text(&out), "--log-every", "1", "--steps", "1000000"])
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let metrics = out.join("metrics.jsonl");
    let started = std::time::Instant::now();
    while std::fs::metadata(&metrics).map_or(0, |m| m.len()) == 0 {
        assert!(started.elapsed().as_secs() < 60, "no step within a minute");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130));
    assert!(out.join("point_cloud.ply").is_file());
    let summary = summary(&out);
    assert_eq!(summary["finished"], false);
    assert!(summary["steps"].as_u64().unwrap() > 0);
    // There are held-out photos, but none was evaluated: neither stderr nor the report claims otherwise.
    assert!(stderr(&output).contains("quality     not evaluated"), "{}", stderr(&output));
    let report = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(!report.contains("held-out"));
    assert!(report.contains("of 1,000,000 steps. To go on: gsscale-train --resume"));
}
