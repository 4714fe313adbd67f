// Sums of blocks of 2048 values: the way up of the prefix sum (scan.wgsl is the way down). Sums saturate.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/workgroup_scan.wgsl"

struct ScanUniforms {
    /// Values of this level.
    count: u32,
    /// 1: scan.wgsl adds `bases`; 0: there is one block, and its base is 0.
    has_bases: u32,
    pad: vec2<u32>,
}

@group(0) @binding(0) var<uniform> level: ScanUniforms;
@group(0) @binding(1) var<storage, read> values: array<u32>;
/// One for each block.
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;

const ITEMS: u32 = 8u;

@compute @workgroup_size(256)
fn scan_reduce(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
#ifdef SUBGROUPS
    @builtin(subgroup_id) subgroup: u32,
    @builtin(num_subgroups) subgroups: u32,
    @builtin(subgroup_invocation_id) subgroup_lane: u32,
#endif
) {
    let block = linear_group(workgroup, workgroups);
    let first = (block * 256u + lane) * ITEMS;
    var sum = 0u;
    for (var i = 0u; i < ITEMS; i++) {
        if first + i < level.count {
            sum = saturating_add(sum, values[first + i]);
        }
    }
#ifdef SUBGROUPS
    let scanned = workgroup_scan(sum, lane, subgroup, subgroups, subgroup_lane);
#else
    let scanned = workgroup_scan(sum, lane);
#endif
    if lane == 0u && block * (256u * ITEMS) < level.count {
        sums[block] = scanned.total;
    }
}
