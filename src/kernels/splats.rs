//! Footprints packed for the tile loops: one cache line for each visible row, in depth order, and the tile grid.
//!
//! Invariants: 1. `rank` is the place of a row in depth order, and [`Splat`]s are indexed by it; 2. the exponent of a
//! splat is kept to base 2 with its opacity folded in: `e = a dx^2 + b dx dy + c dy^2 + log2_opacity`, so that
//! `alpha = 2^e`; 3. [`Splat::reach`] bounds the rounding of the tile loops: where the exact form falls more than
//! `reach` below `log2_opacity`, the loops compute an alpha below 1/255 whatever the order of their operations.

use super::constants::TILE;
use super::project_fwd::Projected;
use rayon::prelude::*;

/// log2 of [`super::constants::ALPHA_MIN`], the threshold that the tile loops compare the exponent with.
pub const LOG2_ALPHA_MIN: f32 = -7.994_353_4;

/// The tiles of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Grid {
    /// Image width, pixels; at most [`Grid::SIDE_MAX`].
    pub width: u32,
    /// Image height, pixels; at most [`Grid::SIDE_MAX`].
    pub height: u32,
    /// Tile columns.
    pub tiles_x: u32,
    /// Tile rows.
    pub tiles_y: u32,
}

impl Grid {
    /// Largest side of an image: tile numbers must fit 24 bits.
    pub const SIDE_MAX: u32 = 65_520;

    /// The grid of a `width` x `height` image.
    pub fn new(width: u32, height: u32) -> Self {
        Grid { width, height, tiles_x: width.div_ceil(TILE), tiles_y: height.div_ceil(TILE) }
    }

    /// Number of tiles; tiles are numbered row by row.
    pub fn tiles(&self) -> usize {
        self.tiles_x as usize * self.tiles_y as usize
    }

    /// Column and row of a tile.
    pub fn position(&self, tile: usize) -> (u32, u32) {
        (tile as u32 % self.tiles_x, tile as u32 / self.tiles_x)
    }
}

/// One visible row as the tile loops read it.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub struct Splat {
    /// Pixel position of the mean.
    pub mean: [f32; 2],
    /// Coefficient of dx^2 in the exponent: -log2(e)/2 times the conic's xx.
    pub a: f32,
    /// Coefficient of dx dy: -log2(e) times the conic's xy.
    pub b: f32,
    /// Coefficient of dy^2: -log2(e)/2 times the conic's yy.
    pub c: f32,
    /// log2 of the opacity.
    pub log2_opacity: f32,
    /// Colour.
    pub color: [f32; 3],
    /// How far the exponent may fall before no contribution is possible; negative when none is possible at all.
    pub reach: f32,
    /// First tile column, first tile row, one past the last column, one past the last row of the box.
    pub tiles: [u16; 4],
}

/// Packs the rows in `order` into `splats`. `colors` has one entry per row.
pub fn pack(order: &[u32], projected: &Projected, colors: &[[f32; 3]], grid: Grid, splats: &mut Vec<Splat>) {
    splats.resize(order.len(), Splat::default());
    splats.par_iter_mut().with_min_len(1024).zip(order).for_each(|(splat, &row)| {
        *splat = pack_row(row as usize, projected, colors, grid);
    });
}

fn pack_row(row: usize, projected: &Projected, colors: &[[f32; 3]], grid: Grid) -> Splat {
    const LOG2E: f32 = std::f32::consts::LOG2_E;
    let [mx, my] = projected.means2d[row];
    let [xx, xy, yy] = projected.conics[row];
    let [rx, ry] = projected.radii[row].map(|r| r as f32);
    let log2_opacity = libm::log2f(projected.opacities[row]);
    let (a, b, c) = (-0.5 * LOG2E * xx, -LOG2E * xy, -0.5 * LOG2E * yy);
    // A tile of the box is at most its side beyond the radius. The exponent takes some six roundings of terms no
    // larger than |a| dx^2 + |c| dy^2 in sum twice (|b dx dy| is below that sum): 12 x 6e-8 of it, doubled for safety.
    let (dx, dy) = (rx + TILE as f32 + 1.0, ry + TILE as f32 + 1.0);
    let rounding = 2e-6 * (a.abs() * dx * dx + c.abs() * dy * dy) + 1e-4;
    Splat {
        mean: [mx, my],
        a,
        b,
        c,
        log2_opacity,
        color: colors[row],
        reach: log2_opacity - LOG2_ALPHA_MIN + rounding,
        tiles: [
            tile_from_pixel((mx - rx).floor(), grid.tiles_x, false),
            tile_from_pixel((my - ry).floor(), grid.tiles_y, false),
            tile_from_pixel((mx + rx).ceil(), grid.tiles_x, true),
            tile_from_pixel((my + ry).ceil(), grid.tiles_y, true),
        ],
    }
}

