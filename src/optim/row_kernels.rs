//! Deferred Adam on rows: the two loops over all the optimizer's bytes, which are forwarding (current values of listed rows) and
//! the step, and rows one by one. Not here: which rows are drawn, and who passes them in.
//!
//! A row is processed in whole vectors (`row_vectors`), which stay in registers from load to store where there
//! are enough of them (AVX-512). AVX2 has too few. Loops written for its registers by hand were faster in the cache only: on
//! 300,000 rows of an AMD Zen 4 they took 2 % less to 20 % more time.
//!
//! The step receives the rows' current values from the forwarding pass: computing them again would cost another root
//! and quotient per value.
//!
//! Floor: memory traffic, 4 floats per parameter for forwarding and 7 for the step; `cargo bench --bench step touched`
//! prints both beside a plain copy and plain passes of the same reads and writes.
//!
//! Invariants: 1. a row is rewritten only when its gradient is non-zero in some column or an event reaches it
//! ([`RowsNow::settle_row`]), and then as a whole; 2. an update starts from the result of the evaluation; 3. the bits are those of
//! [`RowsNow`] on every instruction path and for any number of threads; 4. no non-finite value enters the state.

use super::adam::AdamConfig;
use super::decay::Decay;
use super::deferred::{AdamNow, DeferredAdam, OfLanes};
use super::drift::{EpsFloor, drifted, flush, needs_direct_sum, of_column};
use super::lanes::SizeRows;
use super::moments::{Moments, round_block};
use super::row_vectors::{RowVectors, Table, TableMut, is_of_row_behind};
use crate::base::math::LARGEST_GRAD;
use crate::base::simd::{Kernel, LANES, dispatch};
use crate::scene::columns::{Column, Columns};
use crate::scene::log_scales::LogScaleRange;
use crate::scene::rows::{BLOCK_LANES, ColumnsMut, ColumnsRef, RowBlock, Rows, RowsMut, RowsNow, SH_N_LANE, scales_of};
use crate::scene::state::SceneState;

/// Rows per task of parallel work.
pub const ROWS_PER_TASK: usize = 1024;

/// Rows to prefetch ahead.
const AHEAD: usize = 8;
/// The sign bit of a float.
const SIGN: u32 = 1 << 31;

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StepCounts {
    /// Rows that were rewritten.
    pub updated: usize,
    /// Rows left unchanged because their gradient was not finite (or beyond [`crate::base::math::LARGEST_GRAD`]).
    pub skipped_non_finite: usize,
}

/// Takes optimizer step `now` (0-based) on the rows of the ascending list `rows`; `grads` has one row per entry.
/// Rows whose gradient is zero in every column stay untouched: they take the step when they are next read. Panics
/// as [`step_rows`] does, and for rows outside the state.
pub fn take_step(adam: &DeferredAdam, state: &mut SceneState, rows: &[u32], grads: &Columns, now: u32) -> StepCounts {
    assert_eq!(rows.len(), grads.rows(), "one gradient row per listed row");
    assert_eq!(state.sh_degree(), grads.sh_degree, "gradients of another degree");
    let at = adam.at(now);
    let mut values = Columns::zeros(rows.len(), grads.sh_degree);
    evaluate_rows(&at, state.view(), |i| rows[i] as usize, values.view_mut());
    step_rows(&at, state.view_mut(), rows, values.view(), grads.view())
}

/// Takes the step on a view of rows, as [`take_step`]. `rows` are numbered in the table that the view was
/// cut from and ascend strictly. `values` are the current values of the listed rows, from
/// [`evaluate_rows`]: whoever has gradients has evaluated the rows before. Panics, before any row changes,
/// if row counts or degrees differ, if the list does not ascend, or if it names rows outside the view.
pub fn step_rows(
    at: &AdamNow<'_>,
    view: RowsMut<'_>,
    rows: &[u32],
    values: ColumnsRef<'_>,
    grads: ColumnsRef<'_>,
) -> StepCounts {
    let (Some(&first), Some(&last)) = (rows.first(), rows.last()) else { return StepCounts::default() };
    let degree = view.columns.sh_degree;
    // All checks come before the first change, so that no row is left with half a step.
    assert_eq!([values.rows(), grads.rows()], [rows.len(); 2], "values and gradients of the listed rows");
    assert_eq!([values.sh_degree, grads.sh_degree], [degree; 2], "values or gradients of another degree");
    assert!(rows.is_sorted_by(|a, b| a < b), "listed rows ascend");
    let of_view = view.first_row..view.first_row + view.rows();
    assert!(of_view.contains(&(first as usize)) && of_view.contains(&(last as usize)), "listed rows of the view");
    step_checked(at, view, rows, values, grads)
}

