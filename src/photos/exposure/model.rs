//! The correction of one pixel and its derivatives, as functions of plain numbers; f32 on pictures, f64 in fits and tests.
//!
//! A colour c = (R, G, B) becomes `homography(2^dt falloff(r) c)`.
//!
//! - *Falloff*, per channel: 1 + a1 r^2 + a2 r^4 + a3 r^6, with r the distance to the optical centre (mx, my). Positions
//!   are relative to the principal point, in halves of the picture's diagonal. At least [`FALLOFF_MIN`].
//! - *Homography*: with S = R + G + B, the chromaticities u = R/S - 1/3 and v = G/S - 1/3 become (q0/q2, q1/q2), where
//!   q = ((1 + h0) u + h1 v + h2, h3 u + (1 + h4) v + h5, h6 u + h7 v + 1). S stays. Around grey, (h2, h5) is the white
//!   balance, the four numbers that multiply u and v change hue and saturation, and (h6, h7) is the perspective. PPISP
//!   describes the same maps by where four colours go.
//!
//! Invariant: the correction is homogeneous: a colour that is twice as bright becomes one that is twice as bright. So the
//! derivative with respect to dt is ln 2 times the result, and black stays black.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// Values of a photo: the exposure dt in stops, then h0 to h7.
pub const IMAGE_VALUES: usize = 9;
/// Values of a channel of a camera: a1, a2, a3, mx, my.
pub const CHANNEL_VALUES: usize = 5;
/// Least falloff: a lens that swallows more is a wrong fit.
pub const FALLOFF_MIN: f64 = 0.1;
/// A pixel with a smaller sum of channels is black: its chromaticity has no meaning.
const BLACK: f64 = 1e-6;

/// The numbers of a correction.
pub trait Real:
    Copy
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    fn of(x: f64) -> Self;
}

impl Real for f32 {
    #[inline(always)]
    fn of(x: f64) -> f32 {
        x as f32
    }
}

impl Real for f64 {
    #[inline(always)]
    fn of(x: f64) -> f64 {
        x
    }
}

#[derive(Debug, Clone, Copy)]
pub struct PixelModel<T> {
    /// 2^dt.
    pub gain: T,
    /// h0 to h7; `None` for no change.
    pub chroma: Option<[T; 8]>,
    /// a1, a2, a3, mx, my of each channel; `None` for no falloff.
    pub falloff: Option<[[T; CHANNEL_VALUES]; 3]>,
}

impl<T: Real> PixelModel<T> {
    /// The model with these values; values of zero change nothing and cost nothing.
    pub fn new(image: &[f64; IMAGE_VALUES], falloff: &[[f64; CHANNEL_VALUES]; 3]) -> Self {
        let chroma: [f64; 8] = std::array::from_fn(|k| image[1 + k]);
        PixelModel {
            gain: T::of(libm::exp2(image[0])),
            chroma: chroma.iter().any(|h| *h != 0.0).then(|| chroma.map(T::of)),
            falloff: falloff.as_flattened().iter().any(|a| *a != 0.0).then(|| falloff.map(|of| of.map(T::of))),
        }
    }

    /// Gain of each channel at a position.
    #[inline(always)]
    pub fn gains(&self, at: [T; 2]) -> [T; 3] {
        match &self.falloff {
            None => [self.gain; 3],
            Some(channels) => channels.map(|channel| self.gain * falloff(&channel, at)),
        }
    }

    #[inline(always)]
    pub fn of(&self, at: [T; 2], color: [T; 3]) -> [T; 3] {
        let lit = self.lit(at, color);
        self.chroma.as_ref().map_or(lit, |h| homography(h, lit))
    }

    /// The colour after gain and falloff.
    #[inline(always)]
    pub fn lit(&self, at: [T; 2], color: [T; 3]) -> [T; 3] {
        let gains = self.gains(at);
        [gains[0] * color[0], gains[1] * color[1], gains[2] * color[2]]
    }

    /// The gradient with respect to the colour, from the gradient `v` with respect to the corrected colour.
    #[inline(always)]
    pub fn back(&self, at: [T; 2], color: [T; 3], v: [T; 3]) -> [T; 3] {
        let gains = self.gains(at);
        let lit = [gains[0] * color[0], gains[1] * color[1], gains[2] * color[2]];
        let v = self.chroma.as_ref().map_or(v, |h| homography_back(h, lit, v));
        [gains[0] * v[0], gains[1] * v[1], gains[2] * v[2]]
    }
}

