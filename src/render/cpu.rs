//! [`CpuRenderer`]: the stages of a view on the CPU, forward and backward, and the memory that the stages share.
//!
//! Not here: the computation of each stage (`crate::kernels`), and the order of calls (`super::sequence`).
//!
//! Invariants: 1. buffers grow only when a view is larger than all views before; 2. the result has the same bits for
//! any number of threads, for any split of the rows into batches, and on the AVX2 and AVX-512 paths.

use super::sequence::{Sequence, ViewOptions};
use super::{Gradients, LossOptions, LossValue, PictureGradient, RenderError, RenderOptions, Renderer, RowBatches};
use crate::base::room;
use crate::base::simd::SimdPath;
use crate::kernels::image_loss::{ImageLoss, ImagePair};
use crate::kernels::isect_emit::{count, emit, number_isects};
use crate::kernels::isect_offsets::isect_offsets;
use crate::kernels::project_bwd::project_bwd;
use crate::kernels::project_fwd::{Projected, project_fwd};
use crate::kernels::radix_sort::DepthSort;
use crate::kernels::rasterize_bwd::{
    FoldPart, FootprintGradients, Partial, Upstream, Weighing, WeightPartial, fold_rows, fold_weights, rasterize_bwd,
};
use crate::kernels::rasterize_fwd::{Lists, Raster, rasterize_fwd, untile};
use crate::kernels::scan::scan;
use crate::kernels::sh_bwd::sh_bwd;
use crate::kernels::sh_fwd::sh_fwd;
use crate::kernels::splats::{Grid, Packed, pack};
use crate::kernels::squared_error::squared_errors;
use crate::kernels::stages::STAGES;
use crate::kernels::tile_range::TileRange;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

/// Bytes of one intersection: its entry in a list, and its sums in the backward pass.
const LIST_BYTES: u64 = (size_of::<AtomicU64>() + size_of::<Partial>()) as u64;

/// Counters of the last view.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RenderStats {
    /// Visible rows.
    pub visible: u64,
    /// Intersections of rows and tiles.
    pub isects: u64,
    /// Pixel-Gaussian pairs that the forward pass evaluated.
    pub evaluated: u64,
}

/// Seconds of each stage of [`STAGES`] in the last view, summed over its batches.
#[derive(Debug, Default)]
struct StageClock {
    seconds: [f64; STAGES.len()],
}

impl StageClock {
    /// Runs `work` and adds the elapsed time to `stage`.
    fn time<T>(&mut self, stage: &str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let out = work();
        if let Some(at) = STAGES.iter().position(|s| s.name == stage) {
            self.seconds[at] += start.elapsed().as_secs_f64();
        }
        out
    }

    /// Sets the times of `stages` to zero, before the stages run again.
    fn reset(&mut self, stages: &[&str]) {
        let stages = STAGES.iter().zip(&mut self.seconds).filter(|(s, _)| stages.contains(&s.name));
        stages.for_each(|(_, seconds)| *seconds = 0.0);
    }
}

/// Renders views on the CPU.
#[derive(Debug, Default)]
pub struct CpuRenderer {
    sequence: Sequence,
    image: Image,
    alpha: Vec<f32>,
    projected: Projected,
    colors: Vec<[f32; 3]>,
    depth_sort: DepthSort,
    order: Vec<u32>,
    packed: Packed,
    tile_counts: Vec<u32>,
    /// Emit offsets by chunk of rows.
    chunk_offsets: Vec<u64>,
    tile_offsets: Vec<u64>,
    cursors: Vec<u64>,
    isects: Vec<AtomicU64>,
    raster: Raster,
    partials: Vec<Partial>,
    /// Whether the next views collect weights of rows, and whether this view does; the sums by intersection and by row,
    /// and the error of each pixel.
    weighs_next: bool,
    weighs: bool,
    weight_partials: Vec<WeightPartial>,
    weights: Vec<[f32; 2]>,
    errors: Vec<f32>,
    /// The ranges of tiles of the picture, in order.
    ranges: Vec<TileRange>,
    /// Intersections of each row in the range that is taken back now, and their sums by chunk of rows; unused by a picture of one
    /// range.
    range_counts: Vec<u32>,
    range_chunk_counts: Vec<u64>,
    /// Most bytes of intersections that are listed at once; `None`: all of them.
    list_bytes: Option<u64>,
    footprints: FootprintGradients,
    /// Rows of the view with unusable gradients.
    unusable: u64,
    image_loss: ImageLoss,
    loss_value: Option<LossValue>,
    gradient: PictureGradient,
    stats: RenderStats,
    clock: StageClock,
}

