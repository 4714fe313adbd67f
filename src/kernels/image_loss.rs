//! The training loss of a picture and its gradient: (1 - lambda) L1 + lambda (1 - SSIM). Cuts the picture into bands of
//! rows and sums the results of `ssim_band`; knows neither files nor a renderer.
//!
//! Masks: a pixel with mask byte 0 is excluded from the means of L1 and squared differences and has gradient 0. For
//! SSIM such pixels take the reference's values before filtering, so they add no difference to their neighbours'
//! windows, and the map is averaged over the used pixels only. If no pixel is used (all masked, or an empty picture),
//! loss and gradient are 0 and SSIM is 1.
//!
//! `SsimVariant::Valid` has no window on a picture with a side under 11 pixels: it falls back to `Same`.
//!
//! Invariants: 1. bands depend on the height alone and their f64 sums are added in order, so the bits are the same for
//! any number of threads; 2. a call allocates nothing if its picture is no larger than earlier ones; 3. a picture with
//! NaN or infinity at a used pixel gives a non-finite loss, never a panic.

pub use super::image_pair::{ImagePair, Reference, SsimVariant};
use super::image_pair::{WINDOW, counted};
use super::ssim_band::{BandKernel, BandSums, GradientBand};
use crate::base::room;
use crate::base::simd::{SimdPath, dispatch};
use crate::scene::image::{Image, Target};
use rayon::prelude::*;
use std::ops::Range;

/// Most rows of a band: few enough to give every core one, enough that the ten rows read twice cost little.
const BAND_ROWS: usize = 64;

/// The pixels that the SSIM map of the loss covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SsimPadding {
    /// Only windows inside the image (the default of the loss).
    Valid,
    /// Every pixel, with zeros outside (the 3DGS code).
    Same,
}

impl From<SsimPadding> for SsimVariant {
    fn from(padding: SsimPadding) -> Self {
        match padding {
            SsimPadding::Valid => SsimVariant::Valid,
            SsimPadding::Same => SsimVariant::Same,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossOptions {
    /// Weight of 1 - SSIM; L1 has weight 1 - lambda.
    pub ssim_lambda: f32,
    /// Pixels covered by the SSIM map.
    pub padding: SsimPadding,
    /// Instruction path of the CPU kernels.
    pub simd: SimdPath,
}

/// Loss of one image and its parts.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LossValue {
    /// (1 - lambda) l1 + lambda (1 - ssim).
    pub loss: f64,
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean of the SSIM map.
    pub ssim: f64,
    /// Mean squared difference of the unclamped image.
    pub mse: f64,
}

/// Weights that turn the sums over a picture into the loss; computed by the same code for every backend.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossPlan {
    /// The SSIM variant that is possible at this size.
    pub variant: SsimVariant,
    /// Number of used values: three per pixel.
    pub samples: f64,
    /// Number of used values of the SSIM map.
    pub windows: f64,
    /// Derivative of the loss with respect to the sum of absolute differences.
    pub l1_weight: f32,
    /// Derivative of the loss with respect to the sum of the SSIM map.
    pub ssim_weight: f32,
    lambda: f64,
}

impl LossPlan {
    /// The plan for a picture of this size; `mask` as in [`ImagePair::mask`].
    pub fn new(width: usize, height: usize, mask: Option<&[u8]>, options: &LossOptions) -> Self {
        let variant = SsimVariant::from(options.padding).possible(width, height);
        let lambda = f64::from(options.ssim_lambda);
        let samples = 3.0 * counted(mask, width, 0..height, 0..width) as f64;
        let windows = 3.0 * counted(mask, width, variant.domain(height), variant.domain(width)) as f64;
        LossPlan {
            variant,
            samples,
            windows,
            // No used pixel: no gradient.
            l1_weight: if samples > 0.0 { ((1.0 - lambda) / samples) as f32 } else { 0.0 },
            // If every window is masked but some border pixel is used, only L1 remains.
            ssim_weight: if windows > 0.0 { (-lambda / windows) as f32 } else { 0.0 },
            lambda,
        }
    }

    /// Pixels at each border that the SSIM map does not cover.
    pub fn margin(&self) -> usize {
        self.variant.domain(WINDOW).start
    }

