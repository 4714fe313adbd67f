//! Paging changes no byte of a run: any number of frames, any I/O engine and any number of threads give the same files.
//! Through the real binary.
//!
//! `GSSCALE_PAGING_FULL=1 cargo test --test programs paging_train` runs the whole grid at 600 steps: about 15 minutes
//! on two cores, longer than nextest allows a test.

use crate::support::scenes::{self, stderr, summary, text, train};
use crate::support::shared::real_scene;
use gsscale::dataset::synthetic::{CityOptions, write_city};
use std::path::Path;
use tempfile::TempDir;

/// Flags of all runs.
const COMMON: &[&str] = &["--view-order", "groups:4", "--test-every", "24", "--quiet"];

/// Events of the runs of 600 steps.
const EVENTS: &[&str] = &["--refine-start", "100", "--refine-every", "50", "--reset-every", "200", "--sh-every", "100"];

/// Every event at least twice within 120 steps.
const MORE_EVENTS: &[&str] =
    &["--refine-start", "20", "--refine-every", "25", "--reset-every", "45", "--sh-every", "30"];

/// Every event at least twice within 80 steps.
const CLOSE_EVENTS: &[&str] =
    &["--refine-start", "15", "--refine-every", "20", "--reset-every", "30", "--sh-every", "25"];

/// Where pages are kept, and how they get there.
#[derive(Debug, Clone)]
struct How {
    /// 0: all pages in memory.
    frames: u64,
    /// Empty: a store in memory, without files.
    io: &'static str,
    threads: &'static str,
    more: &'static [&'static str],
}

/// Runs the scene; returns the PLY and the summary.
fn run(folder: &Path, scene: &Path, base: &[&str], how: &How) -> (Vec<u8>, serde_json::Value) {
    let (out, spill) = (folder.join("out"), folder.join("spill"));
    let frames = how.frames.to_string();
    let mut args = vec![text(scene), "--out", text(&out), "--overwrite", "--frames", &frames];
    args.extend(["--threads", how.threads]);
    args.extend(base);
    args.extend(how.more);
    if !how.io.is_empty() {
        args.extend(["--io", how.io, "--spill-dir", text(&spill)]);
    }
    let output = train(&args);
    assert!(output.status.success(), "{how:?}: {}", stderr(&output));
    assert!(!spill.exists(), "{how:?}: the spill directory is left over");
    (std::fs::read(out.join("point_cloud.ply")).unwrap(), summary(&out))
}

fn number(summary: &serde_json::Value, key: &str) -> u64 {
    summary[key].as_u64().unwrap()
}

/// Engines that work here: containers often forbid io_uring.
fn engines() -> Vec<&'static str> {
    let folder = TempDir::new().unwrap();
    let works = |io: &&str| gsscale::page::engine::open::open_engine(io.parse().unwrap(), folder.path(), 4).is_ok();
    ["uring", "mmap", "pread"].into_iter().filter(works).collect()
}

