// Scalar functions with the polynomials of src/base/math.rs, so that devices differ from the CPU only by rounding.
// Finiteness is tested on the bits, because compilers may assume that comparisons never see NaN.

fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn is_nan(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7fffffffu) > 0x7f800000u;
}

const INFINITY_BITS: u32 = 0x7f800000u;

/// The bits of the largest magnitude of four numbers. Without signs, bits of floats are ordered as the magnitudes, with infinity and
/// NaN after all others. A shader may assume that numbers are finite, but not that bits are.
fn largest_magnitude(v: vec4<f32>) -> u32 {
    let m = bitcast<vec4<u32>>(v) & vec4<u32>(0x7fffffffu);
    return max(max(m.x, m.y), max(m.z, m.w));
}

/// e^x: 0 below -87, infinity above 88, NaN for NaN.
fn exp32(x: f32) -> f32 {
    let y = clamp(x, -87.0, 88.0);
    let n = round(y * 1.44269504);
    let r = (y - n * 0.6933594) - n * -2.1219444e-4;
    var p = 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    var value = p * bitcast<f32>(u32(i32(n) + 127) << 23u);
    value = select(value, 0.0, x < -87.0);
    var bits = select(bitcast<u32>(value), INFINITY_BITS, x > 88.0);
    bits = select(bits, bitcast<u32>(x), is_nan(x));
    return bitcast<f32>(bits);
}

fn exp32_vec3(x: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(exp32(x.x), exp32(x.y), exp32(x.z));
}

/// 1 / (1 + e^-x).
fn sigmoid(x: f32) -> f32 {
    return 1.0 / (1.0 + exp32(-x));
}
