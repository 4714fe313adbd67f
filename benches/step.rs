//! Time of a whole training step (acquire, cull, gather, forward, loss, backward, Adam, statistics, bounds) against its
//! floor.
//!
//! `cargo bench --bench step` measures real scenes (in `GSSCALE_DATA` or `../shared/data`) and a generated terrain.
//! Numbers set sizes, words select cases, `--path avx2` sets the instruction path, `--json` prints JSON,
//! `RAYON_NUM_THREADS` sets the threads. A test run does a few steps of a tiny terrain. The cases `touched_100_percent`
//! and `touched_65_percent` measure the gather and the optimizer alone (`support::touched`).
//!
//! Real scenes start from their points with the program's own defaults and all colour bands in use; densification is
//! off but its statistics are collected. Each repetition trains once on the same views; the figure is the median
//! repetition, by CPU seconds of all threads. Photos are decoded beforehand. The hash is over the bits of all losses:
//! the same on each machine and for any number of threads, per instruction path.
//!
//! The floor of a step is the sum of two measured parts: blending the pixel-Gaussian pairs of the view once forward and
//! once backward at the rate of a bare forward loop in registers; and moving 11 floats per parameter at the rate of a
//! plain copy (the gather reads three and writes one for every row in view, Adam reads four and writes three for every
//! row with a gradient). The backward pass has about three times the arithmetic of the forward pass, so a ratio of 1 is
//! out of reach. The floor of each part of a step is the time to move the part's bytes once on all threads;
//! compute-bound parts (the rasterizer, the loss) cannot reach it.

pub mod support;

use gsscale::base::simd::SimdPath;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{
    Gradients, LossOptions, LossValue, PictureGradient, RenderError, RenderOptions, Renderer, RowBatches,
};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Columns, row_width};
use gsscale::scene::image::{Image, Target};
use gsscale::train::step::batch::RowsInHost;
use gsscale::train::step::comparison::Comparison;
use gsscale::train::step::pages::WorkingSet;
use gsscale::train::step::train_step::{StepView, train_step};
use serde_json::json;
use std::time::{Duration, Instant};
use support::cases::{Case, PHOTO_CASES, photo_case, terrain_case};
use support::cpu_bytes::{CpuCounts, part_bytes};
use support::floor::{bare_blend_rate, copy_rate};
use support::touched::touched;
use support::{Args, Hash, Seconds, checked, machine, median, paged, time};

/// Size of a measurement.
#[derive(Clone, Copy)]
struct Effort {
    /// Warm-up rounds over the views.
    warm_up: usize,
    /// Measured rounds.
    rounds: usize,
    /// Most views of a round.
    views: usize,
}

const REAL: Effort = Effort { warm_up: 2, rounds: 5, views: 15 };
const SECOND: Duration = Duration::from_secs(1);
const TINY: Effort = Effort { warm_up: 0, rounds: 2, views: 2 };

fn main() {
    let args = Args::read();
    if !args.real {
        assert!(tiny() != 0);
        return;
    }
    let simd = args.simd();
    let floor = Floor { pairs: bare_blend_rate(simd, SECOND), bytes: copy_rate(1 << 24, SECOND) };
    if !args.json {
        println!("{}", machine(simd));
        println!("floor a thread: {:.2} Gpixel-Gaussians/s, {:.1} GB/s", floor.pairs / 1e9, floor.bytes / 1e9);
    }
    for percent in [100, 65] {
        let name = format!("touched_{percent}_percent");
        if args.wants(&name) {
            let found = touched(500_000, percent, 15, simd);
            let line =
                if args.json { found.json(&name, floor.bytes).to_string() } else { found.text(&name, floor.bytes) };
            println!("{line}");
        }
    }
    for real in &PHOTO_CASES {
        measure(&args, real.name, floor, || photo_case(real, REAL.views));
    }
    let sizes = if args.sizes.is_empty() { vec![10_000, 100_000, 1_000_000] } else { args.sizes.clone() };
    for n in sizes {
        measure(&args, &format!("terrain_640x480_{n}"), floor, || Some(terrain_case(n, 640, 480, REAL.views)));
    }
}

