//! Records the backward half of the tile stages: the gradient sums of each intersection, then the gradients of each
//! row's splat.
//!
//! Invariants: 1. the sums of all intersections may exceed one binding: each window of intersections has its own pass
//! over the lists, and a row that spans two windows continues its sums, so the result has the same bits for any window
//! size; 2. the same holds for ranges of tiles ([`Fold::Range`]), whose rows continue the sums of the ranges before; 3. the
//! order of every sum is fixed; 4. collecting weights changes no bit of the gradients, and costs nothing when it is off.

use super::gpu_frame::{Blend, Demand, Frame, Pixels, Ranks, raster_uniforms};
use super::gpu_rows::WEIGHS;
use super::gpu_segments::{Segment, gradients_of};
use crate::gpu::{Buffer, BufferView, Gpu, GpuResult, Pipeline, Recorder, groups_1d};
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms::{
    FOLD_CARRIED, FOLD_ROWS, FOLD_UNFINISHED, FOLD_WITHOUT_LISTS, HAS_V_ALPHA, RasterUniforms, SEGMENT_BWD,
    SEGMENT_FIRST, SEGMENT_LAST, SUMS, WEIGHED_FOLD_ROWS, WEIGHED_SUMS, range_words,
};
use std::ops::Range;
use std::sync::Arc;

/// Gradient of the picture on the device: the input of the backward pass.
#[derive(Debug, Clone, Copy)]
pub struct PictureGradientBuffers<'a> {
    /// `[3][height][width]` f32, and a fourth plane if `has_v_alpha`.
    pub v_rgb: &'a BufferView,
    /// Whether alpha has a gradient other than zero.
    pub has_v_alpha: bool,
    /// `[height][width]` f32: the error of each pixel; `None` if the rows are not weighed. Needs [`BackStages::weigh_rows`].
    pub errors: Option<&'a BufferView>,
}

/// What becomes of the sums of the rows of a frame.
#[derive(Debug, Clone, Copy)]
pub enum Fold<'a> {
    /// The frame is the whole view: sums begin at zero and become gradients.
    Whole,
    /// The frame is a range of tiles: the rows continue the sums that their records hold, and store sums.
    Range,
    /// As `Range`, for a part of the list of a tile. Parts come farthest first; between two of them, the buffer holds the state
    /// of the pixels (8 B a pixel).
    Part(&'a Buffer),
}

/// Least intersections of a window, and most windows: each window costs a pass over all lists.
const WINDOW_MIN: u32 = 1 << 10;
const WINDOWS_MOST: u32 = 4;

/// A buffer for the sums of a window of at most `isects` intersections, of `bytes` each: as many as fit one binding and device
/// memory.
fn window_of_sums(gpu: &Gpu, isects: u32, bytes: u64) -> GpuResult<(Buffer, u32)> {
    let most = u32::try_from(gpu.max_binding_bytes() / bytes).unwrap_or(u32::MAX).max(1);
    let mut window = most.min(isects.max(1));
    let least = isects.div_ceil(WINDOWS_MOST).max(WINDOW_MIN);
    loop {
        match gpu.buffer("sums of intersections", bytes * u64::from(window)) {
            Err(error) if error.is_out_of_memory() && window > least => window = window.div_ceil(2).max(least),
            buffer => return Ok((buffer?, window)),
        }
    }
}

/// Bytes of the state of the pixels between two segments or parts: two words a pixel; the transmittance has one.
pub fn carry_bytes(pixels: &Pixels) -> u64 {
    2 * pixels.t_final.size()
}

/// The stages of a backward pass, with or without weights.
#[derive(Debug)]
struct Sums {
    rasterize_bwd: Arc<Pipeline>,
    fold_rows: Arc<Pipeline>,
    /// Sums of an intersection.
    count: u32,
    rows_per_group: u32,
}

/// Most pairs of a pixel and a list entry in one dispatch. Windows resets a device whose dispatch takes longer than two seconds. A small
/// integrated GPU blends some 4 G pairs backwards in that time (estimated).
const DISPATCH_PAIRS: u64 = 1 << 32;

