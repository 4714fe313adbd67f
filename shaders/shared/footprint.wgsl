// A splat in the form that the tile stages use, and the tiles it can reach: the twin of `Splat`, `Ellipse` and
// `rows_in` in src/kernels/splats.rs, which documents the reasons.
//
// A tile is skipped only if the computed alpha of all its pixels is below 1/255. A device's rounding may move the
// border of the ellipse by less than the padding, so counts there may differ from the CPU's, but pictures cannot.
#import "shared/math.wgsl"
#import "shared/splat.wgsl"

/// log2 of ALPHA_MIN.
const LOG2_ALPHA_MIN: f32 = -7.9943534;
const HALF_LOG2E: f32 = 0.72134752;
const LOG2E: f32 = 1.442695;

/// The exponent to base 2: e = a dx^2 + b dx dy + c dy^2 + log2_opacity.
struct Exponent {
    a: f32,
    b: f32,
    c: f32,
    log2_opacity: f32,
}

/// log2 of positive normal numbers, within 1.2e-7: the built-in one may err by more near 1.
fn log2_positive(x: f32) -> f32 {
    let bits = bitcast<u32>(x);
    let exponent = bitcast<i32>(bits - 0x3f3504f3u) >> 23u;
    let m = bitcast<f32>(bits - (bitcast<u32>(exponent) << 23u));
    let s = (m - 1.0) / (m + 1.0);
    let z = s * s;
    let series = z * (1.0 / 3.0 + z * (0.2 + z * (1.0 / 7.0 + z * (1.0 / 9.0))));
    return f32(exponent) + 2.0 * LOG2E * (s + s * series);
}

fn exponent_of(splat: Splat) -> Exponent {
    return Exponent(
        -HALF_LOG2E * splat.conic.x,
        -LOG2E * splat.conic.y,
        -HALF_LOG2E * splat.conic.z,
        log2_positive(splat.opacity),
    );
}

struct Grid {
    /// Pixels.
    width: u32,
    height: u32,
    tiles_x: u32,
    tiles_y: u32,
}

/// The region that a splat can reach.
struct Reach {
    mean: vec2<f32>,
    /// Half extents of the ellipse.
    half: vec2<f32>,
    /// dx of the topmost point is -tilt, of the lowest +tilt.
    tilt: f32,
    /// The half chord is sqrt(chord.x - chord.y dx^2).
    chord: vec2<f32>,
    /// dy of the chord's middle is slope dx.
    slope: f32,
    pad: f32,
    /// Whether this is not a proper ellipse: then everything in the box counts as reached.
    all: bool,
    /// First tile column and row, and one past the last.
    box: vec4<u32>,
}

/// The tile that contains a pixel coordinate, clamped to the grid; for the end of a range, rounded up.
fn tile_from_pixel(pixel: f32, tiles: u32, end: bool) -> u32 {
    let tile = pixel * (1.0 / 16.0);
    return u32(clamp(select(floor(tile), ceil(tile), end), 0.0, f32(tiles)));
}

/// Splits x into two floats of 12 bits each, whose products are exact. Works on the bits, so that no compiler can
/// contract or simplify it. Magnitudes below 2^-80 lose the second part.
fn halves(x: f32) -> vec2<f32> {
    let bits = bitcast<u32>(x);
    let high = bitcast<f32>(bits & 0xfffff000u);
    let exponent = (bits >> 23u) & 0xffu;
    let unit = bitcast<f32>((bits & 0x80000000u) | ((max(exponent, 47u) - 23u) << 23u));
    return vec2<f32>(high, select(0.0, f32(bits & 0xfffu) * unit, exponent > 47u));
}

