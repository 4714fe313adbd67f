//! PSNR after the render's colours were fitted to the photo's: roughly what a model of exposure and white balance would
//! reach. It is another measure than PSNR, by a decibel or more on drone photos, so whoever reports it names it; several
//! papers on city scenes report nothing else.
//!
//! Two fits are in use, both from MultiNeRF (github.com/google-research/multinerf), both of one photo at a time:
//! - [`ColorCorrect::Affine`], of RawNeRF and gsplat's `color_correct_affine`: per channel, (a, b) of least
//!   sum (a photo + b - render)^2, undone as (render - b) / a. A render that has little to do with its photo has a small
//!   slope, whose undoing magnifies its errors: there the figure is below PSNR;
//! - [`ColorCorrect::Quadratic`], of Mip-NeRF 360 and Zip-NeRF, nerfstudio's and gsplat's `color_correct`: each channel of
//!   the photo as a quadratic polynomial of the render's three (10 terms), by least squares over pixels that are not
//!   saturated, five times, each on the result of the last.
//!
//! Invariants: 1. renders are cut to 0..1 before and after; 2. pixels with mask byte 0 take no part; 3. sums are f64, in
//! the order of the rows: the same bits for any number of threads; 4. NaN at a pixel that counts gives NaN.

use crate::scene::image::{Image, Target};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Terms of a quadratic polynomial of three variables.
const TERMS: usize = 10;
/// Least variance and slope that are divided by.
const LEAST: f64 = 1e-8;
/// Values nearer to 0 or 1 than this are saturated: half a step of 8 bits.
const SATURATED: f64 = 0.5 / 255.0;
/// How often the quadratic is fitted.
const ROUNDS: usize = 5;
/// Share of a term's own square below which what is left of it after the other terms is rounding.
const RANK: f64 = 1e-12;

/// How colours are fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorCorrect {
    /// Per channel, slope and offset.
    Affine,
    /// All channels, a quadratic polynomial.
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

/// PSNR of the render after its colours were fitted to the photo's, dB; infinity without any difference, NaN when no
/// pixel counts.
///
/// # Panics
/// When picture and target differ in size.
pub fn color_corrected_psnr(image: &Image, target: &Target, how: ColorCorrect) -> f64 {
    assert_eq!((image.width, image.height), (target.width, target.height), "picture and photo differ in size");
    let rows = pairs(image, target);
    if rows.iter().any(|row| row.iter().any(|(render, _)| render.iter().any(|x| x.is_nan()))) {
        return f64::NAN;
    }
    let corrected = match how {
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

/// Pixels that count, row by row: render (cut to 0..1) and photo.
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

/// Sums over pixels in parallel, the rows' sums in their order; `renders` stand in for those of `rows`.
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
        // About the means, so that nothing cancels.
        let [square, product] = sum(&renders, rows, |r, (_, p)| {
            let p = p[c] - photo;
            [p * p, p * (r[c] - render)]
        });
        let slope = product / n / (square / n).max(LEAST);
        (slope, render - slope * photo)
    };
    let fits = [of(0), of(1), of(2)];
    map(&renders, |render| {
        std::array::from_fn(|c| {
            let (slope, offset) = fits[c];
            ((render[c] - offset) / if slope.abs() < LEAST { 1.0 } else { slope }).clamp(0.0, 1.0)
        })
    })
}

fn quadratic(rows: &[Vec<(Rgb, Rgb)>]) -> Vec<Vec<Rgb>> {
    let is_unsaturated = |x: f64| (SATURATED..=1.0 - SATURATED).contains(&x);
    let mut fitted = renders(rows);
    for _ in 0..ROUNDS {
        let of = |c: usize| {
            // The upper triangle of the normal equations, row after row, and their right-hand side at its end.
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

/// rr, rg, rb, gg, gb, bb, r, g, b, 1.
fn terms([r, g, b]: &Rgb) -> [f64; TERMS] {
    [r * r, r * g, r * b, g * g, g * b, b * b, *r, *g, *b, 1.0]
}

/// Weights of least squares from the normal equations, by Cholesky's decomposition. The constant comes first and then the
/// linear terms; a term that the ones before it explain (a gray picture has such) gets no weight, which changes no
/// fitted value.
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
                true if rest > RANK * at(i, i) => rest.sqrt(),
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
