//! The two loops that go through all the optimizer's bytes: forwarding (values of listed rows as they are now) and the
//! step, compiled for every instruction path.
//!
//! A row is worked on in whole vectors: one of the narrow columns, the others of `sh_n`. Where the last of these would not
//! be full it starts earlier instead, and what it shares with the one before it comes to the same in both: so every
//! load and store is one of a whole vector, and none has to wait for parts of another. That is right in place because a row is
//! loaded whole before any of it is stored. The next row is loaded before that, so listed rows must differ.
//!
//! Floor: the bytes, 4 floats a parameter for forwarding and 7 for the step; `gsscale-bench touched` prints both beside a
//! plain copy.
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
const AHEAD: usize = 8;
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
    fn zero() -> Self {
        RowVectors([0.0; BLOCK_LANES])
    }

    #[inline(always)]
    fn load(&mut self, columns: &ColumnsRef<'_>, row: usize) {
        columns.load_row::<0>(row, &mut self.0);
        let sh_n = &columns.sh_n[row * W..row * W + W];
        for (lane, start, len) in Self::parts() {
            self.0[lane..lane + len].copy_from_slice(&sh_n[start..start + len]);
        }
    }

    /// Asks for `sh_n` of a row that will be loaded soon, but for what lies in a last line of a few values; the narrow
    /// columns come by themselves, many rows to a line.
    #[inline(always)]
    fn prefetch(columns: &ColumnsRef<'_>, row: usize) {
        for line in 0..W.div_ceil(LANES) {
            columns.sh_n.get(row * W + line * LANES).into_iter().for_each(prefetch);
        }
    }

    #[inline(always)]
    fn store(&self, columns: &mut ColumnsMut<'_>, row: usize) {
        columns.store_row::<0>(row, &self.0);
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

    fn set(&mut self, block: &RowBlock) {
        self.0[..SH_N_LANE].copy_from_slice(&block[..SH_N_LANE]);
        for (lane, start, len) in Self::parts() {
            self.0[lane..lane + len].copy_from_slice(&block[SH_N_LANE + start..][..len]);
        }
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
        let mut pasts = [Past::<W>::zero(); 2];
        let mut value = RowVectors::<W>::zero();
        let count = self.out.rows();
        for i in 0..=count {
            if i + AHEAD < count {
                let coming = (self.row_of)(i + AHEAD);
                RowVectors::<W>::prefetch(&self.view.columns, coming);
                RowVectors::<W>::prefetch(&self.view.exp_avg, coming);
                RowVectors::<W>::prefetch(&self.view.exp_avg_sq, coming);
            }
            if i < count {
                let Rows { columns, exp_avg, exp_avg_sq, stamp, .. } = &self.view;
                pasts[i % 2].load([columns, exp_avg, exp_avg_sq], stamp, (self.row_of)(i));
            }
            if i > 0 {
                evaluate(self.at, &pasts[(i - 1) % 2], &mut value);
                value.store(&mut self.out, i - 1);
            }
        }
    }
}

/// A row as its last update left it. Loaded a row ahead of its turn: the narrow columns come in pieces, and a vector of
/// them cannot be read before all have arrived.
#[derive(Clone, Copy)]
struct Past<const W: usize> {
    value: RowVectors<W>,
    m: RowVectors<W>,
    v: RowVectors<W>,
    /// Steps that it contains.
    stamp: u32,
}

impl<const W: usize> Past<W> {
    #[inline(always)]
    fn zero() -> Self {
        Past { value: RowVectors::zero(), m: RowVectors::zero(), v: RowVectors::zero(), stamp: 0 }
    }

