//! The arithmetic of the image loss on one band of rows of one channel: windowed sums, SSIM map, its derivative, L1.
//! `image_loss` decides averages, weights and bands.
//!
//! A band is processed in tiles of at most [`TILE`] columns, each row by row from top to bottom: an input row enters a
//! ring of [`RING`], of which a window reads eleven; then the map row five above it can be computed, and the gradient row
//! ten above it. Only these rings are stored (155 KiB on the stack), so memory does not grow with the picture and stays in
//! the second-level cache.
//!
//! SSIM (Wang, Bovik, Sheikh and Simoncelli 2004) with means m, over an 11x11 Gaussian window of sigma 1.5:
//! S = (2 mx my + C1)(2 sxy + C2) / ((mx^2 + my^2 + C1)(sxx + syy + C2)). Only the sum sxx + syy occurs, so four
//! windowed maps are enough: x, y, x^2 + y^2, x y. The derivative goes back through the same symmetric window, with
//! three maps: dS/dx = W * dS/dmx + 2 x (W * `dS/dE[xx]`) + y (W * `dS/dE[xy]`).
//!
//! Invariants: 1. each value of a pixel comes from the same operations in the same order wherever the band or tile
//! borders are; 2. each pixel is counted once in the sums, by the band and tile that own it; 3. where the mask is 0 the
//! picture is replaced by the reference, the map has weight 0 and the gradient is exactly 0.

use super::image_pair::{ImagePair, RADIUS, Reference, SsimVariant, WINDOW};
use super::lanes::Lane;
use crate::base::simd::{Kernel, LANES, fma};
use std::array::from_fn;
use std::ops::Range;

/// Columns of one tile: with the map's margin of 5 on both sides, 16 vectors.
const TILE: usize = 16 * LANES - 2 * RADIUS;
/// Columns (and rows) of input that a gradient needs on each side.
const HALO: usize = 2 * RADIUS;
/// Vectors in one row of scratch: 16 of the map and another one for loads of the window's right half.
const VECTORS: usize = 17;
/// Floats in one row of scratch.
const STRIDE: usize = VECTORS * LANES;
/// Rows that are computed together, so that a row above and below them is loaded once for all.
const GROUP: usize = 4;
/// Input rows of a group.
const GROUP_WINDOW: usize = WINDOW - 1 + GROUP;
/// Rows of a ring: at least those of a group's window.
const RING: usize = 16;

/// (0.01 L)^2 and (0.03 L)^2 for the value range L = 1.
const C1: f32 = 1e-4;
const C2: f32 = 9e-4;

/// exp(-k^2 / 4.5) for k = -5..=5, divided by its sum.
const TAPS: [f32; WINDOW] = [
    1.028_380_1e-3,
    7.598_758e-3,
    3.600_077_3e-2,
    1.093_606_9e-1,
    2.130_055_4e-1,
    2.660_117_2e-1,
    2.130_055_4e-1,
    1.093_606_9e-1,
    3.600_077_3e-2,
    7.598_758e-3,
    1.028_380_1e-3,
];

/// One row of scratch.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct PixelRow([Lane; VECTORS]);

impl PixelRow {
    const ZERO: PixelRow = PixelRow([[0.0; LANES]; VECTORS]);

    /// Sixteen values from column `at` on.
    #[inline(always)]
    fn lane_at(&self, at: usize) -> Lane {
        let mut lane = [0.0; LANES];
        lane.copy_from_slice(&self.0.as_flattened()[at..at + LANES]);
        lane
    }
}

/// Sums over the used pixels of one band.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct BandSums {
    /// Sum of absolute differences; 0 without a gradient.
    pub l1: f64,
    /// Sum of squared differences; 0 without a gradient.
    pub squares: f64,
    /// Sum of the SSIM map.
    pub ssim: f64,
}

/// Gradient output of a band, and the factors of the sums' derivatives.
pub(super) struct GradientBand<'a> {
    /// The band's rows of the channel's plane.
    pub v_plane: &'a mut [f32],
    /// Derivative of the loss with respect to the sum of absolute differences.
    pub l1_weight: f32,
    /// Derivative of the loss with respect to the sum of the SSIM map.
    pub ssim_weight: f32,
}

/// One band of one channel; run it with `base::simd::dispatch`.
pub(super) struct BandKernel<'a> {
    pub pair: &'a ImagePair<'a>,
    /// Determines the pixels that the map covers, and the values outside the picture.
    pub variant: SsimVariant,
    /// 0, 1, 2: red, green, blue.
    pub channel: usize,
    /// Image rows that the band owns.
    pub rows: Range<usize>,
    /// `None`: only the SSIM sum is computed.
    pub gradient: Option<GradientBand<'a>>,
}

