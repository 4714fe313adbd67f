//! Image metrics for reports: PSNR and SSIM of a rendered picture against its photo.
//!
//! Not here: the training loss with its gradient (`kernels::image_loss`). Metrics clamp values to 0..1 first.
//!
//! Invariants: 1. pictures are clamped but not rounded to 8 bits; 2. pixels with mask byte 0 are ignored; 3. the bits
//! are the same for any number of threads; 4. NaN at an unmasked pixel makes the metric NaN.

use crate::base::simd::SimdPath;
pub use crate::kernels::image_loss::SsimVariant;
use crate::kernels::image_loss::{ImagePair, mean_ssim};
use crate::scene::image::{Image, Target};
use rayon::prelude::*;
use std::ops::Range;

/// Mean squared difference over unmasked pixels and channels, values clamped to 0..1; NaN when every pixel is masked.
///
/// # Panics
/// When picture and target differ in size.
pub fn mse(image: &Image, target: &Target) -> f64 {
    assert_eq!((image.width, image.height), (target.width, target.height), "picture and photo differ in size");
    mse_of_columns(&image.rgb, target, 0..image.width as usize)
}

/// [`mse`] of some columns of pixels of a picture, `[3][height][width]`.
fn mse_of_columns(picture: &[f32], target: &Target, columns: Range<usize>) -> f64 {
    let (width, pixels) = (target.width as usize, target.pixels());
    assert_eq!(picture.len(), 3 * pixels, "picture and photo differ in size");
    let of_row = |row: usize| {
        let (mut sum, mut counted) = (0.0, 0u64);
        for i in row * width + columns.start..row * width + columns.end {
            if target.mask.as_ref().is_some_and(|mask| mask[i] == 0) {
                continue;
            }
            counted += 1;
            for c in 0..3 {
                let x = f64::from(picture[c * pixels + i].clamp(0.0, 1.0));
                let difference = x - f64::from(target.rgb[3 * i + c]) / 255.0;
                sum += difference * difference;
            }
        }
        (sum, counted)
    };
    let rows: Vec<(f64, u64)> = (0..target.height as usize).into_par_iter().map(of_row).collect();
    let counted: u64 = rows.iter().map(|(_, counted)| counted).sum();
    rows.iter().map(|(sum, _)| sum).sum::<f64>() / (3.0 * counted as f64)
}

/// Peak signal-to-noise ratio, dB: -10 log10 of [`mse`] for a peak of 1. A picture equal to its photo has PSNR
/// `f64::INFINITY`; JSON has no infinity, so the caller decides what to print. NaN when every pixel is masked.
///
/// # Panics
/// When picture and target differ in size.
pub fn psnr(image: &Image, target: &Target) -> f64 {
    decibels(mse(image, target))
}

/// [`psnr`] of some columns of pixels of a picture, `[3][height][width]`.
///
/// # Panics
/// When picture and target differ in size.
pub fn psnr_of_columns(picture: &[f32], target: &Target, columns: Range<usize>) -> f64 {
    decibels(mse_of_columns(picture, target, columns))
}

fn decibels(mse: f64) -> f64 {
    if mse == 0.0 { f64::INFINITY } else { -10.0 * libm::log10(mse) }
}

/// Mean structural similarity over pixels and channels (11x11 Gaussian window, sigma 1.5), values clamped to 0..1.
/// Masked pixels take the photo's value before filtering and are excluded from the mean; NaN when every pixel is
/// masked. [`SsimVariant::Valid`] falls back to `Same` when a side is under 11 pixels.
///
/// # Panics
/// When picture and target differ in size.
pub fn ssim(image: &Image, target: &Target, variant: SsimVariant, simd: SimdPath) -> f64 {
    let pair = ImagePair { clamp: true, ..ImagePair::new(image, target) };
    mean_ssim(&pair, variant, simd)
}

/// Mean over views. Every view has the same weight, whatever its size; PSNR is averaged in dB (both are the field's
/// convention). NaN for no views; NaN or infinity in a view stays visible in the mean.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gradient_pair(width: u32, height: u32) -> (Image, Target) {
        let n = (width * height) as usize;
        let rgb: Vec<u8> = (0..3 * n).map(|i| (i * 37 % 256) as u8).collect();
        let target = Target::new([width, height], rgb);
        let mut image = Image::new(width, height);
        for i in 0..n {
            for c in 0..3 {
                image.rgb[c * n + i] = f32::from(target.rgb[3 * i + c]) / 255.0;
            }
        }
        (image, target)
    }

    #[test]
    fn a_perfect_picture_is_infinitely_good() {
        let (image, target) = gradient_pair(23, 14);
        // The only difference is one f32 rounding of byte / 255 per value, at most 2^-25 each: above 144 dB.
        assert!(psnr(&image, &target) > 144.0);
        for variant in SsimVariant::ALL {
            // f32 rounding of windowed sums, relative to C2 = 9e-4.
            assert!((ssim(&image, &target, variant, SimdPath::best()) - 1.0).abs() < 1e-5);
        }
        let white = Target::new([4, 3], vec![255; 36]);
        let mut bright = Image::new(4, 3);
        bright.rgb.fill(7.5);
        assert_eq!(psnr(&bright, &white), f64::INFINITY, "clamped to white");
    }

    #[test]
    fn masked_pixels_do_not_matter_and_nan_shows() {
        let (mut image, mut target) = gradient_pair(23, 14);
        image.rgb[40] = 0.9;
        let mut mask = vec![255u8; 23 * 14];
        mask[100] = 0;
        target.mask = Some(mask);
        let before = (psnr(&image, &target), SsimVariant::ALL.map(|v| ssim(&image, &target, v, SimdPath::best())));
        image.rgb[100] = f32::NAN;
        assert_eq!(
            before,
            (psnr(&image, &target), SsimVariant::ALL.map(|v| ssim(&image, &target, v, SimdPath::best())))
        );
        image.rgb[101] = f32::NAN;
        assert!(psnr(&image, &target).is_nan());
        assert!(SsimVariant::ALL.iter().all(|&v| ssim(&image, &target, v, SimdPath::best()).is_nan()));
        target.mask = Some(vec![0; 23 * 14]);
        assert!(psnr(&image, &target).is_nan() && ssim(&image, &target, SsimVariant::Same, SimdPath::best()).is_nan());
    }
}
