//! The two loops over all the optimizer's bytes: forwarding (current values of listed rows) and the step, for every
//! instruction path except AVX2.
//!
//! A row is processed in whole vectors ([`super::row_vectors`]), which stay in registers from load to store where there
//! are enough of them (AVX-512). AVX2 has too few: see `super::eights`.
//!
//! The step receives the rows' current values from the forwarding pass: computing them again would cost another root
//! and quotient per value.
//!
//! Floor: memory traffic, 4 floats per parameter for forwarding and 7 for the step; `cargo bench --bench step touched`
//! prints both beside a plain copy and plain passes of the same reads and writes.
//!
//! Invariant: the bits are those of [`RowsNow`] on every instruction path.

use super::adam::AdamConfig;
use super::adam_now::{AdamNow, OfLanes, StepCounts};
use super::decay::Decay;
use super::drift::{EpsFloor, drifted, flush, needs_direct_sum};
use super::moments::{Moments, round_block};
use super::row_vectors::{RowVectors, Table, TableMut, is_of_row_behind};
use crate::base::math::LARGEST_GRAD;
use crate::base::simd::{Kernel, LANES};
use crate::scene::columns::Column;
use crate::scene::log_scales::LogScaleRange;
use crate::scene::rows::{BLOCK_LANES, ColumnsMut, ColumnsRef, RowBlock, Rows, RowsMut, RowsNow, SH_N_LANE};

/// Rows to prefetch ahead.
pub(super) const AHEAD: usize = 8;
/// The sign bit of a float.
const SIGN: u32 = 1 << 31;

/// Evaluates listed rows into a table.
pub(super) struct EvaluateRows<'k, 'a, const W: usize, F> {
    pub at: &'k AdamNow<'a>,
    pub view: Rows<'k>,
    /// Row of the view for each row of `out`.
    pub row_of: F,
    pub out: ColumnsMut<'k>,
}

impl<const W: usize, F: Fn(usize) -> usize> Kernel for EvaluateRows<'_, '_, W, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let EvaluateRows { at, view, row_of, mut out } = self;
        let (rows, listed) = (view.rows(), out.rows());
        let value = Table::<W>::new(&view.columns, rows);
        let (m, v) = (Table::<W>::new(&view.exp_avg, rows), Table::<W>::new(&view.exp_avg_sq, rows));
        let mut out = TableMut::<W>::new(&mut out, listed);
        for i in 0..listed {
            if i + AHEAD < listed {
                let coming = row_of(i + AHEAD);
                value.prefetch(coming);
                m.prefetch(coming);
                v.prefetch(coming);
            }
            let row = row_of(i);
            if row + 1 < rows {
                let past = Past { value: value.load(row), m: m.load(row), v: v.load(row), stamp: view.stamp[row] };
                if let Some(now) = evaluate(at, &past) {
                    // Stored here, instead of where the other function's result is handled: that result is in memory,
                    // and merging both would send every row through memory.
                    out.store(i, &now);
                    continue;
                }
            }
            out.store_alone(i, &evaluate_alone(at, &view, row));
        }
    }
}

/// A row as stored by its last update.
struct Past<const W: usize> {
    value: RowVectors<W>,
    m: RowVectors<W>,
    v: RowVectors<W>,
    /// Number of steps that it contains.
    stamp: u32,
}

/// The current values of a row; `None` if eps affects one of them or a value loaded with them.
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
            // The first lanes are the means.
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

/// Evaluates the last row of a table, or one for which [`evaluate`] returned `None`. Loads the row itself, because an
/// argument could not stay in registers.
#[cold]
#[inline(never)]
pub(super) fn evaluate_alone<const W: usize>(at: &AdamNow<'_>, view: &Rows<'_>, row: usize) -> RowVectors<W> {
    let mut now = [0.0; BLOCK_LANES];
    at.evaluate_row(view, row, &mut now);
    RowVectors::of_block(&now)
}

/// Moves the values of one row of any width to now.
pub(super) fn evaluate_block(at: &AdamNow<'_>, value: &mut RowBlock, m: &RowBlock, v: &RowBlock, stamp: u32) {
    let [then, m_vectors, v_vectors] = [&*value, m, v].map(RowVectors::of_block);
    match evaluate(at, &Past::<45> { value: then, m: m_vectors, v: v_vectors, stamp }) {
        Some(now) => *value = now.to_block(),
        None => at.evaluate_block_directly(value, m, v, stamp),
    }
}

/// One optimizer step on listed rows of a view. The rows ascend, because a row listed twice would lose its first step.
pub(super) struct StepRows<'k, 'a, const W: usize> {
    pub at: &'k AdamNow<'a>,
    pub view: RowsMut<'k>,
    pub rows: &'k [u32],
    /// Current values of the listed rows, from [`EvaluateRows`].
    pub values: ColumnsRef<'k>,
    pub grads: ColumnsRef<'k>,
}