/// One input row with its margins: x, y, x^2 + y^2, x y and the weight of the pixel (0 outside the picture).
struct InputRow {
    maps: [PixelRow; 4],
    weight: PixelRow,
}

struct Scratch {
    input: [InputRow; RING],
    derivatives: [[PixelRow; 3]; RING],
    /// Sums down the columns, by row of the group and map.
    columns: [[PixelRow; 4]; GROUP],
    domain: PixelRow,
    owned: PixelRow,
}

struct Tile {
    /// Image columns that the tile owns.
    own: Range<usize>,
    /// Image columns of the halo that exist.
    loaded: Range<usize>,
    /// Position of `loaded.start` in a scratch row; scratch column 0 is image column `own.start - HALO`.
    at: usize,
}

#[derive(Default)]
struct LaneSums {
    l1: [f64; LANES],
    squares: [f64; LANES],
    ssim: [f64; LANES],
}

impl Kernel for BandKernel<'_> {
    type Out = BandSums;

    #[inline(always)]
    fn run<const FMA: bool>(mut self) -> BandSums {
        let mut scratch = Scratch {
            input: [const { InputRow { maps: [PixelRow::ZERO; 4], weight: PixelRow::ZERO } }; RING],
            derivatives: [[PixelRow::ZERO; 3]; RING],
            columns: [[PixelRow::ZERO; 4]; GROUP],
            domain: PixelRow::ZERO,
            owned: PixelRow::ZERO,
        };
        let mut sums = LaneSums::default();
        let width = self.pair.width;
        let tile_width = width.div_ceil(width.div_ceil(TILE).max(1)).max(1);
        for start in (0..width).step_by(tile_width) {
            let own = start..(start + tile_width).min(width);
            let loaded = start.saturating_sub(HALO)..(own.end + HALO).min(width);
            let at = loaded.start + HALO - start;
            self.walk::<FMA>(&Tile { own, loaded, at }, &mut scratch, &mut sums);
        }
        BandSums { l1: sums.l1.iter().sum(), squares: sums.squares.iter().sum(), ssim: sums.ssim.iter().sum() }
    }
}

