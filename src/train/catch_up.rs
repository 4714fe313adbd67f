//! From stored rows to the rows of one view: which of them it may draw, and what they are at this step.
//!
//! Invariants: 1. the state is only read here, except by [`apply_event`]; 2. the cull is conservative: no row that the
//! projection would draw is left out, whatever its rotation and opacity; 3. listed rows ascend; 4. results are the same
//! for any number of threads; 5. once `out` has grown to its size, nothing that grows with the scene is allocated.

use crate::base::math::exp32;
use crate::base::simd::{Kernel, dispatch};
use crate::densify::ops;
use crate::optim::deferred::{AdamNow, DeferredAdam, ROWS_PER_TASK};
use crate::optim::drift::{EpsFloor, drifted, needs_direct_sum};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::events::{Event, EventKind};
use crate::scene::frustum::Frustum;
use crate::scene::rows::{ColumnsMut, Rows, RowsNow};
use crate::scene::state::SceneState;

/// Rows of one vector of the cull.
const LANES: usize = 16;

/// What an event changed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EventOutcome {
    /// What a densification round did.
    pub round: ops::RoundCounts,
    /// Rows that an opacity reset rewrote.
    pub reset_rows: usize,
}

/// The rows that `camera` may draw after `now` optimizer steps, ascending.
pub fn visible_rows(state: &SceneState, adam: &DeferredAdam, now: u32, camera: &Camera, out: &mut Vec<u32>) {
    let at = adam.at(now);
    let frustum = Frustum::new(camera);
    out.resize(state.rows(), 0);
    let found = cull(&at, &frustum, state.view(), out);
    out.truncate(found);
}

/// The listed rows as they are after `now` optimizer steps: row i of `out` is row `rows[i]` of the state.
pub fn gather(state: &SceneState, adam: &DeferredAdam, now: u32, rows: &[u32], out: &mut Columns) {
    if out.sh_degree != state.sh_degree() {
        *out = Columns::zeros(0, state.sh_degree());
    }
    out.resize(rows.len());
    let row_of = |i: usize| rows[i] as usize;
    evaluate_into(&adam.at(now), state.view(), &row_of, 0, out.view_mut());
}

/// All rows as they are after `now` optimizer steps.
pub fn evaluate_all(state: &SceneState, adam: &DeferredAdam, now: u32) -> Columns {
    let mut out = Columns::zeros(state.rows(), state.sh_degree());
    evaluate_into(&adam.at(now), state.view(), &|i| i, 0, out.view_mut());
    out
}

/// Applies event number `index` of the log to all rows of a table: the whole scene or one page of it.
pub fn apply_event(
    state: &mut SceneState,
    adam: &DeferredAdam,
    seed: u64,
    index: usize,
    event: &Event,
) -> EventOutcome {
    let at = adam.at(event.now());
    match event.kind {
        EventKind::RaiseShDegree { .. } => EventOutcome::default(),
        EventKind::ResetOpacity { max_opacity } => {
            EventOutcome { reset_rows: ops::reset_opacities(&at, state, max_opacity), ..EventOutcome::default() }
        }
        EventKind::Densify(thresholds) => {
            let round = ops::apply_round(&at, state, &thresholds, seed, index as u64);
            EventOutcome { round, ..EventOutcome::default() }
        }
    }
}

