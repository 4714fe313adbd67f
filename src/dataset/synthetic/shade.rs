//! Lighting: the sun with sharp shadows, the visible part of a blue sky, some light from the ground, and a weak gloss
//! that depends on the viewing direction.
//!
//! Invariant: light depends on (world, place, viewing direction, footprint) alone.

use super::texture::{FacePlace, SurfaceLook};
use super::trace::{Face, Ray, Shape, Solid, SolidGrid, SurfaceHit};
use super::world::World;
use glam::{DVec3, Vec3};
use std::sync::atomic::{AtomicU32, Ordering};

/// Side of a cell of the sky map, metres.
const SKY_CELL: f64 = 1.0;
const SKY_RAYS: usize = 32;
/// Length of the rays that sample the sky, metres.
const SKY_REACH: f64 = 45.0;

const SUN_LIGHT: Vec3 = Vec3::new(1.42, 1.30, 1.10);
const SKY_LIGHT: Vec3 = Vec3::new(0.40, 0.47, 0.58);
const GROUND_LIGHT: Vec3 = Vec3::new(0.17, 0.155, 0.13);

/// Unit vector towards the sun: 47 degrees high in the south-east.
fn sun() -> DVec3 {
    let v = DVec3::new(0.52, -0.43, 0.74);
    v / v.length()
}

/// A world with its grid and its sky map.
pub(super) struct Scene {
    pub(super) world: World,
    grid: SolidGrid,
    sun: DVec3,
    sky: SkyMap,
}

/// For each square metre: the height of its top, and the share of the sky that the top sees. Both are found where light is
/// first asked for: photos show a small part of a large city.
struct SkyMap {
    low: f64,
    cells: usize,
    directions: [DVec3; SKY_RAYS],
    /// Bits of floats, or [`UNKNOWN`]. A value depends on its place alone, so threads that find it at once find the same.
    height: Vec<AtomicU32>,
    open: Vec<AtomicU32>,
}

/// A NaN that no height and no share has.
const UNKNOWN: u32 = u32::MAX;

#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    pub(super) t: f64,
    pub(super) point: DVec3,
    pub(super) normal: DVec3,
    /// Solid and its part; `None` for the ground.
    solid: Option<(u32, Face)>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub(super) light: Vec3,
    /// A number that changes at every border of a surface or a shadow.
    pub(super) surface: u32,
}

const SKY: Sample = Sample { light: Vec3::new(0.55, 0.68, 0.85), surface: u32::MAX };

impl Scene {
    /// Builds the grid, and a sky map of which nothing is known.
    pub(super) fn new(world: World) -> Scene {
        let grid = SolidGrid::new(&world.solids);
        let sky = SkyMap::new(&world);
        Scene { world, grid, sun: sun(), sky }
    }

    /// The first place on a ray; `None` is the sky.
    pub(super) fn hit(&self, ray: &Ray) -> Option<Hit> {
        let ground = if ray.along.z < 0.0 { -ray.from.z * ray.inverse.z } else { f64::INFINITY };
        if let Some((k, SurfaceHit { t, normal, face })) = self.grid.nearest(&self.world.solids, ray, ground.min(1e5)) {
            let normal = self.world.solids[k as usize].rotate_to_world(normal);
            return Some(Hit { t, point: ray.at(t), normal, solid: Some((k, face)) });
        }
        if !ground.is_finite() {
            return None;
        }
        let p = ray.at(ground);
        Some(Hit { t: ground, point: DVec3::new(p.x, p.y, 0.0), normal: DVec3::Z, solid: None })
    }

    /// Whether nothing is between a place and a camera.
    pub(super) fn sees(&self, camera: DVec3, hit: &Hit) -> bool {
        let from = hit.point + hit.normal * 0.02;
        let way = camera - from;
        let length = way.length();
        !self.grid.blocked(&self.world.solids, &Ray::new(from, way / length), length)
    }

    /// Light along a ray; `spread` is the side of the sample's footprint at distance 1.
    pub(super) fn sample(&self, ray: &Ray, spread: f64) -> Sample {
        match self.hit(ray) {
            Some(hit) => self.shade(ray, &hit, spread),
            None => SKY,
        }
    }

