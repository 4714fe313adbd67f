//! Movement of a value under dense Adam over steps with zero gradient, for any gap and rate schedule, as a pure
//! function of the stored moments and two step numbers. Knows no rows; [`super::deferred`] applies it to rows.
//!
//! A value whose state contains s steps, with moments m and v, moves over the next k zero-gradient steps by
//!
//! ```text
//! sum over j = 1..k of  lr(s+j) beta1^j m / ((1 - beta1^(s+j)) (sqrt(beta2^j v) / sqrt(1 - beta2^(s+j)) + eps))
//! ```
//!
//! Without eps this is (m / sqrt v) (S(s) - r^k S(s+k)), where r = beta1 / sqrt beta2, c(t) = lr(t) sqrt(1 - beta2^t) /
//! (1 - beta1^t) and S(s) = r (c(s+1) + S(s+1)), filled backwards once. Expanding 1 / (root + eps) gives the same
//! series with the square and the cube of the corrected root, here T2 and T3, with T1 = S: (m / sqrt v) (T1 - e T2 +
//! e^2 T3) with e = eps / sqrt v. If e is not small, the sum itself is computed with 200 terms, the smallest first: the
//! rest is below 1e-9 of it, and the roundings are below 5e-7 of it.
//!
//! Invariants: 1. the same bits on every instruction path: + - * / sqrt only, nothing contracted, sums in a fixed
//! order; 2. tables depend on the rates and the betas alone; 3. results below the smallest normal float are zero.

use super::adam::AdamConfig;
use super::rates::Rates;
use crate::scene::columns::Column;

/// From this gap on the term r^k S(s+k) is below a rounding of S(s).
pub(super) const RECENT: usize = 400;
const DIRECT_TERMS: usize = 200;
/// After this many steps every bias correction is 1 in f64 (0.999^40000 = 4e-18).
const BIAS_STEPS: u32 = 40_000;
/// The series is used if sqrt(v) exceeds this many eps; the omitted terms are e^3 < 1.6e-8 of the movement.
const SERIES_FLOOR: f32 = 400.0;

/// Series sums of one gap at unit base rate: T1, T2, T3, 0 for the schedule of the means, then the same for that of the
/// other columns.
pub(crate) type Drift = [f32; 8];

/// Bytes of the tables for each step of a run.
pub const STEP_BYTES: u64 = 96;

/// Tables of a run: [`STEP_BYTES`] per step (at least 40,000 steps), plus 0.6 MB.
#[derive(Debug, Clone)]
pub struct DriftTables {
    rates: Rates,
    config: AdamConfig,
    /// `[s]`: T1, T2, T3 for the means' schedule and for that of the others.
    series: Vec<[f64; 6]>,
    /// `series` rounded: the movement over infinite gaps.
    limits: Vec<Drift>,
    /// `[k]`: r_1^k, r_2^k, r_3^k.
    ratio_powers: Vec<[f64; 3]>,
    /// `[t]`, t from 1: 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t).
    bias: Vec<[f64; 2]>,
    /// `[j]`: beta1^j, sqrt(beta2^j).
    decay_powers: Vec<[f64; 2]>,
    /// `[step]`, 0-based: factors on the rate of the means and on the other rates.
    rate_factors: Vec<[f64; 2]>,
    /// Whether values stay in place without a gradient.
    is_still: bool,
}

impl DriftTables {
    /// Fills the tables. Panics if the betas are so slow that a gap of 400 steps still matters (beta1 > 0.91 at beta2 =
    /// 0.999): that is a bug in the program, not bad input.
    pub fn new(rates: Rates, config: AdamConfig) -> Self {
        let root = libm::sqrt(config.beta2);
        let ratios: [f64; 3] = std::array::from_fn(|p| config.beta1 / libm::pow(root, p as f64 + 1.0));
        assert!(
            libm::pow(ratios[2], RECENT as f64) < 1e-15,
            "beta1 {} forgets too slowly for the deferred form",
            config.beta1
        );
        let horizon = rates.steps.max(BIAS_STEPS) as usize;
        let rate_factors: Vec<[f64; 2]> = (0..=rates.steps).map(|step| rates.factors(step)).collect();
        let bias = bias_table(config);
        let mut series = vec![[0.0; 6]; horizon + 1];
        // Row s needs the factors of 1-based step s + 1. Beyond the horizon they are constant: a geometric series.
        let term = |s: usize| {
            let [inv_bias1, inv_root] = bias[(s + 1).min(bias.len() - 1)];
            let factors = rate_factors[s.min(rate_factors.len() - 1)];
            let corrected = |p: usize| inv_bias1 / libm::pow(inv_root, p as f64 + 1.0);
            std::array::from_fn::<f64, 6, _>(|i| factors[i / 3] * corrected(i % 3))
        };
        let last = term(horizon);
        series[horizon] = std::array::from_fn(|i| last[i] * ratios[i % 3] / (1.0 - ratios[i % 3]));
        for s in (0..horizon).rev() {
            let (c, next) = (term(s), series[s + 1]);
            series[s] = std::array::from_fn(|i| ratios[i % 3] * (c[i] + next[i]));
        }
        DriftTables {
            limits: series.iter().map(|&t| rounded(t)).collect(),
            ratio_powers: powers(ratios, RECENT),
            decay_powers: powers([config.beta1, root], DIRECT_TERMS + 1),
            series,
            bias,
            rate_factors,
            rates,
            config,
            is_still: false,
        }
    }

