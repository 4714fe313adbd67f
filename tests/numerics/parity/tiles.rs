//! The tile stages on the device against their twins on the CPU.

use super::cost::Cost;
use super::pages::read;
use crate::support::gpu;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::gpu::{BufferView, Gpu, GpuOptions, Subgroups};
use gsscale::kernels::fold::{FoldPart, FootprintGradients, fold_rows};
use gsscale::kernels::isect_emit::{Isect, count, emit};
use gsscale::kernels::isect_offsets::isect_offsets;
use gsscale::kernels::project_fwd::Projected;
use gsscale::kernels::radix_sort::DepthSort;
use gsscale::kernels::raster::Lists;
use gsscale::kernels::rasterize_bwd::{Upstream, rasterize_bwd};
use gsscale::kernels::rasterize_fwd::{Raster, rasterize_fwd, untile};
use gsscale::kernels::scan::scan;
use gsscale::kernels::splats::{Grid, Packed, pack};
use gsscale::kernels::tile_range::TileRange;
use gsscale::kernels::uniforms::SCAN_SUMS;
use gsscale::render::gpu_frame::{Blend, Demand, Frame, Pairs, Pixels, Ranks, splat_bytes};
use gsscale::render::gpu_tiles::TileStages;
use gsscale::render::gpu_tiles_bwd::{Fold, PictureGradientBuffers};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The device on each path that it has.
fn devices() -> Vec<Gpu> {
    let all = [Subgroups::Best, Subgroups::AnySize, Subgroups::Off];
    all.into_iter().filter_map(|subgroups| gpu::open(&GpuOptions { subgroups, ..GpuOptions::default() })).collect()
}

/// The same, and with emulated subgroups of every size, each with the most values for it. Sizes beyond `most` add no path to a form
/// of subgroups, so the first device alone has them.
fn devices_and_emulated(most: usize) -> Vec<(Gpu, usize)> {
    let emulated = [4, 8, 16, 32, 64].map(Subgroups::Emulated).into_iter();
    let emulated = emulated.filter_map(|subgroups| gpu::open(&GpuOptions { subgroups, ..GpuOptions::default() }));
    let all = devices().into_iter().chain(emulated).enumerate();
    all.map(|(i, gpu)| (gpu, if i == 0 { usize::MAX } else { most })).collect()
}

#[test]
fn sums_are_those_of_the_cpu() {
    for (gpu, most) in devices_and_emulated(100_001) {
        let mut stages = TileStages::new(&gpu).unwrap();
        let mut draws = Stream::new(31, Purpose::Test, 0, 0);
        // One block, its borders, more sums than a block's, more than a block reads; the last beyond 2^24 values.
        for n in [0, 1, 7, 2047, 2048, 2049, 100_001, 5_000_000, 20_000_000u32] {
            if n as usize > most {
                continue;
            }
            let values: Vec<u32> = (0..n).map(|i| if n > 1 << 24 { i & 31 } else { draws.below(800) as u32 }).collect();
            let mut want = Vec::new();
            scan(&values.iter().map(|&x| u64::from(x)).collect::<Vec<_>>(), &mut want);
            for scan_sums in [SCAN_SUMS, 1] {
                stages.scan_sums = scan_sums;
                let before = gpu.traffic().work.dispatches;
                let sums = gpu_scan(&gpu, &stages, &values);
                assert!(sums.iter().map(|&x| u64::from(x)).eq(want.iter().copied()), "{n} values, {scan_sums} sums");
                let mut cost = Cost::default();
                cost.scan(n.into(), scan_sums.into());
                assert_eq!(gpu.traffic().work.dispatches - before, cost.dispatches, "{n} values, {scan_sums} sums");
            }
        }
        // Sums beyond 32 bits saturate, at any position.
        for (big, scan_sums) in [0, 2048, 99_999].into_iter().flat_map(|big| [(big, SCAN_SUMS), (big, 1)]) {
            stages.scan_sums = scan_sums;
            let mut values = vec![1u32; 100_000];
            values[big] = u32::MAX - 3;
            let got = gpu_scan(&gpu, &stages, &values);
            for (i, got) in got.into_iter().enumerate() {
                let want = i as u64 + if i > big { u64::from(u32::MAX - 4) } else { 0 };
                assert_eq!(u64::from(got), want.min(u64::from(u32::MAX)), "{big} {i}");
            }
        }
    }
}

