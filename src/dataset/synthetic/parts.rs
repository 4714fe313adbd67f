//! Parts of the city, made of solids: houses, flats, offices, trees, cars, lamps.
//!
//! Invariant: a part takes its random draws from the stream of its plot or street, in the order of construction.

use super::texture::{Material, Skin, paint};
use super::trace::{Shape, Solid};
use crate::base::rng::Stream;
use glam::{DVec3, Vec3};

/// The solids of one plot or street, and its stream of random draws.
pub(super) struct Parts {
    pub(super) draws: Stream,
    pub(super) solids: Vec<Solid>,
}

/// A surface with a seed of its own.
pub(super) fn skin(parts: &mut Parts, kind: Material, color: Vec3, accent: Vec3) -> Skin {
    Skin { kind, color, accent, seed: parts.draws.next_u64() as u32 }
}

pub(super) fn grass(parts: &mut Parts) -> Skin {
    let green = parts.draws.range(0.0, 0.06) as f32;
    skin(parts, Material::Grass, paint(0.38 + green, 0.48, 0.25), paint(0.5 + green, 0.53, 0.3))
}

/// Cosine and sine of an angle.
type Turn = (f64, f64);

const AXIS: Turn = (1.0, 0.0);
const QUARTER: Turn = (0.0, 1.0);

fn turn_by(angle: f64) -> Turn {
    (libm::cos(angle), libm::sin(angle))
}

/// The place at these distances from `at`, in directions turned by `turn`.
fn beside(at: DVec3, turn: Turn, along: f64, across: f64, up: f64) -> DVec3 {
    at + DVec3::new(turn.0 * along - turn.1 * across, turn.1 * along + turn.0 * across, up)
}

fn above(at: DVec3, up: f64) -> DVec3 {
    at + DVec3::new(0.0, 0.0, up)
}

const WALLS: [Vec3; 9] = [
    paint(0.88, 0.85, 0.78),
    paint(0.84, 0.76, 0.62),
    paint(0.8, 0.68, 0.52),
    paint(0.66, 0.42, 0.34),
    paint(0.74, 0.73, 0.7),
    paint(0.86, 0.82, 0.66),
    paint(0.6, 0.52, 0.46),
    paint(0.7, 0.55, 0.47),
    paint(0.72, 0.76, 0.74),
];
const TILES: [Vec3; 5] = [
    paint(0.66, 0.38, 0.29),
    paint(0.58, 0.34, 0.27),
    paint(0.45, 0.42, 0.42),
    paint(0.52, 0.38, 0.3),
    paint(0.36, 0.37, 0.4),
];
const CARS: [Vec3; 8] = [
    paint(0.86, 0.86, 0.86),
    paint(0.2, 0.2, 0.22),
    paint(0.58, 0.6, 0.62),
    paint(0.62, 0.14, 0.13),
    paint(0.18, 0.28, 0.5),
    paint(0.42, 0.44, 0.46),
    paint(0.8, 0.76, 0.66),
    paint(0.22, 0.38, 0.32),
];
const CROWNS: [(Vec3, Vec3); 5] = [
    (paint(0.25, 0.36, 0.17), paint(0.4, 0.5, 0.24)),
    (paint(0.3, 0.4, 0.18), paint(0.48, 0.55, 0.27)),
    (paint(0.22, 0.33, 0.2), paint(0.34, 0.45, 0.26)),
    (paint(0.36, 0.4, 0.19), paint(0.56, 0.55, 0.28)),
    (paint(0.42, 0.34, 0.2), paint(0.6, 0.46, 0.25)),
];

impl Parts {
    pub(super) fn new(draws: Stream) -> Parts {
        Parts { draws, solids: Vec::new() }
    }

    fn pick<T: Copy>(&mut self, items: &[T]) -> T {
        items[self.draws.below(items.len() as u64) as usize]
    }

    fn block(&mut self, at: DVec3, half: (f64, f64), height: f64, turn: Turn, side: Skin, top: Skin) {
        let shape = Shape::Block { half_x: half.0, half_y: half.1, height };
        self.solids.push(Solid::new(shape, at, turn, side, top));
    }

