//! Bounds of the rows of a page, valid from now until the page is next touched.
//!
//! An untouched value moves by its momentum, monotonically, towards a limit ([`super::drift`]): value and limit bound
//! it for all later steps. Where eps matters, the limit without eps stands for it: it lies farther away and needs no sum. An opacity reset may rewrite a row in between, which changes only roundings. A densification
//! round may split it. That happens at most once, because the round clears the statistics that made the row grow. The
//! children then lie around it. The children are included in the box, rather than in a larger sigma (1.63 times for random splits: 3.33 +
//! 3.33 / 1.6 of 3.33), for two reasons: a row must not be missed if its parent is before the near plane, and the margin
//! is then that of the row instead of the page's largest. Children are never larger than their parent along any axis of
//! it, so sigma_max needs no factor: means of children lie within [`SplitLimits::reach`] of their parent (3.33 sigma for
//! random splits, 0.75 for long-axis splits, where no point of a child's 3.33 sigma is farther than 2.98 sigma).
//!
//! Invariants: 1. bounds are a function of the stored rows and the run's configuration alone, not of the step at which
//! they are computed; 2. they hold for every later step, whatever events are pending, in the f32 arithmetic of the
//! evaluation; 3. the same bits on every instruction path; 4. bounds of finite rows are finite.

use super::deferred::DeferredAdam;
use super::lanes::{LANES, LaneDrifts, by_element, drifted_lanes, marked_rows, tables_of};
use super::moments::Moments;
use crate::base::math::exp32;
use crate::base::simd::{Kernel, dispatch};
use crate::scene::columns::Column;
pub use crate::scene::optimizer_numbers::SplitLimits;
use crate::scene::page_meta::PageBounds;
use crate::scene::rows::{Rows, mean_grad2d};

/// Relative slack of a movement. Rewriting a row in between rounds its moments (1e-7 each), may switch between series
/// and direct sum (which differ by 1e-6), and may flush a second moment of 1e-38 to zero, which with eps = 1e-15
/// changes the movement by 1e-4.
const MOVEMENT_SLACK: f32 = 1e-3;
/// The same if rewriting rounds moments to 16 bits: an error of up to 0.8 % each, the second one under a root.
const MOVEMENT_SLACK_BF16: f32 = 2e-2;
/// Relative slack of a value: four roundings in the evaluation, one for the child of a split, three in this file.
const VALUE_SLACK: f32 = 8.0 * 0.5 * f32::EPSILON;
/// Slack of a value that is flushed to zero.
const FLUSH_SLACK: f32 = 2.0 * f32::MIN_POSITIVE;
/// Relative slack of a standard deviation: [`exp32`] is within two ulp, both here and in the test of a row.
const SIGMA_SLACK: f32 = 1e-6;
/// Largest standard deviation in bounds. Only a value that drifts beyond the range of log-scales has a larger one, and the
/// projection draws no such row, because the square overflows f32.
const SIGMA_MOST: f32 = 1e30;
/// Factor of a split's reach for the roundings of its rotation and scales.
const REACH_SLACK: f32 = 1.0 + 1e-4;

/// Bounds of the rows of a page that has just been rewritten.
pub fn page_bounds(adam: &DeferredAdam, rows: &Rows<'_>, splits: &SplitLimits) -> PageBounds {
    dispatch(adam.simd, BoundRows { adam, rows, splits })
}

/// A lower bound, for all later steps, of the opacities (logit) of untouched rows; infinity without rows. Does not
/// account for opacity resets.
pub fn lowest_opacity(adam: &DeferredAdam, rows: &Rows<'_>) -> f32 {
    dispatch(adam.simd, LowestOpacity { adam, rows })
}

struct LowestOpacity<'k> {
    adam: &'k DeferredAdam,
    rows: &'k Rows<'k>,
}

