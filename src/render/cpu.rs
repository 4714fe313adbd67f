//! [`CpuRenderer`]: the stages of a view on the CPU, forward and backward, and the memory that the stages share.
//!
//! Not here: the computation of each stage (`crate::kernels`), and the order of calls (`super::sequence`).
//!
//! # Memory
//! A view is crowded if its visible rows alone need longer lists of intersections than the budget allows, since every
//! visible row has at least one intersection. Such a view frees each buffer after the last stage that reads the buffer:
//!
//! | bytes a row | buffer | freed |
//! | --- | --- | --- |
//! | 36 + 4 | gradients of splats, and counts of a range | when the next view begins |
//! | 16 | keys of the sort | after the sort |
//! | 4 | depths | after the sort |
//! | 8 + 12 | projected means and colours, which the packed splats hold too | after packing |
//!
//! At most 152 bytes a row are held at once, instead of 192, and 12 bytes for each row of one batch, whose colours are taken
//! from the packed splats. Sums of weights, where a strategy collects them, come on top.
//!
//! Between views, the owner of a renderer can free all buffers that grow with rows: frames of pages need the memory of a
//! view that is far wider than the coming ones.
//!
//! Invariants: 1. buffers of views that are not crowded grow only when a view is larger than all views before; 2. the result has the
//! same bits for any number of threads, for any split of the rows into batches, on the AVX2 and AVX-512 paths, whether a view is
//! crowded, and whenever buffers are freed.

use super::sequence::{Sequence, ViewOptions};
use super::{Gradients, LossOptions, LossValue, PictureGradient, RenderError, RenderOptions, Renderer, RowBatches};
use crate::base::room;
use crate::base::simd::SimdPath;
use crate::kernels::fold::{FoldPart, FootprintGradients, Partial, WeightPartial, fold_rows, fold_weights};
use crate::kernels::image_loss::{ImageLoss, ImagePair};
use crate::kernels::isect_emit::{count, emit, number_isects};
use crate::kernels::isect_offsets::isect_offsets;
use crate::kernels::project_bwd::project_bwd;
use crate::kernels::project_fwd::{Projected, project_fwd};
use crate::kernels::radix_sort::DepthSort;
use crate::kernels::raster::Lists;
use crate::kernels::rasterize_bwd::{Upstream, Weighing, rasterize_bwd};
use crate::kernels::rasterize_fwd::{Raster, rasterize_fwd, untile};
use crate::kernels::scan::scan;
use crate::kernels::sh_bwd::sh_bwd;
use crate::kernels::sh_fwd::sh_fwd;
use crate::kernels::splats::{Grid, Packed, Span, Splat, pack};
use crate::kernels::squared_error::squared_errors;
use crate::kernels::stages::STAGES;
use crate::kernels::tile_range::TileRange;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::{Image, Target};
use std::ops::Range;
use std::sync::atomic::AtomicU64;
use std::time::Instant;

/// Bytes of one intersection: its entry in a list, and its sums in the backward pass.
const LIST_BYTES: u64 = (size_of::<AtomicU64>() + size_of::<Partial>()) as u64;

/// Most bytes that a crowded view holds for a visible row, beside lists, pixels and weights: conic, radii, opacity and depth
/// order; packed splat, span and count; gradients of the splat, and the count of a range.
const CROWDED_ROW_BYTES: usize =
    (12 + 8 + 4 + 4) + (size_of::<Splat>() + size_of::<Span>() + 4) + (8 + 12 + 12 + 4) + 4;

/// Bytes that a view with room holds for a visible row on top: keys of the sort, depth, projected mean and colour.
const ROOMY_ROW_BYTES: usize = 16 + 4 + 8 + 12;
/// Bytes that a crowded view holds on top for a row of one batch: colour.
const BATCH_ROW_BYTES: usize = 12;

/// Buffers keep at most an eighth to spare ([`crate::base::room`]).
const SPARE_SHARE: u64 = 8;
/// Bytes of the depth sort that do not grow with rows: its tables.
const SORT_TABLES_BYTES: u64 = 256 << 10;

