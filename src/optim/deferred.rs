//! Deferred Adam: dense Adam, with the steps without a gradient computed only when the row is read.
//!
//! A row's stored state is the state after its last gradient, with the number of steps that it contains. Its current
//! value is a pure function of that state ([`super::drift`]), and reading stores nothing. So it does not matter how
//! often, when and by whom rows are read, evicted or loaded. Not decided here: which rows are drawn, and who passes
//! them in.
//!
//! Invariants: 1. a row is rewritten only when its gradient is non-zero in some column or an event reaches it
//! ([`RowsNow::settle_row`]), and then as a whole; 2. one function evaluates, and an update starts from its result; 3.
//! the same bits on every instruction path and for any number of threads; 4. no non-finite value enters the state.

use super::adam::AdamConfig;
use super::decay::Decay;
use super::drift::{Drift, DriftTables, EpsFloor, RECENT, drifted, flush, needs_direct_sum};
#[cfg(target_arch = "x86_64")]
use super::eights::Eights;
use super::lanes::SizeRows;
use super::moments::{Moments, round_block};
use super::rates::Rates;
use super::row_kernels::{EvaluateRows, OfLanes, StepRows, evaluate_block};
#[cfg(target_arch = "x86_64")]
use crate::base::eight::{EightKernel, with_avx2};
use crate::base::simd::{Kernel, SimdPath, dispatch};
use crate::scene::columns::{Column, Columns};
use crate::scene::rows::{BLOCK_LANES, ColumnsMut, ColumnsRef, RowBlock, Rows, RowsMut, RowsNow, first_lane};
use crate::scene::state::SceneState;

/// Rows per task of parallel work.
pub const ROWS_PER_TASK: usize = 1024;
/// Gaps whose decay is tabulated; longer ones are computed.
const TABLED_GAPS: usize = 4096;

/// The optimizer of a run: rates, tables, instruction path. Holds no row state.
#[derive(Debug, Clone)]
pub struct DeferredAdam {
    tables: DriftTables,
    /// Base rates.
    lane_rates: OfLanes,
    eps: EpsFloor,
    /// `[k]`: decay of the moments over k steps.
    decays: Vec<Decay>,
    simd: SimdPath,
    moments: Moments,
}

/// Counts of one step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StepCounts {
    /// Rows that were rewritten.
    pub updated: usize,
    /// Rows left unchanged because their gradient was not finite (or beyond 1e18).
    pub skipped_non_finite: usize,
}

/// The optimizer at one step: everything that evaluation at this step needs, so that the work per row is a look-up.
#[derive(Debug, Clone)]
pub struct AdamNow<'a> {
    adam: &'a DeferredAdam,
    now: u32,
    /// `[k]`: drift of a row that missed k steps.
    recent: [Drift; RECENT],
}

impl DeferredAdam {
    /// Builds the tables for these rates; panics as [`DriftTables::new`] does.
    pub fn new(rates: Rates, config: AdamConfig, simd: SimdPath) -> Self {
        let lane_rates = OfLanes::new(|column| rates.base(column) as f32);
        DeferredAdam {
            tables: DriftTables::new(rates, config),
            lane_rates,
            eps: EpsFloor::new(config.eps),
            decays: (0..TABLED_GAPS as u32).map(|k| Decay::new(config, k)).collect(),
            simd,
            moments: Moments::F32,
        }
    }

    /// The same optimizer with another storage format of moments.
    #[must_use]
    pub fn with_moments(self, moments: Moments) -> Self {
        DeferredAdam { moments, ..self }
    }

    /// The same optimizer without catching up: rows without a gradient keep their values and moments
    /// ([`super::method::Method::Sparse`]).
    #[must_use]
    pub fn without_catch_up(self) -> Self {
        DeferredAdam { tables: self.tables.still(), ..self }
    }

    /// Storage format of moments.
    pub fn moments(&self) -> Moments {
        self.moments
    }

    /// The rates of the run.
    pub fn rates(&self) -> &Rates {
        self.tables.rates()
    }

