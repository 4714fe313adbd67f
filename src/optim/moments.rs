//! Optional 16-bit storage of moments between updates. Inexact: second moments differ from f32 by 0.2 % on average.
//!
//! After each update a moment is rounded to bfloat16 (the upper half of an f32) stochastically: up with the probability
//! of the cut fraction, so that the mean is right. Rounding to nearest would prevent any change of a second moment
//! below 0.4 % at a time, which at beta2 = 0.999 is nearly every change.
//!
//! A device that updates rows itself draws in the same way from another key (`decays_of` in `shaders/update.wgsl`).
//!
//! Invariants: 1. the draw depends on the row's uid, the number of steps contained and the column's element, not on
//! where the row is, when it is stored, or the order of lanes in a block; 2. zero and other exactly representable
//! values stay unchanged; 3. the lower halves are zero, so that pages can omit them.

use crate::base::rng::mix64;
use crate::scene::rows::{RowBlock, SH_N_LANE};

/// The number of each narrow lane in draws: by means, quats, scales, opacity, sh0. It is independent of the lanes'
/// order, which may change while the bits of a run may not.
const DRAW_FROM_LANE: [u32; SH_N_LANE] = [0, 1, 2, 10, 3, 4, 5, 6, 7, 8, 9, 14, 11, 12, 13, 15];

/// Storage format of moments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Moments {
    /// All 32 bits.
    #[default]
    F32,
    /// The upper 16 bits.
    Bf16,
}

/// Rounds both moments of a loaded row that contains `steps` steps; `W` is the width of `sh_n`.
#[inline(always)]
pub(crate) fn round_block<const W: usize>(m: &mut RowBlock, v: &mut RowBlock, uid: u64, steps: u32) {
    let key = mix64(uid ^ mix64(u64::from(steps)));
    let (low, high) = (key as u32, (key >> 32) as u32);
    for l in 0..SH_N_LANE {
        (m[l], v[l]) = rounded(m[l], v[l], low, high, DRAW_FROM_LANE[l]);
    }
    for l in SH_N_LANE..SH_N_LANE + W.next_multiple_of(16) {
        (m[l], v[l]) = rounded(m[l], v[l], low, high, l as u32);
    }
}

#[inline(always)]
fn rounded(m: f32, v: f32, low: u32, high: u32, number: u32) -> (f32, f32) {
    // The finaliser of MurmurHash3 over the number and both halves of the key gives 16 bits for each moment.
    let mut draw = low ^ number.wrapping_mul(0x9e37_79b9);
    draw = (draw ^ (draw >> 16)).wrapping_mul(0x85eb_ca6b).wrapping_add(high);
    draw = (draw ^ (draw >> 13)).wrapping_mul(0xc2b2_ae35);
    draw ^= draw >> 16;
    (cut(m, draw & 0xffff), cut(v, draw >> 16))
}

/// The upper half after adding `draw` (16 bits) to the lower one. Moments that are finite stay finite.
#[inline(always)]
fn cut(x: f32, draw: u32) -> f32 {
    f32::from_bits(x.to_bits().wrapping_add(draw) & 0xffff_0000)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::columns::Column;
    use crate::scene::rows::{BLOCK_LANES, first_lane};

    #[test]
    fn draws_are_numbered_by_the_columns_whatever_their_lanes() {
        let mut number = 0;
        for column in Column::ALL.into_iter().filter(|&c| c != Column::ShN) {
            for i in 0..column.width(3) {
                assert_eq!(DRAW_FROM_LANE[first_lane(column) + i], number, "{column:?} {i}");
                number += 1;
            }
        }
    }

    fn nearest(x: f32) -> f32 {
        cut(x, 0x7fff + (x.to_bits() >> 16 & 1))
    }

    #[test]
    fn rounding_is_unbiased_and_keeps_exact_numbers() {
        let x = 1.0 + 1.0 / 512.0 + 1.0 / 2048.0; // 5/16 of the way from 1 to the next bfloat16
        let (mut ups, rows) = ([0u32; 2], 40_000);
        for uid in 0..rows {
            let (mut m, mut v) = ([-x; BLOCK_LANES], [x; BLOCK_LANES]);
            (m[0], v[0], m[9], v[9]) = (0.0, 0.0, -0.5, 1e30);
            v[9] = nearest(v[9]);
            let exact = v[9];
            round_block::<45>(&mut m, &mut v, uid, 7);
            assert!([m[0], v[0], m[9], v[9]] == [0.0, 0.0, -0.5, exact]);
            assert!((m[3] == -1.0 || m[3] == -1.007_812_5) && (v[3] == 1.0 || v[3] == 1.007_812_5));
            ups[0] += u32::from(m[3] != -1.0);
            ups[1] += u32::from(v[3] != 1.0);
        }
        for up in ups {
            // Five standard errors of sqrt(p (1 - p) / n) are 0.012.
            assert!((f64::from(up) / rows as f64 - 5.0 / 16.0).abs() < 0.012, "{up}");
        }
    }
}