impl Kernel for LowestOpacity<'_> {
    type Out = f32;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> f32 {
        let LowestOpacity { adam, rows } = self;
        let tables = tables_of(rows, Column::Opacities);
        let values = tables[0];
        let slack = movement_slack(adam);
        let of_row = |row: usize| {
            let (m, v) = (rows.exp_avg.opacities[row], rows.exp_avg_sq.opacities[row]);
            hull(values[row], adam.limit(Column::Opacities, values[row], m, v, rows.stamp[row]), slack)[0]
        };
        let mut lowest = [f32::INFINITY; LANES];
        let whole = rows.rows() / LANES * LANES;
        for first in (0..whole).step_by(LANES) {
            let drifts = LaneDrifts::gather(&rows.stamp[first..], |stamp| adam.tables.limit(stamp));
            let (limits, direct) = drifted_lanes::<1, true>(adam, Column::Opacities, tables, first, &drifts);
            let values = &values[first..first + LANES];
            for l in 0..LANES {
                lowest[l] = lowest[l].min(hull(values[l], limits[0][l], slack)[0]);
            }
            marked_rows(first, direct, direct).for_each(|row| lowest[0] = lowest[0].min(of_row(row)));
        }
        (whole..rows.rows()).for_each(|row| lowest[0] = lowest[0].min(of_row(row)));
        lowest.into_iter().fold(f32::INFINITY, f32::min)
    }
}

struct BoundRows<'k> {
    adam: &'k DeferredAdam,
    rows: &'k Rows<'k>,
    splits: &'k SplitLimits,
}

impl Kernel for BoundRows<'_> {
    type Out = PageBounds;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> PageBounds {
        let BoundRows { adam, rows, splits } = self;
        let mut lanes = LaneBounds::EMPTY;
        let mut bounds = PageBounds::EMPTY;
        let whole = rows.rows() / LANES * LANES;
        for first in (0..whole).step_by(LANES) {
            for row in lanes.add(adam, rows, splits, first) {
                add_row(&mut bounds, adam, rows, splits, row);
            }
        }
        (whole..rows.rows()).for_each(|row| add_row(&mut bounds, adam, rows, splits, row));
        lanes.fold(bounds)
    }
}

/// Bounds of the rows in each lane, separately.
struct LaneBounds {
    lo: [[f32; LANES]; 3],
    hi: [[f32; LANES]; 3],
    sigma_max: [f32; LANES],
}

impl LaneBounds {
    const EMPTY: LaneBounds =
        LaneBounds { lo: [[f32::INFINITY; LANES]; 3], hi: [[f32::NEG_INFINITY; LANES]; 3], sigma_max: [0.0; LANES] };

    /// Adds [`LANES`] rows from `first` on; returns those whose limits need the direct sum.
    #[inline(always)]
    fn add(
        &mut self,
        adam: &DeferredAdam,
        rows: &Rows<'_>,
        splits: &SplitLimits,
        first: usize,
    ) -> impl Iterator<Item = usize> {
        let drifts = LaneDrifts::gather(&rows.stamp[first..], |stamp| adam.tables.limit(stamp));
        let (means, scales) = (tables_of(rows, Column::Means), tables_of(rows, Column::Scales));
        let (mean_limits, a) = drifted_lanes::<3, true>(adam, Column::Means, means, first, &drifts);
        let (scale_limits, b) = drifted_lanes::<3, true>(adam, Column::Scales, scales, first, &drifts);
        let (from, to) = (first * 3, (first + LANES) * 3);
        let (means, scales) = (by_element::<3>(&means[0][from..to]), by_element::<3>(&scales[0][from..to]));
        let (grad2d, count) = (&rows.grad2d[first..first + LANES], &rows.count[first..first + LANES]);
        let slack = movement_slack(adam);
        let mut reach = [0.0; LANES];
        for l in 0..LANES {
            let mut log_scale = f32::NEG_INFINITY;
            for c in 0..3 {
                log_scale = log_scale.max(hull(scales[c][l], scale_limits[c][l], slack)[1]);
            }
            let sigma = sigma(log_scale);
            reach[l] = split_reach(splits, grad2d[l], count[l], sigma);
            self.sigma_max[l] = self.sigma_max[l].max(sigma);
        }
        for c in 0..3 {
            for l in 0..LANES {
                let [lo, hi] = hull(means[c][l], mean_limits[c][l], slack);
                self.lo[c][l] = self.lo[c][l].min(outwards(lo, -reach[l]));
                self.hi[c][l] = self.hi[c][l].max(outwards(hi, reach[l]));
            }
        }
        marked_rows(first, a, b)
    }

