//! A scene that outgrows its frames: the start warns, the run keeps its work, and the run continued with more frames
//! ends with the bytes of a run that had these frames from the start. Through the real binary.

use crate::support::scenes::{stderr, summary, text, train};
#[cfg(target_os = "linux")]
use crate::support::small_drive::Small;
use gsscale::dataset::synthetic::{CityOptions, write_city};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Grows by half within the steps; commits only at the end or when the run stops.
const GROWING: &[&str] = &[
    "--steps",
    "150",
    "--page-rows",
    "32",
    "--grow-grad2d",
    "0.001",
    "--refine-start",
    "40",
    "--refine-every",
    "30",
    "--sh-every",
    "50",
    "--view-order",
    "groups:4",
    "--test-every",
    "24",
    "--commit-every",
    "0",
    "--device",
    "cpu",
];

fn scene(folder: &Path) -> PathBuf {
    let scene = folder.join("scene");
    let (views, width, height, points, blocks) = (24, 64, 48, 6000, Some(20));
    let city = CityOptions { seed: 5, views, width, height, points, blocks, supersample: 1, ..CityOptions::default() };
    write_city(&scene, &city, &|_, _| {}).unwrap();
    scene
}

#[test]
fn a_run_that_outgrows_its_frames_says_so_keeps_what_it_has_and_goes_on_with_more() {
    let folder = TempDir::new().unwrap();
    let scene = scene(folder.path());
    let path = |name: &str| folder.path().join(name);
    let (alone, out, spill) = (path("alone"), path("out"), path("spill"));
    let output = train(&[&[text(&scene), "--out", text(&alone), "--quiet"], GROWING].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let most = summary(&alone)["pages_pinned_max"].as_u64().unwrap();
    // The largest view takes 65 pages at the start.
    let too_few = (most * 85 / 100).to_string();
    let begin = ["--out", text(&out), "--spill-dir", text(&spill), "--frames", &too_few];
    let output = train(&[&[text(&scene)], &begin[..], GROWING].concat());
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "the scene never outgrew {too_few} frames: {said}");
    for words in
        ["warning: the view", "no cap", "pages in memory at once", &format!("--resume {} --frames ", text(&out))]
    {
        assert!(said.contains(words), "{words} is not in: {said}");
    }
    let stopped = summary(&out);
    let steps = stopped["steps"].as_u64().unwrap();
    assert!(stopped["finished"] == false && steps > 30, "{stopped}");
    let kept = std::fs::read(out.join("point_cloud.ply")).unwrap();
    assert!(kept.len() > 62 * 4 * 6000, "the last good state is written");
    // With the same number of frames the run stops at the same step with the same Gaussians; further pages may have
    // been split meanwhile, which changes the order of rows.
    let output = train(&["--resume", text(&out), "--quiet"]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let again = std::fs::read(out.join("point_cloud.ply")).unwrap();
    assert!(again.len() == kept.len() && again[..300] == kept[..300], "step and number of Gaussians are in the header");
    let output = train(&["--resume", text(&out), "--frames", &most.to_string(), "--quiet"]);
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(summary(&out)["finished"], true);
    assert!(spill.read_dir().map_or(true, |mut left| left.next().is_none()), "nothing is left of its pages");
    let [got, want] = [&out, &alone].map(|folder| std::fs::read(folder.join("point_cloud.ply")).unwrap());
    assert!(got == want, "another scene than that of a run with enough frames");
}

#[test]
fn a_cap_that_the_frames_hold_is_no_reason_to_warn() {
    let folder = TempDir::new().unwrap();
    let scene = scene(folder.path());
    let (out, spill) = (folder.path().join("out"), folder.path().join("spill"));
    let said = |cap: &str| {
        let flags = ["--out", text(&out), "--spill-dir", text(&spill), "--frames", "200", "--max-gaussians", cap];
        let output = train(&[&[text(&scene), "--steps", "2", "--page-rows", "32", "--overwrite"], &flags[..]].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        stderr(&output)
    };
    assert!(!said("6300").contains("warning: the view"));
    let warned = said("600000");
    assert!(warned.contains("--max-gaussians 600000") && warned.contains("200 frames"), "{warned}");
}

/// The purpose of the drive: a scene that outgrows its memory.
fn large_scene(folder: &Path) -> PathBuf {
    let scene = folder.join("scene");
    let (views, width, height, points, blocks) = (33, 160, 120, 60_000, Some(12));
    let city = CityOptions { seed: 5, views, width, height, points, blocks, supersample: 1, ..CityOptions::default() };
    write_city(&scene, &city, &|_, _| {}).unwrap();
    scene
}

/// Grows sixfold; a round every 20 steps, all colour bands in use.
const GROWING_MUCH: &str = "--steps 120 --page-rows 64 --grow-grad2d 0.00005 --refine-start 20 --refine-every 20 --view-order \
    groups:4 --test-every 11 --commit-every 0 --device cpu --threads 2 --image-cache 4MiB --prefetch-bytes 1MiB \
    --log-every 5 --sh-start 3";

fn frames_logged(out: &Path) -> Vec<u64> {
    let metrics = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    let frames = |line| serde_json::from_str::<serde_json::Value>(line).unwrap()["frames"].as_u64().unwrap();
    metrics.lines().map(frames).collect()
}

#[test]
fn a_scene_that_grows_stays_within_its_memory() {
    const BUDGET: f64 = 160.0 * 1048576.0;
    let folder = TempDir::new().unwrap();
    let scene = large_scene(folder.path());
    let path = |name: &str| folder.path().join(name);
    let (alone, out, spill) = (path("alone"), path("out"), path("spill"));
    let flags: Vec<&str> = GROWING_MUCH.split_whitespace().collect();
    let output = train(&[&[text(&scene), "--out", text(&alone), "--quiet"], &flags[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let within = ["--out", text(&out), "--spill-dir", text(&spill), "--host-mem", "160MiB"];
    let output = train(&[&[text(&scene)], &within[..], &flags[..]].concat());
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("growth has no cap") && said.contains("one for every page"), "{said}");
    // Without a folder for its pages it begins in memory, and finds the drive of its results when it does not fit.
    let moved = path("moved");
    let other = ["--out", text(&moved), "--host-mem", "160MiB", "--spill-codec", "zstd:1", "--evict", "lru"];
    let output = train(&[&[text(&scene)], &other[..], &flags[..]].concat());
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    assert!(said.contains(&format!("its pages move between memory and {}/checkpoint", text(&moved))), "{said}");
    assert!(!moved.join("checkpoint").exists(), "removed at a clean end");
    // Stopped after the move, the run continues in the same memory.
    let cut = path("cut");
    let begin = ["--out", text(&cut), "--host-mem", "160MiB", "--quiet", "--keep-checkpoint"];
    let steps = GROWING_MUCH.replace("--steps 120", "--steps 90 --schedule-steps 120");
    let output = train(&[&[text(&scene)], &begin[..], &steps.split_whitespace().collect::<Vec<_>>()].concat());
    assert!(output.status.success() && stderr(&output).contains("move between"), "{}", stderr(&output));
    assert!(summary(&cut)["drive_bytes_peak"].as_u64() > Some(0));
    let more = ["--steps", "120", "--schedule-steps", "120", "--keep-checkpoint=false", "--quiet"];
    let output = train(&[&["--resume", text(&cut)], &more[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let in_memory = summary(&alone);
    let peak = |summary: &serde_json::Value| summary["host_bytes_peak"].as_f64().unwrap();
    assert!(peak(&in_memory) > 1.8 * BUDGET, "{:.1} MB in memory: it hardly grew", peak(&in_memory) / 1e6);
    assert_eq!(in_memory["bytes_read"], 0);
    for out in [&out, &moved, &cut] {
        // The documented error is a tenth.
        let done = summary(out);
        assert!(peak(&done) <= 1.1 * BUDGET, "{:.1} MB at the peak", peak(&done) / 1e6);
        let frames = frames_logged(out);
        let (most, least) = (frames.iter().max().unwrap(), frames[frames.len() / 2..].iter().min().unwrap());
        assert!(least * 4 < most * 3, "none gave way: {frames:?}");
        let read = |key: &str| done[key].as_u64().unwrap();
        assert!(read("bytes_read") > read("other_bytes_read"), "no step read a page: {done}");
        let [got, want] = [out, &alone].map(|folder| std::fs::read(folder.join("point_cloud.ply")).unwrap());
        assert!(got == want, "another scene than in memory");
    }
}

#[test]
fn a_scene_that_grows_beyond_its_memory_stops_with_the_need_and_goes_on_with_it() {
    let folder = TempDir::new().unwrap();
    let scene = large_scene(folder.path());
    let (out, spill) = (folder.path().join("out"), folder.path().join("spill"));
    let flags: Vec<&str> = GROWING_MUCH.split_whitespace().collect();
    let within = ["--out", text(&out), "--spill-dir", text(&spill), "--host-mem", "92MiB"];
    let output = train(&[&[text(&scene)], &within[..], &flags[..]].concat());
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for words in ["(view_00", ".jpg) needs", "pages in memory at once", "--host-mem"] {
        assert!(said.contains(words), "{words} is not in: {said}");
    }
    let stopped = summary(&out);
    let peak = stopped["host_bytes_peak"].as_f64().unwrap();
    assert!(peak <= 1.1 * 92.0 * 1048576.0, "{:.1} MB at the peak", peak / 1e6);
    assert!(stopped["gaussians"].as_u64() > Some(70_000), "it stopped before it grew: {stopped}");
    // Again with the named memory, which is more than before.
    let line = said.lines().find(|l| l.starts_with("to go on from the last commit")).unwrap();
    let named = line.split("--host-mem ").nth(1).and_then(|rest| rest.split_whitespace().next()).unwrap();
    let output = train(&["--resume", text(&out), "--host-mem", named, "--quiet"]);
    let steps = summary(&out)["steps"].as_u64().unwrap();
    assert!(steps > stopped["steps"].as_u64().unwrap(), "{named} did not help: {}", stderr(&output));
    // With less memory than its views take, in memory from the start: the finished part is written all the same.
    let tight = folder.path().join("tight");
    let output = train(&[&[text(&scene), "--out", text(&tight), "--host-mem", "92MiB"], &flags[..]].concat());
    let said = stderr(&output);
    assert!(output.status.code() == Some(1) && said.contains("pages in memory at once"), "{said}");
    assert!(tight.join("point_cloud.ply").is_file() && tight.join("summary.json").is_file(), "{said}");
    let output = train(&["--resume", text(&out), "--host-mem", "200MiB", "--quiet"]);
    assert!(output.status.success() && summary(&out)["finished"] == true, "{}", stderr(&output));
}

/// Just enough steps for the scene to grow beyond 160 MiB.
fn growing_less() -> String {
    let all = "--steps 120";
    assert!(GROWING_MUCH.contains(all));
    GROWING_MUCH.replace(all, "--steps 66")
}

/// Dense Adam updates every row at every step: also pages in memory beside those just read.
#[test]
fn a_run_that_updates_every_row_moves_out_as_well() {
    let folder = TempDir::new().unwrap();
    let scene = large_scene(folder.path());
    let (alone, out) = (folder.path().join("alone"), folder.path().join("out"));
    let dense = growing_less() + " --optimizer dense --quiet";
    let flags: Vec<&str> = dense.split_whitespace().collect();
    let output = train(&[&[text(&scene), "--out", text(&alone)], &flags[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let output = train(&[&[text(&scene), "--out", text(&out), "--host-mem", "160MiB"], &flags[..]].concat());
    let said = stderr(&output);
    assert!(output.status.success() && said.contains("move between memory and"), "{said}");
    let peak = summary(&out)["host_bytes_peak"].as_f64().unwrap();
    assert!(peak <= 1.1 * 160.0 * 1048576.0, "{:.1} MB at the peak", peak / 1e6);
    let [got, want] = [&out, &alone].map(|folder| std::fs::read(folder.join("point_cloud.ply")).unwrap());
    assert!(got == want, "another scene than in memory");
}

/// The drive of the results is full when the pages should move there: the run reports it and continues in memory.
#[cfg(target_os = "linux")]
#[test]
fn a_run_with_no_drive_to_move_to_goes_on_in_memory() {
    let folder = TempDir::new().unwrap();
    let scene = large_scene(folder.path());
    let Some(drive) = Small::mount(&folder.path().join("drive"), 60 << 20) else { return };
    let (alone, out) = (folder.path().join("alone"), drive.0.join("out"));
    let fewer = growing_less();
    let flags: Vec<&str> = fewer.split_whitespace().collect();
    let output = train(&[&[text(&scene), "--out", text(&alone), "--quiet"], &flags[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let output = train(&[&[text(&scene), "--out", text(&out), "--host-mem", "160MiB", "--quiet"], &flags[..]].concat());
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    assert_eq!(said.matches("its pages cannot be moved to a drive").count(), 1, "once, not at every step: {said}");
    assert_eq!(summary(&out)["bytes_read"], 0);
    let [got, want] = [&out, &alone].map(|folder| std::fs::read(folder.join("point_cloud.ply")).unwrap());
    assert!(got == want, "another scene than in memory");
}
