//! Gradients of footprints and colours from the gradient of the image, back to front through each tile's list.
//!
//! With h = alpha dL/dalpha (zero where alpha is clamped), a splat needs only nine sums over a tile's pixels: h, h dx,
//! h dy, h dx^2, h dx dy, h dy^2 and weight v_rgb. The gradients are linear in these sums and are computed once per
//! row ([`super::fold`]). On demand two more sums are collected, statistics for densification: weight = alpha T, and weight times a value
//! of the pixel, its error.
//!
//! Invariants: 1. where opacity exp(-sigma) > max_alpha, no gradient passes through alpha, only through the colour; 2.
//! a splat that contributes to no pixel gets exact zeros; 3. threads cannot change a bit; 4. collecting weights changes no
//! bit of the nine sums.

use super::constants::TILE;
use super::fold::{Partial, SUMS, WeightPartial};
use super::lanes::Lane;
use super::raster::{Lists, TILE_PIXELS, copy_lanes, exp2_bounded, log2_max_alpha};
use super::rasterize_fwd::Raster;
use super::splats::{LOG2_ALPHA_MIN, ROWS_PER_CHUNK};
use super::tile_block::{Block, Local, ROWS, prefetch_list, prefetch_splats};
use crate::base::room;
use crate::base::simd::{Kernel, LANES, dispatch, fma, prefetch};
use rayon::prelude::*;
use std::cell::RefCell;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

/// The statistics that [`rasterize_bwd`] collects besides gradients.
#[derive(Debug)]
pub struct Weighing<'a> {
    /// Error of each pixel, `[height][width]`.
    pub errors: &'a [f32],
    /// The sums of every intersection at its emit index; resized.
    pub partials: &'a mut Vec<WeightPartial>,
}

/// Gradient of the loss with respect to the image.
#[derive(Debug, Clone, Copy)]
pub struct Upstream<'a> {
    /// `[3][height][width]`.
    pub v_rgb: &'a [f32],
    /// `[height][width]`, for alpha = 1 - T.
    pub v_alpha: Option<&'a [f32]>,
}

/// State of one row of a tile in the backward pass. One block of memory, so that the compiler sees that its parts do
/// not overlap.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Row {
    /// Transmittance in front of the splats processed so far (initially: behind everything).
    t: Lane,
    /// Colour seen behind the splats processed so far, dotted with v_rgb, as if nothing were in front; initially that
    /// of the background, minus v_alpha.
    behind: Lane,
    v_rgb: [Lane; 3],
    /// Error of the pixels; zeros unless weights are collected.
    error: Lane,
    /// List index at which the lane stopped: entries from there on do not affect it.
    stop: [u32; LANES],
}

/// Splats prepared together: with their sums, half of a first-level cache.
const BLOCK: usize = 32;

/// State of one tile in the backward pass.
struct Tile {
    rows: [Row; ROWS],
    /// Largest stop of each row.
    row_stop: [u32; ROWS],
    block: Block<BLOCK>,
    sums: [Sums; BLOCK],
    weights: [[Lane; 2]; BLOCK],
    halves: [Halves; BLOCK],
}

thread_local! {
    /// Each thread reuses its own: initialising one for every tile would cost as much as about a hundred splats.
    static SCRATCH: RefCell<Box<Tile>> = RefCell::new(Box::new(Tile {
        rows: [Row::EMPTY; ROWS],
        row_stop: [0; ROWS],
        block: Block::new(),
        sums: [Sums::default(); BLOCK],
        weights: [[[0.0; LANES]; 2]; BLOCK],
        halves: [Halves::default(); BLOCK],
    }));
}

impl Row {
    const EMPTY: Row =
        Row { t: [0.0; LANES], behind: [0.0; LANES], v_rgb: [[0.0; LANES]; 3], error: [0.0; LANES], stop: [0; LANES] };
}

