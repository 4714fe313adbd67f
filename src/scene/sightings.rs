//! One word per row with two statistics: how many views drew the row since the last round, and the blending weight that
//! the row had in these views together.
//!
//! The blending weight of a row in a view is the sum of alpha times transmittance over the pixels of the view, so its
//! unit is the pixel. The word holds the number of views in its low 12 bits and the sum of weights in the other 20
//! bits: the exponent and the upper 12 bits of the mantissa of a positive f32, rounded to nearest. Adding a view rounds
//! the sum by at most 2^-13 of it, so even after [`VIEWS_MOST`] views a rounding is at most half of a mean addition.
//!
//! Invariants: 1. a word without weights is the plain number of views; 2. a row with [`VIEWS_MOST`] views takes no more
//! statistics until the next round; 3. weights only add up, in the order of the steps, so the word is a function of
//! these steps alone.

const VIEWS_BITS: u32 = 12;
/// The most views that a row counts between two rounds.
pub const VIEWS_MOST: u32 = (1 << VIEWS_BITS) - 1;
/// Least weight of a view, so that the sum of a weighed row is not zero.
const WEIGHT_LEAST: f32 = 1e-30;
/// Greatest weight of a view and greatest sum, so that sums stay finite.
pub const WEIGHT_MOST: f32 = 1e30;
/// Bits of an f32 that the sum of weights drops.
const DROPPED_BITS: u32 = 11;

#[inline(always)]
pub fn views(word: u32) -> u32 {
    word & VIEWS_MOST
}

/// Sum of the weights in a word, pixels; 0 if no view was weighed.
#[inline(always)]
pub fn weight(word: u32) -> f32 {
    f32::from_bits((word >> VIEWS_BITS) << DROPPED_BITS)
}

/// Mean weight per view, pixels; `None` if no view was weighed.
#[inline(always)]
pub fn mean_weight(word: u32) -> Option<f32> {
    let sum = weight(word);
    (sum > 0.0).then(|| sum / views(word).max(1) as f32)
}

/// A word of many views with a mean weight of at most `mean`, and hardly less.
pub fn of_mean_weight(mean: f32) -> u32 {
    // A power of two, so that the mean is the sum but for its low bits.
    const VIEWS: u32 = 1 << (VIEWS_BITS - 1);
    let sum = (mean * VIEWS as f32).clamp(WEIGHT_LEAST, WEIGHT_MOST);
    ((sum.to_bits() >> DROPPED_BITS) << VIEWS_BITS) | VIEWS
}

/// Whether a row with this word takes no more statistics.
#[inline(always)]
pub fn is_full(word: u32) -> bool {
    views(word) == VIEWS_MOST
}

/// The word after one more view, weighed or not. The word must not be full. A weight that is NaN counts as the least.
#[inline(always)]
pub fn with_view(word: u32, weighed: Option<f32>) -> u32 {
    debug_assert!(!is_full(word), "a full word takes no view");
    let Some(added) = weighed else { return word + 1 };
    let sum = (weight(word) + added.max(WEIGHT_LEAST)).min(WEIGHT_MOST);
    let rounded = (sum.to_bits() + (1 << (DROPPED_BITS - 1))) >> DROPPED_BITS;
    (rounded << VIEWS_BITS) | (views(word) + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    #[test]
    fn words_without_weights_are_plain_counts() {
        let mut word = 0;
        for n in 1..=VIEWS_MOST {
            word = with_view(word, None);
            assert_eq!((word, views(word), weight(word), mean_weight(word)), (n, n, 0.0, None));
        }
        assert!(is_full(word) && !is_full(word - 1));
    }

    #[test]
    fn means_follow_the_exact_ones() {
        let mut draws = Stream::new(31, Purpose::Test, 0, 0);
        for size in [1e-6, 0.02, 3.0, 1e5] {
            let (mut word, mut exact) = (0, 0.0f64);
            for n in 1..=VIEWS_MOST {
                let added = (size * draws.uniform()) as f32;
                exact += f64::from(added);
                word = with_view(word, Some(added));
                let mean = f64::from(mean_weight(word).unwrap_or(0.0));
                // A rounding errs by 2^-13 of the sum; n of them, unbiased, by some sqrt(n) times that: 0.8 % at most.
                assert!((mean * f64::from(n) / exact - 1.0).abs() < 0.02, "{size} after {n} views: {mean}");
            }
        }
    }

    #[test]
    fn a_word_of_a_mean_has_that_mean() {
        let mut draws = Stream::new(32, Purpose::Test, 0, 0);
        for _ in 0..10_000 {
            let mean = libm::exp(draws.range(-60.0, 50.0)) as f32;
            let got = mean_weight(of_mean_weight(mean)).unwrap_or(f32::NAN);
            assert!(got <= mean && got >= mean * (1.0 - 1.0 / 2048.0), "{mean}: {got}");
        }
        assert!(mean_weight(of_mean_weight(0.0)).is_some() && mean_weight(of_mean_weight(f32::INFINITY)).is_some());
        // Extreme weights stay numbers.
        for (added, least, most) in [(0.0, 1e-31, 1e-29), (f32::NAN, 1e-31, 1e-29), (f32::INFINITY, 9e29, 1.1e30)] {
            let word = with_view(with_view(0, Some(added)), Some(added));
            assert_eq!(views(word), 2);
            assert!((least..most).contains(&weight(word)), "{added}: {}", weight(word));
        }
    }
}
