//! From stored rows to the rows of one view: which of them it may draw, and what they are at this step.
//!
//! Invariants: 1. the state is only read here; 2. the cull is conservative: no row that the
//! projection would draw is left out, whatever its rotation and opacity; 3. listed rows ascend; 4. results are the same
//! for any number of threads; 5. once `out` has grown to its size, nothing that grows with the scene is allocated.

use crate::base::math::exp32;
use crate::base::simd::{Kernel, dispatch};
use crate::kernels::constants::{EPS2D, EXTENT_SIGMAS};
use crate::optim::deferred::{AdamNow, DeferredAdam, ROWS_PER_TASK};
use crate::optim::lanes::{LANES, LaneDrifts, drifted_lanes, tables_of};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::rows::{ColumnsMut, Rows, RowsNow};
use crate::scene::state::SceneState;

/// The view angle at which the projection's Jacobian is clamped lies this share of the half field of view outside it.
const CLAMP_MARGIN: f32 = 0.3;

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
