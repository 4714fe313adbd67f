//! Footprints packed for the tile loops, one cache line per row, and the pixels that each can reach.
//!
//! Invariants: 1. splats and spans have one entry per row; those of culled rows are not valid; 2. the exponent of a
//! splat is to base 2 and includes its opacity: `e = a dx^2 + b dx dy + c dy^2 + log2_opacity`, so that `alpha = 2^e`;
//! 3. [`Splat::reach`] includes the rounding errors of the tile loops: where the exact form is more than `reach` below
//! `log2_opacity`, the loops compute an alpha below 1/255 for any order of operations; 4. spans are conservative: they
//! include every pixel with a contribution; 5. nothing here is contracted, so every instruction path gives the same
//! bits.

use super::constants::TILE;
use super::lanes::{Lane, block_of, gather};
use super::project_fwd::Projected;
use crate::base::room;
use crate::base::simd::{Kernel, LANES, SimdPath, dispatch};
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
    pub tiles_x: u32,
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

/// One row in the form that the tile loops read.
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
    pub log2_opacity: f32,
    pub color: [f32; 3],
    /// How far the exponent may fall before no contribution is possible; not positive if none is possible at all.
    pub reach: f32,
    /// Emit index of its first intersection, counted from its chunk's first (see [`Packed::chunk_counts`]).
    pub emit: u64,
}

/// The tiles and pixel rows that a row can reach; for most rows the intersection stages read only this.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[repr(C, align(16))]
pub struct Span {
    /// First tile column, first tile row, one past the last column, one past the last row.
    pub tiles: [u16; 4],
    /// First and last pixel row of the image (inclusive) that the row reaches in its first and in its second tile
    /// column; last < first if there is none. [`Ellipse::rows_in`] computes further columns.
    pub rows: [[u16; 2]; 2],
}

/// The region that splats can reach: an ellipse (for one row, or for a block of rows by lane).
///
/// With P = -a, Q = -b/2, R = -c it is P dx^2 + 2 Q dx dy + R dy^2 = reach; det = P R - Q^2 is formed in f64, where the
/// products of two f32 are exact, because it cancels for needles.
#[derive(Debug, Clone, Copy)]
pub struct Ellipse {
    mean: [f32; 2],
    /// Half extents, including rounding errors.
    half: [f32; 2],
    /// dx of the lowest dy is `tilt`, of the highest `-tilt`.
    tilt: f32,
    /// Coefficients of the half chord: sqrt(chord0 - chord1 dx^2).
    chord: [f32; 2],
    /// dy of the chord's middle is `slope * dx`.
    slope: f32,
    /// Margin added to dy at both ends.
    pad: f32,
    /// Whether this is not a proper ellipse: then everything counts as reached.
    all: bool,
}

impl Splat {
    /// The ellipse on which the exponent has fallen by [`Splat::reach`].
    #[inline(always)]
    pub fn ellipse(&self) -> Ellipse {
        let (p, q, r) = (-f64::from(self.a), -0.5 * f64::from(self.b), -f64::from(self.c));
        let det = (p * r - q * q) as f32;
        let (p, q, r) = (p as f32, q as f32, r as f32);
        let scale = self.reach / det;
        let half = [(scale * r).sqrt(), (scale * p).sqrt()];
        let [mx, my] = self.mean;
        // Near its ends the half chord is the root of a difference, so a rounding of 6e-8 becomes up to 1e-3 of the
        // half extent; the rest covers the roundings of coordinates.
        let pad = [half[0] * 1e-3 + 0.01 + 1e-6 * mx.abs(), half[1] * 1e-3 + 0.01 + 1e-6 * my.abs()];
        let inv_r = 1.0 / r;
        let sound = (half[0] + half[1]) + (mx.abs() + my.abs());
        Ellipse {
            mean: self.mean,
            half: [half[0] + pad[0], half[1] + pad[1]],
            tilt: q / p * half[1],
            chord: [self.reach * inv_r, det * inv_r * inv_r],
            slope: -q * inv_r,
            pad: pad[1],
            // Written so that NaN counts as not sound.
            all: !((det > 0.0) & (p > 0.0) & (r > 0.0) & (sound < 1e9)),
        }
    }
}

