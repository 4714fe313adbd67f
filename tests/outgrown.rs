//! A scene that grows beyond its frames: it is said at the start that it may, the run that does keeps what it has, and goes
//! on with more frames to the bytes of a run that had them from the start. Through the real binary.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "support/scenes.rs"]
mod scenes;

use gsscale::dataset::synthetic::{CityOptions, write_city};
use scenes::{stderr, summary, text, train};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Grows by half within the steps; no commit before the end but that of a run that stops.
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
    // The view that needs most takes 65 pages at the start.
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
    // With as few as before it stops where it did, with the same Gaussians; more pages may have been cut meanwhile, whose
    // rows come in another order.
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