impl<const W: usize> Kernel for StepRows<'_, '_, W> {
    type Out = StepCounts;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> StepCounts {
        let StepRows { at, mut view, rows, values, grads } = self;
        let (first_row, count) = (view.first_row, view.rows());
        let Some((&last, before)) = rows.split_last() else { return StepCounts::default() };
        let mut columns = TableMut::<W>::new(&mut view.columns, count);
        let mut exp_avg = TableMut::<W>::new(&mut view.exp_avg, count);
        let mut exp_avg_sq = TableMut::<W>::new(&mut view.exp_avg_sq, count);
        let (value, grad) = (Table::<W>::new(&values, rows.len()), Table::<W>::new(&grads, rows.len()));
        let stamp = &mut view.stamp[..count];
        let constants = StepConstants::new(at);
        let mut counts = StepCounts::default();
        for (i, &row) in before.iter().enumerate() {
            if let Some(&coming) = rows.get(i + AHEAD) {
                let coming = coming as usize - first_row;
                for (table, row) in [(&grad, i + AHEAD), (&value, i + AHEAD)] {
                    table.prefetch(row);
                    table.prefetch_narrow(row);
                }
                for table in [columns.as_ref(), exp_avg.as_ref(), exp_avg_sq.as_ref()] {
                    table.prefetch(coming);
                    table.prefetch_narrow(coming);
                }
            }
            let row = row as usize - first_row;
            let g = grad.load(i);
            let kind = GradKind::of(&g);
            if kind != GradKind::Usable {
                counts.skipped_non_finite += usize::from(kind == GradKind::Bad);
                continue;
            }
            counts.updated += 1;
            // Placed before the loads, so that nothing separates them from their use.
            let decay = at.step_decay(stamp[row]);
            let mut now = value.load(i);
            let (mut m, mut v) = (exp_avg.as_ref().load(row), exp_avg_sq.as_ref().load(row));
            constants.step(&mut now, &mut m, &mut v, &g, decay);
            columns.store(row, &now);
            exp_avg.store(row, &m);
            exp_avg_sq.store(row, &v);
            stamp[row] = at.now() + 1;
        }
        finish_step::<W>(at, &constants, &mut view, (rows, last), [&values, &grads], counts)
    }
}

/// Finishes the step that all listed `rows` except the last have taken.
#[inline(always)]
pub(super) fn finish_step<const W: usize>(
    at: &AdamNow<'_>,
    constants: &StepConstants,
    view: &mut RowsMut<'_>,
    (rows, last): (&[u32], u32),
    [values, grads]: [&ColumnsRef<'_>; 2],
    counts: StepCounts,
) -> StepCounts {
    let kind = step_last::<W>(at, constants, view, last as usize - view.first_row, values, grads);
    if at.adam().moments() == Moments::Bf16 {
        // A loop of its own, so that the main loop keeps its registers.
        for row in rows.iter().map(|&row| row as usize - view.first_row) {
            // Only rows of this step have stamps ahead of now.
            if view.stamp[row] > at.now() {
                round_row::<W>(&mut view.exp_avg, &mut view.exp_avg_sq, row, view.uid[row], at.now() + 1);
            }
        }
    }
    StepCounts {
        updated: counts.updated + usize::from(kind == GradKind::Usable),
        skipped_non_finite: counts.skipped_non_finite + usize::from(kind == GradKind::Bad),
    }
}

/// Kind of a row's gradient.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum GradKind {
    /// Zero in every column: the row stays unchanged.
    Zero,
    /// Finite and usable.
    Usable,
    /// Not finite, or too large.
    Bad,
}

impl GradKind {
    /// Lane by lane up to the two final comparisons.
    #[inline(always)]
    fn of<const W: usize>(g: &RowVectors<W>) -> GradKind {
        // Without signs, floats are ordered as integers, with non-finite ones after all others.
        let mut largest = [0; LANES];
        for first in (0..RowVectors::<W>::USED).step_by(LANES) {
            for l in 0..LANES {
                let without_sign = if is_of_row_behind(first + l) { 0 } else { !SIGN };
                largest[l] = largest[l].max(g.0[first + l].to_bits() & without_sign);
            }
        }
        let (mut is_bad, mut is_some) = (false, false);
        for bits in largest {
            is_bad |= bits > LARGEST_GRAD.to_bits();
            is_some |= bits != 0;
        }
        match (is_bad, is_some) {
            (true, _) => GradKind::Bad,
            (false, true) => GradKind::Usable,
            (false, false) => GradKind::Zero,
        }
    }
}