    /// A roof with its ridge along x, hipped if `run` > 0.
    fn roof(&mut self, at: DVec3, half: (f64, f64), (height, run): (f64, f64), turn: Turn, side: Skin, top: Skin) {
        let shape = Shape::Roof { half_x: half.0, half_y: half.1, height, run, cap: 100.0 };
        self.solids.push(Solid::new(shape, at, turn, side, top));
    }

    /// Leaves in the colours of a random kind of tree.
    pub(super) fn leaf_skin(&mut self) -> Skin {
        let (color, accent) = self.pick(&CROWNS[..3]);
        skin(self, Material::Leaves, color, accent)
    }

    pub(super) fn hedge(&mut self, at: DVec3, half_x: f64, half_y: f64, leaves: Skin) {
        let height = self.draws.range(1.2, 1.7);
        self.block(at, (half_x, half_y), height, AXIS, leaves, leaves);
    }

    /// A house with a gabled or hipped roof, a chimney, sometimes a dormer.
    pub(super) fn house(&mut self, at: DVec3, half_x: f64, half_y: f64, turn: f64) {
        let turn = turn_by(turn);
        let height = if self.draws.uniform() < 0.6 { 5.6 } else { 3.4 } + self.draws.range(-0.2, 0.3);
        let wall_color = self.pick(&WALLS);
        let trim = self.pick(&[paint(0.9, 0.88, 0.84), paint(0.5, 0.4, 0.32), paint(0.8, 0.78, 0.72)]);
        let wall = skin(self, Material::Facade, wall_color, trim);
        let tile_color = self.pick(&TILES);
        let tiles = skin(self, Material::Tiles, tile_color, tile_color * 0.8);
        self.block(at, (half_x, half_y), height, turn, wall, tiles);
        // The ridge runs along the longer side.
        let (roof_turn, long, wide) =
            if half_x >= half_y { (turn, half_x, half_y) } else { ((-turn.1, turn.0), half_y, half_x) };
        let rise = wide * self.draws.range(0.62, 0.85);
        let run = if self.draws.uniform() < 0.35 { wide } else { 0.0 };
        let gable = Skin { kind: Material::Plain, ..wall };
        self.roof(above(at, height), (long + 0.45, wide + 0.45), (rise, run), roof_turn, gable, tiles);
        let brick = skin(self, Material::Plain, paint(0.56, 0.36, 0.3), paint(0.5, 0.5, 0.5));
        let (cx, cy) = (self.draws.range(-0.5, 0.5) * long, self.draws.range(0.15, 0.35) * wide);
        self.block(beside(at, roof_turn, cx, cy, height), (0.4, 0.4), rise + 0.7, turn, brick, brick);
        if run == 0.0 && self.draws.uniform() < 0.45 {
            // A dormer: a small house across the ridge.
            let place = above(at, height + 0.35 * rise);
            let across = (-roof_turn.1, roof_turn.0);
            self.block(place - DVec3::Z, (wide * 0.74, 1.1), 1.0, across, wall, tiles);
            self.roof(place, (wide * 0.8, 1.3), (0.9, 0.0), across, gable, tiles);
        }
    }

    pub(super) fn shed(&mut self, at: DVec3) {
        let wood = skin(self, Material::Wood, paint(0.52, 0.4, 0.3), paint(0.5, 0.4, 0.3));
        let roof_color = self.pick(&TILES);
        let roof = skin(self, Material::Metal, roof_color, roof_color);
        self.block(at, (1.5, 1.3), 2.1, AXIS, wood, roof);
        self.roof(above(at, 2.1), (1.7, 1.5), (0.8, 0.0), AXIS, wood, roof);
    }

