//! Blends each tile's list of splats front to back.
//!
//! Contract: a pixel (centre +0.5) processes its tile's list in depth order. A splat contributes `alpha =
//! min(max_alpha, opacity exp(-sigma))`; below 1/255 it is skipped; if T (1 - alpha) <= 1e-4 the pixel stops without
//! it; otherwise `rgb += T alpha color` and `T *= 1 - alpha`. At the end `rgb += T background`.
//!
//! Invariants: 1. a sigma below 0 is a rounding error (conics are positive definite) and counts as 0; 2. skipped rows
//! of a tile have no contribution, so the image has the same bits as a plain loop over all splats of the tile; 3. AVX2
//! and AVX-512 give the same bits; 4. tiles are independent, so threads cannot change a bit.
//!
//! The unit of work is a pixel row of a tile, 16 lanes, through a block of splats (see `tile_block`). Dead lanes
//! (stopped, or outside the image) keep T = 0, so they add nothing, and a `floor` of -1, so they never stop again: the
//! inner loop needs no other test.

use super::constants::{TILE, TRANSMITTANCE_MIN};
use super::lanes::Lane;
use super::raster::{Lists, NEVER, TILE_PIXELS, copy_lanes, exp2_bounded, log2_max_alpha};
use super::splats::{Grid, LOG2_ALPHA_MIN};
use super::tile_block::{Block, ROWS, prefetch_splats};
use crate::base::room;
use crate::base::simd::{Kernel, LANES, dispatch, fma};
use rayon::prelude::*;
use std::cell::RefCell;

/// Output of the forward pass, tile by tile (`[tiles][...][16][16]`).
#[derive(Debug, Clone, Default)]
pub struct Raster {
    /// `[tiles][3][16][16]` colours.
    pub rgb: Vec<f32>,
    /// `[tiles][16][16]` transmittance after the last contribution.
    pub t_final: Vec<f32>,
    /// `[tiles][16][16]` index in the tile's list of the splat at which the pixel stopped, or [`NEVER`].
    pub stop: Vec<u32>,
    /// `[tiles]` number of pixel-splat pairs evaluated.
    pub evaluated: Vec<u64>,
}

impl Raster {
    /// Sets the size, keeping allocations; the content is unspecified.
    pub fn resize(&mut self, tiles: usize) {
        room::resize(&mut self.rgb, tiles * 3 * TILE_PIXELS, 0.0);
        room::resize(&mut self.t_final, tiles * TILE_PIXELS, 0.0);
        room::resize(&mut self.stop, tiles * TILE_PIXELS, 0);
        room::resize(&mut self.evaluated, tiles, 0);
    }

    /// Bytes kept between views.
    pub fn bytes(&self) -> u64 {
        let words = self.rgb.capacity() + self.t_final.capacity() + self.stop.capacity();
        (4 * words + 8 * self.evaluated.capacity()) as u64
    }
}

/// Splats prepared together: their locals fill a quarter of a first-level cache.
const BLOCK: usize = 64;

/// State of one row of a tile.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Row {
    t: Lane,
    /// A lane stops when its T would fall to this or below; -1 for dead lanes.
    floor: Lane,
    rgb: [Lane; 3],
    t_final: Lane,
    stop: [u32; LANES],
    /// Whether any lane is alive.
    alive: bool,
}

impl Row {
    const DEAD: Row = Row {
        t: [0.0; LANES],
        floor: [-1.0; LANES],
        rgb: [[0.0; LANES]; 3],
        t_final: [0.0; LANES],
        stop: [NEVER; LANES],
        alive: false,
    };

    /// Stops the lanes whose next transmittance is at or below their floor, at list index `at`.
    #[inline(always)]
    fn stop_lanes(&mut self, at: u32, t: &Lane, next: &mut Lane, weight: &mut Lane) {
        let mut alive = false;
        for lane in 0..LANES {
            let stops = next[lane] <= self.floor[lane];
            self.t_final[lane] = if stops { t[lane] } else { self.t_final[lane] };
            self.stop[lane] = if stops { at } else { self.stop[lane] };
            self.floor[lane] = if stops { -1.0 } else { self.floor[lane] };
            next[lane] = if stops { 0.0 } else { next[lane] };
            weight[lane] = if stops { 0.0 } else { weight[lane] };
            alive |= self.floor[lane] > 0.0;
        }
        self.alive = alive;
    }
}

