//! Colour-corrected PSNR: PSNR after the colours of the render were fitted to the photo. The figure is roughly what a
//! model of exposure and white balance would reach. It differs from PSNR by a decibel or more on drone photos, so every
//! report names the fit. Several papers on city scenes report this figure only.
//!
//! The field uses two fits, both from MultiNeRF (github.com/google-research/multinerf), both of one photo at a time:
//! - [`ColorCorrect::Affine`] (RawNeRF; `color_correct_affine` of gsplat): per channel, the (a, b) that minimise
//!   sum (a photo + b - render)^2, inverted as (render - b) / a. A render that hardly resembles its photo has a small
//!   slope a, and the inversion magnifies the errors: such a figure is below PSNR;
//! - [`ColorCorrect::Quadratic`] (Mip-NeRF 360, Zip-NeRF; `color_correct` of nerfstudio and gsplat): each channel of
//!   the photo as a quadratic polynomial of the three channels of the render (10 terms), by least squares over
//!   unsaturated pixels, in five rounds that each start from the result of the last.
//!
//! Invariants: 1. renders are clamped to 0..1 before and after; 2. pixels with mask byte 0 are ignored; 3. sums are f64
//! in row order, so the bits are the same for any number of threads; 4. NaN at an unmasked pixel gives NaN; 5. nothing of a
//! pixel is stored: memory grows with the rows of a photo, not with its pixels.

use crate::base::names::names;
use crate::scene::image::{Image, Target};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Terms of a quadratic polynomial of three variables.
const TERMS: usize = 10;
/// Smallest variance or slope to divide by.
const DIVISOR_MIN: f64 = 1e-8;
/// A value is saturated when it is nearer to 0 or 1 than this: half a step of 8 bits.
const SATURATION_MARGIN: f64 = 0.5 / 255.0;
/// Rounds of the quadratic fit.
const ROUNDS: usize = 5;
/// Relative size of a Cholesky pivot below which the pivot is rounding error: the term depends on earlier terms.
const PIVOT_MIN: f64 = 1e-12;

/// The colour fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorCorrect {
    /// Slope and offset per channel.
    Affine,
    /// A quadratic polynomial of all three channels.
    Quadratic,
}

names!(ColorCorrect { Affine = "affine", Quadratic = "quadratic" });

type Rgb = [f64; 3];

/// PSNR of the render after the colours were fitted to the photo, dB. Infinity when the fitted render equals the photo,
/// NaN when every pixel is masked.
///
/// # Panics
/// When picture and target differ in size.
pub fn color_corrected_psnr(image: &Image, target: &Target, fit: ColorCorrect) -> f64 {
    assert_eq!((image.width, image.height), (target.width, target.height), "picture and photo differ in size");
    let pair = Pair { image, target };
    match fit {
        ColorCorrect::Affine => {
            let fits = [0, 1, 2].map(|c| pair.affine(c, |render, photo| (photo, render)));
            pair.psnr(|render| affine_inverse(&fits, render))
        }
        ColorCorrect::Quadratic => {
            let rounds = pair.quadratic();
            pair.psnr(|render| after_rounds(&rounds, render))
        }
    }
}

/// PSNR of the render after the slope and offset of each channel that bring it closest to the photo, dB: for comparing pictures of scenes whose
/// photos have exposures of their own. Unlike [`ColorCorrect::Affine`], which fits the other way round, it is at least the PSNR as it is (but
/// for clamping), whatever the render resembles. Infinity and NaN as in [`color_corrected_psnr`].
///
/// # Panics
/// When picture and target differ in size.
pub fn exposure_fitted_psnr(image: &Image, target: &Target) -> f64 {
    assert_eq!((image.width, image.height), (target.width, target.height), "picture and photo differ in size");
    let pair = Pair { image, target };
    let fits = [0, 1, 2].map(|c| pair.affine(c, |render, photo| (render, photo)));
    pair.psnr(|render| std::array::from_fn(|c| (fits[c].0 * render[c] + fits[c].1).clamp(0.0, 1.0)))
}

/// A render and its photo.
struct Pair<'a> {
    image: &'a Image,
    target: &'a Target,
}