impl BandKernel<'_> {
    /// Streams the rows of one tile through the rings.
    #[inline(always)]
    fn walk<const FMA: bool>(&mut self, tile: &Tile, scratch: &mut Scratch, sums: &mut LaneSums) {
        self.mark_columns(tile, scratch);
        let margin = if self.gradient.is_some() { HALO } else { RADIUS };
        for first in (0..self.rows.len() + 2 * margin).step_by(GROUP) {
            let top = (self.rows.start + first) as isize - margin as isize;
            for g in 0..GROUP {
                self.load_row::<FMA>(tile, top + g as isize, &mut scratch.input[(first + g) % RING]);
            }
            // The first rows of a group may lack rows of their windows: nothing reads their results.
            if first + GROUP > 2 * RADIUS {
                self.map_rows::<FMA>(tile, top - RADIUS as isize, first, scratch, sums);
            }
            if first + GROUP > 4 * RADIUS && self.gradient.is_some() {
                self.gradient_rows::<FMA>(tile, first, scratch, sums);
            }
        }
    }

    /// Marks the columns of the map that have weight, and those that this tile sums.
    fn mark_columns(&self, tile: &Tile, scratch: &mut Scratch) {
        let inside = self.variant.domain(self.pair.width);
        for j in 0..STRIDE {
            let column = (tile.own.start + j).wrapping_sub(RADIUS);
            let counts = inside.contains(&column) && j < tile.own.len() + 2 * RADIUS;
            scratch.domain.0[j / LANES][j % LANES] = f32::from(u8::from(counts));
            scratch.owned.0[j / LANES][j % LANES] = f32::from(u8::from(counts && tile.own.contains(&column)));
        }
    }

    /// Fills one ring entry with image row `row`, which may be outside the picture.
    #[inline(always)]
    fn load_row<const FMA: bool>(&self, tile: &Tile, row: isize, entry: &mut InputRow) {
        let height = self.pair.height;
        let inside = (0..height as isize).contains(&row);
        if !inside && self.variant != SsimVariant::Reflect {
            entry.maps = [PixelRow::ZERO; 4];
            entry.weight = PixelRow::ZERO;
            return;
        }
        let row = reflect(row, height);
        let InputRow { maps: [x, y, squares, products], weight } = entry;
        let span = tile.at..tile.at + tile.loaded.len();
        {
            let [x, y, weight] = [&mut *x, &mut *y, weight].map(|row| row.0.as_flattened_mut());
            for outside in [0..span.start, span.end..STRIDE] {
                x[outside.clone()].fill(0.0);
                y[outside.clone()].fill(0.0);
                weight[outside].fill(0.0);
            }
            self.copy_row(row, tile, &mut x[span.clone()], &mut y[span.clone()], &mut weight[span.clone()]);
            if self.variant == SsimVariant::Reflect {
                self.mirror_columns(tile, span, x, y);
            }
        }
        // One loop over plain slices: two nested ones are vectorised across the rows of vectors, with gathers.
        let [x, y, squares, products] = [x, y, squares, products].map(|row| row.0.as_flattened_mut());
        for (((x, y), square), product) in x.iter().zip(&*y).zip(squares).zip(products) {
            *square = fma::<FMA>(*x, *x, y * y);
            *product = x * y;
        }
    }

    /// Loads values and weights of the existing columns.
    #[inline(always)]
    fn copy_row(&self, row: usize, tile: &Tile, x: &mut [f32], y: &mut [f32], weight: &mut [f32]) {
        let (width, pixels) = (self.pair.width, self.pair.width * self.pair.height);
        let span = row * width + tile.loaded.start..row * width + tile.loaded.end;
        let plane = self.channel * pixels;
        x.copy_from_slice(&self.pair.rgb[plane + span.start..plane + span.end]);
        match self.pair.reference {
            Reference::Bytes(bytes) => {
                let bytes = &bytes[3 * span.start..3 * span.end];
                match self.channel {
                    0 => channel_of::<0>(bytes, y),
                    1 => channel_of::<1>(bytes, y),
                    _ => channel_of::<2>(bytes, y),
                }
            }
            Reference::Planar(values) => y.copy_from_slice(&values[plane + span.start..plane + span.end]),
        }
        if self.pair.clamp {
            // clamp() keeps NaN, so that a broken picture shows in the result.
            x.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
            y.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
        }
        weight.fill(1.0);
        if let Some(mask) = self.pair.mask {
            for (((x, &y), weight), &byte) in x.iter_mut().zip(&*y).zip(weight).zip(&mask[span]) {
                *weight = if byte == 0 { 0.0 } else { 1.0 };
                *x = if byte == 0 { y } else { *x };
            }
        }
    }

    /// Fills the columns outside the picture with their mirror images, as far as a window reaches.
    fn mirror_columns(&self, tile: &Tile, span: Range<usize>, x: &mut [f32], y: &mut [f32]) {
        let origin = tile.own.start as isize - HALO as isize;
        for j in (span.start.saturating_sub(RADIUS)..span.start).chain(span.end..(span.end + RADIUS).min(STRIDE)) {
            let column = origin + j as isize;
            if (0..self.pair.width as isize).contains(&column) {
                continue; // beyond the halo of an inner tile: no window reaches it
            }
            let from = (reflect(column, self.pair.width) as isize - origin) as usize;
            (x[j], y[j]) = (x[from], y[from]);
        }
    }

    /// Computes SSIM and its three derivatives along the map rows from `top` on; the last input row of the first one's
    /// window is at ring index `first`.
    #[inline(always)]
    fn map_rows<const FMA: bool>(
        &self,
        tile: &Tile,
        top: isize,
        first: usize,
        scratch: &mut Scratch,
        sums: &mut LaneSums,
    ) {
        let Scratch { input, derivatives, columns, domain: in_domain, owned } = scratch;
        let vectors = (tile.own.len() + 2 * RADIUS).div_ceil(LANES);
        let window: [&InputRow; GROUP_WINDOW] = from_fn(|k| &input[(first + RING + 1 - WINDOW + k) % RING]);
        for m in 0..4 {
            let rows = window.map(|row| &row.maps[m]);
            for v in 0..=vectors {
                let of_rows = down::<FMA>(&rows, v);
                for g in 0..GROUP {
                    columns[g][m].0[v] = of_rows[g];
                }
            }
        }
        let rows_with_weight = self.variant.domain(self.pair.height);
        for g in 0..GROUP {
            let row = top + g as isize;
            let derivatives = &mut derivatives[(first + g) % RING];
            if row < 0 || !rows_with_weight.contains(&(row as usize)) {
                *derivatives = [PixelRow::ZERO; 3];
                continue;
            }
            let sum_row = self.rows.contains(&(row as usize));
            let (columns, weights) = (&columns[g], &window[g + RADIUS].weight);
            // At most sixteen values a lane: added up in f32.
            let mut of_row = [0.0; LANES];
            for v in 0..vectors {
                let at = v * LANES;
                let [mx, my] = [across::<FMA>(&columns[0], at), across::<FMA>(&columns[1], at)];
                let [squares, products] = [across::<FMA>(&columns[2], at), across::<FMA>(&columns[3], at)];
                let weight = multiply(weights.lane_at(at + RADIUS), in_domain.0[v]);
                let [mut ssim, mut v_mean, mut v_square, mut v_product] = [weight; 4];
                for l in 0..LANES {
                    let point = ssim_point::<FMA>(mx[l], my[l], squares[l], products[l]);
                    ssim[l] *= point[0];
                    v_mean[l] *= point[1];
                    v_square[l] *= point[2];
                    v_product[l] *= point[3];
                }
                if sum_row {
                    let owned = owned.0[v];
                    for l in 0..LANES {
                        of_row[l] += ssim[l] * owned[l];
                    }
                }
                if self.gradient.is_some() {
                    (derivatives[0].0[v], derivatives[1].0[v], derivatives[2].0[v]) = (v_mean, v_square, v_product);
                }
            }
            add_row(&mut sums.ssim, &of_row);
        }
    }

    /// Computes the gradient of a group of rows, ten above ring index `first`, and the differences along them.
    #[inline(always)]
    fn gradient_rows<const FMA: bool>(
        &mut self,
        tile: &Tile,
        first: usize,
        scratch: &mut Scratch,
        sums: &mut LaneSums,
    ) {
        let Some(out) = &mut self.gradient else { return };
        let Scratch { input, derivatives, columns, .. } = scratch;
        let vectors = tile.own.len().div_ceil(LANES);
        let window: [&[PixelRow; 3]; GROUP_WINDOW] = from_fn(|k| &derivatives[(first + RING + 1 - WINDOW + k) % RING]);
        for m in 0..3 {
            let rows = window.map(|row| &row[m]);
            for v in 0..=vectors {
                let of_rows = down::<FMA>(&rows, v);
                for g in 0..GROUP {
                    columns[g][m].0[v] = of_rows[g];
                }
            }
        }
        for g in 0..GROUP {
            // Both margins are loaded: rows between them are the band's own.
            let Some(own_row) = (first + g).checked_sub(4 * RADIUS).filter(|row| *row < self.rows.len()) else {
                continue;
            };
            let centre = &input[(first + g + RING - 2 * RADIUS) % RING];
            let columns = &columns[g];
            let [mut l1, mut squares] = [[0.0; LANES]; 2];
            let at = own_row * self.pair.width + tile.own.start;
            let v_row = &mut out.v_plane[at..at + tile.own.len()];
            for (v, v_out) in v_row.chunks_mut(LANES).enumerate() {
                let at = v * LANES;
                let (v_mean, v_square) = (across::<FMA>(&columns[0], at), across::<FMA>(&columns[1], at));
                let v_product = across::<FMA>(&columns[2], at);
                let (x, y) = (centre.maps[0].lane_at(at + HALO), centre.maps[1].lane_at(at + HALO));
                let weight = centre.weight.lane_at(at + HALO);
                let [mut v_pixel, mut difference] = [[0.0; LANES]; 2];
                for l in 0..LANES {
                    difference[l] = x[l] - y[l];
                    let above = if difference[l] > 0.0 { out.l1_weight } else { 0.0 };
                    let below = if difference[l] < 0.0 { out.l1_weight } else { 0.0 };
                    let v_ssim = fma::<FMA>(2.0 * x[l], v_square[l], fma::<FMA>(y[l], v_product[l], v_mean[l]));
                    v_pixel[l] = weight[l] * fma::<FMA>(out.ssim_weight, v_ssim, above - below);
                }
                v_out.copy_from_slice(&v_pixel[..v_out.len()]);
                // Columns beyond the tile belong to the next tile.
                difference[v_out.len()..].fill(0.0);
                for l in 0..LANES {
                    l1[l] += difference[l].abs();
                    squares[l] = fma::<FMA>(difference[l], difference[l], squares[l]);
                }
            }
            add_row(&mut sums.l1, &l1);
            add_row(&mut sums.squares, &squares);
        }
    }
}

