//! One intersection for each visible row and tile that it can reach.
//!
//! Invariants: 1. a row's tiles are enumerated column by column (tile x outer, tile y inner), and the k-th of them has
//! emit index `offset[rank] + k`: per-row sums are folded in that order; 2. a tile, and a pixel row of a tile, is left
//! out only where every pixel's alpha is computed below 1/255, so leaving it out cannot change the image;
//! 3. [`count`] and [`emit`] walk through the same enumeration, with the same bits on every
//! path (nothing is contracted); 4. the result does not depend on the number of threads.

use super::constants::TILE;
use super::radix_sort::chunk_len;
use super::splats::{Grid, Splat};
use crate::base::simd::{Kernel, SimdPath, dispatch};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

const RANKS_PER_CHUNK: usize = 2048;
const CHUNKS_MAX: usize = 32;

/// One intersection, packed in 64 bits: rank (32), first pixel row in the tile (4), last pixel row (4), k (24).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Isect {
    /// The row's place in depth order.
    pub rank: u32,
    /// First and last pixel row of the tile, 0 to 15, that the row can reach.
    pub rows: [u8; 2],
    /// Its number among the row's intersections, below 2^24.
    pub k: u32,
}

impl Isect {
    /// To 64 bits.
    #[inline(always)]
    pub fn pack(self) -> u64 {
        u64::from(self.rank) | u64::from(self.rows[0]) << 32 | u64::from(self.rows[1]) << 36 | u64::from(self.k) << 40
    }

    /// From 64 bits.
    #[inline(always)]
    pub fn unpack(bits: u64) -> Self {
        Isect { rank: bits as u32, rows: [(bits >> 32) as u8 & 15, (bits >> 36) as u8 & 15], k: (bits >> 40) as u32 }
    }
}

/// Calls `each(tile, [first row, last row])` for every tile that the splat can reach, in emit order.
#[inline(always)]
fn for_each_tile(splat: &Splat, grid: Grid, mut each: impl FnMut(usize, [u8; 2])) {
    // Written so that NaN (an opacity of 0) has no tiles.
    let possible = splat.reach > 0.0;
    if !possible {
        return;
    }
    let ellipse = splat.ellipse();
    let [box_x0, box_y0, box_x1, box_y1] = splat.tiles.map(u32::from);
    let last_pixel = grid.height as i32 - 1;
    let side = TILE as i32;
    for tx in box_x0..box_x1 {
        let x0 = (tx * TILE) as f32 + 0.5;
        let (first, last) = ellipse.rows_in(x0, x0 + (TILE - 1) as f32);
        let first = first.max(box_y0 as i32 * side);
        let last = last.min(box_y1 as i32 * side - 1).min(last_pixel);
        if last < first {
            continue;
        }
        for ty in first / side..=last / side {
            let rows = [(first - ty * side).max(0) as u8, (last - ty * side).min(side - 1) as u8];
            each(ty as usize * grid.tiles_x as usize + tx as usize, rows);
        }
    }
}

/// Counts intersections: `counts` by rank, `tile_counts` as `[chunks][tiles]` for [`super::isect_offsets`].
pub fn count(splats: &[Splat], grid: Grid, simd: SimdPath, counts: &mut Vec<u32>, tile_counts: &mut Vec<u32>) {
    let tiles = grid.tiles();
    let len = chunk_len(splats.len(), RANKS_PER_CHUNK, CHUNKS_MAX);
    counts.resize(splats.len(), 0);
    tile_counts.clear();
    tile_counts.resize(splats.len().div_ceil(len) * tiles, 0);
    if tiles == 0 {
        counts.fill(0);
        return;
    }
    let chunks = splats.par_chunks(len).zip(counts.par_chunks_mut(len));
    chunks.zip(tile_counts.par_chunks_mut(tiles)).for_each(|((splats, counts), tile_counts)| {
        dispatch(simd, CountChunk { splats, grid, counts, tile_counts });
    });
}

struct CountChunk<'a> {
    splats: &'a [Splat],
    grid: Grid,
    counts: &'a mut [u32],
    tile_counts: &'a mut [u32],
}

impl Kernel for CountChunk<'_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        for (splat, count) in self.splats.iter().zip(self.counts) {
            *count = 0;
            for_each_tile(splat, self.grid, |tile, _| {
                self.tile_counts[tile] += 1;
                *count += 1;
            });
        }
    }
}

/// Writes each intersection (as [`Isect::pack`]) to its place in its tile's list. `cursors` comes from
/// [`super::isect_offsets`] and is used up; `isects` is resized to `total`.
pub fn emit(
    splats: &[Splat],
    grid: Grid,
    simd: SimdPath,
    total: u64,
    cursors: &mut [u64],
    isects: &mut Vec<AtomicU64>,
) {
    let tiles = grid.tiles();
    let len = chunk_len(splats.len(), RANKS_PER_CHUNK, CHUNKS_MAX);
    isects.resize_with(total as usize, AtomicU64::default);
    if tiles == 0 {
        return;
    }
    let isects = &*isects;
    splats.par_chunks(len).zip(cursors.par_chunks_mut(tiles)).enumerate().for_each(|(chunk, (splats, cursors))| {
        dispatch(simd, EmitChunk { splats, grid, first_rank: (chunk * len) as u32, cursors, isects });
    });
}

struct EmitChunk<'a> {
    splats: &'a [Splat],
    grid: Grid,
    first_rank: u32,
    cursors: &'a mut [u64],
    isects: &'a [AtomicU64],
}

