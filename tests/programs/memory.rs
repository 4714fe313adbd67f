//! The memory that `--dry-run` announces against the peak memory of the run that follows.

use crate::support::scenes::{city, stderr, summary, text, told, train};
use std::path::Path;
use tempfile::TempDir;

/// The documented error is a tenth. On a small test scene, the memory of the bare program (code, libraries, stacks)
/// differs between systems and build profiles by up to this much; on real scenes that difference is negligible.
const SLACK: f64 = 4e6;

/// The announced peak of a run, bytes.
fn announced(scene: &Path, more: &[&str]) -> f64 {
    let output = train(&[&[text(scene), "--dry-run"], more].concat());
    let said = told(&output);
    assert!(output.status.success(), "{said}");
    let line = said.lines().find(|l| l.starts_with("memory ")).unwrap();
    let mut words = line.split_whitespace().skip(2);
    let number: f64 = words.next().unwrap().parse().unwrap();
    let unit = words.next().unwrap();
    number * (1u64 << (10 * ["B", "KiB", "MiB", "GiB"].iter().position(|u| *u == unit).unwrap())) as f64
}

fn check(folder: &Path, scene: &Path, name: &str, more: &[&str]) -> u64 {
    let announced = announced(scene, more);
    let out = folder.join(name);
    let output = train(&[&[text(scene), "--out", text(&out), "--quiet"], more].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let summary = summary(&out);
    let peak = summary["host_bytes_peak"].as_f64().unwrap();
    if peak > 0.0 {
        let off = (announced - peak).abs();
        let (mega, shown) = (announced / 1e6, peak / 1e6);
        assert!(off <= 0.1 * peak + SLACK, "{name}: {mega:.1} MB announced, {shown:.1} MB at the peak");
    }
    summary["gaussians"].as_u64().unwrap()
}

#[test]
fn the_announced_memory_is_what_a_run_takes() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 400, 300, 60_000);
    let two = ["--threads", "2", "--steps", "30"];
    check(folder.path(), &scene, "all photos", &[&two[..], &["--strategy", "none"]].concat());
    check(folder.path(), &scene, "one photo", &[&two[..], &["--strategy", "none", "--image-cache", "1MiB"]].concat());
    let growing = ["--max-gaussians", "66000", "--refine-start", "9", "--refine-every", "10", "--grow-grad2d", "0"];
    let gaussians = check(folder.path(), &scene, "growing", &[&two[..], &growing].concat());
    assert!(gaussians > 64_000, "the scene hardly grew ({gaussians}), so the last case shows little");
    // Large pages, many of which split, with all colour bands.
    let growing =
        ["--max-gaussians", "150000", "--refine-start", "9", "--refine-every", "5", "--grow-grad2d", "0.00002"];
    let gaussians = check(folder.path(), &scene, "grown", &[&two[..], &growing, &["--sh-start", "3"]].concat());
    assert!(gaussians > 140_000, "the scene hardly grew ({gaussians}), so the last case shows little");
}