impl CpuRenderer {
    /// A renderer that holds no memory yet.
    pub fn new() -> Self {
        CpuRenderer::default()
    }

    /// Ranges of tiles of the last picture.
    pub fn ranges(&self) -> &[TileRange] {
        &self.ranges
    }

    /// Counts the intersections with the tiles of a range. Returns their number.
    fn count_range(&mut self, grid: Grid, range: TileRange, simd: SimdPath) -> u64 {
        count(&self.order, &self.packed, grid, range, simd, &mut self.tile_counts);
        isect_offsets(&self.tile_counts, grid.tiles(), &mut self.tile_offsets, &mut self.cursors);
        self.tile_offsets.last().copied().unwrap_or(0)
    }

    /// Lists the intersections with the tiles of a range that was counted last.
    fn list_range(&mut self, grid: Grid, range: TileRange, simd: SimdPath, isects: u64) {
        emit(&self.order, &self.packed, grid, range, simd, isects, &mut self.cursors, &mut self.isects);
    }

    fn rasterize(&mut self, grid: Grid, range: TileRange, options: &RenderOptions) {
        let mut raster = std::mem::take(&mut self.raster);
        rasterize_fwd(&self.lists(grid, range, options), &mut raster);
        self.raster = raster;
    }

    /// Copies the tiles into the picture.
    fn finish_picture(&mut self, grid: Grid) {
        let pixels = grid.width as usize * grid.height as usize;
        (self.image.width, self.image.height) = (grid.width, grid.height);
        self.image.rgb.resize(3 * pixels, 0.0);
        self.alpha.resize(pixels, 0.0);
        untile(grid, &self.raster, &mut self.image.rgb, &mut self.alpha);
    }

    fn lists(&self, grid: Grid, range: TileRange, options: &RenderOptions) -> Lists<'_> {
        Lists {
            grid,
            range,
            splats: &self.packed.splats,
            isects: &self.isects,
            tile_offsets: &self.tile_offsets,
            max_alpha: options.max_alpha,
            background: options.background,
            simd: options.simd,
        }
    }

    /// Coverage 1 - T of the last picture, `[height][width]`.
    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// Per-tile results of the last picture.
    pub fn raster(&self) -> &Raster {
        &self.raster
    }

    /// Footprints of the last view, one entry per row over all batches.
    pub fn projected(&self) -> &Projected {
        &self.projected
    }

    /// Takes the gradient of the picture back to the splats, range by range. The lists of a picture of one range are still
    /// there; others are made again.
    fn rasterize_back(&mut self, grid: Grid, options: &RenderOptions) {
        let ranges = std::mem::take(&mut self.ranges);
        for (i, &range) in ranges.iter().enumerate() {
            let part = FoldPart { is_first: i == 0, is_last: i + 1 == ranges.len() };
            if ranges.len() > 1 {
                let (counts, sums) = (&mut self.range_counts, &mut self.range_chunk_counts);
                number_isects(&mut self.packed, grid, range, options.simd, counts, sums);
                scan(&self.range_chunk_counts, &mut self.chunk_offsets);
                let isects = self.count_range(grid, range, options.simd);
                self.list_range(grid, range, options.simd, isects);
            }
            let mut partials = std::mem::take(&mut self.partials);
            let mut weight_partials = std::mem::take(&mut self.weight_partials);
            let upstream = Upstream { v_rgb: &self.gradient.v_rgb, v_alpha: self.gradient.v_alpha.as_deref() };
            let lists = self.lists(grid, range, options);
            let weighing = Weighing { errors: &self.errors, partials: &mut weight_partials };
            let weighing = self.weighs.then_some(weighing);
            rasterize_bwd(&lists, &self.chunk_offsets, &self.raster, &upstream, &mut partials, weighing);
            (self.partials, self.weight_partials) = (partials, weight_partials);
            let counts = if ranges.len() > 1 { &self.range_counts } else { &self.packed.counts };
            if self.weighs {
                let rows = (self.projected.rows(), counts.as_slice());
                fold_weights(part.is_first, rows, &self.chunk_offsets, &self.weight_partials, &mut self.weights);
            }
            let counts = [counts, &self.packed.counts].map(Vec::as_slice);
            self.unusable =
                fold_rows(part, counts, &self.chunk_offsets, &self.partials, &self.projected, &mut self.footprints);
        }
        self.ranges = ranges;
    }

    /// Seconds of each stage in the last view, in the order of [`STAGES`]; 0 for a stage that did not run.
    pub fn stage_seconds(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        STAGES.iter().zip(self.clock.seconds).map(|(stage, seconds)| (stage.name, seconds))
    }

    /// Counters of the last view.
    pub fn stats(&self) -> RenderStats {
        self.stats
    }

    /// Host memory that this renderer holds, bytes.
    pub fn scratch_bytes(&self) -> u64 {
        let p = &self.projected;
        let f = &self.footprints;
        self.depth_sort.bytes()
            + self.raster.bytes()
            + bytes(&self.image.rgb)
            + bytes(&self.alpha)
            + self.gradient.bytes()
            + (bytes(&p.means2d) + bytes(&p.conics) + bytes(&p.depths) + bytes(&p.radii) + bytes(&p.opacities))
            + (bytes(&self.colors) + bytes(&self.order) + bytes(&self.packed.splats))
            + (bytes(&self.packed.counts)
                + bytes(&self.packed.spans)
                + bytes(&self.tile_counts)
                + bytes(&self.chunk_offsets)
                + bytes(&self.packed.chunk_counts)
                + bytes(&self.tile_offsets)
                + bytes(&self.range_counts)
                + bytes(&self.range_chunk_counts))
            + (bytes(&self.cursors) + bytes(&self.isects) + bytes(&self.partials))
            + (bytes(&self.weight_partials) + bytes(&self.weights) + bytes(&self.errors))
            + (bytes(&f.v_means2d) + bytes(&f.v_conics) + bytes(&f.v_colors) + bytes(&f.v_opacities))
    }
}