/// State of one tile.
struct Tile {
    rows: [Row; ROWS],
    block: Block<BLOCK>,
}

thread_local! {
    /// Each thread reuses its own: initialising one for every tile would cost as much as blending a few hundred splats.
    static SCRATCH: RefCell<Box<Tile>> = RefCell::new(Box::new(Tile { rows: [Row::DEAD; ROWS], block: Block::new() }));
}

impl Tile {
    #[inline(always)]
    fn reset(&mut self, grid: Grid, tile: usize) {
        let (tx, ty) = grid.position(tile);
        let columns = (grid.width - tx * TILE).min(TILE) as usize;
        let rows = (grid.height - ty * TILE).min(TILE) as usize;
        let mut live = Row { alive: true, ..Row::DEAD };
        live.t[..columns].fill(1.0);
        live.floor[..columns].fill(TRANSMITTANCE_MIN);
        self.rows[..rows].fill(live);
        self.rows[rows..].fill(Row::DEAD);
    }

    #[inline(always)]
    fn write(&self, background: [f32; 3], rgb: &mut [f32], t_final: &mut [f32], stop: &mut [u32]) {
        for (row, state) in self.rows.iter().enumerate() {
            let at = row * LANES..(row + 1) * LANES;
            let t_out = &mut t_final[at.clone()];
            for lane in 0..LANES {
                t_out[lane] = if state.floor[lane] > 0.0 { state.t[lane] } else { state.t_final[lane] };
            }
            stop[at].copy_from_slice(&state.stop);
            for c in 0..3 {
                let out = &mut rgb[c * TILE_PIXELS + row * LANES..][..LANES];
                for lane in 0..LANES {
                    out[lane] = state.rgb[c][lane] + t_out[lane] * background[c];
                }
            }
        }
    }
}

struct BlendTile<'a> {
    lists: &'a Lists<'a>,
    tile: usize,
    cap: f32,
    state: &'a mut Tile,
    rgb: &'a mut [f32],
    t_final: &'a mut [f32],
    stop: &'a mut [u32],
}

impl Kernel for BlendTile<'_> {
    /// Number of splats evaluated.
    type Out = u64;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> u64 {
        let BlendTile { lists, tile, cap, state, rgb, t_final, stop } = self;
        state.reset(lists.grid, tile);
        let Tile { rows, block } = state;
        let (tx, ty) = lists.grid.position(tile);
        let (x0, y0) = ((tx * TILE) as f32 + 0.5, (ty * TILE) as f32 + 0.5);
        let mut rows_done = 0u64;
        let all = lists.tile(tile);
        for (number, list) in all.chunks(BLOCK).enumerate() {
            block.fill::<FMA>(list, lists.splats, y0, cap);
            let coming = match (number + 1) * BLOCK {
                at if at < all.len() => &all[at..],
                // The same thread most likely goes on with the next tile.
                _ => lists.tile_or_empty(tile + 1),
            };
            prefetch_splats(&coming[..coming.len().min(BLOCK)], lists.splats);
            let mut alive = false;
            for (y, row) in rows.iter_mut().enumerate() {
                if row.alive {
                    rows_done += blend_row::<FMA>(row, y, (number * BLOCK) as u32, block, x0);
                    alive |= row.alive;
                }
            }
            if !alive {
                break;
            }
        }
        state.write(lists.background, rgb, t_final, stop);
        rows_done
    }
}