/// The compiled tile stages of the backward pass.
#[derive(Debug)]
pub struct BackStages {
    /// Most pairs of a pixel and a list entry in one dispatch, of the forward pass, too; tests lower it. It changes no result.
    pub dispatch_pairs: u64,
    plain: Sums,
    /// `None` before [`BackStages::weigh_rows`].
    weighing: Option<Sums>,
}

impl BackStages {
    pub(super) fn new(gpu: &Gpu) -> GpuResult<BackStages> {
        let get = |entry: &str| gpu.pipeline("rasterize_bwd.wgsl", entry, &[]);
        let (rasterize_bwd, fold_rows) = (get("rasterize_bwd")?, get("fold_rows")?);
        let plain = Sums { rasterize_bwd, fold_rows, count: SUMS, rows_per_group: FOLD_ROWS };
        Ok(BackStages { dispatch_pairs: DISPATCH_PAIRS, plain, weighing: None })
    }

    /// The bands of tiles of a range that get a dispatch each, and a submission each if there are several. A dispatch blends `entries` entries of
    /// each list.
    pub(super) fn bands(&self, range: TileRange, entries: u32) -> Vec<TileRange> {
        let pairs_of_tile = 256 * u64::from(entries.max(1));
        range.bands(u32::try_from(self.dispatch_pairs / pairs_of_tile).unwrap_or(u32::MAX)).collect()
    }

    /// Compiles what the backward pass needs to collect weights.
    pub fn weigh_rows(&mut self, gpu: &Gpu) -> GpuResult<()> {
        let get = |entry: &str| gpu.pipeline("rasterize_bwd.wgsl", entry, &WEIGHS);
        let (rasterize_bwd, fold_rows) = (get("rasterize_bwd")?, get("fold_rows")?);
        self.weighing = Some(Sums { rasterize_bwd, fold_rows, count: WEIGHED_SUMS, rows_per_group: WEIGHED_FOLD_ROWS });
        Ok(())
    }

    fn stages(&self, weighs: bool) -> &Sums {
        self.weighing.as_ref().filter(|_| weighs).unwrap_or(&self.plain)
    }

    /// Records the gradients of the splats into `v_splats`, one record per row, and adds the number of rows with unusable gradients, as
    /// [`crate::render::Renderer::unusable_splats`] defines them, to the u32 `unusable`.
    /// [`super::gpu_tiles::TileStages::fits`] must be true for `frame` and `demand`.
    pub fn backward(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        ranks: &Ranks,
        frame: &Frame,
        pixels: &Pixels,
        demand: Demand,
        picture: PictureGradientBuffers<'_>,
        (v_splats, unusable): (&BufferView, &Buffer),
        fold: Fold<'_>,
    ) -> GpuResult<()> {
        let segments = demand.list_max.div_ceil(SEGMENT_BWD).max(1);
        let stages = self.stages(picture.errors.is_some());
        let isect_bytes = 4 * u64::from(stages.count);
        let (own_carry, partials, window);
        let carry = match fold {
            Fold::Part(carry) => {
                // One window: a second one would begin with the pixels as they are after this part, not before it.
                window = demand.isects.max(1);
                partials = gpu.buffer("sums of intersections", isect_bytes * u64::from(window))?;
                carry
            }
            Fold::Whole | Fold::Range => {
                let bytes = if segments > 1 { carry_bytes(pixels) } else { 8 };
                own_carry = gpu.buffer("pixels between segments", bytes)?;
                (partials, window) = window_of_sums(gpu, demand.isects, isect_bytes)?;
                &own_carry
            }
        };
        let fold_flags = if matches!(fold, Fold::Whole) { 0 } else { FOLD_CARRIED | FOLD_UNFINISHED };
        let mut first = 0u32;
        loop {
            let isects = first..demand.isects.min(first.saturating_add(window));
            let (carry, partials) = (carry.view(), partials.view());
            let buffers = (splats, pixels, &carry, &partials);
            self.sums(recorder, frame, demand.list_max, isects.clone(), picture, buffers)?;
            let mut fold = window_uniforms(frame, 0, fold_flags, isects.clone());
            (fold.row_count, fold.isect_count) = (ranks.rows, demand.isects);
            let views = [
                recorder.uniform(&fold)?,
                splats.clone(),
                frame.row_from_isect.view(),
                partials,
                ranks.order.view(),
                ranks.offsets.view(),
                v_splats.clone(),
                unusable.view(),
            ];
            let groups = groups_1d(ranks.rows, stages.rows_per_group);
            recorder.dispatch("rasterize_bwd", &stages.fold_rows, &views, groups)?;
            first = isects.end;
            if first >= demand.isects {
                return Ok(());
            }
        }
    }