    /// Combines all lanes with `bounds`.
    #[inline(always)]
    fn fold(&self, mut bounds: PageBounds) -> PageBounds {
        for l in 0..LANES {
            for c in 0..3 {
                bounds.lo[c] = bounds.lo[c].min(self.lo[c][l]);
                bounds.hi[c] = bounds.hi[c].max(self.hi[c][l]);
            }
            bounds.sigma_max = bounds.sigma_max.max(self.sigma_max[l]);
        }
        bounds
    }
}

/// Adds one row, by the exact evaluation.
fn add_row(bounds: &mut PageBounds, adam: &DeferredAdam, rows: &Rows<'_>, splits: &SplitLimits, row: usize) {
    let hull_of = |column: Column, c: usize| {
        let [value, m, v] = tables_of(rows, column).map(|table| table[row * 3 + c]);
        hull(value, adam.limit(column, value, m, v, rows.stamp[row]), movement_slack(adam))
    };
    let log_scale = (0..3).map(|c| hull_of(Column::Scales, c)[1]).fold(f32::NEG_INFINITY, f32::max);
    let sigma = sigma(log_scale);
    let reach = split_reach(splits, rows.grad2d[row], rows.count[row], sigma);
    for c in 0..3 {
        let [lo, hi] = hull_of(Column::Means, c);
        bounds.lo[c] = bounds.lo[c].min(outwards(lo, -reach));
        bounds.hi[c] = bounds.hi[c].max(outwards(hi, reach));
    }
    bounds.sigma_max = bounds.sigma_max.max(sigma);
}

#[inline(always)]
fn movement_slack(adam: &DeferredAdam) -> f32 {
    if adam.moments == Moments::Bf16 { MOVEMENT_SLACK_BF16 } else { MOVEMENT_SLACK }
}

/// The range that a value passes through on its way to its limit, in the evaluation's arithmetic.
#[inline(always)]
fn hull(value: f32, limit: f32, movement_slack: f32) -> [f32; 2] {
    let (lo, hi) = (value.min(limit), value.max(limit));
    let slack = movement_slack * (hi - lo) + VALUE_SLACK * lo.abs().max(hi.abs()) + FLUSH_SLACK;
    [lo - slack, hi + slack]
}

/// A bound moved outwards by `reach` plus the rounding of that sum.
#[inline(always)]
fn outwards(bound: f32, reach: f32) -> f32 {
    let moved = bound + reach;
    // Only bounds of rows that may split are moved; the others are rounded outwards already.
    let slack = if reach == 0.0 { 0.0 } else { f32::EPSILON * moved.abs() };
    if reach < 0.0 { moved - slack } else { moved + slack }
}

#[inline(always)]
fn sigma(log_scale: f32) -> f32 {
    let sigma = exp32(log_scale) * (1.0 + SIGMA_SLACK);
    if sigma < SIGMA_MOST { sigma } else { SIGMA_MOST }
}

