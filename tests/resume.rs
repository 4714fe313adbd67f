//! A run that is killed or stopped and goes on ends with the bytes of one that was left alone. Through the real binary.
//!
//! `GSSCALE_KILLS=1000` kills as many times as that (5 without it).
#![cfg(unix)]
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "support/scenes.rs"]
mod scenes;

use gsscale::base::rng::{Purpose, Stream};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use scenes::{TextModel, stderr, summary, text, train};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Rounds, resets and raises of the SH degree, each several times.
const BUSY: &[&str] = &[
    "--steps",
    "200",
    "--page-rows",
    "32",
    "--grow-grad2d",
    "0.001",
    "--refine-start",
    "60",
    "--refine-every",
    "30",
    "--reset-every",
    "80",
    "--sh-every",
    "50",
    "--view-order",
    "groups:4",
    "--log-every",
    "7",
    "--test-every",
    "24",
    "--device",
    "cpu",
    "--quiet",
];

struct Bench {
    folder: TempDir,
    scene: PathBuf,
}

impl Bench {
    fn new() -> Bench {
        let folder = TempDir::new().unwrap();
        let scene = folder.path().join("scene");
        let (views, width, height, points) = (24, 64, 48, 6000);
        let blocks = Some(20);
        let city =
            CityOptions { seed: 5, views, width, height, points, blocks, supersample: 1, ..CityOptions::default() };
        write_city(&scene, &city, &|_, _| {}).unwrap();
        Bench { folder, scene }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The run that is left alone: its PLY, its metrics and the most pages of a step.
    fn alone(&self) -> (Vec<u8>, Vec<u64>, u64) {
        let out = self.path("alone");
        let output = train(&[&[text(&self.scene), "--out", text(&out)], BUSY].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        let done = summary(&out);
        assert_ne!(done["gaussians"], 6000, "no round changed anything, so the test shows little");
        (ply(&out), logged(&out), done["pages_pinned_max"].as_u64().unwrap())
    }

    fn begin(&self, frames: u64, more: &[&str]) -> Child {
        let (out, spill, frames) = (self.path("out"), self.path("spill"), frames.to_string());
        let args = [&[text(&self.scene), "--out", text(&out), "--spill-dir", text(&spill), "--frames", &frames], BUSY];
        spawn(&[&args.concat(), more].concat())
    }

    fn go_on(&self, more: &[&str]) -> Child {
        spawn(&[&["--resume", text(&self.path("out")), "--quiet"], more].concat())
    }

    /// Waits until the run has logged something after its first `lines` lines, or ended.
    fn wait_for_lines(&self, child: &mut Child, lines: usize) {
        let started = Instant::now();
        let file = self.path("out/metrics.jsonl");
        let count = || std::fs::read_to_string(&file).map_or(0, |text| text.lines().count());
        while count() <= lines && child.try_wait().unwrap().is_none() {
            assert!(started.elapsed() < Duration::from_secs(120), "the run does not get on");
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

fn spawn(args: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
    command.args(args).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

fn ply(out: &Path) -> Vec<u8> {
    std::fs::read(out.join("point_cloud.ply")).unwrap()
}

/// Steps in metrics.jsonl.
fn logged(out: &Path) -> Vec<u64> {
    let text = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    let step = |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()["step"].as_u64().unwrap();
    text.lines().map(step).collect()
}

fn signal(child: &Child, name: &str) {
    let done = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
    assert!(done.success());
}

fn ended(child: Child) -> Output {
    child.wait_with_output().unwrap()
}

#[test]
fn a_run_that_is_killed_at_any_time_ends_with_the_same_bytes() {
    let kills: u32 = std::env::var("GSSCALE_KILLS").ok().map_or(5, |n| n.parse().unwrap());
    let bench = Bench::new();
    let (want, steps, fewest) = bench.alone();
    let mut draws = Stream::new(7, Purpose::Test, 0, 0);
    let (out, often) = (bench.path("out"), ["--commit-every", "0.02"]);
    let mut killed = 0;
    while killed < kills {
        let mut child = bench.begin(fewest, &often);
        bench.wait_for_lines(&mut child, 4);
        let mut lives = 1;
        loop {
            if killed < kills {
                std::thread::sleep(Duration::from_millis(draws.below(600)));
                let _ = child.kill();
            }
            let output = ended(child);
            if output.status.signal() != Some(9) {
                assert!(output.status.success(), "life {lives}: {}", stderr(&output));
                break;
            }
            (killed, lives) = (killed + 1, lives + 1);
            // Whatever changes no number changes from life to life.
            let frames = [fewest, fewest + 40, 4000][killed as usize % 3].to_string();
            let threads = ["1", "2"][killed as usize % 2];
            let codec = ["raw", "zstd:1"][killed as usize / 2 % 2];
            let more = ["--frames", &frames, "--threads", threads, "--spill-codec", codec];
            child = bench.go_on(&[&more[..], &often[..]].concat());
        }
        assert!(ply(&out) == want, "after {lives} lives the scene is another");
        assert_eq!(logged(&out), steps, "after {lives} lives");
        assert!(!bench.path("spill/FORMAT").exists(), "a run that is done leaves no checkpoint");
        assert_eq!(summary(&out)["finished"], true);
        std::fs::remove_dir_all(&out).unwrap();
    }
}

/// A kill while the spill directory of a finished run is being removed leaves a map whose segments are gone.
#[test]
fn a_run_that_was_done_is_not_trained_again() {
    let bench = Bench::new();
    let (want, _, fewest) = bench.alone();
    let (out, spill, kept) = (bench.path("out"), bench.path("spill"), bench.path("kept"));
    let seldom = ["--commit-every", "0"];
    let mut child = bench.begin(fewest, &seldom);
    bench.wait_for_lines(&mut child, 4);
    signal(&child, "INT");
    assert_eq!(ended(child).status.code(), Some(130));
    std::fs::create_dir(&kept).unwrap();
    for entry in std::fs::read_dir(&spill).unwrap().map(Result::unwrap) {
        std::fs::copy(entry.path(), kept.join(entry.file_name())).unwrap();
    }
    assert!(ended(bench.go_on(&[])).status.success());
    assert!(ply(&out) == want && !spill.join("FORMAT").exists());
    // Empty, or this fails.
    std::fs::remove_dir(&spill).unwrap();
    std::fs::rename(&kept, &spill).unwrap();
    let segments = |folder: &Path| {
        let names = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
        names.filter(|p| p.extension().is_some_and(|e| e == "dat")).collect::<Vec<_>>()
    };
    segments(&spill).iter().for_each(|segment| std::fs::remove_file(segment).unwrap());
    let output = ended(bench.go_on(&[]));
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(ply(&out) == want && !spill.join("FORMAT").exists(), "the results stay, what was left over goes");
}

#[test]
fn a_run_that_is_asked_to_stop_says_how_to_go_on_and_does() {
    let bench = Bench::new();
    let (want, steps, fewest) = bench.alone();
    let out = bench.path("out");
    // No commit but those at the stops.
    let seldom = ["--commit-every", "0"];
    let mut child = bench.begin(fewest, &seldom);
    for (lines, (name, code)) in [(3, ("INT", 130)), (12, ("TERM", 143))] {
        bench.wait_for_lines(&mut child, lines);
        signal(&child, name);
        let output = ended(child);
        assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
        assert!(stderr(&output).contains(&format!("gsscale-train --resume {}", out.display())), "{}", stderr(&output));
        assert!(bench.path("spill/map.redb").exists() && out.join("point_cloud.ply").exists());
        assert_eq!(summary(&out)["finished"], false);
        child = bench.go_on(&seldom);
    }
    let output = ended(child);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(ply(&out) == want, "the scene is another");
    assert_eq!(logged(&out), steps);
}

#[test]
fn what_cannot_go_on_is_refused_and_left_as_it_was() {
    let bench = Bench::new();
    let (want, _, fewest) = bench.alone();
    let out = bench.path("out");
    let said = |more: &[&str]| {
        let output = ended(bench.go_on(more));
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        assert!(stderr(&output).contains("remedy"), "{}", stderr(&output));
        stderr(&output)
    };
    assert!(said(&[]).contains("config.toml"));
    let mut child = bench.begin(fewest, &[]);
    bench.wait_for_lines(&mut child, 2);
    // In use: a second process is kept out.
    let words = said(&[]);
    assert!(words.contains("use"), "{words}");
    signal(&child, "INT");
    assert_eq!(ended(child).status.code(), Some(130));
    let words = said(&["--means-lr", "0.001", "--steps", "300"]);
    assert!(words.contains("means-lr was") && words.contains("steps was 200 and is 300"), "{words}");
    // The same command again: it says that there is a run and how to go on.
    let again = ended(bench.begin(fewest, &[]));
    assert_eq!(again.status.code(), Some(1));
    assert!(stderr(&again).contains("--resume"), "{}", stderr(&again));
    // Over the output, but not over the checkpoint.
    let again = ended(bench.begin(fewest, &["--overwrite"]));
    assert_eq!(again.status.code(), Some(1));
    assert!(stderr(&again).contains("checkpoint of another run"), "{}", stderr(&again));
    // Another dataset.
    let model = std::fs::read_dir(bench.scene.join("sparse/0")).unwrap().flatten();
    let files: Vec<(PathBuf, Vec<u8>)> = model.map(|e| (e.path(), std::fs::read(e.path()).unwrap())).collect();
    let mut moved = TextModel::of(&bench.scene);
    moved.views[3].tvec[0] += 0.01;
    moved.write(&bench.scene);
    assert!(said(&[]).contains("the dataset changed"), "{}", said(&[]));
    std::fs::remove_dir_all(bench.scene.join("sparse/0")).unwrap();
    std::fs::create_dir(bench.scene.join("sparse/0")).unwrap();
    files.iter().for_each(|(path, bytes)| std::fs::write(path, bytes).unwrap());
    // After all of that it still goes on.
    let output = ended(bench.go_on(&[]));
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(ply(&out) == want, "the scene is another");
    // Done is done; more steps would need the pages, which are gone.
    assert!(ended(bench.go_on(&[])).status.success());
    let words = said(&["--steps", "300"]);
    assert!(words.contains("no spill directory"), "{words}");
}

#[test]
fn a_run_that_was_cut_off_before_its_first_commit_says_so() {
    let bench = Bench::new();
    let mut child = bench.begin(4000, &["--commit-every", "0"]);
    bench.wait_for_lines(&mut child, 0);
    child.kill().unwrap();
    ended(child);
    let output = ended(bench.go_on(&[]));
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("before its first commit"), "{}", stderr(&output));
}
