// Blends each tile's list of splats front to back, the twin of src/kernels/rasterize_fwd.rs, which documents the
// contract.
//
// Dead pixels (stopped, or outside the image) keep t = 0, so they add nothing, and a floor of -1, so they never stop
// again.
//
// If subgroups have 8 invocations, each subgroup processes the list by itself, 8 splats at a time: every invocation
// loads one, and the others receive it from there. Otherwise the workgroup loads batches into its memory.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/raster.wgsl"

@group(0) @binding(0) var<uniform> view: RasterUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> row_from_isect: array<u32>;
/// Intersections, tile by tile.
@group(0) @binding(3) var<storage, read> isects: array<u32>;
@group(0) @binding(4) var<storage, read> tile_offsets: array<u32>;
/// [3][height][width]
@group(0) @binding(5) var<storage, read_write> rgb: array<f32>;
/// [height][width]: transmittance after the last contribution.
@group(0) @binding(6) var<storage, read_write> t_final: array<f32>;
/// [height][width]: list index of the splat at which the pixel stopped, or NEVER.
@group(0) @binding(7) var<storage, read_write> stops: array<u32>;

/// An invocation's four pixels.
struct Pixels {
    /// Transmittance, 0 once dead.
    t: vec4<f32>,
    /// The transmittance at which a pixel stops, or -1 once it is dead.
    low: vec4<f32>,
    /// Transmittance at which it stopped.
    end_t: vec4<f32>,
    stop: vec4<u32>,
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
}

fn are_alive(pixels: Pixels) -> bool {
    return any(pixels.low > vec4<f32>(0.0));
}

/// Blends entry `index` of the whole list, whose exponents are `e`.
fn blend(pixels: ptr<function, Pixels>, splat: TileSplat, e: vec4<f32>, index: u32) {
    let above = e >= vec4<f32>(LOG2_ALPHA_MIN);
    let alpha = select(vec4<f32>(0.0), alphas(e, splat.log2_opacity, view.max_alpha), above);
    let t = (*pixels).t;
    let next = t - alpha * t;
    let stopping = next <= (*pixels).low;
    (*pixels).end_t = select((*pixels).end_t, t, stopping);
    (*pixels).stop = select((*pixels).stop, vec4<u32>(index), stopping);
    (*pixels).low = select((*pixels).low, vec4<f32>(-1.0), stopping);
    (*pixels).t = select(next, vec4<f32>(0.0), stopping);
    let weight = select(alpha * t, vec4<f32>(0.0), stopping);
    (*pixels).red += weight * splat.color.x;
    (*pixels).green += weight * splat.color.y;
    (*pixels).blue += weight * splat.color.z;
}

/// State of the pixels before the segment.
fn pixels_before(at: u32, plane: u32, inside: vec4<bool>) -> Pixels {
    var p: Pixels;
    p.t = select(vec4<f32>(0.0), vec4<f32>(1.0), inside);
    p.low = select(vec4<f32>(-1.0), vec4<f32>(TRANSMITTANCE_MIN), inside);
    p.stop = vec4<u32>(NEVER);
    if (view.flags & SEGMENT_FIRST) == 0u {
        for (var i = 0u; i < 4u; i++) {
            if inside[i] {
                p.red[i] = rgb[at + i];
                p.green[i] = rgb[plane + at + i];
                p.blue[i] = rgb[2u * plane + at + i];
                p.stop[i] = stops[at + i];
                p.end_t[i] = t_final[at + i];
                let alive = p.stop[i] == NEVER;
                p.t[i] = select(0.0, p.end_t[i], alive);
                p.low[i] = select(-1.0, TRANSMITTANCE_MIN, alive);
            }
        }
    }
    return p;
}