/// Largest distance of a row's children from it.
#[inline(always)]
fn split_reach(limits: &SplitLimits, grad2d: f32, count: u32, sigma: f32) -> f32 {
    let is_split = (mean_grad2d(grad2d, count) > limits.grow_grad2d) & (sigma > limits.split_scale);
    if is_split { limits.reach * REACH_SLACK * sigma } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::base::simd::SimdPath;
    use crate::optim::adam::{AdamConfig, EPS_MIN};
    use crate::optim::rates::Rates;
    use crate::scene::columns::Columns;
    use crate::scene::rows::RowsNow;
    use crate::scene::state::SceneState;

    #[test]
    fn bounds_are_the_hull_of_rows_on_every_instruction_path() {
        let rows = 16 * 7 + 5;
        let mut state = SceneState::from_columns(Columns::zeros(rows, 0));
        let mut draws = Stream::new(2, Purpose::Test, 0, 0);
        for row in 0..rows {
            for c in row * 3..row * 3 + 3 {
                (state.columns.means[c], state.columns.scales[c]) =
                    (draws.normal() as f32, draws.normal() as f32 - 5.0);
                for (m, v) in [
                    (&mut state.exp_avg.means, &mut state.exp_avg_sq.means),
                    (&mut state.exp_avg.scales, &mut state.exp_avg_sq.scales),
                ] {
                    // Some second moments are so small that eps matters, some rows have both moments zero.
                    let size = libm::pow(10.0, -draws.range(0.0, if row % 16 == 3 { 18.0 } else { 9.0 }));
                    (m[c], v[c]) = ((draws.normal() * size) as f32, (size * size) as f32);
                    if row % 16 == 5 {
                        // Flushed: the quotient has no bound, and the limit needs the direct sum.
                        (m[c], v[c]) = (1e-19, 0.0);
                    }
                }
            }
            let (m, v) = (&mut state.exp_avg.opacities, &mut state.exp_avg_sq.opacities);
            (m[row], v[row]) = if row % 16 == 5 { (1e-19, 0.0) } else { (draws.normal() as f32, 1.0) };
            state.columns.opacities[row] = draws.normal() as f32;
            state.stamp[row] = draws.below(600) as u32;
            (state.grad2d[row], state.count[row]) = (draws.uniform() as f32, draws.below(3) as u32);
        }
        // The box ends at a row whose limit needs the direct sum, which moves it by more than the slack.
        state.columns.means[15..18].fill(50.0);
        state.exp_avg.means[15..18].fill(-1e-17);
        (state.columns.opacities[5], state.exp_avg.opacities[5], state.stamp[5]) = (-9.0, 1e-17, 1);
        let splits = SplitLimits { grow_grad2d: 0.3, split_scale: 0.01, reach: 3.33 };
        let of = |simd: SimdPath, rows: &Rows<'_>| {
            page_bounds(&DeferredAdam::new(Rates::new(100.0, 500), AdamConfig::default(), simd), rows, &splits)
        };
        let adam = DeferredAdam::new(Rates::new(100.0, 500), AdamConfig::default(), SimdPath::Baseline);
        let mut want = PageBounds::EMPTY;
        (0..rows).for_each(|row| add_row(&mut want, &adam, &state.view(), &splits, row));
        let lowest = |simd: SimdPath| {
            lowest_opacity(&DeferredAdam::new(Rates::new(100.0, 500), AdamConfig::default(), simd), &state.view())
        };
        // So does the range of opacities.
        let limit = adam.limit(Column::Opacities, -9.0, 1e-17, 0.0, 1);
        let want_lowest = hull(-9.0, limit, movement_slack(&adam))[0];
        assert!(limit < -9.001 && want.hi[0] > 50.001, "{limit} {want:?}");
        for simd in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
            assert_eq!((of(simd, &state.view()), lowest(simd)), (want, want_lowest), "{}", simd.name());
        }
        assert!(of(SimdPath::best(), &SceneState::default().view()).is_empty());
    }

    /// The smallest allowed eps, with second moments down to the smallest floats: rewriting flushes them to zero, which
    /// leaves only eps to divide by.
    #[test]
    fn bounds_hold_for_every_allowed_eps() {
        for eps in [EPS_MIN, 1e-15, 1e-8, 1.0] {
            let config = AdamConfig { eps, ..AdamConfig::default() };
            let adam = DeferredAdam::new(Rates::new(1.0, 500), config, SimdPath::best());
            for seed in 0..3000 {
                let mut draws = Stream::new(seed, Purpose::Test, 0, 0);
                let mut state = SceneState::from_columns(Columns::zeros(1, 0));
                for c in 0..3 {
                    let root = libm::pow(10.0, -draws.range(6.0, 18.9));
                    state.columns.means[c] = (draws.normal() * libm::pow(10.0, -draws.range(0.0, 9.0))) as f32;
                    state.exp_avg.means[c] = (draws.normal() * root) as f32;
                    state.exp_avg_sq.means[c] = (root * root) as f32;
                }
                state.stamp[0] = draws.below(600) as u32;
                let bounds = page_bounds(&adam, &state.view(), &SplitLimits::NEVER);
                let mut now = state.stamp[0];
                for _ in 0..6 {
                    now += 1 + draws.below(60) as u32;
                    let at = adam.at(now);
                    for c in 0..3 {
                        let mean = at.evaluate_element(&state.view(), Column::Means, 0, c);
                        let [lo, hi] = [bounds.lo[c], bounds.hi[c]];
                        assert!(lo.is_finite() && hi.is_finite() && (lo..=hi).contains(&mean), "{eps:e} seed {seed}");
                    }
                    // As an event in between does.
                    at.settle_row(&mut state.view_mut(), 0);
                }
            }
        }
    }
}
