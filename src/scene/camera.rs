//! Camera: pose, pinhole intrinsics and size of one view, in the trainer's local frame.
//!
//! OpenCV axes: x right, y down, z forward. Loading removes distortion from the photos, so cameras are pinholes. The
//! centre of pixel (0, 0) is (0.5, 0.5).

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// World to camera, row-major 3x4: `p_cam = R p + t`, rows of `[R | t]`.
    pub viewmat: [[f32; 4]; 3],
    /// Focal lengths, pixels; then the principal point and the size of the image, pixels.
    pub fx: f32,
    pub fy: f32,
    pub cx: f32,
    pub cy: f32,
    pub width: u32,
    pub height: u32,
    /// Rows at or nearer than this depth are culled.
    pub near_plane: f32,
    /// Rows at or beyond this depth are culled.
    pub far_plane: f32,
}

impl Camera {
    /// Position of the camera in the world: `-R^T t`.
    pub fn centre(&self) -> [f32; 3] {
        let m = &self.viewmat;
        std::array::from_fn(|i| -(m[0][i] * m[0][3] + m[1][i] * m[1][3] + m[2][i] * m[2][3]))
    }

    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}