#[test]
fn frames_engines_and_threads_change_no_bit() {
    let Some(scene) = real_scene("seneca") else { return };
    let folder = TempDir::new().unwrap();
    let is_full = std::env::var_os("GSSCALE_PAGING_FULL").is_some();
    let steps = if is_full { "600" } else { "80" };
    let events = if is_full { EVENTS } else { CLOSE_EVENTS };
    let base = [&["--data-factor", "4", "--page-rows", "128", "--steps", steps], COMMON, events].concat();
    let in_memory = How { frames: 0, io: "", threads: "2", more: &[] };
    let (want, whole) = run(folder.path(), &scene, &base, &in_memory);
    let (pages, fewest) = (number(&whole, "frames"), number(&whole, "pages_pinned_max"));
    assert_ne!(number(&whole, "gaussians"), 59_927, "no round changed anything, so the test shows little");
    assert_eq!((number(&whole, "bytes_read"), number(&whole, "evictions")), (0, 0));
    let engines = engines();
    let how = |frames, io, threads, more| How { frames, io, threads, more };
    let mut grid = Vec::new();
    if is_full {
        for frames in [pages, pages / 2, pages / 4, fewest, fewest / 2, fewest / 10, 2] {
            for &io in engines.iter().chain(&[""]) {
                grid.extend(["1", "2"].map(|threads| how(frames, io, threads, &[] as &[&str])));
            }
        }
    } else {
        let io = |i: usize| engines[i % engines.len()];
        grid.push(how(pages, io(1), "1", &[]));
        grid.push(how(pages / 2, io(0), "2", &[]));
        // Or the fewest frames, if a view needs more than a quarter of the pages.
        grid.push(how(pages / 4, io(1), "2", &["--evict", "lru", "--prefetch-bytes", "1MiB"]));
        grid.push(how(pages / 4, "", "1", &[]));
        grid.push(how(fewest, io(0), "1", &["--spill-codec", "zstd:1"]));
        grid.push(how(fewest, io(2), "2", &[]));
        // Fewer frames than the largest view has pages: its steps go in batches.
        grid.push(how(fewest / 2, io(1), "1", &[]));
        grid.push(how(fewest / 10, io(0), "2", &["--spill-codec", "zstd:1"]));
        grid.push(how(2, "", "2", &[]));
    }
    for how in grid {
        let (got, summary) = run(folder.path(), &scene, &base, &how);
        assert!(got == want, "{how:?} gives another scene");
        assert!(number(&summary, "frames") <= how.frames, "{how:?}: {summary}");
        let spills = how.frames < pages;
        assert_eq!(number(&summary, "pages_read") > 0, spills, "{how:?}: {summary}");
        // Pages that fit in memory are written to the drive once, by the commit after the last step.
        let commits = !how.io.is_empty();
        assert_eq!(number(&summary, "bytes_written") > 0, spills || commits, "{how:?}: {summary}");
    }
}

/// Without this flag, the first reset also starts the pruning of large Gaussians.
const NO_SIZE_LIMIT: &[&str] = &["--prune-scale3d", "1000"];

/// Flags of runs on cities.
const CITY: &[&str] = &["--page-rows", "32", "--steps", "120", "--grow-grad2d", "0.001"];

#[test]
fn a_tenth_of_a_city_in_memory_gives_the_same_city() {
    let folder = TempDir::new().unwrap();
    let scene = folder.path().join("scene");
    let options = CityOptions {
        seed: 5,
        views: 96,
        width: 48,
        height: 36,
        points: 1_500,
        tiles: [8, 6],
        blocks: Some(12),
        supersample: 1,
        ..CityOptions::default()
    };
    write_city(&scene, &options, &|_, _| {}).unwrap();
    let base = [CITY, COMMON, NO_SIZE_LIMIT, MORE_EVENTS].concat();
    let in_memory = How { frames: 0, io: "", threads: "2", more: &[] };
    let (want, whole) = run(folder.path(), &scene, &base, &in_memory);
    let mut fewest_pages = u64::MAX;
    for (flag, never) in [("--refine-every", "1000"), ("--reset-every", "0"), ("--sh-every", "1000")] {
        let mut without = base.clone();
        let at = without.iter().position(|word| *word == flag).unwrap();
        without[at + 1] = never;
        let (other, summary) = run(folder.path(), &scene, &without, &in_memory);
        fewest_pages = fewest_pages.min(number(&summary, "pages"));
        assert!(other != want, "{flag} {never} changes nothing, so these events had no effect");
    }
    let frames = number(&whole, "pages") / 10;
    let (got, summary) = run(folder.path(), &scene, &base, &How { frames, io: "auto", threads: "2", more: &[] });
    assert!(got == want);
    // As a share of the pages of a city that did not grow.
    let seen = number(&summary, "pages_pinned_max") as f64 / fewest_pages as f64;
    assert!(seen < 0.03, "a view sees {seen} of the pages: {summary}");
    assert!(number(&summary, "evictions") > 0 && number(&summary, "pages_read") > 0, "{summary}");
    // Export and evaluation read every page; the steps' counters exclude these reads.
    assert!(number(&summary, "other_pages_needed") >= number(&summary, "pages"), "{summary}");
    // The bound may keep other pages after the import than the run; pages prefetched at the end of the run are in
    // neither count.
    let (bound, steps) = (number(&summary, "belady_bytes_read"), number(&summary, "bytes_read"));
    let read = steps - number(&summary, "other_bytes_read");
    assert!(bound > 0 && bound <= read && read < bound + bound / 2, "{read} read by steps, {bound} at least");
}

