//! The loops of [`super::row_kernels`] in registers of eight floats ([`crate::base::eight`]): what runs with AVX2.
//!
//! Sixteen registers do not hold a row with its moments. What the compiler makes of arrays then is stored in pieces and
//! loaded whole, and such a load waits for every store before it, of other rows too. So here a vector is loaded, worked on
//! and stored before the next one is; a row that turns out to need slower code is written a second time.
//!
//! A block of rows is gone through once for the narrow columns and once for `sh_n`: fewer tables at a time, which the
//! processor's own prefetching follows better.
//!
//! Invariants: 1. the bits are those of [`super::row_kernels`]; 2. what a lane of the row behind holds is neither stored nor
//! counted.

use super::deferred::{AdamNow, StepCounts};
use super::drift::EpsFloor;
use super::row_kernels::{
    AHEAD, EvaluateRows, GradKind, LARGEST_GRAD, StepConstants, StepRows, evaluate_alone, finish_step,
};
use super::row_vectors::{Table, TableMut, start_of_eight};
use crate::base::eight::{Avx2, EIGHT, Eight, EightKernel};
use crate::scene::rows::RowsNow;
use std::ops::Range;

/// Rows of a block: one bit of a word each.
const BLOCK: usize = 64;

/// A loop over rows, to be run in this form.
pub(super) struct Eights<K>(pub K);

impl<const W: usize, F: Fn(usize) -> usize> EightKernel for Eights<EvaluateRows<'_, '_, W, F>> {
    type Out = ();
    #[inline(always)]
    fn run(self, avx2: Avx2) {
        let Eights(EvaluateRows { at, view, row_of, mut out }) = self;
        let (rows, listed) = (view.rows(), out.rows());
        let drifting = Drifting {
            of: Constants::of_drift(avx2, at),
            at,
            value: Table::<W>::new(&view.columns, rows),
            m: Table::<W>::new(&view.exp_avg, rows),
            v: Table::<W>::new(&view.exp_avg_sq, rows),
            stamps: &view.stamp[..rows],
            listed,
            row_of: &row_of,
        };
        let mut out = TableMut::<W>::new(&mut out, listed);
        for first in (0..listed).step_by(BLOCK) {
            let block = first..(first + BLOCK).min(listed);
            let mut alone = drifting.narrow(block.clone(), &mut out);
            if W > 0 {
                alone |= drifting.sh_n(block, &mut out);
            }
            while alone != 0 {
                let i = first + alone.trailing_zeros() as usize;
                out.store_alone(i, &evaluate_alone(at, &view, row_of(i)));
                alone &= alone - 1;
            }
        }
    }
}

/// What is the same for all rows, in every lane or lane by lane.
struct Constants {
    avx2: Avx2,
    zero: Eight,
    one: Eight,
    sign: Eight,
    smallest: Eight,
    /// Of means, opacity and quats; of scales and sh0; of `sh_n`: base rates, or lr / (1 - beta1^t).
    rates: [Eight; 3],
    eps: Eight,
    /// Of the series.
    floor: Eight,
}

impl Constants {
    #[inline(always)]
    fn new(avx2: Avx2, narrow: &[f32; 2 * EIGHT], sh_n: f32, [eps, floor]: [f32; 2]) -> Self {
        let narrow = narrow.as_chunks().0;
        Constants {
            avx2,
            zero: avx2.splat(0.0),
            one: avx2.splat(1.0),
            sign: avx2.splat(-0.0),
            smallest: avx2.splat(f32::MIN_POSITIVE),
            rates: [avx2.load(&narrow[0]), avx2.load(&narrow[1]), avx2.splat(sh_n)],
            eps: avx2.splat(eps),
            floor: avx2.splat(floor),
        }
    }

    #[inline(always)]
    fn of_drift(avx2: Avx2, at: &AdamNow<'_>) -> Self {
        let (EpsFloor { eps, floor }, rates) = (at.adam().eps_floor(), at.adam().lane_rates());
        Constants::new(avx2, &rates.narrow, rates.sh_n, [eps, floor])
    }

    // Not `map`: its closure is not always inlined, and then runs without the instructions.
    #[inline(always)]
    fn splat3(&self, [a, b, c]: [f32; 3]) -> [Eight; 3] {
        [self.avx2.splat(a), self.avx2.splat(b), self.avx2.splat(c)]
    }