#[inline(always)]
fn add_row(sums: &mut [f64; LANES], of_row: &Lane) {
    for l in 0..LANES {
        sums[l] += f64::from(of_row[l]);
    }
}

/// One channel of interleaved bytes as values from 0 to 1.
#[inline(always)]
fn channel_of<const CHANNEL: usize>(bytes: &[u8], out: &mut [f32]) {
    let (blocks, rest) = bytes.as_chunks::<{ 3 * LANES }>();
    let (out_blocks, out_rest) = out.as_chunks_mut::<LANES>();
    for (out, block) in out_blocks.iter_mut().zip(blocks) {
        let bytes: [u8; LANES] = from_fn(|l| block[3 * l + CHANNEL]);
        for l in 0..LANES {
            out[l] = f32::from(bytes[l]) / 255.0;
        }
    }
    for (out, pixel) in out_rest.iter_mut().zip(rest.as_chunks::<3>().0) {
        *out = f32::from(pixel[CHANNEL]) / 255.0;
    }
}

/// Applies the window down the columns of vector `v`, for each row of a group.
#[inline(always)]
fn down<const FMA: bool>(window: &[&PixelRow; GROUP_WINDOW], v: usize) -> [Lane; GROUP] {
    /// Adds row `K` of the window to the sums that it belongs to.
    #[inline(always)]
    fn add<const FMA: bool, const K: usize>(value: &Lane, sums: &mut [Lane; GROUP]) {
        for (g, sum) in sums.iter_mut().enumerate() {
            if K >= g && K - g < WINDOW {
                *sum = add_scaled::<FMA>(TAPS[K - g], *value, *sum);
            }
        }
    }
    let mut sums = [[0.0; LANES]; GROUP];
    // Written out, because the compiler does not unroll a loop of this size.
    macro_rules! add_rows {
        ($($k:literal)*) => { $(add::<FMA, $k>(&window[$k].0[v], &mut sums);)* };
    }
    add_rows!(0 1 2 3 4 5 6 7 8 9 10 11 12 13);
    sums
}