fn gpu_scan(gpu: &Gpu, stages: &TileStages, values: &[u32]) -> Vec<u32> {
    let mut recorder = gpu.begin("test");
    let from = recorder.buffer_with("values", values).unwrap();
    let to = gpu.buffer("sums", 4 * (values.len() as u64 + 1)).unwrap();
    stages.scan(gpu, &mut recorder, &from.view(), values.len() as u32, &to.view()).unwrap();
    gpu.submit(recorder).unwrap();
    read(gpu, &to, usize::MAX)
}

#[test]
fn sorted_pairs_are_those_of_a_stable_sort() {
    for (gpu, most) in devices_and_emulated(20_000) {
        let mut stages = TileStages::new(&gpu).unwrap();
        let mut draws = Stream::new(32, Purpose::Test, 0, 0);
        for (n, bits, distinct) in [
            (0, 32, 1),
            (1, 32, 1 << 32),
            (2047, 13, 5),
            (2048, 13, 8192),
            (2049, 4, 16),
            (20_000, 32, 1),
            (20_000, 32, 1 << 32),
            (20_000, 17, 90_000),
            (300_000, 32, 1 << 32),
        ] {
            if n > most {
                continue;
            }
            let keys: Vec<u32> = (0..n).map(|_| draws.below(distinct) as u32).collect();
            let mut want: Vec<(u32, u32)> = keys.iter().copied().zip(0..).collect();
            want.sort_by_key(|pair| pair.0);
            // Buffers are larger than the sorted part.
            let capacity = n as u32 + n as u32 / 3;
            let mut padded = keys.clone();
            padded.resize(capacity as usize, 3);
            for scan_sums in [SCAN_SUMS, 1] {
                stages.scan_sums = scan_sums;
                let (keys, values) = gpu_sort(&gpu, &stages, &padded, n as u32, bits);
                let got = keys.into_iter().zip(values).take(n);
                assert!(got.eq(want.iter().copied()), "{n} keys of {bits} bits, {scan_sums} sums");
            }
        }
    }
}

fn gpu_sort(gpu: &Gpu, stages: &TileStages, keys: &[u32], live: u32, bits: u32) -> (Vec<u32>, Vec<u32>) {
    let values: Vec<u32> = (0..keys.len() as u32).collect();
    let mut recorder = gpu.begin("test");
    let pairs = Pairs {
        keys: recorder.buffer_with("keys", keys).unwrap(),
        values: recorder.buffer_with("values", &values).unwrap(),
    };
    let live = recorder.buffer_with("count", &[77, live]).unwrap();
    let sorted = stages.sort(gpu, &mut recorder, &live.view(), 1, keys.len() as u32, bits, pairs).unwrap();
    gpu.submit(recorder).unwrap();
    (read(gpu, &sorted.keys, usize::MAX), read(gpu, &sorted.values, usize::MAX))
}

/// Footprints of a view, with culled rows among them.
struct Scene {
    projected: Projected,
    colors: Vec<[f32; 3]>,
    blend: Blend,
}

impl Scene {
    fn empty(width: u32, height: u32) -> Scene {
        let blend = Blend { grid: Grid::new(width, height), background: [0.3, 0.2, 0.1], max_alpha: 0.99 };
        Scene { projected: Projected::default(), colors: vec![], blend }
    }

    /// A row from its variances' axes (pixels), as `project_fwd` leaves it.
    fn push(&mut self, mean: [f64; 2], axes: [f64; 2], angle: f64, depth: f32, opacity: f32, color: [f32; 3]) {
        let (sin, cos) = angle.sin_cos();
        let (u, v) = (1.0 / (axes[0] * axes[0]), 1.0 / (axes[1] * axes[1]));
        let conic = [u * cos * cos + v * sin * sin, (u - v) * sin * cos, u * sin * sin + v * cos * cos];
        let reach = (2.0 * (255.0 * f64::from(opacity)).ln()).max(0.0).sqrt().min(3.33);
        let p = &mut self.projected;
        p.means2d.push(mean.map(|x| x as f32));
        p.conics.push(conic.map(|x| x as f32));
        p.depths.push(depth);
        p.radii.push([conic[2], conic[0]].map(|c| (reach * (c / (u * v)).sqrt()).ceil() as u32));
        p.opacities.push(opacity);
        self.colors.push(color);
        // Off the picture, or too faint: culled as project_fwd culls.
        let last = p.radii.len() - 1;
        let [rx, ry] = p.radii[last].map(f64::from);
        let (w, h) = (f64::from(self.blend.grid.width), f64::from(self.blend.grid.height));
        let off = mean[0] + rx <= 0.0 || mean[0] - rx >= w || mean[1] + ry <= 0.0 || mean[1] - ry >= h;
        if off || opacity < 1.0 / 255.0 {
            p.radii[last] = [0, 0];
        }
    }