/// The smallest integer at or above `x`, clamped to the range of tile arithmetic. Avoids the library call that the
/// baseline path would make for each lane.
#[inline(always)]
fn ceil(x: f32) -> i32 {
    let cut = within_i32(x) as i32;
    cut + i32::from((cut as f32) < x)
}

/// The largest integer at or below `x`, clamped likewise.
#[inline(always)]
fn floor(x: f32) -> i32 {
    let cut = within_i32(x) as i32;
    cut - i32::from((cut as f32) > x)
}

/// `x` clamped to +-2^24; NaN becomes -2^24.
#[inline(always)]
fn within_i32(x: f32) -> f32 {
    const LIMIT: f32 = 16_777_216.0;
    let x = if x > -LIMIT { x } else { -LIMIT };
    if x < LIMIT { x } else { LIMIT }
}

impl Ellipse {
    /// First and last pixel row (inclusive, not clipped) that the ellipse can reach in the pixel columns whose centres
    /// are in `x0..=x1`; last < first if there is none. Conservative: never too small.
    #[inline(always)]
    pub fn rows_in(&self, x0: f32, x1: f32) -> [i32; 2] {
        let left = x0 - self.mean[0];
        let right = x1 - self.mean[0];
        let within = |dx: f32| {
            let dx = if dx < left { left } else { dx };
            if dx > right { right } else { dx }
        };
        let chord = |dx: f32| {
            let square = self.chord[0] - self.chord[1] * dx * dx;
            (if square > 0.0 { square } else { 0.0 }).sqrt()
        };
        // y grows downwards: "first" is the smallest y.
        let (dx_first, dx_last) = (within(self.tilt), within(-self.tilt));
        let first = ceil(self.mean[1] + (self.slope * dx_first - chord(dx_first) - self.pad) - 0.5);
        let last = floor(self.mean[1] + (self.slope * dx_last + chord(dx_last) + self.pad) - 0.5);
        let beside = (left > self.half[0]) | (right < -self.half[0]);
        let first = if beside { 1 } else { first };
        let last = if beside { 0 } else { last };
        [if self.all { i32::MIN } else { first }, if self.all { i32::MAX } else { last }]
    }

    /// First and last pixel column (inclusive, not clipped) that the ellipse can reach.
    #[inline(always)]
    fn columns(&self) -> [i32; 2] {
        let first = ceil(self.mean[0] - self.half[0] - 0.5);
        let last = floor(self.mean[0] + self.half[0] - 0.5);
        [if self.all { i32::MIN } else { first }, if self.all { i32::MAX } else { last }]
    }
}

/// Pixel rows of a tile column, clipped to the box and the image; last < first if there is none.
#[inline(always)]
fn rows_in_column(ellipse: &Ellipse, grid: Grid, tiles: [u16; 4], column: u16) -> [u16; 2] {
    let x0 = (u32::from(column) * TILE) as f32 + 0.5;
    let [first, last] = ellipse.rows_in(x0, x0 + (TILE - 1) as f32);
    let first = first.max(i32::from(tiles[1]) * TILE as i32);
    let last = last.min(i32::from(tiles[3]) * TILE as i32 - 1).min(grid.height as i32 - 1);
    // An empty range is stored as 1..=0, because -1 cannot be represented.
    if last < first { [1, 0] } else { [first as u16, last as u16] }
}

/// Tile rows of a range of pixel rows.
#[inline(always)]
pub(super) fn tile_rows([first, last]: [u16; 2]) -> std::ops::Range<u32> {
    if last < first { 0..0 } else { u32::from(first) / TILE..u32::from(last) / TILE + 1 }
}