    pub(super) fn barn(&mut self, at: DVec3, turn: f64) {
        let turn = turn_by(turn);
        let wall = skin(self, Material::Wood, paint(0.55, 0.36, 0.28), paint(0.5, 0.4, 0.3));
        let roof = skin(self, Material::Metal, paint(0.6, 0.58, 0.56), paint(0.5, 0.5, 0.5));
        let (long, wide) = (self.draws.range(8.0, 10.5), self.draws.range(4.5, 6.0));
        self.block(at, (long, wide), 4.2, turn, wall, roof);
        self.roof(above(at, 4.2), (long + 0.5, wide + 0.5), (2.6, 0.0), turn, wall, roof);
    }

    /// A row of flats of half length `half_long`; `along_y` turns it.
    pub(super) fn flats(&mut self, at: DVec3, half_long: f64, half_deep: f64, along_y: bool) {
        let turn = if along_y { QUARTER } else { AXIS };
        // A long row is several houses side by side.
        let houses = ((half_long / 8.0 + 0.5) as u32).max(1);
        let part = half_long / f64::from(houses);
        let floors = self.draws.range(3.0, 6.0);
        let pitched = self.draws.uniform() < 0.6;
        for k in 0..houses {
            let along = (f64::from(2 * k + 1) - f64::from(houses)) * part;
            let place = beside(at, turn, along, 0.0, 0.0);
            let height = (floors + self.draws.range(-0.6, 0.9)).floor() * 3.1 + 0.5;
            let wall_color = self.pick(&WALLS);
            let trim = self.pick(&[paint(0.86, 0.84, 0.8), paint(0.66, 0.62, 0.56), paint(0.56, 0.46, 0.4)]);
            let kind = if self.draws.uniform() < 0.35 { Material::ShopFacade } else { Material::Facade };
            let wall = skin(self, kind, wall_color, trim);
            if pitched {
                let tile_color = self.pick(&TILES);
                let tiles = skin(self, Material::Tiles, tile_color, tile_color * 0.8);
                self.block(place, (part, half_deep), height, turn, wall, tiles);
                let rise = half_deep * 0.62;
                let gable = Skin { kind: Material::Plain, ..wall };
                self.roof(above(place, height), (part, half_deep + 0.5), (rise, 0.0), turn, gable, tiles);
                let brick = skin(self, Material::Plain, paint(0.56, 0.38, 0.32), paint(0.5, 0.5, 0.5));
                let side = self.draws.range(0.3, 0.6) * part;
                self.block(beside(place, turn, side, 0.0, height), (0.5, 0.8), rise + 0.9, turn, brick, brick);
            } else {
                self.flat_roofed(place, (part, half_deep), height, turn, wall);
            }
            self.balconies(place, (part, half_deep), height, turn);
        }
    }

    /// Balconies on the two long sides of a part of a row.
    fn balconies(&mut self, at: DVec3, half: (f64, f64), height: f64, turn: Turn) {
        if self.draws.uniform() < 0.5 {
            return;
        }
        let slab = skin(self, Material::Plain, paint(0.76, 0.75, 0.72), paint(0.7, 0.7, 0.7));
        let floors = (height / 3.1) as u32;
        for side in [-1.0, 1.0] {
            for floor in 1..floors {
                let along = 0.45 * half.0;
                for along in [-along, along] {
                    let place = beside(at, turn, along, side * (half.1 + 0.6), f64::from(floor) * 3.1 - 0.1);
                    self.block(place, (1.5, 0.6), 1.1, turn, slab, slab);
                }
            }
        }
    }

