//! The two loops that go through all the optimizer's bytes: forwarding (values of listed rows as they are now) and the
//! step, compiled for every instruction path.
//!
//! A row is worked on in whole vectors: one of the narrow columns, the others of `sh_n`. Where the last of these would not
//! be full it starts earlier instead, and what it shares with the one before it comes to the same in both: so every
//! load and store is one of a whole vector, and none has to wait for parts of another. That is right in place because a row is
//! loaded whole before any of it is stored. Where there are registers enough (AVX-512) it stays in them from load to store.
//!
//! The step takes the values of its rows from whoever forwarded them: to find them again would cost a second root and a
//! second quotient for every value.
//!
//! Floor: the bytes, 4 floats a parameter for forwarding and 7 for the step; `gsscale-bench touched` prints both beside a
//! plain copy and beside plain passes of the same reads and writes.
//!
//! Invariant: the bits are those of [`RowsNow`], whatever the instruction path.

use super::adam::AdamConfig;
use super::deferred::{AdamNow, StepCounts};
use super::drift::{EpsFloor, drifted, flush, needs_direct_sum};
use super::moments::{Moments, round_block};
use crate::base::simd::{Kernel, LANES, prefetch};
use crate::scene::columns::Column;
use crate::scene::rows::{
    BLOCK_LANES, ColumnsMut, ColumnsRef, RowBlock, Rows, RowsMut, RowsNow, SH_N_LANE, first_lane,
};

/// Gradients beyond this are treated like non-finite ones: their square must not overflow the second moment. With it
/// every number that an update computes from finite state is finite.
const LARGEST_GRAD: f32 = 1e18;
/// Log-scales are kept within this at every update: standard deviations of 1e-13 to 1e13 scene units, whose squares
/// and projections stay finite. Out of reach of training that works.
const LOG_SCALE_LIMIT: f32 = 30.0;

/// Rows that are asked for ahead of their turn.
const AHEAD: usize = 16;
/// The sign of a float.
const SIGN: u32 = 1 << 31;

/// One row of columns whose `sh_n` is `W` wide: the lanes of a [`RowBlock`] before `sh_n`, then the vectors of `sh_n`. Lanes
/// that hold nothing are zero.
#[derive(Clone, Copy)]
struct RowVectors<const W: usize>(RowBlock);

impl<const W: usize> RowVectors<W> {
    /// Lanes in use.
    const USED: usize = SH_N_LANE + W.next_multiple_of(LANES);

    /// The vectors of `sh_n`: the lane that each starts at, where in `sh_n` that is, and how many of its lanes are in use.
    #[inline(always)]
    fn parts() -> impl Iterator<Item = (usize, usize, usize)> {
        (0..W.div_ceil(LANES)).map(|i| {
            let start = if W < LANES { 0 } else { (i * LANES).min(W - LANES) };
            (SH_N_LANE + i * LANES, start, W.min(LANES))
        })
    }

    #[inline(always)]
    fn load(columns: &ColumnsRef<'_>, row: usize) -> Self {
        let mut block = [0.0; BLOCK_LANES];
        block[..SH_N_LANE].copy_from_slice(&columns.narrow(row));
        let sh_n = &columns.sh_n[row * W..row * W + W];
        for (lane, start, len) in Self::parts() {
            block[lane..lane + len].copy_from_slice(&sh_n[start..start + len]);
        }
        RowVectors(block)
    }

    /// Asks for `sh_n` of a row that will be loaded soon, but for what lies in a last line of a few values; the narrow
    /// columns come by themselves, many rows to a line.
    #[inline(always)]
    fn prefetch(columns: &ColumnsRef<'_>, row: usize) {
        for line in 0..W.div_ceil(LANES) {
            prefetch(columns.sh_n, row * W + line * LANES);
        }
    }

    #[inline(always)]
    fn store(&self, columns: &mut ColumnsMut<'_>, row: usize) {
        columns.store_narrow(row, &self.0);
        let sh_n = &mut columns.sh_n[row * W..row * W + W];
        for (lane, start, len) in Self::parts() {
            sh_n[start..start + len].copy_from_slice(&self.0[lane..lane + len]);
        }
    }

