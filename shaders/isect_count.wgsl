// How many tiles each row can reach, in depth order: what the scan turns into the offsets of isect_emit.wgsl.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/footprint.wgsl"

struct IsectUniforms {
    grid: Grid,
    row_count: u32,
    /// Intersections that the buffers hold.
    capacity: u32,
    pad: vec2<u32>,
}

@group(0) @binding(0) var<uniform> view: IsectUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
/// Rows by rank.
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(256)
fn isect_count(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let rank = linear_index(workgroup, workgroups, lane, 256u);
    if rank >= view.row_count {
        return;
    }
    let at = SPLAT_STRIDE * order[rank];
    let reach = reach_of(splat_unpack(splats[at], splats[at + 1u], splats[at + 2u]), view.grid);
    var count = 0u;
    for (var tile_x = reach.box.x; tile_x < reach.box.z; tile_x++) {
        let rows = tile_rows_in(reach, view.grid, tile_x);
        count += rows.y - rows.x;
    }
    counts[rank] = count;
}