fn evaluate_into<F>(at: &AdamNow<'_>, view: Rows<'_>, row_of: &F, first: usize, out: ColumnsMut<'_>)
where
    F: Fn(usize) -> usize + Sync,
{
    if out.rows() <= ROWS_PER_TASK {
        return at.evaluate_rows(view, |i| row_of(first + i), out);
    }
    let half = out.rows().div_ceil(ROWS_PER_TASK) / 2 * ROWS_PER_TASK;
    let (head, tail) = out.split_at(half);
    rayon::join(
        || evaluate_into(at, view, row_of, first, head),
        || evaluate_into(at, view, row_of, first + half, tail),
    );
}

/// Lists the rows of the view that may be drawn in the front of `out`, which is as long as the view; returns how many.
fn cull(at: &AdamNow<'_>, frustum: &Frustum, view: Rows<'_>, out: &mut [u32]) -> usize {
    if view.rows() <= ROWS_PER_TASK {
        return dispatch(at.simd(), CullRows { at, frustum, view, out });
    }
    let half = view.rows().div_ceil(ROWS_PER_TASK) / 2 * ROWS_PER_TASK;
    let (head, tail) = view.split_at(half);
    let (head_out, tail_out) = out.split_at_mut(half);
    let (a, b) = rayon::join(|| cull(at, frustum, head, head_out), || cull(at, frustum, tail, tail_out));
    out.copy_within(half..half + b, a);
    a + b
}

struct CullRows<'k, 'a> {
    at: &'k AdamNow<'a>,
    frustum: &'k Frustum,
    view: Rows<'k>,
    out: &'k mut [u32],
}

impl Kernel for CullRows<'_, '_> {
    type Out = usize;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> usize {
        let CullRows { at, frustum, view, out } = self;
        let mut found = 0;
        let whole = view.rows() / LANES * LANES;
        for first in (0..whole).step_by(LANES) {
            let drawn = cull_lanes(at, frustum, &view, first);
            for (lane, &drawn) in drawn.iter().enumerate() {
                // Written always, kept when counted: no branch to mispredict.
                out[found] = (view.first_row + first + lane) as u32;
                found += usize::from(drawn);
            }
        }
        for row in whole..view.rows() {
            out[found] = (view.first_row + row) as u32;
            found += usize::from(cull_row(at, frustum, &view, row));
        }
        found
    }
}

/// [`LANES`] rows from `first` on: one vector per coordinate.
#[inline(always)]
fn cull_lanes(at: &AdamNow<'_>, frustum: &Frustum, view: &Rows<'_>, first: usize) -> [bool; LANES] {
    let mut drift = [[0.0; LANES]; 8];
    for (l, &stamp) in view.stamp[first..first + LANES].iter().enumerate() {
        let of_row = at.drift(stamp);
        for p in 0..8 {
            drift[p][l] = of_row[p];
        }
    }
    let [m1, m2, m3, _, c1, c2, c3, _] = &drift;
    let (values, exp_avg, exp_avg_sq) = (&view.columns, &view.exp_avg, &view.exp_avg_sq);
    let (means, a) =
        drifted_lanes(at, Column::Means, [values.means, exp_avg.means, exp_avg_sq.means], first, [m1, m2, m3]);
    let (scales, b) =
        drifted_lanes(at, Column::Scales, [values.scales, exp_avg.scales, exp_avg_sq.scales], first, [c1, c2, c3]);
    if a | b {
        return cull_row_by_row(at, frustum, view, first);
    }
    let mut drawn = [false; LANES];
    for l in 0..LANES {
        let sigma_max = exp32(scales[0][l].max(scales[1][l]).max(scales[2][l]));
        drawn[l] = frustum.may_draw([means[0][l], means[1][l], means[2][l]], sigma_max);
    }
    drawn
}

/// The three coordinates of a column now, by the series; and whether some of them need the direct sum instead.
/// `tables`: values, first and second moments.
#[inline(always)]
fn drifted_lanes(
    at: &AdamNow<'_>,
    column: Column,
    tables: [&[f32]; 3],
    first: usize,
    sums: [&[f32; LANES]; 3],
) -> ([[f32; LANES]; 3], bool) {
    let EpsFloor { eps, floor } = at.eps_floor();
    let rate = at.base_rate(column);
    let (from, to) = (first * 3, (first + LANES) * 3);
    // Not `map` over the tables: its closure is not always inlined, and then runs without the vector instructions.
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
fn by_coordinate(rows: &[f32]) -> [[f32; LANES]; 3] {
    let rows = &rows[..LANES * 3];
    let mut out = [[0.0; LANES]; 3];
    for l in 0..LANES {
        out[0][l] = rows[l * 3];
        out[1][l] = rows[l * 3 + 1];
        out[2][l] = rows[l * 3 + 2];
    }
    out
}

#[cold]
#[inline(never)]
fn cull_row_by_row(at: &AdamNow<'_>, frustum: &Frustum, view: &Rows<'_>, first: usize) -> [bool; LANES] {
    std::array::from_fn(|l| cull_row(at, frustum, view, first + l))
}

/// One row, by the exact evaluation.
fn cull_row(at: &AdamNow<'_>, frustum: &Frustum, view: &Rows<'_>, row: usize) -> bool {
    let of = |column: Column| std::array::from_fn::<f32, 3, _>(|c| at.evaluate_element(view, column, row, c));
    let s = of(Column::Scales);
    frustum.may_draw(of(Column::Means), exp32(s[0].max(s[1]).max(s[2])))
}