impl Tile {
    #[inline(always)]
    fn load(&mut self, lists: &Lists<'_>, raster: &Raster, upstream: &Upstream<'_>, errors: &[f32], tile: usize) {
        let grid = lists.grid;
        let (tx, ty) = grid.position(tile);
        let columns = (grid.width - tx * TILE).min(TILE) as usize;
        let rows = (grid.height - ty * TILE).min(TILE) as usize;
        let pixels = grid.width as usize * grid.height as usize;
        self.rows = [Row::EMPTY; ROWS];
        self.row_stop = [0; ROWS];
        for (row, out) in self.rows[..rows].iter_mut().enumerate() {
            let from = (ty as usize * ROWS + row) * grid.width as usize + tx as usize * LANES;
            for c in 0..3 {
                copy_lanes(&mut out.v_rgb[c][..columns], &upstream.v_rgb[c * pixels + from..]);
            }
            if !errors.is_empty() {
                copy_lanes(&mut out.error[..columns], &errors[from..]);
            }
            let within = tile * TILE_PIXELS + row * LANES;
            let v_alpha = upstream.v_alpha.map(|v| &v[from..from + columns]);
            for lane in 0..columns {
                let t = raster.t_final[within + lane];
                let mut v = -v_alpha.map_or(0.0, |v| v[lane]);
                for c in 0..3 {
                    v += lists.background[c] * out.v_rgb[c][lane];
                }
                out.t[lane] = t;
                out.behind[lane] = v;
            }
            out.stop[..columns].copy_from_slice(&raster.stop[within..within + columns]);
            self.row_stop[row] = out.stop.iter().fold(0, |m, s| m.max(*s));
        }
    }
}

/// The way back through any tile.
#[derive(Clone, Copy)]
struct Back<'a> {
    lists: &'a Lists<'a>,
    chunk_offsets: &'a [u64],
    raster: &'a Raster,
    upstream: &'a Upstream<'a>,
    cap: f32,
    partials: &'a [Partial],
    /// Empty unless weights are collected.
    errors: &'a [f32],
    weight_partials: &'a [WeightPartial],
    weighs: bool,
}

/// The way back through one tile.
struct BackTile<'a> {
    back: Back<'a>,
    tile: usize,
    state: &'a mut Tile,
}

impl Kernel for BackTile<'_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        if self.back.weighs { self.go_back::<FMA, true>() } else { self.go_back::<FMA, false>() }
    }
}

impl BackTile<'_> {
    /// Goes back to front; `WEIGHS` collects weights.
    #[inline(always)]
    fn go_back<const FMA: bool, const WEIGHS: bool>(self) {
        let BackTile { back, tile, state } = self;
        let Back { lists, chunk_offsets, raster, upstream, cap, partials, errors, weight_partials, .. } = back;
        state.load(lists, raster, upstream, errors, tile);
        let Tile { rows, row_stop, block, sums, weights, halves } = state;
        let (tx, ty) = lists.grid.position(tile);
        let (x0, y0) = ((tx * TILE) as f32 + 0.5, (ty * TILE) as f32 + 0.5);
        let mut x = [0.0; LANES];
        for lane in 0..LANES {
            x[lane] = x0 + lane as f32;
        }
        let last_stop = row_stop.iter().fold(0, |m, s| m.max(*s));
        let all = lists.tile(tile);
        for (number, list) in all.chunks(BLOCK).enumerate().rev() {
            let first = (number * BLOCK) as u32;
            if first >= last_stop {
                continue;
            }
            block.fill::<FMA>(list, lists.splats, y0, cap);
            // The entries of the block after next are loaded, and with the entries of the next block its splats. After the
            // last block comes the last of the next tile: the same thread most likely goes on there.
            let of_next_tile = last_block(lists.tile_or_empty(tile + 1));
            prefetch_list(match number {
                0 => &[],
                1 => of_next_tile,
                _ => last_block(&all[..(number - 1) * BLOCK]),
            });
            prefetch_splats(if number > 0 { last_block(&all[..number * BLOCK]) } else { of_next_tile }, lists.splats);
            let mut touched = 0;
            for (reach, &stop) in block.reach.iter_mut().zip(row_stop.iter()) {
                // Splats at or after the row's last stop have no effect.
                let before = stop.saturating_sub(first);
                *reach &= if before < BLOCK as u32 { (1u64 << before) - 1 } else { u64::MAX };
                touched |= *reach;
            }
            for i in bits(touched) {
                prefetch(partials, index_of(chunk_offsets, &block.locals[i]));
                sums[i] = Sums::default();
                if WEIGHS {
                    weights[i] = [[0.0; LANES]; 2];
                }
            }
            for (y, row) in rows.iter_mut().enumerate() {
                back_row::<FMA, WEIGHS>(row, y, first, block, &x, cap, (sums, weights));
            }
            for i in bits(touched) {
                halves[i] = sums[i].halves(&x, block.locals[i].mean_x);
            }
            for i in bits(touched) {
                let at = index_of(chunk_offsets, &block.locals[i]);
                for (out, half) in partials[at].iter().zip(&halves[i].0) {
                    out.store(sum_of_half(half).to_bits(), Relaxed);
                }
                if WEIGHS {
                    for (out, lanes) in weight_partials[at].iter().zip(&weights[i]) {
                        let mut half = [0.0; 8];
                        for lane in 0..8 {
                            half[lane] = lanes[lane] + lanes[lane + 8];
                        }
                        out.store(sum_of_half(&half).to_bits(), Relaxed);
                    }
                }
            }
        }
    }
}