    fn to_block(self) -> RowBlock {
        let mut block = [0.0; BLOCK_LANES];
        block[..SH_N_LANE].copy_from_slice(&self.0[..SH_N_LANE]);
        for (lane, start, len) in Self::parts() {
            block[SH_N_LANE + start..][..len].copy_from_slice(&self.0[lane..lane + len]);
        }
        block
    }

    fn of_block(block: &RowBlock) -> Self {
        let mut lanes = [0.0; BLOCK_LANES];
        lanes[..SH_N_LANE].copy_from_slice(&block[..SH_N_LANE]);
        for (lane, start, len) in Self::parts() {
            lanes[lane..lane + len].copy_from_slice(&block[SH_N_LANE + start..][..len]);
        }
        RowVectors(lanes)
    }
}

/// Evaluates listed rows into a table.
pub(super) struct EvaluateRows<'k, 'a, const W: usize, F> {
    pub at: &'k AdamNow<'a>,
    pub view: Rows<'k>,
    /// Row of the view for a row of `out`.
    pub row_of: F,
    pub out: ColumnsMut<'k>,
}

impl<const W: usize, F: Fn(usize) -> usize> Kernel for EvaluateRows<'_, '_, W, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(mut self) {
        let Rows { columns, exp_avg, exp_avg_sq, stamp, .. } = &self.view;
        for i in 0..self.out.rows() {
            if i + AHEAD < self.out.rows() {
                let coming = (self.row_of)(i + AHEAD);
                RowVectors::<W>::prefetch(columns, coming);
                RowVectors::<W>::prefetch(exp_avg, coming);
                RowVectors::<W>::prefetch(exp_avg_sq, coming);
            }
            let row = (self.row_of)(i);
            let past = Past::<W> {
                value: RowVectors::load(columns, row),
                m: RowVectors::load(exp_avg, row),
                v: RowVectors::load(exp_avg_sq, row),
                stamp: stamp[row],
            };
            match evaluate(self.at, &past) {
                Some(now) => now.store(&mut self.out, i),
                None => evaluate_directly(self.at, &self.view, row, &mut self.out, i),
            }
        }
    }
}

/// A row as its last update left it.
struct Past<const W: usize> {
    value: RowVectors<W>,
    m: RowVectors<W>,
    v: RowVectors<W>,
    /// Steps that it contains.
    stamp: u32,
}

/// What the values of a row are now; nothing where eps touches one of them.
#[inline(always)]
fn evaluate<const W: usize>(at: &AdamNow<'_>, past: &Past<W>) -> Option<RowVectors<W>> {
    if past.stamp >= at.now() {
        return Some(past.value);
    }
    let (EpsFloor { eps, floor }, rates) = (at.adam().eps_floor(), at.adam().lane_rates());
    let (value, m, v) = (&past.value.0, &past.m.0, &past.v.0);
    let mut direct = false;
    for l in 0..RowVectors::<W>::USED {
        direct |= needs_direct_sum(m[l], v[l], floor);
    }
    if direct {
        return None;
    }
    let drift = at.drift(past.stamp);
    let (means, others) = ([drift[0], drift[1], drift[2]], [drift[4], drift[5], drift[6]]);
    let mut sums = [[0.0; SH_N_LANE]; 3];
    for p in 0..3 {
        for l in 0..SH_N_LANE {
            // Means are the first lanes.
            sums[p][l] = if l < 3 { means[p] } else { others[p] };
        }
    }
    let mut now = [0.0; BLOCK_LANES];
    for l in 0..SH_N_LANE {
        now[l] = drifted(value[l], m[l], v[l], [sums[0][l], sums[1][l], sums[2][l]], rates.narrow[l], eps);
    }
    for l in SH_N_LANE..RowVectors::<W>::USED {
        now[l] = drifted(value[l], m[l], v[l], others, rates.sh_n, eps);
    }
    Some(RowVectors(now))
}