    /// The same tables for values that stay in place without a gradient: every sum is zero.
    #[must_use]
    pub fn still(mut self) -> Self {
        self.series.fill([0.0; 6]);
        self.limits.fill([0.0; 8]);
        self.is_still = true;
        self
    }

    /// Whether these are tables of [`DriftTables::still`].
    pub fn is_still(&self) -> bool {
        self.is_still
    }

    pub fn rates(&self) -> &Rates {
        &self.rates
    }

    /// The betas and eps of the tables.
    pub fn config(&self) -> AdamConfig {
        self.config
    }

    pub fn bytes(&self) -> usize {
        self.series.len() * 48
            + self.limits.len() * 32
            + self.ratio_powers.len() * 24
            + (self.bias.len() + self.decay_powers.len()) * 16
            + self.rate_factors.len() * 16
    }

    /// Series sums for the gap from a state of `stamp` steps to one of `now` steps.
    pub(crate) fn drift(&self, stamp: u32, now: u32) -> Drift {
        let gap = now.saturating_sub(stamp) as usize;
        if gap >= self.ratio_powers.len() {
            return self.limits[(stamp as usize).min(self.limits.len() - 1)];
        }
        rounded(self.sums(stamp, now))
    }

    /// [`DriftTables::drift`] before rounding: T1, T2, T3 for the means' schedule and for that of the others.
    fn sums(&self, stamp: u32, now: u32) -> [f64; 6] {
        let gap = now.saturating_sub(stamp) as usize;
        let from = (stamp as usize).min(self.series.len() - 1);
        let start = self.series[from];
        let Some(power) = self.ratio_powers.get(gap) else { return start };
        let end = self.series[(now as usize).min(self.series.len() - 1)];
        std::array::from_fn(|i| start[i] - power[i % 3] * end[i])
    }

    /// Movement of a value from a state of `stamp` steps with moments `m` and `v` to one of `now` steps, at unit base
    /// rate, on the schedule of the means or that of the others. Computes in f64 what `drifted` and `direct_sums` compute
    /// in f32: the oracle of the formula, unused in training.
    pub fn movement(&self, [m, v]: [f64; 2], stamp: u32, now: u32, of_means: bool) -> f64 {
        let root = v.sqrt();
        if m == 0.0 || now <= stamp {
            return 0.0;
        }
        if root <= f64::from(SERIES_FLOOR) * self.config.eps {
            return self.direct(m, root, stamp, now, of_means);
        }
        let (sums, e) = (self.sums(stamp, now), self.config.eps / root);
        let [t1, t2, t3] = if of_means { [sums[0], sums[1], sums[2]] } else { [sums[3], sums[4], sums[5]] };
        m / root * (t1 - e * (t2 - e * t3))
    }

    /// Series sums of the movement to the limit, from a state of `stamp` steps.
    #[inline(always)]
    pub(crate) fn limit(&self, stamp: u32) -> &Drift {
        &self.limits[(stamp as usize).min(self.limits.len() - 1)]
    }

    /// The bias corrections of all steps that a direct sum from a state of at most `steps` steps reads, by 1-based step.
    pub(super) fn bias_until(&self, steps: u32) -> &[[f64; 2]] {
        &self.bias[..(steps as usize).saturating_add(DIRECT_TERMS + 1).min(self.bias.len())]
    }

    /// `[step]`, 0-based: factors on the rate of the means and on the others; the last pair holds from there on.
    pub(super) fn rate_factors(&self) -> &[[f64; 2]] {
        &self.rate_factors
    }

    /// `[j]`: beta1^j, sqrt(beta2^j), for the terms of the direct sum.
    pub(super) fn decay_powers(&self) -> &[[f64; 2]] {
        &self.decay_powers[..=DIRECT_TERMS]
    }

    /// 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) for the 1-based step t.
    pub(crate) fn bias(&self, t: u32) -> [f64; 2] {
        self.bias[(t as usize).min(self.bias.len() - 1)]
    }

