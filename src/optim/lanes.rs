//! Sixteen rows at a time: moves the three coordinates of a column by the series, one vector per coordinate.
//!
//! Not here: rows with second moments so small that eps matters; they are reported, and the caller evaluates them one
//! by one.
//!
//! Invariant: the bits are those of `RowsNow` on every instruction path.

use super::adam_now::{AdamNow, DeferredAdam};
use super::drift::{Drift, EpsFloor, drifted, needs_direct_sum};
use crate::base::simd::Kernel;
use crate::scene::columns::Column;
use crate::scene::rows::{Rows, RowsNow};

/// Rows per vector.
pub(crate) const LANES: usize = 16;

/// Series sums of [`LANES`] rows, one vector per sum: T1, T2, T3 of the means, then of the other columns.
pub(crate) struct LaneDrifts {
    sums: [[f32; LANES]; 8],
}

/// Values of three coordinates of [`LANES`] rows.
pub(crate) type Coordinates = [[f32; LANES]; 3];

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

    /// The sums for a column.
    #[inline(always)]
    fn of(&self, column: Column) -> [&[f32; LANES]; 3] {
        let s = &self.sums;
        if matches!(column, Column::Means) { [&s[0], &s[1], &s[2]] } else { [&s[4], &s[5], &s[6]] }
    }
}

/// Values, first and second moments of a column of three coordinates.
#[inline(always)]
pub(crate) fn tables_of<'a>(rows: &Rows<'a>, column: Column) -> [&'a [f32]; 3] {
    let (values, m, v) = (&rows.columns, &rows.exp_avg, &rows.exp_avg_sq);
    match column {
        Column::Means => [values.means, m.means, v.means],
        _ => [values.scales, m.scales, v.scales],
    }
}

/// The coordinates of rows `first..` after their drift, and whether one of them needs the direct sum instead.
#[inline(always)]
pub(crate) fn drifted_lanes(
    adam: &DeferredAdam,
    column: Column,
    tables: [&[f32]; 3],
    first: usize,
    drifts: &LaneDrifts,
) -> (Coordinates, bool) {
    let EpsFloor { eps, floor } = adam.eps_floor();
    let rate = adam.base_rate(column);
    let sums = drifts.of(column);
    let (from, to) = (first * 3, (first + LANES) * 3);
    // Not `map` over the tables: its closure is not always inlined, and would then be compiled without vector
    // instructions.
    let value = by_coordinate(&tables[0][from..to]);
    let m = by_coordinate(&tables[1][from..to]);
    let v = by_coordinate(&tables[2][from..to]);
    let mut out = [[0.0; LANES]; 3];
    let mut direct = false;
    for c in 0..3 {
        let mut lanes = [false; LANES];
        for l in 0..LANES {
            out[c][l] = drifted(value[c][l], m[c][l], v[c][l], [sums[0][l], sums[1][l], sums[2][l]], rate, eps);
            lanes[l] = needs_direct_sum(m[c][l], v[c][l], floor);
        }
        for lane in lanes {
            direct |= lane;
        }
    }
    (out, direct)
}

/// `[LANES][3]` to `[3][LANES]`.
#[inline(always)]
pub(crate) fn by_coordinate(rows: &[f32]) -> Coordinates {
    let rows = &rows[..LANES * 3];
    let mut out = [[0.0; LANES]; 3];
    for l in 0..LANES {
        out[0][l] = rows[l * 3];
        out[1][l] = rows[l * 3 + 1];
        out[2][l] = rows[l * 3 + 2];
    }
    out
}

/// The opacities (logit) of rows `first..` after their drift, and whether one of them needs the direct sum instead.
#[inline(always)]
pub(crate) fn drifted_opacities(
    adam: &DeferredAdam,
    rows: &Rows<'_>,
    first: usize,
    drifts: &LaneDrifts,
) -> ([f32; LANES], bool) {
    let EpsFloor { eps, floor } = adam.eps_floor();
    let rate = adam.base_rate(Column::Opacities);
    let sums = drifts.of(Column::Opacities);
    let value = &rows.columns.opacities[first..first + LANES];
    let m = &rows.exp_avg.opacities[first..first + LANES];
    let v = &rows.exp_avg_sq.opacities[first..first + LANES];
    let mut out = [0.0; LANES];
    let mut direct = false;
    for l in 0..LANES {
        out[l] = drifted(value[l], m[l], v[l], [sums[0][l], sums[1][l], sums[2][l]], rate, eps);
        direct |= needs_direct_sum(m[l], v[l], floor);
    }
    (out, direct)
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
        let adam = at.adam();
        let scale_tables = tables_of(rows, Column::Scales);
        let whole = rows.rows() / LANES * LANES;
        for first in (0..whole).step_by(LANES) {
            let drifts = LaneDrifts::gather(&rows.stamp[first..], |stamp| at.drift(stamp));
            let (scales, a) = drifted_lanes(adam, Column::Scales, scale_tables, first, &drifts);
            let (opacity, b) = drifted_opacities(adam, rows, first, &drifts);
            if a | b {
                (first..first + LANES).for_each(|row| size_row(at, rows, row, log_scales, opacities));
                continue;
            }
            for l in 0..LANES {
                log_scales[first + l] = scales[0][l].max(scales[1][l]).max(scales[2][l]);
            }
            opacities[first..first + LANES].copy_from_slice(&opacity);
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