    /// [`super::drift::flush`].
    #[inline(always)]
    fn flush(&self, x: Eight) -> Eight {
        x.and(self.sign.not_and(x).not_less(self.smallest))
    }

    /// [`super::drift::flush_positive`].
    #[inline(always)]
    fn flush_positive(&self, x: Eight) -> Eight {
        x.and(x.not_less(self.smallest))
    }

    /// [`super::drift::drifted`]; and in `direct` the lanes for which it is too coarse.
    #[inline(always)]
    fn drifted(&self, [value, m, v]: [Eight; 3], sums: [Eight; 3], rate: Eight, direct: &mut Eight) -> Eight {
        let inv = self.one.over(v.sqrt());
        let e = self.eps.times(inv);
        let series = sums[0].minus(e.times(sums[1].minus(e.times(sums[2]))));
        let moved = self.flush(value.minus(m.times(inv).times(series).times(rate)));
        let still = m.equal(self.zero);
        *direct = direct.or(still.not_and(v.at_most(self.floor)));
        moved.but(still, value)
    }
}

/// Rows that are moved to now.
struct Drifting<'k, 'a, const W: usize, F> {
    of: Constants,
    at: &'k AdamNow<'a>,
    value: Table<'k, W>,
    m: Table<'k, W>,
    v: Table<'k, W>,
    stamps: &'k [u32],
    listed: usize,
    row_of: &'k F,
}

impl<const W: usize, F: Fn(usize) -> usize> Drifting<'_, '_, W, F> {
    /// The narrow columns of a block. Returns a bit for every row that is to be evaluated alone: the last one of the table,
    /// and those that eps touches, or with which it touches what is loaded with them.
    #[inline(always)]
    fn narrow(&self, block: Range<usize>, out: &mut TableMut<'_, W>) -> u64 {
        let (of, avx2, mut alone) = (&self.of, self.of.avx2, 0);
        for i in block.clone() {
            let (row, bit) = ((self.row_of)(i), 1 << (i - block.start));
            if row + 1 >= self.stamps.len() {
                alone |= bit;
                continue;
            }
            let (stamp, value) = (self.stamps[row], self.value.load_narrow(avx2, row));
            if stamp >= self.at.now() {
                out.store_narrow(i, value);
                continue;
            }
            let drift = self.at.drift(stamp);
            let means = of.splat3([drift[0], drift[1], drift[2]]);
            let others = of.splat3([drift[4], drift[5], drift[6]]);
            let low = [
                others[0].but_first_three(means[0]),
                others[1].but_first_three(means[1]),
                others[2].but_first_three(means[2]),
            ];
            let (m, v, mut direct) = (self.m.load_narrow(avx2, row), self.v.load_narrow(avx2, row), of.zero);
            let low = of.drifted([value[0], m[0], v[0]], low, of.rates[0], &mut direct);
            let high = of.drifted([value[1], m[1], v[1]], others, of.rates[1], &mut direct);
            out.store_narrow(i, [low, high]);
            if direct.any() {
                alone |= bit;
            }
        }
        alone
    }

    /// The same for `sh_n`.
    #[inline(always)]
    fn sh_n(&self, block: Range<usize>, out: &mut TableMut<'_, W>) -> u64 {
        let (of, avx2, mut alone) = (&self.of, self.of.avx2, 0);
        for i in block.clone() {
            if i + AHEAD < self.listed {
                let coming = (self.row_of)(i + AHEAD);
                self.value.prefetch(coming);
                self.m.prefetch(coming);
                self.v.prefetch(coming);
            }
            let row = (self.row_of)(i);
            let (stamp, value, out) = (self.stamps[row], self.value.sh_n_of(row), out.sh_n_of(i));
            if stamp >= self.at.now() {
                out.copy_from_slice(value);
                continue;
            }
            let (m, v, drift) = (self.m.sh_n_of(row), self.v.sh_n_of(row), self.at.drift(stamp));
            let (sums, mut direct) = (of.splat3([drift[4], drift[5], drift[6]]), of.zero);
            for part in 0..W.div_ceil(EIGHT) {
                let start = start_of_eight::<W>(part);
                let past = [load(avx2, value, start), load(avx2, m, start), load(avx2, v, start)];
                of.drifted(past, sums, of.rates[2], &mut direct).store(eight_mut(out, start));
            }
            if direct.any() {
                alone |= 1 << (i - block.start);
            }
        }
        alone
    }
}

