//! Outliers: photos, and parts of photos, that contradict the rest of the scene.
//!
//! [`blocks`]: parts of photos that show what other photos do not (cars, people), by their residuals on a grid (`grid`).
//! [`landmarks`]: whether photos show such parts at all.
//! [`views`]: whole views whose photo does not match their pose (a wrong pose, another place, a broken photo).
//!
//! Invariant: every value is a function of photos, pictures and steps alone, so runs give the same bits for any number
//! of threads, frames and budgets, and a resumed run goes on with the values of its commit.

pub mod blocks;
mod grid;
pub mod landmarks;
pub mod views;

use crate::scene::image::Target;

/// Median absolute deviation of a normal distribution, in standard deviations.
pub(super) const MAD_OF_NORMAL: f64 = 0.674_489_75;

/// Median and median absolute deviation of values, each the lower of two middle values; `None` without values. Overwrites the values.
pub(super) fn median_and_deviation(values: &mut [f64]) -> Option<(f64, f64)> {
    let middle = values.len().checked_sub(1)? / 2;
    let median = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
    values.iter_mut().for_each(|value| *value = (*value - median).abs());
    Some((median, *values.select_nth_unstable_by(middle, f64::total_cmp).1))
}

/// Robust standard deviation; 0 of nothing.
pub(super) fn spread(mut values: Vec<f64>) -> f64 {
    median_and_deviation(&mut values).map_or(0.0, |(_, deviation)| deviation / MAD_OF_NORMAL)
}

/// Whether a pixel (y * width + x) of a photo is not masked.
pub(super) fn is_used(photo: &Target, pixel: usize) -> bool {
    photo.mask.as_ref().is_none_or(|mask| mask[pixel] != 0)
}
