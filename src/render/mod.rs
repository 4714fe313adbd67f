//! The stages in order: forward, loss, backward; and image metrics.

pub mod cpu;
pub mod metrics;

use crate::base::simd::SimdPath;
pub use crate::kernels::image_loss::{LossOptions, LossValue, SsimPadding};

/// What a rendering depends on besides rows and camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderOptions {
    /// Bands in use now, 0 to 3; at most the degree the rows are stored with.
    pub sh_degree: u8,
    /// Upper clamp of alpha.
    pub max_alpha: f32,
    /// Blur of the projected covariance, px^2.
    pub eps2d: f32,
    /// RGB added behind everything.
    pub background: [f32; 3],
    /// Instruction path of the CPU kernels.
    pub simd: SimdPath,
}

impl Default for RenderOptions {
    fn default() -> Self {
        RenderOptions { sh_degree: 3, max_alpha: 0.99, eps2d: 0.3, background: [0.0; 3], simd: SimdPath::best() }
    }
}

/// Gradients of one view, one entry per row of the working set.
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    /// With respect to the stored (pre-activation) columns.
    pub columns: crate::scene::columns::Columns,
    /// With respect to the pixel position of the mean, signed, pixel units.
    pub means2d: Vec<[f32; 2]>,
    /// Half extents of the footprint, pixels; [0, 0]: the row was not drawn.
    pub radii: Vec<[u32; 2]>,
}