#[inline(always)]
pub fn falloff<T: Real>(values: &[T; CHANNEL_VALUES], at: [T; 2]) -> T {
    let [a1, a2, a3, mx, my] = *values;
    let (dx, dy) = (at[0] - mx, at[1] - my);
    let r2 = dx * dx + dy * dy;
    let light = T::of(1.0) + r2 * (a1 + r2 * (a2 + r2 * a3));
    if light < T::of(FALLOFF_MIN) { T::of(FALLOFF_MIN) } else { light }
}

/// Derivative of [`falloff`] with respect to its values; zero at the least falloff.
pub fn falloff_columns(values: &[f64; CHANNEL_VALUES], at: [f64; 2]) -> [f64; CHANNEL_VALUES] {
    let [a1, a2, a3, mx, my] = *values;
    let (dx, dy) = (at[0] - mx, at[1] - my);
    let r2 = dx * dx + dy * dy;
    if 1.0 + r2 * (a1 + r2 * (a2 + r2 * a3)) < FALLOFF_MIN {
        return [0.0; CHANNEL_VALUES];
    }
    let of_r2 = a1 + r2 * (2.0 * a2 + r2 * 3.0 * a3);
    [r2, r2 * r2, r2 * r2 * r2, -2.0 * dx * of_r2, -2.0 * dy * of_r2]
}

/// The intermediate values of a homography: S, (u, v) S, (q0, q1, q2) S.
#[inline(always)]
fn projected<T: Real>(h: &[T; 8], [r, g, b]: [T; 3]) -> (T, [T; 2], [T; 3]) {
    let sum = r + g + b;
    let third = sum * T::of(1.0 / 3.0);
    let (u, v) = (r - third, g - third);
    let q0 = u + h[0] * u + h[1] * v + h[2] * sum;
    let q1 = v + h[3] * u + h[4] * v + h[5] * sum;
    (sum, [u, v], [q0, q1, h[6] * u + h[7] * v + sum])
}

#[inline(always)]
pub fn homography<T: Real>(h: &[T; 8], color: [T; 3]) -> [T; 3] {
    let (sum, _, [q0, q1, q2]) = projected(h, color);
    if sum <= T::of(BLACK) {
        return color;
    }
    let scale = sum / q2;
    let (u, v, third) = (scale * q0, scale * q1, sum * T::of(1.0 / 3.0));
    [u + third, v + third, third - u - v]
}

/// The gradient with respect to the colour, from the gradient `v_out` with respect to the result of [`homography`].
#[inline(always)]
pub fn homography_back<T: Real>(h: &[T; 8], color: [T; 3], v_out: [T; 3]) -> [T; 3] {
    let (sum, _, [q0, q1, q2]) = projected(h, color);
    if sum <= T::of(BLACK) {
        return v_out;
    }
    let scale = sum / q2;
    let (v_u_out, v_v_out) = (v_out[0] - v_out[2], v_out[1] - v_out[2]);
    let (v_q0, v_q1) = (scale * v_u_out, scale * v_v_out);
    let along = (v_u_out * q0 + v_v_out * q1) / q2;
    let v_q2 = -(scale * along);
    let v_u = v_q0 + h[0] * v_q0 + h[3] * v_q1 + h[6] * v_q2;
    let v_v = v_q1 + h[1] * v_q0 + h[4] * v_q1 + h[7] * v_q2;
    let third = T::of(1.0 / 3.0);
    let of_thirds = (v_out[0] + v_out[1] + v_out[2] - v_u - v_v) * third;
    let v_sum = along + h[2] * v_q0 + h[5] * v_q1 + v_q2 + of_thirds;
    [v_sum + v_u, v_sum + v_v, v_sum]
}