/// [`step_rows`] on a checked list.
fn step_checked(
    at: &AdamNow<'_>,
    view: RowsMut<'_>,
    rows: &[u32],
    values: ColumnsRef<'_>,
    grads: ColumnsRef<'_>,
) -> StepCounts {
    if rows.is_empty() {
        return StepCounts::default();
    }
    if view.rows() > ROWS_PER_TASK {
        // Split at whole tasks, so that the pieces are the same for any number of threads.
        let middle = view.rows().div_ceil(ROWS_PER_TASK) / 2 * ROWS_PER_TASK;
        let bound = view.first_row + middle;
        let listed = rows.partition_point(|&row| (row as usize) < bound);
        let (head, tail) = view.split_at(middle);
        let (head_values, tail_values) = values.split_at(listed);
        let (head_grads, tail_grads) = grads.split_at(listed);
        let (a, b) = rayon::join(
            || step_checked(at, head, &rows[..listed], head_values, head_grads),
            || step_checked(at, tail, &rows[listed..], tail_values, tail_grads),
        );
        return StepCounts {
            updated: a.updated + b.updated,
            skipped_non_finite: a.skipped_non_finite + b.skipped_non_finite,
        };
    }
    debug_assert!(rows.iter().all(|&row| view.stamp[row as usize - view.first_row] <= at.now()), "a step taken twice");
    debug_assert!(are_values_of(at, &view.as_ref(), rows, &values), "values of another step");
    match view.columns.sh_degree {
        0 => dispatch(at.adam.simd, StepRows::<0> { at, view, rows, values, grads }),
        1 => dispatch(at.adam.simd, StepRows::<9> { at, view, rows, values, grads }),
        2 => dispatch(at.adam.simd, StepRows::<24> { at, view, rows, values, grads }),
        _ => dispatch(at.adam.simd, StepRows::<45> { at, view, rows, values, grads }),
    }
}

/// Whether `values` equal the current values of the listed rows, to the bit.
fn are_values_of(at: &AdamNow<'_>, view: &Rows<'_>, rows: &[u32], values: &ColumnsRef<'_>) -> bool {
    let mut now = Columns::zeros(rows.len(), values.sh_degree);
    evaluate_rows(at, *view, |i| rows[i] as usize - view.first_row, now.view_mut());
    let has_same_bits = |a: &[f32], b: &[f32]| a.iter().map(|x| x.to_bits()).eq(b.iter().map(|x| x.to_bits()));
    Column::ALL.into_iter().all(|column| has_same_bits(now.column(column), values.column(column)))
}

/// Evaluates rows into `out`: row i of `out` is the current value of row `row_of(i)` of the view (counted from its
/// first), in any order. `row_of` is called several times per row, so it must be cheap and consistent. Panics for
/// rows outside the view, and if the degrees differ.
pub fn evaluate_rows(at: &AdamNow<'_>, view: Rows<'_>, row_of: impl Fn(usize) -> usize, out: ColumnsMut<'_>) {
    assert_eq!(view.columns.sh_degree, out.sh_degree, "values of another degree");
    match out.sh_degree {
        0 => dispatch(at.adam.simd, EvaluateRows::<0, _> { at, view, row_of, out }),
        1 => dispatch(at.adam.simd, EvaluateRows::<9, _> { at, view, row_of, out }),
        2 => dispatch(at.adam.simd, EvaluateRows::<24, _> { at, view, row_of, out }),
        _ => dispatch(at.adam.simd, EvaluateRows::<45, _> { at, view, row_of, out }),
    }
}

impl RowsNow for AdamNow<'_> {
    #[inline(always)]
    fn now(&self) -> u32 {
        self.now
    }

    fn evaluate_row(&self, rows: &Rows<'_>, row: usize, out: &mut RowBlock) {
        let (mut m, mut v) = ([0.0; BLOCK_LANES], [0.0; BLOCK_LANES]);
        *out = [0.0; BLOCK_LANES];
        rows.columns.load_row_any(row, out);
        rows.exp_avg.load_row_any(row, &mut m);
        rows.exp_avg_sq.load_row_any(row, &mut v);
        dispatch(self.adam.simd, EvaluateBlock { at: self, value: out, m: &m, v: &v, stamp: rows.stamp[row] });
    }

    fn evaluate_element(&self, rows: &Rows<'_>, column: Column, row: usize, element: usize) -> f32 {
        let of = |table: &ColumnsRef<'_>| table.column(column)[row * column.width(table.sh_degree) + element];
        let (value, m, v) = (of(&rows.columns), of(&rows.exp_avg), of(&rows.exp_avg_sq));
        let stamp = rows.stamp[row];
        self.evaluate_value(column, value, m, v, stamp)
    }

    fn log_scales(&self) -> LogScaleRange {
        self.adam.log_scales
    }

    fn sizes_and_opacities(&self, rows: &Rows<'_>, log_scales: &mut [f32], opacities: &mut [f32]) {
        dispatch(self.adam.simd, SizeRows { at: self, rows, log_scales, opacities });
    }

    fn settle_row(&self, rows: &mut RowsMut<'_>, row: usize) {
        let stamp = rows.stamp[row];
        if stamp >= self.now() {
            return;
        }
        let mut value = [0.0; BLOCK_LANES];
        self.evaluate_row(&rows.as_ref(), row, &mut value);
        self.adam.log_scales.clamp_all(scales_of(&mut value));
        rows.columns.store_row_any(row, &value);
        let decay = self.settled_decay(stamp);
        let (mut m, mut v) = ([0.0; BLOCK_LANES], [0.0; BLOCK_LANES]);
        rows.exp_avg.as_ref().load_row_any(row, &mut m);
        rows.exp_avg_sq.as_ref().load_row_any(row, &mut v);
        m.iter_mut().for_each(|x| *x = decay.first_moment(*x));
        v.iter_mut().for_each(|x| *x = decay.second_moment(*x, 0.0));
        if self.adam.moments == Moments::Bf16 {
            round_block::<45>(&mut m, &mut v, rows.uid[row], self.now());
        }
        rows.exp_avg.store_row_any(row, &m);
        rows.exp_avg_sq.store_row_any(row, &v);
        rows.stamp[row] = self.now();
    }
}

