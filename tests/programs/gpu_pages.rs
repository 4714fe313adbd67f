//! Runs whose optimizer is on the device (`--optimizer-on device`), through the real binary: the same bytes whatever the
//! slots, frames, threads and engines, after kills and after a lost device; what crosses the bus; what is refused.

use crate::support::gpu;
use crate::support::scenes::{city, classic, psnr, stderr, summary, text, train, wide_city};
use gsscale::gpu::GpuOptions;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Rounds, resets, raises and a cap within 54 steps.
const GROWING: &[&str] = &[
    "--device",
    "gpu",
    "--optimizer-on",
    "device",
    "--steps",
    "54",
    "--refine-start",
    "9",
    "--refine-every",
    "10",
    "--grow-grad2d",
    "0.0005",
    "--reset-every",
    "25",
    "--sh-every",
    "15",
    "--max-gaussians",
    "7000",
    "--page-rows",
    "32",
    "--view-order",
    "groups:4",
    "--log-every",
    "1",
    "--quiet",
];

fn has_device() -> bool {
    gpu::open(&GpuOptions::default()).is_some()
}

fn run(scene: &Path, out: &Path, args: &[&str], more: &[&str]) {
    let output = train(&[&[text(scene), "--out", text(out)], args, more].concat());
    assert!(output.status.success(), "{more:?}: {}", stderr(&output));
}

fn ply(out: &Path) -> Vec<u8> {
    std::fs::read(out.join("point_cloud.ply")).unwrap()
}

