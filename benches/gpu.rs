//! Time of a whole training step on a device, and of each stage against its memory floor.
//!
//! `cargo bench --bench gpu` measures the best adapter (a software adapter if there is no other) on real scenes (in
//! `GSSCALE_DATA` or `../shared/data`) and on a generated terrain, and the CPU renderer on the same steps. Words select
//! cases, numbers set the sizes of the terrain, `--json` prints JSON. A test run does two steps of a tiny terrain.
//!
//! Whole steps are timed without stage timestamps. The stages are timed by the device in a second run, with a pass for
//! each stage. The floor of a stage is its bytes (one read of every input including gathers, one write of every output)
//! divided by the rate of a large buffer copy. Compute-bound stages (both directions of the rasterizer, the loss)
//! cannot reach the floor; the ratio shows how far they are from being memory-bound.
//!
//! CPU seconds of a step count all threads, which includes the device's work on a software adapter.

pub mod support;

use gsscale::base::simd::SimdPath;
use gsscale::gpu::{DeviceChoice, Gpu, GpuOptions, GpuResult};
use gsscale::render::Renderer;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::gpu::GpuRenderer;
use gsscale::scene::camera::Camera;
use gsscale::scene::image::Target;
use gsscale::train::step::batch::RowsInHost;
use gsscale::train::step::comparison::Comparison;
use gsscale::train::step::pages::WorkingSet;
use gsscale::train::step::train_step::{StepView, train_step};
use serde_json::{Map, json};
use std::time::Instant;
use support::cases::{Case, PHOTO_CASES, photo_case, terrain_case};
use support::device_bytes::{Counts, stage_bytes};
use support::{Args, Hash, Seconds, checked, machine, paged, time};

/// Views of a round.
const VIEWS: usize = 8;
/// Warm-up rounds and measured rounds.
const ROUNDS: [usize; 2] = [1, 2];
/// Default sizes of the terrain.
const TERRAINS: [usize; 2] = [100_000, 1_000_000];
/// Bytes of the copy that measures the device's rate.
const COPY_BYTES: u64 = 64 << 20;

fn main() {
    let args = Args::read();
    if !args.real {
        assert!(tiny().is_none_or(|hash| hash != 0));
        return;
    }
    let Ok(gpu) = Gpu::open_with(&DeviceChoice::Gpu, &GpuOptions::default()) else {
        gsscale::tell!("SKIPPED: there is no usable GPU adapter; mesa-vulkan-drivers has a software one");
        return;
    };
    let rate = checked(copy_rate(&gpu, COPY_BYTES, 12));
    if !args.json {
        println!("{}\n{}: copies {:.1} GB/s, read and written", machine(args.simd()), gpu.summary(), rate / 1e9);
    }
    drop(gpu);
    for real in PHOTO_CASES.iter().filter(|c| args.wants(c.name)) {
        match photo_case(real, VIEWS) {
            Some(case) => measure(&args, &case, rate),
            None => gsscale::tell!("SKIPPED {}: no such scene; set GSSCALE_DATA to the folder that has it", real.name),
        }
    }
    let sizes = if args.sizes.is_empty() { TERRAINS.to_vec() } else { args.sizes.clone() };
    for n in sizes {
        let name = format!("terrain_640x480_{n}");
        if args.wants(&name) {
            measure(&args, &Case { name, ..terrain_case(n, 640, 480, VIEWS) }, rate);
        }
    }
}

/// Two steps of a tiny terrain; returns the hash of the losses, or `None` without a device.
pub fn tiny() -> Option<u64> {
    let gpu = Gpu::open_with(&DeviceChoice::Gpu, &GpuOptions { profile: true, ..GpuOptions::default() }).ok()?;
    assert!(checked(copy_rate(&gpu, 4096, 1)) > 0.0);
    let case = terrain_case(300, 48, 40, 2);
    let mut renderer = checked(GpuRenderer::new(gpu));
    let run = steps(&case, SimdPath::best(), &mut renderer, [0, 1], |r| u64::from(r.isects()));
    let stages = stages(&mut renderer, &run, 1.0, run.steps);
    let timed = renderer.gpu().summary().timestamps;
    assert!(!timed || stages.iter().any(|s| s.name == "rasterize_bwd" && s.seconds > 0.0 && s.floor > 0.0));
    Some(run.hash)
}

