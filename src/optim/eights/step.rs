//! The optimizer's step in vectors of eight.
//!
//! The gradients of a block are checked first. The state of rows without a gradient is prefetched as well, because the
//! gradients of the next block are not known yet, but it is not processed.
//! Not here: the last listed row, and the rounding of 16-bit moments, which use the code shared by all paths.
//! Invariant: bits and counts are those of [`StepRows`] as a plain loop.

use super::super::adam_now::StepCounts;
use super::super::decay::Decay;
use super::super::row_kernels::{AHEAD, GradKind, StepConstants, StepRows, finish_step};
use super::super::row_vectors::{Table, TableMut, start_of_eight};
use super::{BLOCK, Eights, Numbers, eight_mut, load, of_lanes};
use crate::base::eight::{Avx2, EIGHT, Eight, EightKernel};
use crate::base::math::LARGEST_GRAD;
use crate::scene::rows::RowsNow;

impl<const W: usize> EightKernel for Eights<StepRows<'_, '_, W>> {
    type Out = StepCounts;
    #[inline(always)]
    fn run(self, avx2: Avx2) -> StepCounts {
        let Eights(StepRows { at, mut view, rows, values, grads }) = self;
        let (first_row, count) = (view.first_row, view.rows());
        let Some((&last, before)) = rows.split_last() else { return StepCounts::default() };
        let constants = StepConstants::new(at);
        let mut stepping = Stepping {
            numbers: Numbers::new(avx2),
            sizes: of_lanes(avx2, &constants.sizes.narrow, constants.sizes.sh_n),
            eps: avx2.splat(constants.eps),
            lows: &constants.lows,
            highs: &constants.highs,
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
            let (mut usable, mut decays) = (0u64, [Decay::NONE; BLOCK]);
            for i in block.clone() {
                match stepping.kind_of(i) {
                    GradKind::Zero => {}
                    GradKind::Bad => counts.skipped_non_finite += 1,
                    GradKind::Usable => {
                        let stamp = &mut stamp[row_of(i)];
                        decays[i - first] = at.step_decay(*stamp);
                        *stamp = at.now() + 1;
                        usable |= 1 << (i - first);
                    }
                }
            }
            counts.updated += usable.count_ones() as usize;
            for i in block.clone().filter(|i| usable >> (i - first) & 1 != 0) {
                stepping.narrow(row_of(i), i, decays[i - first]);
            }
            if W == 0 {
                continue;
            }
            for i in block {
                if i + AHEAD < before.len() {
                    stepping.prefetch(row_of(i + AHEAD), i + AHEAD);
                }
                if usable >> (i - first) & 1 != 0 {
                    stepping.sh_n(row_of(i), i, decays[i - first]);
                }
            }
        }
        finish_step::<W>(at, &constants, &mut view, (rows, last), [&values, &grads], counts)
    }
}

/// Rows taking a step.
struct Stepping<'k, const W: usize> {
    numbers: Numbers,
    /// lr / (1 - beta1^t) by lane.
    sizes: [Eight; 3],
    eps: Eight,
    /// Least and greatest values of the narrow columns.
    lows: &'k [f32; 2 * EIGHT],
    highs: &'k [f32; 2 * EIGHT],
    inv_root_correction: Eight,
    one_minus_b1: Eight,
    one_minus_b2: Eight,
    columns: TableMut<'k, W>,
    m: TableMut<'k, W>,
    v: TableMut<'k, W>,
    /// Values of the listed rows.
    values: Table<'k, W>,
    grads: Table<'k, W>,
}

