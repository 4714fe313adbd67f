//! Sixteen rows at a time: moves the elements of a column by the series, one vector per element.
//!
//! Not here: rows with second moments so small that eps matters; they are marked, and the caller evaluates them one by
//! one.
//!
//! Invariant: the bits are those of `RowsNow` on every instruction path.

use super::deferred::{AdamNow, DeferredAdam};
use super::drift::{Drift, drifted, has_infinite_ratio, needs_direct_sum};
use crate::base::simd::Kernel;
pub(crate) use crate::base::simd::LANES;
use crate::scene::columns::Column;
use crate::scene::rows::{Rows, RowsNow};

/// Series sums of [`LANES`] rows, one vector per sum: T1, T2, T3 of the means, then of the other columns.
pub(crate) struct LaneDrifts {
    sums: [[f32; LANES]; 8],
}

impl LaneDrifts {
    /// Gathers the sums of the rows with these stamps.
    #[inline(always)]
    pub(crate) fn gather<'d>(stamps: &[u32], drift_of: impl Fn(u32) -> &'d Drift) -> LaneDrifts {
        let mut sums = [[0.0; LANES]; 8];
        for (l, &stamp) in stamps[..LANES].iter().enumerate() {
            let of_row = drift_of(stamp);
            for p in 0..8 {
                sums[p][l] = of_row[p];
            }
        }
        LaneDrifts { sums }
    }

    #[inline(always)]
    fn of(&self, column: Column) -> [&[f32; LANES]; 3] {
        let s = &self.sums;
        if matches!(column, Column::Means) { [&s[0], &s[1], &s[2]] } else { [&s[4], &s[5], &s[6]] }
    }
}

/// Values, first and second moments of a column.
#[inline(always)]
pub(crate) fn tables_of<'a>(rows: &Rows<'a>, column: Column) -> [&'a [f32]; 3] {
    [rows.columns.column(column), rows.exp_avg.column(column), rows.exp_avg_sq.column(column)]
}

/// The `W` elements of rows `first..` in a column after their drift, and the rows that need the direct sum instead, whose
/// elements in need stay as stored. As a limit (`IS_LIMIT`, [`DeferredAdam::limit`]) only rows with an infinite ratio need it.
#[inline(always)]
pub(crate) fn drifted_lanes<const W: usize, const IS_LIMIT: bool>(
    adam: &DeferredAdam,
    column: Column,
    tables: [&[f32]; 3],
    first: usize,
    drifts: &LaneDrifts,
) -> ([[f32; LANES]; W], [bool; LANES]) {
    let rate = adam.base_rate(column);
    let sums = drifts.of(column);
    let (from, to) = (first * W, (first + LANES) * W);
    // Not `map` over the tables: its closure is not always inlined, and would then be compiled without vector
    // instructions.
    let value = by_element::<W>(&tables[0][from..to]);
    let m = by_element::<W>(&tables[1][from..to]);
    let v = by_element::<W>(&tables[2][from..to]);
    let mut out = [[0.0; LANES]; W];
    let mut direct = [false; LANES];
    for c in 0..W {
        for l in 0..LANES {
            let (value, m, v) = (value[c][l], m[c][l], v[c][l]);
            let eps = if IS_LIMIT { adam.eps.of_limit(v) } else { adam.eps.eps };
            let is_direct = if IS_LIMIT { has_infinite_ratio(m, v) } else { needs_direct_sum(m, v, adam.eps.floor) };
            let moved = drifted(value, m, v, [sums[0][l], sums[1][l], sums[2][l]], rate, eps);
            out[c][l] = if is_direct { value } else { moved };
            direct[l] |= is_direct;
        }
    }
    (out, direct)
}

/// The rows, counted from `first` on, whose lanes `a` or `b` mark; ascending.
#[inline(always)]
pub(crate) fn marked_rows(first: usize, a: [bool; LANES], b: [bool; LANES]) -> impl Iterator<Item = usize> {
    let mut marks = 0u32;
    for l in 0..LANES {
        marks |= u32::from(a[l] | b[l]) << l;
    }
    std::iter::from_fn(move || {
        let lane = (marks != 0).then_some(marks.trailing_zeros() as usize)?;
        marks &= marks - 1;
        Some(first + lane)
    })
}

/// `[LANES][W]` to `[W][LANES]`.
#[inline(always)]
pub(crate) fn by_element<const W: usize>(rows: &[f32]) -> [[f32; LANES]; W] {
    let rows = &rows[..LANES * W];
    let mut out = [[0.0; LANES]; W];
    for l in 0..LANES {
        for c in 0..W {
            out[c][l] = rows[l * W + c];
        }
    }
    out
}

/// Computes the current largest log-scale and opacity of every row.
pub(crate) struct SizeRows<'k, 'a> {
    pub at: &'k AdamNow<'a>,
    pub rows: &'k Rows<'k>,
    pub log_scales: &'k mut [f32],
    pub opacities: &'k mut [f32],
}

impl Kernel for SizeRows<'_, '_> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let SizeRows { at, rows, log_scales, opacities } = self;
        let adam = at.adam;
        let (scale_tables, opacity_tables) = (tables_of(rows, Column::Scales), tables_of(rows, Column::Opacities));
        let whole = rows.rows() / LANES * LANES;
        for first in (0..whole).step_by(LANES) {
            let drifts = LaneDrifts::gather(&rows.stamp[first..], |stamp| at.drift(stamp));
            let (scales, a) = drifted_lanes::<3, false>(adam, Column::Scales, scale_tables, first, &drifts);
            let (opacity, b) = drifted_lanes::<1, false>(adam, Column::Opacities, opacity_tables, first, &drifts);
            for l in 0..LANES {
                log_scales[first + l] = scales[0][l].max(scales[1][l]).max(scales[2][l]);
            }
            opacities[first..first + LANES].copy_from_slice(&opacity[0]);
            marked_rows(first, a, b).for_each(|row| size_row(at, rows, row, log_scales, opacities));
        }
        (whole..rows.rows()).for_each(|row| size_row(at, rows, row, log_scales, opacities));
    }
}

/// One row, by the exact evaluation.
fn size_row(at: &AdamNow<'_>, rows: &Rows<'_>, row: usize, log_scales: &mut [f32], opacities: &mut [f32]) {
    let scale = |i| at.evaluate_element(rows, Column::Scales, row, i);
    log_scales[row] = scale(0).max(scale(1)).max(scale(2));
    opacities[row] = at.evaluate_element(rows, Column::Opacities, row, 0);
}
