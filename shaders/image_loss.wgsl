// Stage "image_loss": (1 - lambda) L1 + lambda (1 - SSIM) of a picture, and its gradient. The twin of
// src/kernels/image_loss.rs and src/kernels/ssim_band.rs, which document the formulas and masks.
//
// Three entry points, run in this order (a fourth, squared_errors, is the twin of src/kernels/squared_error.rs):
//   ssim_map     one workgroup per tile and channel: SSIM's three derivative maps, and the tile's sum of SSIM;
//   gradient     likewise: v_rgb, and the tile's sums of absolute and squared differences.
//                In both an invocation takes places side by side, whose windows share most of what they read: first four of
//                a row of the patch, then two pixels of a column. 128 invocations share the memory of a patch, of which a
//                device holds few: twice as many as with four pixels hide twice the waits;
//   sum_partials one workgroup per 4,096 partial sums: adds them up in a fixed order. Run again until one is left.
// ssim_map and gradient cover `channel_count` channels from `first_channel` on, so that the derivative maps, 12 bytes
// per pixel and channel, can be stored for one channel at a time.
//
// Sums are f32, added as trees: no atomics, so every run on a device gives the same bits. No loop has more than 64
// iterations.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/subgroups.wgsl"

struct LossUniforms {
    width: u32,
    height: u32,
    first_channel: u32,
    channel_count: u32,
    /// Pixels at each border that the SSIM map does not cover: 5 or 0.
    margin: u32,
    /// Derivatives of the loss with respect to the sum of absolute differences, and to the sum of the SSIM map.
    l1_weight: f32,
    ssim_weight: f32,
    /// Number of partial sums that sum_partials reads.
    partial_count: u32,
}

@group(0) @binding(0) var<uniform> loss: LossUniforms;
/// The picture, planar [3][height][width].
@group(0) @binding(1) var<storage, read> rgb: array<f32>;
/// The photo: red in the lowest byte, then green, blue, and the mask (0: the pixel is excluded).
@group(0) @binding(2) var<storage, read> target_pixels: array<u32>;
/// dS/dmx, dS/dE[xx], dS/dE[xy], planar [channel_count][3][height][width].
@group(0) @binding(3) var<storage, read_write> derivatives: array<f32>;
/// Planar [3][height][width].
@group(0) @binding(4) var<storage, read_write> v_rgb: array<f32>;
/// Absolute differences, squared differences, SSIM, 0: one entry per channel and tile.
@group(0) @binding(5) var<storage, read_write> partials: array<vec4<f32>>;
/// Output of sum_partials.
@group(0) @binding(6) var<storage, read_write> sums: array<vec4<f32>>;

/// Output of squared_errors, [height][width].
@group(0) @binding(7) var<storage, read_write> errors: array<f32>;

/// Invocations per workgroup of ssim_map and gradient: one per two pixels of a tile.
const LANES: u32 = 128u;
/// Invocations per workgroup of sum_partials.
const WORKGROUP: u32 = 256u;
const RADIUS: u32 = 5u;
/// Side of a tile including the window's margin.
const PATCH: u32 = 26u;
/// Values of a patch (26 * 26), and those after filtering along rows (26 * 16).
const PATCH_LEN: u32 = 676u;
const FILTERED_LEN: u32 = 416u;
/// Partial sums per invocation of sum_partials.
const PARTIALS_EACH: u32 = 16u;
/// (0.01 L)^2 and (0.03 L)^2 for the value range L = 1.
const SSIM_C1: f32 = 1e-4;
const SSIM_C2: f32 = 9e-4;
/// exp(-k^2 / 4.5) for k = 0..=5, divided by the sum over -5..=5.
const TAP0: f32 = 0.26601172;
const TAP1: f32 = 0.21300554;
const TAP2: f32 = 0.10936069;
const TAP3: f32 = 0.036000773;
const TAP4: f32 = 0.007598758;
const TAP5: f32 = 0.0010283801;

/// x, y of the patch; in `gradient` dS/dmx and dS/dE[xx].
var<workgroup> patch_two: array<vec2<f32>, PATCH_LEN>;
/// In `gradient` dS/dE[xy].
var<workgroup> patch_one: array<f32, PATCH_LEN>;
/// Filtered along rows: x, y, x^2 + y^2, x y; or the three maps.
var<workgroup> filtered: array<vec4<f32>, FILTERED_LEN>;

