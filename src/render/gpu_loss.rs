//! Records the image loss on a device: value and gradient of a picture against an 8-bit photo. The host reads only the
//! four sums from which the value follows.
//!
//! Invariants: 1. sums are trees in a fixed order: the same bits on every run of one device; 2. where memory is short or bindings are
//! small, one channel's derivative maps exist at a time.

use crate::gpu::{Buffer, BufferView, Gpu, GpuResult, Pipeline, Recorder, WORKGROUP, groups_1d};
use crate::kernels::image_loss::{LossPlan, LossValue};
use crate::kernels::uniforms::LossUniforms;
use std::sync::Arc;

/// The derivatives of all channels at once take at most this part of the memory that is left.
const ROOM_SHARE: u64 = 8;

#[derive(Debug)]
pub struct LossStage {
    ssim_map: Arc<Pipeline>,
    gradient: Arc<Pipeline>,
    sum_partials: Arc<Pipeline>,
    /// `None` before [`LossStage::weigh_rows`].
    squared_errors: Option<Arc<Pipeline>>,
}

impl LossStage {
    /// Compiles the stage.
    pub fn new(gpu: &Gpu) -> GpuResult<Self> {
        let entry = |name: &str| gpu.pipeline("image_loss.wgsl", name, &[]);
        Ok(LossStage {
            ssim_map: entry("ssim_map")?,
            gradient: entry("gradient")?,
            sum_partials: entry("sum_partials")?,
            squared_errors: None,
        })
    }

    /// Compiles [`LossStage::errors`].
    pub fn weigh_rows(&mut self, gpu: &Gpu) -> GpuResult<()> {
        self.squared_errors = Some(gpu.pipeline("image_loss.wgsl", "squared_errors", &[])?);
        Ok(())
    }

    /// Records the squared error of each pixel of the picture into `errors` (`[height][width]`): the twin of
    /// [`crate::kernels::squared_error`]. Does nothing before [`LossStage::weigh_rows`].
    pub fn errors(
        &self,
        recorder: &mut Recorder<'_>,
        [width, height]: [u32; 2],
        plan: &LossPlan,
        [rgb, target_pixels, errors]: [&BufferView; 3],
    ) -> GpuResult<()> {
        let Some(pipeline) = &self.squared_errors else { return Ok(()) };
        let uniform = recorder.uniform(&LossUniforms::new(width, height, plan))?;
        let views = [uniform, rgb.clone(), target_pixels.clone(), errors.clone()];
        recorder.dispatch("image_loss", pipeline, &views, groups_1d(width * height, WORKGROUP))
    }

    /// Records the gradient of the picture `rgb` (planar) against `target_pixels` (layout:
    /// [`crate::kernels::uniforms::pack_target`]) into `v_rgb`. Returns the buffer whose first four floats [`value`]
    /// turns into the loss, or `None` for a picture without pixels.
    pub fn run(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        [width, height]: [u32; 2],
        plan: &LossPlan,
        rgb: &BufferView,
        target_pixels: &BufferView,
        v_rgb: &BufferView,
    ) -> GpuResult<Option<Buffer>> {
        let tiles = LossUniforms::tiles(width, height);
        if tiles == 0 {
            return Ok(None);
        }
        let bytes = 12 * u64::from(width) * u64::from(height);
        let of_all = if 3 * bytes <= gpu.max_binding_bytes().min(gpu.room() / ROOM_SHARE) {
            gpu.optional_buffer("derivatives", 3 * bytes)?
        } else {
            None
        };
        let (derivatives, at_once) = match of_all {
            Some(derivatives) => (derivatives, 3),
            None => (gpu.buffer("derivatives", bytes)?, 1),
        };
        let mut partials = gpu.buffer("partials", 16 * 3 * u64::from(tiles))?;
        let mut uniforms = LossUniforms::new(width, height, plan);
        let groups = groups_1d(at_once * tiles, 1);
        for channel in (0..3).step_by(at_once as usize) {
            (uniforms.first_channel, uniforms.channel_count) = (channel, at_once);
            let uniform = recorder.uniform(&uniforms)?;
            let (map, sums) = (derivatives.view(), partials.view());
            let views = [uniform.clone(), rgb.clone(), target_pixels.clone(), map.clone(), sums.clone()];
            recorder.dispatch("image_loss", &self.ssim_map, &views, groups)?;
            let views = [uniform, rgb.clone(), target_pixels.clone(), map, v_rgb.clone(), sums];
            recorder.dispatch("image_loss", &self.gradient, &views, groups)?;
        }
        let mut count = 3 * tiles;
        loop {
            uniforms.partial_count = count;
            let uniform = recorder.uniform(&uniforms)?;
            count = count.div_ceil(LossUniforms::PARTIALS_PER_GROUP);
            let sums = gpu.buffer("loss sums", 16 * u64::from(count))?;
            let views = [uniform, partials.view(), sums.view()];
            recorder.dispatch("image_loss", &self.sum_partials, &views, groups_1d(count, 1))?;
            if count == 1 {
                return Ok(Some(sums));
            }
            partials = sums;
        }
    }
}

/// The loss from the four sums of [`LossStage::run`].
pub fn value(plan: &LossPlan, sums: [f32; 4]) -> LossValue {
    let [l1, squares, ssim, _] = sums.map(f64::from);
    plan.value(l1, squares, ssim)
}
