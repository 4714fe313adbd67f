//! Procedural textures: the colour of a surface at a place, averaged over the footprint of a sample. Colours are linear
//! reflectance; [`super::shade`] adds light.
//!
//! Invariants: 1. a texture depends on the surface and the place alone, never on the view; `w`, the side of the sample's
//! footprint in metres, only removes detail that is too small for the sample; 2. all arithmetic is + - * / sqrt.

use crate::base::rng::{Purpose, Stream, mix64};
use glam::Vec3;

/// Side of the lattice of random values, a power of two.
const LATTICE: usize = 256;

/// Smooth random fields on a repeating lattice.
pub(super) struct Noise {
    lattice: Vec<f32>,
}

/// The floor, computed without a rounding instruction.
#[inline(always)]
fn floor_i(x: f64) -> i64 {
    let i = x as i64;
    i - i64::from((i as f64) > x)
}

impl Noise {
    pub(super) fn new(seed: u64) -> Noise {
        let mut draws = Stream::new(seed, Purpose::City, u64::MAX, 0);
        Noise { lattice: (0..LATTICE * LATTICE).map(|_| draws.range(-1.0, 1.0) as f32).collect() }
    }

    /// Value noise in [-1, 1] with wavelength 1.
    #[inline]
    pub(super) fn value(&self, x: f64, y: f64) -> f32 {
        let (ix, iy) = (floor_i(x), floor_i(y));
        let (fx, fy) = ((x - ix as f64) as f32, (y - iy as f64) as f32);
        let (sx, sy) = (fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy));
        let mask = LATTICE - 1;
        let (x0, y0) = (ix as usize & mask, (iy as usize & mask) * LATTICE);
        let (x1, y1) = ((x0 + 1) & mask, (y0 + LATTICE) & (LATTICE * LATTICE - 1));
        let t = &self.lattice;
        let low = t[y0 + x0] + (t[y0 + x1] - t[y0 + x0]) * sx;
        let high = t[y1 + x0] + (t[y1 + x1] - t[y1 + x0]) * sx;
        low + (high - low) * sy
    }

    /// Sum of noise layers (wavelength in metres, amplitude). Layers that are short against the footprint fade out as in
    /// [`fade`].
    #[inline(always)]
    pub(super) fn layers(&self, x: f64, y: f64, w: f64, layers: &[(f64, f32)]) -> f32 {
        let mut sum = 0.0;
        let (mut a, mut b) = (x, y);
        let per_footprint = 1.0 / w;
        for &(length, amplitude) in layers {
            // Each layer is rotated by 37 degrees against the previous one, so that the lattices do not align.
            (a, b) = (0.8 * a - 0.6 * b + 17.3, 0.6 * a + 0.8 * b - 5.1);
            let keep = ((length * per_footprint - 1.0) * 0.5).clamp(0.0, 1.0) as f32;
            if keep > 0.0 {
                let frequency = 1.0 / length;
                sum += amplitude * keep * self.value(a * frequency, b * frequency);
            }
        }
        sum
    }
}

/// Visibility of a detail of this size in a footprint `w`: 1 from three footprints upwards, 0 below one.
#[inline(always)]
pub(super) fn fade(size: f64, w: f64) -> f32 {
    (((size / w) - 1.0) * 0.5).clamp(0.0, 1.0) as f32
}

/// Share of the footprint [x - w/2, x + w/2] that is in [low, high].
#[inline(always)]
pub(super) fn cover(x: f64, low: f64, high: f64, w: f64) -> f32 {
    (((x + 0.5 * w).min(high) - (x - 0.5 * w).max(low)) / w).clamp(0.0, 1.0) as f32
}

/// Share of the footprint that is on lines of this width around the multiples of `period`.
#[inline(always)]
pub(super) fn lines(x: f64, period: f64, width: f64, w: f64) -> f32 {
    if w >= period {
        return (width / period) as f32;
    }
    let d = x - period * floor_i(x / period + 0.5) as f64;
    cover(d, -0.5 * width, 0.5 * width, w)
}

