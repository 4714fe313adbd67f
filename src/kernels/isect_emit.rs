//! Emits one intersection for each row and tile that the row can reach.
//!
//! Invariants: 1. a row's tiles are enumerated column by column (tile x outer, tile y inner), and the k-th of them has
//! emit index `first emit index of the row + k`: per-row sums are folded in that order; 2. a tile, or a pixel row of a
//! tile, is skipped only if the computed alpha of all its pixels is below 1/255, so skipping cannot change the image;
//! 3. [`count`] and [`emit`] use the same enumeration as the counts of [`super::splats::pack`]; 4. the result does not
//! depend on the number of threads.

use super::constants::TILE;
use super::radix_sort::chunk_len;
use super::splats::{Grid, Packed, ROWS_PER_CHUNK as ROWS_PER_EMIT_CHUNK, Span, Splat, for_each_column, tile_rows};
use super::tile_range::TileRange;
use crate::base::room;
use crate::base::simd::{Kernel, SimdPath, dispatch, prefetch};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

const ROWS_PER_CHUNK: usize = 2048;
const CHUNKS_MAX: usize = 32;

/// One intersection, packed in 64 bits: row (32), first pixel row in the tile (4), last pixel row (4), k (24).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Isect {
    pub row: u32,
    /// First and last pixel row of the tile, 0 to 15, that it can reach.
    pub pixel_rows: [u8; 2],
    /// Its index among the row's intersections with the tiles of the range, below 2^24.
    pub k: u32,
}

impl Isect {
    /// Packs into 64 bits.
    #[inline(always)]
    pub fn pack(self) -> u64 {
        let [first, last] = self.pixel_rows.map(u64::from);
        u64::from(self.row) | first << 32 | last << 36 | u64::from(self.k) << 40
    }

    #[inline(always)]
    pub fn unpack(bits: u64) -> Self {
        let pixel_rows = [(bits >> 32) as u8 & 15, (bits >> 36) as u8 & 15];
        Isect { row: bits as u32, pixel_rows, k: (bits >> 40) as u32 }
    }
}

/// Calls `each(tile, pixel rows within the tile)` for every tile that a row can reach, in emit order; with `CUT`, for every
/// such tile of the range.
#[inline(always)]
fn for_each_tile<const CUT: bool>(
    splat: &Splat,
    span: &Span,
    grid: Grid,
    range: &TileRange,
    mut each: impl FnMut(usize, [u8; 2]),
) {
    for_each_column::<CUT>(splat, span, grid, range.columns, |x, rows| {
        for y in tile_rows(rows) {
            if CUT && !(u32::from(range.rows[0])..u32::from(range.rows[1])).contains(&y) {
                continue;
            }
            let top = (y * TILE) as i32;
            let [first, last] = rows.map(|row| (i32::from(row) - top).clamp(0, TILE as i32 - 1) as u8);
            each(y as usize * grid.tiles_x as usize + usize::from(x), [first, last]);
        }
    });
}

/// Calls `each(row, tile, pixel rows, k)` for every intersection of a chunk of the drawn rows with the tiles of a range, front to
/// back. `CUT`: the range is a part of the picture; all tiles need not pay for its tests.
struct EachIsect<'a, F, const CUT: bool> {
    order: &'a [u32],
    packed: &'a Packed,
    grid: Grid,
    range: TileRange,
    each: F,
}

fn each_isect(
    simd: SimdPath,
    (order, packed): (&[u32], &Packed),
    (grid, range): (Grid, TileRange),
    each: impl FnMut(u32, usize, [u8; 2], u32),
) {
    match range.is_all(grid) {
        true => dispatch(simd, EachIsect::<_, false> { order, packed, grid, range, each }),
        false => dispatch(simd, EachIsect::<_, true> { order, packed, grid, range, each }),
    }
}

impl<F: FnMut(u32, usize, [u8; 2], u32), const CUT: bool> Kernel for EachIsect<'_, F, CUT> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(mut self) {
        let Packed { splats, spans, .. } = self.packed;
        for (i, &row) in self.order.iter().enumerate() {
            // Depth order is random order in memory.
            if let Some(&ahead) = self.order.get(i + 24) {
                prefetch(spans, ahead as usize);
            }
            let mut k = 0;
            let (splat, span) = (&splats[row as usize], &spans[row as usize]);
            for_each_tile::<CUT>(splat, span, self.grid, &self.range, |tile, pixel_rows| {
                (self.each)(row, tile, pixel_rows, k);
                k += 1;
            });
        }
    }
}

/// Counts the intersections with the tiles of `range` as `[chunks][tiles]` for [`super::isect_offsets`]; a chunk is a part
/// of `order`, the drawn rows front to back.
pub fn count(order: &[u32], packed: &Packed, grid: Grid, range: TileRange, simd: SimdPath, tile_counts: &mut Vec<u32>) {
    let tiles = grid.tiles();
    let len = chunk_len(order.len(), ROWS_PER_CHUNK, CHUNKS_MAX);
    tile_counts.clear();
    room::resize(tile_counts, order.len().div_ceil(len) * tiles, 0);
    if tiles == 0 {
        return;
    }
    order.par_chunks(len).zip(tile_counts.par_chunks_mut(tiles)).for_each(|(order, tile_counts)| {
        let each = |_, tile: usize, _, _| tile_counts[tile] += 1;
        each_isect(simd, (order, packed), (grid, range), each);
    });
}