/// The predicted growth of pages that no view has seen since a round counts: the cap on the Gaussians holds at every
/// step, for any memory, and is reached.
#[test]
fn a_cap_on_the_gaussians_holds_at_every_step_and_pages_to_the_same_bits() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 8_000);
    let cap = 8_400;
    // Rounds follow each other closely, so that most growing pages are unseen between two rounds; nothing is pruned,
    // which would make room again, nor reset to impossible opacities.
    let rounds = ["--refine-start", "20", "--refine-every", "4", "--reset-every", "45"];
    let capped = ["--max-gaussians", "8400", "--log-every", "1", "--prune-opa", "0"];
    let base = [CITY, COMMON, NO_SIZE_LIMIT, &rounds, &capped].concat();
    let (want, whole) = run(folder.path(), &scene, &base, &How { frames: 0, io: "", threads: "2", more: &[] });
    let frames = number(&whole, "pages_pinned_max");
    assert!(frames < number(&whole, "pages") / 2, "a view sees too much");
    let (got, summary) = run(folder.path(), &scene, &base, &How { frames, io: "auto", threads: "2", more: &[] });
    assert!(got == want);
    assert_eq!(number(&summary, "gaussians"), number(&whole, "gaussians"));
    let metrics = std::fs::read_to_string(folder.path().join("out/metrics.jsonl")).unwrap();
    let rows: Vec<u64> = metrics.lines().map(|l| number(&serde_json::from_str(l).unwrap(), "gaussians")).collect();
    assert_eq!(rows.len(), 121, "a line after each of 120 steps, and one of the last evaluation");
    assert!(rows.iter().all(|&rows| rows <= cap), "{rows:?}");
    // A histogram bin that does not fit as a whole is left out.
    let end = number(&summary, "gaussians");
    assert!(end <= cap && end + 40 > cap, "{end} of {cap}");
}

/// The rounds of the strategy that splits along the longest axis, with recycling at the cap: for any memory and number
/// of threads the same bits, and the cap holds at every step.
#[test]
fn long_axis_rounds_page_to_the_same_bits_and_keep_the_cap() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 8_000);
    // Views come in groups, so rounds come after whole epochs of 28 steps and recycle 28 / 8 times as much.
    let rounds = ["--refine-start", "20", "--refine-every", "8", "--strategy", "long-axis", "--recycle", "0.01"];
    let mixed = ["--growth-score", "mixed"];
    let capped =
        ["--page-rows", "32", "--steps", "120", "--max-gaussians", "8800", "--log-every", "1", "--device", "cpu"];
    let usual = [COMMON, &rounds, &capped].concat();
    let base = [&usual[..], &mixed].concat();
    let (want, whole) = run(folder.path(), &scene, &base, &How { frames: 0, io: "", threads: "2", more: &[] });
    let most = number(&whole, "pages_pinned_max");
    assert!(most < number(&whole, "pages") / 2, "a view sees too much");
    for (frames, io, threads) in [(most, "auto", "1"), (most / 3, "", "2")] {
        let (got, summary) = run(folder.path(), &scene, &base, &How { frames, io, threads, more: &[] });
        assert!(got == want, "{frames} frames");
        assert_eq!(number(&summary, "gaussians"), number(&whole, "gaussians"));
        assert!(number(&summary, "pages_read") > 0, "{summary}");
        let metrics = std::fs::read_to_string(folder.path().join("out/metrics.jsonl")).unwrap();
        let rows: Vec<u64> = metrics.lines().map(|l| number(&serde_json::from_str(l).unwrap(), "gaussians")).collect();
        assert!(rows.iter().all(|&rows| rows <= 8_800), "{rows:?}");
        // Step 28, counted from 0, ends the first epoch after --refine-start. By steps, the first round would follow step 24.
        assert!(rows[..=28].iter().all(|&rows| rows == 8_000), "a round within an epoch: {rows:?}");
        assert!(rows.windows(2).any(|pair| pair[1] < pair[0]), "nothing was recycled: {rows:?}");
        assert!(rows.iter().max() > Some(&8_600), "the cap is not reached: {rows:?}");
    }
    let (without, _) = run(folder.path(), &scene, &usual, &How { frames: 0, io: "", threads: "1", more: &[] });
    assert!(without != want, "the score changes nothing");
}

