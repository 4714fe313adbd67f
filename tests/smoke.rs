//! A short run through the binary, whatever features it was built with; and what a program without a feature says of it.
//! `cargo test --no-default-features --test smoke` runs it without GPU support and without zstd.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

use gsscale::dataset::synthetic::{CityOptions, write_city};
use std::path::Path;
use std::process::{Command, Output};
use tempfile::TempDir;

fn train(folder: &Path, more: &[&str]) -> Output {
    let scene = folder.join("scene");
    if !scene.exists() {
        let options = CityOptions { seed: 5, views: 8, width: 48, height: 36, points: 300, ..CityOptions::default() };
        write_city(&scene, &options, &|_, _| {}).unwrap();
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
    command.arg(&scene).args(["--steps", "20", "--quiet", "--page-rows", "32"]).args(more);
    command.output().unwrap()
}

#[test]
fn a_run_finishes_and_missing_features_are_refused_by_name() {
    let folder = TempDir::new().unwrap();
    let (out, spill) = (folder.path().join("out"), folder.path().join("spill"));
    let to = ["--out", out.to_str().unwrap(), "--spill-dir", spill.to_str().unwrap(), "--frames", "64"];
    let said = |output: &Output| String::from_utf8_lossy(&output.stderr).into_owned();
    let done = train(folder.path(), &to);
    assert!(done.status.success(), "{}", said(&done));
    let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("summary.json")).unwrap()).unwrap();
    assert!(summary["finished"] == true && summary["test"]["psnr"].as_f64() > Some(5.0), "{summary}");
    let other = folder.path().join("other");
    let other = ["--out", other.to_str().unwrap(), "--dry-run"];
    for (flags, is_there, word) in [
        (["--device", "no such device"], cfg!(feature = "gpu"), "built without GPU support"),
        (["--spill-codec", "zstd:1"], cfg!(feature = "zstd"), "built without zstd"),
    ] {
        let refused = train(folder.path(), &[&other[..], &flags].concat());
        assert_eq!(said(&refused).contains(word), !is_there, "{}", said(&refused));
        assert!(is_there || !refused.status.success());
    }
}
