//! What a new user types first, and what the programs answer.

use crate::support::scenes::{city, stderr, summary, text};
use std::path::Path;
use std::process::{Command, Output};
use tempfile::TempDir;

/// Runs a program in `folder`, in a quiet environment as of a container.
fn run_in(folder: &Path, program: &str, args: &[&str]) -> Output {
    let output = Command::new(program).args(args).current_dir(folder).env_remove("XDG_RUNTIME_DIR").output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    output
}

const TRAIN: &str = env!("CARGO_BIN_EXE_gsscale-train");
const EVAL: &str = env!("CARGO_BIN_EXE_gsscale-eval");

#[test]
fn a_run_needs_no_folder_and_says_where_everything_is() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 16, 64, 48, 500);
    let short =
        ["--steps", "0.05k", "--eval-every", "20", "--save-every", "20", "--strategy", "none", "--device", "cpu"];
    let said = stderr(&run_in(folder.path(), TRAIN, &[&["scene"], &short[..]].concat()));
    let done: Vec<&str> = said.lines().skip_while(|line| !line.starts_with("done: 50 steps, 500 Gaussians")).collect();
    assert!(done.iter().any(|line| line.ends_with("runs/scene/point_cloud.ply")), "{said}");
    assert!(done.iter().any(|line| line.ends_with("runs/scene/report.html")), "{said}");
    assert!(done.iter().any(|line| line.ends_with("gsscale-train --resume runs/scene --steps 100")), "{said}");
    assert!(done.last().is_some_and(|line| line.contains("--keep-checkpoint")), "{said}");
    let lines: Vec<&str> = said.lines().filter(|line| line.starts_with("step ")).collect();
    assert!(lines.iter().any(|line| line.starts_with("step 20: PSNR ")), "{said}");
    assert!(lines.last().is_some_and(|line| line.starts_with("step 50/50  500 Gaussians  PSNR ")), "{said}");
    assert!(lines.iter().all(|line| line.len() <= 80), "{said}");
    let plan = said.lines().take_while(|line| !line.starts_with("step "));
    assert!(plan.filter(|line| line.chars().count() > 80).count() == 0, "{said}");
    assert!(done.iter().any(|line| line.starts_with("  quality     test PSNR ")), "{said}");
    let out = folder.path().join("runs/scene");
    assert!(out.join("point_cloud_000020.ply").is_file() && out.join("point_cloud_000040.ply").is_file());

    // The curves hold the evaluation of the result, at its step.
    let metrics = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    let metrics: Vec<serde_json::Value> = metrics.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let tested: Vec<u64> =
        metrics.iter().filter(|m| m["test"]["psnr"].is_f64()).filter_map(|m| m["step"].as_u64()).collect();
    assert_eq!(tested, [20, 40, 50]);
    assert_eq!(metrics.last().unwrap()["test"], summary(&out)["test"]);
    let cpu = |value: &serde_json::Value| value["train_cpu_seconds"].as_f64();
    // A system that does not report CPU seconds has neither.
    assert_eq!(cpu(&metrics[0]).is_some(), cpu(&summary(&out)).is_some());

    // An evaluation knows the scene of a run, by its folder or its PLY.
    for model in ["runs/scene", "runs/scene/point_cloud.ply"] {
        let report = run_in(folder.path(), EVAL, &[model, "--test-every", "8"]);
        let report: serde_json::Value = serde_json::from_slice(&report.stdout).unwrap();
        // Rounding in the PLY.
        assert!(
            (report["test"]["psnr"].as_f64().unwrap() - summary(&out)["test"]["psnr"].as_f64().unwrap()).abs() < 2e-3
        );
    }
    let bare = folder.path().join("bare.ply");
    std::fs::copy(out.join("point_cloud.ply"), &bare).unwrap();
    let refused = Command::new(EVAL).arg(&bare).output().unwrap();
    assert!(!refused.status.success() && stderr(&refused).contains("gsscale-eval FILE SCENE"), "{}", stderr(&refused));

    // The same command again takes another folder, whatever the name by which the scene is called.
    let again = stderr(&run_in(&scene, TRAIN, &[&["."], &short[..], &["--quiet"]].concat()));
    assert!(again.is_empty() && scene.join("runs/scene/point_cloud.ply").is_file(), "{again}");
    run_in(folder.path(), TRAIN, &[&[text(&scene)], &short[..], &["--quiet"]].concat());
    assert!(folder.path().join("runs/scene-2/point_cloud.ply").is_file());
}

#[test]
fn drivers_do_not_speak_for_gsscale() {
    let folder = TempDir::new().unwrap();
    let listed = run_in(folder.path(), TRAIN, &["--list-devices"]);
    assert!(!stderr(&listed).contains("XDG_RUNTIME_DIR"), "{}", stderr(&listed));
}