    fn random(rows: usize, width: u32, height: u32, needles: bool) -> Scene {
        let mut scene = Scene::empty(width, height);
        let mut draws = Stream::new(33, Purpose::Test, rows as u64, u64::from(needles));
        for row in 0..rows {
            let major = draws.range(-0.8, if needles { 9.0 } else { 4.5 }).exp2();
            let minor = if needles { 0.56 } else { draws.range(-0.8, 3.0).exp2() };
            let mean = [draws.range(-20.0, f64::from(width) + 20.0), draws.range(-20.0, f64::from(height) + 20.0)];
            // Many ties, and some depths at the ends of what a float can hold.
            let depth = match draws.below(20) {
                0 => f32::MIN_POSITIVE / 8.0,
                1 => f32::MAX,
                n => 0.01 * n as f32,
            };
            let opacity = (draws.range(-0.05, 1.5) as f32).clamp(0.0, 1.0);
            let color = [0; 3].map(|_| draws.range(0.0, 1.5) as f32);
            scene.push(mean, [major, minor], draws.range(0.0, 3.2), depth, opacity, color);
            if row % 17 == 5 {
                scene.projected.radii[row] = [0, 0];
            }
        }
        scene
    }

    /// Three vec4 for each row; zeros for culled ones.
    fn records(&self) -> Vec<[f32; 12]> {
        let p = &self.projected;
        (0..p.radii.len())
            .map(|row| {
                if p.radii[row] == [0, 0] {
                    return [0.0; 12];
                }
                let ([x, y], [xx, xy, yy]) = (p.means2d[row], p.conics[row]);
                let ([rx, ry], [r, g, b]) = (p.radii[row].map(|r| r as f32), self.colors[row]);
                [x, y, p.depths[row], p.opacities[row], xx, xy, yy, rx, r, g, b, ry]
            })
            .collect()
    }
}

/// Results of the tile stages for a scene, in the CPU's terms.
#[derive(Default)]
struct Outcome {
    order: Vec<u32>,
    /// For each tile its rows, front to back.
    lists: Vec<Vec<u32>>,
    rgb: Vec<f32>,
    t_final: Vec<f32>,
    /// `[rows][9]`: v_mean2d, v_conic, v_color, v_opacity.
    gradients: Vec<[f32; 9]>,
}

fn on_cpu(scene: &Scene, v_rgb: &[f32], v_alpha: Option<&[f32]>) -> Outcome {
    let (grid, simd, p) = (scene.blend.grid, SimdPath::Baseline, &scene.projected);
    let (mut order, mut packed, mut chunk_offsets) = (Vec::new(), Packed::default(), Vec::new());
    let (mut tile_counts, mut tile_offsets, mut cursors) = (Vec::new(), Vec::new(), Vec::new());
    let mut isects = Vec::<AtomicU64>::new();
    DepthSort::default().sort(&p.depths, &p.radii, &mut order);
    pack(p, &scene.colors, grid, simd, &mut packed);
    let total = scan(&packed.chunk_counts, &mut chunk_offsets);
    count(&order, &packed, grid, TileRange::all(grid), simd, &mut tile_counts);
    isect_offsets(&tile_counts, grid.tiles(), &mut tile_offsets, &mut cursors);
    emit(&order, &packed, grid, TileRange::all(grid), simd, total, &mut cursors, &mut isects);
    let lists = Lists {
        grid,
        range: TileRange::all(grid),
        splats: &packed.splats,
        isects: &isects,
        tile_offsets: &tile_offsets,
        max_alpha: scene.blend.max_alpha,
        background: scene.blend.background,
        simd,
    };
    let (mut raster, mut partials) = (Raster::default(), Vec::new());
    rasterize_fwd(&lists, &mut raster);
    rasterize_bwd(&lists, &chunk_offsets, &raster, &Upstream { v_rgb, v_alpha }, &mut partials, None);
    let mut out = FootprintGradients::default();
    fold_rows(FoldPart::WHOLE, [&packed.counts; 2], &chunk_offsets, &partials, p, &mut out);
    let pixels = (grid.width * grid.height) as usize;
    let (mut rgb, mut alpha) = (vec![0.0; 3 * pixels], vec![0.0; pixels]);
    untile(grid, &raster, &mut rgb, &mut alpha);
    let row_of = |bits: &AtomicU64| Isect::unpack(bits.load(Relaxed)).row;
    Outcome {
        lists: (0..grid.tiles()).map(|t| lists.tile(t).iter().map(row_of).collect()).collect(),
        rgb,
        t_final: alpha.iter().map(|a| 1.0 - a).collect(),
        gradients: (0..order.len().max(p.radii.len()))
            .map(|row| {
                let ([mx, my], [xx, xy, yy], [r, g, b]) = (out.v_means2d[row], out.v_conics[row], out.v_colors[row]);
                [mx, my, xx, xy, yy, r, g, b, out.v_opacities[row]]
            })
            .collect(),
        order,
    }
}