/// The step on the last listed row, row `row` of the view, which may be the view's last. Cold: once per thousand rows.
#[cold]
#[inline(never)]
fn step_last<const W: usize>(
    at: &AdamNow<'_>,
    constants: &StepConstants,
    view: &mut RowsMut<'_>,
    row: usize,
    values: &ColumnsRef<'_>,
    grads: &ColumnsRef<'_>,
) -> GradKind {
    let load = |columns: &ColumnsRef<'_>, row: usize| {
        let mut block = [0.0; BLOCK_LANES];
        columns.load_row::<W>(row, &mut block);
        RowVectors::<W>::of_block(&block)
    };
    let i = grads.rows() - 1;
    let g = load(grads, i);
    let kind = GradKind::of(&g);
    if kind == GradKind::Usable {
        let mut now = load(values, i);
        let [mut m, mut v] = [&view.exp_avg, &view.exp_avg_sq].map(|moments| load(&moments.as_ref(), row));
        let decay = at.step_decay(view.stamp[row]);
        constants.step(&mut now, &mut m, &mut v, &g, decay);
        view.columns.store_row::<W>(row, &now.to_block());
        view.exp_avg.store_row::<W>(row, &m.to_block());
        view.exp_avg_sq.store_row::<W>(row, &v.to_block());
        view.stamp[row] = at.now() + 1;
    }
    kind
}

/// Rounds the moments of a stored row that contains `steps` steps to the storage format.
#[inline(always)]
fn round_row<const W: usize>(m: &mut ColumnsMut<'_>, v: &mut ColumnsMut<'_>, row: usize, uid: u64, steps: u32) {
    let [mut m_block, mut v_block] = [[0.0; BLOCK_LANES]; 2];
    m.as_ref().load_row::<W>(row, &mut m_block);
    v.as_ref().load_row::<W>(row, &mut v_block);
    round_block::<W>(&mut m_block, &mut v_block, uid, steps);
    m.store_row::<W>(row, &m_block);
    v.store_row::<W>(row, &v_block);
}

/// Constants of one ordinary Adam step.
pub(super) struct StepConstants {
    /// Least and greatest values of the narrow columns, by lane: the range of log-scales, no limit elsewhere.
    pub lows: [f32; LANES],
    pub highs: [f32; LANES],
    /// lr / (1 - beta1^t).
    pub sizes: OfLanes,
    pub inv_root_correction: f32,
    pub one_minus_b1: f32,
    pub one_minus_b2: f32,
    pub eps: f32,
}

impl StepConstants {
    pub fn new(at: &AdamNow<'_>) -> Self {
        let (tables, now) = (at.adam().tables(), at.now());
        let [inv_bias1, inv_root] = tables.bias(now + 1);
        let AdamConfig { beta1, beta2, eps } = tables.config();
        let LogScaleRange { low, high } = at.adam().log_scales();
        let of_scales = |limit: f32, none: f32| OfLanes::new(|c| if c == Column::Scales { limit } else { none }).narrow;
        StepConstants {
            lows: of_scales(low, f32::NEG_INFINITY),
            highs: of_scales(high, f32::INFINITY),
            sizes: OfLanes::new(|column| (tables.rates().at(column, now) * inv_bias1) as f32),
            inv_root_correction: inv_root as f32,
            one_minus_b1: (1.0 - beta1) as f32,
            one_minus_b2: (1.0 - beta2) as f32,
            eps: eps as f32,
        }
    }

    /// Decays the moments of a loaded row ([`AdamNow::step_decay`]), then takes the step with gradient `g`.
    #[inline(always)]
    fn step<const W: usize>(
        &self,
        value: &mut RowVectors<W>,
        m: &mut RowVectors<W>,
        v: &mut RowVectors<W>,
        g: &RowVectors<W>,
        decay: Decay,
    ) {
        let (value, m, v, g) = (&mut value.0, &mut m.0, &mut v.0, &g.0);
        for l in 0..SH_N_LANE {
            (value[l], m[l], v[l]) = self.step_value(value[l], m[l], v[l], g[l], decay, self.sizes.narrow[l]);
        }
        for l in SH_N_LANE..RowVectors::<W>::USED {
            (value[l], m[l], v[l]) = self.step_value(value[l], m[l], v[l], g[l], decay, self.sizes.sh_n);
        }
        for l in 0..SH_N_LANE {
            let (low, high) = (self.lows[l], self.highs[l]);
            // Not f32::clamp, which checks its limits.
            value[l] = if value[l] > high { high } else { value[l] };
            value[l] = if value[l] < low { low } else { value[l] };
        }
    }

    #[inline(always)]
    fn step_value(&self, value: f32, m: f32, v: f32, g: f32, decay: Decay, step_size: f32) -> (f32, f32, f32) {
        let m = decay.first_moment(m);
        // Not beta m + (1 - beta) g, for the reason in `super::decay`.
        let m = flush(m + (g - m) * self.one_minus_b1);
        let v = decay.second_moment(v, g * g * self.one_minus_b2);
        let root = v.sqrt() * self.inv_root_correction + self.eps;
        (flush(value - step_size * (m / root)), m, v)
    }
}