impl Pair<'_> {
    /// Sums `of` (render clamped to 0..1, photo) over all unmasked pixels: rows in parallel, then the row sums in order.
    fn sum<const N: usize>(&self, of: impl Fn(Rgb, Rgb) -> [f64; N] + Sync) -> [f64; N] {
        let (width, pixels) = (self.image.width as usize, self.image.pixels());
        let add = |mut all: [f64; N], one: [f64; N]| {
            all.iter_mut().zip(one).for_each(|(a, b)| *a += b);
            all
        };
        let of_pixel = |i: usize| {
            let render = std::array::from_fn(|c| f64::from(self.image.rgb[c * pixels + i].clamp(0.0, 1.0)));
            of(render, std::array::from_fn(|c| f64::from(self.target.rgb[3 * i + c]) / 255.0))
        };
        let counts = |i: &usize| self.target.mask.as_ref().is_none_or(|mask| mask[*i] != 0);
        let of_row = |y: usize| (y * width..(y + 1) * width).filter(counts).map(of_pixel).fold([0.0; N], add);
        let sums: Vec<[f64; N]> = (0..self.image.height as usize).into_par_iter().map(of_row).collect();
        sums.into_iter().fold([0.0; N], add)
    }

    /// PSNR of the fitted render. The clamps of a fit would hide a NaN of the render, so look for NaN before the fit.
    fn psnr(&self, fitted: impl Fn(Rgb) -> Rgb + Sync) -> f64 {
        let [squares, count] = self.sum(|render, photo| {
            if render.iter().any(|x| x.is_nan()) {
                return [f64::NAN, 3.0];
            }
            let fitted = fitted(render);
            let squares: f64 = (0..3).map(|c| (fitted[c] - photo[c]) * (fitted[c] - photo[c])).sum();
            [squares, 3.0]
        });
        let mse = squares / count;
        if mse == 0.0 { f64::INFINITY } else { -10.0 * libm::log10(mse) }
    }

    /// Slope and offset that map the first value of a channel to the second with the least squares; `of` takes them from render and photo.
    fn affine(&self, c: usize, of: impl Fn(f64, f64) -> (f64, f64) + Sync) -> (f64, f64) {
        let [n, from, to] = self.sum(|r, p| {
            let (from, to) = of(r[c], p[c]);
            [1.0, from, to]
        });
        let (from, to) = (from / n, to / n);
        // Centred on the means, which avoids cancellation.
        let [square, product] = self.sum(|r, p| {
            let (x, y) = of(r[c], p[c]);
            [(x - from) * (x - from), (x - from) * (y - to)]
        });
        let slope = product / n / (square / n).max(DIVISOR_MIN);
        (slope, to - slope * from)
    }

    /// The polynomials of all rounds.
    fn quadratic(&self) -> Vec<Polynomials> {
        let is_unsaturated = |x: f64| (SATURATION_MARGIN..=1.0 - SATURATION_MARGIN).contains(&x);
        let mut rounds = Vec::with_capacity(ROUNDS);
        for _ in 0..ROUNDS {
            let of = |c: usize| {
                // The upper triangle of the normal equations, row by row, then the right-hand side.
                const SUMS: usize = TERMS * (TERMS + 1) / 2 + TERMS;
                let sums: [f64; SUMS] = self.sum(|first, photo| {
                    // Earlier rounds are applied again: keeping their results would take 24 bytes a pixel.
                    let render = after_rounds(&rounds, first);
                    if ![first[c], render[c], photo[c]].into_iter().all(is_unsaturated) {
                        return [0.0; SUMS];
                    }
                    let t = terms(&render);
                    let mut at = 0;
                    let mut sums = [0.0; SUMS];
                    for i in 0..TERMS {
                        for j in i..TERMS {
                            sums[at] = t[i] * t[j];
                            at += 1;
                        }
                    }
                    (0..TERMS).for_each(|i| sums[at + i] = t[i] * photo[c]);
                    sums
                });
                let (upper, right) = sums.split_at(SUMS - TERMS);
                solve(upper, right)
            };
            let round = [of(0), of(1), of(2)];
            rounds.push(round);
        }
        rounds
    }
}

/// A render under the inverse of slopes and offsets.
fn affine_inverse(fits: &[(f64, f64); 3], render: Rgb) -> Rgb {
    std::array::from_fn(|c| {
        let (slope, offset) = fits[c];
        ((render[c] - offset) / if slope.abs() < DIVISOR_MIN { 1.0 } else { slope }).clamp(0.0, 1.0)
    })
}

/// Weights of a polynomial for each channel.
type Polynomials = [[f64; TERMS]; 3];

/// A render after some rounds of the quadratic fit.
fn after_rounds(rounds: &[Polynomials], render: Rgb) -> Rgb {
    rounds.iter().fold(render, |render, weights| {
        let t = terms(&render);
        std::array::from_fn(|c| weights[c].iter().zip(t).map(|(w, t)| w * t).sum::<f64>().clamp(0.0, 1.0))
    })
}

/// Terms of the polynomial: rr, rg, rb, gg, gb, bb, r, g, b, 1.
fn terms([r, g, b]: &Rgb) -> [f64; TERMS] {
    [r * r, r * g, r * b, g * g, g * b, b * b, *r, *g, *b, 1.0]
}

/// Least-squares weights from the normal equations, by Cholesky decomposition. The order of elimination is the
/// constant, the linear terms, the quadratic terms. A term that depends linearly on earlier terms (as in a gray
/// picture) gets weight 0, which changes no fitted value.
fn solve(upper: &[f64], right: &[f64]) -> [f64; TERMS] {
    let at = |i: usize, j: usize| {
        let (i, j) = (TERMS - 1 - i.max(j), TERMS - 1 - i.min(j));
        upper[i * TERMS - i * i.saturating_sub(1) / 2 - i + j]
    };
    let mut lower = [[0.0; TERMS]; TERMS];
    let mut y = [0.0; TERMS];
    for i in 0..TERMS {
        for j in 0..=i {
            let rest = at(i, j) - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
            lower[i][j] = match i == j {
                true if rest > PIVOT_MIN * at(i, i) => rest.sqrt(),
                false if lower[j][j] > 0.0 => rest / lower[j][j],
                _ => 0.0,
            };
        }
        let rest = right[TERMS - 1 - i] - (0..i).map(|k| lower[i][k] * y[k]).sum::<f64>();
        y[i] = if lower[i][i] > 0.0 { rest / lower[i][i] } else { 0.0 };
    }
    let mut weights = [0.0; TERMS];
    for i in (0..TERMS).rev() {
        let rest = y[i] - (i + 1..TERMS).map(|k| lower[k][i] * weights[TERMS - 1 - k]).sum::<f64>();
        weights[TERMS - 1 - i] = if lower[i][i] > 0.0 { rest / lower[i][i] } else { 0.0 };
    }
    weights
}
