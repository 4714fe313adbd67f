//! Camera: pose, intrinsics and size of one view, in the trainer's local frame.
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
    /// A pinhole with intrinsics `[fx, fy, cx, cy]` and size `[width, height]`, which draws depths from 0.01 on.
    pub fn pinhole(viewmat: [[f32; 4]; 3], [fx, fy, cx, cy]: [f32; 4], [width, height]: [u32; 2]) -> Camera {
        Camera { viewmat, fx, fy, cx, cy, width, height, near_plane: 0.01, far_plane: 1e10 }
    }

    /// Position of the camera in the world: `-R^T t`.
    pub fn centre(&self) -> [f32; 3] {
        let m = &self.viewmat;
        std::array::from_fn(|i| -(m[0][i] * m[0][3] + m[1][i] * m[1][3] + m[2][i] * m[2][3]))
    }

    /// The pixel position `[u, v]` of a point in the world, and its depth; `None` at or before the near plane. The position may lie outside
    /// of the picture.
    pub fn project(&self, point: [f64; 3]) -> Option<([f64; 2], f64)> {
        let [x, y, z] =
            self.viewmat.map(|row| (0..3).map(|i| f64::from(row[i]) * point[i]).sum::<f64>() + f64::from(row[3]));
        let [fx, fy, cx, cy] = [self.fx, self.fy, self.cx, self.cy].map(f64::from);
        (z > f64::from(self.near_plane)).then(|| ([fx * x / z + cx, fy * y / z + cy], z))
    }

    /// A camera of tests: at `x` on the first axis, looking along the third.
    #[cfg(test)]
    pub(crate) fn along_z(x: f32, intrinsics: [f32; 4], size: [u32; 2]) -> Camera {
        Camera::pinhole([[1.0, 0.0, 0.0, -x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], intrinsics, size)
    }

    /// The point in the world that pixel position `[u, v]` shows at depth `z`.
    pub fn unproject(&self, [u, v]: [f64; 2], z: f64) -> [f32; 3] {
        let x = (u - f64::from(self.cx)) / f64::from(self.fx) * z;
        let y = (v - f64::from(self.cy)) / f64::from(self.fy) * z;
        // R^T (p - t)
        let m = &self.viewmat;
        let moved: [f64; 3] = std::array::from_fn(|row| [x, y, z][row] - f64::from(m[row][3]));
        std::array::from_fn(|i| (0..3).map(|row| f64::from(m[row][i]) * moved[row]).sum::<f64>() as f32)
    }

    /// All numbers but the pose, as words: what tells cameras apart that stand at one place.
    pub fn lens_words(&self) -> [u32; 8] {
        let [fx, fy, cx, cy, near, far] =
            [self.fx, self.fy, self.cx, self.cy, self.near_plane, self.far_plane].map(f32::to_bits);
        [fx, fy, cx, cy, near, far, self.width, self.height]
    }

    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}
