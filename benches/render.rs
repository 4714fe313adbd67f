//! Speed of the CPU renderer against its floor.
//!
//! `cargo bench --bench render` measures the inner loop on each instruction path, then whole views of 10k, 100k and 1M
//! Gaussians. Numbers set other sizes, `--path avx2` the instruction path, `RAYON_NUM_THREADS` the threads. A test run
//! renders one tiny view.
//!
//! Rates are per CPU second and thread, so that other load on the machine changes them little; on a system without CPU
//! times, per wall second.
//!
//! The floor of blending is a bare loop over splats in the first cache level: no lists, no early stops, no edges, all
//! pixels of a tile. A ratio of 1 means that only blending takes time. `nominal` counts every pixel of the tiles that a
//! row can reach, `evaluated` counts only the pixel rows that are blended.
//!
//! The inner loop is measured on tiles with 2,048 splats that reach every pixel and never saturate it.

mod support;

use gsscale::base::simd::SimdPath;
use gsscale::kernels::isect_emit::Isect;
use gsscale::kernels::raster::{Lists, TILE_PIXELS};
use gsscale::kernels::rasterize_fwd::{Raster, rasterize_fwd};
use gsscale::kernels::splats::{Grid, Splat};
use gsscale::kernels::stages::STAGES;
use gsscale::kernels::tile_range::TileRange;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{Gradients, RenderOptions, Renderer};
use std::sync::atomic::AtomicU64;
use std::time::Duration;
use support::floor::bare_blend_rate;
use support::{Args, Hash, checked, machine, steady_time, terrain};

fn main() {
    let args = Args::read();
    if !args.real {
        assert!(tiny() != 0);
        return;
    }
    println!("{}", machine(args.simd()));
    let threads = rayon::current_num_threads();
    for path in SimdPath::ALL.into_iter().filter(|p| p.is_supported() && args.path.is_none_or(|only| only == *p)) {
        for threads in if threads > 1 { vec![1, threads] } else { vec![1] } {
            inner_loop(path, threads, Duration::from_secs(1));
        }
    }
    let (width, height) = (960, 540);
    let floor = bare_blend_rate(args.simd(), Duration::from_secs(1));
    println!("{width}x{height}; floor {:.2} Gpixel-Gaussians/s a thread (bare blend loop)", floor / 1e9);
    let sizes = if args.sizes.is_empty() { vec![10_000, 100_000, 1_000_000] } else { args.sizes.clone() };
    for n in sizes {
        measure(n, width, height, args.simd(), floor, Duration::from_secs(2));
    }
}

/// One tiny view and one small tile on every path; returns a hash of the pictures.
pub fn tiny() -> u64 {
    let mut hash = Hash::default();
    for path in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
        inner_loop(path, 1, Duration::ZERO).iter().for_each(|x| hash.add(u64::from(x.to_bits())));
    }
    measure(300, 48, 40, SimdPath::best(), 1e9, Duration::ZERO);
    hash.0
}

/// Splats per tile in the scene of the inner loop.
const INNER_SPLATS: usize = 2048;

/// Prints the rates of the rasterizer's inner loop and of the bare loop, both on `threads` threads; returns the picture
/// of one tile.
fn inner_loop(simd: SimdPath, threads: usize, least: Duration) -> Vec<f32> {
    let Ok(pool) = rayon::ThreadPoolBuilder::new().num_threads(threads).build() else { return Vec::new() };
    pool.install(|| {
        let bare = bare_blend_rate(simd, least);
        // Eight tiles per thread give every thread the same share.
        let grid = Grid::new(16 * 8 * threads as u32, 16);
        let splats: Vec<Splat> = (0..INNER_SPLATS).map(|i| wide_splat(i, grid.width as f32)).collect();
        let isect = |i: usize| Isect { row: (i % INNER_SPLATS) as u32, pixel_rows: [0, 15], k: 0 };
        let isects: Vec<AtomicU64> =
            (0..grid.tiles() * INNER_SPLATS).map(|i| AtomicU64::new(isect(i).pack())).collect();
        let tile_offsets: Vec<u64> = (0..=grid.tiles()).map(|tile| (tile * INNER_SPLATS) as u64).collect();
        let lists = Lists {
            grid,
            range: TileRange::all(grid),
            splats: &splats,
            isects: &isects,
            tile_offsets: &tile_offsets,
            max_alpha: 0.99,
            background: [0.0; 3],
            simd,
        };
        let mut raster = Raster::default();
        let t = steady_time(least, || rasterize_fwd(&lists, &mut raster));
        let pairs = (grid.tiles() * INNER_SPLATS * TILE_PIXELS) as f64;
        assert!(raster.evaluated.iter().sum::<u64>() as f64 == pairs, "some pixel stopped early or was not reached");
        let rate = pairs / t.cpu;
        println!(
            "inner loop, {}, {threads} threads: {:.2} Gpixel-Gaussians/s a thread, {:.2} of the bare loop's {:.2}; \
             all threads {:.2}",
            simd.name(),
            rate / 1e9,
            rate / bare,
            bare / 1e9,
            threads as f64 * rate / 1e9
        );
        raster.rgb[..3 * TILE_PIXELS].to_vec()
    })
}

/// A splat with an alpha of 1/240 to 1/230 at every pixel of a picture of this width: above 1/255, and 2,048 such
/// splats leave a transmittance above 1e-4.
fn wide_splat(i: usize, width: f32) -> Splat {
    let color = [0.25, 0.5, 0.1 + 0.8 * i as f32 / INNER_SPLATS as f32];
    // The exponent to base 2 falls by less than 0.05 over the picture.
    let fall = 0.01 / (width * width);
    Splat {
        mean: [0.5 * width + (i % 16) as f32, (i / 128) as f32],
        a: -fall,
        b: 0.5 * fall,
        c: -fall,
        log2_opacity: -7.85,
        color,
        reach: 1.0,
        emit: 0,
    }
}

fn measure(n: usize, width: u32, height: u32, simd: SimdPath, floor: f64, least: Duration) {
    let (rows, camera) = terrain(n, width, height);
    let options = RenderOptions { sh_degree: 3, simd, ..RenderOptions::default() };
    let mut renderer = CpuRenderer::new();
    let mut grads = Gradients::default();
    let mut stages = [("", f64::INFINITY); STAGES.len()];
    let forward = steady_time(least, || {
        checked(renderer.draw(&rows, &camera, &options));
        note_stages(&renderer, &mut stages);
    });
    let v_rgb: Vec<f32> = checked(renderer.image()).rgb.iter().map(|x| x - 0.5).collect();
    checked(renderer.picture_gradient()).v_rgb.copy_from_slice(&v_rgb);
    let backward = steady_time(least, || {
        checked(renderer.backpropagate(&rows, &mut grads));
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

/// Keeps the shortest time of each stage that ran.
fn note_stages(renderer: &CpuRenderer, least: &mut [(&'static str, f64)]) {
    for (least, (stage, seconds)) in least.iter_mut().zip(renderer.stage_seconds()) {
        least.0 = stage;
        if seconds > 0.0 {
            least.1 = least.1.min(seconds);
        }
    }
}
