//! kill -9 at random moments, in memory and at several numbers of frames.
//!
//! `GSSCALE_KILLS=1000` sets the number of kills (default 8).

use super::bench::{Bench, Place};
use super::events;
use crate::support::scenes::stderr;
use crate::support::workdir::copy_folder;
use gsscale::base::rng::{Purpose, Stream};
use std::os::unix::process::ExitStatusExt;
use std::time::Duration;

/// Commits as often as possible, names some commits, evaluates, and writes TensorBoard files.
const OFTEN: &str = "--commit-every 0.02 --save-every 45 --eval-every 70 --log tensorboard";
/// Maximum milliseconds from a run's first line of metrics to its kill. One in four runs is killed within this time of
/// its start.
const KILL_WITHIN: u64 = 200;

/// Each kind of run gets a share of the kills: in memory, with 100 % and 50 % of the frames, and with 100 %, 50 % and 10 % of the
/// pages of the largest view.
#[test]
fn a_run_that_is_killed_at_any_time_ends_with_the_same_bytes() {
    let kills: u32 = std::env::var("GSSCALE_KILLS").ok().map_or(8, |n| n.parse().unwrap());
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
            // Settings that change no result vary from process to process; a run in memory may lack memory for them.
            let more = |lives: u32| {
                let frames = match place {
                    Place::Memory if lives.is_multiple_of(3) => format!("--frames {fewest}"),
                    Place::Memory => String::new(),
                    Place::Spill(frames) => format!("--frames {frames}"),
                };
                let [threads, codec] = [lives % 2, lives / 2 % 2].map(|i| i as usize);
                format!("{OFTEN} --threads {} --spill-codec {} {frames}", [1, 2][threads], ["raw", "zstd:1"][codec])
            };
            let lives = live(&bench, &bench.flags(place, OFTEN), more, &mut left, &mut draws);
            assert!(bench.ply("out") == alone.ply, "{place:?}: after {lives} lives the scene is another");
            assert_eq!(bench.logged("out", "step"), alone.logged, "{place:?}: after {lives} lives");
            // The evaluation and each picture of the last step are events of their own.
            let [shown, logged] =
                [events::steps(&bench.path("out/tensorboard")), alone.logged.clone()].map(|mut steps| {
                    steps.dedup();
                    steps
                });
            assert_eq!(shown, logged, "{place:?}: after {lives} lives");
            // Counters since the start of a run continue across restarts.
            let lines = bench.metrics("out");
            for key in ["seconds", "bytes_written", "pages_needed"] {
                let values: Vec<f64> = lines.iter().map(|line| line[key].as_f64().unwrap()).collect();
                assert!(values.is_sorted() && values.last() > Some(&0.0), "{key}: {values:?}");
            }
            assert!(!bench.checkpoint(place).join("FORMAT").exists(), "a run that is done leaves no checkpoint");
            assert_eq!(bench.summary("out")["finished"], true);
            bench.clear();
        }
    }
}

/// One run from start to finish, killed while kills are left: some time after it has logged another line, or within its start.
/// Returns its number of processes.
fn live(bench: &Bench, begin: &str, more: impl Fn(u32) -> String, left: &mut u32, draws: &mut Stream) -> u32 {
    let mut run = bench.begin(begin).after_lines("out", 4);
    let mut lives = 1;
    loop {
        if *left > 0 {
            if draws.below(4) > 0 {
                run = run.after_lines("out", bench.lines("out"));
            }
            std::thread::sleep(Duration::from_millis(draws.below(KILL_WITHIN)));
            let _ = run.child.kill();
        }
        let output = run.end();
        if output.status.signal() != Some(9) {
            assert!(output.status.success(), "{begin}, life {lives}: {}", stderr(&output));
            return lives;
        }
        (*left, lives) = (left.saturating_sub(1), lives + 1);
        run = bench.resume(&more(lives));
    }
}

/// A kill during the removal of a finished run's checkpoint leaves a map without its segments.
#[test]
fn a_run_that_was_done_is_not_trained_again() {
    let bench = Bench::new();
    let alone = bench.alone("");
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        let checkpoint = bench.checkpoint(place);
        bench.stopped(place, 4, "");
        copy_folder(&checkpoint, &bench.path("kept"));
        bench.go_on("");
        assert!(bench.ply("out") == alone.ply && !checkpoint.join("FORMAT").exists());
        // Succeeds only if the folder is empty.
        let _ = std::fs::remove_dir(&checkpoint);
        std::fs::rename(bench.path("kept"), &checkpoint).unwrap();
        for segment in std::fs::read_dir(&checkpoint).unwrap().map(|e| e.unwrap().path()) {
            if segment.extension().is_some_and(|e| e == "dat") {
                std::fs::remove_file(&segment).unwrap();
            }
        }
        bench.go_on("");
        let is_gone = !checkpoint.join("FORMAT").exists();
        assert!(bench.ply("out") == alone.ply && is_gone, "the results stay, what was left goes");
        bench.clear();
    }
}