/// Evaluates listed rows into a table.
struct EvaluateRows<'k, 'a, const W: usize, F> {
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
    let (now, is_direct) = drifted_row(at, past);
    (!is_direct).then_some(now)
}

/// The values of a row after their drift, and whether one of them needs the direct sum instead.
#[inline(always)]
fn drifted_row<const W: usize>(at: &AdamNow<'_>, past: &Past<W>) -> (RowVectors<W>, bool) {
    if past.stamp >= at.now() {
        return (past.value, false);
    }
    let (EpsFloor { eps, floor }, rates) = (at.adam.eps, &at.adam.lane_rates);
    let (value, m, v) = (&past.value.0, &past.m.0, &past.v.0);
    let mut is_direct = false;
    for l in 0..RowVectors::<W>::USED {
        is_direct |= needs_direct_sum(m[l], v[l], floor);
    }
    let drift = at.drift(past.stamp);
    let (means, others) = (of_column(drift, Column::Means), of_column(drift, Column::ShN));
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
    (RowVectors(now), is_direct)
}

/// Evaluates the last row of a table, or one for which [`evaluate`] returned `None`. Loads the row itself, because an
/// argument could not stay in registers.
#[cold]
#[inline(never)]
fn evaluate_alone<const W: usize>(at: &AdamNow<'_>, view: &Rows<'_>, row: usize) -> RowVectors<W> {
    let mut now = [0.0; BLOCK_LANES];
    at.evaluate_row(view, row, &mut now);
    RowVectors::of_block(&now)
}

/// Moves the values of one row of any width to now, by the series or by the direct sum.
struct EvaluateBlock<'k, 'a> {
    at: &'k AdamNow<'a>,
    value: &'k mut RowBlock,
    m: &'k RowBlock,
    v: &'k RowBlock,
    stamp: u32,
}

impl Kernel for EvaluateBlock<'_, '_> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let EvaluateBlock { at, value, m, v, stamp } = self;
        let then = Past::<45> { value: RowVectors(*value), m: RowVectors(*m), v: RowVectors(*v), stamp };
        let (now, is_direct) = drifted_row(at, &then);
        if !is_direct {
            *value = now.0;
            return;
        }
        let moved = at.adam.tables.direct_sums(m, v, stamp, at.now(), 3);
        let rates = &at.adam.lane_rates;
        for l in 0..BLOCK_LANES {
            let rate = if l < SH_N_LANE { rates.narrow[l] } else { rates.sh_n };
            let directly = flush(value[l] - moved[l] * rate);
            value[l] = if needs_direct_sum(m[l], v[l], at.adam.eps.floor) { directly } else { now.0[l] };
        }
    }
}

/// One optimizer step on listed rows of a view. The rows ascend, because a row listed twice would lose its first step.
struct StepRows<'k, 'a, const W: usize> {
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
fn finish_step<const W: usize>(
    at: &AdamNow<'_>,
    constants: &StepConstants,
    view: &mut RowsMut<'_>,
    (rows, last): (&[u32], u32),
    [values, grads]: [&ColumnsRef<'_>; 2],
    counts: StepCounts,
) -> StepCounts {
    let kind = step_last::<W>(at, constants, view, last as usize - view.first_row, values, grads);
    if at.adam.moments == Moments::Bf16 {
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
enum GradKind {
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
struct StepConstants {
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
        let (tables, now) = (&at.adam.tables, at.now());
        let [inv_bias1, inv_root] = tables.bias(now + 1);
        let AdamConfig { beta1, beta2, eps } = tables.config();
        let LogScaleRange { low, high } = at.adam.log_scales;
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
