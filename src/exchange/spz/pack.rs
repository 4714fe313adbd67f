//! A Gaussian in the bytes of SPZ: what each value is rounded to.
//!
//! Invariant: every finite row has bytes; values out of a byte's range become its nearest end.

use crate::base::math::exp32;
use crate::exchange::frames::ExportRow;
use std::f32::consts::FRAC_1_SQRT_2;

/// Bytes of a position.
pub const POSITION_BYTES: usize = 9;
/// Largest magnitude of a coordinate's 24 bits.
const FIXED_MAX: f64 = 8_388_607.0;
/// Most fractional bits of a coordinate. f32 holds no more of values beyond 1/2.
const FRACTION_BITS_MAX: u8 = 22;
/// Colours: a constant band of 0 is mid grey, and this much of it is the whole range.
const COLOR_SCALE: f32 = 0.15;
/// Largest magnitude of the small components of a quaternion, in 9 bits.
const QUAT_MAX: f32 = 511.0;

/// Lengths of the attributes of a row that follow its position: opacity, colours, scales, rotation, harmonics.
pub fn attribute_bytes(sh_degree: u8) -> [usize; 5] {
    let n = usize::from(sh_degree) + 1;
    [1, 3, 3, 4, 3 * (n * n - 1)]
}

/// Largest coordinate that a file can hold, in its own units.
pub fn coordinate_max() -> f32 {
    FIXED_MAX as f32
}

/// The most fractional bits with which coordinates up to `reach` (file units) fit into 24 bits.
pub fn fraction_bits(reach: f32) -> u8 {
    let fits = |bits: &u8| f64::from(reach) * f64::from(1u32 << bits) <= FIXED_MAX - 0.5;
    (0..=FRACTION_BITS_MAX).rev().find(fits).unwrap_or(0)
}

/// Position with this many fractional bits: three numbers of 24 bits, little endian.
pub fn position(position: [f32; 3], fraction_bits: u8) -> [u8; POSITION_BYTES] {
    let mut out = [0; POSITION_BYTES];
    for (bytes, x) in out.chunks_exact_mut(3).zip(position) {
        let fixed = libm::rint(f64::from(x) * f64::from(1u32 << fraction_bits)).clamp(-FIXED_MAX, FIXED_MAX) as i32;
        bytes.copy_from_slice(&fixed.to_le_bytes()[..3]);
    }
    out
}

/// The attributes that follow a position, in their order.
pub fn attributes(row: &ExportRow, sh_degree: u8, out: &mut Vec<u8>) {
    let alpha = 1.0 / (1.0 + exp32(-row.opacity));
    out.push(byte(alpha * 255.0));
    out.extend(row.sh0.map(|c| byte(c * (COLOR_SCALE * 255.0) + 0.5 * 255.0)));
    out.extend(row.log_scales.map(|s| byte((s + 10.0) * 16.0)));
    out.extend(rotation(row.quat));
    // The linear band keeps five bits, the others four.
    let [.., harmonics] = attribute_bytes(sh_degree);
    out.extend(row.sh_n[..harmonics].iter().enumerate().map(|(i, &v)| harmonic(v, if i < 9 { 8 } else { 16 })));
}

fn byte(value: f32) -> u8 {
    // The cast cuts to the range of a byte.
    libm::rintf(value) as u8
}

/// A coefficient in [-1, 1) around 128, rounded to a multiple of `bucket`.
fn harmonic(value: f32, bucket: i32) -> u8 {
    let q = libm::rintf(value.clamp(-2.0, 2.0) * 128.0) as i32 + 128;
    ((q + bucket / 2).div_euclid(bucket) * bucket).clamp(0, 255) as u8
}

/// A unit quaternion (w first) in 32 bits, little endian: number of the largest component among x, y, z, w, then the others in
/// this order, each a sign and nine bits. The largest one is positive: a quaternion and its negative are one rotation.
fn rotation([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let q = [x, y, z, w];
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let turns = q[largest] < 0.0;
    let mut bits = largest as u32;
    for (i, value) in q.into_iter().enumerate() {
        if i != largest {
            let magnitude = libm::rintf(value.abs() / FRAC_1_SQRT_2 * QUAT_MAX).min(QUAT_MAX) as u32;
            let is_negative = (value < 0.0) != turns;
            bits = bits << 10 | u32::from(is_negative) << 9 | magnitude;
        }
    }
    bits.to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_have_as_many_bits_as_fit() {
        for (reach, bits) in [(0.0, 22), (1.0, 22), (2.0, 21), (2047.0, 12), (2048.0, 11), (8_388_606.0, 0), (1e9, 0)] {
            assert_eq!(fraction_bits(reach), bits, "{reach}");
        }
        // -1.5 in units of 1/16 is -24.
        assert_eq!(position([1.0, -1.5, 0.0], 4), [16, 0, 0, 232, 255, 255, 0, 0, 0]);
        // Beyond the range: its end.
        assert_eq!(position([1e9, 0.0, -1e9], 0), [255, 255, 127, 0, 0, 0, 1, 0, 128]);
    }

    #[test]
    fn harmonics_fall_into_buckets() {
        assert_eq!([0.0, 0.02, 0.04, -0.04, 9.0, -9.0].map(|v| harmonic(v, 8)), [128, 128, 136, 120, 255, 0]);
        assert_eq!([0.0, 0.05, 0.07, -0.07].map(|v| harmonic(v, 16)), [128, 128, 144, 112]);
    }

    #[test]
    fn a_quaternion_and_its_negative_have_the_same_bytes() {
        let q = [0.1f32, -0.7, 0.3, 0.64];
        assert_eq!(rotation(q), rotation(q.map(|v| -v)));
        // No rotation: w is the largest, its number is 3, the others are 0.
        assert_eq!(rotation([1.0, 0.0, 0.0, 0.0]), [0, 0, 0, 0xc0]);
        // Half of x and w: x is the first of two equals, w follows after y and z.
        let half = FRAC_1_SQRT_2;
        assert_eq!(rotation([half, half, 0.0, 0.0]), 511u32.to_le_bytes());
        assert_eq!(rotation([-half, half, 0.0, 0.0]), (512u32 + 511).to_le_bytes());
    }
}