/// A few steps of a tiny terrain; returns the hash of its losses.
pub fn tiny() -> u64 {
    let floor =
        Floor { pairs: bare_blend_rate(SimdPath::best(), Duration::ZERO), bytes: copy_rate(1 << 10, Duration::ZERO) };
    let case = terrain_case(300, 48, 40, 2);
    let result = run(&case, SimdPath::best(), TINY, floor);
    assert!(result.cpu.wall > 0.0 && result.floor_seconds > 0.0 && result.rows > 0.0);
    // All other parts move rows, lists or pictures.
    assert!(result.parts.iter().all(|p| p.name == "acquire" || p.floor > 0.0));
    result.hash
}

fn measure(args: &Args, name: &str, floor: Floor, make: impl Fn() -> Option<Case>) {
    if !args.wants(name) {
        return;
    }
    let Some(mut case) = make() else {
        gsscale::tell!("SKIPPED {name}: no such scene; set GSSCALE_DATA to the folder that has it");
        return;
    };
    case.name = name.to_string();
    let result = run(&case, args.simd(), REAL, floor);
    if args.json {
        println!("{}", result.json(&case, args.simd()));
    } else {
        result.print(&case);
    }
}

/// Rates of this machine, per second of CPU time and thread.
#[derive(Clone, Copy)]
struct Floor {
    pairs: f64,
    bytes: f64,
}

/// A part of a step: its time, and the time to move its bytes on all threads.
struct Part {
    name: &'static str,
    wall: f64,
    bytes: f64,
    floor: f64,
}

/// Figures of a case, per step.
struct StepResult {
    cpu: Seconds,
    /// Fastest and slowest round, CPU seconds per step.
    spread: [f64; 2],
    floor_seconds: f64,
    rows: f64,
    updated: f64,
    pairs: f64,
    isects: f64,
    parts: Vec<Part>,
    hash: u64,
}

fn run(case: &Case, simd: SimdPath, effort: Effort, floor: Floor) -> StepResult {
    let (mut scene, options) = paged(&case.columns, case.scene_scale, simd);
    let mut working = WorkingSet::default();
    let mut renderer = Watched::default();
    let stride = case.views.len().div_ceil(effort.views);
    let views: Vec<&(Camera, Target)> = case.views.iter().step_by(stride).collect();
    let (mut step, mut hash, mut rounds) = (0, Hash::default(), Vec::new());
    let mut counts = [0.0; 6];
    for round in 0..effort.warm_up + effort.rounds {
        if round == effort.warm_up {
            (renderer.parts, counts) = (Vec::new(), [0.0; 6]);
        }
        rounds.push(time(|| {
            for (camera, target) in &views {
                renderer.begin = Some(Instant::now());
                let (rows, comparison) =
                    (&mut RowsInHost::new(&mut renderer), &mut Comparison::new(target, options.loss));
                let view = StepView { step, camera, render: &options.render, collects: true, pages_most: usize::MAX };
                let outcome = checked(train_step(&mut scene, &mut working, rows, &view, comparison));
                renderer.note_end();
                let stats = renderer.inner.stats();
                let (pinned, rows) = (outcome.rows_pinned as f64, outcome.rows as f64);
                let (updated, pixels) = (outcome.updated as f64, camera.pixels() as f64);
                let of_step = [rows, updated, stats.evaluated as f64, stats.isects as f64, pinned, pixels];
                counts.iter_mut().zip(of_step).for_each(|(sum, x)| *sum += x);
                hash.add(outcome.loss.loss.to_bits());
                step += 1;
            }
        }));
    }
    let n = views.len() as f64;
    let cpu: Vec<f64> = rounds[effort.warm_up..].iter().map(|s| s.cpu / n).collect();
    let wall = median(rounds[effort.warm_up..].iter().map(|s| s.wall / n));
    let steps = n * effort.rounds as f64;
    let [rows, updated, pairs, isects, pinned, pixels] = counts.map(|c| c / steps);
    let counts = CpuCounts { pinned, rows, updated, isects, pixels };
    let rate = floor.bytes * rayon::current_num_threads() as f64;
    let parts = renderer.parts.iter().map(|&(name, seconds)| {
        let bytes = part_bytes(name, &counts);
        Part { name, wall: seconds / steps, bytes, floor: bytes / rate }
    });
    let parts = parts.collect();
    let bytes = 4.0 * row_width(case.columns.sh_degree) as f64 * (4.0 * rows + 7.0 * updated);
    StepResult {
        cpu: Seconds { wall, cpu: median(cpu.iter().copied()) },
        spread: [cpu.iter().copied().fold(f64::INFINITY, f64::min), cpu.iter().copied().fold(0.0, f64::max)],
        floor_seconds: 2.0 * pairs / floor.pairs + bytes / floor.bytes,
        rows,
        updated,
        pairs,
        isects,
        parts,
        hash: hash.0,
    }
}

