//! A run that decides its count goes on with its decisions, and a run with relocations with its draws.

use super::bench::{Bench, Place, SELDOM, ended, lines, ply, signal, succeeded};
use crate::support::scenes::{stderr, summary, text, train};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const DECIDES: &[&str] = &["--strategy", "long-axis", "--quality", "archive"];

#[test]
fn a_run_that_decides_its_count_resumes_with_its_checks() {
    let bench = Bench::new();
    let alone = bench.alone(DECIDES);
    let out = bench.path("out");
    // Stopped before the first check, between checks, while no check is left, and killed at some moment.
    for (place, lines, name) in [
        (Place::Memory, 9, "INT"),
        (Place::Spill(alone.fewest / 2), 13, "INT"),
        (Place::Memory, 18, "INT"),
        (Place::Spill(alone.fewest / 2), 12, "KILL"),
    ] {
        let commits: &[&str] = if name == "KILL" { &["--commit-every", "0.02"] } else { &SELDOM };
        let mut child = bench.begin(place, &[DECIDES, commits].concat());
        bench.wait_for_lines(&mut child, lines);
        signal(&mut child, name);
        ended(child);
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply, "{place:?}, {lines} lines, {name}: the resumed run gives another scene");
        let growth = summary(&out)["growth"].clone();
        let steps: Vec<u64> = growth.as_array().unwrap().iter().map(|check| check["step"].as_u64().unwrap()).collect();
        assert_eq!(steps, [91, 121]);
        std::fs::remove_dir_all(&out).unwrap();
    }
    // A cap that is given is another run.
    assert!(Bench::new().alone(&[DECIDES, &["--max-gaussians", "4000"]].concat()).ply != alone.ply);
}

/// Trials double the scene three times, and it keeps what they gave.
const GROWS: &str = "--steps 300 --quality archive --device cpu --quiet --test-every 12 --page-rows 32 --log-every 10";

/// Gaussians before the first step and at the end.
fn growth_of(out: &Path) -> [u64; 2] {
    let config: toml::Table = std::fs::read_to_string(out.join("config.toml")).unwrap().parse().unwrap();
    let first = config["resolved"]["gaussians"].as_integer().unwrap() as u64;
    [first, summary(out)["gaussians"].as_u64().unwrap()]
}

/// In memory with two threads, and through the drive with one thread, killed after the scene has grown and resumed under another budget.
#[test]
fn a_count_that_has_grown_is_the_same_through_the_drive_and_after_a_kill() {
    let folder = TempDir::new().unwrap();
    let scene = folder.path().join("scene");
    let size = CityOptions { seed: 5, views: 24, width: 96, height: 72, points: 300, ..CityOptions::default() };
    write_city(&scene, &CityOptions { supersample: 1, ..size }, &|_, _| {}).unwrap();
    let flags: Vec<&str> = GROWS.split_whitespace().collect();
    for order in ["shuffle", "groups:4"] {
        let path = |name: &str| folder.path().join(format!("{name}-{}", order.replace(':', "-")));
        let (alone, out, spill) = (path("alone"), path("out"), path("spill"));
        let begin = |out: &Path, more: &[&str]| {
            let args = [
                text(&scene),
                "--out",
                text(out),
                "--view-order",
                order,
                "--strategy",
                "long-axis",
                "--schedule",
                "run-length",
            ];
            let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
            command.args(args).args(&flags).args(more).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
        };
        succeeded(begin(&alone, &["--threads", "2"]));
        let [first, last] = growth_of(&alone);
        let checks = summary(&alone)["growth"].clone();
        assert!(
            last > 4 * first && checks.as_array().unwrap().iter().any(|check| check["is_trial"] == true),
            "{last}: {checks}"
        );
        let pages = summary(&alone)["pages_pinned_max"].as_u64().unwrap();
        let frames = [pages / 2, pages + pages / 4].map(|frames| frames.to_string());
        let to_drive = ["--spill-dir", text(&spill), "--spill-codec", "raw", "--frames", &frames[0]];
        let mut child = begin(&out, &[&to_drive[..], &["--threads", "1", "--commit-every", "0.05"]].concat());
        let began = Instant::now();
        let has_grown = || {
            let grown = |line: &serde_json::Value| {
                line["gaussians"].as_u64() > Some(2 * first) && line["commits"].as_u64() > Some(0)
            };
            out.join("metrics.jsonl").is_file() && lines(&out).last().is_some_and(grown)
        };
        while !has_grown() {
            assert!(
                child.try_wait().unwrap().is_none() && began.elapsed() < Duration::from_secs(240),
                "{order}: no growth"
            );
            std::thread::sleep(Duration::from_millis(5));
        }
        signal(&mut child, "KILL");
        ended(child);
        let output =
            train(&["--resume", text(&out), "--quiet", "--frames", &frames[1], "--threads", "2", "--host-mem", "1GiB"]);
        assert!(output.status.success(), "{}", stderr(&output));
        assert!(summary(&out)["pages_read"].as_u64() > Some(0), "no page was read from the drive");
        assert!(ply(&out) == ply(&alone), "{order}: another scene than in memory");
        assert_eq!(summary(&out)["growth"], checks, "{order}");
    }
}

const RELOCATES: &[&str] = &["--strategy", "mcmc", "--max-gaussians", "4000"];

#[test]
fn a_run_with_relocations_resumes_with_its_draws() {
    let bench = Bench::new();
    let alone = bench.alone(RELOCATES);
    let out = bench.path("out");
    for (place, lines) in [(Place::Memory, 9), (Place::Spill(alone.fewest / 2), 14)] {
        let mut child = bench.begin(place, &[RELOCATES, &SELDOM[..]].concat());
        bench.wait_for_lines(&mut child, lines);
        signal(&mut child, "INT");
        ended(child);
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply, "{place:?}, {lines} lines: the resumed run gives another scene");
        std::fs::remove_dir_all(&out).unwrap();
    }
}