/// The tile that holds a pixel coordinate (rounded up for the end of a range), clamped to the grid.
fn tile_from_pixel(pixel: f32, tiles: u32, end: bool) -> u16 {
    let tile = pixel / TILE as f32;
    let tile = if end { tile.ceil() } else { tile.floor() };
    tile.clamp(0.0, tiles as f32) as u16
}

/// Where a splat can reach inside a slab of pixel columns.
#[derive(Debug, Clone, Copy)]
pub struct Reach {
    mean: [f32; 2],
    /// Half extents of the ellipse.
    half: [f32; 2],
    /// dx of the topmost point is `-tilt`, of the lowest `+tilt`.
    tilt: f32,
    /// Coefficients of the half chord: sqrt(chord0 - chord1 dx^2).
    chord: [f32; 2],
    /// dy of the chord's middle is `slope * dx`.
    slope: f32,
    pad: f32,
    /// The form is not a proper ellipse: everything counts as reached.
    all: bool,
}

impl Splat {
    /// The ellipse on which the exponent has fallen by [`Splat::reach`].
    ///
    /// With P = -a, Q = -b/2, R = -c the ellipse is P dx^2 + 2 Q dx dy + R dy^2 = reach; det = P R - Q^2 is formed in
    /// f64, where the products of two f32 are exact, because it cancels for needles.
    #[inline(always)]
    pub fn ellipse(&self) -> Reach {
        let (p, q, r) = (-f64::from(self.a), -0.5 * f64::from(self.b), -f64::from(self.c));
        let det = (p * r - q * q) as f32;
        let (p, q, r) = (p as f32, q as f32, r as f32);
        let half_y = (self.reach * p / det).sqrt();
        let half_x = (self.reach * r / det).sqrt();
        let proper = det > 0.0 && p > 0.0 && r > 0.0 && (half_x + half_y + self.mean[0] + self.mean[1]).is_finite();
        Reach {
            mean: self.mean,
            half: [half_x, half_y],
            tilt: q / p * half_y,
            chord: [self.reach / r, det / (r * r)],
            slope: -q / r,
            // Near its ends the half chord is the root of a difference, so a rounding of 6e-8 becomes up to 1e-3 of
            // the half extent; the rest covers the roundings of coordinates.
            pad: 1e-3 * half_y + 0.01 + 1e-6 * self.mean[1].abs(),
            all: !proper,
        }
    }
}

impl Reach {
    /// First and last pixel row (inclusive, not clipped) that the ellipse can reach in the pixel columns whose
    /// centres lie in `x0..=x1`; an empty range has last < first. Conservative: never too small.
    #[inline(always)]
    pub fn rows_in(&self, x0: f32, x1: f32) -> (i32, i32) {
        if self.all {
            return (i32::MIN, i32::MAX);
        }
        let left = x0 - self.mean[0];
        let right = x1 - self.mean[0];
        let half_x = self.half[0] + 1e-3 * self.half[0] + 0.01 + 1e-6 * self.mean[0].abs();
        if left > half_x || right < -half_x {
            return (0, -1);
        }
        let dx_low = self.tilt.clamp(left, right);
        let dx_high = (-self.tilt).clamp(left, right);
        let chord = |dx: f32| (self.chord[0] - self.chord[1] * dx * dx).max(0.0).sqrt();
        // y grows downwards; "low" is the smallest y. With slope = -Q/R the largest dy is at dx = -tilt.
        let low = self.slope * dx_low - chord(dx_low) - self.pad;
        let high = self.slope * dx_high + chord(dx_high) + self.pad;
        ((self.mean[1] + low - 0.5).ceil() as i32, (self.mean[1] + high - 0.5).floor() as i32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::constants::ALPHA_MIN;

    #[test]
    fn the_threshold_is_the_logarithm_of_alpha_min() {
        // Half a unit in the last place of 8.
        assert!((f64::from(LOG2_ALPHA_MIN) - libm::log2(f64::from(ALPHA_MIN))).abs() < 2.5e-7);
    }
}