    /// Bytes of the tables.
    pub fn bytes(&self) -> usize {
        self.tables.bytes() + self.decays.len() * size_of::<Decay>()
    }

    /// The optimizer after `now` steps. Costs about a microsecond.
    pub fn at(&self, now: u32) -> AdamNow<'_> {
        let recent = std::array::from_fn(|k| self.tables.drift(now.saturating_sub(k as u32), now));
        AdamNow { adam: self, now, recent }
    }

    /// One value after `now` steps, from its state after `stamp` steps. This defines a single value; [`AdamNow`] gives
    /// the same bits for rows.
    pub fn evaluate(&self, column: Column, value: f32, m: f32, v: f32, stamp: u32, now: u32) -> f32 {
        self.evaluate_with(&self.tables.drift(stamp, now), column, value, m, v, stamp, now)
    }

    /// Series sums of the movement to the limit, for a row of this stamp.
    #[inline(always)]
    pub(crate) fn limit_drift(&self, stamp: u32) -> &Drift {
        self.tables.limit(stamp)
    }

    /// The limit of a value that gets no more gradients; it moves there from `value` monotonically.
    pub(crate) fn limit(&self, column: Column, value: f32, m: f32, v: f32, stamp: u32) -> f32 {
        self.evaluate_with(self.tables.limit(stamp), column, value, m, v, stamp, u32::MAX)
    }

    /// The run's instruction path.
    pub(crate) fn simd(&self) -> SimdPath {
        self.simd
    }

    /// Base rates of the lanes of a row.
    #[inline(always)]
    pub(super) fn lane_rates(&self) -> &OfLanes {
        &self.lane_rates
    }

    pub(super) fn tables(&self) -> &DriftTables {
        &self.tables
    }

    /// eps, and the second moment above which the series is valid.
    #[inline(always)]
    pub(crate) fn eps_floor(&self) -> EpsFloor {
        self.eps
    }

    /// Base rate of a column, as the evaluation uses it.
    #[inline(always)]
    pub(crate) fn base_rate(&self, column: Column) -> f32 {
        self.lane_rates.of(column)
    }

    fn evaluate_with(&self, drift: &Drift, column: Column, value: f32, m: f32, v: f32, stamp: u32, now: u32) -> f32 {
        if stamp >= now {
            return value;
        }
        let of_means = column == Column::Means;
        let rate = self.lane_rates.of(column);
        if needs_direct_sum(m, v, self.eps.floor) {
            return flush(value - self.tables.direct_sum(m, v, stamp, now, of_means) * rate);
        }
        let sums = if of_means { [drift[0], drift[1], drift[2]] } else { [drift[4], drift[5], drift[6]] };
        drifted(value, m, v, sums, rate, self.eps.eps)
    }

    /// Takes optimizer step `now` (0-based) on the rows of the ascending list `rows`; `grads` has one row per entry.
    /// Rows whose gradient is zero in every column stay untouched: they take the step when they are next read. Panics
    /// as [`AdamNow::step_rows`] does, and for rows outside the state.
    pub fn step(&self, state: &mut SceneState, rows: &[u32], grads: &Columns, now: u32) -> StepCounts {
        assert_eq!(rows.len(), grads.rows(), "one gradient row per listed row");
        assert_eq!(state.sh_degree(), grads.sh_degree, "gradients of another degree");
        let at = self.at(now);
        let mut values = Columns::zeros(rows.len(), grads.sh_degree);
        at.evaluate_rows(state.view(), |i| rows[i] as usize, values.view_mut());
        at.step_rows(state.view_mut(), rows, values.view(), grads.view())
    }

    /// The decay of the moments over `k` steps.
    #[inline(always)]
    fn decay(&self, k: u32) -> Decay {
        match self.decays.get(k as usize) {
            Some(&decay) => decay,
            None => self.far_decay(k),
        }
    }

    /// The decay over `k` steps beyond the table.
    #[cold]
    #[inline(never)]
    fn far_decay(&self, k: u32) -> Decay {
        Decay::new(self.tables.config(), k)
    }
}