impl<const W: usize> EightKernel for Eights<StepRows<'_, '_, W>> {
    type Out = StepCounts;
    #[inline(always)]
    fn run(self, avx2: Avx2) -> StepCounts {
        let Eights(StepRows { at, mut view, rows, values, grads }) = self;
        let (first_row, count) = (view.first_row, view.rows());
        let Some((&last, before)) = rows.split_last() else { return StepCounts::default() };
        let constants = StepConstants::new(at);
        let mut stepping = Stepping {
            of: Constants::new(avx2, &constants.sizes.narrow, constants.sizes.sh_n, [constants.eps, 0.0]),
            limits: &constants.limits,
            inv_root_correction: avx2.splat(constants.inv_root_correction),
            one_minus_b1: avx2.splat(constants.one_minus_b1),
            one_minus_b2: avx2.splat(constants.one_minus_b2),
            columns: TableMut::<W>::new(&mut view.columns, count),
            m: TableMut::<W>::new(&mut view.exp_avg, count),
            v: TableMut::<W>::new(&mut view.exp_avg_sq, count),
            values: Table::<W>::new(&values, rows.len()),
            grads: Table::<W>::new(&grads, rows.len()),
        };
        let stamp = &mut view.stamp[..count];
        let mut counts = StepCounts::default();
        for first in (0..before.len()).step_by(BLOCK) {
            let block = first..(first + BLOCK).min(before.len());
            let row_of = |i: usize| before[i] as usize - first_row;
            let (mut usable, mut powers) = (0u64, [[0.0; 2]; BLOCK]);
            for i in block.clone() {
                match stepping.kind_of(i) {
                    GradKind::Zero => {}
                    GradKind::Bad => counts.skipped_non_finite += 1,
                    GradKind::Usable => {
                        let stamp = &mut stamp[row_of(i)];
                        powers[i - first] = at.adam().beta_power(at.now().saturating_sub(*stamp));
                        *stamp = at.now() + 1;
                        usable |= 1 << (i - first);
                    }
                }
            }
            counts.updated += usable.count_ones() as usize;
            for i in block.clone().filter(|i| usable >> (i - first) & 1 != 0) {
                stepping.narrow(row_of(i), i, powers[i - first]);
            }
            for i in block.filter(|_| W > 0) {
                if i + AHEAD < before.len() {
                    stepping.prefetch(row_of(i + AHEAD), i + AHEAD);
                }
                if usable >> (i - first) & 1 != 0 {
                    stepping.sh_n(row_of(i), i, powers[i - first]);
                }
            }
        }
        finish_step::<W>(at, &constants, &mut view, (rows, last), [&values, &grads], counts)
    }
}

/// Rows that take a step.
struct Stepping<'k, const W: usize> {
    of: Constants,
    /// What the magnitudes of the narrow columns are kept within.
    limits: &'k [f32; 2 * EIGHT],
    inv_root_correction: Eight,
    one_minus_b1: Eight,
    one_minus_b2: Eight,
    columns: TableMut<'k, W>,
    m: TableMut<'k, W>,
    v: TableMut<'k, W>,
    /// Of the listed rows.
    values: Table<'k, W>,
    grads: Table<'k, W>,
}

