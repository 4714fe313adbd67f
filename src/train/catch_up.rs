//! From stored rows to the rows of one view: which of them it may draw, and what they are at this step.
//!
//! Invariants: 1. the state is only read here; 2. the cull is conservative: no row that the
//! projection would draw is left out, whatever its rotation and opacity; 3. listed rows ascend; 4. results are the same
//! for any number of threads; 5. once `out` has grown to its size, nothing that grows with the scene is allocated.

use crate::base::math::exp32;
use crate::base::simd::{Kernel, dispatch};
use crate::optim::deferred::{AdamNow, DeferredAdam, ROWS_PER_TASK};
use crate::optim::lanes::{LANES, LaneDrifts, drifted_lanes, tables_of};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::frustum::Frustum;
use crate::scene::rows::{ColumnsMut, Rows, RowsNow};
use crate::scene::state::SceneState;

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
    let drifts = LaneDrifts::gather(&view.stamp[first..], |stamp| at.drift(stamp));
    let (means, a) = drifted_lanes(at.adam(), Column::Means, tables_of(view, Column::Means), first, &drifts);
    let (scales, b) = drifted_lanes(at.adam(), Column::Scales, tables_of(view, Column::Scales), first, &drifts);
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