impl<'a> AdamNow<'a> {
    /// The optimizer.
    #[inline(always)]
    pub fn adam(&self) -> &'a DeferredAdam {
        self.adam
    }

    /// The run's instruction path.
    pub fn simd(&self) -> SimdPath {
        self.adam.simd
    }

    /// Number of steps without a gradient over which the moments of a row of this stamp decay.
    #[inline(always)]
    fn missed(&self, stamp: u32) -> u32 {
        if self.adam.tables.is_still() { 0 } else { self.now.saturating_sub(stamp) }
    }

    /// The decay that the current step applies to the moments of a row of this stamp: for the first moment over the
    /// missed steps, for the second moment over the missed steps and this one.
    #[inline(always)]
    pub(super) fn step_decay(&self, stamp: u32) -> Decay {
        let missed = self.missed(stamp);
        Decay { first: self.adam.decay(missed).first, ..self.adam.decay(missed.saturating_add(1)) }
    }

    /// Series sums for a row of this stamp.
    #[inline(always)]
    pub(crate) fn drift(&self, stamp: u32) -> &Drift {
        let gap = self.now.saturating_sub(stamp) as usize;
        if gap < RECENT { &self.recent[gap] } else { self.adam.tables.limit(stamp) }
    }

    /// Takes the step on a view of rows, as [`DeferredAdam::step`]. `rows` are numbered in the table that the view was
    /// cut from and ascend strictly. `values` are the current values of the listed rows, from
    /// [`AdamNow::evaluate_rows`]: whoever has gradients has evaluated the rows before. Panics, before any row changes,
    /// if row counts or degrees differ, if the list does not ascend, or if it names rows outside the view.
    pub fn step_rows(
        &self,
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
        self.step_checked(view, rows, values, grads)
    }

    /// [`AdamNow::step_rows`] on a checked list.
    fn step_checked(
        &self,
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
            let at = view.rows().div_ceil(ROWS_PER_TASK) / 2 * ROWS_PER_TASK;
            let bound = view.first_row + at;
            let listed = rows.partition_point(|&row| (row as usize) < bound);
            let (head, tail) = view.split_at(at);
            let (head_values, tail_values) = values.split_at(listed);
            let (head_grads, tail_grads) = grads.split_at(listed);
            let (a, b) = rayon::join(
                || self.step_checked(head, &rows[..listed], head_values, head_grads),
                || self.step_checked(tail, &rows[listed..], tail_values, tail_grads),
            );
            return StepCounts {
                updated: a.updated + b.updated,
                skipped_non_finite: a.skipped_non_finite + b.skipped_non_finite,
            };
        }
        debug_assert!(
            rows.iter().all(|&row| view.stamp[row as usize - view.first_row] <= self.now),
            "a step taken twice"
        );
        debug_assert!(self.are_values_of(&view.as_ref(), rows, &values), "values of another step");
        match view.columns.sh_degree {
            0 => over_rows(self.adam.simd, StepRows::<0> { at: self, view, rows, values, grads }),
            1 => over_rows(self.adam.simd, StepRows::<9> { at: self, view, rows, values, grads }),
            2 => over_rows(self.adam.simd, StepRows::<24> { at: self, view, rows, values, grads }),
            _ => over_rows(self.adam.simd, StepRows::<45> { at: self, view, rows, values, grads }),
        }
    }

    /// Whether `values` equal the current values of the listed rows, to the bit.
    fn are_values_of(&self, view: &Rows<'_>, rows: &[u32], values: &ColumnsRef<'_>) -> bool {
        let mut now = Columns::zeros(rows.len(), values.sh_degree);
        self.evaluate_rows(*view, |i| rows[i] as usize - view.first_row, now.view_mut());
        let has_same_bits = |a: &[f32], b: &[f32]| a.iter().map(|x| x.to_bits()).eq(b.iter().map(|x| x.to_bits()));
        Column::ALL.into_iter().all(|column| has_same_bits(now.column(column), values.column(column)))
    }

    /// Evaluates rows into `out`: row i of `out` is the current value of row `row_of(i)` of the view (counted from its
    /// first), in any order. `row_of` is called several times per row, so it must be cheap and consistent. Panics for
    /// rows outside the view, and if the degrees differ.
    pub fn evaluate_rows(&self, view: Rows<'_>, row_of: impl Fn(usize) -> usize, out: ColumnsMut<'_>) {
        assert_eq!(view.columns.sh_degree, out.sh_degree, "values of another degree");
        match out.sh_degree {
            0 => over_rows(self.adam.simd, EvaluateRows::<0, _> { at: self, view, row_of, out }),
            1 => over_rows(self.adam.simd, EvaluateRows::<9, _> { at: self, view, row_of, out }),
            2 => over_rows(self.adam.simd, EvaluateRows::<24, _> { at: self, view, row_of, out }),
            _ => over_rows(self.adam.simd, EvaluateRows::<45, _> { at: self, view, row_of, out }),
        }
    }

    /// Moves the values of one loaded row to now, lane by lane, if eps affects one of them.
    pub(super) fn evaluate_block_directly(&self, value: &mut RowBlock, m: &RowBlock, v: &RowBlock, stamp: u32) {
        let drift = self.drift(stamp);
        for column in Column::ALL {
            let first = first_lane(column);
            for l in first..first + column.width(3) {
                value[l] = self.adam.evaluate_with(drift, column, value[l], m[l], v[l], stamp, self.now);
            }
        }
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
        evaluate_block(self, out, &m, &v, rows.stamp[row]);
    }

    fn evaluate_element(&self, rows: &Rows<'_>, column: Column, row: usize, element: usize) -> f32 {
        let of = |table: &ColumnsRef<'_>| table.column(column)[row * column.width(table.sh_degree) + element];
        let (value, m, v) = (of(&rows.columns), of(&rows.exp_avg), of(&rows.exp_avg_sq));
        let stamp = rows.stamp[row];
        self.adam.evaluate_with(self.drift(stamp), column, value, m, v, stamp, self.now)
    }

    fn sizes_and_opacities(&self, rows: &Rows<'_>, log_scales: &mut [f32], opacities: &mut [f32]) {
        dispatch(self.adam.simd, SizeRows { at: self, rows, log_scales, opacities });
    }

    fn settle_row(&self, rows: &mut RowsMut<'_>, row: usize) {
        let stamp = rows.stamp[row];
        if stamp >= self.now {
            return;
        }
        let mut value = [0.0; BLOCK_LANES];
        self.evaluate_row(&rows.as_ref(), row, &mut value);
        rows.columns.store_row_any(row, &value);
        let decay = self.adam.decay(self.missed(stamp));
        let (mut m, mut v) = ([0.0; BLOCK_LANES], [0.0; BLOCK_LANES]);
        rows.exp_avg.as_ref().load_row_any(row, &mut m);
        rows.exp_avg_sq.as_ref().load_row_any(row, &mut v);
        m.iter_mut().for_each(|x| *x = decay.first_moment(*x));
        v.iter_mut().for_each(|x| *x = decay.second_moment(*x, 0.0));
        if self.adam.moments == Moments::Bf16 {
            round_block::<45>(&mut m, &mut v, rows.uid[row], self.now);
        }
        rows.exp_avg.store_row_any(row, &m);
        rows.exp_avg_sq.store_row_any(row, &v);
        rows.stamp[row] = self.now;
    }
}

/// Runs a loop over rows in the form written for the path.
#[cfg(target_arch = "x86_64")]
#[inline]
fn over_rows<K: Kernel>(path: SimdPath, kernel: K) -> K::Out
where
    Eights<K>: EightKernel<Out = K::Out>,
{
    if path != SimdPath::Avx2 {
        return dispatch(path, kernel);
    }
    with_avx2(Eights(kernel)).unwrap_or_else(|Eights(kernel)| dispatch(SimdPath::Baseline, kernel))
}

/// Runs a loop over rows.
#[cfg(not(target_arch = "x86_64"))]
#[inline]
fn over_rows<K: Kernel>(path: SimdPath, kernel: K) -> K::Out {
    dispatch(path, kernel)
}