/// The share of work of a workgroup.
struct Job {
    /// 0 red, 1 green, 2 blue; and the same counted from first_channel.
    channel: u32,
    plane: u32,
    /// First pixel of the tile.
    x0: u32,
    y0: u32,
    /// Index of its partial sums.
    partial: u32,
    exists: bool,
}

fn job(group: u32) -> Job {
    let tiles_x = (loss.width + TILE - 1u) / TILE;
    let tiles_y = (loss.height + TILE - 1u) / TILE;
    let tiles = max(tiles_x * tiles_y, 1u);
    let plane = group / tiles;
    let tile = group % tiles;
    let channel = loss.first_channel + plane;
    let exists = plane < loss.channel_count && tiles_x * tiles_y > 0u;
    let columns = max(tiles_x, 1u);
    return Job(channel, plane, TILE * (tile % columns), TILE * (tile / columns), channel * tiles + tile, exists);
}

/// Pixel index of a place in the patch, or 0xffffffff outside the picture. Patch column 0 is 5 left of the tile.
fn pixel_of_patch(j: Job, at: u32) -> u32 {
    // A value below 0 wraps to far beyond the picture.
    let x = j.x0 + at % PATCH - RADIUS;
    let y = j.y0 + at / PATCH - RADIUS;
    return select(0xffffffffu, y * loss.width + x, x < loss.width && y < loss.height);
}

/// Picture and photo at a pixel; the photo twice if the pixel is excluded.
fn values(channel: u32, pixel: u32) -> vec2<f32> {
    let photo = target_pixels[pixel];
    let y = f32((photo >> (8u * channel)) & 255u) / 255.0;
    let x = rgb[channel * loss.width * loss.height + pixel];
    return vec2<f32>(select(x, y, (photo >> 24u) == 0u), y);
}

/// The window over eleven values: the middle one, then sums of pairs outwards.
fn windowed(v0: vec4<f32>, v1: vec4<f32>, v2: vec4<f32>, v3: vec4<f32>, v4: vec4<f32>, v5: vec4<f32>) -> vec4<f32> {
    return TAP0 * v0 + TAP1 * v1 + TAP2 * v2 + TAP3 * v3 + TAP4 * v4 + TAP5 * v5;
}

/// x, y, x^2 + y^2 and x y at a place in the patch.
fn four(at: u32) -> vec4<f32> {
    let both = patch_two[at];
    return vec4<f32>(both, both.x * both.x + both.y * both.y, both.x * both.y);
}

/// The three derivatives at a place in the patch.
fn three(at: u32) -> vec4<f32> {
    return vec4<f32>(patch_two[at], patch_one[at], 0.0);
}

/// Groups of four adjacent places in the rows of a patch.
const FOURS_LEN: u32 = 104u;
/// Values covered by the windows of four neighbours.
const SPAN: u32 = 14u;

/// The window at four adjacent places.
fn windowed_4(v: array<vec4<f32>, SPAN>) -> array<vec4<f32>, 4> {
    return array<vec4<f32>, 4>(
#repeat K 0u 1u 2u 3u
        windowed(v[K + 5u], v[K + 4u] + v[K + 6u], v[K + 3u] + v[K + 7u], v[K + 2u] + v[K + 8u], v[K + 1u] + v[K + 9u], v[K] + v[K + 10u]),
#end
    );
}

/// The window down a column of the row-filtered values, at two pixels from place t on.
fn down_2(t: u32) -> array<vec4<f32>, 2> {
    var v: array<vec4<f32>, 12>;
#repeat K 0u 1u 2u 3u 4u 5u 6u 7u 8u 9u 10u 11u
    v[K] = filtered[t + TILE * K];
#end
    return array<vec4<f32>, 2>(
#repeat K 0u 1u
        windowed(v[K + 5u], v[K + 4u] + v[K + 6u], v[K + 3u] + v[K + 7u], v[K + 2u] + v[K + 8u], v[K + 1u] + v[K + 9u], v[K] + v[K + 10u]),
#end
    );
}