impl StepResult {
    fn print(&self, case: &Case) {
        println!(
            "{}: {} Gaussians, {:.0} in view, {:.0} updated, {:.0} intersections, {:.0} evaluated per pixel",
            case.name,
            case.columns.rows(),
            self.rows,
            self.updated,
            self.isects,
            self.pairs / case.views[0].0.pixels() as f64
        );
        println!(
            "  step {:.2} ms CPU ({:.2} to {:.2}), {:.2} ms wall; floor {:.2} ms CPU, ratio {:.2}; losses {:016x}",
            1e3 * self.cpu.cpu,
            1e3 * self.spread[0],
            1e3 * self.spread[1],
            1e3 * self.cpu.wall,
            1e3 * self.floor_seconds,
            self.cpu.cpu / self.floor_seconds,
            self.hash
        );
        if let Some(peer) = &case.peer {
            let factor = peer.opensplat / self.cpu.cpu;
            let wanted = peer.target.map_or(String::new(), |t| {
                format!("; wanted {t:.0} ({}), stretch 10", if factor >= t { "reached" } else { "missed" })
            });
            println!("  OpenSplat {:.0} ms CPU on a Zen 5: {factor:.1} times ours{wanted}", 1e3 * peer.opensplat);
        }
        println!("  {:<22} {:>9} {:>9} {:>9} {:>7}", "part", "wall ms", "MB moved", "floor ms", "ratio");
        let row = |name: &str, wall: f64, bytes: f64, floor: f64| {
            let ratio = if floor > 0.0 { format!("{:.1}", wall / floor) } else { "-".to_string() };
            println!("  {name:<22} {:>9.2} {:>9.2} {:>9.3} {ratio:>7}", 1e3 * wall, bytes / 1e6, 1e3 * floor);
        };
        self.parts.iter().for_each(|p| row(p.name, p.wall, p.bytes, p.floor));
        let sum = |of: fn(&Part) -> f64| self.parts.iter().map(of).sum::<f64>();
        row("all", sum(|p| p.wall), sum(|p| p.bytes), sum(|p| p.floor));
    }

    fn json(&self, case: &Case, simd: SimdPath) -> serde_json::Value {
        let part = |p: &Part| {
            (p.name.to_string(), json!({ "wall_seconds": p.wall, "bytes": p.bytes, "floor_seconds": p.floor }))
        };
        json!({
            "case": case.name, "gaussians": case.columns.rows(), "rows": self.rows, "updated": self.updated,
            "isects": self.isects, "pairs": self.pairs, "cpu_seconds": self.cpu.cpu, "wall_seconds": self.cpu.wall,
            "cpu_seconds_least": self.spread[0], "cpu_seconds_most": self.spread[1],
            "floor_cpu_seconds": self.floor_seconds, "ratio_to_floor": self.cpu.cpu / self.floor_seconds,
            "peer_cpu_seconds": case.peer.as_ref().map(|p| p.opensplat),
            "times_faster": case.peer.as_ref().map(|p| p.opensplat / self.cpu.cpu),
            "target": case.peer.as_ref().and_then(|p| p.target),
            "stages": self.parts.iter().map(part).collect::<serde_json::Map<_, _>>(),
            "losses": format!("{:016x}", self.hash), "path": simd.name(),
            "threads": rayon::current_num_threads(), "machine": machine(simd),
        })
    }
}