fn write_pixels(pixels: Pixels, at: u32, plane: u32, inside: vec4<bool>) {
    var p = pixels;
    p.end_t = select(p.end_t, p.t, p.low > vec4<f32>(0.0));
    if (view.flags & SEGMENT_LAST) != 0u {
        p.red += p.end_t * view.background.x;
        p.green += p.end_t * view.background.y;
        p.blue += p.end_t * view.background.z;
    }
    for (var i = 0u; i < 4u; i++) {
        if inside[i] {
            rgb[at + i] = p.red[i];
            rgb[plane + at + i] = p.green[i];
            rgb[2u * plane + at + i] = p.blue[i];
            t_final[at + i] = p.end_t[i];
            stops[at + i] = p.stop[i];
        }
    }
}

fn splat_of(entry: u32) -> TileSplat {
    let record = SPLAT_STRIDE * row_from_isect[isects[entry]];
    return tile_splat(splat_unpack(splats[record], splats[record + 1u], splats[record + 2u]));
}

var<workgroup> batch: array<TileSplat, TILE_LANES>;
/// Number of invocations whose four pixels are all dead.
var<workgroup> finished: atomic<u32>;

@compute @workgroup_size(64)
fn rasterize_fwd(
    workgroup: Group,
    place: Place,
#ifdef SUBGROUPS_OF_8
    @builtin(subgroup_invocation_id) subgroup_lane: u32,
#endif
) {
    let n = linear_group(workgroup);
    // Uniform across the workgroup.
    if n >= tiles_in_range(view.range) {
        return;
    }
    let here = pixels_of(n, place.lane, view.range, view.grid);
    var pixels = pixels_before(here.at, here.plane, here.inside);

    // Not from `here`, in which compilers would see what differs between invocations.
    let tile = tile_of_range(n, view.range, view.grid);
    let list = tile_offsets[tile];
    let count = tile_offsets[tile + 1u] - list;
    let end = min(count, view.end);
#ifdef SUBGROUPS_OF_8
    for (var first = view.first; first < end; first += 8u) {
        if !subgroupAny(are_alive(pixels)) {
            break;
        }
        var own = splat_of(list + min(first + subgroup_lane, end - 1u));
        // Beyond the end: far below every threshold.
        own.log2_opacity = select(-1e30, own.log2_opacity, first + subgroup_lane < end);
#repeat LANE 0u 1u 2u 3u 4u 5u 6u 7u
        {
            let splat = TileSplat(
                subgroupBroadcast(own.mean, LANE),
                subgroupBroadcast(own.a, LANE),
                subgroupBroadcast(own.b, LANE),
                subgroupBroadcast(own.c, LANE),
                subgroupBroadcast(own.log2_opacity, LANE),
                subgroupBroadcast(own.color, LANE),
            );
            blend(&pixels, splat, exponents(splat, here.x - vec4<f32>(splat.mean.x), here.y - splat.mean.y), view.list_base + first + LANE);
        }
#end
    }
#else
    if place.lane == 0u {
        atomicStore(&finished, 0u);
    }
    workgroupBarrier();
    var alive = are_alive(pixels);
    if !alive {
        atomicAdd(&finished, 1u);
    }
    for (var first = view.first; first < end; first += TILE_LANES) {
        // Waits for all, before and after.
        if workgroupUniformLoad(&finished) == TILE_LANES {
            break;
        }
        if first + place.lane < end {
            batch[place.lane] = splat_of(list + first + place.lane);
        }
        workgroupBarrier();
        let batch_end = min(TILE_LANES, end - first);
        for (var i = 0u; alive && i < batch_end; i++) {
            let splat = batch[i];
            let e = exponents(splat, here.x - vec4<f32>(splat.mean.x), here.y - splat.mean.y);
            if any(e >= vec4<f32>(LOG2_ALPHA_MIN)) {
                blend(&pixels, splat, e, view.list_base + first + i);
                alive = are_alive(pixels);
                if !alive {
                    atomicAdd(&finished, 1u);
                }
            }
        }
    }
#endif
    write_pixels(pixels, here.at, here.plane, here.inside);
}