/// A row with a value that eps touches: its values now, into row `to` of `out`. Loads the row itself: what is handed to
/// another function cannot stay in registers.
#[cold]
#[inline(never)]
fn evaluate_directly(at: &AdamNow<'_>, view: &Rows<'_>, row: usize, out: &mut ColumnsMut<'_>, to: usize) {
    let [mut value, mut m, mut v] = [[0.0; BLOCK_LANES]; 3];
    view.columns.load_row_any(row, &mut value);
    view.exp_avg.load_row_any(row, &mut m);
    view.exp_avg_sq.load_row_any(row, &mut v);
    at.evaluate_block_directly(&mut value, &m, &v, view.stamp[row]);
    out.store_row_any(to, &value);
}

/// Something of every lane of a row; all of `sh_n` has the same.
#[derive(Debug, Clone)]
pub(super) struct OfLanes {
    pub narrow: [f32; LANES],
    pub sh_n: f32,
}

impl OfLanes {
    /// From something of every column.
    pub fn new(of: impl Fn(Column) -> f32) -> Self {
        let mut narrow = [0.0; LANES];
        for column in Column::ALL.into_iter().filter(|&c| c != Column::ShN) {
            narrow[first_lane(column)..][..column.width(0)].fill(of(column));
        }
        OfLanes { narrow, sh_n: of(Column::ShN) }
    }

    /// What a column has.
    #[inline(always)]
    pub fn of(&self, column: Column) -> f32 {
        if column == Column::ShN { self.sh_n } else { self.narrow[first_lane(column)] }
    }
}

/// Moves the values of one row of any width to now.
pub(super) fn evaluate_block(at: &AdamNow<'_>, value: &mut RowBlock, m: &RowBlock, v: &RowBlock, stamp: u32) {
    let [then, m_vectors, v_vectors] = [&*value, m, v].map(RowVectors::of_block);
    match evaluate(at, &Past::<45> { value: then, m: m_vectors, v: v_vectors, stamp }) {
        Some(now) => *value = now.to_block(),
        None => at.evaluate_block_directly(value, m, v, stamp),
    }
}

/// One optimizer step on listed rows of a view, which ascend: one listed twice would lose its first step.
pub(super) struct StepRows<'k, 'a, const W: usize> {
    pub at: &'k AdamNow<'a>,
    pub view: RowsMut<'k>,
    pub rows: &'k [u32],
    /// The listed rows as they are now: what [`EvaluateRows`] makes of them.
    pub values: ColumnsRef<'k>,
    pub grads: ColumnsRef<'k>,
}

impl<const W: usize> Kernel for StepRows<'_, '_, W> {
    type Out = StepCounts;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> StepCounts {
        let StepRows { at, view, rows, values, grads } = self;
        let RowsMut { mut columns, mut exp_avg, mut exp_avg_sq, stamp, .. } = view;
        let constants = StepConstants::new(at);
        let mut counts = StepCounts::default();
        for (i, &row) in rows.iter().enumerate() {
            if let Some(&coming) = rows.get(i + AHEAD) {
                let coming = coming as usize - view.first_row;
                RowVectors::<W>::prefetch(&grads, i + AHEAD);
                RowVectors::<W>::prefetch(&values, i + AHEAD);
                RowVectors::<W>::prefetch(&columns.as_ref(), coming);
                RowVectors::<W>::prefetch(&exp_avg.as_ref(), coming);
                RowVectors::<W>::prefetch(&exp_avg_sq.as_ref(), coming);
            }
            let g = RowVectors::<W>::load(&grads, i);
            // Without their signs floats are ordered as integers, with what is not finite behind all others.
            let mut largest = 0;
            for l in 0..RowVectors::<W>::USED {
                largest = largest.max(g.0[l].to_bits() & !SIGN);
            }
            let is_bad = largest > LARGEST_GRAD.to_bits();
            counts.skipped_non_finite += usize::from(is_bad);
            if is_bad || largest == 0 {
                continue;
            }
            let row = row as usize - view.first_row;
            let mut value = RowVectors::<W>::load(&values, i);
            let mut m = RowVectors::<W>::load(&exp_avg.as_ref(), row);
            let mut v = RowVectors::<W>::load(&exp_avg_sq.as_ref(), row);
            let powers = at.adam().beta_power(at.now().saturating_sub(stamp[row]));
            constants.step(&mut value, &mut m, &mut v, &g, powers);
            value.store(&mut columns, row);
            m.store(&mut exp_avg, row);
            v.store(&mut exp_avg_sq, row);
            if at.adam().moments() == Moments::Bf16 {
                round_row::<W>(&mut exp_avg, &mut exp_avg_sq, row, view.uid[row], at.now() + 1);
            }
            stamp[row] = at.now() + 1;
            counts.updated += 1;
        }
        counts
    }
}