/// Runs sort, lists and blending, again with larger buffers if needed, and waits. `splats` holds `rows` records.
fn forward(
    gpu: &Gpu,
    stages: &mut TileStages,
    splats: &BufferView,
    rows: u32,
    blend: Blend,
) -> (Ranks, Frame, Pixels, Demand) {
    let mut recorder = gpu.begin("tiles");
    let pixels = Pixels::new(gpu, blend.grid).unwrap();
    let ranks = stages.order(gpu, &mut recorder, splats, rows, blend.grid, TileRange::all(blend.grid), None).unwrap();
    loop {
        let (frame, demand) = stages.frame(gpu, &mut recorder, splats, &ranks, blend, &pixels).unwrap();
        gpu.submit(recorder).unwrap();
        let demand = demand.wait().unwrap();
        if stages.fits(&frame, demand).unwrap() {
            return (ranks, frame, pixels, demand);
        }
        recorder = gpu.begin("tiles again");
    }
}

fn on_gpu(gpu: &Gpu, stages: &mut TileStages, scene: &Scene, v_rgb: &[f32], v_alpha: Option<&[f32]>) -> Outcome {
    let rows = scene.projected.radii.len() as u32;
    let grid = scene.blend.grid;
    let mut recorder = gpu.begin("upload");
    let splats = recorder.buffer_with("splats", &scene.records()).unwrap();
    let v_rgb = recorder.buffer_with("v_rgb", &[v_rgb, v_alpha.unwrap_or_default()].concat()).unwrap();
    let v_splats = recorder.buffer_zeroed("v_splats", splat_bytes(rows)).unwrap();
    gpu.submit(recorder).unwrap();
    let (ranks, frame, pixels, demand) = forward(gpu, stages, &splats.view(), rows, scene.blend);
    let mut recorder = gpu.begin("backward");
    let (from, to) = (splats.view(), v_splats.view());
    let picture = PictureGradientBuffers { v_rgb: &v_rgb.view(), has_v_alpha: v_alpha.is_some(), errors: None };
    let unusable = recorder.buffer_zeroed("unusable", 4).unwrap();
    let (into, to, fold) = (&mut recorder, (&to, &unusable), Fold::Whole);
    stages.back.backward(gpu, into, &from, &ranks, &frame, &pixels, demand, picture, to, fold).unwrap();
    gpu.submit(recorder).unwrap();
    let words = [&ranks.order, &frame.row_from_isect, &frame.isects, &frame.tile_offsets];
    let [order, rows_of, isects, starts] = words.map(|words| read::<u32>(gpu, words, usize::MAX));
    let visible = scene.projected.radii.iter().filter(|r| **r != [0, 0]).count();
    let count = (grid.width * grid.height) as usize;
    let tile =
        |t: usize| isects[starts[t] as usize..starts[t + 1] as usize].iter().map(|&i| rows_of[i as usize]).collect();
    Outcome {
        order: order[..visible].to_vec(),
        lists: (0..grid.tiles()).map(tile).collect(),
        rgb: read(gpu, &pixels.rgb, 3 * count),
        t_final: read(gpu, &pixels.t_final, count),
        gradients: read::<[f32; 12]>(gpu, &v_splats, rows as usize)
            .iter()
            .map(|v| [v[0], v[1], v[4], v[5], v[6], v[8], v[9], v[10], v[3]])
            .collect(),
    }
}

