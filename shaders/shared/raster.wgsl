// Shared by both directions of the rasterizer: a workgroup of 64 invocations processes a tile, each invocation four
// adjacent pixels, and splats arrive in batches through workgroup memory.
//
// Some drivers limit an invocation to 65,535 loop iterations and then silently continue with wrong results. So a
// dispatch processes one segment of every tile's list, and a pixel's state is carried from segment to segment.
#import "shared/footprint.wgsl"

struct RasterUniforms {
    grid: Grid,
    /// Background colour.
    background: vec3<f32>,
    max_alpha: f32,
    /// log2 of max_alpha.
    log2_max_alpha: f32,
    /// First list index of the segment, and one past the last.
    first: u32,
    end: u32,
    /// Sum of SEGMENT_FIRST, SEGMENT_LAST (in this direction's order), HAS_V_ALPHA and the flags of fold_rows.
    flags: u32,
    /// Numbers of rows of the view and of their intersections, for fold_rows.
    row_count: u32,
    isect_count: u32,
    /// The intersections, by emit index, whose sums the backward rasterizer stores in this dispatch.
    window_first: u32,
    window_end: u32,
    /// The range of tiles that is blended: first column, end of the columns, first row, end of the rows.
    range: vec4<u32>,
    /// List entries of the tile in earlier parts of its list.
    list_base: u32,
    pad0: u32,
    pad1: u32,
    pad2: u32,
}

const SEGMENT_FIRST: u32 = 1u;
const SEGMENT_LAST: u32 = 2u;
const HAS_V_ALPHA: u32 = 4u;
/// The rows continue the sums that v_splats holds.
const FOLD_CARRIED: u32 = 8u;
/// The rows store their sums: another range of tiles follows.
const FOLD_UNFINISHED: u32 = 16u;
/// No lists: every row stands at its own rank and has no intersections.
const FOLD_WITHOUT_LISTS: u32 = 32u;

/// Invocations per tile.
const TILE_LANES: u32 = 64u;
/// Stop position of a pixel that processed its whole list.
const NEVER: u32 = 0xffffffffu;

struct TileSplat {
    mean: vec2<f32>,
    a: f32,
    b: f32,
    c: f32,
    log2_opacity: f32,
    color: vec3<f32>,
}

fn tile_splat(splat: Splat) -> TileSplat {
    let e = exponent_of(splat);
    return TileSplat(splat.mean2d, e.a, e.b, e.c, e.log2_opacity, splat.color);
}

/// The exponent of a splat at four pixels of a row, from dx and dy.
fn exponents(splat: TileSplat, dx: vec4<f32>, dy: f32) -> vec4<f32> {
    return (splat.a * dx + splat.b * dy) * dx + (splat.c * dy * dy + splat.log2_opacity);
}

/// Alpha before the threshold is applied. A sigma below 0 is a rounding error and counts as 0.
fn alphas(e: vec4<f32>, log2_opacity: f32, max_alpha: f32) -> vec4<f32> {
    return min(exp2(min(e, vec4<f32>(log2_opacity))), vec4<f32>(max_alpha));
}

/// Number of tiles of the range.
fn tiles_in_range(range: vec4<u32>) -> u32 {
    return (range.y - range.x) * (range.w - range.z);
}

/// The number, in the picture, of the n-th tile of the range.
fn tile_of_range(n: u32, range: vec4<u32>, grid: Grid) -> u32 {
    let columns = max(range.y - range.x, 1u);
    return (range.z + n / columns) * grid.tiles_x + range.x + n % columns;
}

/// The four pixels of an invocation, side by side.
struct TilePixels {
    /// Number of the tile in the picture.
    tile: u32,
    /// Pixels of the picture, and index of the first of the four.
    plane: u32,
    at: u32,
    /// Which of them lie in the picture.
    inside: vec4<bool>,
    /// Their centres.
    x: vec4<f32>,
    y: f32,
}

/// The pixels of invocation `lane` of the n-th tile of the range.
fn pixels_of(n: u32, lane: u32, range: vec4<u32>, grid: Grid) -> TilePixels {
    let tile = tile_of_range(n, range, grid);
    let pixel = 16u * vec2<u32>(tile % grid.tiles_x, tile / grid.tiles_x) + vec2<u32>(4u * (lane % 4u), lane / 4u);
    return TilePixels(
        tile,
        grid.width * grid.height,
        pixel.y * grid.width + pixel.x,
        (vec4<u32>(pixel.x) + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(grid.width)) & vec4<bool>(pixel.y < grid.height),
        vec4<f32>(f32(pixel.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5),
        f32(pixel.y) + 0.5,
    );
}
