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

pub use super::adam_now::{AdamNow, DeferredAdam, StepCounts};
#[cfg(target_arch = "x86_64")]
use super::eights::Eights;
use super::lanes::SizeRows;
use super::moments::{Moments, round_block};
use super::row_kernels::{EvaluateRows, StepRows, evaluate_block};
#[cfg(target_arch = "x86_64")]
use crate::base::eight::{EightKernel, with_avx2};
use crate::base::simd::{Kernel, SimdPath, dispatch};
use crate::scene::columns::{Column, Columns};
use crate::scene::log_scales::LogScaleRange;
use crate::scene::rows::{BLOCK_LANES, ColumnsMut, ColumnsRef, RowBlock, Rows, RowsMut, RowsNow, scales_of};
use crate::scene::state::SceneState;

/// Rows per task of parallel work.
pub const ROWS_PER_TASK: usize = 1024;

impl DeferredAdam {
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
}

impl AdamNow<'_> {
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
            rows.iter().all(|&row| view.stamp[row as usize - view.first_row] <= self.now()),
            "a step taken twice"
        );
        debug_assert!(self.are_values_of(&view.as_ref(), rows, &values), "values of another step");
        match view.columns.sh_degree {
            0 => over_rows(self.simd(), StepRows::<0> { at: self, view, rows, values, grads }),
            1 => over_rows(self.simd(), StepRows::<9> { at: self, view, rows, values, grads }),
            2 => over_rows(self.simd(), StepRows::<24> { at: self, view, rows, values, grads }),
            _ => over_rows(self.simd(), StepRows::<45> { at: self, view, rows, values, grads }),
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
            0 => over_rows(self.simd(), EvaluateRows::<0, _> { at: self, view, row_of, out }),
            1 => over_rows(self.simd(), EvaluateRows::<9, _> { at: self, view, row_of, out }),
            2 => over_rows(self.simd(), EvaluateRows::<24, _> { at: self, view, row_of, out }),
            _ => over_rows(self.simd(), EvaluateRows::<45, _> { at: self, view, row_of, out }),
        }
    }
}

impl RowsNow for AdamNow<'_> {
    #[inline(always)]
    fn now(&self) -> u32 {
        self.steps()
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
        self.evaluate_value(column, value, m, v, stamp)
    }

    fn log_scales(&self) -> LogScaleRange {
        self.adam().log_scales()
    }

    fn sizes_and_opacities(&self, rows: &Rows<'_>, log_scales: &mut [f32], opacities: &mut [f32]) {
        dispatch(self.simd(), SizeRows { at: self, rows, log_scales, opacities });
    }

    fn settle_row(&self, rows: &mut RowsMut<'_>, row: usize) {
        let stamp = rows.stamp[row];
        if stamp >= self.now() {
            return;
        }
        let mut value = [0.0; BLOCK_LANES];
        self.evaluate_row(&rows.as_ref(), row, &mut value);
        self.log_scales().clamp_all(scales_of(&mut value));
        rows.columns.store_row_any(row, &value);
        let decay = self.settled_decay(stamp);
        let (mut m, mut v) = ([0.0; BLOCK_LANES], [0.0; BLOCK_LANES]);
        rows.exp_avg.as_ref().load_row_any(row, &mut m);
        rows.exp_avg_sq.as_ref().load_row_any(row, &mut v);
        m.iter_mut().for_each(|x| *x = decay.first_moment(*x));
        v.iter_mut().for_each(|x| *x = decay.second_moment(*x, 0.0));
        if self.adam().moments() == Moments::Bf16 {
            round_block::<45>(&mut m, &mut v, rows.uid[row], self.now());
        }
        rows.exp_avg.store_row_any(row, &m);
        rows.exp_avg_sq.store_row_any(row, &v);
        rows.stamp[row] = self.now();
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