/// Counters of the last view.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RenderStats {
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
        if let Some(at) = STAGES.iter().position(|s| *s == stage) {
            self.seconds[at] += start.elapsed().as_secs_f64();
        }
        out
    }

    /// Sets the times of `stages` to zero, before the stages run again.
    fn reset(&mut self, stages: &[&str]) {
        let stages = STAGES.iter().zip(&mut self.seconds).filter(|(s, _)| stages.contains(s));
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
    /// Weights of rows: whether the next views collect them, whether this view does, the sums by intersection and by
    /// row, and the error of each pixel.
    weighs_next: bool,
    weighs: bool,
    weight_partials: Vec<WeightPartial>,
    weights: Vec<[f32; 2]>,
    errors: Vec<f32>,
    /// The ranges of tiles of the picture, in order.
    ranges: Vec<TileRange>,
    /// Intersections of each row with the range that the backward pass is in, and their sums by chunk of rows. Unused
    /// for a picture of one range.
    range_counts: Vec<u32>,
    range_chunk_counts: Vec<u64>,
    /// Most bytes of intersections that are listed at once; `None`: all of them.
    list_bytes: Option<u64>,
    /// Whether this view gives buffers up between stages, and the most bytes that any view held: in total, and in
    /// buffers that grow with rows.
    is_crowded: bool,
    bytes_most: u64,
    row_bytes_most: u64,
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
        room::resize(&mut self.image.rgb, 3 * pixels, 0.0);
        room::resize(&mut self.alpha, pixels, 0.0);
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
        STAGES.into_iter().zip(self.clock.seconds)
    }

    /// Counters of the last view.
    pub fn stats(&self) -> RenderStats {
        self.stats
    }

    /// Most intersections that are listed at once.
    fn isects_most(&self) -> Option<u64> {
        let isect_bytes = LIST_BYTES + if self.weighs { size_of::<WeightPartial>() as u64 } else { 0 };
        self.list_bytes.map(|bytes| bytes / isect_bytes)
    }

    /// Whether the visible rows alone need longer lists than the budget allows.
    fn lists_are_short(&self) -> bool {
        let visible = || self.projected.radii.iter().filter(|radii| **radii != [0, 0]).count() as u64;
        self.isects_most().is_some_and(|most| visible() > most)
    }

    /// Frees what only the backward pass of the view before has read.
    fn free_after_view(&mut self) {
        self.note_bytes();
        if self.is_crowded {
            self.footprints = FootprintGradients::default();
            self.range_counts = Vec::new();
        }
    }

    /// Frees what only the sort reads.
    fn free_after_sort(&mut self) {
        self.note_bytes();
        if self.is_crowded {
            self.depth_sort.free();
            self.projected.depths = Vec::new();
        }
    }

    /// Frees the buffers whose content the packed splats repeat.
    fn free_after_pack(&mut self) {
        self.note_bytes();
        if self.is_crowded {
            self.projected.means2d = Vec::new();
            self.colors = Vec::new();
        }
    }

    /// The range of `colors` that holds the colours of a batch of rows, made again from the packed splats if they were freed.
    fn colors_of(&mut self, rows: Range<usize>) -> Range<usize> {
        if !self.is_crowded {
            return rows;
        }
        self.colors.clear();
        room::reserve(&mut self.colors, rows.len());
        self.colors.extend(self.packed.splats[rows].iter().map(|splat| splat.color));
        0..self.colors.len()
    }

    fn note_bytes(&mut self) {
        self.row_bytes_most = self.row_bytes_most.max(self.bytes_of_rows());
        self.bytes_most = self.bytes_most.max(self.scratch_bytes());
    }

    /// Host memory that this renderer holds now, bytes.
    pub fn scratch_bytes(&self) -> u64 {
        self.bytes_of_rows() + self.bytes_of_lists_and_pixels()
    }

    /// Host memory in buffers that grow with the rows of a view, held now, bytes.
    fn bytes_of_rows(&self) -> u64 {
        let (p, f) = (&self.projected, &self.footprints);
        let Packed { splats, spans, counts, .. } = &self.packed;
        self.depth_sort.bytes()
            + (bytes(&p.means2d) + bytes(&p.conics) + bytes(&p.depths) + bytes(&p.radii) + bytes(&p.opacities))
            + (bytes(&self.colors) + bytes(&self.order) + bytes(splats) + bytes(spans) + bytes(counts))
            + (bytes(&self.range_counts) + bytes(&self.weights))
            + (bytes(&f.v_means2d) + bytes(&f.v_conics) + bytes(&f.v_colors) + bytes(&f.v_opacities))
    }

    /// Grows with intersections, chunks of rows, tiles and pixels.
    fn bytes_of_lists_and_pixels(&self) -> u64 {
        (bytes(&self.isects) + bytes(&self.partials) + bytes(&self.weight_partials))
            + (bytes(&self.packed.chunk_counts) + bytes(&self.chunk_offsets) + bytes(&self.range_chunk_counts))
            + (bytes(&self.tile_counts) + bytes(&self.tile_offsets) + bytes(&self.cursors))
            + (bytes(&self.image.rgb) + bytes(&self.alpha) + bytes(&self.errors))
            + (self.raster.bytes() + self.gradient.bytes())
    }
}

