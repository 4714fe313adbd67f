//! Speed of the CPU renderer beside its floor.
//!
//! `cargo bench --bench render` runs one tiny size, so that the program cannot rot;
//! `cargo bench --bench render -- 10000 100000 1000000` measures those numbers of Gaussians (`--path avx2` picks the
//! instruction path, `RAYON_NUM_THREADS` the threads).
//!
//! Rates are per second of CPU time and thread where the system tells it (Linux), so that other programs on the
//! machine disturb them little; else per second of wall time.
//!
//! The floor of blending is a bare loop over splats that stay in the first cache level: no lists, no early stops, no
//! edges, all pixels of a tile. A ratio of 1 means that only blending takes time. `nominal` counts every pixel of the
//! tiles that a row can reach, `evaluated` only the pixel rows that are blended.

use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::{Kernel, LANES, SimdPath, dispatch, fma};
use gsscale::kernels::rasterize_fwd::exp2_bounded;
use gsscale::kernels::splats::LOG2_ALPHA_MIN;
use gsscale::kernels::stages::STAGES;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{Gradients, RenderOptions};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;
use rayon::prelude::*;
use std::time::{Duration, Instant};

fn main() {
    let mut sizes = Vec::new();
    let mut simd = SimdPath::best();
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        if let Ok(n) = arg.parse::<usize>() {
            sizes.push(n);
        } else if arg == "--path" {
            simd = args.next().and_then(|name| SimdPath::from_name(&name)).unwrap_or(simd);
        }
    }
    let real = !sizes.is_empty();
    if !real {
        sizes.push(500);
    }
    let (width, height) = if real { (960, 540) } else { (64, 48) };
    let floor = floor_rate(simd, if real { 400 } else { 1 });
    println!("path {}, {} threads, {width}x{height}", simd.name(), rayon::current_num_threads());
    println!("floor: {:.2} Gpixel-Gaussians/s a thread (bare blend loop)", floor / 1e9);
    for n in sizes {
        measure(n, width, height, simd, floor, if real { Duration::from_secs(2) } else { Duration::ZERO });
    }
}

/// Wall and CPU seconds of one run.
#[derive(Clone, Copy)]
struct Seconds {
    wall: f64,
    cpu: f64,
}

/// CPU seconds of all threads of this program so far.
fn cpu_seconds() -> Option<f64> {
    let tasks = std::fs::read_dir("/proc/self/task").ok()?;
    let nanos = tasks.map(|task| {
        let text = std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<u64>().ok()
    });
    Some(nanos.sum::<Option<u64>>()? as f64 * 1e-9)
}

/// The least of at least three runs and `least` of time, by CPU.
fn seconds(least: Duration, mut work: impl FnMut()) -> Seconds {
    let start = Instant::now();
    let mut best = Seconds { wall: f64::INFINITY, cpu: f64::INFINITY };
    let mut runs = 0;
    while runs < 3 || start.elapsed() < least {
        let (begin, before) = (Instant::now(), cpu_seconds());
        work();
        let wall = begin.elapsed().as_secs_f64();
        let cpu = cpu_seconds().zip(before).map_or(wall * rayon::current_num_threads() as f64, |(b, a)| b - a);
        best = Seconds { wall: best.wall.min(wall), cpu: best.cpu.min(cpu) };
        runs += 1;
    }
    best
}

fn measure(n: usize, width: u32, height: u32, simd: SimdPath, floor: f64, least: Duration) {
    let (rows, camera) = scene(n, width, height);
    let options = RenderOptions { sh_degree: 3, simd, ..RenderOptions::default() };
    let mut renderer = CpuRenderer::new();
    let mut grads = Gradients::default();
    let mut stages = [("", f64::INFINITY); STAGES.len()];
    let forward = seconds(least, || {
        renderer.forward(&rows, &camera, &options);
        note_stages(&renderer, &mut stages);
    });
    let v_rgb: Vec<f32> = renderer.image().rgb.iter().map(|x| x - 0.5).collect();
    let backward = seconds(least, || {
        renderer.backward(&rows, &v_rgb, None, &mut grads);
        note_stages(&renderer, &mut stages);
    });
    let stats = renderer.stats();
    let nominal = 256.0 * stats.isects as f64;
    let evaluated = stats.evaluated as f64;
    println!(
        "{n} Gaussians: {} visible, {} intersections, {:.1} rows of a tile each, {:.0} evaluated per pixel",
        stats.visible,
        stats.isects,
        evaluated / 16.0 / stats.isects as f64,
        evaluated / camera.pixels() as f64
    );
    for (what, t) in [("forward", forward), ("backward", backward)] {
        println!(
            "  {what:8} {:8.2} ms wall, {:8.2} ms CPU; a thread: {:.2} G/s evaluated ({:.2} of the floor), {:.2} nominal",
            1e3 * t.wall,
            1e3 * t.cpu,
            evaluated / t.cpu / 1e9,
            evaluated / t.cpu / floor,
            nominal / t.cpu / 1e9
        );
    }
    let sum = 1e3 * (forward.cpu + backward.cpu);
    let mib = renderer.scratch_bytes() as f64 / f64::from(1 << 20);
    println!("  together {sum:.2} ms CPU, scratch {mib:.1} MiB");
    let blend = stages.iter().find(|(name, _)| *name == "rasterize_fwd").map_or(f64::NAN, |(_, seconds)| *seconds);
    let rate = evaluated / blend / rayon::current_num_threads() as f64;
    println!(
        "  rasterize_fwd alone, by wall time: {:.2} G/s a thread evaluated ({:.2} of the floor), {:.2} nominal",
        rate / 1e9,
        rate / floor,
        rate / 1e9 * nominal / evaluated
    );
    print!("  least wall ms:");
    for (stage, seconds) in stages.iter().filter(|(_, s)| s.is_finite()) {
        print!(" {stage} {:.2}", 1e3 * seconds);
    }
    println!();
}