/// Rounds the moments of a stored row that contains `steps` steps to what is kept of them.
#[inline(never)]
fn round_row<const W: usize>(m: &mut ColumnsMut<'_>, v: &mut ColumnsMut<'_>, row: usize, uid: u64, steps: u32) {
    let [mut m_block, mut v_block] = [[0.0; BLOCK_LANES]; 2];
    m.as_ref().load_row::<W>(row, &mut m_block);
    v.as_ref().load_row::<W>(row, &mut v_block);
    round_block::<W>(&mut m_block, &mut v_block, uid, steps);
    m.store_row::<W>(row, &m_block);
    v.store_row::<W>(row, &v_block);
}

/// Constants of one ordinary Adam step.
struct StepConstants {
    /// lr / (1 - beta1^t).
    sizes: OfLanes,
    inv_root_correction: f32,
    one_minus_b1: f32,
    one_minus_b2: f32,
    eps: f32,
}

impl StepConstants {
    fn new(at: &AdamNow<'_>) -> Self {
        let (tables, now) = (at.adam().tables(), at.now());
        let [inv_bias1, inv_root] = tables.bias(now + 1);
        let AdamConfig { beta1, beta2, eps } = tables.config();
        StepConstants {
            sizes: OfLanes::new(|column| (tables.rates().at(column, now) * inv_bias1) as f32),
            inv_root_correction: inv_root as f32,
            one_minus_b1: (1.0 - beta1) as f32,
            one_minus_b2: (1.0 - beta2) as f32,
            eps: eps as f32,
        }
    }

    /// Decays the moments of a loaded row to now (`powers` of the betas), then takes the step with gradient `g`.
    #[inline(always)]
    fn step<const W: usize>(
        &self,
        value: &mut RowVectors<W>,
        m: &mut RowVectors<W>,
        v: &mut RowVectors<W>,
        g: &RowVectors<W>,
        powers: [f32; 2],
    ) {
        let (value, m, v, g) = (&mut value.0, &mut m.0, &mut v.0, &g.0);
        for l in 0..SH_N_LANE {
            (value[l], m[l], v[l]) = self.step_value(value[l], m[l], v[l], g[l], powers, self.sizes.narrow[l]);
        }
        for l in SH_N_LANE..RowVectors::<W>::USED {
            (value[l], m[l], v[l]) = self.step_value(value[l], m[l], v[l], g[l], powers, self.sizes.sh_n);
        }
        let scales = first_lane(Column::Scales);
        for l in scales..scales + 3 {
            value[l] = value[l].clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT);
        }
    }

    #[inline(always)]
    fn step_value(&self, value: f32, m: f32, v: f32, g: f32, powers: [f32; 2], step_size: f32) -> (f32, f32, f32) {
        let (m, v) = (flush(m * powers[0]), flush(v * powers[1]));
        // m + (1 - beta)(g - m) rather than beta m + (1 - beta) g: f32 holds 0.001 to 5e-8 of itself but 0.999 only to
        // 1.3e-5 of its distance from 1, which would show in every second moment.
        let m = flush(m + (g - m) * self.one_minus_b1);
        let v = flush(v + (g * g - v) * self.one_minus_b2);
        let root = v.sqrt() * self.inv_root_correction + self.eps;
        (flush(value - step_size * (m / root)), m, v)
    }
}
