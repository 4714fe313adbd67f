//! kill -9 at random moments, in memory and at several numbers of frames.
//!
//! `GSSCALE_KILLS=1000` sets the number of kills (default 20).

use super::bench::{Bench, Place, ended, lines, logged, ply, succeeded};
use super::events;
use crate::support::gpu;
use crate::support::scenes::{stderr, summary};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::gpu::GpuOptions;
use std::os::unix::process::ExitStatusExt;
use std::time::Duration;

/// Commits as often as possible, names some commits, evaluates, and writes TensorBoard files.
const OFTEN: &[&str] = &["--commit-every", "0.02", "--save-every", "45", "--eval-every", "70", "--log", "tensorboard"];
/// Maximum milliseconds from a run's first line of metrics to its kill. One in four runs is killed within this time of
/// its start.
const KILL_WITHIN: u64 = 200;

/// Each kind of run gets a share of the kills: in memory, with 100 % and 50 % of the frames, and with 100 %, 50 % and 10 % of the
/// pages of the largest view.
#[test]
fn a_run_that_is_killed_at_any_time_ends_with_the_same_bytes() {
    let kills: u32 = std::env::var("GSSCALE_KILLS").ok().map_or(20, |n| n.parse().unwrap());
    let bench = Bench::new();
    let alone = bench.alone(OFTEN);
    let (all, fewest) = (alone.pages, alone.fewest);
    // With fewer frames than the largest view has pages, kills come within and between the passes of a step.
    let frames = [all, fewest.max(all / 2), fewest, fewest / 2, (fewest / 10).max(2)];
    let places: Vec<Place> = [Place::Memory].into_iter().chain(frames.map(Place::Spill)).collect();
    let mut draws = Stream::new(7, Purpose::Test, 0, 0);
    for &place in &places {
        let mut left = kills.div_ceil(places.len() as u32);
        while left > 0 {
            let lives = live(&bench, place, fewest, &mut left, &mut draws);
            let out = bench.path("out");
            assert!(ply(&out) == alone.ply, "{place:?}: after {lives} lives the scene is another");
            assert_eq!(logged(&out), alone.logged, "{place:?}: after {lives} lives");
            // The evaluation and each picture of the last step are events of their own.
            let [shown, logged] = [events::steps(&out.join("tensorboard")), alone.logged.clone()].map(|mut steps| {
                steps.dedup();
                steps
            });
            assert_eq!(shown, logged, "{place:?}: after {lives} lives");
            counters_go_on(&bench);
            assert!(!bench.checkpoint(place).join("FORMAT").exists(), "a run that is done leaves no checkpoint");
            assert_eq!(summary(&out)["finished"], true);
            std::fs::remove_dir_all(&out).unwrap();
        }
    }
}

/// One run from start to finish, killed while kills are left. Returns its number of processes.
fn live(bench: &Bench, place: Place, fewest: u64, left: &mut u32, draws: &mut Stream) -> u32 {
    let mut child = bench.begin(place, OFTEN);
    bench.wait_for_lines(&mut child, 4);
    let mut lives = 1;
    loop {
        if *left > 0 {
            if draws.below(4) > 0 {
                let before = logged(&bench.path("out")).len();
                bench.wait_for_lines(&mut child, before);
            }
            std::thread::sleep(Duration::from_millis(draws.below(KILL_WITHIN)));
            let _ = child.kill();
        }
        let output = ended(child);
        if output.status.signal() != Some(9) {
            assert!(output.status.success(), "{place:?}, life {lives}: {}", stderr(&output));
            return lives;
        }
        (*left, lives) = (left.saturating_sub(1), lives + 1);
        // Settings that change no result vary from process to process; a run in memory may lack memory for them.
        let mut more = vec!["--threads", ["1", "2"][lives as usize % 2], "--spill-codec"];
        more.push(["raw", "zstd:1"][lives as usize / 2 % 2]);
        let frames = match place {
            Place::Memory if lives % 3 == 0 => Some(fewest),
            Place::Memory => None,
            Place::Spill(frames) => Some(frames),
        };
        let frames = frames.map(|f| f.to_string());
        more.extend(frames.iter().flat_map(|f| ["--frames", f.as_str()]));
        child = bench.go_on(&[OFTEN, &more].concat());
    }
}

/// On a GPU with half the device memory and half the frames that the largest view wants, a step is long and goes in batches,
/// so most kills hit a pass. The resumed runs keep the budgets and end with the bytes of a run that has plenty of both.
#[test]
fn a_run_on_a_gpu_that_is_killed_within_its_passes_ends_with_the_same_bytes() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let bench = Bench::on("gpu");
    let commits = ["--commit-every", "0.02"];
    let alone = bench.alone(&commits);
    let (frames, memory) = ((alone.fewest / 2).max(2), (alone.device_bytes / 2).to_string());
    let little = [&commits[..], &["--device-mem", &memory]].concat();
    let mut child = bench.begin(Place::Spill(frames), &little);
    bench.wait_for_lines(&mut child, 2);
    let mut draws = Stream::new(11, Purpose::Test, 0, 0);
    let mut kills = 0;
    loop {
        if kills < 6 {
            let before = logged(&bench.path("out")).len();
            bench.wait_for_lines(&mut child, before + 1);
            std::thread::sleep(Duration::from_millis(draws.below(KILL_WITHIN)));
            let _ = child.kill();
        }
        let output = ended(child);
        if output.status.signal() != Some(9) {
            assert!(output.status.success(), "{}", stderr(&output));
            break;
        }
        kills += 1;
        let frames = frames.to_string();
        child = bench.go_on(&[&little[..], &["--frames", &frames]].concat());
    }
    let out = bench.path("out");
    assert!(kills >= 4, "the run was over after {kills} kills");
    assert!(ply(&out) == alone.ply, "after {kills} kills the scene is another");
    assert_eq!(logged(&out), alone.logged);
    let frames = summary(&out)["frames"].as_u64().unwrap();
    assert!(frames < alone.fewest, "{frames} frames hold the largest view of {} pages whole", alone.fewest);
}

/// Counters since the start of a run continue across restarts.
fn counters_go_on(bench: &Bench) {
    let lines = lines(&bench.path("out"));
    for key in ["seconds", "bytes_written", "pages_needed"] {
        let of = |i: usize| lines[i][key].as_f64().unwrap();
        let falls = (1..lines.len()).find(|&i| of(i) < of(i - 1));
        assert_eq!(falls.map(|i| (of(i - 1), of(i))), None, "{key} falls");
        assert!(of(lines.len() - 1) > 0.0, "{key} counts nothing");
    }
}

/// A kill during the removal of a finished run's checkpoint leaves a map without its segments.
#[test]
fn a_run_that_was_done_is_not_trained_again() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        let (out, checkpoint, kept) = (bench.path("out"), bench.checkpoint(place), bench.path("kept"));
        bench.stopped(place, 4);
        super::bench::copy_folder(&checkpoint, &kept);
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply && !checkpoint.join("FORMAT").exists());
        // Succeeds only if the folder is empty.
        let _ = std::fs::remove_dir(&checkpoint);
        std::fs::rename(&kept, &checkpoint).unwrap();
        for segment in std::fs::read_dir(&checkpoint).unwrap().map(|e| e.unwrap().path()) {
            if segment.extension().is_some_and(|e| e == "dat") {
                std::fs::remove_file(&segment).unwrap();
            }
        }
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply && !checkpoint.join("FORMAT").exists(), "the results stay, what was left goes");
        std::fs::remove_dir_all(&out).unwrap();
        let _ = std::fs::remove_dir(&checkpoint);
    }
}