/// Writes each intersection with a tile of `range` (as [`Isect::pack`]) to its place in its tile's list. Consumes `cursors`,
/// which comes from [`super::isect_offsets`]; `isects` is resized to `total`.
pub fn emit(
    order: &[u32],
    packed: &Packed,
    grid: Grid,
    range: TileRange,
    simd: SimdPath,
    total: u64,
    cursors: &mut [u64],
    isects: &mut Vec<AtomicU64>,
) {
    let tiles = grid.tiles();
    let len = chunk_len(order.len(), ROWS_PER_CHUNK, CHUNKS_MAX);
    room::resize_with(isects, total as usize, AtomicU64::default);
    if tiles == 0 {
        return;
    }
    let isects = &*isects;
    order.par_chunks(len).zip(cursors.par_chunks_mut(tiles)).for_each(|(order, cursors)| {
        let each = |row, tile: usize, pixel_rows, k| {
            let place = &mut cursors[tile];
            isects[*place as usize].store(Isect { row, pixel_rows, k }.pack(), Relaxed);
            *place += 1;
        };
        each_isect(simd, (order, packed), (grid, range), each);
    });
}

/// Numbers the intersections of a range in emit order, as [`super::splats::pack`] does for all tiles: sets
/// [`Splat::emit`], writes the number of intersections of each row to `counts`, and their sums by chunk to `chunk_counts`.
pub fn number_isects(
    packed: &mut Packed,
    grid: Grid,
    range: TileRange,
    simd: SimdPath,
    counts: &mut Vec<u32>,
    chunk_counts: &mut Vec<u64>,
) {
    let Packed { splats, spans, counts: of_all, .. } = packed;
    room::resize(counts, of_all.len(), 0);
    room::resize(chunk_counts, of_all.len().div_ceil(ROWS_PER_EMIT_CHUNK), 0);
    let rows = (splats.par_chunks_mut(ROWS_PER_EMIT_CHUNK), spans.par_chunks(ROWS_PER_EMIT_CHUNK)).into_par_iter();
    let out = (counts.par_chunks_mut(ROWS_PER_EMIT_CHUNK), chunk_counts.par_iter_mut()).into_par_iter();
    rows.zip(of_all.par_chunks(ROWS_PER_EMIT_CHUNK)).zip(out).for_each(|(((splats, spans), of_all), (counts, sum))| {
        *sum = dispatch(simd, NumberChunk { splats, spans, of_all, grid, range, counts });
    });
}

struct NumberChunk<'a> {
    splats: &'a mut [Splat],
    spans: &'a [Span],
    /// Intersections of each row with all tiles; 0 for rows that are not drawn.
    of_all: &'a [u32],
    grid: Grid,
    range: TileRange,
    counts: &'a mut [u32],
}

impl Kernel for NumberChunk<'_> {
    /// Sum of the counts.
    type Out = u64;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> u64 {
        let mut emit = 0;
        for (i, splat) in self.splats.iter_mut().enumerate() {
            let mut count = 0;
            if self.of_all[i] > 0 {
                for_each_tile::<true>(splat, &self.spans[i], self.grid, &self.range, |_, _| count += 1);
            }
            (splat.emit, self.counts[i]) = (emit, count);
            emit += u64::from(count);
        }
        emit
    }
}

