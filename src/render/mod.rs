//! The stages in order: forward, loss, backward; and image metrics.

use crate::base::simd::SimdPath;

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

/// Which pixels the SSIM map covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SsimPadding {
    /// Only windows that lie inside the image (the default of the loss).
    Valid,
    /// Every pixel, zeros outside (the 3DGS code).
    Same,
}
