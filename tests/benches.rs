//! Every benchmark at its smallest size, so that benchmarks keep working. Two calls hash the same bits.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test
#![allow(clippy::duplicate_mod)] // each benchmark is a program of its own, with its own support

#[allow(dead_code)] // its `main`
#[path = "../benches/bounded.rs"]
mod bounded;
#[allow(dead_code)] // its `main`
#[path = "../benches/bus.rs"]
mod bus;
#[allow(dead_code)] // its `main`
#[path = "../benches/gpu.rs"]
mod gpu;
#[allow(dead_code)] // the tests of programs use all of it
#[path = "support/bench.rs"]
mod lines_of_a_bench;
#[allow(dead_code)] // the tests of programs use all of it
#[path = "support/scenes.rs"]
mod scenes;
#[allow(dead_code)] // its `main`
#[path = "../benches/step.rs"]
mod step;
#[allow(dead_code)] // its `main`
#[path = "../benches/view_memory.rs"]
mod view_memory;

use clap::Parser;
use gsscale::train::error::TrainError;
use lines_of_a_bench::number;
use scenes::{city, text};
use serde_json::Value;
use std::ffi::OsString;
use step::support::touched::touched;
use step::support::{Args, median};
use tempfile::TempDir;

type Lines = Result<Vec<Value>, TrainError>;

fn arguments(args: &[&str]) -> Vec<OsString> {
    std::iter::once("bench").chain(args.iter().copied()).map(OsString::from).collect()
}

fn collected(start: impl FnOnce(&mut dyn FnMut(&Value)) -> Result<(), TrainError>) -> Lines {
    let mut lines = Vec::new();
    start(&mut |line| lines.push(line.clone())).map(|()| lines)
}

fn bounded(args: &[&str]) -> Lines {
    collected(|print| bounded::start(&bounded::Args::parse_from(arguments(args)), print))
}

#[test]
fn buses_slow_steps_and_change_no_loss() {
    if gsscale::gpu::list_adapters().iter().all(|adapter| adapter.refusal.is_some()) {
        assert!(
            std::env::var_os("CI").is_none(),
            "there is no usable GPU adapter; mesa-vulkan-drivers has a software one"
        );
        println!("SKIPPED: there is no usable GPU adapter");
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 6, 64, 48, 600);
    let args = [text(&scene), "--steps", "10", "--warm-up", "4", "--rounds", "1", "--shares", "0.2,2"];
    let bus = |args: &[&str]| collected(|print| bus::start(&bus::Args::parse_from(arguments(args)), print));
    let lines = bus(&args).unwrap();
    let [slow, slower] = &lines[..] else { panic!("{lines:?}") };
    for line in [slow, slower] {
        assert_eq!((&line["same_losses"], number(line, "steps")), (&Value::Bool(true), 6.0), "{line}");
        assert!(number(line, "download_seconds_median") > 0.0 && number(line, "ratio_hidden_none") >= 1.0, "{line}");
        // A step cannot be faster than its uploads.
        assert!(number(line, "seconds_per_step_median") > number(line, "upload_seconds_median"), "{line}");
    }
    assert!(number(slower, "upload_seconds_median") > 5.0 * number(slow, "upload_seconds_median"), "{slow} {slower}");
    let error = bus(&[&args[..7], &["--shares", "0"]].concat()).unwrap_err().to_string();
    assert!(error.contains("--shares") && error.contains("remedy"), "{error}");
}

#[test]
fn benchmarks_of_parts_run() {
    assert!(view_memory::tiny() != 0);
    assert_eq!(gpu::tiny(), gpu::tiny());
}

#[test]
fn step_runs_with_the_same_losses_for_any_number_of_threads() {
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(step::tiny)
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn touched_rows_are_timed_beside_a_copy() {
    let [all, some] = [100, 65].map(|percent| touched(5000, percent, 3, gsscale::base::simd::SimdPath::best()));
    let line = |of: &step::support::touched::Touched| of.json("", 1e9);
    let rows = number(&line(&some), "rows");
    assert!(number(&line(&all), "rows") == 5000.0 && (3000.0..3500.0).contains(&rows), "{rows}");
    for line in [line(&all), line(&some)] {
        for key in ["gather_cpu_seconds", "optimizer_cpu_seconds", "bytes", "share_of_copy"] {
            assert!(number(&line, key) > 0.0, "{line}");
        }
    }
}

/// A control group is created if this user may create one; otherwise the line gives the reason.
#[test]
#[cfg(unix)]
fn a_city_larger_than_memory_trains_under_a_hard_limit() {
    let folder = TempDir::new().unwrap();
    let dir = folder.path().join("bounded");
    let sizes = ["--gaussians", "240000", "--city", "20000", "--views", "24", "--steps", "12", "--page-rows", "128"];
    let lines = bounded(&[&["--dir", text(&dir), "--host-mem", "128MiB"][..], &sizes].concat()).unwrap();
    let [line] = &lines[..] else { panic!("{lines:?}") };
    assert_eq!((number(line, "gaussians"), number(line, "steps")), (240_000.0, 12.0), "{line}");
    assert!(line["is_bounded"] == true && line["finished"] == true, "{line}");
    assert_ne!(line["limited_by"].is_null(), line["no_limit_because"].is_null(), "{line}");
    assert!(number(line, "state_bytes") > number(line, "limit_bytes"), "{line}");
    assert!(number(line, "host_bytes_peak") <= number(line, "limit_bytes"), "{line}");
    assert!(!dir.exists(), "all of it is removed");
}

#[test]
fn benchmarks_that_train_refuse_wrong_input() {
    let folder = TempDir::new().unwrap();
    let refused = |lines: Lines, words: &str| {
        let error = lines.unwrap_err().to_string();
        assert!(error.contains(words) && error.contains("remedy"), "{error}");
    };
    refused(bounded(&["--dir", text(folder.path())]), "already exists");
    let new = folder.path().join("new");
    refused(bounded(&["--dir", text(&new), "--gaussians", "lots"]), "--gaussians");
    refused(bounded(&["--dir", text(&new), "--gaussians", "999"]), "fewer than");
    assert!(!new.exists());
}

#[test]
fn arguments_and_medians_are_what_they_say() {
    let args = |text: &str| Args::parse(text.split_whitespace().map(String::from));
    let got = args("--bench 10 brighton --path baseline --json").unwrap();
    assert!(got.real && got.json && got.sizes == [10] && got.wants("brighton_480x269_10k") && !got.wants("terrain"));
    assert_eq!(got.simd().name(), "baseline");
    assert!(!args("").unwrap().real && args("").unwrap().wants("anything"));
    assert!(args("--quick").is_err() && args("--path sse9").is_err());
    assert_eq!(median([3.0, 1.0, 2.0].into_iter()), 2.0);
    assert_eq!(median([4.0, 1.0, 2.0, 3.0].into_iter()), 2.5);
    assert_eq!(median(std::iter::empty()), 0.0);
}
