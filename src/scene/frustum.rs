//! The view frustum as half-spaces: tests whether a camera may draw a row or a page.
//!
//! Not here: evaluating rows, listing pages (`schedule::visibility`).
//!
//! Invariants: 1. both tests are conservative: a row that the projection would draw, with any rotation and opacity,
//! passes the row test; and a page fails the page test only if every row within its bounds fails the row test; 2. NaN
//! counts as drawn; 3. only + - * / sqrt, nothing contracted: the same answer on every instruction path.

use super::camera::Camera;
use super::page_meta::PageBounds;

/// Blur added to both diagonal elements of the projected covariance, px^2.
pub const EPS2D: f32 = 0.3;
/// Largest extent of a footprint, in standard deviations: beyond it alpha is below 1/255 even at opacity 1.
pub const EXTENT_SIGMAS: f32 = 3.33;

/// The projection's Jacobian is clamped at a view angle outside the field of view by this fraction of its half.
const CLAMP_MARGIN: f32 = 0.3;
/// Rounding slack of a camera coordinate, per unit of position: sixteen times the rounding error of a dot product of
/// four terms.
const POSITION_SLACK: f32 = 4e-6;
/// Relative slack on slopes and footprints, for the projection's own roundings.
const RELATIVE_SLACK: f32 = 1e-4;
/// Slack of the page test: that of the row test, and as much again for the roundings of both tests (each at most eight
/// roundings of 6e-8 per unit of position, together a quarter of this slack).
const PAGE_POSITION_SLACK: f32 = 2.0 * POSITION_SLACK;
/// Factor on footprints in the page test: sixteen roundings.
const PAGE_REACH: f32 = 1.0 + 1e-6;

/// Half-spaces of a camera in its own axes, each shifted outwards by a multiple of the row's largest sigma.
///
/// A row is drawn if z is between the planes and its box meets the image. The box's half width is at most ceil(3.33
/// sqrt(c_xx)), with c_xx <= (sigma_max fx / z)^2 (1 + lim^2) + 0.3, where lim is the angle at which the Jacobian is
/// clamped; the square root of a sum is at most the sum of the roots. Multiplied by z / fx, the box meets the image
/// only if  x <= ((W - cx) + 3.33 sqrt 0.3 + 1) / fx z + 3.33 sigma_max sqrt(1 + lim^2),  and likewise on the other
/// sides.
#[derive(Debug, Clone, Copy)]
pub struct Frustum {
    pub viewmat: [[f32; 4]; 3],
    /// Sum of |t|: rounding errors of camera coordinates scale with it and with the position.
    translation: f32,
    /// Near and far plane.
    pub depth_range: [f32; 2],
    /// Slopes of the planes at x low, x high, y low, y high, and how far they lie from the axis at depth 0; positive outwards.
    pub slopes: [f32; 4],
    pub offsets: [f32; 4],
    /// Reach of a footprint beyond its mean in x and y, in sigmas.
    pub reach: [f32; 2],
    /// Factor on the slack for the side planes, one plus the steepest slope: by it a camera coordinate's rounding error enters a
    /// side test.
    pub side_slack: f32,
}

impl Frustum {
    /// The half-spaces of a camera whose pose is a rotation and a translation.
    pub fn new(camera: &Camera) -> Self {
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
        let slopes = [x_low, x_high, y_low, y_high];
        Frustum {
            viewmat: camera.viewmat,
            translation: m[0][3].abs() + m[1][3].abs() + m[2][3].abs(),
            depth_range: [camera.near_plane, camera.far_plane],
            slopes,
            offsets: [0.0; 4],
            reach: [reach_x, reach_y],
            side_slack: 1.0 + slopes.iter().fold(0.0, |most: f32, slope| most.max(slope.abs())),
        }
    }

    /// Rounding slack of a camera coordinate: a constant part, and a factor on |x| + |y| + |z|.
    pub fn slack(&self) -> [f32; 2] {
        [POSITION_SLACK * self.translation, POSITION_SLACK]
    }