/// Adds the lanes' sums in the memory of the patch, which is no longer needed; the first lane gets the result.
#ifdef SUBGROUPS
fn sum_lanes(place: SubgroupPlace, lanes: u32, value: vec3<f32>) -> vec3<f32> {
    let part = subgroup_sum_vec3(value, place.lane);
    if subgroup_lane_of(place) == 0u {
        patch_two[subgroup_of(place)] = part.xy;
        patch_one[subgroup_of(place)] = part.z;
    }
    workgroupBarrier();
    var sum = vec3<f32>();
    if place.lane == 0u {
        for (var k = 0u; k < subgroups_of(place, lanes); k++) {
            sum += vec3<f32>(patch_two[k], patch_one[k]);
        }
    }
    return sum;
}
#else
fn sum_lanes(place: SubgroupPlace, lanes: u32, value: vec3<f32>) -> vec3<f32> {
    patch_two[place.lane] = value.xy;
    patch_one[place.lane] = value.z;
    workgroupBarrier();
    // Sixteen parts of equally many lanes.
    let each = lanes / 16u;
    var sum = vec3<f32>();
    if place.lane < 16u {
        for (var k = 0u; k < each; k++) {
            sum += vec3<f32>(patch_two[each * place.lane + k], patch_one[each * place.lane + k]);
        }
    }
    workgroupBarrier();
    if place.lane < 16u {
        patch_two[place.lane] = sum.xy;
        patch_one[place.lane] = sum.z;
    }
    workgroupBarrier();
    sum = vec3<f32>();
    if place.lane == 0u {
        for (var k = 0u; k < 16u; k++) {
            sum += vec3<f32>(patch_two[k], patch_one[k]);
        }
    }
    return sum;
}
#endif

/// [S, dS/dmx, dS/dE[xx], dS/dE[xy]] from the windowed means of x, y, x^2 + y^2 and x y.
fn ssim_point(mx: f32, my: f32, squares: f32, products: f32) -> vec4<f32> {
    let mean_product = mx * my;
    let mean_squares = mx * mx + my * my;
    let a1 = 2.0 * mean_product + SSIM_C1;
    let a2 = 2.0 * (products - mean_product) + SSIM_C2;
    let b1 = mean_squares + SSIM_C1;
    // Rounding can make the sum of two variances negative, for a bright flat patch.
    let b2 = max(squares - mean_squares, 0.0) + SSIM_C2;
    let inverse = 1.0 / (b1 * b2);
    let ssim = a1 * a2 * inverse;
    let v_mean = 2.0 * inverse * (my * (a2 - a1) + mx * ssim * (b1 - b2));
    return vec4<f32>(ssim, v_mean, -ssim * b1 * inverse, 2.0 * a1 * inverse);
}

@compute @workgroup_size(128)
fn ssim_map(workgroup: Group, place: SubgroupPlace) {
    let j = job(linear_group(workgroup));
    for (var at = place.lane; at < PATCH_LEN; at += LANES) {
        let pixel = pixel_of_patch(j, at);
        var both = vec2<f32>();
        if j.exists && pixel != 0xffffffffu {
            both = values(j.channel, pixel);
        }
        patch_two[at] = both;
    }
    workgroupBarrier();
    for (var at = place.lane; at < FOURS_LEN; at += LANES) {
        let first = (at / 4u) * PATCH + 4u * (at % 4u);
        var v: array<vec4<f32>, SPAN>;
#repeat K 0u 1u 2u 3u 4u 5u 6u 7u 8u 9u 10u 11u 12u 13u
        v[K] = four(first + K);
#end
        let sums = windowed_4(v);
#repeat K 0u 1u 2u 3u
        filtered[4u * at + K] = sums[K];
#end
    }
    workgroupBarrier();
    let column = place.lane % TILE;
    let row = place.lane / TILE * 2u;
    let means = down_2(row * TILE + column);
    let x = j.x0 + column;
    let pixels = loss.width * loss.height;
    var sum = vec3<f32>();
#repeat K 0u 1u
    {
        let y = j.y0 + row + K;
        if j.exists && x < loss.width && y < loss.height {
            let pixel = y * loss.width + x;
            let inside = x >= loss.margin && x + loss.margin < loss.width && y >= loss.margin && y + loss.margin < loss.height;
            var point = vec4<f32>();
            if inside && (target_pixels[pixel] >> 24u) != 0u {
                point = ssim_point(means[K].x, means[K].y, means[K].z, means[K].w);
            }
            sum.z += point.x;
            derivatives[3u * j.plane * pixels + pixel] = point.y;
            derivatives[(3u * j.plane + 1u) * pixels + pixel] = point.z;
            derivatives[(3u * j.plane + 2u) * pixels + pixel] = point.w;
        }
    }
#end
    let total = sum_lanes(place, LANES, sum);
    if place.lane == 0u && j.exists {
        partials[j.partial] = vec4<f32>(total, 0.0);
    }
}