    #[inline(always)]
    fn load(&mut self, [value, m, v]: [&ColumnsRef<'_>; 3], stamp: &[u32], row: usize) {
        self.value.load(value, row);
        self.m.load(m, row);
        self.v.load(v, row);
        self.stamp = stamp[row];
    }
}

/// What the values of a row are now.
#[inline(always)]
fn evaluate<const W: usize>(at: &AdamNow<'_>, past: &Past<W>, now: &mut RowVectors<W>) {
    if past.stamp >= at.now() {
        *now = past.value;
        return;
    }
    let (EpsFloor { eps, floor }, rates) = (at.adam().eps_floor(), at.adam().lane_rates());
    let (value, m, v, now) = (&past.value.0, &past.m.0, &past.v.0, &mut now.0);
    let mut direct = false;
    for l in 0..RowVectors::<W>::USED {
        direct |= needs_direct_sum(m[l], v[l], floor);
    }
    if direct {
        return evaluate_directly(at, past, now);
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
    for l in 0..SH_N_LANE {
        now[l] = drifted(value[l], m[l], v[l], [sums[0][l], sums[1][l], sums[2][l]], rates.narrow[l], eps);
    }
    for l in SH_N_LANE..RowVectors::<W>::USED {
        now[l] = drifted(value[l], m[l], v[l], others, rates.sh_n, eps);
    }
}

/// The same for a row with a value that eps touches.
#[cold]
#[inline(never)]
fn evaluate_directly<const W: usize>(at: &AdamNow<'_>, past: &Past<W>, now: &mut RowBlock) {
    let mut block = past.value.to_block();
    at.evaluate_block_directly(&mut block, &past.m.to_block(), &past.v.to_block(), past.stamp);
    let mut moved = past.value;
    moved.set(&block);
    *now = moved.0;
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
    let mut past = Past::<45> { stamp, ..Past::zero() };
    past.value.set(value);
    past.m.set(m);
    past.v.set(v);
    let mut now = past.value;
    evaluate(at, &past, &mut now);
    *value = now.to_block();
}

/// One optimizer step on listed rows of a view.
pub(super) struct StepRows<'k, 'a, const W: usize> {
    pub at: &'k AdamNow<'a>,
    pub view: RowsMut<'k>,
    pub rows: &'k [u32],
    pub grads: ColumnsRef<'k>,
}

impl<const W: usize> Kernel for StepRows<'_, '_, W> {
    type Out = StepCounts;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> StepCounts {
        let StepRows { at, view, rows, grads } = self;
        let RowsMut { mut columns, mut exp_avg, mut exp_avg_sq, stamp, .. } = view;
        let constants = StepConstants::new(at);
        let (mut pasts, mut gradients) = ([Past::<W>::zero(); 2], [RowVectors::<W>::zero(); 2]);
        let mut value = RowVectors::<W>::zero();
        let mut counts = StepCounts::default();
        for i in 0..=rows.len() {
            if let Some(&coming) = rows.get(i + AHEAD) {
                let coming = coming as usize - view.first_row;
                RowVectors::<W>::prefetch(&grads, i + AHEAD);
                RowVectors::<W>::prefetch(&columns.as_ref(), coming);
                RowVectors::<W>::prefetch(&exp_avg.as_ref(), coming);
                RowVectors::<W>::prefetch(&exp_avg_sq.as_ref(), coming);
            }
            if let Some(&row) = rows.get(i) {
                gradients[i % 2].load(&grads, i);
                let tables = [&columns.as_ref(), &exp_avg.as_ref(), &exp_avg_sq.as_ref()];
                pasts[i % 2].load(tables, stamp, row as usize - view.first_row);
            }
            let Some(&row) = i.checked_sub(1).and_then(|i| rows.get(i)) else { continue };
            let (past, g) = (&mut pasts[(i - 1) % 2], &gradients[(i - 1) % 2]);
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
            evaluate(at, past, &mut value);
            let powers = at.adam().beta_power(at.now().saturating_sub(past.stamp));
            let Past { m, v, .. } = past;
            constants.step(&mut value, m, v, g, powers);
            if at.adam().moments() == Moments::Bf16 {
                round::<W>(m, v, view.uid[row], at.now() + 1);
            }
            value.store(&mut columns, row);
            m.store(&mut exp_avg, row);
            v.store(&mut exp_avg_sq, row);
            stamp[row] = at.now() + 1;
            counts.updated += 1;
        }
        counts
    }
}

/// Rounds the moments of a row to what is kept of them.
#[inline(never)]
fn round<const W: usize>(m: &mut RowVectors<W>, v: &mut RowVectors<W>, uid: u64, steps: u32) {
    let (mut m_block, mut v_block) = (m.to_block(), v.to_block());
    round_block::<W>(&mut m_block, &mut v_block, uid, steps);
    m.set(&m_block);
    v.set(&v_block);
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