    /// Whether a row at `p` with this largest sigma may be drawn. NaN counts as drawn.
    #[inline(always)]
    pub fn may_draw(&self, p: [f32; 3], sigma_max: f32) -> bool {
        let m = &self.viewmat;
        let x = m[0][0] * p[0] + m[0][1] * p[1] + m[0][2] * p[2] + m[0][3];
        let y = m[1][0] * p[0] + m[1][1] * p[1] + m[1][2] * p[2] + m[1][3];
        let z = m[2][0] * p[0] + m[2][1] * p[1] + m[2][2] * p[2] + m[2][3];
        let slack = POSITION_SLACK * (p[0].abs() + p[1].abs() + p[2].abs() + self.translation);
        let Frustum { slopes, offsets, .. } = self;
        let side = slack * self.side_slack;
        let (reach_x, reach_y) = (self.reach[0] * sigma_max + side, self.reach[1] * sigma_max + side);
        let outside = (z <= self.depth_range[0] - slack)
            | (z >= self.depth_range[1] + slack)
            | (-x - offsets[0] > slopes[0] * z + reach_x)
            | (x - offsets[1] > slopes[1] * z + reach_x)
            | (-y - offsets[2] > slopes[2] * z + reach_y)
            | (y - offsets[3] > slopes[3] * z + reach_y);
        !outside
    }

    /// The same half-spaces in world coordinates, for boxes.
    pub fn planes(&self) -> PagePlanes {
        let m = &self.viewmat;
        // A row is outside if  sign * (row `axis` of the pose) - slope * z - offset  exceeds its reach.
        let side = |side: usize| {
            let (axis, sign) = (side / 2, [-1.0, 1.0][side % 2]);
            let at = |i: usize| sign * m[axis][i] - self.slopes[side] * m[2][i];
            PagePlane {
                normal: [at(0), at(1), at(2)],
                offset: at(3) - self.offsets[side],
                reach: self.reach[axis] * PAGE_REACH,
                slack: PAGE_POSITION_SLACK * self.side_slack,
            }
        };
        let depth = |sign: f32, edge: f32| PagePlane {
            normal: [sign * m[2][0], sign * m[2][1], sign * m[2][2]],
            offset: sign * (m[2][3] - edge),
            reach: 0.0,
            slack: PAGE_POSITION_SLACK,
        };
        let [near, far] = self.depth_range;
        PagePlanes {
            planes: [depth(-1.0, near), depth(1.0, far), side(0), side(1), side(2), side(3)],
            translation: self.translation,
        }
    }
}

/// One half-space: a box is outside if `normal . p + offset` exceeds `reach * sigma_max + slack * size` at every
/// corner. `size` is the largest sum of coordinates of the box plus that of the camera.
#[derive(Debug, Clone, Copy)]
pub struct PagePlane {
    /// Points outwards; not of unit length.
    pub normal: [f32; 3],
    /// Value at the origin.
    pub offset: f32,
    /// Per unit of sigma.
    pub reach: f32,
    /// Per unit of size.
    pub slack: f32,
}

/// The six half-spaces of a camera in world coordinates.
#[derive(Debug, Clone, Copy)]
pub struct PagePlanes {
    /// Near, far, x low, x high, y low, y high.
    pub planes: [PagePlane; 6],
    /// Sum of |t|, the camera's part of the size.
    pub translation: f32,
}

impl PagePlanes {
    /// Whether a row within these bounds may be drawn. `schedule::visibility` computes the same for many pages at once.
    pub fn may_intersect(&self, bounds: &PageBounds) -> bool {
        if bounds.is_empty() {
            return false;
        }
        let PageBounds { lo, hi, sigma_max } = bounds;
        let size = (0..3).fold(self.translation, |sum, i| sum + larger(lo[i].abs(), hi[i].abs()));
        !self.planes.iter().any(|plane| {
            let nearest = (0..3).fold(plane.offset, |sum, i| {
                let corner = if plane.normal[i] > 0.0 { lo[i] } else { hi[i] };
                sum + plane.normal[i] * corner
            });
            nearest > plane.reach * sigma_max + plane.slack * size
        })
    }
}

/// The larger of two numbers, NaN if the second is.
#[inline(always)]
pub fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}
