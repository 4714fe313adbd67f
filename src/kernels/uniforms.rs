//! Uniforms and packed targets for the device's per-row stages and image loss.
//!
//! Not here: buffers, dispatches, the uniforms of the tile stages.
//!
//! Invariants: 1. each struct has the layout of its twin in `shaders/`, which documents its fields; 2. numbers that
//! both backends need are computed once, by the same code.

use crate::kernels::image_loss::LossPlan;
use crate::kernels::project_fwd::View;
use crate::scene::camera::Camera;
use crate::scene::image::Target;

crate::wgsl_struct! {
    /// Uniform of `project_fwd`, `sh_fwd`, `sh_bwd` and `project_bwd`: `RowsUniforms` in `shaders/shared/camera.wgsl`.
    pub struct RowsUniforms {
        /// Rows of the world-to-camera rotation, with the translation last.
        pub world_to_camera: [[f32; 4]; 3],
        /// Cofactors of the rotation, last 0.
        pub cofactors: [[f32; 4]; 3],
        /// Position of the camera in the world.
        pub centre: [f32; 3],
        /// Blur of the covariance, px^2.
        pub eps2d: f32,
        /// Focal lengths, pixels.
        pub focal: [f32; 2],
        /// Principal point, pixels.
        pub principal: [f32; 2],
        /// Image size, pixels.
        pub size: [f32; 2],
        /// Drawn depths are strictly between these.
        pub depth_range: [f32; 2],
        /// Lower limit of X/Z and Y/Z inside the Jacobian.
        pub slope_low: [f32; 2],
        /// Upper limit.
        pub slope_high: [f32; 2],
        /// Rows of the window.
        pub row_count: u32,
        _pad: [u32; 3],
    }
}

impl RowsUniforms {
    /// Uniforms for a window of `row_count` rows.
    pub fn new(camera: &Camera, eps2d: f32, row_count: u32) -> Self {
        let view = View::new(camera, eps2d);
        let with_last = |row: [f32; 3], last: f32| [row[0], row[1], row[2], last];
        RowsUniforms {
            world_to_camera: std::array::from_fn(|i| with_last(view.rotation[i], view.translation[i])),
            cofactors: view.cofactors.map(|row| with_last(row, 0.0)),
            centre: camera.centre(),
            eps2d,
            focal: view.focal,
            principal: view.principal,
            size: view.size,
            depth_range: view.depth_range,
            slope_low: view.slope_low,
            slope_high: view.slope_high,
            row_count,
            _pad: [0; 3],
        }
    }
}

crate::wgsl_struct! {
    /// Uniform of `image_loss`: `LossUniforms` in `shaders/image_loss.wgsl`.
    pub struct LossUniforms {
        /// Pixels.
        pub width: u32,
        /// Pixels.
        pub height: u32,
        /// First channel of this dispatch.
        pub first_channel: u32,
        /// Channels of this dispatch.
        pub channel_count: u32,
        /// Pixels at each border that the SSIM map does not cover.
        pub margin: u32,
        /// Derivative of the loss with respect to the sum of absolute differences.
        pub l1_weight: f32,
        /// Derivative of the loss with respect to the sum of the SSIM map.
        pub ssim_weight: f32,
        /// Number of partial sums that `sum_partials` reads.
        pub partial_count: u32,
    }
}

impl LossUniforms {
    /// Partial sums per workgroup of `sum_partials`.
    pub const PARTIALS_PER_GROUP: u32 = 4096;

    /// Uniforms for all three channels in one dispatch; `partial_count` is that of the first run of `sum_partials`.
    pub fn new(width: u32, height: u32, plan: &LossPlan) -> Self {
        LossUniforms {
            width,
            height,
            first_channel: 0,
            channel_count: 3,
            margin: plan.margin() as u32,
            l1_weight: plan.l1_weight,
            ssim_weight: plan.ssim_weight,
            partial_count: 3 * Self::tiles(width, height),
        }
    }

    /// Workgroups of `ssim_map` and `gradient` per channel.
    pub fn tiles(width: u32, height: u32) -> u32 {
        let side = super::constants::TILE;
        width.div_ceil(side) * height.div_ceil(side)
    }
}

/// Packs a photo for `image_loss`: one word per pixel, red in the lowest byte, then green, blue and the mask.
pub fn pack_target(target: &Target, words: &mut Vec<u32>) {
    let (pixels, _) = target.rgb.as_chunks::<3>();
    words.clear();
    match &target.mask {
        None => words.extend(pixels.iter().map(|&[r, g, b]| u32::from_le_bytes([r, g, b, 255]))),
        Some(mask) => {
            words.extend(pixels.iter().zip(mask).map(|(&[r, g, b], &byte)| u32::from_le_bytes([r, g, b, byte])));
        }
    }
}