/// Derivatives of the result of [`homography`] with respect to h0 to h7.
pub fn homography_columns(h: &[f64; 8], color: [f64; 3]) -> [[f64; 3]; 8] {
    let (sum, [u, v], [q0, q1, q2]) = projected(h, color);
    if sum <= BLACK {
        return [[0.0; 3]; 8];
    }
    let scale = sum / q2;
    // The change of (R, G, B) where u S changes by x and v S by y.
    let rgb = |x: f64, y: f64| [x, y, -x - y];
    let (along_u, along_v) = (-scale * q0 / q2, -scale * q1 / q2);
    [
        rgb(scale * u, 0.0),
        rgb(scale * v, 0.0),
        rgb(scale * sum, 0.0),
        rgb(0.0, scale * u),
        rgb(0.0, scale * v),
        rgb(0.0, scale * sum),
        rgb(along_u * u, along_v * u),
        rgb(along_u * v, along_v * v),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    const IMAGE: [f64; IMAGE_VALUES] = [0.7, 0.1, -0.05, 0.03, 0.08, -0.12, -0.02, 0.2, -0.15];
    const LENS: [[f64; CHANNEL_VALUES]; 3] =
        [[-0.3, 0.1, -0.05, 0.02, -0.01], [-0.2, 0.05, 0.02, 0.03, 0.04], [-0.4, 0.2, -0.1, -0.05, 0.0]];
    const PIXELS: [([f64; 2], [f64; 3]); 4] = [
        ([0.1, -0.3], [0.5, 0.3, 0.2]),
        ([-0.7, 0.6], [0.02, 0.9, 0.4]),
        ([0.0, 0.0], [1.7, 0.0, 0.1]),
        ([0.4, 0.5], [0.3, 0.3, 0.3]),
    ];
    const STEP: f64 = 1e-6;
    // Central differences of step 1e-6: an error of 1e-12 by truncation and of 1e-10 by rounding.
    const NEAR: f64 = 1e-8;

    /// Central difference of `of` at 0.
    fn slope(of: impl Fn(f64) -> [f64; 3]) -> [f64; 3] {
        let (high, low) = (of(STEP), of(-STEP));
        std::array::from_fn(|c| (high[c] - low[c]) / (2.0 * STEP))
    }

    fn assert_near(got: [f64; 3], want: [f64; 3]) {
        assert!((0..3).all(|c| (got[c] - want[c]).abs() < NEAR), "{got:?}, not {want:?}");
    }

    #[test]
    fn gradients_of_colours_agree_with_differences() {
        let model = PixelModel::<f64>::new(&IMAGE, &LENS);
        for (at, color) in PIXELS {
            let columns: [[f64; 3]; 3] = std::array::from_fn(|c| {
                slope(|by| model.of(at, std::array::from_fn(|i| color[i] + if i == c { by } else { 0.0 })))
            });
            for v in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, -0.4, 0.8]] {
                let want = columns.map(|column| (0..3).map(|i| column[i] * v[i]).sum());
                assert_near(model.back(at, color, v), want);
            }
        }
    }

    #[test]
    fn derivatives_of_values_agree_with_differences() {
        for (at, color) in PIXELS {
            let of = |image: &[f64; IMAGE_VALUES]| PixelModel::<f64>::new(image, &LENS).of(at, color);
            let by = |k: usize| slope(|by| of(&std::array::from_fn(|i| IMAGE[i] + if i == k { by } else { 0.0 })));
            assert_near(of(&IMAGE).map(|c| std::f64::consts::LN_2 * c), by(0));
            let model = PixelModel::<f64>::new(&IMAGE, &LENS);
            let lit = model.lit(at, color);
            let chroma = std::array::from_fn(|k| IMAGE[1 + k]);
            homography_columns(&chroma, lit).into_iter().enumerate().for_each(|(k, got)| assert_near(got, by(1 + k)));
            for channel in LENS {
                for (k, got) in falloff_columns(&channel, at).into_iter().enumerate() {
                    let moved = |by: f64| std::array::from_fn(|i| channel[i] + if i == k { by } else { 0.0 });
                    let want = (falloff(&moved(STEP), at) - falloff(&moved(-STEP), at)) / (2.0 * STEP);
                    assert!((got - want).abs() < NEAR, "{got}, not {want}");
                }
            }
        }
    }

    #[test]
    fn no_values_change_nothing_and_black_stays_black() {
        let none = PixelModel::<f32>::new(&[0.0; IMAGE_VALUES], &[[0.0; CHANNEL_VALUES]; 3]);
        assert_eq!(none.of([0.5, 0.5], [0.1, 0.2, 0.3]), [0.1, 0.2, 0.3]);
        let some = PixelModel::<f32>::new(&IMAGE, &LENS);
        assert_eq!(some.of([0.5, 0.5], [0.0; 3]), [0.0; 3]);
        assert!(some.back([0.5, 0.5], [0.0; 3], [1.0; 3]).iter().all(|v| v.is_finite()));
        // The sum of the channels is what exposure and falloff make of it: the homography keeps it.
        let h = std::array::from_fn(|k| IMAGE[1 + k]);
        let sum = homography(&h, [0.5, 0.3, 0.2]).iter().sum::<f64>();
        assert!((sum - 1.0).abs() < 1e-15, "rounding alone");
    }
}