    /// The movement at unit base rate of values with these moments, summed term by term with eps; for roots small enough
    /// that eps matters. The first `of_means` values follow the schedule of the means.
    #[inline(always)]
    pub(super) fn direct_sums<const N: usize>(
        &self,
        m: &[f32; N],
        v: &[f32; N],
        stamp: u32,
        now: u32,
        of_means: usize,
    ) -> [f32; N] {
        let (mut sums, mut roots) = ([0.0; N], [0.0; N]);
        if self.is_still {
            return sums;
        }
        for l in 0..N {
            roots[l] = v[l].sqrt();
        }
        let eps = self.config.eps as f32;
        for j in (1..=(now.saturating_sub(stamp) as usize).min(DIRECT_TERMS)).rev() {
            let t = (stamp as usize).saturating_add(j);
            let [inv_bias1, inv_root] = self.bias[t.min(self.bias.len() - 1)];
            let factors = self.rate_factors[(t - 1).min(self.rate_factors.len() - 1)];
            let [decay1, decay2] = self.decay_powers[j];
            let [means, others] = [0, 1].map(|of| (factors[of] * inv_bias1 * decay1) as f32);
            let shrink = (decay2 * inv_root) as f32;
            for l in 0..N {
                let factor = if l < of_means { means } else { others };
                sums[l] += factor * m[l] / (roots[l] * shrink + eps);
            }
        }
        sums
    }

    /// [`DriftTables::direct_sums`] of one value in f64.
    fn direct(&self, m: f64, root: f64, stamp: u32, now: u32, of_means: bool) -> f64 {
        if self.is_still {
            return 0.0;
        }
        let term = |j: usize| {
            let t = (stamp as usize).saturating_add(j);
            let [inv_bias1, inv_root] = self.bias[t.min(self.bias.len() - 1)];
            let [means, others] = self.rate_factors[(t - 1).min(self.rate_factors.len() - 1)];
            let [decay1, decay2] = self.decay_powers[j];
            let rate = if of_means { means } else { others };
            rate * inv_bias1 * decay1 * m / (root * decay2 * inv_root + self.config.eps)
        };
        (1..=(now.saturating_sub(stamp) as usize).min(DIRECT_TERMS)).map(term).sum()
    }
}

/// Constants for the movement of a value.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EpsFloor {
    pub eps: f32,
    /// The series is valid for second moments greater than this.
    pub floor: f32,
}

impl EpsFloor {
    pub(crate) fn new(eps: f64) -> Self {
        let eps = eps as f32;
        let largest_root = SERIES_FLOOR * eps;
        // The largest second moment whose root is at most that: comparing with it saves a root per value.
        let mut floor = largest_root * largest_root;
        while floor.sqrt() > largest_root {
            floor = floor.next_down();
        }
        while floor.next_up().sqrt() <= largest_root {
            floor = floor.next_up();
        }
        EpsFloor { eps, floor }
    }

    /// Eps for a limit that bounds later values: 0 where eps matters, since the limit without eps lies farther away.
    #[inline(always)]
    pub(crate) fn of_limit(self, v: f32) -> f32 {
        if v <= self.floor { 0.0 } else { self.eps }
    }
}

/// The series sums for a column.
#[inline(always)]
pub(crate) fn of_column(drift: &Drift, column: Column) -> [f32; 3] {
    if column == Column::Means { [drift[0], drift[1], drift[2]] } else { [drift[4], drift[5], drift[6]] }
}

/// The value after a gap, by the series. Only for second moments above the floor: see [`needs_direct_sum`]. Rounding
/// error: at most 4e-7 of the movement and half an ulp of the value.
#[inline(always)]
pub(crate) fn drifted(value: f32, m: f32, v: f32, sums: [f32; 3], rate: f32, eps: f32) -> f32 {
    let inv = 1.0 / v.sqrt();
    let e = eps * inv;
    let moved = flush(value - (m * inv) * (sums[0] - e * (sums[1] - e * sums[2])) * rate);
    // Without a first moment nothing moves, and the quotient above may be 0 / 0.
    if m == 0.0 { value } else { moved }
}

/// Whether the series is too inaccurate for this second moment.
#[inline(always)]
pub(crate) fn needs_direct_sum(m: f32, v: f32, floor: f32) -> bool {
    // Written so that a NaN does not cause 200 terms of NaN.
    (m != 0.0) & (v <= floor)
}

/// Whether m / sqrt(v), the ratio of the series, is infinite.
#[inline(always)]
pub(crate) fn has_infinite_ratio(m: f32, v: f32) -> bool {
    (m != 0.0) & (v == 0.0)
}

