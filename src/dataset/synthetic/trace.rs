//! Solids, and the first solid on a ray: each cell of a grid over the ground lists its solids, and a ray visits cell by cell.
//!
//! Invariants: 1. every solid is convex and inside its box `low..high`; 2. a ray that starts inside a solid does not hit it, so that
//! shadow rays may start on a face; 3. a solid is in the list of every cell that its box touches; 4. cells are visited in the
//! order in which the ray crosses them, up to the cell of the nearest hit, so that the result does not depend on the cell size;
//! 5. the `top` of a cell is at least as high as every solid in it.

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
    Block {
        half_x: f64,
        half_y: f64,
        height: f64,
    },
    /// Roof over a rectangle with its ridge along x: slopes along y, and also along x if `run > 0` (hipped); cut off at
    /// the height `cap`.
    Roof {
        half_x: f64,
        half_y: f64,
        height: f64,
        run: f64,
        cap: f64,
    },
    Ellipsoid {
        radii: DVec3,
    },
}

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
pub(super) struct SurfaceHit {
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
    pub(super) fn enter(&self, ray: &Ray, limit: f64) -> Option<SurfaceHit> {
        let from = self.rotate_to_local(ray.from - self.origin);
        let along = self.rotate_to_local(ray.along);
        let entry = match self.shape {
            Shape::Block { half_x, half_y, height } => {
                let mut clip = OPEN;
                clip.half_space(from, along, DVec3::X, half_x, Face::SideX);
                clip.half_space(from, along, DVec3::NEG_X, half_x, Face::SideX);
                clip.half_space(from, along, DVec3::Y, half_y, Face::SideY);
                clip.half_space(from, along, DVec3::NEG_Y, half_y, Face::SideY);
                clip.half_space(from, along, DVec3::Z, height, Face::Top);
                clip.half_space(from, along, DVec3::NEG_Z, 0.0, Face::Bottom);
                clip.entry()
            }
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

    fn entry(self) -> Option<SurfaceHit> {
        (self.t0 <= self.t1 && self.t0 > 0.0).then(|| SurfaceHit {
            t: self.t0,
            normal: self.normal / self.normal.length(),
            face: self.face,
        })
    }
}

const OPEN: Clip = Clip { t0: f64::NEG_INFINITY, t1: f64::INFINITY, normal: DVec3::Z, face: Face::Top };

#[inline(always)]
fn enter_roof(
    from: DVec3,
    along: DVec3,
    half_x: f64,
    half_y: f64,
    height: f64,
    run: f64,
    cap: f64,
) -> Option<SurfaceHit> {
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
fn enter_ellipsoid(from: DVec3, along: DVec3, radii: DVec3) -> Option<SurfaceHit> {
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
    Some(SurfaceHit { t, normal: normal / normal.length(), face: Face::Round })
}

/// Side of a cell, metres.
const CELL: f64 = 4.0;

pub(super) struct SolidGrid {
    low: [f64; 2],
    cells: [usize; 2],
    /// Highest point of the solids of each cell.
    top: Vec<f64>,
    /// `items[starts[c]..starts[c + 1]]` are the solids of cell c.
    starts: Vec<u32>,
    items: Vec<Item>,
    highest: f64,
}

/// A solid in a cell's list, with its box: most solids of a cell are rejected by the box, without a look at the solid.
#[derive(Debug, Clone, Copy)]
struct Item {
    low: [f32; 3],
    high: [f32; 3],
    solid: u32,
}

/// Slack of the boxes, metres: more than the rounding of f32 for coordinates of up to 24 km.
const SLACK: f64 = 0.02;

impl Item {
    fn new(solid: u32, s: &Solid) -> Item {
        let (low, high) = (s.low - DVec3::splat(SLACK), s.high + DVec3::splat(SLACK));
        Item { low: low.as_vec3().into(), high: high.as_vec3().into(), solid }
    }

    /// Whether the ray passes through the box before `limit`.
    #[inline(always)]
    fn is_near(&self, from: &[f32; 3], inverse: &[f32; 3], limit: f32) -> bool {
        let (mut t0, mut t1) = (0.0f32, limit);
        for k in 0..3 {
            let (a, b) = ((self.low[k] - from[k]) * inverse[k], (self.high[k] - from[k]) * inverse[k]);
            // A NaN (0 times infinity, from a ray along a face) fails both comparisons: the box counts as near.
            let (near, far) = if a < b { (a, b) } else { (b, a) };
            t0 = if near > t0 { near } else { t0 };
            t1 = if far < t1 { far } else { t1 };
        }
        t0 <= t1
    }
}

/// The ray's origin and inverse direction in single precision.
fn single(ray: &Ray) -> ([f32; 3], [f32; 3]) {
    (ray.from.as_vec3().into(), ray.inverse.as_vec3().into())
}

impl SolidGrid {
    pub(super) fn new(solids: &[Solid]) -> SolidGrid {
        let mut low = [0.0f64; 2];
        let mut high = [0.0f64; 2];
        let mut highest = 0.0f64;
        for s in solids {
            low = [low[0].min(s.low.x), low[1].min(s.low.y)];
            high = [high[0].max(s.high.x), high[1].max(s.high.y)];
            highest = highest.max(s.high.z);
        }
        let cells = [0, 1].map(|k| ((high[k] - low[k]) / CELL) as usize + 1);
        let count = cells[0] * cells[1];
        let (top, starts) = (vec![0.0; count], vec![0; count + 1]);
        let mut grid = SolidGrid { low, cells, top, starts, items: Vec::new(), highest };
        let mut listed = Vec::new();
        for (k, s) in solids.iter().enumerate() {
            let at = |v: f64, k: usize| (((v - low[k]) / CELL) as usize).min(cells[k] - 1);
            for j in at(s.low.y, 1)..=at(s.high.y, 1) {
                listed.extend((at(s.low.x, 0)..=at(s.high.x, 0)).map(|i| ((j * cells[0] + i) as u32, k as u32)));
            }
        }
        listed.sort_unstable();
        for &(c, k) in &listed {
            let (c, s) = (c as usize, &solids[k as usize]);
            grid.starts[c + 1] += 1;
            grid.top[c] = grid.top[c].max(s.high.z);
            grid.items.push(Item::new(k, s));
        }
        for c in 0..count {
            grid.starts[c + 1] += grid.starts[c];
        }
        grid
    }

    /// Calls `visit` with the solids of each cell that the ray may meet and the distance at which it leaves the
    /// cell, until `visit` returns true or the ray ends.
    #[inline(always)]
    fn visit(&self, ray: &Ray, limit: f64, mut visit: impl FnMut(&[Item], f64) -> bool) {
        // The part of the ray before `limit` that can meet a solid.
        let high = [0, 1].map(|k| self.low[k] + self.cells[k] as f64 * CELL);
        let (mut t, mut end) = (0.0f64, limit);
        let slabs = [
            (ray.from.x, ray.inverse.x, self.low[0], high[0]),
            (ray.from.y, ray.inverse.y, self.low[1], high[1]),
            (ray.from.z, ray.inverse.z, -0.01, self.highest),
        ];
        for (from, inverse, low, high) in slabs {
            let (a, b) = ((low - from) * inverse, (high - from) * inverse);
            // min and max drop the NaN of 0 * infinity: a ray along a border counts as inside.
            t = t.max(a.min(b));
            end = end.min(a.max(b));
        }
        if t >= end {
            return;
        }
        let p = ray.at(t);
        let from = [p.x - self.low[0], p.y - self.low[1]];
        let along = [ray.along.x, ray.along.y];
        let mut cell = [0, 1].map(|k| ((from[k] / CELL) as isize).clamp(0, self.cells[k] as isize - 1));
        // Where the ray crosses the next border of cells across x and across y, and from border to border.
        let mut next = [0, 1].map(|k| {
            let border = (cell[k] + isize::from(along[k] >= 0.0)) as f64 * CELL;
            if along[k] == 0.0 { f64::INFINITY } else { t + (border - from[k]) / along[k] }
        });
        let delta = [0, 1].map(|k| if along[k] == 0.0 { f64::INFINITY } else { CELL / along[k].abs() });
        loop {
            let out = next[0].min(next[1]).min(end);
            let c = cell[1] as usize * self.cells[0] + cell[0] as usize;
            let lowest = ray.from.z + ray.along.z * if ray.along.z < 0.0 { out } else { t };
            let items = &self.items[self.starts[c] as usize..self.starts[c + 1] as usize];
            if (lowest <= self.top[c] && visit(items, out)) || out >= end {
                return;
            }
            let k = usize::from(next[1] < next[0]);
            t = out;
            cell[k] += if along[k] < 0.0 { -1 } else { 1 };
            next[k] += delta[k];
            if cell[k] < 0 || cell[k] >= self.cells[k] as isize {
                return;
            }
        }
    }

    /// The nearest solid that the ray enters in (0, limit).
    pub(super) fn nearest(&self, solids: &[Solid], ray: &Ray, limit: f64) -> Option<(u32, SurfaceHit)> {
        let mut best: Option<(u32, SurfaceHit)> = None;
        let mut reach = limit;
        let (from, inverse) = single(ray);
        self.visit(ray, limit, |items, out| {
            for item in items {
                if item.is_near(&from, &inverse, (reach + SLACK) as f32)
                    && let Some(entry) = solids[item.solid as usize].enter(ray, reach)
                {
                    reach = entry.t;
                    best = Some((item.solid, entry));
                }
            }
            // A hit beyond this cell is final only if no later cell has a nearer one.
            reach <= out
        });
        best
    }

    /// Whether the ray enters any solid in (0, limit).
    pub(super) fn blocked(&self, solids: &[Solid], ray: &Ray, limit: f64) -> bool {
        let mut found = false;
        let (from, inverse) = single(ray);
        self.visit(ray, limit, |items, _| {
            found = items.iter().any(|item| {
                item.is_near(&from, &inverse, (limit + SLACK) as f32)
                    && solids[item.solid as usize].enter(ray, limit).is_some()
            });
            found
        });
        found
    }

    /// Height of the highest solid above (x, y), 0 on open ground.
    pub(super) fn top_at(&self, solids: &[Solid], x: f64, y: f64) -> f64 {
        let from = DVec3::new(x, y, self.highest + 1.0);
        let down = Ray::new(from, DVec3::NEG_Z);
        self.nearest(solids, &down, from.z).map_or(0.0, |(_, e)| from.z - e.t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::dataset::synthetic::build::build_city;

    #[test]
    fn the_grid_finds_what_a_search_of_all_solids_finds() {
        let world = build_city(3, 2);
        let grid = SolidGrid::new(&world.solids);
        let mut draws = Stream::new(1, Purpose::Test, 0, 0);
        let mut hits = 0;
        for _ in 0..3000 {
            let from = DVec3::new(draws.range(-90.0, 90.0), draws.range(-90.0, 90.0), draws.range(0.5, 80.0));
            let along = DVec3::new(draws.normal(), draws.normal(), draws.normal() - 0.5).normalize();
            let ray = Ray::new(from, along);
            let mut all: Option<(u32, SurfaceHit)> = None;
            for (k, s) in world.solids.iter().enumerate() {
                if let Some(e) = s.enter(&ray, all.map_or(300.0, |(_, e)| e.t)) {
                    all = Some((k as u32, e));
                }
            }
            let got = grid.nearest(&world.solids, &ray, 300.0);
            assert_eq!(got.map(|(_, e)| e.t), all.map(|(_, e)| e.t));
            assert_eq!(grid.blocked(&world.solids, &ray, 300.0), all.is_some());
            hits += u32::from(all.is_some());
        }
        assert!(hits > 300, "the test rays meet too little: {hits}");
    }
}
