//! Solids, and the place where a ray enters one.
//!
//! Invariants: 1. every solid is convex and inside its box `low..high`; 2. a ray that starts inside a solid does not hit
//! it, so that shadow rays may start on a face.

use super::texture::Skin;
use glam::DVec3;

/// A ray; the direction has length 1.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub(super) from: DVec3,
    pub(super) along: DVec3,
    /// 1 / along; infinite where it is 0.
    pub(super) inverse: DVec3,
}

impl Ray {
    pub(super) fn new(from: DVec3, along: DVec3) -> Ray {
        Ray { from, along, inverse: DVec3::new(1.0 / along.x, 1.0 / along.y, 1.0 / along.z) }
    }

    pub(super) fn at(&self, t: f64) -> DVec3 {
        self.from + self.along * t
    }
}

/// Shapes in their own frame: base centre at the origin, z up.
#[derive(Debug, Clone, Copy)]
pub(super) enum Shape {
    /// Box with half sides and a height.
    Block { half_x: f64, half_y: f64, height: f64 },
    /// Roof over a rectangle with its ridge along x: slopes along y, and also along x if `run > 0` (hipped); cut off at
    /// the height `cap`.
    Roof { half_x: f64, half_y: f64, height: f64, run: f64, cap: f64 },
    /// Ellipsoid around the origin.
    Ellipsoid { radii: DVec3 },
}

/// A part of a solid's surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Face {
    /// Vertical wall across x, or gable end.
    SideX,
    /// Vertical wall across y.
    SideY,
    Top,
    Bottom,
    /// Roof slope that falls along y.
    SlopeY,
    /// Roof slope that falls along x.
    SlopeX,
    Round,
}

/// The place where a ray enters a solid; the normal is in the solid's frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub(super) t: f64,
    pub(super) normal: DVec3,
    pub(super) face: Face,
}

/// A shape at a place in the world, with its surfaces.
#[derive(Debug, Clone)]
pub(super) struct Solid {
    pub(super) shape: Shape,
    pub(super) origin: DVec3,
    pub(super) cos: f64,
    pub(super) sin: f64,
    pub(super) low: DVec3,
    pub(super) high: DVec3,
    /// Surface of walls and of round shapes.
    pub(super) side: Skin,
    /// Surface of tops and slopes.
    pub(super) top: Skin,
}

impl Solid {
    /// Places `shape` at `origin`, rotated by the angle with this cosine and sine.
    pub(super) fn new(shape: Shape, origin: DVec3, (cos, sin): (f64, f64), side: Skin, top: Skin) -> Solid {
        let (hx, hy, z0, z1) = match shape {
            Shape::Block { half_x, half_y, height } => (half_x, half_y, 0.0, height),
            Shape::Roof { half_x, half_y, height, cap, .. } => (half_x, half_y, 0.0, height.min(cap)),
            Shape::Ellipsoid { radii } => (radii.x, radii.y, -radii.z, radii.z),
        };
        let (ex, ey) = (hx * cos.abs() + hy * sin.abs(), hx * sin.abs() + hy * cos.abs());
        // A millimetre of slack keeps hits on faces inside the box despite rounding.
        let low = origin + DVec3::new(-ex, -ey, z0) - DVec3::splat(1e-3);
        let high = origin + DVec3::new(ex, ey, z1) + DVec3::splat(1e-3);
        Solid { shape, origin, cos, sin, low, high, side, top }
    }

    /// Rotates a direction, or the difference of two points, from the world to the solid's frame.
    #[inline(always)]
    pub(super) fn rotate_to_local(&self, p: DVec3) -> DVec3 {
        DVec3::new(self.cos * p.x + self.sin * p.y, self.cos * p.y - self.sin * p.x, p.z)
    }

    /// Rotates a direction from the solid's frame to the world.
    #[inline(always)]
    pub(super) fn rotate_to_world(&self, p: DVec3) -> DVec3 {
        DVec3::new(self.cos * p.x - self.sin * p.y, self.sin * p.x + self.cos * p.y, p.z)
    }