impl Renderer for CpuRenderer {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn host_bytes(&self) -> u64 {
        self.scratch_bytes()
    }

    fn set_list_bytes(&mut self, bytes: Option<u64>) {
        self.list_bytes = bytes;
    }

    fn weigh_rows(&mut self, is_wanted: bool) -> Result<(), RenderError> {
        self.weighs_next = is_wanted;
        Ok(())
    }

    fn begin_view(&mut self, camera: &Camera, options: &RenderOptions, batches: RowBatches) -> Result<(), RenderError> {
        self.sequence.begin(camera, options, batches)?;
        (self.clock, self.stats, self.loss_value) = (StageClock::default(), RenderStats::default(), None);
        self.weighs = self.weighs_next;
        Ok(())
    }

    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError> {
        let (ViewOptions { camera, options }, place) = self.sequence.rows_in(rows)?;
        let RenderOptions { eps2d, sh_degree, simd, .. } = options;
        let Self { clock, projected, colors, .. } = self;
        clock.time("project_fwd", || project_fwd(rows, &camera, eps2d, simd, place.start, projected));
        clock.time("sh_fwd", || {
            room::resize(colors, place.end, [0.0; 3]);
            sh_fwd(rows, &camera, sh_degree, &projected.radii[place.clone()], simd, &mut colors[place]);
        });
        Ok(())
    }

