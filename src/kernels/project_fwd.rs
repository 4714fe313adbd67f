//! (being written) Rows to footprints on the screen.

/// Footprints of rows, one entry per row of the working set; entries of culled rows are not read.
#[derive(Debug, Clone, Default)]
pub struct Projected {
    /// Pixel position of the mean.
    pub means2d: Vec<[f32; 2]>,
    /// Inverse of the blurred 2D covariance: xx, xy, yy.
    pub conics: Vec<[f32; 3]>,
    /// Camera-space z.
    pub depths: Vec<f32>,
    /// Half extents of the footprint's box in pixels, rounded up; [0, 0] marks a culled row.
    pub radii: Vec<[u32; 2]>,
    /// Opacity after activation.
    pub opacities: Vec<f32>,
}
