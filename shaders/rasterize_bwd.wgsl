// Gradients of footprints and colours from the gradient of the image, back to front through each tile's list: the twin
// of src/kernels/rasterize_bwd.rs, which documents the formulas. Nine sums per splat and tile: h, h dx, h dy, h dx^2, h
// dx dy, h dy^2 and weight v_rgb; fold_rows converts them to gradients. With WEIGHS two more sums are statistics: weight, and
// weight times the error of the pixel. They lie in words of a record that gradients leave free.
//
// No float atomics: the sums of an invocation's pixels are added within the subgroup (without subgroups, each
// invocation is a part), the parts are added through workgroup memory in a fixed order, and one invocation writes the
// result to the place of this intersection. If subgroups have 8 invocations, sums within one are written out, 8 splats
// at a time. So every run on a device gives the same bits.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/subgroups.wgsl"
#import "shared/math.wgsl"
#import "shared/raster.wgsl"

@group(0) @binding(0) var<uniform> view: RasterUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> row_from_isect: array<u32>;
@group(0) @binding(3) var<storage, read> isects: array<u32>;
@group(0) @binding(4) var<storage, read> tile_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> t_final: array<f32>;
@group(0) @binding(6) var<storage, read> stops: array<u32>;
/// [3][height][width], and a fourth plane with HAS_V_ALPHA.
@group(0) @binding(7) var<storage, read> v_rgb: array<f32>;
/// [intersections of the window][9]
@group(0) @binding(8) var<storage, read_write> partials: array<f32>;
/// [height][width][2]: t and behind, if the list has more than one segment or part.
@group(0) @binding(9) var<storage, read_write> carry: array<vec2<f32>>;
/// Rows by rank.
@group(0) @binding(10) var<storage, read> order: array<u32>;
/// First intersection of each rank; row_count + 1 entries.
@group(0) @binding(11) var<storage, read> offsets: array<u32>;
@group(0) @binding(12) var<storage, read_write> v_splats: array<vec4<f32>>;
/// Rows with a gradient that is too large for the optimizer, or not finite.
@group(0) @binding(13) var<storage, read_write> unusable: atomic<u32>;

#ifdef WEIGHS
/// [height][width]
@group(0) @binding(14) var<storage, read> errors: array<f32>;

const SUMS: u32 = 11u;
#else
const SUMS: u32 = 9u;
#endif
/// The bits of LARGEST_SPLAT_GRAD in src/base/math.rs, 1e12.
const LARGEST_SPLAT_GRAD_BITS: u32 = 0x5368d4a5u;
/// Parts of the sums of one splat, times the splats of a batch. Subgroups of 32 and more give at most two parts, so that a whole batch
/// takes half of the memory, and more workgroups run at a time.
#ifdef SUBGROUPS_OF_32
const PARTS_OF_BATCH: u32 = 128u;
#else
const PARTS_OF_BATCH: u32 = 256u;
#endif

var<workgroup> batch: array<TileSplat, TILE_LANES>;
var<workgroup> batch_isects: array<u32, TILE_LANES>;
/// [splats of the batch][SUMS][parts]
var<workgroup> sums: array<f32, PARTS_OF_BATCH * SUMS>;
/// Largest stop of the tile.
var<workgroup> tile_stop: atomic<u32>;

/// An invocation's four pixels.
struct Pixels {
    /// Transmittance behind the splats processed so far.
    t: vec4<f32>,
    /// Colour seen behind them, dotted with v_rgb.
    behind: vec4<f32>,
    stop: vec4<u32>,
    v_red: vec4<f32>,
    v_green: vec4<f32>,
    v_blue: vec4<f32>,
#ifdef WEIGHS
    error: vec4<f32>,
#endif
}

/// The sums over an invocation's pixels.
struct Sums {
    h: f32,
    firsts: vec2<f32>,
    seconds: vec3<f32>,
    color: vec3<f32>,
#ifdef WEIGHS
    /// Weight, and weight times error.
    weights: vec2<f32>,
#endif
}