    /// Light from a place towards the ray's origin.
    pub(super) fn shade(&self, ray: &Ray, hit: &Hit, spread: f64) -> Sample {
        let facing = -hit.normal.dot(ray.along);
        // At a flat angle the footprint is longer in one direction: its side is the geometric mean.
        let w = hit.t * spread / facing.max(0.08).sqrt();
        let (look, surface) = match hit.solid {
            Some((k, face)) => {
                let solid = &self.world.solids[k as usize];
                (solid_look(&self.world, solid, face, hit.point, w), (k + 64) * 8 + face as u32)
            }
            None => self.world.ground(hit.point.x, hit.point.y, w),
        };
        let (light, in_sun) = self.light(ray, hit, &look, w);
        Sample { light, surface: surface * 2 + u32::from(in_sun) }
    }

    fn light(&self, ray: &Ray, hit: &Hit, look: &SurfaceLook, w: f64) -> (Vec3, bool) {
        let mut n = hit.normal;
        if look.rough > 0.0 {
            let p = hit.point;
            let noise = &self.world.noise;
            let tilt = |a: f64, b: f64| f64::from(noise.layers(a, b, w, &[(0.9, 0.6), (0.4, 0.6), (0.2, 0.4)]));
            let bump = DVec3::new(tilt(p.x + p.z, p.y), tilt(p.y - p.z, p.x), tilt(p.z + p.x, p.y - p.x));
            let turned = n + bump * f64::from(look.rough);
            n = turned / turned.length();
        }
        let to_sun = hit.normal.dot(self.sun);
        let mut in_sun = to_sun > 0.0;
        if in_sun {
            let away = Ray::new(hit.point + hit.normal * 1e-3, self.sun);
            in_sun = !self.grid.blocked(&self.world.solids, &away, 1e4);
        }
        let direct = if in_sun { n.dot(self.sun).max(0.0) as f32 } else { 0.0 };
        let open = self.sky.open_at(self, hit.point + hit.normal * 0.7);
        let up = (0.5 + 0.5 * n.z) as f32;
        let ambient = SKY_LIGHT * (open * up) + GROUND_LIGHT * ((1.0 - up) * (0.4 + 0.6 * open));
        let mut light = look.albedo * (SUN_LIGHT * direct + ambient);
        if look.gloss > 0.0 {
            light += self.gloss(ray, hit.normal, look.gloss, in_sun, open);
        }
        (light, in_sun)
    }

    /// The reflected light: sky or street in the mirrored direction, and a broad highlight of the sun.
    fn gloss(&self, ray: &Ray, n: DVec3, gloss: f32, in_sun: bool, open: f32) -> Vec3 {
        let facing = (-n.dot(ray.along)).clamp(0.0, 1.0);
        let mirrored = ray.along + n * (2.0 * facing);
        // Schlick's approximation of Fresnel's law, with a floor of 6 %.
        let rest = (1.0 - facing) as f32;
        let fresnel = 0.06 + 0.94 * rest * rest * rest * rest * rest;
        let up = mirrored.z as f32;
        let around = if up > 0.0 {
            Vec3::new(0.75, 0.85, 1.0).lerp(Vec3::new(0.4, 0.6, 0.9), up) * (0.3 + 0.7 * open)
        } else {
            // The reflected street is brighter on the side that the sun lights.
            let lit = (mirrored.x * self.sun.x + mirrored.y * self.sun.y) as f32;
            Vec3::new(0.42, 0.38, 0.33).lerp(Vec3::new(0.16, 0.16, 0.17), -up) * (1.0 - 0.45 * lit)
        };
        let mut light = around * (fresnel * gloss * 1.6);
        if in_sun {
            let c = mirrored.dot(self.sun).max(0.0) as f32;
            let c4 = (c * c) * (c * c);
            light += SUN_LIGHT * (c4 * c4 * c4 * c4 * gloss * 0.35);
        }
        light
    }
}

fn solid_look(world: &World, solid: &Solid, face: Face, point: DVec3, w: f64) -> SurfaceLook {
    let p = solid.rotate_to_local(point - solid.origin);
    let (half_x, half_y, height) = match solid.shape {
        Shape::Block { half_x, half_y, height } | Shape::Roof { half_x, half_y, height, .. } => {
            (half_x, half_y, height)
        }
        Shape::Ellipsoid { radii } => (radii.x, radii.y, radii.z),
    };
    let (x, y) = (p.x + half_x, p.y + half_y);
    let (u, v, width, height) = match face {
        Face::SideX => (y, p.z, 2.0 * half_y, height),
        Face::SideY => (x, p.z, 2.0 * half_x, height),
        Face::Top | Face::Bottom => (x, y, 2.0 * half_x, 2.0 * half_y),
        Face::SlopeY => {
            let stretch = (half_y * half_y + height * height).sqrt();
            (x, (1.0 - p.y.abs() / half_y) * stretch, 2.0 * half_x, stretch)
        }
        Face::SlopeX => {
            let run = if let Shape::Roof { run, .. } = solid.shape { run } else { half_x };
            let stretch = (run * run + height * height).sqrt();
            (y, (half_x - p.x.abs()) / run * stretch, 2.0 * half_y, stretch)
        }
        Face::Round => (p.x + 0.6 * p.z, p.y - 0.6 * p.z, 2.0 * half_x, 2.0 * half_y),
    };
    let skin = match face {
        Face::SideX | Face::SideY | Face::Round | Face::Bottom => &solid.side,
        Face::Top | Face::SlopeX | Face::SlopeY => &solid.top,
    };
    skin.look(&world.noise, FacePlace { u, v, width, height, w })
}