/// Keeps the least time of every stage that ran.
fn note_stages(renderer: &CpuRenderer, least: &mut [(&'static str, f64)]) {
    for (least, (stage, seconds)) in least.iter_mut().zip(renderer.stage_seconds()) {
        least.0 = stage;
        if seconds > 0.0 {
            least.1 = least.1.min(seconds);
        }
    }
}

/// A rough terrain seen obliquely, covered by flat Gaussians whose size follows their spacing; most are half opaque.
fn scene(n: usize, width: u32, height: u32) -> (Columns, Camera) {
    let mut draws = Stream::new(1, Purpose::Test, n as u64, 0);
    let mut c = Columns::zeros(n, 3);
    let spacing = 4.0 / (n as f64).sqrt();
    for row in 0..n {
        let (x, y) = (draws.range(-2.0, 2.0), draws.range(-2.0, 2.0));
        let z = 0.2 * (libm::sin(3.0 * x) + libm::cos(4.0 * y)) + draws.range(-0.15, 0.15);
        c.means[3 * row..3 * row + 3].copy_from_slice(&[x as f32, y as f32, z as f32]);
        for i in 0..4 {
            c.quats[4 * row + i] = draws.normal() as f32;
        }
        for i in 0..3 {
            c.scales[3 * row + i] = libm::log(spacing * libm::exp(0.6 * draws.normal()) * 0.8) as f32;
        }
        c.opacities[row] = draws.range(-2.0, 3.0) as f32;
    }
    c.sh0.iter_mut().chain(&mut c.sh_n).for_each(|x| *x = 0.2 * draws.normal() as f32);
    // Looks down at 45 degrees from the side of negative y.
    let h = std::f32::consts::FRAC_1_SQRT_2;
    let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, -h, -h, 0.0], [0.0, h, -h, 3.0]];
    let f = width as f32 * 0.9;
    let (cx, cy) = (0.5 * width as f32, 0.5 * height as f32);
    (c, Camera { viewmat, fx: f, fy: f, cx, cy, width, height, near_plane: 0.01, far_plane: 1e10 })
}

/// Pixel-Gaussians per CPU second of the bare loop.
fn floor_rate(simd: SimdPath, repeats: usize) -> f64 {
    let threads = rayon::current_num_threads();
    let splats: Vec<[f32; 8]> = (0..512)
        .map(|i| [(i % 16) as f32, (i / 32) as f32, -0.02, 0.01, -0.03, -6.0, 0.5, 0.25 + i as f32 * 1e-3])
        .collect();
    let t = seconds(Duration::ZERO, || {
        let sums: Vec<f32> =
            (0..threads).into_par_iter().map(|_| dispatch(simd, Bare { splats: &splats, repeats })).collect();
        assert!(sums.iter().all(|s| s.is_finite()));
    });
    (threads * repeats * splats.len() * 256) as f64 / t.cpu
}

struct Bare<'a> {
    splats: &'a [[f32; 8]],
    repeats: usize,
}

impl Kernel for Bare<'_> {
    type Out = f32;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> f32 {
        let mut sum = 0.0;
        for _ in 0..self.repeats {
            for row in 0..16 {
                let (mut t, mut rgb) = ([1.0f32; LANES], [[0.0f32; LANES]; 3]);
                for s in std::hint::black_box(self.splats) {
                    let dy = row as f32 - s[1];
                    let (bdy, cdy) = (s[3] * dy, fma::<FMA>(s[4] * dy, dy, s[5]));
                    for lane in 0..LANES {
                        let dx = lane as f32 - s[0];
                        let e = fma::<FMA>(fma::<FMA>(s[2], dx, bdy), dx, cdy);
                        let alpha = if e >= LOG2_ALPHA_MIN { exp2_bounded::<FMA>(e) } else { 0.0 };
                        let w = alpha * t[lane];
                        t[lane] -= w;
                        rgb[0][lane] = fma::<FMA>(w, s[5], rgb[0][lane]);
                        rgb[1][lane] = fma::<FMA>(w, s[6], rgb[1][lane]);
                        rgb[2][lane] = fma::<FMA>(w, s[7], rgb[2][lane]);
                    }
                }
                sum += rgb.iter().flatten().sum::<f32>();
            }
        }
        sum
    }
}