/// Output of [`pack`] for a view's rows.
#[derive(Debug, Clone, Default)]
pub struct Packed {
    /// Splats by row.
    pub splats: Vec<Splat>,
    /// Spans by row.
    pub spans: Vec<Span>,
    /// Number of tiles that each row reaches; 0 for culled rows.
    pub counts: Vec<u32>,
    /// Sums of `counts` over chunks of [`ROWS_PER_CHUNK`] rows: their prefix sums are the chunks' emit offsets.
    pub chunk_counts: Vec<u64>,
}

/// Rows per chunk of emit indices.
pub const ROWS_PER_CHUNK: usize = 2048;

/// Packs all rows. `colors` has one entry per row.
pub fn pack(projected: &Projected, colors: &[[f32; 3]], grid: Grid, simd: SimdPath, out: &mut Packed) {
    let rows = projected.rows();
    room::renew(&mut out.splats, rows, Splat::default());
    room::renew(&mut out.spans, rows, Span::default());
    room::resize(&mut out.counts, rows, 0);
    room::resize(&mut out.chunk_counts, rows.div_ceil(ROWS_PER_CHUNK), 0);
    let chunks = (out.splats.par_chunks_mut(ROWS_PER_CHUNK), out.spans.par_chunks_mut(ROWS_PER_CHUNK));
    let counts = (out.counts.par_chunks_mut(ROWS_PER_CHUNK), out.chunk_counts.par_iter_mut()).into_par_iter();
    chunks.into_par_iter().zip(counts).enumerate().for_each(|(chunk, ((splats, spans), (counts, sum)))| {
        let first = chunk * ROWS_PER_CHUNK;
        *sum = dispatch(simd, PackChunk { projected, colors, grid, first, splats, spans, counts });
    });
}

struct PackChunk<'a> {
    projected: &'a Projected,
    colors: &'a [[f32; 3]],
    grid: Grid,
    first: usize,
    splats: &'a mut [Splat],
    spans: &'a mut [Span],
    counts: &'a mut [u32],
}

impl Kernel for PackChunk<'_> {
    /// Sum of the counts.
    type Out = u64;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> u64 {
        let mut emit = 0;
        let grid = self.grid;
        let p = self.projected;
        let range = self.first..self.first + self.splats.len();
        let (means2d, conics) = (&p.means2d[range.clone()], &p.conics[range.clone()]);
        let (radii, opacities) = (&p.radii[range.clone()], &p.opacities[range.clone()]);
        let colors = &self.colors[range];
        for block in 0..self.splats.len().div_ceil(LANES) {
            let radii = block_of(radii, block, 1);
            let mut boxes = [[0.0; LANES]; 2];
            for (lane, r) in radii.iter().enumerate() {
                (boxes[0][lane], boxes[1][lane]) = (r[0] as f32, r[1] as f32);
            }
            let means = gather::<2>(block_of(means2d, block, 1).as_flattened());
            let conics = gather::<3>(block_of(conics, block, 1).as_flattened());
            let colors = block_of(colors, block, 1);
            let logs = log2_lanes(&gather::<1>(block_of(opacities, block, 1))[0]);
            let lanes = PackedLanes::new(&means, &conics, &boxes, &logs, grid);
            for (lane, radii) in radii.iter().enumerate() {
                let row = block * LANES + lane;
                let (splat, span) = lanes.lane(lane, colors[lane]);
                let count = if *radii == [0, 0] { 0 } else { tiles_reached(&splat, &span, grid) };
                self.splats[row] = Splat { emit, ..splat };
                self.spans[row] = span;
                self.counts[row] = count;
                emit += u64::from(count);
            }
        }
        emit
    }
}