/// The last entries of a list, as many as a block holds or fewer, so that whole blocks come before them.
#[inline(always)]
fn last_block(list: &[AtomicU64]) -> &[AtomicU64] {
    &list[list.len().saturating_sub(1) / BLOCK * BLOCK..]
}

/// The emit index of an intersection.
#[inline(always)]
fn index_of(chunk_offsets: &[u64], local: &Local) -> usize {
    (chunk_offsets[local.row as usize / ROWS_PER_CHUNK] + local.emit) as usize
}

/// The last steps of the sum over lanes, pairwise.
#[inline(always)]
fn sum_of_half(half: &[f32; 8]) -> f32 {
    let mut four = [0.0; 4];
    for lane in 0..4 {
        four[lane] = half[lane] + half[lane + 4];
    }
    (four[0] + four[2]) + (four[1] + four[3])
}

/// Indices of the set bits, ascending.
#[inline(always)]
fn bits(mut set: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let i = set.trailing_zeros() as usize % BLOCK;
        let some = set != 0;
        set &= set.wrapping_sub(1);
        some.then_some(i)
    })
}

/// Sums of one splat in one tile, by lane.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
struct Sums {
    h: Lane,
    hy: Lane,
    hyy: Lane,
    rgb: [Lane; 3],
}

/// The nine sums with lanes i and i + 8 added.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
struct Halves([[f32; 8]; SUMS]);

impl Sums {
    /// The nine sums of one lane. No closure: one that is not inlined is compiled without vector instructions.
    #[inline(always)]
    fn of_lane(&self, x: &Lane, mean_x: f32, lane: usize) -> [f32; SUMS] {
        let (dx, h, hy) = (x[lane] - mean_x, self.h[lane], self.hy[lane]);
        let hx = h * dx;
        let [red, green, blue] = &self.rgb;
        [h, hx, hy, hx * dx, hy * dx, self.hyy[lane], red[lane], green[lane], blue[lane]]
    }

    /// First step of the sum over lanes (pairwise halving, in the same order on every path). dx is constant in a lane,
    /// so its moments are formed here.
    #[inline(always)]
    fn halves(&self, x: &Lane, mean_x: f32) -> Halves {
        let mut out = Halves::default();
        for i in 0..8 {
            let (left, right) = (self.of_lane(x, mean_x, i), self.of_lane(x, mean_x, i + 8));
            for s in 0..SUMS {
                out.0[s][i] = left[s] + right[s];
            }
        }
        out
    }
}

/// Processes one row of a tile, whose pixel centres are at `x`, through a block that begins at list index `first`.
#[inline(always)]
fn back_row<const FMA: bool, const WEIGHS: bool>(
    row: &mut Row,
    y: usize,
    first: u32,
    block: &Block<BLOCK>,
    x: &Lane,
    cap: f32,
    (sums, weights): (&mut [Sums; BLOCK], &mut [[Lane; 2]; BLOCK]),
) {
    let mut reach = block.reach[y];
    let Row { mut t, mut behind, v_rgb: [v_red, v_green, v_blue], error, stop } = *row;
    while reach != 0 {
        let i = reach.ilog2() as usize % BLOCK;
        reach ^= 1 << i;
        let (local, acc, weighed) = (&block.locals[i], &mut sums[i], &mut weights[i]);
        let at = first + i as u32;
        // Loaded once: a load under the loop's conditions would become a gather.
        let (dy, bdy, cdy, top, color) = (local.dy[y], local.bdy[y], local.cdy[y], local.top, local.color);
        for lane in 0..LANES {
            let dx = x[lane] - local.mean_x;
            let e = fma::<FMA>(fma::<FMA>(local.a, dx, bdy), dx, cdy);
            let clamped = if e < top { e } else { top };
            let active = (e >= LOG2_ALPHA_MIN) & (at < stop[lane]);
            let alpha = if active { exp2_bounded::<FMA>(clamped) } else { 0.0 };
            let before = t[lane] * (1.0 / (1.0 - alpha));
            let weight = alpha * before;
            let q = color[2] * v_blue[lane];
            let q = fma::<FMA>(color[0], v_red[lane], fma::<FMA>(color[1], v_green[lane], q));
            // alpha dL/dalpha = weight (colour of the splat - colour it hides)
            let over = q - behind[lane];
            let h = if e <= cap { weight * over } else { 0.0 };
            t[lane] = before;
            behind[lane] = fma::<FMA>(alpha, over, behind[lane]);
            let hy = h * dy;
            acc.h[lane] += h;
            acc.hy[lane] += hy;
            acc.hyy[lane] = fma::<FMA>(hy, dy, acc.hyy[lane]);
            acc.rgb[0][lane] = fma::<FMA>(weight, v_red[lane], acc.rgb[0][lane]);
            acc.rgb[1][lane] = fma::<FMA>(weight, v_green[lane], acc.rgb[1][lane]);
            acc.rgb[2][lane] = fma::<FMA>(weight, v_blue[lane], acc.rgb[2][lane]);
            if WEIGHS {
                weighed[0][lane] += weight;
                weighed[1][lane] = fma::<FMA>(weight, error[lane], weighed[1][lane]);
            }
        }
    }
    (row.t, row.behind) = (t, behind);
}