#[cfg(test)]
pub(in crate::kernels) mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::kernels::isect_offsets::isect_offsets;
    use crate::kernels::project_fwd::Projected;
    use crate::kernels::scan::scan;
    use crate::kernels::splats::{LOG2_ALPHA_MIN, pack};

    /// Footprints of all kinds on and around a picture, all at depth 1, packed; and the footprints themselves.
    pub(in crate::kernels) fn random_rows(n: usize, needles: bool, seed: u64, grid: Grid) -> (Packed, Projected) {
        let mut draws = Stream::new(21, Purpose::Test, seed, u64::from(needles));
        let mut p = Projected::default();
        let mut colors = Vec::new();
        for _ in 0..n {
            let major = draws.range(-1.0, if needles { 9.0 } else { 4.0 }).exp2();
            let minor = if needles { 0.6 } else { draws.range(-1.0, 3.0).exp2() };
            let (sin, cos) = draws.range(0.0, 3.2).sin_cos();
            let (u, v) = (1.0 / (major * major), 1.0 / (minor * minor));
            let conic = [u * cos * cos + v * sin * sin, (u - v) * sin * cos, u * sin * sin + v * cos * cos];
            let [width, height] = [grid.width, grid.height].map(f64::from);
            p.means2d.push([draws.range(-20.0, width + 20.0) as f32, draws.range(-20.0, height + 17.0) as f32]);
            p.conics.push(conic.map(|x| x as f32));
            p.radii.push([conic[2], conic[0]].map(|x| (3.33 * (x / (u * v)).sqrt()).ceil() as u32));
            // A third of the opacities can reach the clamp.
            p.opacities.push((draws.range(0.0, 1.5) as f32).min(1.0));
            p.depths.push(1.0);
            colors.push([0; 3].map(|_| draws.range(0.0, 1.5) as f32));
        }
        let mut packed = Packed::default();
        pack(&p, &colors, grid, SimdPath::best(), &mut packed);
        (packed, p)
    }

    /// Every pixel of the box whose exponent reaches the threshold must be in an emitted tile and row.
    #[test]
    fn no_contribution_is_left_out() {
        let grid = Grid::new(107, 75);
        for needles in [false, true] {
            let (packed, projected) = random_rows(2000, needles, 0, grid);
            let (mut emitted, mut boxed) = (0, 0.0);
            for row in 0..2000 {
                let (splat, [rx, ry]) = (packed.splats[row], projected.radii[row].map(|r| r as f32));
                let mut reached = vec![[16u8, 0]; grid.tiles()];
                let mut last = None;
                for_each_tile::<false>(&splat, &packed.spans[row], grid, &TileRange::all(grid), |tile, rows| {
                    // Sums over a row's tiles are folded in this order, so that a view may be cut at tile columns.
                    let place = Some(grid.position(tile));
                    assert!(last < place, "tiles come once, column by column: {place:?} after {last:?}");
                    last = place;
                    reached[tile] = rows;
                    emitted += 1;
                });
                for y in 0..grid.height {
                    for x in 0..grid.width {
                        let (dx, dy) = (x as f32 + 0.5 - splat.mean[0], y as f32 + 0.5 - splat.mean[1]);
                        if dx.abs() > rx || dy.abs() > ry {
                            continue;
                        }
                        boxed += 1.0 / 256.0;
                        let constant = (splat.c * dy).mul_add(dy, splat.log2_opacity);
                        let fused = splat.a.mul_add(dx, splat.b * dy).mul_add(dx, constant);
                        let plain = (splat.a * dx + splat.b * dy) * dx + (splat.c * dy * dy + splat.log2_opacity);
                        if fused >= LOG2_ALPHA_MIN || plain >= LOG2_ALPHA_MIN {
                            let rows = reached[(y / TILE * grid.tiles_x + x / TILE) as usize];
                            let y_in = (y % TILE) as u8;
                            assert!(rows[0] <= y_in && y_in <= rows[1], "row {row}: {x},{y} lost: {splat:?}");
                        }
                    }
                }
            }
            assert!(!needles || f64::from(emitted) < boxed, "needles must leave out tiles: {emitted} of {boxed}");
        }
    }

    #[test]
    fn lists_are_in_depth_order_and_k_counts_columns_first() {
        let grid = Grid::new(107, 75);
        // More than two chunks, in an order other than that of the rows.
        let (packed, _) = random_rows(5000, false, 1, grid);
        let order: Vec<u32> = (0..5000).map(|i| i * 7 % 5000).collect();
        let mut rank = vec![0; 5000];
        order.iter().enumerate().for_each(|(i, &row)| rank[row as usize] = i);
        let (mut tile_counts, mut offsets) = (Vec::new(), Vec::new());
        let (mut tile_offsets, mut cursors, mut isects) = (Vec::new(), Vec::new(), Vec::new());
        count(&order, &packed, grid, TileRange::all(grid), SimdPath::best(), &mut tile_counts);
        let total = scan(&packed.chunk_counts, &mut offsets);
        isect_offsets(&tile_counts, grid.tiles(), &mut tile_offsets, &mut cursors);
        assert_eq!(tile_offsets[grid.tiles()], total);
        emit(&order, &packed, grid, TileRange::all(grid), SimdPath::best(), total, &mut cursors, &mut isects);
        let mut tiles_of = vec![Vec::new(); 5000];
        for tile in 0..grid.tiles() {
            let list = &isects[tile_offsets[tile] as usize..tile_offsets[tile + 1] as usize];
            let list: Vec<Isect> = list.iter().map(|bits| Isect::unpack(bits.load(Relaxed))).collect();
            assert!(list.windows(2).all(|w| rank[w[0].row as usize] < rank[w[1].row as usize]));
            for isect in list {
                tiles_of[isect.row as usize].push((isect.k, grid.position(tile)));
            }
        }
        for (row, mut tiles) in tiles_of.into_iter().enumerate() {
            tiles.sort_unstable();
            assert_eq!(tiles.len(), packed.counts[row] as usize);
            assert!(tiles.iter().enumerate().all(|(i, t)| t.0 as usize == i));
            assert!(tiles.windows(2).all(|w| w[0].1 < w[1].1), "columns first");
        }
    }
}