    /// The place where `ray` enters, if its distance is in (0, limit).
    #[inline]
    pub(super) fn enter(&self, ray: &Ray, limit: f64) -> Option<Entry> {
        let from = self.rotate_to_local(ray.from - self.origin);
        let along = self.rotate_to_local(ray.along);
        let entry = match self.shape {
            Shape::Block { half_x, half_y, height } => enter_block(from, along, half_x, half_y, height),
            Shape::Roof { half_x, half_y, height, run, cap } => {
                enter_roof(from, along, half_x, half_y, height, run, cap)
            }
            Shape::Ellipsoid { radii } => enter_ellipsoid(from, along, radii),
        }?;
        (entry.t > 0.0 && entry.t < limit).then_some(entry)
    }
}

/// The part of a ray inside all half-spaces so far, and the face through which it enters.
struct Clip {
    t0: f64,
    t1: f64,
    normal: DVec3,
    face: Face,
}

impl Clip {
    /// Keeps the part with `normal . p <= distance`; the normal may have any length.
    #[inline(always)]
    fn half_space(&mut self, from: DVec3, along: DVec3, normal: DVec3, distance: f64, face: Face) {
        let (speed, room) = (normal.dot(along), distance - normal.dot(from));
        if speed < 0.0 {
            let t = room / speed;
            if t > self.t0 {
                (self.t0, self.normal, self.face) = (t, normal, face);
            }
        } else if speed > 0.0 {
            self.t1 = self.t1.min(room / speed);
        } else if room < 0.0 {
            self.t1 = f64::NEG_INFINITY;
        }
    }

    fn entry(self) -> Option<Entry> {
        (self.t0 <= self.t1 && self.t0 > 0.0).then(|| Entry {
            t: self.t0,
            normal: self.normal / self.normal.length(),
            face: self.face,
        })
    }
}

const OPEN: Clip = Clip { t0: f64::NEG_INFINITY, t1: f64::INFINITY, normal: DVec3::Z, face: Face::Top };

#[inline(always)]
fn enter_block(from: DVec3, along: DVec3, half_x: f64, half_y: f64, height: f64) -> Option<Entry> {
    let mut clip = OPEN;
    clip.half_space(from, along, DVec3::X, half_x, Face::SideX);
    clip.half_space(from, along, DVec3::NEG_X, half_x, Face::SideX);
    clip.half_space(from, along, DVec3::Y, half_y, Face::SideY);
    clip.half_space(from, along, DVec3::NEG_Y, half_y, Face::SideY);
    clip.half_space(from, along, DVec3::Z, height, Face::Top);
    clip.half_space(from, along, DVec3::NEG_Z, 0.0, Face::Bottom);
    clip.entry()
}

#[inline(always)]
fn enter_roof(from: DVec3, along: DVec3, half_x: f64, half_y: f64, height: f64, run: f64, cap: f64) -> Option<Entry> {
    let mut clip = OPEN;
    clip.half_space(from, along, DVec3::new(0.0, height, half_y), height * half_y, Face::SlopeY);
    clip.half_space(from, along, DVec3::new(0.0, -height, half_y), height * half_y, Face::SlopeY);
    if run > 0.0 {
        clip.half_space(from, along, DVec3::new(height, 0.0, run), height * half_x, Face::SlopeX);
        clip.half_space(from, along, DVec3::new(-height, 0.0, run), height * half_x, Face::SlopeX);
    } else {
        clip.half_space(from, along, DVec3::X, half_x, Face::SideX);
        clip.half_space(from, along, DVec3::NEG_X, half_x, Face::SideX);
    }
    clip.half_space(from, along, DVec3::NEG_Z, 0.0, Face::Bottom);
    clip.half_space(from, along, DVec3::Z, cap, Face::Top);
    clip.entry()
}

#[inline(always)]
fn enter_ellipsoid(from: DVec3, along: DVec3, radii: DVec3) -> Option<Entry> {
    let (o, d) = (from / radii, along / radii);
    let (a, b, c) = (d.dot(d), o.dot(d), o.dot(o) - 1.0);
    let under = b * b - a * c;
    if under <= 0.0 {
        return None;
    }
    let t = (-b - under.sqrt()) / a;
    if t <= 0.0 {
        return None;
    }
    let normal = (o + d * t) / radii;
    Some(Entry { t, normal: normal / normal.length(), face: Face::Round })
}