/// Writes the sums of every intersection to its emit index in `partials`, which is resized, and the weights likewise if
/// `weighing` asks for them. `chunk_offsets` are the first emit indices of the chunks of [`ROWS_PER_CHUNK`] rows.
pub fn rasterize_bwd(
    lists: &Lists<'_>,
    chunk_offsets: &[u64],
    raster: &Raster,
    upstream: &Upstream<'_>,
    partials: &mut Vec<Partial>,
    weighing: Option<Weighing<'_>>,
) {
    let cap = log2_max_alpha(lists.max_alpha, lists.simd);
    reset(partials, lists.isects.len());
    let weighs = weighing.is_some();
    let (errors, weight_partials) = match weighing {
        Some(Weighing { errors, partials }) => {
            reset(partials, lists.isects.len());
            (errors, &partials[..])
        }
        None => (&[][..], &[][..]),
    };
    let tiles = (0..lists.grid.tiles()).into_par_iter().filter(|tile| lists.range.contains(lists.grid, *tile));
    let back = Back { lists, chunk_offsets, raster, upstream, cap, partials, errors, weight_partials, weighs };
    tiles.for_each(|tile| {
        SCRATCH.with_borrow_mut(|state| dispatch(lists.simd, BackTile { back, tile, state }));
    });
}

/// Resizes sums to this number of intersections and zeroes everything in memory order: cheaper than writing single zeros
/// for splats without effect.
fn reset<const N: usize>(partials: &mut Vec<[AtomicU32; N]>, isects: usize) {
    room::resize_with(partials, isects, || std::array::from_fn(|_| AtomicU32::new(0)));
    partials.par_chunks_mut(16_384).for_each(|partials| {
        partials.iter_mut().flatten().for_each(|sum| *sum.get_mut() = 0);
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::base::simd::SimdPath;
    use crate::kernels::isect_emit::Isect;
    use crate::kernels::rasterize_fwd::{rasterize_fwd, tests::scene};

    fn sums(lists: &Lists<'_>, chunk_offsets: &[u64]) -> Vec<f32> {
        let pixels = (lists.grid.width * lists.grid.height) as usize;
        let mut draws = Stream::new(22, Purpose::Test, 0, 0);
        let v_rgb: Vec<f32> = (0..3 * pixels).map(|_| draws.normal() as f32).collect();
        let v_alpha: Vec<f32> = (0..pixels).map(|_| draws.normal() as f32).collect();
        let mut raster = Raster::default();
        rasterize_fwd(lists, &mut raster);
        let mut partials = Vec::new();
        let upstream = Upstream { v_rgb: &v_rgb, v_alpha: Some(&v_alpha) };
        rasterize_bwd(lists, chunk_offsets, &raster, &upstream, &mut partials, None);
        partials.iter().flatten().map(|x| f32::from_bits(x.load(Relaxed))).collect()
    }

    #[test]
    fn rows_that_are_skipped_add_nothing() {
        for simd in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
            for (n, needles) in [(60, false), (2000, false), (300, true)] {
                let mut scene = scene(n, needles);
                let fast = sums(&scene.lists(simd), &scene.chunk_offsets);
                for bits in &mut scene.isects {
                    let isect = Isect::unpack(bits.load(Relaxed));
                    *bits.get_mut() = Isect { pixel_rows: [0, 15], ..isect }.pack();
                }
                // Compared as values, not bits: a sum of nothing is 0.0, a sum of zeros may be -0.0.
                assert!(fast == sums(&scene.lists(simd), &scene.chunk_offsets), "{simd:?} {n}");
                assert!(fast.iter().any(|x| *x != 0.0) && fast.iter().all(|x| x.is_finite()));
            }
        }
    }
}
