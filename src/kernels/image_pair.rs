//! A picture and its reference on plain slices, and the variants of SSIM that compare them.
//!
//! Not here: the comparison itself (`image_loss`, `ssim_band`).

use crate::base::names::names;
use crate::scene::image::{Image, Target};
use std::ops::Range;

/// Side of the SSIM window, pixels.
pub(super) const WINDOW: usize = 11;
/// Pixels on each side of the window's centre.
pub(super) const RADIUS: usize = 5;

/// Variants of SSIM; published figures use all three, and they differ in the third digit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum SsimVariant {
    /// Mean over every pixel, with zeros outside the picture: the 3DGS code.
    #[default]
    Same,
    /// Mean over the windows inside the picture: scikit-image, pytorch-msssim.
    Valid,
    /// Mean over every pixel, with the picture mirrored at its borders: torchmetrics.
    Reflect,
}

names!(SsimVariant { Same = "same", Valid = "valid", Reflect = "reflect" });

impl SsimVariant {
    /// Positions along a side of the picture that the map covers.
    pub(super) fn domain(self, side: usize) -> Range<usize> {
        match self {
            SsimVariant::Valid => RADIUS..side.saturating_sub(RADIUS),
            SsimVariant::Same | SsimVariant::Reflect => 0..side,
        }
    }

    /// The variant that is possible at this size.
    pub(super) fn possible(self, width: usize, height: usize) -> SsimVariant {
        if width.min(height) < WINDOW && self == SsimVariant::Valid { SsimVariant::Same } else { self }
    }
}

#[derive(Debug, Clone, Copy)]
pub enum Reference<'a> {
    /// Interleaved `[height][width][3]`; a byte stands for byte / 255.
    Bytes(&'a [u8]),
    /// Planar `[3][height][width]`.
    Planar(&'a [f32]),
}

/// A picture and its reference, of one size, on plain slices.
#[derive(Debug, Clone, Copy)]
pub struct ImagePair<'a> {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// The picture to judge, planar `[3][height][width]`.
    pub rgb: &'a [f32],
    pub reference: Reference<'a>,
    /// One byte per pixel, 0 = excluded; `None`: every pixel is used.
    pub mask: Option<&'a [u8]>,
    /// Clamp the values to 0..1 first, as metrics do. The gradient ignores the clamp: keep it `false` for the loss.
    pub clamp: bool,
}

impl<'a> ImagePair<'a> {
    /// A picture and its photo.
    pub fn new(image: &'a Image, target: &'a Target) -> Self {
        assert_eq!((image.width, image.height), (target.width, target.height), "picture and target differ in size");
        ImagePair {
            width: image.width as usize,
            height: image.height as usize,
            rgb: &image.rgb,
            reference: Reference::Bytes(&target.rgb),
            mask: target.mask.as_deref(),
            clamp: false,
        }
    }

    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Number of used pixels.
    pub fn counted_pixels(&self) -> usize {
        counted(self.mask, self.width, 0..self.height, 0..self.width)
    }

    /// Panics if a length does not match the size.
    pub(super) fn check(&self) {
        let n = self.pixels();
        let reference = match self.reference {
            Reference::Bytes(bytes) => bytes.len(),
            Reference::Planar(values) => values.len(),
        };
        assert!(self.rgb.len() == 3 * n && reference == 3 * n, "a picture's length does not fit its size");
        assert!(self.mask.is_none_or(|mask| mask.len() == n), "the mask's length does not fit the picture");
    }
}

/// Number of used pixels in a part of a picture.
pub(super) fn counted(mask: Option<&[u8]>, width: usize, rows: Range<usize>, columns: Range<usize>) -> usize {
    let Some(mask) = mask else { return rows.len() * columns.len() };
    rows.map(|row| {
        let line = &mask[row * width..][columns.clone()];
        line.iter().filter(|&&byte| byte != 0).count()
    })
    .sum()
}