/// Rounds of relocation, noise and regularisers: for any memory and number of threads the same bits; the cap holds at every step,
/// and faint rows make place for others.
#[test]
fn relocations_and_noise_page_to_the_same_bits_and_keep_the_cap() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 8_000);
    // Rows begin nearly dead, so that many die between two rounds and all have noise.
    let rounds = ["--strategy", "mcmc", "--refine-start", "20", "--refine-every", "8", "--prune-opa", "0.03"];
    let capped = ["--page-rows", "32", "--steps", "120", "--max-gaussians", "8100", "--log-every", "1"];
    let base = [COMMON, &rounds, &capped, &["--init-opacity", "0.05", "--device", "cpu"]].concat();
    let (want, whole) = run(folder.path(), &scene, &base, &How { frames: 0, io: "", threads: "2", more: &[] });
    let most = number(&whole, "pages_pinned_max");
    assert!(most < number(&whole, "pages") / 2, "a view sees too much");
    for (frames, io, threads) in [(most, "auto", "1"), (most / 3, "", "2")] {
        let (got, summary) = run(folder.path(), &scene, &base, &How { frames, io, threads, more: &[] });
        assert!(got == want, "{frames} frames");
        assert!(number(&summary, "pages_read") > 0, "{summary}");
        let metrics = std::fs::read_to_string(folder.path().join("out/metrics.jsonl")).unwrap();
        let rows: Vec<u64> = metrics.lines().map(|l| number(&serde_json::from_str(l).unwrap(), "gaussians")).collect();
        assert!(rows.iter().all(|&rows| rows <= 8_100), "{rows:?}");
        let falls = rows.windows(2).filter(|pair| pair[1] < pair[0]).count();
        let rises = rows.windows(2).filter(|pair| pair[1] > pair[0]).count();
        assert!(falls > 0 && rises > 0, "nothing died or nothing was copied: {rows:?}");
    }
}

/// A count that the run decides: the same checks, the same decisions and the same bits for any number of frames and threads.
#[test]
fn a_count_that_the_run_decides_pages_to_the_same_bits() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 3_000);
    // Rounds after every fourth step, and a check with every other of them from a third of the steps on.
    let long = ["--page-rows", "32", "--steps", "120", "--strategy", "long-axis", "--refine-start", "20"];
    let base = [COMMON, &long, &["--refine-every", "4", "--device", "cpu"]].concat();
    let archive = [&base[..], &["--quality", "archive"]].concat();
    let in_memory = How { frames: 0, io: "", threads: "2", more: &[] };
    let (want, whole) = run(folder.path(), &scene, &archive, &in_memory);
    let checks = whole["growth"].as_array().unwrap();
    let steps: Vec<u64> = checks.iter().map(|check| number(check, "step")).collect();
    assert_eq!(steps, [41, 49, 57, 65]);
    let allowed = number(&checks[3], "allowed");
    assert!(allowed > 3_200 && number(&whole, "gaussians") > 3_100, "nothing pays: {checks:?}");
    assert!(number(&whole, "gaussians") <= allowed, "{whole}");
    let most = number(&whole, "pages_pinned_max");
    assert!(most < number(&whole, "pages"), "a view sees everything");
    for (frames, io, threads) in [(most, "auto", "1"), (most / 3, "", "2")] {
        let (got, summary) = run(folder.path(), &scene, &archive, &How { frames, io, threads, more: &[] });
        assert_eq!(summary["growth"], whole["growth"], "{frames} frames");
        assert!(got == want, "{frames} frames");
        assert!(number(&summary, "pages_read") > 0, "{summary}");
    }
    // A higher price, and no trial, allow fewer; and the last check cannot come after the last round.
    let draft = [&base[..], &["--quality", "draft", "--refine-stop", "60"]].concat();
    let (_, summary) = run(folder.path(), &scene, &draft, &in_memory);
    let growth = summary["growth"].as_array().unwrap();
    assert!(growth.len() == 3 && number(&growth[2], "allowed") < allowed, "{growth:?}");
}