/// A random number in [0, 1) for a lattice cell.
#[inline(always)]
pub(super) fn cell_draw(i: i64, j: i64, seed: u32) -> f32 {
    let key = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (j as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    (mix64(key ^ (u64::from(seed) << 17)) >> 40) as f32 * (1.0 / 16_777_216.0)
}

/// Linear reflectance of a display colour (the tone curve is a square root).
pub(super) const fn paint(r: f32, g: f32, b: f32) -> Vec3 {
    Vec3::new(r * r, g * g, b * b)
}

#[inline(always)]
fn mix(a: Vec3, b: Vec3, t: f32) -> Vec3 {
    a + (b - a) * t
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Material {
    /// Wall with a grid of windows.
    Facade,
    /// A facade with shops on the ground floor.
    ShopFacade,
    /// Glass front with mullions.
    Curtain,
    /// Plain rendered wall or concrete.
    Plain,
    /// Tiled pitched roof, some with solar panels.
    Tiles,
    /// Flat roof of bitumen sheets.
    Bitumen,
    Gravel,
    /// Sheets with standing seams.
    Metal,
    Solar,
    Leaves,
    Wood,
    CarPaint,
    CarGlass,
    /// Road and car-park surface.
    Asphalt,
    Paving,
    Grass,
    /// Gravel path or bare earth.
    Earth,
    /// Rows of plants on a field or a vegetable bed.
    Crop,
    /// Sports court: accent lines on colour.
    Court,
    Pool,
}

/// A surface: its material, its colours, and the seed of its random details.
#[derive(Debug, Clone, Copy)]
pub(super) struct Skin {
    pub(super) kind: Material,
    pub(super) color: Vec3,
    pub(super) accent: Vec3,
    pub(super) seed: u32,
}

/// The optical properties of a surface at one place.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfaceLook {
    /// Linear reflectance.
    pub(super) albedo: Vec3,
    /// Share of mirror-like reflection at grazing view, 0 to 1.
    pub(super) gloss: f32,
    /// Strength of the random tilt of the normal.
    pub(super) rough: f32,
}

/// A place on a face: metres along it, metres up it, the size of the face, and the footprint.
#[derive(Debug, Clone, Copy)]
pub(super) struct FacePlace {
    pub(super) u: f64,
    pub(super) v: f64,
    pub(super) width: f64,
    pub(super) height: f64,
    pub(super) w: f64,
}

fn matt(albedo: Vec3) -> SurfaceLook {
    SurfaceLook { albedo, gloss: 0.0, rough: 0.0 }
}

impl Skin {
    pub(super) fn look(&self, noise: &Noise, place: FacePlace) -> SurfaceLook {
        // Each surface shifts the noise, so that walls have different stains.
        let shift = f64::from(self.seed & 0xffff) * 0.37;
        let (u, v, w) = (place.u + shift, place.v, place.w);
        let speckled = |layers: &[(f64, f32)]| matt(self.color * (1.0 + noise.layers(u, v, w, layers)));
        match self.kind {
            Material::Facade | Material::ShopFacade => self.facade(noise, place, shift),
            Material::Curtain => self.curtain(noise, place, shift),
            Material::Plain => matt(self.color * (1.0 + wall_stains(noise, u, v, w))),
            Material::Tiles => self.tiles(noise, place, shift),
            Material::Bitumen => self.bitumen(noise, u, v, w),
            Material::Gravel => speckled(&[(0.3, 0.22), (0.8, 0.12), (4.0, 0.14), (0.12, 0.2)]),
            Material::Metal => self.metal(noise, u, v, w),
            Material::Solar => solar(u, v, w),
            Material::Leaves => {
                let n = noise.layers(u, v, w, &[(1.6, 0.22), (0.7, 0.30), (0.3, 0.30), (0.12, 0.25)]);
                SurfaceLook { albedo: mix(self.color, self.accent, 0.5 + n) * (0.95 + 0.9 * n), gloss: 0.0, rough: 0.7 }
            }
            Material::Wood => matt(self.color * (1.0 + noise.layers(u * 4.0, v, w, &[(0.8, 0.2), (0.3, 0.2)]))),
            Material::CarPaint => SurfaceLook { albedo: self.color, gloss: 0.35, rough: 0.0 },
            Material::CarGlass => SurfaceLook { albedo: self.color, gloss: 0.6, rough: 0.0 },
            Material::Asphalt => matt(asphalt(noise, self, u, v, w)),
            Material::Paving => matt(self.paving(noise, place.u, v, w)),
            Material::Grass => matt(self.grass(noise, u, v, w)),
            Material::Earth => speckled(&[(5.0, 0.12), (1.3, 0.12), (0.4, 0.14), (0.15, 0.14)]),
            Material::Crop => matt(self.crop(noise, u, v, w)),
            Material::Court => matt(self.court(noise, place)),
            Material::Pool => {
                let n = noise.layers(u, v, w, &[(1.4, 0.10), (0.5, 0.10)]);
                let lane = lines(place.u, 2.0, 0.18, w) * 0.25;
                SurfaceLook { albedo: self.color * (1.0 + n - lane), gloss: 0.25, rough: 0.0 }
            }
        }
    }

    fn draw(&self, k: u32) -> f32 {
        cell_draw(i64::from(k), 77, self.seed)
    }

    fn facade(&self, noise: &Noise, p: FacePlace, shift: f64) -> SurfaceLook {
        let w = p.w;
        let mut albedo = self.color * (1.0 + wall_stains(noise, p.u + shift, p.v, w));
        if self.seed & 3 == 0 {
            // Rows of bricks are 0.3 m high: aerial photos cannot resolve real ones.
            albedo *= 1.0 - 0.25 * lines(p.v, 0.3, 0.06, w);
            let row = floor_i(p.v / 0.3);
            let brick = floor_i((p.u + 0.3 * (row & 1) as f64) / 0.6);
            albedo *= 1.0 + 0.22 * (cell_draw(brick, row, self.seed) - 0.5) * fade(0.5, w);
        }
        let floors = (p.height / 3.1 + 0.5).max(1.0) as i64;
        let floor_height = p.height / floors as f64;
        let bay_wish = 2.5 + 1.2 * f64::from(self.draw(1));
        let bays = (p.width / bay_wish + 0.5).max(1.0) as i64;
        let bay = p.width / bays as f64;
        let (i, j) = (floor_i(p.u / bay), floor_i(p.v / floor_height));
        let (cu, cv) = (p.u - (i as f64 + 0.5) * bay, p.v - j as f64 * floor_height);
        let shop = self.kind == Material::ShopFacade && j == 0;
        let wide = if shop { 0.86 } else { 0.36 + 0.3 * f64::from(self.draw(2)) };
        let half = 0.5 * bay * wide;
        let (sill, head) = if shop { (0.12, 0.74) } else { (0.26, 0.26 + 0.4 + 0.12 * f64::from(self.draw(3))) };
        let (sill, head) = (sill * floor_height, head * floor_height);
        // Base course, floor bands, cornice.
        albedo *= 1.0 - 0.35 * cover(p.v, 0.0, 0.5, w);
        albedo = mix(albedo, self.accent, 0.55 * lines(p.v, floor_height, 0.22, w));
        albedo = mix(albedo, self.accent, cover(p.v, p.height - 0.45, p.height, w));
        if shop {
            let sign = cover(cv, head + 0.1, floor_height - 0.15, w);
            let tone = cell_draw(i / 2, 5, self.seed);
            albedo = mix(albedo, SHOP_SIGNS[((tone * 5.0) as usize).min(4)], sign);
        }
        let frame = cover(cu, -half - 0.12, half + 0.12, w) * cover(cv, sill - 0.2, head + 0.12, w);
        albedo = mix(albedo, mix(self.accent, Vec3::splat(0.75), 0.5), frame);
        let glass = cover(cu, -half, half, w) * cover(cv, sill, head, w);
        let glass = glass * (1.0 - lines(cu, half, 0.1, w) * 0.7);
        let lit = cell_draw(i, j, self.seed ^ 0x55);
        let pane = if lit > 0.72 { paint(0.62, 0.6, 0.54) } else { paint(0.16, 0.19, 0.24) * (0.6 + lit) };
        // A blind covers the upper part of a dark pane.
        let blind = cover(cv, head - f64::from(cell_draw(j, i, self.seed)) * (head - sill) * 0.8, head, w);
        let pane = mix(pane, paint(0.66, 0.64, 0.6), if lit < 0.35 { blind } else { 0.0 });
        SurfaceLook { albedo: mix(albedo, pane, glass), gloss: 0.55 * glass, rough: 0.0 }
    }

    fn curtain(&self, noise: &Noise, p: FacePlace, shift: f64) -> SurfaceLook {
        let w = p.w;
        let floors = (p.height / 3.5 + 0.5).max(1.0) as i64;
        let (floor_height, bays) = (p.height / floors as f64, (p.width / 1.6 + 0.5).max(1.0));
        let bay = p.width / (bays as i64) as f64;
        let (i, j) = (floor_i(p.u / bay), floor_i(p.v / floor_height));
        let cv = p.v - j as f64 * floor_height;
        let tint = cell_draw(i, j, self.seed);
        let mut pane = self.color * (0.75 + 0.5 * tint * fade(bay, w) + 0.25 * (1.0 - fade(bay, w)));
        if tint > 0.85 {
            pane = mix(pane, paint(0.55, 0.55, 0.52), 0.6 * fade(bay, w));
        }
        pane *= 1.0 + 0.3 * noise.layers(p.u + shift, p.v, w, &[(9.0, 0.5), (3.0, 0.3)]);
        let spandrel = cover(cv, 0.0, 0.9, w);
        let albedo = mix(pane, self.accent * 0.55, spandrel);
        let grid = lines(p.u, bay, 0.16, w).max(lines(p.v, floor_height, 0.2, w));
        SurfaceLook { albedo: mix(albedo, self.accent, grid), gloss: 0.8 * (1.0 - spandrel) * (1.0 - grid), rough: 0.0 }
    }

    fn tiles(&self, noise: &Noise, p: FacePlace, shift: f64) -> SurfaceLook {
        let (u, v, w) = (p.u + shift, p.v, p.w);
        let row = floor_i(v / 0.42);
        let tile = floor_i(u / 0.5);
        let own = cell_draw(tile, row, self.seed) - 0.5;
        let mut albedo = self.color * (1.0 + 0.42 * own * fade(0.45, w));
        albedo *= 1.0 - 0.35 * lines(v, 0.42, 0.1, w);
        let n = noise.layers(u, v * 0.35, w, &[(5.0, 0.14), (1.5, 0.16), (0.5, 0.12), (0.2, 0.1)]);
        albedo *= 1.0 + n;
        // Moss grows near the eaves, in places chosen by the coarse noise.
        let moss = (noise.layers(u, v, w, &[(3.0, 0.7), (0.8, 0.4)]) - 0.35 - 0.06 * v as f32).clamp(0.0, 0.6);
        albedo = mix(albedo, paint(0.36, 0.38, 0.26), moss);
        albedo = mix(albedo, self.accent, cover(v, p.height - 0.25, p.height + 1.0, w));
        if self.seed.is_multiple_of(5) && p.width > 6.0 {
            let (low, high) = (p.width * 0.2, p.width * 0.2 + 1.0 * (p.width * 0.55).max(2.0));
            let on = cover(p.u, low, high, w) * cover(v, p.height * 0.25, p.height * 0.8, w);
            let panel = solar(p.u - low, v - p.height * 0.25, w);
            return SurfaceLook { albedo: mix(albedo, panel.albedo, on), gloss: panel.gloss * on, rough: 0.0 };
        }
        SurfaceLook { albedo, gloss: 0.04, rough: 0.0 }
    }

    fn bitumen(&self, noise: &Noise, u: f64, v: f64, w: f64) -> SurfaceLook {
        let sheet = floor_i(u / 2.2);
        let mut albedo = self.color * (1.0 + 0.24 * (cell_draw(sheet, floor_i(v / 7.0), self.seed) - 0.5));
        albedo *= 1.0 + noise.layers(u, v, w, &[(6.0, 0.22), (2.0, 0.16), (0.6, 0.12), (0.2, 0.12)]);
        albedo *= 1.0 - 0.35 * lines(u, 2.2, 0.12, w) - 0.3 * lines(v, 7.0, 0.12, w);
        let puddle = (noise.layers(u + 40.0, v, w, &[(7.0, 1.0), (1.8, 0.35)]) * 3.0 - 1.6).clamp(0.0, 1.0);
        SurfaceLook { albedo: albedo * (1.0 - 0.4 * puddle), gloss: 0.03 + 0.2 * puddle, rough: 0.0 }
    }

    fn metal(&self, noise: &Noise, u: f64, v: f64, w: f64) -> SurfaceLook {
        let sheet = floor_i(u / 0.9);
        let mut albedo = self.color * (1.0 + 0.16 * (cell_draw(sheet, 0, self.seed) - 0.5) * fade(0.9, w));
        albedo *= 1.0 - 0.3 * lines(u, 0.9, 0.12, w);
        albedo *= 1.0 + noise.layers(u, v * 0.3, w, &[(4.0, 0.12), (1.0, 0.1), (0.3, 0.08)]);
        let rust = (noise.layers(u, v * 0.2, w, &[(2.5, 0.8), (0.7, 0.4)]) - 0.55).clamp(0.0, 0.5);
        SurfaceLook { albedo: mix(albedo, paint(0.45, 0.3, 0.2), rust), gloss: 0.22, rough: 0.0 }
    }

    fn paving(&self, noise: &Noise, u: f64, v: f64, w: f64) -> Vec3 {
        let size = if self.seed & 1 == 0 { 1.25 } else { 2.0 };
        let (i, j) = (floor_i(u / size), floor_i(v / size));
        let mut albedo = self.color * (1.0 + 0.26 * (cell_draw(i, j, self.seed) - 0.5) * fade(size, w));
        if (i + j) & 3 == 0 {
            albedo = mix(albedo, self.accent, 0.35 * fade(size, w));
        }
        albedo *= 1.0 - 0.3 * lines(u, size, 0.08, w) - 0.3 * lines(v, size, 0.08, w);
        albedo * (1.0 + noise.layers(u, v, w, &[(7.0, 0.14), (1.8, 0.12), (0.5, 0.1), (0.18, 0.1)]))
    }

    fn grass(&self, noise: &Noise, u: f64, v: f64, w: f64) -> Vec3 {
        let dry = noise.layers(u, v, w, &[(11.0, 0.35), (3.2, 0.3), (0.9, 0.2)]);
        let mut albedo = mix(self.color, self.accent, (0.35 + dry).clamp(0.0, 1.0));
        if self.seed & 1 == 0 {
            albedo *= 1.0 + 0.16 * (lines(u, 3.0, 1.5, w) - 0.5);
        }
        let bare = (noise.layers(u + 9.0, v, w, &[(4.0, 0.9), (1.1, 0.4)]) - 0.72).clamp(0.0, 0.8);
        albedo = mix(albedo, paint(0.5, 0.42, 0.32), bare);
        albedo * (1.0 + noise.layers(u, v, w, &[(0.9, 0.14), (0.4, 0.2), (0.15, 0.24)]))
    }

    fn crop(&self, noise: &Noise, u: f64, v: f64, w: f64) -> Vec3 {
        let (along, across) = if self.seed & 1 == 0 { (u, v) } else { (v, u) };
        let bend = 0.4 * f64::from(noise.value(along / 13.0, across / 13.0));
        let row = lines(across + bend, 1.1, 0.6, w);
        let mut albedo = mix(self.accent, self.color, row);
        albedo *= 1.0 - 0.35 * lines(across + bend, 11.0, 0.7, w);
        albedo * (1.0 + noise.layers(u, v, w, &[(18.0, 0.2), (5.0, 0.16), (1.5, 0.16), (0.5, 0.14), (0.2, 0.12)]))
    }

    fn court(&self, noise: &Noise, p: FacePlace) -> Vec3 {
        let w = p.w;
        let border = 1.0 - cover(p.u, 0.9, p.width - 0.9, w) * cover(p.v, 0.9, p.height - 0.9, w);
        let inner = cover(p.u, 1.02, p.width - 1.02, w) * cover(p.v, 1.02, p.height - 1.02, w);
        let line = (1.0 - border - inner).max(0.0)
            + cover(p.u, 0.5 * p.width - 0.06, 0.5 * p.width + 0.06, w)
            + cover(p.v, 0.5 * p.height - 0.06, 0.5 * p.height + 0.06, w) * inner;
        let n = noise.layers(p.u, p.v, w, &[(4.0, 0.1), (1.0, 0.1), (0.3, 0.12)]);
        let albedo = mix(self.color, self.accent, border) * (1.0 + n);
        mix(albedo, Vec3::splat(0.7), line.min(1.0))
    }
}

fn wall_stains(noise: &Noise, u: f64, v: f64, w: f64) -> f32 {
    let streaks = noise.layers(u, v * 0.18, w, &[(1.2, 0.09), (0.45, 0.08)]);
    streaks + noise.layers(u, v, w, &[(6.0, 0.08), (1.7, 0.06), (0.35, 0.07), (0.14, 0.06)])
}

const SHOP_SIGNS: [Vec3; 5] = [
    paint(0.66, 0.18, 0.16),
    paint(0.16, 0.32, 0.55),
    paint(0.15, 0.42, 0.28),
    paint(0.82, 0.66, 0.22),
    paint(0.82, 0.8, 0.76),
];

fn solar(u: f64, v: f64, w: f64) -> SurfaceLook {
    let frame = lines(u, 1.05, 0.09, w).max(lines(v, 1.7, 0.09, w));
    let cells = 0.4 * lines(u, 0.35, 0.04, w).max(lines(v, 0.34, 0.04, w));
    let albedo = mix(paint(0.09, 0.12, 0.24), paint(0.6, 0.62, 0.65), frame.max(cells * 0.6));
    SurfaceLook { albedo, gloss: 0.5, rough: 0.0 }
}

/// Asphalt with patches, cracks and stains. The ground plan adds road markings.
pub(super) fn asphalt(noise: &Noise, skin: &Skin, x: f64, y: f64, w: f64) -> Vec3 {
    let mut albedo = skin.color;
    albedo *= 1.0 + noise.layers(x, y, w, &[(21.0, 0.16), (4.0, 0.12), (1.1, 0.1), (0.4, 0.12), (0.15, 0.16)]);
    // One cell in five has a rectangular patch.
    let (i, j) = (floor_i(x / 9.0), floor_i(y / 9.0));
    let own = cell_draw(i, j, skin.seed ^ 0x31);
    if own < 0.2 {
        let (dx, dy) = (x - 9.0 * i as f64, y - 9.0 * j as f64);
        let size = 1.5 + 22.0 * f64::from(own);
        let on = cover(dx, 1.5, 1.5 + size, w) * cover(dy, 2.5, 2.5 + size * 0.6, w);
        albedo *= 1.0 - on * (0.34 - 2.4 * (own - 0.1).abs());
    }
    // Cracks follow the zero crossings of smooth noise.
    let n = noise.value(x / 3.7 + 3.1, y / 3.7) + 0.35 * noise.value(x / 0.9, y / 0.9);
    let crack = (1.0 - n.abs() * 22.0).max(0.0) * fade(0.28, w);
    albedo * (1.0 - 0.45 * crack)
}
