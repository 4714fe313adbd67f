// Exclusive prefix sum over the 256 invocations of a workgroup. Sums saturate: 0xffffffff means "this or more" and
// stays so whatever is added, so an overflow anywhere shows in the total.

/// One entry per invocation, or per subgroup if the adapter has subgroups.
var<workgroup> scan_parts: array<u32, 256>;
var<workgroup> scan_segments: array<u32, 16>;

struct WorkgroupScan {
    /// Sum of the values of all invocations before this one.
    before: u32,
    /// Sum of all values.
    total: u32,
}

fn saturating_add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

#ifdef SUBGROUPS
/// Joins a sum that was computed separately for the low and the high 16 bits of its terms.
fn saturating_join(low: u32, high: u32) -> u32 {
    let top = high + (low >> 16u);
    return select((top << 16u) | (low & 0xffffu), 0xffffffffu, top > 0xffffu);
}

/// Every invocation of the workgroup must call this, and pass a barrier before the next call.
fn workgroup_scan(value: u32, lane: u32, subgroup: u32, subgroups: u32, subgroup_lane: u32) -> WorkgroupScan {
    let low = value & 0xffffu;
    let high = value >> 16u;
    var before = saturating_join(subgroupExclusiveAdd(low), subgroupExclusiveAdd(high));
    let all = saturating_join(subgroupAdd(low), subgroupAdd(high));
    if subgroup_lane == 0u {
        scan_parts[subgroup] = all;
    }
    workgroupBarrier();
    var total = 0u;
    var base = 0u;
    for (var s = 0u; s < subgroups; s++) {
        base = select(base, total, s == subgroup);
        total = saturating_add(total, scan_parts[s]);
    }
    return WorkgroupScan(saturating_add(base, before), total);
}
#else
/// Every invocation of the workgroup must call this, and pass a barrier before the next call.
fn workgroup_scan(value: u32, lane: u32) -> WorkgroupScan {
    scan_parts[lane] = value;
    workgroupBarrier();
    if lane < 16u {
        var sum = 0u;
        for (var i = 16u * lane; i < 16u * lane + 16u; i++) {
            let part = scan_parts[i];
            scan_parts[i] = sum;
            sum = saturating_add(sum, part);
        }
        scan_segments[lane] = sum;
    }
    workgroupBarrier();
    var total = 0u;
    var base = 0u;
    for (var s = 0u; s < 16u; s++) {
        base = select(base, total, s == lane / 16u);
        total = saturating_add(total, scan_segments[s]);
    }
    return WorkgroupScan(saturating_add(base, scan_parts[lane]), total);
}
#endif