    /// The loss from the sums of absolute differences, of squared differences and of the SSIM map.
    pub fn value(&self, l1: f64, squares: f64, ssim: f64) -> LossValue {
        if self.samples == 0.0 {
            return LossValue { ssim: 1.0, ..LossValue::default() };
        }
        let l1 = l1 / self.samples;
        let ssim = if self.windows > 0.0 { ssim / self.windows } else { 1.0 };
        LossValue { loss: (1.0 - self.lambda) * l1 + self.lambda * (1.0 - ssim), l1, ssim, mse: squares / self.samples }
    }
}

/// Computes losses; keeps the sums of bands between calls, so that later calls allocate nothing.
#[derive(Debug, Default)]
pub struct ImageLoss {
    sums: Vec<BandSums>,
}

impl ImageLoss {
    /// Loss of `image` against `target`, and its derivative with respect to every value of the image into `v_rgb`
    /// (planar `[3][height][width]`, resized; sign(0) = 0 in the L1 part).
    ///
    /// # Panics
    /// The sizes differ.
    pub fn value_and_gradient(
        &mut self,
        image: &Image,
        target: &Target,
        options: &LossOptions,
        v_rgb: &mut Vec<f32>,
    ) -> LossValue {
        self.pair_value_and_gradient(&ImagePair::new(image, target), options, v_rgb)
    }

    /// The same on plain slices; the reference may also be f32.
    ///
    /// # Panics
    /// A length does not match the size.
    pub fn pair_value_and_gradient(
        &mut self,
        pair: &ImagePair,
        options: &LossOptions,
        v_rgb: &mut Vec<f32>,
    ) -> LossValue {
        pair.check();
        let plan = LossPlan::new(pair.width, pair.height, pair.mask, options);
        let LossPlan { variant, l1_weight, ssim_weight, .. } = plan;
        let n = pair.pixels();
        room::resize(v_rgb, 3 * n, 0.0);
        if plan.samples == 0.0 {
            v_rgb.fill(0.0);
            return plan.value(0.0, 0.0, 0.0);
        }
        let bands = pair.height.div_ceil(BAND_ROWS);
        room::resize(&mut self.sums, 3 * bands, BandSums::default());
        let planes = v_rgb.par_chunks_mut(n).zip(self.sums.par_chunks_mut(bands)).enumerate();
        planes.for_each(|(channel, (v_plane, sums))| {
            let parts = v_plane.par_chunks_mut(BAND_ROWS * pair.width).zip(sums).enumerate();
            parts.for_each(|(band, (v_plane, sum))| {
                let gradient = Some(GradientBand { v_plane, l1_weight, ssim_weight });
                let rows = band_rows(band, pair.height);
                *sum = dispatch(options.simd, BandKernel { pair, variant, channel, rows, gradient });
            });
        });
        let total = add_up(&self.sums);
        plan.value(total.l1, total.squares, total.ssim)
    }
}

/// Mean of the SSIM map over pixels and channels; NaN if no pixel of the map is used.
///
/// # Panics
/// A length does not match the size.
pub fn mean_ssim(pair: &ImagePair, variant: SsimVariant, simd: SimdPath) -> f64 {
    pair.check();
    let variant = variant.possible(pair.width, pair.height);
    let windows = 3.0 * counted(pair.mask, pair.width, variant.domain(pair.height), variant.domain(pair.width)) as f64;
    if windows == 0.0 {
        return f64::NAN;
    }
    let bands = pair.height.div_ceil(BAND_ROWS);
    let sums: Vec<BandSums> = (0..3 * bands)
        .into_par_iter()
        .map(|i| {
            let rows = band_rows(i % bands, pair.height);
            dispatch(simd, BandKernel { pair, variant, channel: i / bands, rows, gradient: None })
        })
        .collect();
    add_up(&sums).ssim / windows
}

fn band_rows(band: usize, height: usize) -> Range<usize> {
    band * BAND_ROWS..((band + 1) * BAND_ROWS).min(height)
}

/// Adds sums in the order of channels and bands.
fn add_up(bands: &[BandSums]) -> BandSums {
    bands.iter().fold(BandSums::default(), |total, band| BandSums {
        l1: total.l1 + band.l1,
        squares: total.squares + band.squares,
        ssim: total.ssim + band.ssim,
    })
}
