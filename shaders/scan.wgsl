// Exclusive prefix sum, the twin of src/kernels/scan.rs: blocks of 2048 values, each starting from the sum of the
// earlier blocks.
//
// Reduce, then scan: scan_reduce, or the stage that makes the values, sums them in groups; then every block of the scan adds up the
// sums before it, and the values before it in a group that it shares with another block. One dispatch replaces levels of scans, but what
// it reads grows with the square of the number of sums: where a block would read more than a few sums for each of its values,
// scan_reduce sums whole blocks, and where these are too many as well, their sums are scanned first. No workgroup waits for another.
// Offsets are 32-bit and saturate: a last entry of 0xffffffff means that the true total is that or more.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/workgroup_scan.wgsl"

struct ScanUniforms {
    /// Number of values.
    count: u32,
    /// Number of values of a sum.
    values_of_sum: u32,
    /// 1 if the sums are those of blocks, scanned already; else 0.
    are_sums_scanned: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> level: ScanUniforms;
@group(0) @binding(1) var<storage, read> values: array<u32>;
/// Sums of groups of values; not read where there is a single block.
@group(0) @binding(2) var<storage, read> sums: array<u32>;
/// One more entry than values: the last is the total. For scan_reduce: the sums of blocks.
@group(0) @binding(3) var<storage, read_write> offsets: array<u32>;

const ITEMS: u32 = 8u;

/// Whether a scan of ones counts the invocations in their order: 1 for each of a workgroup's. Sums over subgroups assume that
/// invocations lie in subgroups in their order, which drivers need not promise.
@compute @workgroup_size(256)
fn check_order(workgroup: Group, place: SubgroupPlace) {
    let scanned = workgroup_scan(1u, place);
    offsets[place.lane] = u32(scanned.before == place.lane && scanned.total == 256u);
}

@compute @workgroup_size(256)
fn scan_reduce(workgroup: Group, place: SubgroupPlace) {
    let block = linear_group(workgroup);
    let first = (block * 256u + place.lane) * ITEMS;
    var sum = 0u;
    for (var i = 0u; i < ITEMS; i++) {
        if first + i < level.count {
            sum = saturating_add(sum, values[first + i]);
        }
    }
    let scanned = workgroup_scan(sum, place);
    if place.lane == 0u && block * (256u * ITEMS) < level.count {
        offsets[block] = scanned.total;
    }
}

@compute @workgroup_size(256)
fn scan(workgroup: Group, place: SubgroupPlace) {
    let block = linear_group(workgroup);
    let first = (block * 256u + place.lane) * ITEMS;
    var before: array<u32, ITEMS>;
    var sum = 0u;
    for (var i = 0u; i < ITEMS; i++) {
        before[i] = sum;
        if first + i < level.count {
            sum = saturating_add(sum, values[first + i]);
        }
    }
    var earlier = 0u;
    let start = block * (256u * ITEMS);
    if level.are_sums_scanned == 1u {
        if place.lane == 0u && start < level.count {
            earlier = sums[block];
        }
    } else {
        let whole = start / max(level.values_of_sum, 1u);
        for (var k = place.lane; k < whole; k += 256u) {
            earlier = saturating_add(earlier, sums[k]);
        }
        for (var k = whole * level.values_of_sum + place.lane; k < start; k += 256u) {
            earlier = saturating_add(earlier, values[k]);
        }
    }
    let before_block = workgroup_scan(earlier, place).total;
    workgroupBarrier();
    let base = saturating_add(before_block, workgroup_scan(sum, place).before);
    for (var i = 0u; i < ITEMS; i++) {
        if first + i < level.count {
            offsets[first + i] = saturating_add(base, before[i]);
        }
    }
    // The invocation with the last value writes the total; without values the first invocation does.
    if first < level.count && first + ITEMS >= level.count {
        offsets[level.count] = saturating_add(base, sum);
    } else if level.count == 0u && first == 0u {
        offsets[0] = 0u;
    }
}