fn metrics(out: &Path) -> Vec<serde_json::Value> {
    let lines = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The loss of every step.
fn losses(out: &Path) -> Vec<f64> {
    metrics(out).iter().map(|line| line["loss"].as_f64().unwrap()).collect()
}

/// A city of which a view sees a part.
fn scene_in(folder: &Path) -> PathBuf {
    wide_city(folder, 6000)
}

#[test]
fn slots_frames_threads_and_engines_change_no_byte() {
    if !has_device() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = scene_in(folder.path());
    let alone = folder.path().join("alone");
    run(&scene, &alone, GROWING, &["--threads", "1"]);
    let whole = summary(&alone);
    let [pages, pinned] = ["pages", "pages_pinned_max"].map(|key| whole[key].as_u64().unwrap());
    assert!(whole["gaussians"].as_u64().unwrap() > 6100 && pinned < pages / 2, "{whole}");
    let few = pinned.to_string();
    // Device memory, frames, threads, engine: every pair of values of two of them.
    let cases: &[[&str; 4]] = &[
        ["0", "0", "2", "auto"],
        ["8MiB", "0", "1", "auto"],
        ["8MiB", &few, "2", "pread"],
        ["5MiB", &few, "1", "uring"],
        ["3MiB", "12", "2", "auto"],
        ["0", "12", "1", "pread"],
    ];
    for (i, [device_mem, frames, threads, io]) in cases.iter().enumerate() {
        let (out, spill) = (folder.path().join(format!("out{i}")), folder.path().join(format!("spill{i}")));
        let mut more = vec!["--device-mem", device_mem, "--threads", threads];
        if *frames != "0" {
            more.extend(["--spill-dir", text(&spill), "--frames", frames, "--io", io]);
        }
        run(&scene, &out, GROWING, &more);
        assert!(ply(&out) == ply(&alone), "{more:?} give another scene");
        assert_eq!(losses(&out), losses(&alone), "{more:?}");
        if *frames != "0" {
            assert!(summary(&out)["evictions"].as_u64().unwrap() > 0, "{more:?}: no page left its frame");
        }
    }
}

#[test]
fn a_run_that_is_killed_with_pages_newer_on_the_device_ends_with_the_same_bytes() {
    if !has_device() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = scene_in(folder.path());
    let [alone, out, spill] = ["alone", "out", "spill"].map(|name| folder.path().join(name));
    run(&scene, &alone, GROWING, &[]);
    let begin = |args: &[&str]| {
        let program = env!("CARGO_BIN_EXE_gsscale-train");
        Command::new(program).args(args).args(classic(args)).stderr(Stdio::null()).spawn().unwrap()
    };
    let of_run = [text(&scene), "--out", text(&out), "--spill-dir", text(&spill), "--commit-every", "0.05"];
    let mut child = begin(&[&of_run[..], GROWING].concat());
    let mut kills = 0;
    for steps in [12, 28, 44] {
        let began = Instant::now();
        let is_there = |out: &Path| out.join("metrics.jsonl").exists() && losses_so_far(out) >= steps;
        while !is_there(&out) && child.try_wait().unwrap().is_none() {
            assert!(began.elapsed() < Duration::from_secs(120), "no step in two minutes");
            std::thread::sleep(Duration::from_millis(5));
        }
        child.kill().unwrap();
        kills += usize::from(!child.wait().unwrap().success());
        child = begin(&["--resume", text(&out), "--quiet"]);
    }
    assert!(child.wait().unwrap().success() && kills >= 2, "{kills} kills");
    assert!(ply(&out) == ply(&alone), "the resumed run gives another scene");
    assert_eq!(losses(&out), losses(&alone));
    let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
    assert!(config.contains("optimizer-on = \"device\""), "{config}");
}

/// Whole lines of a file that is being written.
fn losses_so_far(out: &Path) -> usize {
    std::fs::read_to_string(out.join("metrics.jsonl")).unwrap_or_default().lines().count()
}

/// A run of [`GROWING`] whose device is lost at every so many submissions.
fn run_with_losses(scene: &Path, [out, spill]: [&Path; 2], fault: &str, more: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gsscale-train"))
        .args([text(scene), "--out", text(out), "--spill-dir", text(spill), "--commit-every", "0.005"])
        .args(GROWING)
        .args(classic(more))
        .args(more)
        .env("GSSCALE_GPU_FAULT", fault)
        .output()
        .unwrap()
}

#[test]
fn a_lost_device_loses_the_steps_since_the_last_commit_alone() {
    if !has_device() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = scene_in(folder.path());
    let [alone, out, spill] = ["alone", "out", "spill"].map(|name| folder.path().join(name));
    run(&scene, &alone, GROWING, &[]);
    let output = run_with_losses(&scene, [&out, &spill], "lost@400", &["--restarts", "0"]);
    assert!(!output.status.success() && stderr(&output).contains("the device was lost"), "{}", stderr(&output));
    let resumed = train(&["--resume", text(&out), "--quiet"]);
    assert!(resumed.status.success(), "{}", stderr(&resumed));
    assert!(ply(&out) == ply(&alone), "the resumed run gives another scene");
    // The same in one process. The variable strikes every device that the process opens.
    let [out, spill] = ["out2", "spill2"].map(|name| folder.path().join(name));
    let output = run_with_losses(&scene, [&out, &spill], "lost@400", &[]);
    let said = stderr(&output);
    assert!(output.status.success() && said.contains("(restart 1 of at most 3)"), "{said}");
    assert!(ply(&out) == ply(&alone) && losses(&out) == losses(&alone), "the run that went on gives another scene");
    assert_eq!(summary(&out)["finished"], true);
    // Before its first commit a run with a spill directory has nothing to go on from.
    let [out, spill] = ["out3", "spill3"].map(|name| folder.path().join(name));
    let output = run_with_losses(&scene, [&out, &spill], "lost@40", &[]);
    let said = stderr(&output);
    let is_loss = |line: &str| line.starts_with("error: rendering failed") && line.contains("the device was lost");
    assert!(!output.status.success() && !said.contains("(restart 1"), "{said}");
    assert!(said.lines().any(is_loss), "{said}");
    // A run in memory begins again, three times at most.
    let out = folder.path().join("out4");
    let mut again = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
    again
        .args([text(&scene), "--out", text(&out)])
        .args(GROWING)
        .args(classic(GROWING))
        .env("GSSCALE_GPU_FAULT", "lost@40");
    let output = again.output().unwrap();
    let said = stderr(&output);
    let restarts = said.matches("the run goes on in this process").count();
    assert!(!output.status.success() && restarts == 3 && said.lines().any(is_loss), "{said}");
}

/// Steps without events, after every page has been loaded: only the photo, tables and counts cross the bus.
#[test]
fn a_step_with_all_pages_on_the_device_moves_no_row() {
    if !has_device() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 8, 128, 96, 1200);
    let [on_device, on_host] = ["device", "host"].map(|name| folder.path().join(name));
    let args = ["--steps", "60", "--strategy", "none", "--sh-every", "0", "--log-every", "1", "--device", "gpu"];
    run(&scene, &on_device, &args, &["--optimizer-on", "device"]);
    run(&scene, &on_host, &args, &["--optimizer-on", "host"]);
    let pages = summary(&on_device)["pages"].as_u64().unwrap();
    let lines = metrics(&on_device);
    for line in &lines[30..59] {
        let of = |key: &str| line[key].as_u64().unwrap();
        let (up, down) = (of("bytes_uploaded"), of("bytes_read_back"));
        assert!(up <= 4 * 128 * 96 + (128 << 10), "step {}: {up} bytes up", line["step"]);
        assert!(down <= 64 * pages + 4096, "step {}: {down} bytes down for {pages} pages", line["step"]);
    }
    // The photo, tables and lists, and nothing but the payloads that the device lacked, where it has slots for a part of the pages.
    let (few, wide) = (folder.path().join("few"), TempDir::new().unwrap());
    let of_few = ["--optimizer-on", "device", "--device-mem", "5MiB", "--page-rows", "32", "--view-order", "shuffle"];
    run(&scene_in(wide.path()), &few, &args, &of_few);
    let lines = metrics(&few);
    let loaded = |i: usize| lines[i]["slots"]["bytes_loaded"].as_u64().unwrap();
    for i in 30..59 {
        let (up, payloads) = (lines[i]["bytes_uploaded"].as_u64().unwrap(), loaded(i) - loaded(i - 1));
        assert!(
            (payloads..payloads + 4 * 48 * 36 + (128 << 10)).contains(&up),
            "step {i}: {up} of {payloads} bytes up"
        );
    }
    assert!(loaded(59) > loaded(30), "every page had a slot");
    // The host's optimizer sums small second moments in f64, and divides exactly.
    let (device, host) = (psnr(&on_device), psnr(&on_host));
    println!("test PSNR after 60 steps: {device:.3} dB on the device, {host:.3} dB on the host");
    assert!((device - host).abs() < 0.05, "{device} dB on the device, {host} dB on the host");
    assert!(host > metrics(&on_host)[0]["psnr"].as_f64().unwrap() + 1.0, "60 steps are training");
}

#[test]
fn what_a_device_does_not_do_is_refused_with_a_remedy() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 8, 64, 48, 100);
    let out = folder.path().join("out");
    let cases: &[(&[&str], &str)] = &[
        (&["--device", "cpu"], "use --device auto or gpu"),
        (&["--device", "gpu", "--moments", "bf16"], "use --moments f32"),
        (&["--device", "gpu", "--optimizer", "sparse"], "use --optimizer deferred"),
    ];
    let weighs = ["--device", "gpu", "--strategy", "long-axis", "--max-gaussians", "500", "--growth-score", "mixed"];
    let mut cases = cases.to_vec();
    if has_device() {
        // Without a device the lack of one is said first.
        cases.push((&weighs, "use --growth-score gradient, or --optimizer-on host"));
    }
    for (more, remedy) in cases {
        let args = [text(&scene), "--out", text(&out), "--steps", "3", "--optimizer-on", "device"];
        let output = train(&[&args[..], more].concat());
        let said = stderr(&output);
        assert!(!output.status.success() && said.contains("--optimizer-on device") && said.contains(remedy), "{said}");
        assert!(!out.exists());
    }
}
