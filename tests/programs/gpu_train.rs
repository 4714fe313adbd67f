//! Whole runs on a GPU through the real binary: quality equal to the CPU renderer, bytes that cross the bus, and the
//! choice of device with its reason.

use crate::support::a_device;
use crate::support::gpu;
use crate::support::scenes::{stderr, told};
use crate::support::workdir::{EVAL, TRAIN, Workdir, says};
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::densify::strategy::StrategyName;
use gsscale::gpu::GpuOptions;
use gsscale::kernels::stages::STAGES;
use gsscale::render::Traffic;
use gsscale::render::gpu::GpuRenderer;
use gsscale::scene::columns::Column;
use gsscale::train::start::first_scene::{Prepared, prepare};
use gsscale::train::state::trainer::Trainer;
use std::path::{Path, PathBuf};
use std::process::Command;

const SHORT: &str = "--steps 60 --strategy none --sh-every 20 --log-every 1";

fn run(work: &Workdir, out: &str, more: &str) -> String {
    work.train(&format!("scene --out {out} {SHORT} {more}"))
}

#[test]
fn a_gpu_trains_as_the_cpu_does() {
    let Some(device) = gpu::open(&GpuOptions::default()) else { return };
    let work = Workdir::city(16, 128, 96, 1200);
    run(&work, "cpu", "--device cpu");
    let said = run(&work, "gpu", "--device gpu");
    // Plans fold at 80 columns.
    let words = said.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words.contains(&device.summary().name), "{said}");
    let resolved = work.text("gpu/config.toml");
    assert!(resolved.contains(&device.summary().name), "{resolved}");
    // Rounding differences grow with every step, in both directions. Growth would multiply them: `gpu_quality`.
    let (want, got) = (work.psnr("cpu"), work.psnr("gpu"));
    println!("test PSNR after 60 steps: {want:.3} dB on the CPU, {got:.3} dB on the GPU");
    assert!((want - got).abs() < 0.05, "{got} dB, on the CPU {want} dB");
    assert!(want > work.metrics("cpu")[0]["psnr"].as_f64().unwrap() + 1.0, "60 steps are training");
    for line in work.metrics("gpu") {
        for key in ["bytes_uploaded", "bytes_read_back", "device_bytes_peak"] {
            assert!(line[key].as_u64().unwrap() > 0, "{key}: {line}");
        }
        // Upper bound: all rows of 59 floats with 16 bytes for densification, a photo of 4 bytes a pixel, and 64 KiB of
        // counts and uniforms.
        let most = 1200 * (59 * 4 + 16) + 128 * 96 * 4 + (64 << 10);
        assert!(line["bytes_uploaded"].as_u64().unwrap() < most && line["bytes_read_back"].as_u64().unwrap() < most);
    }
    for line in work.metrics("cpu") {
        assert_eq!((&line["bytes_uploaded"], &line["device_bytes_peak"]), (&0.into(), &0.into()));
    }
    // The same command gives the same file.
    for device in ["gpu", "cpu"] {
        run(&work, "again", &format!("--overwrite --device {device}"));
        assert!(work.ply(device) == work.ply("again"), "two runs of the same command differ: {device}");
    }
    // The PLY alone gives the run's metrics, on the device that its config names.
    work.json_of(EVAL, "gpu scene");
}

#[test]
fn little_device_memory_trains_the_same_scene() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(8, 128, 96, 400);
    run(&work, "plenty", "--device gpu");
    run(&work, "little", "--device gpu --device-mem 1500KiB");
    assert!(work.ply("plenty") == work.ply("little"), "a budget of device memory gives another scene");
    let [plenty, little] = ["plenty", "little"].map(|out| *work.logged(out, "device_bytes_peak").last().unwrap());
    assert!(little <= 1500 << 10 && plenty > 4 << 20, "{little} {plenty}");
    // The pictures alone need more than 200 KiB.
    let flags = format!("scene --out none {SHORT} --device gpu --device-mem 200KiB");
    let said = work.refuses(&flags, &["--device-mem: 200 KiB is not enough", "give at least"]);
    assert!(!work.exists("none/point_cloud.ply"), "nothing was trained");
    // The least that the message names is enough.
    let (_, least) = said.split_once("give at least ").unwrap();
    let least = least.split_once(',').unwrap().0.replace(' ', "");
    run(&work, "none", &format!("--device gpu --device-mem {least}"));
    assert!(work.ply("plenty") == work.ply("none"), "{least} give another scene");
}

