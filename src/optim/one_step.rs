//! Upper bound on how far one optimizer update moves the bounds of a page. It holds before the gradients of the update are known.
//!
//! Adam bounds its own steps. With m = (1 - b1) sum b1^k g_k and v = (1 - b2) sum b2^k g_k^2, the Cauchy-Schwarz inequality gives
//! |m| / sqrt(v) <= (1 - b1) / sqrt((1 - b2) (1 - b1^2 / b2)), 7.3 for the usual decays, whatever the gradients. An update after
//! `now` steps moves a value by at most that ratio times c_{now+1}, and the limit towards which the row drifts afterwards by at most the
//! ratio times S(now+1) more. The sum of both is the ratio times S(now) / r (`super::drift`), at the rate of the column.
//!
//! Invariant: bounds after an update lie within the widened bounds before it.

use super::bounds::SplitLimits;
use crate::scene::columns::Column;
use crate::scene::optimizer_numbers::RunNumbers;
use crate::scene::page_meta::PageBounds;

/// Factor for the rounding of moments and tables, and for the slack that bounds have of their own.
const SLACK: f64 = 1.05;
/// The same with moments of 16 bits. Each rounding moves a second moment by .3 % (standard deviation), and its memory holds some 500 of
/// them: 7 %, 3.5 % of the root; so this is ten standard deviations.
const SLACK_OF_HALVES: f64 = 1.4;
/// Rounding of values, relative.
const VALUE_SLACK: f32 = 1e-5;
/// Factor on the reach of a split, as in `super::bounds`.
const REACH_SLACK: f32 = 1.001;
/// Largest standard deviation in bounds.
const SIGMA_MOST: f32 = 1e30;

/// The largest movement of an update, by step.
#[derive(Debug, Clone)]
pub struct OneStep {
    /// `[steps done]`: movement of a coordinate of the mean, of a log-scale; beyond the end as the last.
    movements: Vec<[f32; 2]>,
    splits: SplitLimits,
}

impl OneStep {
    /// The movements of a run with these numbers, whose rows may split within `splits`.
    pub fn new(numbers: &RunNumbers, splits: &SplitLimits) -> OneStep {
        let [one_minus_b1, one_minus_b2] = numbers.one_minus_betas.map(f64::from);
        let (b1, b2) = (1.0 - one_minus_b1, 1.0 - one_minus_b2);
        let ratio = one_minus_b1 / libm::sqrt(one_minus_b2 * (1.0 - b1 * b1 / b2));
        let slack = if numbers.has_halves { SLACK_OF_HALVES } else { SLACK };
        let factor = slack * ratio * libm::sqrt(b2) / b1;
        let rate = |column: Column| f64::from(numbers.base_rates[column as usize]);
        let [of_means, of_scales] = [Column::Means, Column::Scales].map(rate);
        let of = |sum: f32, rate: f64| (factor * f64::from(sum) * rate) as f32;
        let movements = numbers.limits.iter().map(|sums| [of(sums[0], of_means), of(sums[4], of_scales)]);
        OneStep { movements: movements.collect(), splits: *splits }
    }

    /// Bounds that hold after an update of any rows of a page with `bounds`, taken after `now` steps.
    pub fn widened(&self, bounds: &PageBounds, now: u32) -> PageBounds {
        let at = (now as usize).min(self.movements.len().saturating_sub(1));
        let [of_means, of_scales] = self.movements.get(at).copied().unwrap_or([f32::INFINITY; 2]);
        let sigma_max = (bounds.sigma_max * libm::expf(of_scales) * (1.0 + VALUE_SLACK)).min(SIGMA_MOST);
        // Statistics may have made rows grow that did not.
        let reach = if sigma_max > self.splits.split_scale { self.splits.reach * REACH_SLACK * sigma_max } else { 0.0 };
        let by = of_means + reach;
        let lo = bounds.lo.map(|lo| lo - by - VALUE_SLACK * (lo.abs() + by));
        let hi = bounds.hi.map(|hi| hi + by + VALUE_SLACK * (hi.abs() + by));
        PageBounds { lo, hi, sigma_max }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::base::simd::SimdPath;
    use crate::optim::adam::AdamConfig;
    use crate::optim::bounds::page_bounds;
    use crate::optim::deferred::DeferredAdam;
    use crate::optim::moments::Moments;
    use crate::optim::rates::Rates;
    use crate::optim::row_kernels::take_step;
    use crate::scene::columns::Columns;
    use crate::scene::state::SceneState;

    const STEPS: u32 = 700;

    /// Gradients that turn, grow and fade over many orders, after gaps of any length, and statistics that change at once.
    #[test]
    fn an_update_moves_no_bound_beyond_the_widened_ones() {
        for moments in [Moments::F32, Moments::Bf16] {
            moves_no_bound(
                DeferredAdam::new(Rates::new(3.0, STEPS), AdamConfig::default(), SimdPath::best())
                    .with_moments(moments),
            );
        }
    }

    fn moves_no_bound(adam: DeferredAdam) {
        let splits = SplitLimits { grow_grad2d: 0.3, split_scale: 0.01, reach: 3.33 };
        let numbers = adam.numbers(STEPS).unwrap_or_default();
        let one_step = OneStep::new(&numbers, &splits);
        let mut nearest = 0.0f32;
        for seed in 0..60 {
            let mut draws = Stream::new(seed, Purpose::Test, 0, 0);
            let rows = 4;
            let mut state = SceneState::from_columns(Columns::zeros(rows, 0));
            state.columns.means.iter_mut().for_each(|mean| *mean = draws.range(-2.0, 2.0) as f32);
            state.columns.scales.iter_mut().for_each(|scale| *scale = draws.range(-7.0, -3.0) as f32);
            let (mut now, listed) = (0, [0, 1, 2, 3]);
            let grows = draws.range(0.0, 1.5);
            while now + 1 < STEPS {
                let before = page_bounds(&adam, &state.view(), &splits);
                let mut grads = Columns::zeros(rows, 0);
                let size = libm::pow(10.0, -8.0 + grows * f64::from(now % 9));
                for column in [Column::Means, Column::Scales] {
                    grads.column_mut(column).iter_mut().for_each(|g| *g = (size * draws.range(0.5, 1.0)) as f32);
                }
                take_step(&adam, &mut state, &listed, &grads, now);
                (state.grad2d[0], state.count[0]) = (draws.uniform() as f32, 1);
                let (after, within) = (page_bounds(&adam, &state.view(), &splits), one_step.widened(&before, now));
                for c in 0..3 {
                    assert!(after.lo[c] >= within.lo[c] && after.hi[c] <= within.hi[c], "seed {seed}, step {now}");
                    let [moved, most] = [before.lo[c] - after.lo[c], before.lo[c] - within.lo[c]];
                    nearest = nearest.max(moved / most);
                }
                assert!(after.sigma_max <= within.sigma_max, "seed {seed}, step {now}");
                now += 1 + if seed % 3 == 0 { draws.below(40) as u32 } else { 0 };
            }
        }
        assert!(nearest > 0.3, "the gradients move bounds by {nearest} of the widening only");
    }
}
