// Blends each tile's list of splats front to back, the twin of src/kernels/rasterize_fwd.rs, which has the contract.
//
// Dead pixels (stopped, or outside the image) keep t = 0, so they add nothing, and a floor of -1, so they never stop
// again.
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
/// [height][width]: transmittance behind the last contribution.
@group(0) @binding(6) var<storage, read_write> t_final: array<f32>;
/// [height][width]: list index of the splat at which the pixel stopped, or NEVER.
@group(0) @binding(7) var<storage, read_write> stops: array<u32>;

var<workgroup> batch: array<TileSplat, TILE_LANES>;
/// Invocations whose four pixels are dead.
var<workgroup> finished: atomic<u32>;

@compute @workgroup_size(64)
fn rasterize_fwd(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = linear_group(workgroup, workgroups);
    let grid = view.grid;
    // Uniform in the workgroup.
    if tile >= grid.tiles_x * grid.tiles_y {
        return;
    }
    let pixel = pixel_of(tile, lane, grid);
    let plane = grid.width * grid.height;
    let at = pixel.y * grid.width + pixel.x;
    let inside = (vec4<u32>(pixel.x) + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(grid.width))
        & vec4<bool>(pixel.y < grid.height);

    var t = select(vec4<f32>(0.0), vec4<f32>(1.0), inside);
    var low = select(vec4<f32>(-1.0), vec4<f32>(TRANSMITTANCE_MIN), inside);
    var end_t = vec4<f32>(0.0);
    var stop = vec4<u32>(NEVER);
    var red = vec4<f32>(0.0);
    var green = vec4<f32>(0.0);
    var blue = vec4<f32>(0.0);
    if (view.flags & SEGMENT_FIRST) == 0u {
        for (var i = 0u; i < 4u; i++) {
            if inside[i] {
                red[i] = rgb[at + i];
                green[i] = rgb[plane + at + i];
                blue[i] = rgb[2u * plane + at + i];
                stop[i] = stops[at + i];
                end_t[i] = t_final[at + i];
                let alive = stop[i] == NEVER;
                t[i] = select(0.0, end_t[i], alive);
                low[i] = select(-1.0, TRANSMITTANCE_MIN, alive);
            }
        }
    }
    var alive = any(low > vec4<f32>(0.0));
    if !alive {
        atomicAdd(&finished, 1u);
    }

    let list = tile_offsets[tile];
    let count = tile_offsets[tile + 1u] - list;
    let end = min(count, view.end);
    let x = vec4<f32>(f32(pixel.x)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let y = f32(pixel.y) + 0.5;
    for (var first = view.first; first < end; first += TILE_LANES) {
        workgroupBarrier();
        // Every invocation reads between two barriers and adds behind the second: all see the same number.
        if atomicLoad(&finished) == TILE_LANES {
            break;
        }
        if first + lane < end {
            let record = SPLAT_STRIDE * row_from_isect[isects[list + first + lane]];
            batch[lane] = tile_splat(splat_unpack(splats[record], splats[record + 1u], splats[record + 2u]));
        }
        workgroupBarrier();
        let batch_end = min(TILE_LANES, end - first);
        for (var i = 0u; alive && i < batch_end; i++) {
            let splat = batch[i];
            let dx = x - vec4<f32>(splat.mean.x);
            let e = exponents(splat, dx, y - splat.mean.y);
            let above = e >= vec4<f32>(LOG2_ALPHA_MIN);
            if !any(above) {
                continue;
            }
            let alpha = select(vec4<f32>(0.0), alphas(e, splat.log2_opacity, view.max_alpha), above);
            var weight = alpha * t;
            var next = t - alpha * t;
            let stopping = next <= low;
            if any(stopping) {
                end_t = select(end_t, t, stopping);
                stop = select(stop, vec4<u32>(first + i), stopping);
                low = select(low, vec4<f32>(-1.0), stopping);
                next = select(next, vec4<f32>(0.0), stopping);
                weight = select(weight, vec4<f32>(0.0), stopping);
                alive = any(low > vec4<f32>(0.0));
                if !alive {
                    atomicAdd(&finished, 1u);
                }
            }
            t = next;
            red += weight * splat.color.x;
            green += weight * splat.color.y;
            blue += weight * splat.color.z;
        }
    }

    end_t = select(end_t, t, low > vec4<f32>(0.0));
    if (view.flags & SEGMENT_LAST) != 0u {
        red += end_t * view.background.x;
        green += end_t * view.background.y;
        blue += end_t * view.background.z;
    }
    for (var i = 0u; i < 4u; i++) {
        if inside[i] {
            rgb[at + i] = red[i];
            rgb[plane + at + i] = green[i];
            rgb[2u * plane + at + i] = blue[i];
            t_final[at + i] = end_t[i];
            stops[at + i] = stop[i];
        }
    }
}
