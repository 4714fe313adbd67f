//! Decay of a row's moments over k steps.
//!
//! Adam multiplies the first moment by beta1 and the second by beta2 at every step. A deferred row takes k of these
//! products at once, in f32, but rounding beta2^k to f32 is not accurate enough. Near 1 the spacing of f32 is 6e-8, so
//! rounding 0.995 errs by up to 3e-8. A row with a regular schedule meets the same rounding at every update, always in
//! the same direction, and a second moment remembers about a thousand steps: with 160 updates in that time the errors
//! add up to 5e-6 of the moment. The lost part, 1 - beta2^k, is small, and f32 holds it to a relative 6e-8. So the
//! second moment is decayed as v - v (1 - beta2^k), which leaves one rounding of v to nearest, with errors of either
//! sign.
//!
//! The step itself decays the second moment once more and adds (1 - beta2) g^2. Both decays are taken together:
//! v + ((1 - beta2) g^2 - v (1 - beta2^(k+1))) rounds v once for each update.
//!
//! Over more than 692 steps less than half remains. There v - v (1 - beta2^k) cancels: after 10,000 steps a rounding of
//! v is 1e-3 of the remainder. Beyond 692 steps the moment is therefore multiplied by beta2^k rounded to f32, which
//! errs by a relative 6e-8 at most, and no moment remembers two such gaps. Both cases are v kept + (gained - v lost).
//!
//! The first moment remembers ten steps, which contain few roundings: it is multiplied by beta1^k.
//!
//! Here: the factors of one gap and their effect on one value. Not here: the table of common gaps ([`super::deferred`]).
//!
//! Invariants: 1. a decay is a function of the betas and k alone; 2. the same bits on every instruction path: only
//! `+ - x`, nothing contracted; 3. no second moment becomes negative; 4. results below the smallest normal float are zero.

use super::adam::AdamConfig;
use super::drift::{flush, flush_positive};

/// Decay of the moments over a number of steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Decay {
    /// Factor of the first moment.
    pub first: f32,
    /// Factor of the second moment: 1, or beta2^k rounded.
    pub kept: f32,
    /// If `kept` is 1: 1 - beta2^k, computed in f64 and rounded once. Otherwise 0.
    pub lost: f32,
}

impl Decay {
    /// Decay over `k` steps.
    pub fn new(config: AdamConfig, k: u32) -> Decay {
        let steps = f64::from(k);
        let first = flush(libm::pow(config.beta1, steps) as f32);
        let lost = -libm::expm1(steps * libm::log(config.beta2));
        if lost <= 0.5 {
            return Decay { first, kept: 1.0, lost: lost as f32 };
        }
        Decay { first, kept: flush_positive(libm::pow(config.beta2, steps) as f32), lost: 0.0 }
    }

    /// A first moment after the decay.
    #[inline(always)]
    pub fn first_moment(&self, m: f32) -> f32 {
        flush(m * self.first)
    }

    /// A second moment after the decay, plus `gained`.
    #[inline(always)]
    pub fn second_moment(&self, v: f32, gained: f32) -> f32 {
        flush_positive(v * self.kept + (gained - v * self.lost))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    #[test]
    fn a_decay_over_any_gap_errs_by_a_rounding_or_two() {
        const VALUES: u32 = 1024;
        let config = AdamConfig::default();
        assert_eq!(Decay::new(config, 0), Decay { first: 1.0, kept: 1.0, lost: 0.0 });
        for k in (0..2000).chain((2000..30_000).step_by(61)) {
            let decay = Decay::new(config, k);
            let mut draws = Stream::new(3, Purpose::Test, u64::from(k), 0);
            let mut sum = 0.0;
            for _ in 0..VALUES {
                let v = draws.range(1.0, 2.0) as f32;
                let left = f64::from(v) * libm::pow(config.beta2, f64::from(k));
                let error = f64::from(decay.second_moment(v, 0.0)) / left - 1.0;
                // Two roundings, each of half a spacing of f32, which is 1.2e-7 of the number at most.
                assert!(error.abs() < 1.2e-7, "{k} steps of {v}: {error:e}");
                sum += error;
            }
            // The common gaps, of which a moment remembers many, have errors of both signs. Two uniform draws of half a
            // spacing have a standard deviation of 4.9e-8, and the mean of 1024 one of 1.5e-9: the limit is six of
            // these. Equal for every v is only the rounding of `lost`, at most a relative 6e-8. (For beta2^k it would
            // be up to 3e-8 of the moment.)
            let mean = sum / f64::from(VALUES);
            let limit = 9e-9 + 6e-8 * f64::from(decay.lost);
            assert!(k > 300 || mean.abs() < limit, "{k} steps: errors of {mean:e} on average");
        }
    }

    #[test]
    fn tiny_results_are_flushed_to_zero_and_none_is_negative() {
        let config = AdamConfig::default();
        for k in [0, 1, 5, 692, 693, 694, 5000, 80_000, 87_000, 88_000, 100_000, 1_000_000, u32::MAX] {
            let decay = Decay::new(config, k);
            for v in [0.0, f32::MIN_POSITIVE, 1.5e-38, 1e-30, 1e-12, 1.0, 3e18, 1e36] {
                let left = decay.second_moment(v, 0.0);
                assert!(left == 0.0 || left >= f32::MIN_POSITIVE && left <= v, "{k} steps of {v:e}: {left:e}");
                assert_eq!(left.to_bits() >> 31, 0, "{k} steps of {v:e}");
            }
            assert!(decay.lost.abs() >= f32::MIN_POSITIVE || decay.lost == 0.0, "{k}");
        }
    }
}