@compute @workgroup_size(128)
fn gradient(workgroup: Group, place: SubgroupPlace) {
    let j = job(linear_group(workgroup));
    let pixels = loss.width * loss.height;
    for (var at = place.lane; at < PATCH_LEN; at += LANES) {
        let pixel = pixel_of_patch(j, at);
        var two = vec2<f32>();
        var one = 0.0;
        if j.exists && pixel != 0xffffffffu {
            two = vec2<f32>(
                derivatives[3u * j.plane * pixels + pixel],
                derivatives[(3u * j.plane + 1u) * pixels + pixel],
            );
            one = derivatives[(3u * j.plane + 2u) * pixels + pixel];
        }
        patch_two[at] = two;
        patch_one[at] = one;
    }
    workgroupBarrier();
    for (var at = place.lane; at < FOURS_LEN; at += LANES) {
        let first = (at / 4u) * PATCH + 4u * (at % 4u);
        var v: array<vec4<f32>, SPAN>;
#repeat K 0u 1u 2u 3u 4u 5u 6u 7u 8u 9u 10u 11u 12u 13u
        v[K] = three(first + K);
#end
        let sums = windowed_4(v);
#repeat K 0u 1u 2u 3u
        filtered[4u * at + K] = sums[K];
#end
    }
    workgroupBarrier();
    let column = place.lane % TILE;
    let row = place.lane / TILE * 2u;
    let d = down_2(row * TILE + column);
    let x = j.x0 + column;
    var sum = vec3<f32>();
#repeat K 0u 1u
    {
        let y = j.y0 + row + K;
        if j.exists && x < loss.width && y < loss.height {
            let pixel = y * loss.width + x;
            let both = values(j.channel, pixel);
            let difference = both.x - both.y;
            var v = select(0.0, loss.l1_weight, difference > 0.0) - select(0.0, loss.l1_weight, difference < 0.0);
            v += loss.ssim_weight * (2.0 * both.x * d[K].y + both.y * d[K].z + d[K].x);
            let counts = (target_pixels[pixel] >> 24u) != 0u;
            v_rgb[j.channel * pixels + pixel] = select(0.0, v, counts);
            sum += vec3<f32>(abs(difference), difference * difference, 0.0);
        }
    }
#end
    let total = sum_lanes(place, LANES, sum);
    if place.lane == 0u && j.exists {
        partials[j.partial] = vec4<f32>(total.xy, partials[j.partial].z, 0.0);
    }
}

@compute @workgroup_size(256)
fn sum_partials(workgroup: Group, place: SubgroupPlace) {
    let group = linear_group(workgroup);
    let each = PARTIALS_EACH * WORKGROUP;
    var sum = vec3<f32>();
    for (var k = 0u; k < PARTIALS_EACH; k++) {
        let at = group * each + k * WORKGROUP + place.lane;
        if at < loss.partial_count {
            sum += partials[at].xyz;
        }
    }
    let total = sum_lanes(place, WORKGROUP, sum);
    if place.lane == 0u && group < (loss.partial_count + each - 1u) / each {
        sums[group] = vec4<f32>(total, 0.0);
    }
}

/// Squared difference of picture and photo at each pixel, mean over the channels; 0 where the pixel is excluded.
@compute @workgroup_size(256)
fn squared_errors(workgroup: Group, place: Place) {
    let pixel = linear_index(workgroup, place, WORKGROUP);
    if pixel >= loss.width * loss.height {
        return;
    }
    var sum = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        let both = values(channel, pixel);
        let difference = both.x - both.y;
        sum += difference * difference;
    }
    errors[pixel] = sum / 3.0;
}