/// `[S, dS/dmx, dS/dE[xx], dS/dE[xy]]` from the windowed means of x, y, x^2 + y^2 and x y.
#[inline(always)]
fn ssim_point<const FMA: bool>(mx: f32, my: f32, squares: f32, products: f32) -> [f32; 4] {
    let mean_product = mx * my;
    let mean_squares = fma::<FMA>(mx, mx, my * my);
    let a1 = fma::<FMA>(2.0, mean_product, C1);
    let a2 = fma::<FMA>(2.0, products - mean_product, C2);
    let b1 = mean_squares + C1;
    // Rounding can make the sum of two variances negative by 1e-7 of the squares, for a bright flat patch.
    let b2 = (squares - mean_squares).max(0.0) + C2;
    let inverse = 1.0 / (b1 * b2);
    let ssim = a1 * a2 * inverse;
    let v_mean = 2.0 * inverse * fma::<FMA>(my, a2 - a1, mx * ssim * (b1 - b2));
    [ssim, v_mean, -ssim * b1 * inverse, 2.0 * a1 * inverse]
}

#[inline(always)]
fn add_scaled<const FMA: bool>(tap: f32, v: Lane, mut sum: Lane) -> Lane {
    for l in 0..LANES {
        sum[l] = fma::<FMA>(tap, v[l], sum[l]);
    }
    sum
}

/// Applies the window along a row: sixteen results, the first from columns `at..at + 11`.
#[inline(always)]
fn across<const FMA: bool>(row: &PixelRow, at: usize) -> Lane {
    let values = &row.0.as_flattened()[at..at + LANES + WINDOW - 1];
    let mut sum = [0.0; LANES];
    for k in 0..WINDOW {
        let mut shifted = [0.0; LANES];
        shifted.copy_from_slice(&values[k..k + LANES]);
        sum = add_scaled::<FMA>(TAPS[k], shifted, sum);
    }
    sum
}

#[inline(always)]
fn multiply(mut a: Lane, b: Lane) -> Lane {
    for l in 0..LANES {
        a[l] *= b[l];
    }
    a
}

/// Index of the mirror image of `i` in `0..side`; the border element is not repeated.
fn reflect(i: isize, side: usize) -> usize {
    let period = 2 * (side as isize - 1).max(1);
    let i = i.rem_euclid(period);
    (if i < side as isize { i } else { period - i }).min(side as isize - 1) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_is_a_normalised_gaussian() {
        let raw: [f64; WINDOW] = from_fn(|k| libm::exp(-(k as f64 - 5.0).powi(2) / 4.5));
        let sum: f64 = raw.iter().sum();
        for k in 0..WINDOW {
            assert_eq!(TAPS[k], (raw[k] / sum) as f32, "tap {k}");
        }
    }

    #[test]
    fn reflection_does_not_repeat_the_border() {
        let got: Vec<usize> = (-5..9).map(|i| reflect(i, 4)).collect();
        assert_eq!(got, [1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0, 1, 2]);
        assert!((-5..6).all(|i| reflect(i, 1) == 0));
    }
}
