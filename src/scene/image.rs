//! Images as data: rendered pictures and the photos they are compared with.

use crate::base::room;

/// A rendered picture: planar f32, `[3][height][width]`, not clamped.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Image {
    pub width: u32,
    pub height: u32,
    /// Red plane, green plane, blue plane, each row-major.
    pub rgb: Vec<f32>,
}

/// The photo of a view at training size: 8-bit, interleaved `[height][width][3]`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Target {
    pub width: u32,
    pub height: u32,
    pub rgb: Vec<u8>,
    /// One byte per pixel: 255 = used, 0 = excluded from loss and metrics; `None` if every pixel is used.
    pub mask: Option<Vec<u8>>,
}

/// Gradient of a loss with respect to a picture, in host memory: the input of the backward pass.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PictureGradient {
    /// `[3][height][width]`.
    pub v_rgb: Vec<f32>,
    /// `[height][width]`, with respect to the coverage 1 - T; `None` stands for zeros.
    pub v_alpha: Option<Vec<f32>>,
}

impl Image {
    pub fn new(width: u32, height: u32) -> Self {
        Image { width, height, rgb: vec![0.0; 3 * width as usize * height as usize] }
    }

    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// An interleaved 8-bit copy, clamped and rounded to nearest.
    pub fn to_rgb8(&self) -> Vec<u8> {
        let mut out = vec![0; 3 * self.pixels()];
        let rows = out.chunks_exact_mut((3 * self.width as usize).max(1)).enumerate();
        rows.for_each(|(y, row)| self.row_to_rgb8(y, row));
        out
    }

    /// Writes row `y` of [`Image::to_rgb8`] to `row`, which holds `3 * width` bytes.
    pub fn row_to_rgb8(&self, y: usize, row: &mut [u8]) {
        let (width, n) = (self.width as usize, self.pixels());
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            for (c, byte) in pixel.iter_mut().enumerate() {
                *byte = (self.rgb[c * n + y * width + x].clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
            }
        }
    }
}

impl Target {
    /// A photo of `[width, height]` pixels, all of which are used.
    pub fn new([width, height]: [u32; 2], rgb: Vec<u8>) -> Target {
        Target { width, height, rgb, mask: None }
    }

    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    pub fn counts(&self) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.iter().any(|&byte| byte != 0))
    }

    pub fn bytes(&self) -> u64 {
        (self.rgb.len() + self.mask.as_ref().map_or(0, Vec::len)) as u64
    }
}

impl PictureGradient {
    pub fn new(v_rgb: Vec<f32>, v_alpha: Vec<f32>) -> PictureGradient {
        PictureGradient { v_rgb, v_alpha: Some(v_alpha) }
    }

    /// Whether this is the gradient of a picture of `pixels` pixels.
    pub fn fits(&self, pixels: usize) -> bool {
        self.v_rgb.len() == 3 * pixels && self.v_alpha.as_ref().is_none_or(|v| v.len() == pixels)
    }

    /// Sets the gradient to zeros for a picture of `pixels` pixels; reuses the allocation.
    pub fn reset(&mut self, pixels: usize) {
        self.v_rgb.clear();
        room::resize(&mut self.v_rgb, 3 * pixels, 0.0);
        self.v_alpha = None;
    }

    pub fn bytes(&self) -> u64 {
        let floats = self.v_rgb.capacity() + self.v_alpha.as_ref().map_or(0, Vec::capacity);
        (4 * floats) as u64
    }
}