fn upstream(scene: &Scene) -> (Vec<f32>, Vec<f32>) {
    let pixels = (scene.blend.grid.width * scene.blend.grid.height) as usize;
    let mut draws = Stream::new(34, Purpose::Test, 0, 0);
    let mut normals = |n: usize| (0..n).map(|_| draws.normal() as f32).collect();
    (normals(3 * pixels), normals(pixels))
}

/// The order must be equal. Lists must agree except for tiles at which a footprint's border meets a rounding. Pictures
/// and gradients must agree up to roundings and up to pixels in which a rounding decides whether a contribution is
/// above 1/255.
fn compare(want: &Outcome, got: &Outcome, what: &str) {
    assert!(want.order == got.order, "{what}: depth order");
    let total: usize = want.lists.iter().map(Vec::len).sum();
    let mut differing = 0;
    for (want, got) in want.lists.iter().zip(&got.lists) {
        let missing = want.iter().filter(|row| !got.contains(row)).count();
        let more = got.iter().filter(|row| !want.contains(row)).count();
        differing += missing + more;
        if missing + more == 0 {
            assert!(want == got, "{what}: a list is out of order");
        }
    }
    // The device's log2, root and quotient err by some 1e-6 of a footprint's extent; a border falls that close to a
    // tile's border about as often.
    assert!(differing <= total / 10_000 + 1, "{what}: {differing} of {total} intersections differ");
    for (name, want, got) in [("rgb", &want.rgb, &got.rgb), ("t_final", &want.t_final, &got.t_final)] {
        let mut beyond = 0;
        for (want, got) in want.iter().zip(got) {
            let error = (want - got).abs();
            // One contribution of 1/255 of the brightest colour there is, and what it hides.
            assert!(error < 2.0 * 1.5 / 255.0, "{what}: {name} {got}, not {want}");
            // Roundings: 1e-6 for each alpha, of which the front hundred matter.
            beyond += usize::from(error > 5e-5);
        }
        assert!(beyond <= want.len() / 500 + 1, "{what}: {beyond} of {} pixels of {name} differ", want.len());
    }
    for which in 0..9 {
        let norm = |v: &[[f32; 9]]| v.iter().map(|g| f64::from(g[which]).powi(2)).sum::<f64>().sqrt();
        let differences: Vec<[f32; 9]> = want
            .gradients
            .iter()
            .zip(&got.gradients)
            .map(|(want, got)| {
                let mut d = [0.0; 9];
                d[which] = want[which] - got[which];
                d
            })
            .collect();
        let (size, error) = (norm(&want.gradients), norm(&differences));
        // Roundings leave 1e-5 (needles) or less; a pixel that decides otherwise adds or drops 1/255 of its gradient.
        assert!(error <= 1e-3 * size + 1e-12, "{what}: gradient {which} is off by {error} of {size}");
    }
}

#[test]
fn pictures_and_gradients_are_those_of_the_cpu() {
    for (gpu, most) in devices_and_emulated(3000) {
        let mut stages = TileStages::new(&gpu).unwrap();
        for (rows, width, height, needles) in [
            (0, 40, 30, false),
            (1, 70, 43, true),
            (60, 1, 1, false),
            (60, 70, 43, false),
            (3000, 70, 43, false),
            (5000, 203, 117, false),
            (400, 203, 117, true),
            (4097, 640, 16, false),
        ] {
            if rows > most {
                continue;
            }
            let scene = Scene::random(rows, width, height, needles);
            let (v_rgb, v_alpha) = upstream(&scene);
            for v_alpha in [None, Some(&v_alpha[..])] {
                let want = on_cpu(&scene, &v_rgb, v_alpha);
                let got = on_gpu(&gpu, &mut stages, &scene, &v_rgb, v_alpha);
                compare(&want, &got, &format!("{rows} rows on {width}x{height}, needles {needles}"));
            }
        }
    }
}