/// p r - q^2, within 2^-35 of p r although it cancels for needles. The large products are exact in f32, so their
/// difference is exact wherever it cancels, fused or not.
fn determinant(p: f32, q: f32, r: f32) -> f32 {
    let ph = halves(p);
    let qh = halves(q);
    let rh = halves(r);
    let large = ph.x * rh.x - qh.x * qh.x;
    let mixed = (ph.x * rh.y + ph.y * rh.x) - 2.0 * (qh.x * qh.y);
    let small = ph.y * rh.y - qh.y * qh.y;
    return large + (mixed + small);
}

fn reach_of(splat: Splat, grid: Grid) -> Reach {
    let e = exponent_of(splat);
    var out: Reach;
    out.mean = splat.mean2d;
    let far = splat.radii + vec2<f32>(17.0);
    let rounding = 2e-6 * (abs(e.a) * far.x * far.x + abs(e.c) * far.y * far.y) + 1e-4;
    let reach = e.log2_opacity - LOG2_ALPHA_MIN + rounding;
    let low = floor(splat.mean2d - splat.radii);
    let high = ceil(splat.mean2d + splat.radii);
    out.box = vec4<u32>(
        tile_from_pixel(low.x, grid.tiles_x, false),
        tile_from_pixel(low.y, grid.tiles_y, false),
        tile_from_pixel(high.x, grid.tiles_x, true),
        tile_from_pixel(high.y, grid.tiles_y, true),
    );
    // A row that is not drawn has no tiles, nor has one of opacity 0 (whose log2 is unspecified).
    if !(splat.radii.x > 0.0 && splat.opacity > 0.0 && reach > 0.0) {
        out.box = vec4<u32>();
    }
    let p = -e.a;
    let q = -0.5 * e.b;
    let r = -e.c;
    let det = determinant(p, q, r);
    out.half = sqrt(vec2<f32>(reach * r / det, reach * p / det));
    out.all = !(det > 0.0 && p > 0.0 && r > 0.0) || !is_finite(out.half.x + out.half.y + out.mean.x + out.mean.y);
    out.tilt = q / p * out.half.y;
    out.chord = vec2<f32>(reach / r, det / (r * r));
    out.slope = -q / r;
    out.pad = 1e-3 * out.half.y + 0.01 + 1e-6 * abs(out.mean.y);
    return out;
}

fn half_chord(reach: Reach, dx: f32) -> f32 {
    return sqrt(max(reach.chord.x - reach.chord.y * dx * dx, 0.0));
}

/// First tile row and one past the last that the splat can reach in a tile column; equal if there are none.
fn tile_rows_in(reach: Reach, grid: Grid, tile_x: u32) -> vec2<u32> {
    let box_rows = vec2<i32>(i32(reach.box.y * 16u), i32(min(reach.box.w * 16u, grid.height)) - 1);
    if reach.all {
        return rows_to_tiles(box_rows);
    }
    let left = f32(tile_x * 16u) + 0.5 - reach.mean.x;
    let right = left + 15.0;
    let half_x = reach.half.x + 1e-3 * reach.half.x + 0.01 + 1e-6 * abs(reach.mean.x);
    if left > half_x || right < -half_x {
        return vec2<u32>();
    }
    let dx_low = clamp(reach.tilt, left, right);
    let dx_high = clamp(-reach.tilt, left, right);
    let low = reach.slope * dx_low - half_chord(reach, dx_low) - reach.pad;
    let high = reach.slope * dx_high + half_chord(reach, dx_high) + reach.pad;
    // A limit far beyond any picture that converts to an integer on every device.
    let first = i32(clamp(ceil(reach.mean.y + low - 0.5), -1e6, 1e6));
    let last = i32(clamp(floor(reach.mean.y + high - 0.5), -1e6, 1e6));
    return rows_to_tiles(vec2<i32>(max(first, box_rows.x), min(last, box_rows.y)));
}

/// Converts the first and last pixel row to tile rows.
fn rows_to_tiles(rows: vec2<i32>) -> vec2<u32> {
    if rows.y < rows.x {
        return vec2<u32>();
    }
    return vec2<u32>(u32(rows.x) / 16u, u32(rows.y) / 16u + 1u);
}