/// One row of a tile through a block that begins at list index `first`; returns the number of splats evaluated.
#[inline(always)]
fn blend_row<const FMA: bool>(row: &mut Row, y: usize, first: u32, block: &Block<BLOCK>, x0: f32) -> u64 {
    let mut reach = block.reach[y];
    let count = u64::from(reach.count_ones());
    let (mut t, mut rgb) = (row.t, row.rgb);
    let x: Lane = std::array::from_fn(|lane| x0 + lane as f32);
    while reach != 0 {
        let i = reach.trailing_zeros() as usize % BLOCK;
        reach &= reach - 1;
        let local = &block.locals[i];
        // Loaded once: a load under the loop's conditions would become a gather.
        let (bdy, cdy, top) = (local.bdy[y], local.cdy[y], local.top);
        let (mut weight, mut next) = ([0.0; LANES], [0.0; LANES]);
        let mut stops = false;
        for lane in 0..LANES {
            let dx = x[lane] - local.mean_x;
            let e = fma::<FMA>(fma::<FMA>(local.a, dx, bdy), dx, cdy);
            let clamped = if e < top { e } else { top };
            let alpha = if e >= LOG2_ALPHA_MIN { exp2_bounded::<FMA>(clamped) } else { 0.0 };
            weight[lane] = alpha * t[lane];
            next[lane] = fma::<FMA>(-alpha, t[lane], t[lane]);
            stops |= next[lane] <= row.floor[lane];
        }
        if stops {
            let (before, mut n, mut w) = (t, next, weight);
            row.stop_lanes(first + i as u32, &before, &mut n, &mut w);
            (next, weight) = (n, w);
            reach = if row.alive { reach } else { 0 };
        }
        t = next;
        for lane in 0..LANES {
            rgb[0][lane] = fma::<FMA>(weight[lane], local.color[0], rgb[0][lane]);
            rgb[1][lane] = fma::<FMA>(weight[lane], local.color[1], rgb[1][lane]);
            rgb[2][lane] = fma::<FMA>(weight[lane], local.color[2], rgb[2][lane]);
        }
    }
    (row.t, row.rgb) = (t, rgb);
    count
}

/// Blends the tiles of the range into `out`, and leaves the other tiles as they are.
pub fn rasterize_fwd(lists: &Lists<'_>, out: &mut Raster) {
    let tiles = lists.grid.tiles();
    out.resize(tiles);
    let cap = log2_max_alpha(lists.max_alpha, lists.simd);
    out.rgb
        .par_chunks_mut(3 * TILE_PIXELS)
        .zip(out.t_final.par_chunks_mut(TILE_PIXELS))
        .zip(out.stop.par_chunks_mut(TILE_PIXELS))
        .zip(out.evaluated.par_iter_mut())
        .enumerate()
        .filter(|(tile, _)| lists.range.contains(lists.grid, *tile))
        .for_each(|(tile, (((rgb, t_final), stop), evaluated))| {
            SCRATCH.with_borrow_mut(|state| {
                let rows = dispatch(lists.simd, BlendTile { lists, tile, cap, state, rgb, t_final, stop });
                *evaluated = rows * LANES as u64;
            });
        });
}

