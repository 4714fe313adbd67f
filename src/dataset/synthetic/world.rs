//! The city as data: its solids, and the ground plan.
//!
//! Invariants: 1. the world depends on (seed, blocks) alone; 2. the ground is the plane z = 0, the city is the square
//! [-half, half]^2 with a road around it, surrounded by fields; 3. coordinates are metres, z up, without the dataset's
//! offset.

use super::texture::{FacePlace, Material, Noise, Skin, SurfaceLook, asphalt, cell_draw, cover, lines, paint};
use super::trace::Solid;
use glam::{DVec3, Vec3};

/// Distance between the centre lines of neighbouring roads, metres.
pub(super) const PITCH: f64 = 60.0;
/// Half the width of the carriageway, metres.
pub(super) const HALF_ROAD: f64 = 4.0;
/// Distance from the centre line to the outer edge of the pavement, metres.
pub(super) const HALF_STREET: f64 = 6.6;
/// Width of the strip around the city that has trees and farms, metres.
pub(super) const MARGIN: f64 = 150.0;

/// A rectangle of ground inside a plot.
#[derive(Debug, Clone)]
pub(super) struct Patch {
    pub(super) low: [f64; 2],
    pub(super) high: [f64; 2],
    pub(super) skin: Skin,
}

/// The ground between four streets.
#[derive(Debug, Clone)]
pub(super) struct CityPlot {
    pub(super) base: Skin,
    /// Later patches cover earlier ones.
    pub(super) patches: Vec<Patch>,
}

pub(super) struct World {
    pub(super) seed: u64,
    pub(super) blocks: u32,
    pub(super) noise: Noise,
    pub(super) solids: Vec<Solid>,
    /// `[blocks][blocks]`, rows along x.
    pub(super) plots: Vec<CityPlot>,
}

const ROAD: Skin =
    Skin { kind: Material::Asphalt, color: paint(0.34, 0.34, 0.35), accent: paint(0.84, 0.84, 0.8), seed: 3 };
const PAVEMENT: Skin =
    Skin { kind: Material::Paving, color: paint(0.62, 0.6, 0.57), accent: paint(0.55, 0.52, 0.49), seed: 4 };
const VERGE: Skin =
    Skin { kind: Material::Grass, color: paint(0.4, 0.47, 0.24), accent: paint(0.52, 0.52, 0.3), seed: 5 };

/// Side of a field outside the city, metres.
const FIELD: f64 = 74.0;

impl World {
    pub(super) fn half(&self) -> f64 {
        0.5 * PITCH * f64::from(self.blocks)
    }

    /// The ground at (x, y), and a number that changes at the borders of the plan.
    pub(super) fn ground(&self, x: f64, y: f64, w: f64) -> (SurfaceLook, u32) {
        let half = self.half();
        let last = f64::from(self.blocks);
        let (gx, gy) = ((x + half) / PITCH, (y + half) / PITCH);
        let (kx, ky) = ((gx + 0.5).floor().clamp(0.0, last), (gy + 0.5).floor().clamp(0.0, last));
        // Signed distances to the nearest centre lines.
        let (dx, dy) = ((gx - kx) * PITCH, (gy - ky) * PITCH);
        let inside_x = x.abs() <= half + HALF_STREET;
        let inside_y = y.abs() <= half + HALF_STREET;
        // The two middle roads leave the city.
        let middle = (self.blocks / 2) as f64;
        let street_x = dx.abs() < HALF_STREET && (inside_y || kx == middle);
        let street_y = dy.abs() < HALF_STREET && (inside_x || ky == middle);
        if street_x || street_y {
            let beyond = f64::INFINITY;
            let (dx, dy) = (if street_x { dx } else { beyond }, if street_y { dy } else { beyond });
            return self.street(x, y, dx, dy, inside_x && inside_y, w);
        }
        if x.abs() < half && y.abs() < half {
            return self.plot_ground(x, y, gx, gy, w);
        }
        self.countryside(x, y, w)
    }

    /// A street; `dx`, `dy` are the distances to the centre lines of the streets along y and along x.
    fn street(&self, x: f64, y: f64, dx: f64, dy: f64, in_town: bool, w: f64) -> (SurfaceLook, u32) {
        let on_road = dx.abs() < HALF_ROAD || dy.abs() < HALF_ROAD;
        let place = FacePlace { u: x, v: y, width: 0.0, height: 0.0, w };
        if !on_road && !in_town {
            return (VERGE.look(&self.noise, place), 2);
        }
        if !on_road {
            let mut look = PAVEMENT.look(&self.noise, place);
            // The kerb is light stone.
            let nearest = (dx.abs() - HALF_ROAD).min(dy.abs() - HALF_ROAD);
            look.albedo += (Vec3::splat(0.45) - look.albedo) * (0.7 * cover(nearest, -0.1, 0.28, w));
            return (look, 1);
        }
        let mut albedo = asphalt(&self.noise, &ROAD, x, y, w);
        let crossing = dx.abs() < HALF_ROAD && dy.abs() < HALF_ROAD;
        if !crossing {
            // Across and along the road; `to_crossing` is the distance from the crossing's centre line.
            let along_y = dx.abs() < HALF_ROAD;
            let (across, along, to_crossing) = if along_y { (dx, y, dy.abs()) } else { (dy, x, dx.abs()) };
            let mark = markings(across, along, to_crossing, in_town, w);
            let worn = 0.75 + self.noise.layers(x, y, w, &[(1.3, 0.25), (0.4, 0.25)]);
            albedo += (ROAD.accent - albedo) * (mark * worn.clamp(0.2, 1.0));
            // Tyres darken the asphalt.
            let lane = across.abs() - 2.0;
            let track = cover(lane.abs(), 0.55, 1.05, w.max(0.4));
            albedo *= 1.0 - 0.16 * track;
        }
        (SurfaceLook { albedo, gloss: 0.02, rough: 0.0 }, 3)
    }