    /// A building with a parapet, and with stairs, machines and solar panels on its flat roof.
    fn flat_roofed(&mut self, at: DVec3, half: (f64, f64), height: f64, turn: Turn, wall: Skin) {
        let kind = self.pick(&[Material::Bitumen, Material::Gravel, Material::Bitumen, Material::Grass]);
        let color = match kind {
            Material::Gravel => self.pick(&[paint(0.64, 0.61, 0.56), paint(0.56, 0.54, 0.52)]),
            Material::Grass => paint(0.42, 0.46, 0.28),
            _ => self.pick(&[paint(0.42, 0.42, 0.43), paint(0.6, 0.6, 0.6), paint(0.5, 0.46, 0.43)]),
        };
        let roof = skin(self, kind, color, paint(0.55, 0.5, 0.36));
        self.block(at, half, height, turn, wall, roof);
        let rim = skin(self, Material::Plain, wall.accent.lerp(Vec3::splat(0.4), 0.5), wall.accent);
        let put = |along: f64, across: f64, up: f64| beside(at, turn, along, across, up);
        for side in [-1.0, 1.0] {
            self.block(put(0.0, side * (half.1 - 0.2), height), (half.0, 0.2), 0.6, turn, rim, rim);
            let end = (0.2, half.1 - 0.4);
            self.block(put(side * (half.0 - 0.2), 0.0, height), end, 0.6, turn, rim, rim);
        }
        let grey = skin(self, Material::Plain, paint(0.7, 0.7, 0.68), paint(0.6, 0.6, 0.6));
        let stair = self.draws.range(-0.5, 0.5) * half.0;
        self.block(put(stair, 0.35 * half.1, height), (1.7, 1.5), 2.5, turn, grey, roof);
        let metal = skin(self, Material::Metal, paint(0.74, 0.75, 0.76), paint(0.6, 0.6, 0.6));
        for _ in 0..2 + self.draws.below(4) {
            let d = &mut self.draws;
            let (along, across) = (d.range(-0.75, 0.75) * half.0, d.range(-0.7, 0.0) * half.1);
            let (size, tall) = ((d.range(0.5, 1.2), d.range(0.5, 0.9)), d.range(0.7, 1.5));
            self.block(put(along, across, height), size, tall, turn, metal, metal);
        }
        if kind != Material::Grass && half.1 > 5.0 && self.draws.uniform() < 0.45 {
            let panel = skin(self, Material::Solar, paint(0.1, 0.12, 0.2), paint(0.5, 0.5, 0.5));
            for k in 0..3 {
                let across = -0.1 * half.1 - f64::from(k) * 2.2;
                let shape = Shape::Roof { half_x: 0.5 * half.0, half_y: 0.85, height: 1.0, run: 0.0, cap: 0.8 };
                let place = put(-stair.signum() * 0.3 * half.0, across, height);
                self.solids.push(Solid::new(shape, place, turn, grey, panel));
            }
        }
    }

    /// An office building, sometimes with a smaller upper part.
    pub(super) fn office(&mut self, at: DVec3, half_x: f64, half_y: f64, height: f64) {
        let wall = if self.draws.uniform() < 0.45 {
            let glass = self.pick(&[
                paint(0.24, 0.34, 0.42),
                paint(0.3, 0.38, 0.4),
                paint(0.2, 0.26, 0.34),
                paint(0.34, 0.36, 0.38),
            ]);
            let frame = self.pick(&[paint(0.72, 0.73, 0.74), paint(0.4, 0.41, 0.43), paint(0.8, 0.77, 0.7)]);
            skin(self, Material::Curtain, glass, frame)
        } else {
            let color = self.pick(&WALLS);
            skin(self, Material::ShopFacade, color, paint(0.8, 0.79, 0.76))
        };
        self.flat_roofed(at, (half_x, half_y), height, AXIS, wall);
        if height > 20.0 && self.draws.uniform() < 0.5 {
            let upper = (half_x * 0.55, half_y * 0.55);
            let more = if self.draws.uniform() < 0.5 { 6.6 } else { 9.9 };
            let raised = at + DVec3::new(0.2 * half_x, -0.2 * half_y, height);
            self.block(raised, upper, more, AXIS, Skin { seed: wall.seed ^ 1, ..wall }, wall);
            let roof = skin(self, Material::Gravel, paint(0.58, 0.56, 0.54), paint(0.5, 0.5, 0.5));
            self.block(above(raised, more), upper, 0.3, AXIS, roof, roof);
        }
    }