#[test]
fn a_tile_list_longer_than_an_invocation_may_loop() {
    for gpu in devices() {
        let mut stages = TileStages::new(&gpu).unwrap();
        // 70,000 barely visible Gaussians on the middle tile of three by three, a few of them with large footprints.
        let mut scene = Scene::empty(48, 48);
        let mut draws = Stream::new(35, Purpose::Test, 0, 0);
        for row in 0..70_000 {
            let sigma = if row % 5000 == 0 { 20.0 } else { 4.0 };
            let mean = [draws.range(22.0, 26.0), draws.range(22.0, 26.0)];
            let color = [0; 3].map(|_| draws.range(0.0, 1.0) as f32);
            // Just above 1/255 and only near the mean: pixels stop late, at different places, and some never.
            scene.push(mean, [sigma, sigma], 0.0, 1.0 + row as f32, 0.004, color);
        }
        let (v_rgb, _) = upstream(&scene);
        let want = on_cpu(&scene, &v_rgb, None);
        assert!(want.lists[4].len() > 65_535, "{} in the list", want.lists[4].len());
        let got = on_gpu(&gpu, &mut stages, &scene, &v_rgb, None);
        compare(&want, &got, "70,000 on one tile");
        // Some pixels see beyond the first segment of either direction.
        assert!(want.t_final.iter().any(|t| *t > 1e-4 && *t < 0.9));
    }
}

/// Again, and when the room for intersections falls short.
#[test]
fn a_frame_that_is_made_again_has_the_same_bits() {
    for gpu in devices() {
        let mut stages = TileStages::new(&gpu).unwrap();
        let scene = Scene::random(4000, 203, 117, false);
        let (v_rgb, v_alpha) = upstream(&scene);
        let want = on_gpu(&gpu, &mut stages, &scene, &v_rgb, Some(&v_alpha));
        for capacity in [None, None, None, Some(1), Some(1000), Some(2048)] {
            capacity.into_iter().for_each(|capacity| stages.set_capacity(capacity));
            let got = on_gpu(&gpu, &mut stages, &scene, &v_rgb, Some(&v_alpha));
            assert!(capacity.is_none_or(|capacity| stages.room().capacity > capacity), "it must not have fitted");
            assert!(want.lists == got.lists && bits(&want) == bits(&got), "capacity {capacity:?}");
        }
    }
}

fn bits(outcome: &Outcome) -> Vec<u32> {
    let all = outcome.rgb.iter().chain(&outcome.t_final).chain(outcome.gradients.as_flattened());
    all.map(|x| x.to_bits()).collect()
}

/// More than 65,535 workgroups of 256 intersections, more than 2^24 keys, all with the plain counts of a CPU.
#[test]
fn dispatches_beyond_65_535_workgroups_fold() {
    // One kind of subgroups: all stages fold by `linear_index`.
    for gpu in devices().into_iter().take(1) {
        let mut stages = TileStages::new(&gpu).unwrap();
        // A column of 4095 tiles and 4,150 Gaussians that cover all of it.
        let mut scene = Scene::empty(16, 65_520);
        for row in 0..4150 {
            scene.push([8.0, 32_760.0], [1e5, 1e5], 0.0, 1.0 + row as f32, 0.9, [0.5; 3]);
        }
        let rows = 4150;
        let mut recorder = gpu.begin("upload");
        let splats = recorder.buffer_with("splats", &scene.records()).unwrap();
        gpu.submit(recorder).unwrap();
        let (_, frame, pixels, demand) = forward(&gpu, &mut stages, &splats.view(), rows, scene.blend);
        assert_eq!(demand.isects, 4150 * 4095);
        assert!(demand.isects > 65_535 * 256);
        let words = [&frame.row_from_isect, &frame.isects, &frame.tile_offsets];
        let [rows_of, isects, starts] = words.map(|words| read::<u32>(&gpu, words, usize::MAX));
        for tile in 0..4095u32 {
            assert_eq!(starts[tile as usize], tile * rows);
            for (row, isect) in (0..rows).zip(&isects[(tile * rows) as usize..]) {
                assert_eq!((*isect, rows_of[*isect as usize]), (row * 4095 + tile, row));
            }
        }
        // alpha is 0.9 at every pixel: three of them, then the fourth would bring T to 1e-4 or, by rounding, not.
        assert!(read::<f32>(&gpu, &pixels.rgb, 16 * 65_520).iter().all(|red| (red - 0.5).abs() < 1e-3));
    }
}