    fn picture(&mut self) -> Result<(), RenderError> {
        let ViewOptions { camera, options } = self.sequence.picture()?;
        let grid = Grid::new(camera.width, camera.height);
        let mut clock = std::mem::take(&mut self.clock);
        let simd = options.simd;
        clock.time("radix_sort", || {
            self.depth_sort.sort(&self.projected.depths, &self.projected.radii, &mut self.order);
        });
        let total = clock.time("scan", || {
            pack(&self.projected, &self.colors, grid, simd, &mut self.packed);
            scan(&self.packed.chunk_counts, &mut self.chunk_offsets)
        });
        let all = TileRange::all(grid);
        clock.time("isect_offsets", || self.count_range(grid, all, simd));
        let isect_bytes = LIST_BYTES + if self.weighs { size_of::<WeightPartial>() as u64 } else { 0 };
        let isects_most = self.list_bytes.map(|bytes| bytes / isect_bytes);
        let ranges = match isects_most.filter(|most| total > *most) {
            Some(most) => {
                let of_tile = |x: u32, y: u32| {
                    let tile = y as usize * grid.tiles_x as usize + x as usize;
                    self.tile_offsets[tile + 1] - self.tile_offsets[tile]
                };
                TileRange::cut(grid, of_tile, |_, isects| isects <= most)
            }
            None => vec![all],
        };
        for &range in &ranges {
            let isects = match ranges.len() {
                1 => total,
                _ => clock.time("isect_offsets", || self.count_range(grid, range, simd)),
            };
            clock.time("isect_emit", || self.list_range(grid, range, simd, isects));
            clock.time("rasterize_fwd", || self.rasterize(grid, range, &options));
        }
        clock.time("rasterize_fwd", || self.finish_picture(grid));
        self.ranges = ranges;
        self.clock = clock;
        self.stats = RenderStats {
            visible: self.order.len() as u64,
            isects: total,
            evaluated: self.raster.evaluated.iter().sum(),
        };
        Ok(())
    }

    fn image(&mut self) -> Result<&Image, RenderError> {
        self.sequence.image()?;
        Ok(&self.image)
    }

    fn picture_mut(&mut self) -> Result<&mut [f32], RenderError> {
        self.sequence.image()?;
        Ok(&mut self.image.rgb)
    }

    fn loss(&mut self, target: &Target, options: &LossOptions) -> Result<(), RenderError> {
        self.sequence.loss(target)?;
        let Self { clock, image_loss, image, gradient: PictureGradient { v_rgb, v_alpha }, .. } = self;
        *v_alpha = None;
        clock.reset(&["image_loss"]);
        let value = clock.time("image_loss", || image_loss.value_and_gradient(image, target, options, v_rgb));
        self.loss_value = Some(value);
        if self.weighs {
            squared_errors(&ImagePair::new(&self.image, target), &mut self.errors);
        }
        Ok(())
    }

    fn picture_gradient(&mut self) -> Result<&mut PictureGradient, RenderError> {
        let (view, had_gradient) = self.sequence.picture_gradient()?;
        if !had_gradient {
            self.gradient.reset(view.camera.pixels());
            // No photo was compared.
            self.errors.clear();
            self.errors.resize(if self.weighs { view.camera.pixels() } else { 0 }, 0.0);
        }
        Ok(&mut self.gradient)
    }

    fn picture_back(&mut self) -> Result<(), RenderError> {
        let ViewOptions { camera, options } = self.sequence.picture_back(Some(&self.gradient))?;
        let grid = Grid::new(camera.width, camera.height);
        let mut clock = std::mem::take(&mut self.clock);
        clock.reset(&["rasterize_bwd", "sh_bwd", "project_bwd"]);
        clock.time("rasterize_bwd", || self.rasterize_back(grid, &options));
        self.clock = clock;
        Ok(())
    }

    fn rows_out(&mut self, batch: usize, rows: &Columns, grads: &mut Gradients) -> Result<(), RenderError> {
        let (ViewOptions { camera, options }, place) = self.sequence.rows_out(batch, rows)?;
        let RenderOptions { eps2d, sh_degree, simd, .. } = options;
        let Self { clock, projected, colors, footprints: v, .. } = self;
        let (radii, colors) = (&projected.radii[place.clone()], &colors[place.clone()]);
        let (v_means2d, v_conics) = (&v.v_means2d[place.clone()], &v.v_conics[place.clone()]);
        let (v_colors, v_opacities) = (&v.v_colors[place.clone()], &v.v_opacities[place.clone()]);
        let columns = &mut grads.columns;
        clock.time("sh_bwd", || sh_bwd(rows, &camera, sh_degree, radii, colors, v_colors, simd, columns));
        clock.time("project_bwd", || {
            project_bwd(rows, &camera, eps2d, radii, v_means2d, v_conics, v_opacities, simd, columns);
        });
        grads.means2d.clear();
        grads.means2d.extend_from_slice(v_means2d);
        grads.radii.clear();
        grads.radii.extend_from_slice(radii);
        grads.weights.clear();
        if self.weighs {
            grads.weights.extend_from_slice(&self.weights[place]);
        }
        Ok(())
    }

    fn unusable_splats(&mut self) -> Result<u64, RenderError> {
        self.sequence.splat_gradients("unusable_splats")?;
        Ok(self.unusable)
    }