impl<const W: usize> Stepping<'_, W> {
    /// [`GradKind::of`] the gradient of listed row `i`.
    #[inline(always)]
    fn kind_of(&self, i: usize) -> GradKind {
        // Bits that are left out: the sign everywhere, all of the row behind.
        const ALL: f32 = f32::from_bits(u32::MAX);
        let (avx2, sign) = (self.of.avx2, self.of.sign);
        let left_out = sign.or(avx2.load(&[0.0, 0.0, 0.0, ALL, 0.0, 0.0, 0.0, ALL]));
        if i + AHEAD < self.grads.rows() {
            self.grads.prefetch(i + AHEAD);
        }
        let [low, high] = self.grads.load_narrow(avx2, i);
        // Without their signs floats are ordered as integers, with what is not finite behind all others.
        let mut largest = sign.not_and(low).larger_bits(left_out.not_and(high));
        let sh_n = self.grads.sh_n_of(i);
        for part in 0..W.div_ceil(EIGHT) {
            largest = largest.larger_bits(sign.not_and(load(avx2, sh_n, start_of_eight::<W>(part))));
        }
        if largest.not_at_most(avx2.splat(LARGEST_GRAD)).any() {
            GradKind::Bad
        } else if largest.not_at_most(self.of.zero).any() {
            GradKind::Usable
        } else {
            GradKind::Zero
        }
    }

    /// Asks for `sh_n` of a row, which is listed as `i`, and of its value; its gradient was loaded before.
    #[inline(always)]
    fn prefetch(&self, row: usize, i: usize) {
        self.values.prefetch(i);
        self.columns.as_ref().prefetch(row);
        self.m.as_ref().prefetch(row);
        self.v.as_ref().prefetch(row);
    }

    /// The narrow columns of a row, which is listed as `i`.
    #[inline(always)]
    fn narrow(&mut self, row: usize, i: usize, powers: [f32; 2]) {
        let (of, avx2) = (&self.of, self.of.avx2);
        let powers = [avx2.splat(powers[0]), avx2.splat(powers[1])];
        let (now, g) = (self.values.load_narrow(avx2, i), self.grads.load_narrow(avx2, i));
        let (m, v) = (self.m.as_ref().load_narrow(avx2, row), self.v.as_ref().load_narrow(avx2, row));
        let low = self.step([now[0], m[0], v[0]], g[0], powers, of.rates[0]);
        let high = self.step([now[1], m[1], v[1]], g[1], powers, of.rates[1]);
        let now = [self.limited(low[0], 0), self.limited(high[0], 1)];
        self.columns.store_narrow(row, now);
        self.m.store_narrow(row, [low[1], high[1]]);
        self.v.store_narrow(row, [low[2], high[2]]);
    }

    /// The same for `sh_n`.
    #[inline(always)]
    fn sh_n(&mut self, row: usize, i: usize, powers: [f32; 2]) {
        let avx2 = self.of.avx2;
        let powers = [avx2.splat(powers[0]), avx2.splat(powers[1])];
        let (now, g) = (self.values.sh_n_of(i), self.grads.sh_n_of(i));
        // The last vector shares lanes with the one before: its moments are loaded before those are stored.
        let (parts, last) = (W.div_ceil(EIGHT), start_of_eight::<W>(W));
        let last_moments = [load(avx2, self.m.sh_n_of(row), last), load(avx2, self.v.sh_n_of(row), last)];
        for part in 0..parts {
            let start = start_of_eight::<W>(part);
            let [m, v] = match part + 1 == parts {
                true => last_moments,
                false => [load(avx2, self.m.sh_n_of(row), start), load(avx2, self.v.sh_n_of(row), start)],
            };
            let next = self.step([load(avx2, now, start), m, v], load(avx2, g, start), powers, self.of.rates[2]);
            next[0].store(eight_mut(self.columns.sh_n_of(row), start));
            next[1].store(eight_mut(self.m.sh_n_of(row), start));
            next[2].store(eight_mut(self.v.sh_n_of(row), start));
        }
    }

    /// What [`StepConstants`] does to a value and its moments.
    #[inline(always)]
    fn step(&self, [value, m, v]: [Eight; 3], g: Eight, powers: [Eight; 2], size: Eight) -> [Eight; 3] {
        let of = &self.of;
        let (m, v) = (of.flush(m.times(powers[0])), of.flush_positive(v.times(powers[1])));
        let m = of.flush(m.plus(g.minus(m).times(self.one_minus_b1)));
        let v = of.flush_positive(v.plus(g.times(g).minus(v).times(self.one_minus_b2)));
        let root = v.sqrt().times(self.inv_root_correction).plus(of.eps);
        [of.flush(value.minus(size.times(m.over(root)))), m, v]
    }

    /// A half of the narrow columns within its limits.
    #[inline(always)]
    fn limited(&self, value: Eight, half: usize) -> Eight {
        let limit = self.of.avx2.load(&self.limits.as_chunks().0[half]);
        self.of.sign.or(limit).larger(limit.smaller(value))
    }
}

/// Eight values from `start` on.
#[inline(always)]
fn load(avx2: Avx2, values: &[f32], start: usize) -> Eight {
    avx2.load(&values[start..].as_chunks().0[0])
}

/// Eight values from `start` on, to write to.
#[inline(always)]
fn eight_mut(values: &mut [f32], start: usize) -> &mut [f32; EIGHT] {
    &mut values[start..].as_chunks_mut().0[0]
}
