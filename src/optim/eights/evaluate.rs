//! Forwarding in vectors of eight: the current values of listed rows.
//!
//! Not here: rows whose values eps affects, and the last row of a table; the code shared by all paths evaluates them
//! one by one. Invariant: the bits are those of [`EvaluateRows`] as a plain loop.

use super::super::adam_now::AdamNow;
use super::super::drift::EpsFloor;
use super::super::row_kernels::{AHEAD, EvaluateRows, evaluate_alone};
use super::super::row_vectors::{Table, TableMut, start_of_eight};
use super::{BLOCK, Eights, Numbers, eight_mut, load, of_lanes};
use crate::base::eight::{Avx2, EIGHT, Eight, EightKernel};
use crate::scene::rows::RowsNow;
use std::ops::Range;

impl<const W: usize, F: Fn(usize) -> usize> EightKernel for Eights<EvaluateRows<'_, '_, W, F>> {
    type Out = ();
    #[inline(always)]
    fn run(self, avx2: Avx2) {
        let Eights(EvaluateRows { at, view, row_of, mut out }) = self;
        let (rows, listed) = (view.rows(), out.rows());
        let drifting = Drifting {
            of: Constants::new(avx2, at),
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

/// Constants of all rows.
struct Constants {
    numbers: Numbers,
    one: Eight,
    /// Base rates by lane.
    rates: [Eight; 3],
    eps: Eight,
    /// The series is valid for second moments above this.
    floor: Eight,
}

impl Constants {
    #[inline(always)]
    fn new(avx2: Avx2, at: &AdamNow<'_>) -> Self {
        let (EpsFloor { eps, floor }, rates) = (at.adam().eps_floor(), at.adam().lane_rates());
        Constants {
            numbers: Numbers::new(avx2),
            one: avx2.splat(1.0),
            rates: of_lanes(avx2, &rates.narrow, rates.sh_n),
            eps: avx2.splat(eps),
            floor: avx2.splat(floor),
        }
    }

    // Not `map`: its closure is not always inlined, and would then be compiled without AVX2.
    #[inline(always)]
    fn splat3(&self, [a, b, c]: [f32; 3]) -> [Eight; 3] {
        let avx2 = self.numbers.avx2;
        [avx2.splat(a), avx2.splat(b), avx2.splat(c)]
    }

    /// [`super::super::drift::drifted`]; sets in `direct` the lanes for which the series is too inaccurate.
    #[inline(always)]
    fn drifted(&self, [value, m, v]: [Eight; 3], sums: [Eight; 3], rate: Eight, direct: &mut Eight) -> Eight {
        let inv = self.one.over(v.sqrt());
        let e = self.eps.times(inv);
        let series = sums[0].minus(e.times(sums[1].minus(e.times(sums[2]))));
        let moved = self.numbers.flush(value.minus(m.times(inv).times(series).times(rate)));
        let still = m.equal(self.numbers.zero);
        *direct = direct.or(still.not_and(v.at_most(self.floor)));
        moved.blend(still, value)
    }
}

/// Rows being moved to now.
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
    /// Evaluates the narrow columns of a block. Returns a bit for every row that must be evaluated alone: the last one
    /// of the table, and rows where eps affects a value or a lane loaded with them.
    #[inline(always)]
    fn narrow(&self, block: Range<usize>, out: &mut TableMut<'_, W>) -> u64 {
        let (of, avx2, mut alone) = (&self.of, self.of.numbers.avx2, 0);
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
                others[0].blend_first_three(means[0]),
                others[1].blend_first_three(means[1]),
                others[2].blend_first_three(means[2]),
            ];
            let (m, v, mut direct) = (self.m.load_narrow(avx2, row), self.v.load_narrow(avx2, row), of.numbers.zero);
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
        let (of, avx2, mut alone) = (&self.of, self.of.numbers.avx2, 0);
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
            let (sums, mut direct) = (of.splat3([drift[4], drift[5], drift[6]]), of.numbers.zero);
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
