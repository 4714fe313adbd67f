//! The memory that `--dry-run` announces against the peak memory of the run that follows.

use crate::support::lpips::lpips_weights;
#[cfg(target_os = "linux")]
use crate::support::memory_group::MemoryGroup;
use crate::support::scenes::told;
use crate::support::workdir::{EVAL, TRAIN, Workdir, least_memory};

/// The documented error is a tenth. On a small test scene, the memory of the bare program (code, libraries, stacks)
/// differs between systems and build profiles by up to this much; on real scenes that difference is negligible.
const SLACK: f64 = 4e6;

/// The announced peak of a run, bytes.
fn announced(work: &Workdir, more: &str) -> f64 {
    let output = work.output(TRAIN, &format!("scene --dry-run {more}"));
    let said = told(&output);
    assert!(output.status.success(), "{said}");
    let line = said.lines().find(|l| l.starts_with("memory ")).unwrap();
    let mut words = line.split_whitespace().skip(2);
    let number: f64 = words.next().unwrap().parse().unwrap();
    let unit = words.next().unwrap();
    number * (1u64 << (10 * ["B", "KiB", "MiB", "GiB"].iter().position(|u| *u == unit).unwrap())) as f64
}

/// Runs into `out`; returns the Gaussians.
fn check(work: &Workdir, more: &str) -> u64 {
    let announced = announced(work, more);
    work.train(&format!("scene --out out --overwrite --quiet {more}"));
    let peak = work.count("out", "host_bytes_peak") as f64;
    if peak > 0.0 {
        let off = (announced - peak).abs();
        let (mega, shown) = (announced / 1e6, peak / 1e6);
        assert!(off <= 0.1 * peak + SLACK, "{more}: {mega:.1} MB announced, {shown:.1} MB at the peak");
    }
    work.count("out", "gaussians")
}

#[test]
fn the_announced_memory_is_what_a_run_takes() {
    let work = Workdir::city(12, 400, 300, 60_000);
    for (more, least) in [
        // All photos in memory, then one; then a scene that grows.
        ("--strategy none", 0),
        ("--strategy none --image-cache 1MiB", 0),
        ("--max-gaussians 66000 --refine-start 9 --refine-every 10 --grow-grad2d 0", 64_000),
        // Large pages, many of which split, with all colour bands.
        ("--max-gaussians 150000 --refine-start 9 --refine-every 5 --grow-grad2d 0.00002 --sh-start 3", 140_000),
    ] {
        let gaussians = check(&work, &format!("--threads 2 --steps 22 {more}"));
        assert!(gaussians > least, "the scene hardly grew ({gaussians}), so {more} shows little");
    }
}

/// Runs a program, refused in 64 MiB, within exactly the memory that the refusal names as the least; `false` where the system cannot
/// limit it.
#[cfg(target_os = "linux")]
fn succeeds_within_the_least(work: &Workdir, program: &str, flags: &str) -> bool {
    let mebibytes = least_memory(&work.refuses_with(program, &format!("{flags} --host-mem 64MiB"), &[]));
    let group = match MemoryGroup::new((mebibytes * f64::from(1 << 20)) as u64) {
        Ok(group) => group,
        Err(why) => {
            println!("SKIPPED: no memory control group here: {why}");
            return false;
        }
    };
    let output = work.within(&group, program, &format!("{flags} --host-mem {mebibytes}MiB"));
    assert!(output.status.success(), "{flags} in {mebibytes} MiB: {:?} {}", output.status, told(&output));
    true
}

/// Every option that looks at whole photos, with photos of 2 million pixels: the run stays within exactly the memory that it says is
/// the least, and the announced peak is right within a tenth.
#[test]
#[cfg(target_os = "linux")]
fn no_option_takes_more_memory_than_promised_with_large_photos() {
    // Twelve photos to train on are enough to decide the count by.
    let work = Workdir::city(14, 240, 135, 2_000);
    // A photo may be larger than its camera states.
    for path in work.photos() {
        let small = image::open(&path).unwrap().into_rgb8();
        image::imageops::resize(&small, 1920, 1080, image::imageops::FilterType::Nearest).save(&path).unwrap();
    }
    let fixed = "--threads 2 --steps 5 --device cpu --image-cache 1MiB --appearance full";
    let decides = format!("{fixed} --strategy long-axis --refine-start 1 --refine-every 1 --refine-stop 5");
    let all = format!(
        "{fixed} --max-gaussians 2000 --color-correct quadratic --robust-pixels --robust-views --refine-poses --export spz,sog \
         --eval-every 3"
    );
    check(&work, &all);
    for (flags, decides) in [(&all, false), (&decides, true)] {
        let flags = format!("scene --out limited --overwrite --spill-dir spill --quiet {flags}");
        let is_limited = succeeds_within_the_least(&work, TRAIN, &flags);
        assert!(!is_limited || work.text("limited/metrics.jsonl").contains("trained_psnr") == decides, "{flags}");
        work.remove("spill");
    }
    // The evaluation of a file on the same photos; with LPIPS on smaller ones, of which its weights are a part that counts.
    lpips_weights(&work.path(""));
    for more in ["", "--max-resolution 960 --lpips lpips_alex.safetensors --appearance full"] {
        let flags = "out scene --image-cache 1MiB --color-correct quadratic --renders pictures";
        succeeds_within_the_least(&work, EVAL, &format!("{flags} {more}"));
    }
}
