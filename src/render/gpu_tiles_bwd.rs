//! Records the backward half of the tile stages: the gradient sums of each intersection, then the gradients of each
//! row's splat.
//!
//! Invariants: 1. the sums of all intersections may exceed one binding: each window of intersections has its own pass
//! over the lists, and a row that spans two windows continues its sums, so the result has the same bits for any window
//! size; 2. the order of every sum is fixed.

use super::gpu_tiles::{Demand, Frame, Ranks, TileStages, raster_uniforms, words};
use crate::gpu::{BufferView, Gpu, GpuResult, Recorder, groups_1d};
use crate::kernels::uniforms_tiles::{
    FOLD_ROWS, HAS_V_ALPHA, RasterUniforms, SEGMENT_BWD, SEGMENT_FIRST, SEGMENT_LAST, SUMS,
};
use std::ops::Range;

/// Gradient of the picture on the device: the input of the backward pass.
#[derive(Debug, Clone, Copy)]
pub struct PictureGradientBuffers<'a> {
    /// `[3][height][width]` f32.
    pub v_rgb: &'a BufferView,
    /// `[height][width]` f32; `None` stands for zeros.
    pub v_alpha: Option<&'a BufferView>,
}

/// Intersections whose sums fit one binding, at least 1.
fn window_isects(gpu: &Gpu) -> u32 {
    let bytes = 4 * u64::from(SUMS);
    u32::try_from(gpu.max_binding_bytes() / bytes).unwrap_or(u32::MAX).max(1)
}

impl TileStages {
    /// Records the gradients of the splats into `v_splats`, one record per row. [`TileStages::fits`] must be true for
    /// `frame` and `demand`.
    ///
    /// # Errors
    /// Device memory is exhausted.
    pub fn backward(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        ranks: &Ranks,
        frame: &Frame,
        demand: Demand,
        picture: PictureGradientBuffers<'_>,
        v_splats: &BufferView,
    ) -> GpuResult<()> {
        let grid = frame.blend.grid;
        let segments = demand.list_max.div_ceil(SEGMENT_BWD).max(1);
        let pixels = u64::from(grid.width) * u64::from(grid.height);
        let window = window_isects(gpu).min(demand.isects.max(1));
        let partials = gpu.buffer("sums of intersections", u64::from(SUMS) * words(window))?;
        let carry = gpu.buffer("pixels between segments", if segments > 1 { 8 * pixels } else { 8 })?;
        let mut first = 0u32;
        loop {
            let isects = first..demand.isects.min(first.saturating_add(window));
            let (carry, partials) = (carry.view(), partials.view());
            let buffers = (splats, &carry, &partials);
            self.sums(recorder, frame, segments, isects.clone(), picture, buffers)?;
            let mut fold = window_uniforms(frame, 0, 0, isects.clone());
            (fold.row_count, fold.isect_count) = (ranks.rows, demand.isects);
            let views = [
                recorder.uniform(&fold)?,
                splats.clone(),
                frame.row_from_isect.view(),
                partials,
                ranks.order.view(),
                ranks.offsets.view(),
                v_splats.clone(),
            ];
            let groups = groups_1d(ranks.rows, FOLD_ROWS);
            recorder.dispatch("rasterize_bwd", &self.pipelines.fold_rows, &views, groups)?;
            first = isects.end;
            if first >= demand.isects {
                return Ok(());
            }
        }
    }

    /// Records one pass over all lists, back to front, that stores the sums of the intersections in the window
    /// `isects`.
    fn sums(
        &self,
        recorder: &mut Recorder<'_>,
        frame: &Frame,
        segments: u32,
        isects: Range<u32>,
        PictureGradientBuffers { v_rgb, v_alpha }: PictureGradientBuffers<'_>,
        (splats, carry, partials): (&BufferView, &BufferView, &BufferView),
    ) -> GpuResult<()> {
        let tiles = frame.blend.grid.tiles_x * frame.blend.grid.tiles_y;
        for segment in (0..segments).rev() {
            let mut flags = if v_alpha.is_some() { HAS_V_ALPHA } else { 0 };
            flags |= if segment + 1 == segments { SEGMENT_FIRST } else { 0 };
            flags |= if segment == 0 { SEGMENT_LAST } else { 0 };
            let views = [
                recorder.uniform(&window_uniforms(frame, segment, flags, isects.clone()))?,
                splats.clone(),
                frame.row_from_isect.view(),
                frame.isects.view(),
                frame.tile_offsets.view(),
                frame.t_final.view(),
                frame.stops.view(),
                v_rgb.clone(),
                v_alpha.unwrap_or(v_rgb).clone(),
                partials.clone(),
                carry.clone(),
            ];
            recorder.dispatch("rasterize_bwd", &self.pipelines.rasterize_bwd, &views, groups_1d(tiles, 1))?;
        }
        Ok(())
    }
}

fn window_uniforms(frame: &Frame, segment: u32, flags: u32, isects: Range<u32>) -> RasterUniforms {
    let (window_first, window_end) = (isects.start, isects.end);
    RasterUniforms { window_first, window_end, ..raster_uniforms(&frame.blend, segment, SEGMENT_BWD, flags) }
}