fn pixels_behind(at: u32, plane: u32, inside: vec4<bool>) -> Pixels {
    var p: Pixels;
    for (var i = 0u; i < 4u; i++) {
        if inside[i] {
            let here = at + i;
            p.v_red[i] = v_rgb[here];
            p.v_green[i] = v_rgb[plane + here];
            p.v_blue[i] = v_rgb[2u * plane + here];
            p.stop[i] = stops[here];
#ifdef WEIGHS
            p.error[i] = errors[here];
#endif
            if (view.flags & SEGMENT_FIRST) != 0u {
                p.t[i] = t_final[here];
                p.behind[i] = dot(view.background, vec3<f32>(p.v_red[i], p.v_green[i], p.v_blue[i]));
                if (view.flags & HAS_V_ALPHA) != 0u {
                    p.behind[i] -= v_rgb[3u * plane + here];
                }
            } else {
                p.t[i] = carry[here].x;
                p.behind[i] = carry[here].y;
            }
        }
    }
    return p;
}

/// Removes a splat from the pixels that it affects.
fn take_off(
    pixels: ptr<function, Pixels>,
    splat: TileSplat,
    e: vec4<f32>,
    taking_part: vec4<bool>,
    dx: vec4<f32>,
    dy: f32,
) -> Sums {
    let alpha = select(vec4<f32>(0.0), alphas(e, splat.log2_opacity, view.max_alpha), taking_part);
    let before = (*pixels).t / (vec4<f32>(1.0) - alpha);
    let weight = alpha * before;
    let v_red = (*pixels).v_red;
    let v_green = (*pixels).v_green;
    let v_blue = (*pixels).v_blue;
    // alpha dL/dalpha = weight (colour of the splat - colour it hides)
    let over = splat.color.x * v_red + (splat.color.y * v_green + splat.color.z * v_blue) - (*pixels).behind;
    let h = select(vec4<f32>(0.0), weight * over, e <= vec4<f32>(view.log2_max_alpha));
    (*pixels).t = before;
    (*pixels).behind += alpha * over;
    let hx = h * dx;
    let h_sum = (h.x + h.y) + (h.z + h.w);
    let hx_sum = (hx.x + hx.y) + (hx.z + hx.w);
    return Sums(
        h_sum,
        vec2<f32>(hx_sum, dy * h_sum),
        vec3<f32>(dot(hx, dx), dy * hx_sum, dy * dy * h_sum),
        vec3<f32>(dot(weight, v_red), dot(weight, v_green), dot(weight, v_blue)),
#ifdef WEIGHS
        vec2<f32>((weight.x + weight.y) + (weight.z + weight.w), dot(weight, (*pixels).error)),
#endif
    );
}

fn write_sums(to: u32, parts: u32, s: Sums) {
    sums[to] = s.h;
    sums[to + parts] = s.firsts.x;
    sums[to + 2u * parts] = s.firsts.y;
    sums[to + 3u * parts] = s.seconds.x;
    sums[to + 4u * parts] = s.seconds.y;
    sums[to + 5u * parts] = s.seconds.z;
    sums[to + 6u * parts] = s.color.x;
    sums[to + 7u * parts] = s.color.y;
    sums[to + 8u * parts] = s.color.z;
#ifdef WEIGHS
    sums[to + 9u * parts] = s.weights.x;
    sums[to + 10u * parts] = s.weights.y;
#endif
}

#ifdef SUBGROUPS_OF_8
/// The sum over a subgroup of 8, in all its invocations.
fn sum_of_8(v: vec3<f32>) -> vec3<f32> {
    let low = (subgroupBroadcast(v, 0u) + subgroupBroadcast(v, 1u)) + (subgroupBroadcast(v, 2u) + subgroupBroadcast(v, 3u));
    let high = (subgroupBroadcast(v, 4u) + subgroupBroadcast(v, 5u)) + (subgroupBroadcast(v, 6u) + subgroupBroadcast(v, 7u));
    return low + high;
}