/// Bytes read and written per second by buffer copies: the best of `runs` runs.
fn copy_rate(gpu: &Gpu, bytes: u64, runs: usize) -> GpuResult<f64> {
    let (from, to) = (gpu.buffer("copied", bytes)?, gpu.buffer("copy", bytes)?);
    let mut best = f64::INFINITY;
    for _ in 0..runs {
        let mut recorder = gpu.begin("copy");
        recorder.copy(&from.view(), &to.view())?;
        let begin = Instant::now();
        let submission = gpu.submit(recorder)?;
        gpu.wait(&submission)?;
        best = best.min(begin.elapsed().as_secs_f64());
    }
    Ok(2.0 * bytes as f64 / best)
}

/// Mean figures of a step.
struct Run {
    time: Seconds,
    counts: Counts,
    steps: f64,
    hash: u64,
}

/// Trains from the start of the case: `warm` warm-up rounds, then `rounds` measured rounds.
fn steps<R: Renderer>(
    case: &Case,
    simd: SimdPath,
    renderer: &mut R,
    [warm, rounds]: [usize; 2],
    isects: impl Fn(&R) -> u64,
) -> Run {
    let (mut scene, options) = paged(&case.columns, case.scene_scale, simd);
    let mut working = WorkingSet::default();
    let stride = case.views.len().div_ceil(VIEWS);
    let views: Vec<&(Camera, Target)> = case.views.iter().step_by(stride).collect();
    let (mut step, mut hash, mut counts, mut counted) = (0, Hash::default(), Counts::default(), false);
    let mut round = |counted: bool| {
        for (camera, target) in &views {
            let (rows, comparison) = (&mut RowsInHost::new(renderer), &mut Comparison::new(target, options.loss));
            let view = StepView { step, camera, render: &options.render, collects: false, pages_most: usize::MAX };
            let outcome = checked(train_step(&mut scene, &mut working, rows, &view, comparison));
            hash.add(outcome.loss.loss.to_bits());
            step += 1;
            if counted {
                counts.add(outcome.rows as u64, isects(renderer), camera);
            }
        }
    };
    (0..warm).for_each(|_| round(counted));
    counted = true;
    let whole = time(|| (0..rounds).for_each(|_| round(counted)));
    let steps = (rounds * views.len()) as f64;
    counts.divide(steps);
    Run { time: Seconds { wall: whole.wall / steps, cpu: whole.cpu / steps }, counts, steps, hash: hash.0 }
}

/// Mean time and floor of a stage in a step, seconds.
struct StageResult {
    name: &'static str,
    seconds: f64,
    bytes: f64,
    floor: f64,
}

/// The stages that the device timed over `timed` steps, with the bytes of a mean step.
fn stages(renderer: &mut GpuRenderer, run: &Run, rate: f64, timed: f64) -> Vec<StageResult> {
    let times = checked(renderer.gpu().stage_times());
    let of = |t: &gsscale::gpu::StageTime| {
        let bytes = stage_bytes(t.stage, &run.counts);
        StageResult { name: t.stage, seconds: t.seconds / timed, bytes, floor: bytes / rate }
    };
    times.iter().map(of).collect()
}

