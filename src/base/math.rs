//! Scalar functions with the same bits on every platform and instruction path: they use only + - * / sqrt and integer
//! moves, never contracted.

/// e^x in f32, within 2 ulp for x in [-87, 88]; 0 below (subnormal results are flushed), infinity above, NaN for NaN.
/// Branch-free, so that loops over it vectorise.
///
/// Range reduction by n = round(x log2 e) with ln 2 in two parts (Cody and Waite), then the Taylor terms to x^6/720
/// on [-ln2/2, ln2/2] (remainder 1.2e-7 relative).
#[inline(always)]
pub fn exp32(x: f32) -> f32 {
    const LOG2E: f32 = std::f32::consts::LOG2_E;
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    // Adding 1.5 * 2^23 rounds to an integer in the low mantissa bits.
    const ROUND: f32 = 12_582_912.0;
    // max() and min() lose NaN; it is restored at the end.
    let y = x.clamp(-87.0, 88.0);
    let shifted = y * LOG2E + ROUND;
    let n = shifted - ROUND;
    let r = (y - n * LN2_HIGH) - n * LN2_LOW;
    let mut p = 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    let exponent = (shifted.to_bits() << 23).wrapping_add(127 << 23);
    let value = p * f32::from_bits(exponent);
    let value = if x < -87.0 { 0.0 } else { value };
    let value = if x > 88.0 { f32::INFINITY } else { value };
    if x.is_nan() { x } else { value }
}

/// 1 / (1 + e^-x).
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp32(-x))
}

/// A gradient of a larger magnitude counts as not finite: its square must not overflow Adam's second moment. Below this
/// limit, every number that an update computes from finite state is finite.
pub const LARGEST_GRAD: f32 = 1e18;

/// A gradient of a splat of a larger magnitude is taken to lead to a gradient of its Gaussian above [`LARGEST_GRAD`]:
/// focal length over depth, and the like, multiply it by 1e6 at most. Losses are means over pixels, so sound training
/// stays below 1e8.
pub const LARGEST_SPLAT_GRAD: f32 = 1e12;

/// ln(p / (1 - p)), the inverse of [`sigmoid`], for p in (0, 1).
pub fn logit(p: f32) -> f32 {
    let p = f64::from(p);
    libm::log(p / (1.0 - p)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp32_is_within_two_ulp() {
        let mut x = -86.9f32;
        while x < 87.9 {
            let want = libm::exp(f64::from(x));
            let got = f64::from(exp32(x));
            // 2 ulp = 2^-22; the fixed-point rounding of the range reduction stays within that.
            assert!(((got - want) / want).abs() < 2.4e-7, "exp({x}) = {got}, want {want}");
            x += 0.0037;
        }
        assert_eq!(exp32(0.0), 1.0);
        assert_eq!(exp32(-200.0), 0.0);
        assert_eq!(exp32(f32::NEG_INFINITY), 0.0);
        assert_eq!(exp32(200.0), f32::INFINITY);
        assert!(exp32(f32::NAN).is_nan());
    }

    #[test]
    fn logit_inverts_sigmoid() {
        for p in [0.005f32, 0.1, 0.5, 0.9, 0.99] {
            assert!((sigmoid(logit(p)) - p).abs() < 1e-6);
        }
    }
}