/// Removes the splats [first, first + 8) below `size` and leaves their sums in workgroup memory: each invocation of the
/// subgroup loads one splat, the others receive it from there, and it keeps that splat's sums.
fn take_off_8(pixels: ptr<function, Pixels>, first: u32, list_index: u32, size: u32, x: vec4<f32>, y: f32, part: u32, own_lane: u32) {
    var own = batch[min(first + own_lane, size - 1u)];
    // Beyond the end: far below every threshold.
    own.log2_opacity = select(-1e30, own.log2_opacity, first + own_lane < size);
    var one = vec3<f32>();
    var two = vec3<f32>();
    var three = vec3<f32>();
#ifdef WEIGHS
    var four = vec3<f32>();
#endif
#repeat LANE 7u 6u 5u 4u 3u 2u 1u 0u
    {
        let splat = TileSplat(
            subgroupBroadcast(own.mean, LANE),
            subgroupBroadcast(own.a, LANE),
            subgroupBroadcast(own.b, LANE),
            subgroupBroadcast(own.c, LANE),
            subgroupBroadcast(own.log2_opacity, LANE),
            subgroupBroadcast(own.color, LANE),
        );
        let dx = x - vec4<f32>(splat.mean.x);
        let dy = y - splat.mean.y;
        let e = exponents(splat, dx, dy);
        let taking_part = (e >= vec4<f32>(LOG2_ALPHA_MIN)) & (vec4<u32>(view.list_base + list_index + first + LANE) < (*pixels).stop);
        let s = take_off(pixels, splat, e, taking_part, dx, dy);
        one = select(one, sum_of_8(vec3<f32>(s.h, s.firsts)), own_lane == LANE);
        two = select(two, sum_of_8(s.seconds), own_lane == LANE);
        three = select(three, sum_of_8(s.color), own_lane == LANE);
#ifdef WEIGHS
        four = select(four, sum_of_8(vec3<f32>(s.weights, 0.0)), own_lane == LANE);
#endif
    }
#end
    if first + own_lane < size {
#ifdef WEIGHS
        write_sums((first + own_lane) * SUMS * 8u + part, 8u, Sums(one.x, one.yz, two, three, four.xy));
#else
        write_sums((first + own_lane) * SUMS * 8u + part, 8u, Sums(one.x, one.yz, two, three));
#endif
    }
}
#endif

@compute @workgroup_size(64)
fn rasterize_bwd(
    workgroup: Group,
    place: Place,
#ifdef SUBGROUPS
#ifndef EMULATED_SUBGROUPS
    // Not in a struct: the number is the same for all invocations, which compilers would not see there.
    @builtin(num_subgroups) subgroups: u32,
    @builtin(subgroup_id) part: u32,
    @builtin(subgroup_invocation_id) subgroup_lane: u32,
#endif
#endif
) {
#ifdef SUBGROUPS
#ifdef EMULATED_SUBGROUPS
    let part = place.lane / SUBGROUP_SIZE;
    let subgroup_lane = place.lane % SUBGROUP_SIZE;
    let subgroups = TILE_LANES / SUBGROUP_SIZE;
#endif
#ifdef SUBGROUPS_OF_8
    let parts = 8u;
#else
    let parts = subgroups;
#endif
#else
    let part = place.lane;
    let subgroup_lane = 0u;
    let parts = TILE_LANES;
#endif
    let n = linear_group(workgroup);
    // Uniform across the workgroup.
    if n >= tiles_in_range(view.range) {
        return;
    }
    let here = pixels_of(n, place.lane, view.range, view.grid);
    var pixels = pixels_behind(here.at, here.plane, here.inside);
    let stop = pixels.stop;
    if place.lane == 0u {
        atomicStore(&tile_stop, 0u);
    }
    workgroupBarrier();
    atomicMax(&tile_stop, max(max(stop.x, stop.y), max(stop.z, stop.w)));

    let stop_of_tile = workgroupUniformLoad(&tile_stop);
    // Not from `here`, in which compilers would see what differs between invocations.
    let tile = tile_of_range(n, view.range, view.grid);
    let list = tile_offsets[tile];
    let count = tile_offsets[tile + 1u] - list;
    let batch_size = min(TILE_LANES, PARTS_OF_BATCH / parts);
    var end = min(count, view.end);
    while end > view.first {
        let size = min(batch_size, end - view.first);
        let first = end - size;
        end = first;
        workgroupBarrier();
        if place.lane < size {
            let isect = isects[list + first + place.lane];
            let record = SPLAT_STRIDE * row_from_isect[isect];
            batch_isects[place.lane] = isect;
            batch[place.lane] = tile_splat(splat_unpack(splats[record], splats[record + 1u], splats[record + 2u]));
        }
        workgroupBarrier();
        let reached = view.list_base + first < stop_of_tile;
#ifdef SUBGROUPS_OF_8
        for (var i = (size + 7u) / 8u * 8u; reached && i > 0u;) {
            i -= 8u;
            take_off_8(&pixels, i, first, size, here.x, here.y, part, subgroup_lane);
        }
#else
        for (var i = size; reached && i > 0u;) {
            i--;
            let splat = batch[i];
            let dx = here.x - vec4<f32>(splat.mean.x);
            let dy = here.y - splat.mean.y;
            let e = exponents(splat, dx, dy);
            let taking_part = (e >= vec4<f32>(LOG2_ALPHA_MIN)) & (vec4<u32>(view.list_base + first + i) < stop);
            let to = i * SUMS * parts + part;
#ifdef SUBGROUPS
#ifndef EMULATED_SUBGROUPS
            if !subgroupAny(any(taking_part)) {
                if subgroup_lane == 0u {
                    write_sums(to, parts, Sums());
                }
                continue;
            }
#endif
            var s = take_off(&pixels, splat, e, taking_part, dx, dy);
#ifdef WEIGHS
            let weights = subgroup_sum_vec2(s.weights, place.lane);
#endif
            let firsts = subgroup_sum_vec3(vec3<f32>(s.h, s.firsts), place.lane);
            s = Sums(
                firsts.x,
                firsts.yz,
                subgroup_sum_vec3(s.seconds, place.lane),
                subgroup_sum_vec3(s.color, place.lane),
#ifdef WEIGHS
                weights,
#endif
            );
            if subgroup_lane == 0u {
                write_sums(to, parts, s);
            }
#else
            write_sums(to, parts, take_off(&pixels, splat, e, taking_part, dx, dy));
#endif
        }
#endif
        workgroupBarrier();
        for (var i = place.lane; i < size * SUMS; i += TILE_LANES) {
            var sum = 0.0;
            if reached {
                if parts < 4u {
                    for (var p = 0u; p < parts; p++) {
                        sum += sums[i * parts + p];
                    }
                } else {
                    // Four at a time, to stay below the limit on iterations; the number of parts is a power of two.
                    for (var p = i * parts; p < (i + 1u) * parts; p += 4u) {
                        sum += (sums[p] + sums[p + 1u]) + (sums[p + 2u] + sums[p + 3u]);
                    }
                }
            }
            let isect = batch_isects[i / SUMS];
            if isect >= view.window_first && isect < view.window_end {
                partials[(isect - view.window_first) * SUMS + i % SUMS] = sum;
            }
        }
    }
    if (view.flags & SEGMENT_LAST) == 0u {
        for (var i = 0u; i < 4u; i++) {
            if here.inside[i] {
                carry[here.at + i] = vec2<f32>(pixels.t[i], pixels.behind[i]);
            }
        }
    }
}