/// Flushes values below the smallest normal float to zero, so that hardware that flushes them gives the same bits.
#[inline(always)]
pub(crate) fn flush(x: f32) -> f32 {
    if x.abs() < f32::MIN_POSITIVE { 0.0 } else { x }
}

/// [`flush`] for non-negative values such as second moments.
#[inline(always)]
pub(crate) fn flush_positive(x: f32) -> f32 {
    if x < f32::MIN_POSITIVE { 0.0 } else { x }
}

fn rounded(t: [f64; 6]) -> Drift {
    [t[0] as f32, t[1] as f32, t[2] as f32, 0.0, t[3] as f32, t[4] as f32, t[5] as f32, 0.0]
}

/// `[k]` = each base to the power k, for k in 0..count.
fn powers<const N: usize>(bases: [f64; N], count: usize) -> Vec<[f64; N]> {
    (0..count).map(|k| bases.map(|b| libm::pow(b, k as f64))).collect()
}

fn bias_table(config: AdamConfig) -> Vec<[f64; 2]> {
    let correction = |t: u32| {
        let t = f64::from(t.max(1));
        [1.0 / (1.0 - libm::pow(config.beta1, t)), 1.0 / libm::sqrt(1.0 - libm::pow(config.beta2, t))]
    };
    (0..=BIAS_STEPS).map(correction).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, in f64, for any gap.
    fn by_loop(tables: &DriftTables, m: f64, v: f64, stamp: u32, now: u32, of_means: bool) -> f64 {
        let AdamConfig { beta1, beta2, eps } = tables.config;
        let mut moved = 0.0;
        for t in stamp + 1..=now {
            let (j, tf) = (f64::from(t - stamp), f64::from(t));
            let [means, others] = tables.rates.factors(t - 1);
            let rate = if of_means { means } else { others };
            let root = (v * beta2.powf(j)).sqrt() / (1.0 - beta2.powf(tf)).sqrt();
            moved += rate * m * beta1.powf(j) / ((1.0 - beta1.powf(tf)) * (root + eps));
        }
        moved
    }

    #[test]
    fn series_and_direct_sum_agree_with_the_definition() {
        for (eps, others_final_factor) in [(1e-15, 1.0), (1e-8, 1.0), (1e-15, 0.1), (1e-8, 0.01)] {
            let rates = Rates { others_final_factor, ..Rates::new(1.0, 5000) };
            let tables = DriftTables::new(rates, AdamConfig { eps, ..AdamConfig::default() });
            let floor = EpsFloor::new(eps);
            for stamp in [0, 1, 7, 300, 4990, 5000, 60_000] {
                for gap in [0, 1, 2, 15, 199, 200, 201, 399, 400, 401, 3000] {
                    for root in [0.3, 1e-5, 1e-7, 1.1e-6, 0.9e-6, 1e-9, 1e-13, 1e-14, 1e-17] {
                        for of_means in [true, false] {
                            check(&tables, floor, stamp, stamp + gap, root, of_means);
                        }
                    }
                }
            }
        }
    }

    fn check(tables: &DriftTables, floor: EpsFloor, stamp: u32, now: u32, root: f32, of_means: bool) {
        let (m, v) = (root * 0.7, root * root);
        let want = by_loop(tables, f64::from(m), f64::from(v), stamp, now, of_means);
        let exact = tables.movement([f64::from(m), f64::from(v)], stamp, now, of_means);
        assert!((exact - want).abs() <= 1e-7 * want.abs() + 1e-30, "{stamp}..{now} v {v}: {exact} {want}");
        let sums = tables.drift(stamp, now);
        let sums = if of_means { [sums[0], sums[1], sums[2]] } else { [sums[4], sums[5], sums[6]] };
        let direct = needs_direct_sum(m, v, floor.floor);
        let got = if direct {
            tables.direct_sums(&[m], &[v], stamp, now, usize::from(of_means))[0]
        } else {
            -drifted(0.0, m, v, sums, 1.0, floor.eps)
        };
        // 4e-7 for the roundings, a few times 1.6e-8 for the terms omitted at the edge of the series, 1e-9 for the tail
        // omitted by the direct sum.
        let slack = 5e-7 * want.abs() + 1e-30;
        assert!((f64::from(got) - want).abs() <= slack, "{stamp}..{now} v {v}: {got} {want} direct {direct}");
    }

    #[test]
    fn the_floor_is_the_largest_second_moment_with_a_root_below_the_limit() {
        for eps in [1e-15, 1e-8] {
            let EpsFloor { eps, floor } = EpsFloor::new(eps);
            let root = SERIES_FLOOR * eps;
            assert!(floor.sqrt() <= root && floor.next_up().sqrt() > root, "{eps}");
        }
    }
}
