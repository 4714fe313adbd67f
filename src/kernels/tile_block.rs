//! A block of consecutive splats of one tile's list, prepared for loops over the tile's pixel rows.
//!
//! Both directions of the rasterizer go block by block, and within a block row by row, so that a row's state stays in
//! registers and the inner loop is long: a loop over the few rows of each splat would cost a mispredicted branch and a
//! drained pipeline per splat, as much time as the blending itself. For each row a bit set tells which splats reach it.

use super::constants::TILE;
use super::isect_emit::Isect;
use super::lanes::Lane;
use super::splats::Splat;
use crate::base::simd::{LANES, fma, prefetch};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

pub(super) const ROWS: usize = TILE as usize;
/// Bytes of a cache line.
const CACHE_LINE: usize = 64;

/// A splat relative to one tile.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Local {
    /// dy by row.
    pub dy: Lane,
    /// b dy by row.
    pub bdy: Lane,
    /// c dy^2 + log2_opacity by row.
    pub cdy: Lane,
    pub mean_x: f32,
    /// Coefficient of dx^2.
    pub a: f32,
    /// Upper bound of the exponent: the opacity's, or that of the clamp if lower.
    pub top: f32,
    pub color: [f32; 3],
    pub row: u32,
    /// Emit index of this intersection, relative to its chunk of rows.
    pub emit: u64,
}

/// Up to `N` (at most 64) consecutive splats of a tile's list.
#[repr(C, align(64))]
pub(super) struct Block<const N: usize> {
    pub locals: [Local; N],
    /// Bit i of `reach[row]`: splat i can reach the row.
    pub reach: [u64; ROWS],
}

#[inline(always)]
pub(super) fn prefetch_list(list: &[AtomicU64]) {
    for at in (0..list.len()).step_by(CACHE_LINE / size_of::<AtomicU64>()) {
        prefetch(list, at);
    }
}

/// Prefetches the splats of a list that will soon be filled into a block.
#[inline(always)]
pub(super) fn prefetch_splats(list: &[AtomicU64], splats: &[Splat]) {
    for bits in list {
        prefetch(splats, Isect::unpack(bits.load(Relaxed)).row as usize);
    }
}

impl<const N: usize> Block<N> {
    pub(super) fn new() -> Self {
        let none = Local {
            dy: [0.0; LANES],
            bdy: [0.0; LANES],
            cdy: [0.0; LANES],
            mean_x: 0.0,
            a: 0.0,
            top: 0.0,
            color: [0.0; 3],
            row: 0,
            emit: 0,
        };
        Block { locals: [none; N], reach: [0; ROWS] }
    }

    /// Fills the block from at most `N` entries of a list. `y0` is the centre of the tile's first pixel row, `cap` the
    /// exponent at which alpha is clamped.
    #[inline(always)]
    pub(super) fn fill<const FMA: bool>(&mut self, list: &[AtomicU64], splats: &[Splat], y0: f32, cap: f32) {
        let mut reach = [0u64; ROWS];
        for (i, (local, bits)) in self.locals.iter_mut().zip(list).enumerate() {
            let isect = Isect::unpack(bits.load(Relaxed));
            let splat = &splats[isect.row as usize];
            let rows = (2u64 << isect.pixel_rows[1]) - (1u64 << isect.pixel_rows[0]);
            for (row, set) in reach.iter_mut().enumerate() {
                *set |= if rows & (1 << row) != 0 { 1u64 << i } else { 0 };
            }
            for row in 0..ROWS {
                let dy = (y0 + row as f32) - splat.mean[1];
                local.dy[row] = dy;
                local.bdy[row] = splat.b * dy;
                local.cdy[row] = fma::<FMA>(splat.c * dy, dy, splat.log2_opacity);
            }
            local.mean_x = splat.mean[0];
            local.a = splat.a;
            local.top = if splat.log2_opacity < cap { splat.log2_opacity } else { cap };
            local.color = splat.color;
            local.row = isect.row;
            local.emit = splat.emit + u64::from(isect.k);
        }
        self.reach = reach;
    }
}