impl SkyMap {
    fn new(world: &World) -> SkyMap {
        let half = world.half() + 25.0;
        let cells = (2.0 * half / SKY_CELL) as usize + 1;
        let unknown = || std::iter::repeat_with(|| AtomicU32::new(UNKNOWN)).take(cells * cells).collect();
        SkyMap { low: -half, cells, directions: sky_directions(), height: unknown(), open: unknown() }
    }

    fn place(&self, c: usize) -> [f64; 2] {
        [c % self.cells, c / self.cells].map(|i| i as f64 * SKY_CELL + self.low)
    }

    fn height(&self, scene: &Scene, c: usize) -> f32 {
        known(&self.height[c], || {
            let [x, y] = self.place(c);
            scene.grid.top_at(&scene.world.solids, x, y) as f32
        })
    }

    fn open(&self, scene: &Scene, c: usize) -> f32 {
        known(&self.open[c], || {
            let [x, y] = self.place(c);
            let solids = &scene.world.solids;
            let from = DVec3::new(x, y, scene.grid.top_at(solids, x, y) + 0.1);
            let free = |d: &&DVec3| !scene.grid.blocked(solids, &Ray::new(from, **d), SKY_REACH);
            self.directions.iter().filter(free).count() as f32 / SKY_RAYS as f32
        })
    }

    /// The share of the sky that a point sees, weighted by the cosine to the vertical.
    fn open_at(&self, scene: &Scene, p: DVec3) -> f32 {
        let (x, y) = ((p.x - self.low) / SKY_CELL, (p.y - self.low) / SKY_CELL);
        let last = (self.cells - 1) as f64;
        if !(x > 0.0 && y > 0.0 && x < last && y < last) {
            return 0.96;
        }
        let (i, j) = (x as usize, y as usize);
        let (fx, fy) = ((x - i as f64) as f32, (y - j as f64) as f32);
        let z = p.z as f32;
        let (mut sum, mut weight) = (0.0, 0.0);
        for (dj, wy) in [(0, 1.0 - fy), (1, fy)] {
            for (di, wx) in [(0, 1.0 - fx), (1, fx)] {
                let c = (j + dj) * self.cells + i + di;
                let above = z - self.height(scene, c);
                // A corner whose top is above the point does not count.
                let usable = (1.5 + above).clamp(0.0, 1.0) * wx * wy;
                if usable == 0.0 {
                    continue;
                }
                let rise = (above / 16.0).clamp(0.0, 1.0);
                let open = self.open(scene, c);
                sum += usable * (open + (1.0 - open) * rise);
                weight += usable;
            }
        }
        // The value below a crown or an eave, where no corner counts.
        let covered = 0.45;
        (sum + covered * 0.05) / (weight + 0.05)
    }
}

/// The value in a cell, found first if it is unknown.
fn known(cell: &AtomicU32, find: impl FnOnce() -> f32) -> f32 {
    match cell.load(Ordering::Relaxed) {
        UNKNOWN => {
            let value = find();
            cell.store(value.to_bits(), Ordering::Relaxed);
            value
        }
        bits => f32::from_bits(bits),
    }
}

/// Directions to the sky with a density proportional to the cosine to the vertical: a spiral on the disk, projected up.
fn sky_directions() -> [DVec3; SKY_RAYS] {
    std::array::from_fn(|k| {
        let area = (k as f64 + 0.5) / SKY_RAYS as f64;
        let (radius, turn) = (area.sqrt(), 2.399_963_229_728_653 * k as f64);
        DVec3::new(radius * libm::cos(turn), radius * libm::sin(turn), (1.0 - area).sqrt())
    })
}
