//! The memory that `--dry-run` announces against the peak memory of the run that follows.

use crate::support::lpips::lpips_weights;
#[cfg(target_os = "linux")]
use crate::support::memory_group::MemoryGroup;
use crate::support::scenes::{city, classic, eval, stderr, summary, text, told, train};
use std::path::Path;
use std::process::Output;
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

/// Runs a program within exactly this memory; `false` where the system cannot limit it.
#[cfg(target_os = "linux")]
fn succeeds_within(mebibytes: f64, program: &str, arguments: &[&str]) -> bool {
    let group = match MemoryGroup::new((mebibytes * f64::from(1 << 20)) as u64) {
        Ok(group) => group,
        Err(why) => {
            println!("SKIPPED: no memory control group here: {why}");
            return false;
        }
    };
    let arguments: Vec<std::ffi::OsString> = arguments.iter().map(Into::into).collect();
    let output = group.command(Path::new(program), &arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?} in {mebibytes} MiB: {:?} {}", output.status, stderr(&output));
    true
}

/// The memory, MiB, that a refusal names as the least.
fn least(refused: &Output) -> f64 {
    let said = stderr(refused);
    assert_eq!(refused.status.code(), Some(1), "{said}");
    let number = said.split("give at least ").nth(1).unwrap_or_else(|| panic!("no memory is named: {said}"));
    assert_eq!(number.split(' ').nth(1), Some("MiB"), "{said}");
    number.split(' ').next().unwrap().parse().unwrap()
}

/// Every option that looks at whole photos, with photos of 8.3 million pixels: the run stays within exactly the memory that it says is
/// the least, and the announced peak is right within a tenth.
#[test]
#[cfg(target_os = "linux")]
fn no_option_takes_more_memory_than_promised_with_large_photos() {
    let folder = TempDir::new().unwrap();
    // Twelve photos to train on are enough to decide the count by.
    let scene = city(folder.path(), 14, 240, 135, 2_000);
    // A photo may be larger than its camera states.
    for entry in std::fs::read_dir(scene.join("images")).unwrap() {
        let path = entry.unwrap().path();
        let small = image::open(&path).unwrap().into_rgb8();
        image::imageops::resize(&small, 3840, 2160, image::imageops::FilterType::Nearest).save(&path).unwrap();
    }
    let fixed = ["--threads", "2", "--steps", "5", "--device", "cpu", "--image-cache", "1MiB"];
    let decides = "--strategy long-axis --refine-start 1 --refine-every 1 --refine-stop 5 --appearance full";
    let decides = [&fixed[..], &decides.split(' ').collect::<Vec<_>>()].concat();
    let all = "--max-gaussians 2000 --color-correct quadratic --robust-pixels --robust-views --refine-poses --appearance full \
               --export spz,sog --eval-every 3";
    let all = [&fixed[..], &all.split_whitespace().collect::<Vec<_>>()].concat();
    let run = folder.path().join("all");
    check(folder.path(), &scene, "all", &all);
    for flags in [all, decides] {
        let (spill, out) = (folder.path().join("spill"), folder.path().join("limited"));
        let places = [text(&scene), "--out", text(&out), "--overwrite", "--spill-dir", text(&spill), "--quiet"];
        let least = least(&train(&[&places, &flags[..], &["--host-mem", "100MiB"]].concat()));
        let host_mem = format!("{least}MiB");
        let arguments = [&places, &flags[..], &["--host-mem", &host_mem], &classic(&flags)].concat();
        let is_limited = succeeds_within(least, env!("CARGO_BIN_EXE_gsscale-train"), &arguments);
        let checks = std::fs::read_to_string(out.join("metrics.jsonl")).is_ok_and(|lines| lines.contains("pays_from"));
        assert!(!is_limited || checks != flags.contains(&"--max-gaussians"), "{flags:?}: checks of growth: {checks}");
        std::fs::remove_dir_all(&spill).ok();
    }
    // The evaluation of a file on the same photos.
    let weights = lpips_weights(folder.path());
    let lpips = ["--lpips", text(&weights), "--appearance", "full"];
    let arguments = [text(&run), text(&scene), "--image-cache", "1MiB", "--color-correct", "quadratic"];
    for arguments in [arguments.to_vec(), [&arguments[..], &lpips].concat()] {
        let arguments = [&arguments[..], &["--host-mem"]].concat();
        let least = least(&eval(&[&arguments[..], &["100MiB"]].concat()));
        let host_mem = format!("{least}MiB");
        let pictures = folder.path().join("pictures");
        let arguments = [&arguments[..], &[&host_mem, "--renders", text(&pictures)]].concat();
        succeeds_within(least, env!("CARGO_BIN_EXE_gsscale-eval"), &arguments);
    }
}