fn bytes<T>(v: &Vec<T>) -> u64 {
    (v.capacity() * size_of::<T>()) as u64
}

impl Renderer for CpuRenderer {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn host_bytes(&self) -> u64 {
        self.scratch_bytes().max(self.bytes_most)
    }

    fn host_bytes_of_rows(&self) -> u64 {
        self.bytes_of_rows().max(self.row_bytes_most)
    }

    fn host_bytes_for_rows(&self, rows: u64) -> u64 {
        let is_crowded = self.isects_most().is_some_and(|most| rows > most);
        let weights = if self.weighs_next { size_of::<[f32; 2]>() } else { 0 };
        let row_bytes = CROWDED_ROW_BYTES + weights + if is_crowded { BATCH_ROW_BYTES } else { ROOMY_ROW_BYTES };
        (rows + rows / SPARE_SHARE) * row_bytes as u64 + SORT_TABLES_BYTES
    }

    fn free_rows(&mut self) {
        self.projected = Projected::default();
        self.colors = Vec::new();
        self.depth_sort.free();
        self.order = Vec::new();
        self.packed = Packed::default();
        self.range_counts = Vec::new();
        self.weights = Vec::new();
        self.footprints = FootprintGradients::default();
        (self.bytes_most, self.row_bytes_most) = (0, 0);
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
        self.free_after_view();
        (self.clock, self.stats, self.loss_value) = (StageClock::default(), RenderStats::default(), None);
        self.weighs = self.weighs_next;
        Ok(())
    }

    fn rows_in(&mut self, rows: &Columns) -> Result<(), RenderError> {
        let (ViewOptions { camera, options }, place) = self.sequence.rows_in(rows.rows(), rows.sh_degree)?;
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
        self.is_crowded = self.lists_are_short();
        clock.time("radix_sort", || {
            self.depth_sort.sort(&self.projected.depths, &self.projected.radii, &mut self.order);
        });
        self.free_after_sort();
        let total = clock.time("scan", || {
            pack(&self.projected, &self.colors, grid, simd, &mut self.packed);
            scan(&self.packed.chunk_counts, &mut self.chunk_offsets)
        });
        self.free_after_pack();
        let all = TileRange::all(grid);
        clock.time("isect_offsets", || self.count_range(grid, all, simd));
        let ranges = match self.isects_most().filter(|most| total > *most) {
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
        self.note_bytes();
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
        let Self { clock, image_loss, image, gradient, errors, .. } = self;
        gradient.v_alpha = None;
        clock.reset(&["image_loss"]);
        let value =
            clock.time("image_loss", || image_loss.value_and_gradient(image, target, options, &mut gradient.v_rgb));
        self.loss_value = Some(value);
        if self.weighs {
            clock.time("image_loss", || squared_errors(&ImagePair::new(image, target), errors));
        }
        Ok(())
    }

    fn picture_gradient(&mut self) -> Result<&mut PictureGradient, RenderError> {
        let (view, had_gradient) = self.sequence.picture_gradient()?;
        if !had_gradient {
            self.gradient.reset(view.camera.pixels());
            // No photo was compared.
            self.errors.clear();
            room::resize(&mut self.errors, if self.weighs { view.camera.pixels() } else { 0 }, 0.0);
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
        let (ViewOptions { camera, options }, place) = self.sequence.rows_out(batch, rows.rows())?;
        let RenderOptions { eps2d, sh_degree, simd, .. } = options;
        self.note_bytes();
        let colors_at = self.colors_of(place.clone());
        let Self { clock, projected, colors, footprints: v, .. } = self;
        let (radii, colors) = (&projected.radii[place.clone()], &colors[colors_at]);
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

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests;