impl Kernel for EmitChunk<'_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        for (rank, splat) in (self.first_rank..).zip(self.splats) {
            let mut k = 0;
            for_each_tile(splat, self.grid, |tile, rows| {
                let place = &mut self.cursors[tile];
                self.isects[*place as usize].store(Isect { rank, rows, k }.pack(), Relaxed);
                *place += 1;
                k += 1;
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::kernels::isect_offsets::isect_offsets;
    use crate::kernels::scan::scan;
    use crate::kernels::splats::LOG2_ALPHA_MIN;

    fn random_splat(draws: &mut Stream, needles: bool, grid: Grid) -> Splat {
        let angle = draws.range(0.0, std::f64::consts::PI);
        let major = draws.range(0.0, if needles { 9.0 } else { 4.0 }).exp2();
        let minor = if needles { 0.55 } else { draws.range(0.55, major.max(0.6)) };
        let (s, c) = angle.sin_cos();
        let (p, q) = (1.0 / (major * major), 1.0 / (minor * minor));
        let conic = [p * c * c + q * s * s, (p - q) * s * c, p * s * s + q * c * c];
        let sigma_x = (major * major * c * c + minor * minor * s * s).sqrt();
        let sigma_y = (major * major * s * s + minor * minor * c * c).sqrt();
        let projected = crate::kernels::project_fwd::Projected {
            means2d: vec![[draws.range(-40.0, 140.0) as f32, draws.range(-40.0, 110.0) as f32]],
            conics: vec![conic.map(|x| x as f32)],
            depths: vec![1.0],
            radii: vec![[(3.33 * sigma_x).ceil() as u32, (3.33 * sigma_y).ceil() as u32]],
            opacities: vec![draws.range(0.001, 1.0) as f32],
        };
        let mut splats = Vec::new();
        crate::kernels::splats::pack(&[0], &projected, &[[0.5; 3]], grid, &mut splats);
        splats[0]
    }

    /// Every pixel of the box whose exponent reaches the threshold must be in a tile and row that was emitted.
    #[test]
    fn no_contribution_is_left_out() {
        let grid = Grid::new(107, 75);
        let mut draws = Stream::new(5, Purpose::Test, 0, 0);
        let (mut emitted, mut boxed) = (0, 0);
        for trial in 0..4000 {
            let splat = random_splat(&mut draws, trial % 2 == 0, grid);
            let mut reached = vec![[16u8, 0]; grid.tiles()];
            for_each_tile(&splat, grid, |tile, rows| {
                assert_eq!(reached[tile], [16, 0], "a tile comes once");
                reached[tile] = rows;
                emitted += 1;
            });
            let [x0, y0, x1, y1] = splat.tiles.map(|t| u32::from(t) * TILE);
            boxed += (x1 - x0) / TILE * ((y1 - y0) / TILE);
            for y in y0..y1.min(grid.height) {
                for x in x0..x1.min(grid.width) {
                    let (dx, dy) = (x as f32 + 0.5 - splat.mean[0], y as f32 + 0.5 - splat.mean[1]);
                    let fused = (splat.a * dx)
                        .mul_add(1.0, splat.b * dy)
                        .mul_add(dx, (splat.c * dy).mul_add(dy, splat.log2_opacity));
                    let plain = (splat.a * dx + splat.b * dy) * dx + (splat.c * dy * dy + splat.log2_opacity);
                    if fused >= LOG2_ALPHA_MIN || plain >= LOG2_ALPHA_MIN {
                        let rows = reached[(y / TILE * grid.tiles_x + x / TILE) as usize];
                        let row = (y % TILE) as u8;
                        assert!(rows[0] <= row && row <= rows[1], "trial {trial}: pixel {x},{y} lost: {splat:?}");
                    }
                }
            }
        }
        assert!(emitted < boxed, "the ellipse must leave out some tiles of the boxes");
    }

    #[test]
    fn lists_are_in_depth_order_and_k_counts_columns_first() {
        let grid = Grid::new(107, 75);
        let mut draws = Stream::new(6, Purpose::Test, 0, 0);
        // More than two chunks.
        let splats: Vec<Splat> = (0..5000).map(|_| random_splat(&mut draws, false, grid)).collect();
        let (mut counts, mut tile_counts, mut offsets) = (Vec::new(), Vec::new(), Vec::new());
        let (mut tile_offsets, mut cursors, mut isects) = (Vec::new(), Vec::new(), Vec::new());
        count(&splats, grid, SimdPath::best(), &mut counts, &mut tile_counts);
        let total = scan(&counts, &mut offsets);
        isect_offsets(&tile_counts, grid.tiles(), &mut tile_offsets, &mut cursors);
        assert_eq!(tile_offsets[grid.tiles()], total);
        emit(&splats, grid, SimdPath::best(), total, &mut cursors, &mut isects);
        let mut tiles_of = vec![Vec::new(); splats.len()];
        for tile in 0..grid.tiles() {
            let list = &isects[tile_offsets[tile] as usize..tile_offsets[tile + 1] as usize];
            let list: Vec<Isect> = list.iter().map(|bits| Isect::unpack(bits.load(Relaxed))).collect();
            assert!(list.windows(2).all(|w| w[0].rank < w[1].rank));
            for isect in list {
                let (x, y) = grid.position(tile);
                tiles_of[isect.rank as usize].push((isect.k, (x, y)));
            }
        }
        for (rank, mut tiles) in tiles_of.into_iter().enumerate() {
            tiles.sort_unstable();
            assert_eq!(tiles.len(), counts[rank] as usize);
            assert!(tiles.iter().enumerate().all(|(i, t)| t.0 as usize == i));
            assert!(tiles.windows(2).all(|w| w[0].1 < w[1].1), "columns first");
        }
    }
}
