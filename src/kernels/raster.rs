//! Shared by both directions of the rasterizer: their input, and the alpha of a splat from its exponent. The twin of
//! shaders/shared/raster.wgsl.

use super::constants::TILE;
use super::lanes::Lane;
use super::splats::{Grid, Splat};
use super::tile_range::TileRange;
use crate::base::simd::{Kernel, LANES, SimdPath, dispatch, fma};
use std::sync::atomic::AtomicU64;

pub const TILE_PIXELS: usize = (TILE * TILE) as usize;
/// Stop position of a pixel that processed its whole list.
pub const NEVER: u32 = u32::MAX;

/// Input of both directions of the rasterizer.
#[derive(Debug, Clone, Copy)]
pub struct Lists<'a> {
    /// The tiles of the picture.
    pub grid: Grid,
    /// The tiles whose lists these are.
    pub range: TileRange,
    /// Splats by row.
    pub splats: &'a [Splat],
    /// Packed [`super::isect_emit::Isect`]s, tile by tile.
    pub isects: &'a [AtomicU64],
    /// Start of each tile's list; tiles + 1 entries.
    pub tile_offsets: &'a [u64],
    /// Upper clamp of alpha.
    pub max_alpha: f32,
    pub background: [f32; 3],
    pub simd: SimdPath,
}

impl Lists<'_> {
    /// The list of one tile.
    #[inline(always)]
    pub fn tile(&self, tile: usize) -> &[AtomicU64] {
        &self.isects[self.tile_offsets[tile] as usize..self.tile_offsets[tile + 1] as usize]
    }

    /// The same, empty beyond the last tile.
    #[inline(always)]
    pub fn tile_or_empty(&self, tile: usize) -> &[AtomicU64] {
        if tile + 1 < self.tile_offsets.len() { self.tile(tile) } else { &[] }
    }
}

/// 2^x for x in [-30, 30], within 2.7e-7 relative; unspecified outside, but never a trap.
///
/// Rounds to the nearest integer by adding 1.5 x 2^23, then evaluates a minimax polynomial of degree 5 on [-1/2, 1/2]
/// (Remez; 0.75e-7, another 0.72e-7 because the constant is moved to 1, and two roundings). Contracted on paths with
/// fused multiply-add.
#[inline(always)]
pub fn exp2_bounded<const FMA: bool>(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0;
    let shifted = x + ROUND;
    let r = x - (shifted - ROUND);
    let mut p = 1.327_647_2e-3;
    p = fma::<FMA>(p, r, 9.675_541e-3);
    p = fma::<FMA>(p, r, 5.550_713_3e-2);
    p = fma::<FMA>(p, r, 0.240_221_2);
    p = fma::<FMA>(p, r, 0.693_146_97);
    p = fma::<FMA>(p, r, 1.0);
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// The exponent at which alpha is clamped: the smallest float whose [`exp2_bounded`] is at least `max_alpha`, found by
/// bisection, for which [`exp2_bounded`] rises there.
pub fn log2_max_alpha(max_alpha: f32, simd: SimdPath) -> f32 {
    struct Find(f32);
    impl Kernel for Find {
        type Out = f32;
        #[inline(always)]
        fn run<const FMA: bool>(self) -> f32 {
            let below = libm::log2f(self.0) - 1e-6;
            if exp2_bounded::<FMA>(below) >= self.0 {
                return below;
            }
            // Bits of negative floats rise with the magnitude: `low` is below, `high` is not.
            let (mut low, mut high) = (below.to_bits(), (-0.0f32).to_bits());
            while low - high > 1 {
                let middle = high + (low - high) / 2;
                if exp2_bounded::<FMA>(f32::from_bits(middle)) < self.0 { low = middle } else { high = middle }
            }
            // Adding zero makes -0 a plain 0.
            f32::from_bits(high) + 0.0
        }
    }
    dispatch(simd, Find(max_alpha))
}

/// Copies up to a tile's row of values; whole rows without a library call.
#[inline(always)]
pub(super) fn copy_lanes(out: &mut [f32], from: &[f32]) {
    let n = out.len();
    match (<&mut Lane>::try_from(&mut *out), from.first_chunk::<LANES>()) {
        (Ok(out), Some(from)) => *out = *from,
        _ => out.copy_from_slice(&from[..n]),
    }
}
