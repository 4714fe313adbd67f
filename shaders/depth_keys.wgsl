// Keys and values of the sort by depth: the bits of a drawn row's depth (positive, so they order as the depths do) and
// the row. Rows that are not drawn go behind all others.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/splat.wgsl"

struct DepthUniforms {
    row_count: u32,
    pad: u32,
    pad2: vec2<u32>,
}

@group(0) @binding(0) var<uniform> depth: DepthUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> values: array<u32>;

@compute @workgroup_size(256)
fn depth_keys(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = linear_index(workgroup, workgroups, lane, 256u);
    if row >= depth.row_count {
        return;
    }
    let radius_x = splats[SPLAT_STRIDE * row + 1u].w;
    keys[row] = select(0xffffffffu, bitcast<u32>(splats[SPLAT_STRIDE * row].z), radius_x > 0.0);
    values[row] = row;
}