impl<const W: usize> Stepping<'_, W> {
    /// [`GradKind::of`] for the gradient of listed row `i`.
    #[inline(always)]
    fn kind_of(&self, i: usize) -> GradKind {
        // Masked bits: the sign everywhere, and all bits of the next row's lanes.
        const ALL: f32 = f32::from_bits(u32::MAX);
        let (avx2, sign) = (self.numbers.avx2, self.numbers.sign);
        let left_out = sign.or(avx2.load(&[0.0, 0.0, 0.0, ALL, 0.0, 0.0, 0.0, ALL]));
        if i + AHEAD < self.grads.rows() {
            self.grads.prefetch(i + AHEAD);
        }
        let [low, high] = self.grads.load_narrow(avx2, i);
        // Without signs, floats are ordered as integers, with non-finite ones after all others.
        let mut largest = sign.not_and(low).larger_bits(left_out.not_and(high));
        let sh_n = self.grads.sh_n_of(i);
        for part in 0..W.div_ceil(EIGHT) {
            largest = largest.larger_bits(sign.not_and(load(avx2, sh_n, start_of_eight::<W>(part))));
        }
        if largest.any_bits_above(LARGEST_GRAD.to_bits() as i32) {
            GradKind::Bad
        } else if largest.any_bit() {
            GradKind::Usable
        } else {
            GradKind::Zero
        }
    }

    /// Prefetches `sh_n` of a row, listed as `i`, and of its value; its gradient is loaded already.
    #[inline(always)]
    fn prefetch(&self, row: usize, i: usize) {
        self.values.prefetch(i);
        self.columns.as_ref().prefetch(row);
        self.m.as_ref().prefetch(row);
        self.v.as_ref().prefetch(row);
    }

    /// Steps the narrow columns of a row, listed as `i`.
    #[inline(always)]
    fn narrow(&mut self, row: usize, i: usize, decay: Decay) {
        let avx2 = self.numbers.avx2;
        let decay = [avx2.splat(decay.first), avx2.splat(decay.kept), avx2.splat(decay.lost)];
        let (now, g) = (self.values.load_narrow(avx2, i), self.grads.load_narrow(avx2, i));
        let (m, v) = (self.m.as_ref().load_narrow(avx2, row), self.v.as_ref().load_narrow(avx2, row));
        let low = self.step([now[0], m[0], v[0]], g[0], decay, self.sizes[0]);
        let high = self.step([now[1], m[1], v[1]], g[1], decay, self.sizes[1]);
        let now = [self.limited(low[0], 0), self.limited(high[0], 1)];
        self.columns.store_narrow(row, now);
        self.m.store_narrow(row, [low[1], high[1]]);
        self.v.store_narrow(row, [low[2], high[2]]);
    }

    /// The same for `sh_n`.
    #[inline(always)]
    fn sh_n(&mut self, row: usize, i: usize, decay: Decay) {
        let avx2 = self.numbers.avx2;
        let decay = [avx2.splat(decay.first), avx2.splat(decay.kept), avx2.splat(decay.lost)];
        let (now, g) = (self.values.sh_n_of(i), self.grads.sh_n_of(i));
        // The last vector shares lanes with the previous one: its moments are loaded before those are stored.
        let (parts, last) = (W.div_ceil(EIGHT), W.saturating_sub(EIGHT));
        let last_moments = [load(avx2, self.m.sh_n_of(row), last), load(avx2, self.v.sh_n_of(row), last)];
        for part in 0..parts {
            let start = start_of_eight::<W>(part);
            let [m, v] = match part + 1 == parts {
                true => last_moments,
                false => [load(avx2, self.m.sh_n_of(row), start), load(avx2, self.v.sh_n_of(row), start)],
            };
            let next = self.step([load(avx2, now, start), m, v], load(avx2, g, start), decay, self.sizes[2]);
            next[0].store(eight_mut(self.columns.sh_n_of(row), start));
            next[1].store(eight_mut(self.m.sh_n_of(row), start));
            next[2].store(eight_mut(self.v.sh_n_of(row), start));
        }
    }

    /// Applies [`StepConstants`] to a value and its moments.
    #[inline(always)]
    fn step(&self, [value, m, v]: [Eight; 3], g: Eight, decay: [Eight; 3], size: Eight) -> [Eight; 3] {
        let numbers = &self.numbers;
        let [first, kept, lost] = decay;
        let m = numbers.flush(m.times(first));
        let m = numbers.flush(m.plus(g.minus(m).times(self.one_minus_b1)));
        let gained = g.times(g).times(self.one_minus_b2);
        let v = numbers.flush_positive(v.times(kept).plus(gained.minus(v.times(lost))));
        let root = v.sqrt().times(self.inv_root_correction).plus(self.eps);
        [numbers.flush(value.minus(size.times(m.over(root)))), m, v]
    }

    /// A half of the narrow columns, clamped to its limits; NaN stays.
    #[inline(always)]
    fn limited(&self, value: Eight, half: usize) -> Eight {
        let avx2 = self.numbers.avx2;
        let (low, high) = (avx2.load(&self.lows.as_chunks().0[half]), avx2.load(&self.highs.as_chunks().0[half]));
        low.larger(high.smaller(value))
    }
}