/// A doubling on trial that fits noise is undone, and the same rows go for any number of frames and threads. Decisions depend on the
/// last bit where values are near a limit, so the instruction path is named.
#[test]
fn a_doubling_that_is_undone_pages_to_the_same_bits() {
    let folder = TempDir::new().unwrap();
    let scene = folder.path().join("scene");
    let size = CityOptions { seed: 3, views: 14, width: 48, height: 36, points: 2000, ..CityOptions::default() };
    write_city(&scene, &CityOptions { supersample: 1, ..size }, &|_, _| {}).unwrap();
    let flags = "--schedule run-length --strategy long-axis --steps 300 --page-rows 128 --view-order shuffle --test-every 0 \
                 --device cpu --simd baseline --log-every 1 --seed 1 --quiet";
    let base: Vec<&str> = flags.split_whitespace().collect();
    let (want, whole) = run(folder.path(), &scene, &base, &How { frames: 0, io: "", threads: "2", more: &[] });
    let allowed: Vec<u64> = whole["growth"].as_array().unwrap().iter().map(|check| number(check, "allowed")).collect();
    assert_eq!(allowed, [4000, 8000, 16_000, 8000]);
    let metrics = std::fs::read_to_string(folder.path().join("out/metrics.jsonl")).unwrap();
    let rows = |line: &str| number(&serde_json::from_str(line).unwrap(), "gaussians");
    let most = metrics.lines().map(rows).max().unwrap();
    assert!(most > 15_000 && (7_500..=8_000).contains(&number(&whole, "gaussians")), "{most}, then {whole}");
    let (got, summary) = run(folder.path(), &scene, &base, &How { frames: 60, io: "auto", threads: "1", more: &[] });
    assert!(number(&summary, "pages_read") > 0, "{summary}");
    assert!(got == want && summary["growth"] == whole["growth"]);
}

/// 16-bit moments change training, but paging changes nothing further.
#[test]
fn moments_in_16_bits_page_to_the_same_bits() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 8_000);
    let base = [CITY, COMMON, MORE_EVENTS].concat();
    let halves = [&base[..], &["--moments", "bf16"]].concat();
    let in_memory = How { frames: 0, io: "", threads: "2", more: &[] };
    let (want, whole) = run(folder.path(), &scene, &halves, &in_memory);
    let frames = number(&whole, "pages_pinned_max");
    assert!(frames < number(&whole, "pages") / 2, "a view sees too much");
    for (threads, more) in [("2", &[][..]), ("1", &["--spill-codec", "zstd:1"])] {
        let how = How { frames, io: "auto", threads, more };
        let (got, summary) = run(folder.path(), &scene, &halves, &how);
        assert!(got == want, "{how:?} gives another scene");
        assert!(number(&summary, "pages_read") > 0 && number(&summary, "evictions") > 0, "{summary}");
    }
    let (exact, _) = run(folder.path(), &scene, &base, &in_memory);
    assert!(exact != want, "the moments were not rounded");
}