/// Copies tiles to a planar image (`[3][height][width]`) and its alpha plane (1 - T).
pub fn untile(grid: Grid, raster: &Raster, rgb: &mut [f32], alpha: &mut [f32]) {
    let (width, pixels) = (grid.width as usize, grid.width as usize * grid.height as usize);
    if pixels == 0 {
        return;
    }
    let (r, rest) = rgb.split_at_mut(pixels);
    let (g, b) = rest.split_at_mut(pixels);
    let planes = r.par_chunks_mut(width).zip(g.par_chunks_mut(width)).zip(b.par_chunks_mut(width));
    planes.zip(alpha.par_chunks_mut(width)).enumerate().for_each(|(y, (((r, g), b), alpha))| {
        for tx in 0..grid.tiles_x as usize {
            let tile = y / ROWS * grid.tiles_x as usize + tx;
            let x = tx * LANES;
            let n = LANES.min(width - x);
            let within = y % ROWS * LANES;
            let colors = &raster.rgb[tile * 3 * TILE_PIXELS..][..3 * TILE_PIXELS];
            copy_lanes(&mut r[x..x + n], &colors[within..]);
            copy_lanes(&mut g[x..x + n], &colors[TILE_PIXELS + within..]);
            copy_lanes(&mut b[x..x + n], &colors[2 * TILE_PIXELS + within..]);
            let t = &raster.t_final[tile * TILE_PIXELS + within..][..n];
            for (a, t) in alpha[x..x + n].iter_mut().zip(t) {
                *a = 1.0 - t;
            }
        }
    });
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
pub(in crate::kernels) mod tests {
    use super::*;
    use crate::base::simd::SimdPath;
    use crate::kernels::isect_emit::{count, emit, tests::random_rows};
    use crate::kernels::isect_offsets::isect_offsets;
    use crate::kernels::scan::scan;
    use crate::kernels::splats::Packed;
    use crate::kernels::tile_range::TileRange;
    use std::sync::atomic::AtomicU64;

    /// Footprints of all kinds, depths in row order, with their intersections.
    pub(in crate::kernels) struct Scene {
        pub grid: Grid,
        pub radii: Vec<[u32; 2]>,
        pub packed: Packed,
        pub chunk_offsets: Vec<u64>,
        pub tile_offsets: Vec<u64>,
        pub isects: Vec<AtomicU64>,
    }

    pub(in crate::kernels) fn scene(n: usize, needles: bool) -> Scene {
        let grid = Grid::new(70, 43);
        let (packed, projected) = random_rows(n, needles, n as u64, grid);
        let order: Vec<u32> = (0..n as u32).collect();
        let simd = SimdPath::best();
        let (mut chunk_offsets, mut tile_offsets, mut isects) = (vec![], vec![], vec![]);
        let (mut tile_counts, mut cursors) = (vec![], vec![]);
        count(&order, &packed, grid, TileRange::all(grid), simd, &mut tile_counts);
        let total = scan(&packed.chunk_counts, &mut chunk_offsets);
        isect_offsets(&tile_counts, grid.tiles(), &mut tile_offsets, &mut cursors);
        emit(&order, &packed, grid, TileRange::all(grid), simd, total, &mut cursors, &mut isects);
        Scene { grid, radii: projected.radii, packed, chunk_offsets, tile_offsets, isects }
    }

    impl Scene {
        pub(in crate::kernels) fn lists(&self, simd: SimdPath) -> Lists<'_> {
            Lists {
                grid: self.grid,
                range: TileRange::all(self.grid),
                splats: &self.packed.splats,
                isects: &self.isects,
                tile_offsets: &self.tile_offsets,
                max_alpha: 0.99,
                background: [0.3, 0.2, 0.1],
                simd,
            }
        }
    }

    /// One pixel by the contract, over every splat whose box contains it.
    struct PlainPixel<'a> {
        lists: &'a Lists<'a>,
        radii: &'a [[u32; 2]],
        x: u32,
        y: u32,
        cap: f32,
    }

    impl Kernel for PlainPixel<'_> {
        type Out = [f32; 4];
        #[inline(always)]
        fn run<const FMA: bool>(self) -> [f32; 4] {
            let (px, py) = (self.x as f32 + 0.5, self.y as f32 + 0.5);
            let (mut t, mut rgb) = (1.0f32, [0.0f32; 3]);
            for (s, radii) in self.lists.splats.iter().zip(self.radii) {
                let (dx, dy) = (px - s.mean[0], py - s.mean[1]);
                if dx.abs() > radii[0] as f32 || dy.abs() > radii[1] as f32 {
                    continue;
                }
                let e = fma::<FMA>(fma::<FMA>(s.a, dx, s.b * dy), dx, fma::<FMA>(s.c * dy, dy, s.log2_opacity));
                if e.is_nan() || e < LOG2_ALPHA_MIN {
                    continue;
                }
                let alpha = exp2_bounded::<FMA>(e.min(s.log2_opacity).min(self.cap));
                let next = fma::<FMA>(-alpha, t, t);
                if next <= TRANSMITTANCE_MIN {
                    break;
                }
                rgb = std::array::from_fn(|c| fma::<FMA>(alpha * t, s.color[c], rgb[c]));
                t = next;
            }
            let [r, g, b] = std::array::from_fn(|c| rgb[c] + t * self.lists.background[c]);
            [r, g, b, 1.0 - t]
        }
    }

    #[test]
    fn the_fast_loop_has_the_bits_of_the_plain_loop() {
        for simd in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
            for (n, needles) in [(60, false), (2000, false), (300, true)] {
                let scene = scene(n, needles);
                let lists = scene.lists(simd);
                let (mut raster, pixels) = (Raster::default(), 70 * 43);
                let (mut rgb, mut alpha) = (vec![0.0; 3 * pixels], vec![0.0; pixels]);
                rasterize_fwd(&lists, &mut raster);
                untile(scene.grid, &raster, &mut rgb, &mut alpha);
                let cap = log2_max_alpha(lists.max_alpha, simd);
                for p in 0..pixels {
                    let (x, y) = ((p % 70) as u32, (p / 70) as u32);
                    let want = dispatch(simd, PlainPixel { lists: &lists, radii: &scene.radii, x, y, cap });
                    let got = [rgb[p], rgb[pixels + p], rgb[2 * pixels + p], alpha[p]];
                    assert_eq!(got.map(f32::to_bits), want.map(f32::to_bits), "{simd:?} {n} {x},{y}: {got:?} {want:?}");
                }
                let stopped = raster.stop.iter().filter(|s| **s != NEVER).count();
                assert!(n < 2000 || stopped > pixels / 4, "the crowded scene must stop pixels: {stopped}");
            }
        }
    }

    #[test]
    fn the_clamp_is_the_first_exponent_that_reaches_it() {
        struct Search(f32);
        impl Kernel for Search {
            type Out = f32;
            #[inline(always)]
            fn run<const FMA: bool>(self) -> f32 {
                let mut x = libm::log2f(self.0) - 1e-6;
                while exp2_bounded::<FMA>(x) < self.0 && x < 0.0 {
                    x = if x.next_up() > 0.0 { 0.0 } else { x.next_up() };
                }
                x
            }
        }
        for simd in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
            for max_alpha in (51..=99).map(|i| i as f32 / 100.0).chain([0.999, 0.9999]) {
                let want = dispatch(simd, Search(max_alpha));
                assert_eq!(log2_max_alpha(max_alpha, simd).to_bits(), want.to_bits(), "{simd:?} {max_alpha}");
            }
            // Floats between this exponent and 0 are so dense that a search among all of them takes seconds.
            let cap = log2_max_alpha(0.999_999_9, simd);
            // One rounding of a number near 1 is 6e-8, twice that in the exponent.
            assert!((cap - libm::log2f(0.999_999_9)).abs() < 2e-7 && cap <= 0.0, "{simd:?}: {cap}");
        }
    }

    #[test]
    fn exp2_is_within_its_bound_on_every_path() {
        struct Worst;
        impl Kernel for Worst {
            type Out = f64;
            #[inline(always)]
            fn run<const FMA: bool>(self) -> f64 {
                let mut worst = 0.0f64;
                for i in 0..2_000_000 {
                    let x = -30.0 + 60.0 * (i as f32 / 2e6);
                    let want = libm::exp2(f64::from(x));
                    worst = worst.max((f64::from(exp2_bounded::<FMA>(x)) / want - 1.0).abs());
                }
                worst
            }
        }
        for simd in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
            // 1.5e-7 of the polynomial and its constant, two roundings of 6e-8 more.
            let worst = dispatch(simd, Worst);
            assert!(worst < 2.7e-7, "{simd:?}: {worst}");
            let cap = log2_max_alpha(0.99, simd);
            assert!((cap - libm::log2f(0.99)).abs() < 1e-6);
        }
        assert_eq!(exp2_bounded::<false>(0.0), 1.0);
    }
}