/// The CPU renderer with timestamps of its stages.
#[derive(Default)]
struct Watched {
    inner: CpuRenderer,
    begin: Option<Instant>,
    /// When the renderer handed back to the gather of the next batch.
    before_gather: Option<Instant>,
    rows_out: Option<Instant>,
    parts: Vec<(&'static str, f64)>,
}

impl Watched {
    fn add(&mut self, name: &'static str, seconds: f64) {
        match self.parts.iter_mut().find(|(n, _)| *n == name) {
            Some((_, sum)) => *sum += seconds,
            None => self.parts.push((name, seconds)),
        }
    }

    /// Notes the end of the step: the time since the renderer belongs to the optimizer.
    fn note_end(&mut self) {
        let optimizer = self.rows_out.map_or(0.0, |t| t.elapsed().as_secs_f64());
        let stages: Vec<(&'static str, f64)> = self.inner.stage_seconds().collect();
        for (name, seconds) in stages {
            if seconds > 0.0 {
                self.add(name, seconds);
            }
        }
        self.add("adam+statistics+bounds", optimizer);
    }
}

impl Renderer for Watched {
    fn name(&self) -> &'static str {
        "watched"
    }

    fn host_bytes(&self) -> u64 {
        self.inner.host_bytes()
    }

    fn set_list_bytes(&mut self, bytes: Option<u64>) {
        self.inner.set_list_bytes(bytes);
    }

    fn weigh_rows(&mut self, is_wanted: bool) -> Result<(), RenderError> {
        self.inner.weigh_rows(is_wanted)
    }

    fn begin_view(&mut self, camera: &Camera, options: &RenderOptions, batches: RowBatches) -> Result<(), RenderError> {
        let before = self.begin.map_or(0.0, |t| t.elapsed().as_secs_f64());
        self.add("acquire", before);
        let done = self.inner.begin_view(camera, options, batches);
        self.before_gather = Some(Instant::now());
        done
    }

    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError> {
        let gathered = self.before_gather.map_or(0.0, |t| t.elapsed().as_secs_f64());
        self.add("cull+gather", gathered);
        let done = self.inner.rows_in(rows);
        self.before_gather = Some(Instant::now());
        done
    }

    fn picture(&mut self) -> Result<(), RenderError> {
        self.inner.picture()
    }

    fn image(&mut self) -> Result<&Image, RenderError> {
        self.inner.image()
    }

    fn picture_mut(&mut self) -> Result<&mut [f32], RenderError> {
        self.inner.picture_mut()
    }

    fn loss(&mut self, target: &Target, options: &LossOptions) -> Result<(), RenderError> {
        self.inner.loss(target, options)
    }

    fn picture_gradient(&mut self) -> Result<&mut PictureGradient, RenderError> {
        self.inner.picture_gradient()
    }

    fn picture_back(&mut self) -> Result<(), RenderError> {
        self.inner.picture_back()
    }

    fn rows_out(&mut self, batch: usize, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError> {
        let done = self.inner.rows_out(batch, rows, grads);
        self.rows_out = Some(Instant::now());
        done
    }

    fn unusable_splats(&mut self) -> Result<u64, RenderError> {
        self.inner.unusable_splats()
    }

    fn loss_value(&mut self) -> Result<LossValue, RenderError> {
        self.inner.loss_value()
    }
}
