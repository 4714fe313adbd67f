//! Culls stored rows for one view and evaluates them at a step.
//!
//! Input rows are a list of tables with consecutive row numbers: the pinned pages of a step, or one table in memory.
//!
//! Invariants: 1. this file only reads rows; 2. the cull is conservative: it keeps every row that the projection would
//! draw, for any rotation and opacity; 3. listed rows ascend; 4. results are the same for any number of threads and any
//! division of the rows into tables; 5. once `out` has its full size, no allocation grows with the scene.

use crate::base::math::exp32;
use crate::base::room;
use crate::base::simd::{Kernel, dispatch};
use crate::optim::deferred::{AdamNow, DeferredAdam};
use crate::optim::lanes::{LANES, LaneDrifts, drifted_lanes, marked_rows, tables_of};
use crate::optim::row_kernels::{ROWS_PER_TASK, evaluate_rows};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::frustum::Frustum;
use crate::scene::rows::{ColumnsMut, Rows, RowsNow};

/// Lists the rows of `tables` that `camera` may draw after `now` optimizer steps, ascending. The row numbers of each
/// table start where those of the previous table end.
pub fn visible_rows(tables: &[Rows<'_>], adam: &DeferredAdam, now: u32, camera: &Camera, out: &mut Vec<u32>) {
    let at = adam.at(now);
    let frustum = Frustum::new(camera);
    room::resize(out, rows_of(tables), 0);
    let found = cull(&at, &frustum, tables, out);
    out.truncate(found);
}

/// Evaluates the listed rows after `now` optimizer steps: row i of `out` is row `rows[i]` of the tables. All tables are
/// stored with `sh_degree`.
pub fn gather(tables: &[Rows<'_>], sh_degree: u8, adam: &DeferredAdam, now: u32, rows: &[u32], out: &mut Columns) {
    if out.sh_degree != sh_degree {
        *out = Columns::zeros(0, sh_degree);
    }
    out.resize(rows.len());
    evaluate_into(&adam.at(now), tables, rows, out.view_mut());
}

/// Evaluates all rows of the tables after `now` optimizer steps, in order.
pub fn evaluate_all(tables: &[Rows<'_>], sh_degree: u8, adam: &DeferredAdam, now: u32) -> Columns {
    let first = tables.first().map_or(0, |t| t.first_row) as u32;
    let rows: Vec<u32> = (first..first + rows_of(tables) as u32).collect();
    let mut out = Columns::zeros(0, sh_degree);
    gather(tables, sh_degree, adam, now, &rows, &mut out);
    out
}

fn rows_of(tables: &[Rows<'_>]) -> usize {
    tables.iter().map(Rows::rows).sum()
}

/// Evaluates the listed rows in parallel tasks, split between tables and within them.
fn evaluate_into(at: &AdamNow<'_>, tables: &[Rows<'_>], rows: &[u32], out: ColumnsMut<'_>) {
    if rows.is_empty() {
        return;
    }
    if let [table] = tables
        && rows.len() <= ROWS_PER_TASK
    {
        return evaluate_rows(at, *table, |i| rows[i] as usize - table.first_row, out);
    }
    let (listed, head_tables, tail_tables) = match tables {
        [_] => (rows.len().div_ceil(ROWS_PER_TASK) / 2 * ROWS_PER_TASK, tables, tables),
        _ => {
            let (head, tail) = tables.split_at(tables.len() / 2);
            let bound = tail[0].first_row;
            (rows.partition_point(|&row| (row as usize) < bound), head, tail)
        }
    };
    let (head, tail) = out.split_at(listed);
    let both = (
        || evaluate_into(at, head_tables, &rows[..listed], head),
        || evaluate_into(at, tail_tables, &rows[listed..], tail),
    );
    join_if(rows.len() > ROWS_PER_TASK, both.0, both.1);
}

/// Runs `a` and `b`, on two threads if `parallel`.
fn join_if<A: Send, B: Send>(parallel: bool, a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    if parallel { rayon::join(a, b) } else { (a(), b()) }
}

/// Writes the visible rows to the front of `out` and returns their number. `out` has as many entries as the tables have
/// rows.
fn cull(at: &AdamNow<'_>, frustum: &Frustum, tables: &[Rows<'_>], out: &mut [u32]) -> usize {
    let rows = out.len();
    match tables {
        [] => return 0,
        [view] if rows <= ROWS_PER_TASK => return dispatch(at.adam.simd, CullRows { at, frustum, view: *view, out }),
        _ => {}
    }
    let halves;
    let (head, tail) = match tables {
        [view] => {
            // Split at a multiple of the task size.
            let (a, b) = view.split_at(rows.div_ceil(ROWS_PER_TASK) / 2 * ROWS_PER_TASK);
            halves = [a, b];
            halves.split_at(1)
        }
        _ => tables.split_at(tables.len() / 2),
    };
    let half = rows_of(head);
    let (head_out, tail_out) = out.split_at_mut(half);
    let (a, b) =
        join_if(rows > ROWS_PER_TASK, || cull(at, frustum, head, head_out), || cull(at, frustum, tail, tail_out));
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
                // Write always, advance only if drawn: this avoids a mispredicted branch.
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

/// Culls [`LANES`] rows from `first` on, one vector per coordinate.
#[inline(always)]
fn cull_lanes(at: &AdamNow<'_>, frustum: &Frustum, view: &Rows<'_>, first: usize) -> [bool; LANES] {
    let drifts = LaneDrifts::gather(&view.stamp[first..], |stamp| at.drift(stamp));
    let (means, a) = drifted_lanes::<3, false>(at.adam, Column::Means, tables_of(view, Column::Means), first, &drifts);
    let (scales, b) =
        drifted_lanes::<3, false>(at.adam, Column::Scales, tables_of(view, Column::Scales), first, &drifts);
    let mut drawn = [false; LANES];
    for l in 0..LANES {
        let sigma_max = exp32(scales[0][l].max(scales[1][l]).max(scales[2][l]));
        drawn[l] = frustum.may_draw([means[0][l], means[1][l], means[2][l]], sigma_max);
    }
    marked_rows(first, a, b).for_each(|row| drawn[row - first] = cull_row(at, frustum, view, row));
    drawn
}

/// Culls one row by exact evaluation.
#[cold]
#[inline(never)]
fn cull_row(at: &AdamNow<'_>, frustum: &Frustum, view: &Rows<'_>, row: usize) -> bool {
    let of = |column: Column| std::array::from_fn::<f32, 3, _>(|c| at.evaluate_element(view, column, row, c));
    let s = of(Column::Scales);
    frustum.may_draw(of(Column::Means), exp32(s[0].max(s[1]).max(s[2])))
}
