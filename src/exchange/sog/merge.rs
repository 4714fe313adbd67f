//! Coarser levels of detail: pairs of Gaussians near each other are merged.
//!
//! The weight of a Gaussian is its optical depth, -ln(1 - opacity), times the product of its two longest sigmas. A merged Gaussian has
//! the weighted mean, covariance and colours of the pair. Its opacity follows from the sum of the weights. The cost of a merge is
//! Runnalls' bound on the divergence of the mixture (2007) plus the weighted squared difference of the colours. For the bound,
//! covariances are widened to a share of the distance between the rows that remain.
//!
//! Every pass merges the pairs with the least costs among near neighbours, at most a quarter of the rows. So detail stays longest.
//!
//! Invariants: 1. rows that did not merge keep their bits; 2. the result depends on the rows and their order alone; all
//! arithmetic is f64.

use super::order::{BUCKET_ROWS, order};
use super::symmetric::Symmetric;
use crate::base::math::sigmoid;
use crate::exchange::frames::ExportRow;

/// Largest opacity that counts: renderers clamp alpha there.
const OPACITY_MAX: f64 = 0.99;
/// Least opacity that viewers draw.
const OPACITY_MIN: f64 = 1.0 / 255.0;
/// Sigma by which covariances are widened for the cost, over the distance between the rows that remain.
const THINNEST: f64 = 0.1;
/// Cost of a squared difference of 1 between two constant SH bands.
const COLOUR_COST: f64 = 2.0;

/// Memory that merging takes for each row, bytes: blobs before and after a pass, and pairs.
pub const MERGE_ROW_BYTES: usize = 2 * size_of::<Blob>() + BUCKET_ROWS / 2 * 16 + 64;

pub fn merged(rows: &[ExportRow], most: usize) -> Vec<ExportRow> {
    let most = most.max(1);
    let mut blobs: Vec<Blob> = rows.iter().map(Blob::of).collect();
    let side = |i: usize| {
        let at = blobs.iter().map(|blob| blob.mean[i]);
        let (low, high) = at.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        (high - low).max(0.0)
    };
    // The distance of rows on a surface.
    let apart = side(0).max(side(1)).max(side(2)) / libm::sqrt(most as f64);
    let floor = (THINNEST * apart).powi(2).max(f64::MIN_POSITIVE);
    while blobs.len() > most {
        let wanted = (blobs.len() - most).min(blobs.len().div_ceil(4));
        blobs = pass(blobs, wanted, floor);
    }
    blobs.into_iter().map(|blob| blob.row).collect()
}

/// Merges the `wanted` cheapest pairs, or as many as there are; at least one.
fn pass(blobs: Vec<Blob>, wanted: usize, floor: f64) -> Vec<Blob> {
    let means: Vec<[f64; 3]> = blobs.iter().map(|blob| blob.mean).collect();
    let near = order(&means);
    let costs: Vec<f64> = blobs.iter().map(|blob| blob.weight * blob.covariance.plus(floor).log_det()).collect();
    let mut pairs: Vec<(f64, u32, u32)> = Vec::with_capacity(near.len() * BUCKET_ROWS / 2);
    for bucket in near.chunks(BUCKET_ROWS) {
        for (i, &a) in bucket.iter().enumerate() {
            for &b in &bucket[i + 1..] {
                let (one, other) = (&blobs[a as usize], &blobs[b as usize]);
                pairs.push((cost(one, other, floor) - costs[a as usize] - costs[b as usize], a.min(b), a.max(b)));
            }
        }
    }
    pairs.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut partner = vec![None; blobs.len()];
    let mut is_gone = vec![false; blobs.len()];
    let mut left = wanted;
    for (_, a, b) in pairs {
        let (a, b) = (a as usize, b as usize);
        let is_free = |i: usize| partner[i].is_none() && !is_gone[i];
        if left > 0 && is_free(a) && is_free(b) {
            (partner[a], is_gone[b]) = (Some(b), true);
            left -= 1;
        }
    }
    let kept = near.iter().map(|&row| row as usize).filter(|&row| !is_gone[row]);
    kept.map(|row| partner[row].map_or_else(|| blobs[row].clone(), |other| blobs[row].with(&blobs[other]))).collect()
}

/// Cost of a merged pair. The cost of the merge is this less the costs of the two Gaussians alone.
fn cost(a: &Blob, b: &Blob, floor: f64) -> f64 {
    let weight = a.weight + b.weight;
    let (_, covariance) = moments(a, b);
    let colours = a.row.sh0.iter().zip(&b.row.sh0);
    let apart: f64 = colours.map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
    weight * covariance.plus(floor).log_det() + COLOUR_COST * a.weight * b.weight / weight * apart
}

/// A Gaussian with the values that merging needs.
#[derive(Clone)]
struct Blob {
    row: ExportRow,
    mean: [f64; 3],
    covariance: Symmetric,
    weight: f64,
}

impl Blob {
    fn of(row: &ExportRow) -> Blob {
        let sigmas = row.log_scales.map(|s| libm::exp(f64::from(s)));
        let opacity = f64::from(sigmoid(row.opacity)).clamp(OPACITY_MIN, OPACITY_MAX);
        Blob {
            row: *row,
            mean: row.position.map(f64::from),
            covariance: Symmetric::turned(row.quat.map(f64::from), sigmas.map(|s| s * s)),
            weight: -libm::log1p(-opacity) * area(sigmas),
        }
    }

    fn with(&self, other: &Blob) -> Blob {
        let weight = self.weight + other.weight;
        let (mean, covariance) = moments(self, other);
        let (variances, axes) = covariance.axes();
        let sigmas = variances.map(|v| libm::sqrt(v.max(f64::from(f32::MIN_POSITIVE))));
        let opacity = (-libm::expm1(-weight / area(sigmas))).clamp(OPACITY_MIN, OPACITY_MAX);
        let share = self.weight / weight;
        let mix = |a: f32, b: f32| (f64::from(a) * share + f64::from(b) * (1.0 - share)) as f32;
        let mut row = self.row;
        row.position = mean.map(|x| x as f32);
        row.log_scales = sigmas.map(|s| libm::log(s) as f32);
        row.quat = axes.map(|q| q as f32);
        row.opacity = libm::log(opacity / (1.0 - opacity)) as f32;
        row.sh0.iter_mut().zip(&other.row.sh0).for_each(|(a, &b)| *a = mix(*a, b));
        row.sh_n.iter_mut().zip(&other.row.sh_n).for_each(|(a, &b)| *a = mix(*a, b));
        Blob { row, mean, covariance, weight }
    }
}

/// Product of the two longest sigmas.
fn area(sigmas: [f64; 3]) -> f64 {
    let [a, b, c] = sigmas;
    (a * b).max(b * c).max(a * c).max(f64::MIN_POSITIVE)
}

/// Weighted mean and covariance of a pair.
fn moments(a: &Blob, b: &Blob) -> ([f64; 3], Symmetric) {
    let share = a.weight / (a.weight + b.weight);
    let apart: [f64; 3] = std::array::from_fn(|i| b.mean[i] - a.mean[i]);
    let mean = std::array::from_fn(|i| a.mean[i] + (1.0 - share) * apart[i]);
    let covariance = a.covariance.mixed(&b.covariance, share).with_offset(apart, share * (1.0 - share));
    (mean, covariance)
}
