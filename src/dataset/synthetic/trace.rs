//! Finds the first solid on a ray: each cell of a grid over the ground lists its solids, and a ray visits cell by cell.
//!
//! Invariants: 1. a solid is in the list of every cell that its box touches; 2. cells are visited in the order in which
//! the ray crosses them, up to the cell of the nearest hit, so that the result does not depend on the cell size; 3. the
//! `top` of a cell is at least as high as every solid in it.

use super::solid::{Entry, Ray, Solid};
use glam::DVec3;

/// Side of a cell, metres.
const CELL: f64 = 4.0;

pub(super) struct Grid {
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

/// A walk over the cells below a ray.
struct Walk {
    cell: [isize; 2],
    step: [isize; 2],
    /// Ray parameter at which the next cell border across x and across y is met.
    next: [f64; 2],
    delta: [f64; 2],
    t: f64,
    end: f64,
}

impl Grid {
    pub(super) fn new(solids: &[Solid]) -> Grid {
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
        let mut grid = Grid { low, cells, top, starts, items: Vec::new(), highest };
        let mut listed = Vec::new();
        for (k, s) in solids.iter().enumerate() {
            grid.for_cells_of(s, |c| listed.push((c as u32, k as u32)));
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

    fn for_cells_of(&self, s: &Solid, mut each: impl FnMut(usize)) {
        let at = |v: f64, k: usize| (((v - self.low[k]) / CELL) as usize).min(self.cells[k] - 1);
        for j in at(s.low.y, 1)..=at(s.high.y, 1) {
            for i in at(s.low.x, 0)..=at(s.high.x, 0) {
                each(j * self.cells[0] + i);
            }
        }
    }

    /// The part of the ray before `limit` that can meet a solid.
    fn walk(&self, ray: &Ray, limit: f64) -> Option<Walk> {
        let high = [0, 1].map(|k| self.low[k] + self.cells[k] as f64 * CELL);
        let (mut t0, mut t1) = (0.0f64, limit);
        let slabs = [
            (ray.from.x, ray.inverse.x, self.low[0], high[0]),
            (ray.from.y, ray.inverse.y, self.low[1], high[1]),
            (ray.from.z, ray.inverse.z, -0.01, self.highest),
        ];
        for (from, inverse, low, high) in slabs {
            let (a, b) = ((low - from) * inverse, (high - from) * inverse);
            // min and max drop the NaN of 0 * infinity: a ray along a border counts as inside.
            t0 = t0.max(a.min(b));
            t1 = t1.min(a.max(b));
        }
        if t0 >= t1 {
            return None;
        }
        let p = ray.at(t0);
        let from = [p.x - self.low[0], p.y - self.low[1]];
        let along = [ray.along.x, ray.along.y];
        let cell = [0, 1].map(|k| ((from[k] / CELL) as isize).clamp(0, self.cells[k] as isize - 1));
        let step = [0, 1].map(|k| if along[k] < 0.0 { -1 } else { 1 });
        let next = [0, 1].map(|k| {
            let border = (cell[k] + isize::from(along[k] >= 0.0)) as f64 * CELL;
            if along[k] == 0.0 { f64::INFINITY } else { t0 + (border - from[k]) / along[k] }
        });
        let delta = [0, 1].map(|k| if along[k] == 0.0 { f64::INFINITY } else { CELL / along[k].abs() });
        Some(Walk { cell, step, next, delta, t: t0, end: t1 })
    }

    /// Calls `visit` with the solids of each cell that the ray may meet and the distance at which it leaves the
    /// cell, until `visit` returns true or the ray ends.
    #[inline(always)]
    fn visit(&self, ray: &Ray, limit: f64, mut visit: impl FnMut(&[Item], f64) -> bool) {
        let Some(mut w) = self.walk(ray, limit) else { return };
        loop {
            let out = w.next[0].min(w.next[1]).min(w.end);
            let c = w.cell[1] as usize * self.cells[0] + w.cell[0] as usize;
            let lowest = ray.from.z + ray.along.z * if ray.along.z < 0.0 { out } else { w.t };
            if lowest <= self.top[c] {
                let items = &self.items[self.starts[c] as usize..self.starts[c + 1] as usize];
                if visit(items, out) {
                    return;
                }
            }
            if out >= w.end {
                return;
            }
            let k = usize::from(w.next[1] < w.next[0]);
            w.t = out;
            w.cell[k] += w.step[k];
            w.next[k] += w.delta[k];
            if w.cell[k] < 0 || w.cell[k] >= self.cells[k] as isize {
                return;
            }
        }
    }

    /// The nearest solid that the ray enters in (0, limit).
    pub(super) fn nearest(&self, solids: &[Solid], ray: &Ray, limit: f64) -> Option<(u32, Entry)> {
        let mut best: Option<(u32, Entry)> = None;
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
    use crate::dataset::synthetic::world::World;

    #[test]
    fn the_grid_finds_what_a_search_of_all_solids_finds() {
        let world = World::build(3, 2);
        let grid = Grid::new(&world.solids);
        let mut draws = Stream::new(1, Purpose::Test, 0, 0);
        let mut hits = 0;
        for _ in 0..3000 {
            let from = DVec3::new(draws.range(-90.0, 90.0), draws.range(-90.0, 90.0), draws.range(0.5, 80.0));
            let along = DVec3::new(draws.normal(), draws.normal(), draws.normal() - 0.5).normalize();
            let ray = Ray::new(from, along);
            let mut all: Option<(u32, Entry)> = None;
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