    fn plot_ground(&self, x: f64, y: f64, gx: f64, gy: f64, w: f64) -> (SurfaceLook, u32) {
        let last = self.blocks as usize - 1;
        let (i, j) = ((gx as usize).min(last), (gy as usize).min(last));
        let plot = &self.plots[j * self.blocks as usize + i];
        let place = FacePlace { u: x, v: y, width: 0.0, height: 0.0, w };
        for (k, patch) in plot.patches.iter().enumerate().rev() {
            if x >= patch.low[0] && x < patch.high[0] && y >= patch.low[1] && y < patch.high[1] {
                // The patterns of courts and car parks start at the patch's corner.
                let own = FacePlace {
                    u: x - patch.low[0],
                    v: y - patch.low[1],
                    width: patch.high[0] - patch.low[0],
                    height: patch.high[1] - patch.low[1],
                    w,
                };
                let mut look = patch.skin.look(&self.noise, own);
                if patch.skin.kind == Material::Asphalt && own.width > 12.0 {
                    look.albedo += (patch.skin.accent - look.albedo) * (0.75 * parking_lines(own));
                }
                return (look, 16 + k as u32);
            }
        }
        (plot.base.look(&self.noise, place), 4)
    }

    fn countryside(&self, x: f64, y: f64, w: f64) -> (SurfaceLook, u32) {
        // Every row of fields is shifted, so that their corners do not align.
        let j = (y / FIELD).floor();
        let shift = f64::from(cell_draw(j as i64, 9, self.seed as u32)) * FIELD;
        let i = ((x + shift) / FIELD).floor();
        let (u, v) = (x + shift - i * FIELD, y - j * FIELD);
        let pick = cell_draw(i as i64, j as i64, self.seed as u32 ^ 0x7a);
        let (kind, color, accent) = FIELDS[((pick * 6.0) as usize).min(5)];
        let skin = Skin { kind, color, accent, seed: (pick * 65_536.0) as u32 };
        let edge = u.min(FIELD - u).min(v).min(FIELD - v);
        let place = FacePlace { u: x, v: y, width: 0.0, height: 0.0, w };
        let mut look = skin.look(&self.noise, place);
        let margin = cover(edge, -1.0, 1.4 + 0.7 * f64::from(self.noise.value(x / 4.0, y / 4.0)), w);
        look.albedo += (VERGE.look(&self.noise, place).albedo - look.albedo) * margin;
        (look, 5 + ((i as i64 + j as i64) & 1) as u32)
    }

    /// Whether `p` is outside the city and not on a road or its verge.
    pub(super) fn is_open_land(&self, p: DVec3) -> bool {
        let half = self.half();
        let middle = (self.blocks / 2) as f64 * PITCH - half;
        let out = p.x.abs() > half + HALF_STREET + 3.0 || p.y.abs() > half + HALF_STREET + 3.0;
        out && (p.x - middle).abs() > HALF_STREET + 2.5 && (p.y - middle).abs() > HALF_STREET + 2.5
    }
}

/// Share of the footprint that is on road markings.
fn markings(across: f64, along: f64, to_crossing: f64, in_town: bool, w: f64) -> f32 {
    let edge = cover(across.abs(), HALF_ROAD - 0.45, HALF_ROAD - 0.28, w);
    let d = along - 6.0 * (along / 6.0).floor();
    let dash = cover(across, -0.09, 0.09, w) * cover(d, 0.0, 3.0, w);
    if !in_town || to_crossing > HALF_ROAD + 6.5 {
        return edge.max(dash);
    }
    // Before a junction: a zebra crossing and a stop line.
    let from_edge = to_crossing - HALF_ROAD;
    let zebra = cover(from_edge, 0.9, 3.9, w) * lines(across + 0.5, 1.0, 0.5, w);
    let stop = cover(from_edge, 5.0, 5.45, w);
    zebra.max(stop)
}

/// Lines of parking bays on both sides of aisles, which repeat every 16 m.
fn parking_lines(p: FacePlace) -> f32 {
    let v = p.v - 16.0 * (p.v / 16.0).floor();
    let row = cover(v, 0.3, 5.3, p.w).max(cover(v, 11.3, 16.0, p.w));
    let inside = cover(p.u, 0.5, p.width - 0.5, p.w);
    row * inside * lines(p.u, 2.6, 0.14, p.w)
}

const FIELDS: [(Material, Vec3, Vec3); 6] = [
    (Material::Crop, paint(0.42, 0.5, 0.24), paint(0.44, 0.4, 0.27)),
    (Material::Crop, paint(0.66, 0.6, 0.36), paint(0.56, 0.49, 0.32)),
    (Material::Crop, paint(0.52, 0.43, 0.33), paint(0.45, 0.36, 0.27)),
    (Material::Grass, paint(0.42, 0.5, 0.26), paint(0.56, 0.56, 0.32)),
    (Material::Crop, paint(0.34, 0.43, 0.2), paint(0.4, 0.4, 0.24)),
    (Material::Grass, paint(0.47, 0.52, 0.29), paint(0.6, 0.57, 0.36)),
];
