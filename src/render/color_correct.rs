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
//! in row order, so the bits are the same for any number of threads; 4. NaN at an unmasked pixel gives NaN.

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

impl ColorCorrect {
    /// The name in reports and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            ColorCorrect::Affine => "affine",
            ColorCorrect::Quadratic => "quadratic",
        }
    }

    /// The fit with this name.
    pub fn from_name(name: &str) -> Option<ColorCorrect> {
        [ColorCorrect::Affine, ColorCorrect::Quadratic].into_iter().find(|c| c.name() == name)
    }
}

type Rgb = [f64; 3];

/// PSNR of the render after the colours were fitted to the photo, dB. Infinity when the fitted render equals the photo,
/// NaN when every pixel is masked.
///
/// # Panics
/// When picture and target differ in size.
pub fn color_corrected_psnr(image: &Image, target: &Target, fit: ColorCorrect) -> f64 {
    assert_eq!((image.width, image.height), (target.width, target.height), "picture and photo differ in size");
    let rows = pairs(image, target);
    if rows.iter().any(|row| row.iter().any(|(render, _)| render.iter().any(|x| x.is_nan()))) {
        return f64::NAN;
    }
    let corrected = match fit {
        ColorCorrect::Affine => affine(&rows),
        ColorCorrect::Quadratic => quadratic(&rows),
    };
    let [squares, count] = sum(&corrected, &rows, |fitted, (_, photo)| {
        let squares: f64 = (0..3).map(|c| (fitted[c] - photo[c]) * (fitted[c] - photo[c])).sum();
        [squares, 3.0]
    });
    let mse = squares / count;
    if mse == 0.0 { f64::INFINITY } else { -10.0 * libm::log10(mse) }
}

/// Unmasked pixels by picture row: (render clamped to 0..1, photo).
fn pairs(image: &Image, target: &Target) -> Vec<Vec<(Rgb, Rgb)>> {
    let (width, pixels) = (image.width as usize, image.pixels());
    let counts = |i: usize| target.mask.as_ref().is_none_or(|mask| mask[i] != 0);
    let pair = |i: usize| {
        let render = std::array::from_fn(|c| f64::from(image.rgb[c * pixels + i].clamp(0.0, 1.0)));
        (render, std::array::from_fn(|c| f64::from(target.rgb[3 * i + c]) / 255.0))
    };
    let rows = (0..image.height as usize).into_par_iter();
    rows.map(|row| (row * width..(row + 1) * width).filter(|&i| counts(i)).map(pair).collect()).collect()
}

/// Sums `of` over all pixels: rows in parallel, then the row sums in order. `renders` replaces the renders in `rows`.
fn sum<const N: usize>(
    renders: &[Vec<Rgb>],
    rows: &[Vec<(Rgb, Rgb)>],
    of: impl Fn(&Rgb, &(Rgb, Rgb)) -> [f64; N] + Sync,
) -> [f64; N] {
    let add = |mut all: [f64; N], one: [f64; N]| {
        all.iter_mut().zip(one).for_each(|(a, b)| *a += b);
        all
    };
    let of_row = |(renders, pairs): (&Vec<Rgb>, &Vec<(Rgb, Rgb)>)| {
        renders.iter().zip(pairs).map(|(render, pair)| of(render, pair)).fold([0.0; N], add)
    };
    let sums: Vec<[f64; N]> = renders.par_iter().zip(rows).map(of_row).collect();
    sums.into_iter().fold([0.0; N], add)
}

fn map(renders: &[Vec<Rgb>], of: impl Fn(&Rgb) -> Rgb + Sync) -> Vec<Vec<Rgb>> {
    renders.par_iter().map(|row| row.iter().map(&of).collect()).collect()
}

fn renders(rows: &[Vec<(Rgb, Rgb)>]) -> Vec<Vec<Rgb>> {
    rows.par_iter().map(|row| row.iter().map(|(render, _)| *render).collect()).collect()
}

fn affine(rows: &[Vec<(Rgb, Rgb)>]) -> Vec<Vec<Rgb>> {
    let renders = renders(rows);
    let of = |c: usize| {
        let [n, photo, render] = sum(&renders, rows, |r, (_, p)| [1.0, p[c], r[c]]);
        let (photo, render) = (photo / n, render / n);
        // Centred on the means, which avoids cancellation.
        let [square, product] = sum(&renders, rows, |r, (_, p)| {
            let p = p[c] - photo;
            [p * p, p * (r[c] - render)]
        });
        let slope = product / n / (square / n).max(DIVISOR_MIN);
        (slope, render - slope * photo)
    };
    let fits = [of(0), of(1), of(2)];
    map(&renders, |render| {
        std::array::from_fn(|c| {
            let (slope, offset) = fits[c];
            ((render[c] - offset) / if slope.abs() < DIVISOR_MIN { 1.0 } else { slope }).clamp(0.0, 1.0)
        })
    })
}

fn quadratic(rows: &[Vec<(Rgb, Rgb)>]) -> Vec<Vec<Rgb>> {
    let is_unsaturated = |x: f64| (SATURATION_MARGIN..=1.0 - SATURATION_MARGIN).contains(&x);
    let mut fitted = renders(rows);
    for _ in 0..ROUNDS {
        let of = |c: usize| {
            // The upper triangle of the normal equations, row by row, then the right-hand side.
            const SUMS: usize = TERMS * (TERMS + 1) / 2 + TERMS;
            let sums: [f64; SUMS] = sum(&fitted, rows, |render, (first, photo)| {
                if ![first[c], render[c], photo[c]].into_iter().all(is_unsaturated) {
                    return [0.0; SUMS];
                }
                let t = terms(render);
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
        let weights = [of(0), of(1), of(2)];
        fitted = map(&fitted, |render| {
            let t = terms(render);
            std::array::from_fn(|c| weights[c].iter().zip(t).map(|(w, t)| w * t).sum::<f64>().clamp(0.0, 1.0))
        });
    }
    fitted
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