/// Runs the real binary with a device fault in mid-run (see `GSSCALE_GPU_FAULT`), under a limit of the address space if
/// one is given, KiB. Asserts that the error names the stage, that the exit code is not 0, and that the last good step
/// is written. Returns the error's line.
fn assert_ends_with_last_good_step(work: &Workdir, fault: &str, address_space: Option<u64>) -> String {
    let limit = address_space.map_or("-v unlimited".to_string(), |kib| format!("-v {kib}"));
    let flags = "scene --out out --overwrite --device gpu --steps 200 --strategy none --restarts 0";
    let output = work.limited(&limit, flags).env("GSSCALE_GPU_FAULT", fault).output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{fault}: {said}");
    let line = said.lines().rev().find(|l| l.starts_with("error: ")).unwrap_or_else(|| panic!("{fault}: {said}"));
    // The stage whose results the run waited for, or the submitted part of the step. Where the run judges a photo, that part is a picture.
    let stage = line.split(": ").nth(2).unwrap_or_default();
    let is_stage = STAGES.contains(&stage) || ["forward", "backward", "picture"].contains(&stage);
    assert!(is_stage, "{fault}: {line}");
    let summary = work.summary("out");
    let steps = summary["steps"].as_u64().unwrap();
    assert!(summary["finished"] == false && steps > 10 && steps < 100, "{fault}: {summary}");
    let ply = work.ply("out");
    assert!(ply.starts_with(b"ply") && ply.len() > 300 * 59 * 4, "{fault}: {} bytes", ply.len());
    line.to_string()
}

#[test]
fn a_device_that_fails_in_mid_run_leaves_the_last_good_step() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(8, 64, 48, 300);
    let cases = [
        ("lost", "the device was lost"),
        ("given-up", "gave up work without an error"),
        ("validation", "refused the work"),
        ("memory", "out of memory"),
    ];
    for (kind, expected) in cases {
        // Five submissions a step; the memory estimate renders some views before the first.
        let line = assert_ends_with_last_good_step(&work, &format!("{kind}@150"), None);
        assert!(line.contains(expected), "{kind}: {line}");
    }
}

/// Nothing is committed on a schedule here, so the run resumes from the commit that the failure makes.
#[test]
fn a_run_whose_device_is_lost_resumes_from_its_last_good_step() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(8, 64, 48, 300);
    let of_run = "--device gpu --steps 60 --strategy none --view-order shuffle";
    work.run("alone", of_run);
    for kind in ["lost", "given-up"] {
        let drive = format!("--spill-dir spill-{kind} --spill-codec raw --commit-every 0 --restarts 0");
        let mut run = work.command(TRAIN, &format!("scene --out {kind} --quiet {of_run} {drive}"));
        let output = run.env("GSSCALE_GPU_FAULT", format!("{kind}@150")).output().unwrap();
        assert!(stderr(&output).contains("the device was lost"), "{}", stderr(&output));
        let steps = work.count(kind, "steps");
        assert!(steps > 10 && steps < 60, "{steps} steps before the loss");
        work.train(&format!("--resume {kind} --log-every 1"));
        let first = work.logged(kind, "step").into_iter().filter(|&step| step > steps).min();
        assert_eq!(first, Some(steps + 1), "steps before the loss were trained again, or the run began anew");
        assert!(work.ply(kind) == work.ply("alone"), "the resumed run gives another scene");
    }
}

/// A library between programs and the driver that has faults of drivers of hardware (tests/support/device_faults.c).
#[cfg(target_os = "linux")]
fn device_faults(work: &Workdir) -> PathBuf {
    let library = work.path("device_faults.so");
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/device_faults.c");
    let compiled = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).args([source, "-ldl"]).status();
    assert!(compiled.unwrap().success());
    library
}

/// The pages exceed a device whose limit nobody states: those that it can hold leave room for views.
#[test]
#[cfg(target_os = "linux")]
fn a_device_that_the_pages_exceed_trains() {
    let Some(device) = gpu::open(&GpuOptions::default()) else { return };
    if device.summary().kind != gsscale::gpu::DeviceKind::Software {
        println!("skipped: the blocks of a driver of hardware are larger than this test allows");
        return;
    }
    drop(device);
    let work = Workdir::city_of(12, [64, 48], 150_000, 6);
    let flags = "scene --out out --quiet --device gpu --optimizer-on device --steps 4 --strategy none --test-every 0";
    let mut run = work.command(TRAIN, flags);
    run.env("LD_PRELOAD", device_faults(&work)).env("GSSCALE_MEMORY_MOST", (128 << 20).to_string());
    let output = run.output().unwrap();
    assert!(output.status.success() && stderr(&output).contains("a block of memory is refused"), "{}", told(&output));
}

/// The driver itself reports the loss.
#[test]
#[cfg(target_os = "linux")]
fn a_loss_that_the_driver_reports_is_committed_and_restarted() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(8, 64, 48, 300);
    let of_run = "--device gpu --steps 60 --strategy none --view-order shuffle";
    work.run("alone", of_run);
    let library = device_faults(&work);
    for place in ["", "--spill-dir spill --spill-codec raw"] {
        let flags = format!("scene --out lost --overwrite --quiet {of_run} {place} --commit-every 0");
        let mut run = work.command(TRAIN, &flags);
        let output = run.env("LD_PRELOAD", &library).env("GSSCALE_LOST_AT", "90").output().unwrap();
        let said = stderr(&output);
        assert!(output.status.success(), "{said}");
        says(&said, &["is answered with its loss", "the device was lost", "(restart 1 of at most 3)"]);
        assert!(!said.contains("panicked"), "{said}");
        assert!(work.ply("lost") == work.ply("alone"), "{place}: the scene is another");
    }
}