/// log2 of positive normal numbers, within 1.2e-7 (absolute, or relative for larger results): scales the mantissa to
/// [1/sqrt 2, sqrt 2), then sums the series of 2 log2(e) atanh((m - 1) / (m + 1)) to the ninth power.
#[inline(always)]
fn log2_lanes(x: &Lane) -> Lane {
    const SQRT_HALF_BITS: u32 = 0x3f35_04f3;
    let mut out = [0.0; LANES];
    for lane in 0..LANES {
        let bits = x[lane].to_bits();
        let exponent = (bits.wrapping_sub(SQRT_HALF_BITS) as i32) >> 23;
        let m = f32::from_bits(bits.wrapping_sub((exponent as u32) << 23));
        let s = (m - 1.0) / (m + 1.0);
        let z = s * s;
        let series = z * (1.0 / 3.0 + z * (0.2 + z * (1.0 / 7.0 + z * (1.0 / 9.0))));
        out[lane] = exponent as f32 + 2.0 * std::f32::consts::LOG2_E * (s + s * series);
    }
    out
}

/// Splats and spans of a block of rows, by lane: plain arrays and one loop, which the compiler vectorises.
struct PackedLanes {
    /// mean x, mean y, a, b, c, log2_opacity, reach.
    splat: [Lane; 7],
    /// First tile column, first tile row, one past the last column, one past the last row.
    tiles: [[i32; LANES]; 4],
    /// First and last pixel row in the first, then in the second tile column.
    rows: [[i32; LANES]; 4],
}

impl PackedLanes {
    #[inline(always)]
    fn new(means: &[Lane; 2], conics: &[Lane; 3], radii: &[Lane; 2], logs: &Lane, grid: Grid) -> Self {
        const LOG2E: f32 = std::f32::consts::LOG2_E;
        const SHIFT: u32 = TILE.ilog2();
        let (tiles_x, tiles_y, height) = (grid.tiles_x as i32, grid.tiles_y as i32, grid.height as i32);
        let mut out = PackedLanes { splat: [[0.0; LANES]; 7], tiles: [[0; LANES]; 4], rows: [[0; LANES]; 4] };
        for lane in 0..LANES {
            let mean = [means[0][lane], means[1][lane]];
            let [xx, xy, yy] = [conics[0][lane], conics[1][lane], conics[2][lane]];
            let radii = [radii[0][lane], radii[1][lane]];
            let (a, b, c) = (-0.5 * LOG2E * xx, -LOG2E * xy, -0.5 * LOG2E * yy);
            // A tile of the box extends at most one tile side beyond the radius. The exponent takes some six roundings
            // of terms whose sum is at most twice |a| dx^2 + |c| dy^2 (|b dx dy| is below that sum): 12 x 6e-8 of it,
            // doubled for safety.
            let (dx, dy) = (radii[0] + TILE as f32 + 1.0, radii[1] + TILE as f32 + 1.0);
            let rounding = 2e-6 * (a.abs() * dx * dx + c.abs() * dy * dy) + 1e-4;
            let reach = logs[lane] - LOG2_ALPHA_MIN + rounding;
            let splat = Splat { mean, a, b, c, log2_opacity: logs[lane], color: [0.0; 3], reach, emit: 0 };
            let ellipse = splat.ellipse();
            let [first, last] = ellipse.columns();
            // The box of the radii in whole tiles, narrowed to the tile columns that the ellipse can reach. Written so
            // that NaN (an opacity of 0) reaches nothing.
            let possible = if reach > 0.0 { i32::MAX } else { 0 };
            let x0 = (floor(mean[0] - radii[0]) >> SHIFT).max(first >> SHIFT).max(0).min(tiles_x);
            let x1 = ((ceil(mean[0] + radii[0]) - 1) >> SHIFT).min(last >> SHIFT).max(-1).min(tiles_x - 1) + 1;
            let y0 = (floor(mean[1] - radii[1]) >> SHIFT).max(0).min(tiles_y);
            let y1 = ((ceil(mean[1] + radii[1]) - 1) >> SHIFT).max(-1).min(tiles_y - 1) + 1;
            let x1 = x1.min(possible);
            let left = (x0 as f32) * TILE as f32 + 0.5;
            for column in 0..2 {
                let left = left + (column as u32 * TILE) as f32;
                let [first, last] = ellipse.rows_in(left, left + (TILE - 1) as f32);
                let first = first.max(y0 << SHIFT);
                let last = last.min((y1 << SHIFT) - 1).min(height - 1);
                // An empty range is stored as 1..=0, because -1 cannot be represented in a span.
                out.rows[2 * column][lane] = if last < first { 1 } else { first };
                out.rows[2 * column + 1][lane] = if last < first { 0 } else { last };
            }
            (out.tiles[0][lane], out.tiles[1][lane], out.tiles[2][lane], out.tiles[3][lane]) = (x0, y0, x1, y1);
            (out.splat[0][lane], out.splat[1][lane], out.splat[2][lane]) = (mean[0], mean[1], a);
            (out.splat[3][lane], out.splat[4][lane], out.splat[5][lane]) = (b, c, logs[lane]);
            out.splat[6][lane] = reach;
        }
        out
    }