fn measure(args: &Args, case: &Case, rate: f64) {
    let simd = args.simd();
    let open = |profile| {
        let gpu = Gpu::open_with(&DeviceChoice::Gpu, &GpuOptions { profile, ..GpuOptions::default() });
        checked(gpu.and_then(GpuRenderer::new))
    };
    let on_cpu = steps(case, simd, &mut CpuRenderer::new(), ROUNDS, |r| r.stats().isects);
    let mut renderer = open(false);
    let on_gpu = steps(case, simd, &mut renderer, ROUNDS, |r| u64::from(r.isects()));
    let traffic = renderer.traffic();
    drop(renderer);
    let mut renderer = open(true);
    let profiled = steps(case, simd, &mut renderer, [0, ROUNDS[1]], |r| u64::from(r.isects()));
    let stages = stages(&mut renderer, &profiled, rate, profiled.steps);
    let all = on_gpu.steps * (ROUNDS[0] + ROUNDS[1]) as f64 / ROUNDS[1] as f64;
    let bus = (traffic.bytes_uploaded + traffic.bytes_read_back) as f64 / all;
    if args.json {
        print_json(case, simd, (&on_cpu, &on_gpu), &stages, bus);
    } else {
        print_text(case, (&on_cpu, &on_gpu), &stages, bus);
    }
}

fn print_text(case: &Case, (on_cpu, on_gpu): (&Run, &Run), stages: &[StageResult], bus: f64) {
    let Counts { rows, isects, .. } = on_gpu.counts;
    println!("{}: {} Gaussians, {rows:.0} in view, {isects:.0} intersections", case.name, case.columns.rows());
    for (name, run) in [("CPU renderer", on_cpu), ("device", on_gpu)] {
        println!("  {name}: step {:.1} ms CPU, {:.1} ms wall", 1e3 * run.time.cpu, 1e3 * run.time.wall);
    }
    if let Some(peer) = case.peer {
        let times = |theirs: f64, ours: &Run| theirs / ours.time.cpu;
        let (brush, opensplat) = (times(peer.brush, on_gpu), times(peer.opensplat, on_cpu));
        let word = if brush >= 3.0 { "reached" } else { "missed" };
        println!(
            "  Brush on lavapipe {:.0} ms CPU on a Zen 5: {brush:.1} times the device's (wanted 3: {word}); OpenSplat {:.0} \
             ms: {opensplat:.1} times the CPU renderer's",
            1e3 * peer.brush,
            1e3 * peer.opensplat,
        );
    }
    println!("  {:<14} {:>9} {:>9} {:>9} {:>7}", "stage", "wall ms", "MB moved", "floor ms", "ratio");
    let row = |name: &str, seconds: f64, bytes: f64, floor: f64| {
        let ratio = seconds / floor.max(1e-12);
        println!("  {name:<14} {:>9.2} {:>9.2} {:>9.3} {ratio:>7.1}", 1e3 * seconds, bytes / 1e6, 1e3 * floor);
    };
    stages.iter().for_each(|s| row(s.name, s.seconds, s.bytes, s.floor));
    let sum = |of: fn(&StageResult) -> f64| stages.iter().map(of).sum::<f64>();
    row("all", sum(|s| s.seconds), sum(|s| s.bytes), sum(|s| s.floor));
    let host = on_gpu.time.wall - sum(|s| s.seconds);
    println!("  bus {:.1} MB a step; host and waiting {:.1} ms wall", bus / 1e6, 1e3 * host);
}

fn print_json(case: &Case, simd: SimdPath, (on_cpu, on_gpu): (&Run, &Run), stages: &[StageResult], bus: f64) {
    let stage = |s: &StageResult| {
        (s.name.to_string(), json!({ "wall_seconds": s.seconds, "bytes": s.bytes, "floor_seconds": s.floor }))
    };
    let line = json!({
        "case": case.name, "gaussians": case.columns.rows(), "rows": on_gpu.counts.rows, "isects": on_gpu.counts.isects,
        "cpu_renderer": { "cpu_seconds": on_cpu.time.cpu, "wall_seconds": on_cpu.time.wall },
        "device": { "cpu_seconds": on_gpu.time.cpu, "wall_seconds": on_gpu.time.wall },
        "stages": stages.iter().map(stage).collect::<Map<_, _>>(), "bus_bytes": bus,
        "brush_cpu_seconds": case.peer.map(|p| p.brush), "opensplat_cpu_seconds": case.peer.map(|p| p.opensplat),
        "losses": format!("{:016x}", on_gpu.hash), "machine": machine(simd),
    });
    println!("{line}");
}