/// The real thing: the driver is asked for memory until it refuses. A software adapter takes the program's own memory, so
/// there the address space is limited to 6 GiB (the program needs about one): it refuses the driver, whose requests are
/// large, long before the program's own small ones. Without filling on purpose this cannot be had there: in a run that
/// grows into such a limit the program's own requests, which cannot be refused, come first as often as the driver's.
#[test]
#[cfg(target_os = "linux")]
fn a_device_without_memory_left_leaves_the_last_good_step() {
    let Some(device) = gpu::open(&GpuOptions::default()) else { return };
    let is_software = device.summary().kind == gsscale::gpu::DeviceKind::Software;
    drop(device);
    let work = Workdir::city(8, 64, 48, 300);
    let line = assert_ends_with_last_good_step(&work, "full@150", is_software.then_some(6 << 20));
    assert!(line.contains("the device is out of memory") && !line.contains("injected"), "{line}");
}

/// Uploads and allocations of the third and fourth step, on a scene `times` as large whose other rows no camera sees.
fn steps_of_a_scene(scene: &Path, times: usize) -> Option<(Vec<usize>, Traffic, Traffic)> {
    let renderer = GpuRenderer::new(gpu::open(&GpuOptions::default())?).unwrap();
    let config = TrainConfig { steps: 10, strategy: StrategyName::None, ..TrainConfig::default() };
    let Prepared { dataset, mut columns, .. } = prepare(scene, &config).unwrap();
    let rows = columns.rows();
    // Opposite to the viewing directions: all cameras look down on the city.
    let away: Vec<f32> = (0..3).map(|i| dataset.views.iter().map(|v| -v.camera.viewmat[2][i]).sum::<f32>()).collect();
    let small = columns.clone();
    columns.resize(times * rows);
    for column in Column::ALL {
        let copies = small.column(column).repeat(times);
        columns.column_mut(column).copy_from_slice(&copies);
    }
    for (i, x) in columns.means.iter_mut().enumerate().skip(3 * rows) {
        *x += 100.0 * dataset.scene_scale * away[i % 3];
    }
    let mut trainer =
        Trainer::new(columns, &dataset, Box::new(renderer), RunOptions::new(&config, dataset.scene_scale)).unwrap();
    let targets = TargetCache::new(&dataset.views, 1 << 30, 1).unwrap();
    let step = |trainer: &mut Trainer| trainer.step(&dataset, &targets).unwrap().rows;
    let mut seen = vec![step(&mut trainer), step(&mut trainer)];
    let before = trainer.renderer.traffic();
    seen.extend([step(&mut trainer), step(&mut trainer)]);
    Some((seen, before, trainer.renderer.traffic()))
}

#[test]
fn what_no_camera_sees_costs_the_device_nothing() {
    let work = Workdir::city(8, 128, 96, 1500);
    let scene = work.scene();
    let (Some(small), Some(large)) = (steps_of_a_scene(&scene, 1), steps_of_a_scene(&scene, 10)) else { return };
    assert!(small.0.iter().all(|&rows| rows > 100), "{:?}", small.0);
    assert_eq!(small.0, large.0, "both see the same rows");
    assert_eq!(small.1, large.1, "before the steps");
    assert_eq!(small.2, large.2, "after the steps");
    assert!(small.2.bytes_uploaded > small.1.bytes_uploaded);
}

#[test]
fn devices_are_listed_and_an_unknown_one_is_refused() {
    let work = Workdir::city(8, 64, 48, 200);
    let output = work.output(TRAIN, "--list-devices");
    let listed = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && listed.ends_with("cpu: the CPU renderer\n"), "{listed}");
    if let Some(device) = gpu::open(&GpuOptions::default()) {
        assert!(listed.contains(&device.summary().to_string()), "{listed}");
    }
    let output = work.command(TRAIN, "scene --out run").args(["--device", "no such device"]).output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(["--device", "'no such device'", "--list-devices"].iter().all(|word| said.contains(word)), "{said}");
    assert!(!work.exists("run"), "bad input leaves nothing behind");
    // `auto` never takes a software adapter.
    let said = told(&work.succeeds(TRAIN, "scene --dry-run"));
    let has_hardware = gsscale::gpu::list_adapters()
        .iter()
        .any(|a| a.kind != gsscale::gpu::DeviceKind::Software && a.refusal.is_none());
    assert_eq!(said.contains("there is no hardware GPU: the CPU renders"), !has_hardware, "{said}");
    assert_eq!(said.contains("rendered by cpu"), !has_hardware, "{said}");
}