    #[inline(always)]
    fn lane(&self, lane: usize, color: [f32; 3]) -> (Splat, Span) {
        let [x, y, a, b, c, log2_opacity, reach] = std::array::from_fn(|i| self.splat[i][lane]);
        let tiles = std::array::from_fn(|i| self.tiles[i][lane] as u16);
        let rows = std::array::from_fn(|i| [self.rows[2 * i][lane] as u16, self.rows[2 * i + 1][lane] as u16]);
        (Splat { mean: [x, y], a, b, c, log2_opacity, color, reach, emit: 0 }, Span { tiles, rows })
    }
}

/// Calls `each(tile column, pixel rows)` for every tile column of a row's span, from left to right; with `CUT`, for those from
/// `columns[0]` to below `columns[1]`.
#[inline(always)]
pub(super) fn for_each_column<const CUT: bool>(
    splat: &Splat,
    span: &Span,
    grid: Grid,
    columns: [u16; 2],
    mut each: impl FnMut(u16, [u16; 2]),
) {
    let [x0, _, x1, _] = span.tiles;
    for (column, rows) in (x0..x1).zip(span.rows) {
        if !CUT || (columns[0]..columns[1]).contains(&column) {
            each(column, rows);
        }
    }
    if x1.saturating_sub(x0) > 2 {
        let [first, end] = if CUT { [(x0 + 2).max(columns[0]), x1.min(columns[1])] } else { [x0 + 2, x1] };
        if first < end {
            let ellipse = splat.ellipse();
            for column in first..end {
                each(column, rows_in_column(&ellipse, grid, span.tiles, column));
            }
        }
    }
}

/// Number of tiles that a row reaches.
#[inline(always)]
fn tiles_reached(splat: &Splat, span: &Span, grid: Grid) -> u32 {
    let mut count = 0;
    for_each_column::<false>(splat, span, grid, [0; 2], |_, rows| count += tile_rows(rows).len() as u32);
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::constants::ALPHA_MIN;

    #[test]
    fn log2_is_accurate() {
        for i in 1..100_000 {
            let x = i as f32 / 1e5;
            let error = f64::from(log2_lanes(&[x; LANES])[3]) - libm::log2(f64::from(x));
            // Two roundings of 6e-8, relative to the result, or absolute for results below 1.
            let unit = f64::from(libm::log2f(x).abs().max(1.0));
            assert!(error.abs() < 1.2e-7 * unit, "log2 {x}: {error}");
        }
        assert_eq!(log2_lanes(&[1.0; LANES])[0], 0.0);
    }

    #[test]
    fn the_threshold_is_the_logarithm_of_alpha_min() {
        // Half a unit in the last place of 8.
        assert!((f64::from(LOG2_ALPHA_MIN) - libm::log2(f64::from(ALPHA_MIN))).abs() < 2.5e-7);
    }
}
