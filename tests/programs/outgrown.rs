//! A scene that outgrows its frames or its memory: the start warns, the run goes on with views in batches or with pages that
//! move to a drive, and ends with the bytes of a run that had memory for everything. Through the real binary.

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
fn a_run_that_outgrows_its_frames_goes_in_batches_to_the_same_bytes() {
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
    assert!(output.status.success(), "{said}");
    for words in ["warning: the view", "no cap", "steps on such views take several batches"] {
        assert!(said.contains(words), "{words} is not in: {said}");
    }
    let done = summary(&out);
    assert!(done["finished"] == true && done["pages_pinned_max"].as_u64() < Some(most), "{done}");
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
fn a_scene_that_grows_stays_within_its_memory_and_within_less_than_its_views_take() {
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
    assert!(said.contains("growth has no cap") && said.contains(" frames of pages"), "{said}");
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
        std::fs::remove_dir_all(out).unwrap();
    }
    finishes_in_less_than_a_view(&scene, &flags, &alone, [&out, &spill]);
}

/// 92 MiB do not hold the largest view of the grown scene. The run finishes in them, whether its pages have a drive from the
/// start or move to the drive of its checkpoint. `alone` holds the run in memory.
fn finishes_in_less_than_a_view(scene: &Path, flags: &[&str], alone: &Path, [out, spill]: [&Path; 2]) {
    let pages = summary(alone)["pages_pinned_max"].as_u64();
    for to_spill in [&["--spill-dir", text(spill)][..], &[]] {
        let within = ["--out", text(out), "--overwrite", "--host-mem", "92MiB"];
        let output = train(&[&[text(scene)], &within[..], to_spill, flags].concat());
        let said = stderr(&output);
        assert!(output.status.success(), "{said}");
        let done = summary(out);
        assert!(done["finished"] == true && done["pages_pinned_max"].as_u64() < pages, "no view was cut: {done}");
        let peak = done["host_bytes_peak"].as_f64().unwrap();
        assert!(peak <= 1.1 * 92.0 * 1048576.0, "{:.1} MB at the peak", peak / 1e6);
        let [got, want] = [out, alone].map(|folder| std::fs::read(folder.join("point_cloud.ply")).unwrap());
        assert!(got == want, "another scene than in memory");
    }
}

/// A photo from high above needs most of the memory for its own rows. Afterwards the frames have this memory again.
#[test]
fn frames_return_after_a_photo_that_shows_much_of_the_scene() {
    const BUDGET: f64 = 128.0 * 1048576.0;
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name);
    let (scene, alone, out, spill) = (path("scene"), path("alone"), path("out"), path("spill"));
    let (width, height, points) = (96, 64, 50_000);
    let size = CityOptions { width, height, points, tiles: [2, 4], ..CityOptions::default() };
    let city = CityOptions { seed: 5, views: 24, overviews: 2, supersample: 1, ..size };
    write_city(&scene, &city, &|_, _| {}).unwrap();
    let flags = "--steps 60 --page-rows 64 --strategy none --test-every 0 --commit-every 0 --device cpu --log-every 1 --quiet \
                 --image-cache 4MiB --prefetch-bytes 1MiB --sh-degree 1 --view-order shuffle";
    let flags: Vec<&str> = flags.split_whitespace().collect();
    let output = train(&[&[text(&scene), "--out", text(&alone)], &flags[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let within = ["--out", text(&out), "--spill-dir", text(&spill), "--host-mem", "128MiB"];
    let output = train(&[&[text(&scene)], &within[..], &flags[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let (frames, done) = (frames_logged(&out), summary(&out));
    // The first step with the fewest frames is that of a photo from high above; few photos follow until all are ordinary.
    let (wide, least) = frames.iter().enumerate().min_by_key(|(_, frames)| **frames).unwrap();
    let again = frames[wide..].iter().max().unwrap();
    // How much of the budget is free for frames is measured in the process, so their number varies by some percent.
    assert!(3 * again >= 4 * least, "{least} frames at step {wide}, at most {again} after it: {frames:?}");
    // The documented error is a tenth.
    let peak = done["host_bytes_peak"].as_f64().unwrap();
    assert!(peak <= 1.1 * BUDGET, "{:.1} MB at the peak, {frames:?}", peak / 1e6);
    let [got, want] = [&out, &alone].map(|folder| std::fs::read(folder.join("point_cloud.ply")).unwrap());
    assert!(got == want, "another scene than in memory");
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