    fn loss_value(&mut self) -> Result<LossValue, RenderError> {
        self.loss_value.ok_or(RenderError::OutOfOrder { call: "loss_value", needs: "loss" })
    }
}

fn bytes<T>(v: &Vec<T>) -> u64 {
    (v.capacity() * size_of::<T>()) as u64
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::kernels::image_loss::SsimPadding;
    use crate::scene::columns::Column;

    /// `rows` Gaussians in front of a camera; some are large, opaque, behind the camera or off the picture.
    fn scene(rows: usize, width: u32, height: u32) -> (Columns, Camera) {
        let mut draws = Stream::new(11, Purpose::Test, rows as u64, 0);
        let mut c = Columns::zeros(rows, 2);
        c.means.iter_mut().for_each(|x| *x = draws.range(-2.0, 2.0) as f32);
        c.quats.iter_mut().for_each(|x| *x = draws.normal() as f32);
        c.scales.iter_mut().for_each(|x| *x = draws.range(-5.0, -1.0) as f32);
        c.opacities.iter_mut().for_each(|x| *x = draws.range(-6.0, 7.0) as f32);
        c.sh0.iter_mut().chain(&mut c.sh_n).for_each(|x| *x = 0.5 * draws.normal() as f32);
        let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 1.5]];
        let (fx, fy, cx, cy) = (60.0, 65.0, 0.5 * width as f32, 0.5 * height as f32);
        (c, Camera { viewmat, fx, fy, cx, cy, width, height, near_plane: 0.01, far_plane: 1e10 })
    }

    fn bits(values: &[f32]) -> Vec<u32> {
        values.iter().map(|x| x.to_bits()).collect()
    }

    fn random_gradient(camera: &Camera) -> PictureGradient {
        let mut draws = Stream::new(12, Purpose::Test, 0, 0);
        let v_rgb = (0..3 * camera.pixels()).map(|_| draws.normal() as f32).collect();
        PictureGradient { v_rgb, v_alpha: Some((0..camera.pixels()).map(|_| draws.normal() as f32).collect()) }
    }

    /// Bits of image, alpha and all gradients for an instruction path and a number of threads.
    fn render_bits(rows: &Columns, camera: &Camera, simd: SimdPath, threads: usize) -> Vec<Vec<u32>> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut renderer = CpuRenderer::new();
            let options = RenderOptions { sh_degree: 2, background: [0.2, 0.4, 0.1], simd, ..RenderOptions::default() };
            renderer.draw(rows, camera, &options).unwrap();
            *renderer.picture_gradient().unwrap() = random_gradient(camera);
            let mut grads = Gradients::default();
            renderer.backpropagate(rows, &mut grads).unwrap();
            let rgb = bits(&renderer.image().unwrap().rgb);
            let mut all = vec![rgb, bits(renderer.alpha()), bits(grads.means2d.as_flattened())];
            all.extend(Column::ALL.map(|c| bits(grads.columns.column(c))));
            all
        })
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        // Enough rows for several chunks in every stage.
        let (rows, camera) = scene(20_000, 123, 77);
        let one = render_bits(&rows, &camera, SimdPath::best(), 1);
        assert!(one.iter().flatten().any(|b| *b != 0));
        for threads in [2, 16] {
            assert!(one == render_bits(&rows, &camera, SimdPath::best(), threads), "{threads} threads");
        }
    }

    fn part(rows: &Columns, place: std::ops::Range<usize>) -> Columns {
        let mut part = Columns { sh_degree: rows.sh_degree, ..Columns::default() };
        for column in Column::ALL {
            let width = column.width(rows.sh_degree);
            *part.column_mut(column) = rows.column(column)[place.start * width..place.end * width].to_vec();
        }
        part
    }

    /// As [`render_bits`] from a loss, with the rows in batches that end at `ends`; `rows_out` takes the last batch
    /// first.
    fn bits_of_batches(renderer: &mut CpuRenderer, rows: &Columns, camera: &Camera, ends: &[usize]) -> Vec<Vec<u32>> {
        let options = RenderOptions { sh_degree: 2, background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
        let firsts = std::iter::once(&0).chain(ends);
        let batches: Vec<Columns> = firsts.zip(ends).map(|(&first, &end)| part(rows, first..end)).collect();
        renderer.weigh_rows(true).unwrap();
        let how = if batches.len() == 1 { RowBatches::One } else { RowBatches::Several };
        renderer.begin_view(camera, &options, how).unwrap();
        batches.iter().for_each(|batch| renderer.rows_in(batch).unwrap());
        renderer.picture().unwrap();
        let rgb = (0..3 * camera.pixels()).map(|i| (i % 251) as u8).collect();
        let target = Target { width: camera.width, height: camera.height, rgb, mask: None };
        let loss = LossOptions { ssim_lambda: 0.2, padding: SsimPadding::Valid, simd: SimdPath::best() };
        renderer.loss(&target, &loss).unwrap();
        renderer.picture_back().unwrap();
        let mut all = vec![Vec::new(); 9];
        for (i, batch) in batches.iter().enumerate().rev() {
            let mut grads = Gradients::default();
            renderer.rows_out(i, batch, &mut grads).unwrap();
            let mut of_batch = vec![bits(grads.means2d.as_flattened()), grads.radii.as_flattened().to_vec()];
            of_batch.push(bits(grads.weights.as_flattened()));
            of_batch.extend(Column::ALL.map(|c| bits(grads.columns.column(c))));
            for (all, mut of_batch) in all.iter_mut().zip(of_batch) {
                of_batch.append(all);
                *all = of_batch;
            }
        }
        let value = renderer.loss_value().unwrap().loss.to_bits();
        all.extend([bits(&renderer.image().unwrap().rgb), vec![value as u32, (value >> 32) as u32]]);
        all
    }

    #[test]
    fn batches_do_not_change_a_bit() {
        // Batch sizes: no multiple of a block or chunk, one row, and zero rows. A larger view, then a smaller one.
        let mut renderer = CpuRenderer::new();
        for (n, cuts) in
            [(20_000, vec![vec![9_001], vec![1, 1, 4_096, 13_313], vec![0, 20_000]]), (900, vec![vec![450]])]
        {
            let (rows, camera) = scene(n, 123, 77);
            let one = bits_of_batches(&mut renderer, &rows, &camera, &[n]);
            assert!(one.iter().all(|values| values.iter().any(|b| *b != 0)));
            for mut ends in cuts {
                ends.push(n);
                assert!(
                    one == bits_of_batches(&mut renderer, &rows, &camera, &ends),
                    "{n} rows, batches end at {ends:?}"
                );
            }
        }
    }

    #[test]
    fn ranges_of_tiles_do_not_change_a_bit() {
        let mut renderer = CpuRenderer::new();
        let (rows, camera) = scene(20_000, 123, 77);
        let one = bits_of_batches(&mut renderer, &rows, &camera, &[20_000]);
        let isects = renderer.stats().isects;
        assert_eq!(renderer.ranges().len(), 1);
        // A few ranges, some fifty with parts of columns, and one for each of the 8 x 5 tiles.
        for (most, least_ranges) in [(isects / 3, 3), (isects / 30, 30), (0, 40)] {
            renderer.set_list_bytes(Some(most * LIST_BYTES));
            assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &[9_001, 20_000]), "lists of {most}");
            assert!(renderer.ranges().len() >= least_ranges, "{} ranges of {most}", renderer.ranges().len());
            let many = one == bits_of_batches(&mut renderer, &rows, &camera, &[20_000]);
            assert!(many, "lists of {most}, the same memory again");
        }
        renderer.set_list_bytes(None);
        assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &[20_000]));
    }

    #[test]
    fn stages_out_of_order_are_errors_and_change_nothing() {
        let (rows, camera) = scene(600, 40, 30);
        let (options, mut grads) = (RenderOptions { sh_degree: 2, ..RenderOptions::default() }, Gradients::default());
        let is_order = |result: Result<(), RenderError>| matches!(result, Err(RenderError::OutOfOrder { .. }));
        let mut renderer = CpuRenderer::new();
        assert!(is_order(renderer.rows_in(&rows)) && is_order(renderer.picture()));
        renderer.begin_view(&camera, &options, RowBatches::One).unwrap();
        assert!(is_order(renderer.picture()), "the rows are missing");
        renderer.rows_in(&rows).unwrap();
        assert!(is_order(renderer.rows_in(&rows)), "the view has one batch");
        renderer.begin_view(&camera, &options, RowBatches::Several).unwrap();
        renderer.rows_in(&rows).unwrap();
        renderer.rows_in(&rows).unwrap();
        assert!(is_order(renderer.image().map(|_| ())));
        renderer.picture().unwrap();
        assert!(is_order(renderer.rows_in(&rows)), "the picture has no more rows");
        assert!(is_order(renderer.picture_back()) && is_order(renderer.loss_value().map(|_| ())));
        *renderer.picture_gradient().unwrap() = random_gradient(&camera);
        assert!(is_order(renderer.rows_out(0, &rows, &mut grads)));
        renderer.picture_back().unwrap();
        renderer.rows_out(1, &rows, &mut grads).unwrap();
        let want = grads.clone();
        assert!(is_order(renderer.rows_out(1, &rows, &mut grads)), "this batch was processed already");
        assert!(is_order(renderer.picture_gradient().map(|_| ())), "the other batch is still due");
        let other = RenderError::BatchRows { batch: 0, given: 1 };
        assert_eq!(renderer.rows_out(0, &part(&rows, 0..1), &mut grads), Err(other));
        let beyond = RenderError::BatchRows { batch: 2, given: 600 };
        assert_eq!(renderer.rows_out(2, &rows, &mut grads), Err(beyond));
        renderer.rows_out(0, &rows, &mut grads).unwrap();
        // The backward pass may run again, from the same gradient.
        renderer.picture_back().unwrap();
        renderer.rows_out(1, &rows, &mut grads).unwrap();
        assert!(grads.columns == want.columns && grads.radii == want.radii);
        renderer.rows_out(0, &rows, &mut grads).unwrap();
        renderer.picture_gradient().unwrap().v_alpha = Some(Vec::new());
        assert_eq!(renderer.picture_back(), Err(RenderError::GradientSize { pixels: 40 * 30 }));
    }

    #[test]
    fn avx2_and_avx512_agree_to_the_bit() {
        if !SimdPath::Avx512.is_supported() {
            println!("SKIPPED: this machine has no AVX-512");
            return;
        }
        let (rows, camera) = scene(3000, 100, 60);
        let wide = render_bits(&rows, &camera, SimdPath::Avx512, 1);
        assert!(wide == render_bits(&rows, &camera, SimdPath::Avx2, 1));
    }

    #[test]
    fn empty_scenes_show_the_background() {
        let options = RenderOptions { sh_degree: 0, background: [0.25, 0.5, 0.75], ..RenderOptions::default() };
        let mut renderer = CpuRenderer::new();
        let mut grads = Gradients::default();
        for (n, width, height) in [(0, 33, 17), (50, 1, 1), (50, 16, 16), (0, 0, 0)] {
            let (mut rows, camera) = scene(n, width, height);
            // All rows behind the camera.
            rows.means.iter_mut().for_each(|x| *x -= 10.0);
            renderer.draw(&rows, &camera, &options).unwrap();
            let pixels = camera.pixels();
            let want: Vec<f32> = [0.25, 0.5, 0.75].iter().flat_map(|&c| vec![c; pixels]).collect();
            assert_eq!(renderer.image().unwrap().rgb, want);
            renderer.picture_gradient().unwrap().v_rgb = want;
            renderer.backpropagate(&rows, &mut grads).unwrap();
            assert_eq!(grads.columns, Columns::zeros(n, 2));
            assert_eq!(grads.radii, vec![[0, 0]; n]);
            assert_eq!(renderer.stats(), RenderStats::default());
        }
    }

    #[test]
    fn memory_stops_growing_once_warm() {
        let (rows, camera) = scene(5000, 123, 77);
        let options = RenderOptions { sh_degree: 1, ..RenderOptions::default() };
        let mut renderer = CpuRenderer::new();
        let mut grads = Gradients::default();
        let mut held = Vec::new();
        for _ in 0..3 {
            renderer.draw(&rows, &camera, &options).unwrap();
            let v_rgb = renderer.image().unwrap().rgb.clone();
            renderer.picture_gradient().unwrap().v_rgb.copy_from_slice(&v_rgb);
            renderer.backpropagate(&rows, &mut grads).unwrap();
            held.push(renderer.scratch_bytes());
        }
        assert!(held[0] > 0 && held[1] == held[0] && held[2] == held[0], "{held:?}");
    }
}