    /// A broad-leaved or needle tree; `size` 1 is about 8 m tall.
    pub(super) fn tree(&mut self, at: DVec3, size: f64) {
        let bark = skin(self, Material::Wood, paint(0.36, 0.29, 0.23), paint(0.3, 0.25, 0.2));
        self.block(at, (0.16 * size, 0.16 * size), 3.0 * size, AXIS, bark, bark);
        if self.draws.uniform() < 0.16 {
            let needles = skin(self, Material::Leaves, paint(0.18, 0.29, 0.2), paint(0.28, 0.38, 0.26));
            for k in 0..4 {
                let share = 1.0 - 0.22 * f64::from(k);
                let turn = turn_by(self.draws.range(0.0, 1.5));
                let (half, height) = (2.1 * size * share, 3.2 * size * share.max(0.5));
                let place = above(at, size * (1.2 + 1.7 * f64::from(k)));
                self.roof(place, (half, half), (height, half), turn, needles, needles);
            }
            return;
        }
        let (color, accent) = self.pick(&CROWNS);
        let clumps = 8 + self.draws.below(5);
        for k in 0..clumps {
            // Every clump has its own tone, so that a crown looks leafy from far away.
            let tone = self.draws.range(0.75, 1.25) as f32;
            let leaves = skin(self, Material::Leaves, color * tone, accent * tone);
            let d = &mut self.draws;
            let turn = 2.399_963 * k as f64 + d.range(-0.4, 0.4);
            let level = (k as f64 + 0.5) / clumps as f64;
            let out = size * 2.1 * (1.0 - level * level).sqrt() * d.range(0.65, 1.0);
            let up = size * (3.2 + 3.6 * level) + d.range(-0.2, 0.2);
            let radius = size * (1.35 - 0.35 * level) * d.range(0.85, 1.15);
            let radii = DVec3::new(radius, radius * d.range(0.85, 1.1), radius * d.range(0.75, 0.95));
            let place = at + DVec3::new(out * libm::cos(turn), out * libm::sin(turn), up);
            self.solids.push(Solid::new(Shape::Ellipsoid { radii }, place, turn_by(turn), leaves, leaves));
        }
    }

    /// A car or van, its length along y when `along_y`.
    pub(super) fn car(&mut self, at: DVec3, along_y: bool) {
        let turn = if along_y { QUARTER } else { AXIS };
        let color = self.pick(&CARS);
        let paint_skin = skin(self, Material::CarPaint, color, color);
        let glass = skin(self, Material::CarGlass, paint(0.14, 0.16, 0.19), color);
        let van = self.draws.uniform() < 0.14;
        let long = self.draws.range(1.95, 2.3);
        let body_height = if van { 1.75 } else { 0.62 };
        self.block(above(at, 0.3), (long, 0.9), body_height, turn, paint_skin, paint_skin);
        let tyre = skin(self, Material::Plain, paint(0.12, 0.12, 0.12), paint(0.1, 0.1, 0.1));
        self.block(at, (long * 0.82, 0.86), 0.35, turn, tyre, tyre);
        if van {
            return;
        }
        let back = if self.draws.uniform() < 0.5 { 0.25 } else { -0.25 };
        let shape = Shape::Roof { half_x: long * 0.66, half_y: 0.86, height: 2.6, run: 2.2, cap: 0.58 };
        // The slopes of the cabin are its windows; a block on its cut top is the roof.
        self.solids.push(Solid::new(shape, beside(at, turn, back, 0.0, 0.92), turn, glass, glass));
        let lid = (long * 0.66 - 0.46, 0.68);
        self.block(beside(at, turn, back, 0.0, 1.48), lid, 0.06, turn, paint_skin, paint_skin);
    }

    pub(super) fn lamp(&mut self, at: DVec3) {
        let metal = skin(self, Material::Plain, paint(0.5, 0.51, 0.52), paint(0.5, 0.5, 0.5));
        self.block(at, (0.09, 0.09), 6.0, AXIS, metal, metal);
        self.block(above(at, 6.0), (0.45, 0.45), 0.15, AXIS, metal, metal);
    }
}
