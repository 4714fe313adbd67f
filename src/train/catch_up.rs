//! From stored rows to the rows of one view: which of them it may draw, and what they are at this step.
//!
//! Rows come as a list of tables numbered through: the pinned pages of a step, or one table in memory.
//!
//! Invariants: 1. rows are only read here; 2. the cull is conservative: no row that the projection would draw is left
//! out, whatever its rotation and opacity; 3. listed rows ascend; 4. results are the same for any number of threads and
//! for any cut of the rows into tables; 5. once `out` has grown to its size, nothing that grows with the scene is
//! allocated.

use crate::base::math::exp32;
use crate::base::simd::{Kernel, dispatch};
use crate::kernels::constants::{EPS2D, EXTENT_SIGMAS};
use crate::optim::deferred::{AdamNow, DeferredAdam, ROWS_PER_TASK};
use crate::optim::lanes::{LANES, LaneDrifts, drifted_lanes, tables_of};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::rows::{ColumnsMut, Rows, RowsNow};

/// The view angle at which the projection's Jacobian is clamped lies this share of the half field of view outside it.
const CLAMP_MARGIN: f32 = 0.3;

/// The rows of `tables` that `camera` may draw after `now` optimizer steps, ascending. Tables are numbered through:
/// each starts where the one before it ends.
pub fn visible_rows(tables: &[Rows<'_>], adam: &DeferredAdam, now: u32, camera: &Camera, out: &mut Vec<u32>) {
    let at = adam.at(now);
    let frustum = Frustum::new(camera);
    out.resize(rows_of(tables), 0);
    let found = cull(&at, &frustum, tables, out);
    out.truncate(found);
}

/// The listed rows as they are after `now` optimizer steps: row i of `out` is row `rows[i]` of the tables, which are
/// numbered through and all stored with `sh_degree`.
pub fn gather(tables: &[Rows<'_>], sh_degree: u8, adam: &DeferredAdam, now: u32, rows: &[u32], out: &mut Columns) {
    if out.sh_degree != sh_degree {
        *out = Columns::zeros(0, sh_degree);
    }
    out.resize(rows.len());
    evaluate_into(&adam.at(now), tables, rows, out.view_mut());
}

/// All rows of the tables as they are after `now` optimizer steps, in their order.
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

/// Evaluates the listed rows, cut into tasks by tables and within them.
fn evaluate_into(at: &AdamNow<'_>, tables: &[Rows<'_>], rows: &[u32], out: ColumnsMut<'_>) {
    if rows.is_empty() {
        return;
    }
    if let [table] = tables
        && rows.len() <= ROWS_PER_TASK
    {
        return at.evaluate_rows(*table, |i| rows[i] as usize - table.first_row, out);
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

/// Runs both, on two threads where that is worth it.
fn join_if<A: Send, B: Send>(worth: bool, a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    if worth { rayon::join(a, b) } else { (a(), b()) }
}

/// Half-spaces of a camera in its own axes, each shifted outwards by a multiple of the row's largest sigma.
///
/// A row is drawn when z lies between the planes and its box meets the image. The box's half width is at most
/// ceil(3.33 sqrt(c_xx)), with c_xx <= (sigma_max fx / z)^2 (1 + lim^2) + 0.3, lim being the angle at which the Jacobian is
/// clamped; the square root of a sum is at most the sum of the roots. Multiplied by z / fx, the box meets the image
/// only if  x <= ((W - cx) + 3.33 sqrt 0.3 + 1) / fx z + 3.33 sigma_max sqrt(1 + lim^2),  and likewise on the other sides.
#[derive(Debug, Clone, Copy)]
struct Frustum {
    viewmat: [[f32; 4]; 3],
    /// Largest |t|: rounding errors of camera coordinates scale with it and with the position.
    translation: f32,
    near: f32,
    far: f32,
    /// Slopes of the planes at x low, x high, y low, y high; outwards positive.
    slopes: [f32; 4],
    /// Sigmas that a footprint reaches beyond its mean, in x and y.
    reach: [f32; 2],
}

/// Rounding slack of a camera coordinate, per unit of position: sixteen times what a dot product of four terms loses.
const POSITION_SLACK: f32 = 4e-6;
/// Relative slack on slopes and footprints, for the roundings of the projection itself.
const RELATIVE_SLACK: f32 = 1e-4;

impl Frustum {
    fn new(camera: &Camera) -> Self {
        let blur = EXTENT_SIGMAS * EPS2D.sqrt() + 1.0;
        let axis = |size: u32, f: f32, c: f32| {
            let size = size as f32;
            let (low, high, margin) = (c / f, (size - c) / f, CLAMP_MARGIN * 0.5 * size / f);
            let limit = (low + margin).abs().max((high + margin).abs());
            let slope = |edge: f32| edge + blur / f + RELATIVE_SLACK * (edge.abs() + blur / f);
            let reach = EXTENT_SIGMAS * (1.0 + limit * limit).sqrt() * (1.0 + RELATIVE_SLACK);
            (slope(low), slope(high), reach)
        };
        let (x_low, x_high, reach_x) = axis(camera.width, camera.fx, camera.cx);
        let (y_low, y_high, reach_y) = axis(camera.height, camera.fy, camera.cy);
        let m = &camera.viewmat;
        Frustum {
            viewmat: camera.viewmat,
            translation: m[0][3].abs() + m[1][3].abs() + m[2][3].abs(),
            near: camera.near_plane,
            far: camera.far_plane,
            slopes: [x_low, x_high, y_low, y_high],
            reach: [reach_x, reach_y],
        }
    }

    /// Whether a row may be drawn. Comparisons are such that a NaN counts as drawn.
    #[inline(always)]
    fn may_draw(&self, p: [f32; 3], sigma_max: f32) -> bool {
        let m = &self.viewmat;
        let x = m[0][0] * p[0] + m[0][1] * p[1] + m[0][2] * p[2] + m[0][3];
        let y = m[1][0] * p[0] + m[1][1] * p[1] + m[1][2] * p[2] + m[1][3];
        let z = m[2][0] * p[0] + m[2][1] * p[1] + m[2][2] * p[2] + m[2][3];
        let slack = POSITION_SLACK * (p[0].abs() + p[1].abs() + p[2].abs() + self.translation);
        let slopes = &self.slopes;
        let steepest = slopes[0].abs().max(slopes[1].abs()).max(slopes[2].abs()).max(slopes[3].abs());
        let side = slack * (1.0 + steepest);
        let (reach_x, reach_y) = (self.reach[0] * sigma_max + side, self.reach[1] * sigma_max + side);
        let outside = (z <= self.near - slack)
            | (z >= self.far + slack)
            | (-x > slopes[0] * z + reach_x)
            | (x > slopes[1] * z + reach_x)
            | (-y > slopes[2] * z + reach_y)
            | (y > slopes[3] * z + reach_y);
        !outside
    }
}

/// Lists the rows of the tables that may be drawn in the front of `out`, which has room for all; returns how many.
fn cull(at: &AdamNow<'_>, frustum: &Frustum, tables: &[Rows<'_>], out: &mut [u32]) -> usize {
    let rows = out.len();
    match tables {
        [] => return 0,
        [view] if rows <= ROWS_PER_TASK => return dispatch(at.simd(), CullRows { at, frustum, view: *view, out }),
        _ => {}
    }
    let halves;
    let (head, tail) = match tables {
        [view] => {
            // Halved at whole tasks.
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