    /// Records one pass over all lists, back to front, that stores the sums of the intersections in the window
    /// `isects`: a dispatch for each segment of the lists, which have up to `list_max` entries, and each band of tiles.
    fn sums(
        &self,
        recorder: &mut Recorder<'_>,
        frame: &Frame,
        list_max: u32,
        isects: Range<u32>,
        PictureGradientBuffers { v_rgb, has_v_alpha, errors }: PictureGradientBuffers<'_>,
        (splats, pixels, carry, partials): (&BufferView, &Pixels, &BufferView, &BufferView),
    ) -> GpuResult<()> {
        let segments = list_max.div_ceil(SEGMENT_BWD).max(1);
        let bands = self.bands(frame.range, list_max.min(SEGMENT_BWD));
        for (segment, &band) in (0..segments).rev().flat_map(|segment| bands.iter().map(move |band| (segment, band))) {
            let mut flags = if has_v_alpha { HAS_V_ALPHA } else { 0 };
            flags |= if segment + 1 == segments && frame.part.is_farthest { SEGMENT_FIRST } else { 0 };
            flags |= if segment == 0 && frame.part.is_nearest { SEGMENT_LAST } else { 0 };
            let mut views = vec![
                recorder.uniform(&RasterUniforms {
                    range: range_words(band),
                    ..window_uniforms(frame, segment, flags, isects.clone())
                })?,
                splats.clone(),
                frame.row_from_isect.view(),
                frame.isects.view(),
                frame.tile_offsets.view(),
                pixels.t_final.view(),
                pixels.stops.view(),
                v_rgb.clone(),
                partials.clone(),
                carry.clone(),
            ];
            views.extend(errors.cloned());
            let groups = groups_1d(band.tiles(), 1);
            recorder.dispatch("rasterize_bwd", &self.stages(errors.is_some()).rasterize_bwd, &views, groups)?;
            if bands.len() > 1 {
                recorder.submit_so_far()?;
            }
        }
        Ok(())
    }

    /// Records the conversion of the sums of `rows` rows to gradients, after the last range of tiles, and counts as
    /// [`BackStages::backward`].
    pub(super) fn finish_sums(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        segment: &Segment,
        unusable: &Buffer,
        blend: Blend,
        weighs: bool,
    ) -> GpuResult<()> {
        let (rows, splats, v_splats) = (segment.rows, segment.splats.view(), gradients_of(segment)?.view());
        let stages = self.stages(weighs);
        // Bound in place of the lists that the stage does not read.
        let (no_list, no_sums) = (gpu.buffer("no list", 4)?.view(), gpu.buffer("no sums", 4)?.view());
        let flags = FOLD_CARRIED | FOLD_WITHOUT_LISTS;
        let mut fold = raster_uniforms(&blend, TileRange::all(blend.grid), 0, SEGMENT_BWD, flags);
        fold.row_count = rows;
        let uniform = recorder.uniform(&fold)?;
        let lists = [no_list.clone(), no_sums, no_list.clone(), no_list];
        let views: Vec<_> = [uniform, splats].into_iter().chain(lists).chain([v_splats, unusable.view()]).collect();
        recorder.dispatch("rasterize_bwd", &stages.fold_rows, &views, groups_1d(rows, stages.rows_per_group))
    }
}

fn window_uniforms(frame: &Frame, segment: u32, flags: u32, isects: Range<u32>) -> RasterUniforms {
    let (window_first, window_end) = (isects.start, isects.end);
    RasterUniforms {
        window_first,
        window_end,
        list_base: frame.part.base,
        ..raster_uniforms(&frame.blend, frame.range, segment, SEGMENT_BWD, flags)
    }
}