/// Rows per workgroup; its last invocations are idle.
#ifdef WEIGHS
const GROUP_ROWS: u32 = 23u;
#else
const GROUP_ROWS: u32 = 28u;
#endif

var<workgroup> row_sums: array<f32, 256>;

/// One sum of one intersection; 0 if it was counted but not found, because no tile wrote it.
fn partial(isect: u32, row: u32, which: u32) -> f32 {
    return select(0.0, partials[(isect - view.window_first) * SUMS + which], row_from_isect[isect] == row);
}

/// The row at a rank.
fn row_at(rank: u32) -> u32 {
    if (view.flags & FOLD_WITHOUT_LISTS) != 0u {
        return rank;
    }
    return order[rank];
}

/// First intersection of a rank, and one past the last.
fn isects_at(rank: u32) -> vec2<u32> {
    if (view.flags & FOLD_WITHOUT_LISTS) != 0u {
        return vec2<u32>();
    }
    let end = min(offsets[rank + 1u], view.isect_count);
    return vec2<u32>(min(offsets[rank], end), end);
}

/// Folds the sums of each row over its intersections, in emit order (tiles column by column), and converts them to
/// gradients. As many invocations process a row as there are sums. A row that ends beyond the window, or may have intersections
/// in a later range of tiles, stores its sums in place of its gradients, in the order of the sums, and the next window
/// or range continues from there. Counts the rows whose gradients are unusable.
@compute @workgroup_size(256)
fn fold_rows(workgroup: Group, place: Place) {
    let group = linear_group(workgroup);
    let rank = group * GROUP_ROWS + place.lane / SUMS;
    let which = place.lane % SUMS;
    var sum = 0.0;
    if place.lane < GROUP_ROWS * SUMS && rank < view.row_count {
        let row = row_at(rank);
        let isects_of_row = isects_at(rank);
        let row_first = isects_of_row.x;
        let row_end = isects_of_row.y;
        let end = min(row_end, view.window_end);
        var isect = max(row_first, view.window_first);
        let spans_windows = row_first < view.window_first && row_end > view.window_first;
        if spans_windows || (view.flags & FOLD_CARRIED) != 0u {
            let carried = v_splats[SPLAT_STRIDE * row + which / 4u];
            sum = carried[which % 4u];
        }
        // Four at a time, to stay below the limit on iterations; the additions are in the order of the intersections.
        while isect + 4u <= end {
            let p0 = partial(isect, row, which);
            let p1 = partial(isect + 1u, row, which);
            let p2 = partial(isect + 2u, row, which);
            let p3 = partial(isect + 3u, row, which);
            sum = (((sum + p0) + p1) + p2) + p3;
            isect += 4u;
        }
        while isect < end {
            sum += partial(isect, row, which);
            isect++;
        }
    }
    row_sums[place.lane] = sum;
    workgroupBarrier();
    let own_rank = group * GROUP_ROWS + place.lane;
    if place.lane >= GROUP_ROWS || own_rank >= view.row_count {
        return;
    }
    let row = row_at(own_rank);
    let at = SPLAT_STRIDE * row;
    let s = place.lane * SUMS;
    let isects_of_row = isects_at(own_rank);
    let row_first = isects_of_row.x;
    let row_end = isects_of_row.y;
    // A row without intersections belongs to the first window, any other row to each window that has some of its
    // intersections.
    let is_here = select(view.window_first == 0u, row_first < view.window_end && row_end > view.window_first, row_end > row_first);
    if !is_here {
        return;
    }
    // More windows follow. (A row without intersections is complete, wherever its place would be.)
    let continues = row_end > view.window_end && row_end > row_first;
    if continues || (view.flags & FOLD_UNFINISHED) != 0u {
        v_splats[at] = vec4<f32>(row_sums[s], row_sums[s + 1u], row_sums[s + 2u], row_sums[s + 3u]);
        v_splats[at + 1u] = vec4<f32>(row_sums[s + 4u], row_sums[s + 5u], row_sums[s + 6u], row_sums[s + 7u]);
#ifdef WEIGHS
        v_splats[at + 2u] = vec4<f32>(row_sums[s + 8u], row_sums[s + 9u], row_sums[s + 10u], 0.0);
#else
        v_splats[at + 2u] = vec4<f32>(row_sums[s + 8u], 0.0, 0.0, 0.0);
#endif
        return;
    }
    let splat = splat_unpack(splats[at], splats[at + 1u], splats[at + 2u]);
    // dL/dsigma = -h; sigma = (A dx^2 + C dy^2) / 2 + B dx dy with dx = pixel - mean.
    let conic = splat.conic;
    let v_mean = vec2<f32>(conic.x * row_sums[s + 1u] + conic.y * row_sums[s + 2u], conic.y * row_sums[s + 1u] + conic.z * row_sums[s + 2u]);
    // A row that is not drawn has neither opacity nor sums.
    let v_opacity = select(0.0, row_sums[s] / splat.opacity, splat.opacity > 0.0);
#ifdef WEIGHS
    let weights = vec2<f32>(row_sums[s + 9u], row_sums[s + 10u]);
#else
    let weights = vec2<f32>();
#endif
    let of_mean = vec4<f32>(v_mean, weights.x, v_opacity);
    let of_conic = vec4<f32>(-0.5 * row_sums[s + 3u], -row_sums[s + 4u], -0.5 * row_sums[s + 5u], weights.y);
    let of_color = vec4<f32>(row_sums[s + 6u], row_sums[s + 7u], row_sums[s + 8u], 0.0);
    v_splats[at] = of_mean;
    v_splats[at + 1u] = of_conic;
    v_splats[at + 2u] = of_color;
    // The weights are no gradients: a bright picture may make them larger than a gradient may be.
    let of_place = max(largest_magnitude(vec4<f32>(v_mean, v_opacity, 0.0)), largest_magnitude(vec4<f32>(of_conic.xyz, 0.0)));
    let most = max(of_place, largest_magnitude(of_color));
    if most > LARGEST_SPLAT_GRAD_BITS {
        atomicAdd(&unusable, 1u);
    }
}
