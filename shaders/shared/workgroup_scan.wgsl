// Exclusive prefix sum over the 256 invocations of a workgroup. Sums saturate: 0xffffffff means "this or more" and
// stays so whatever is added, so an overflow anywhere shows in the total.
#import "shared/subgroups.wgsl"

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
fn workgroup_scan(value: u32, place: SubgroupPlace) -> WorkgroupScan {
    let low = subgroup_scan_u32(value & 0xffffu, place.lane);
    let high = subgroup_scan_u32(value >> 16u, place.lane);
    let before = saturating_join(low.x, high.x);
    if subgroup_lane_of(place) == 0u {
        scan_parts[subgroup_of(place)] = saturating_join(low.y, high.y);
    }
    workgroupBarrier();
    var total = 0u;
    var base = 0u;
    for (var s = 0u; s < subgroups_of(place, 256u); s++) {
        base = select(base, total, s == subgroup_of(place));
        total = saturating_add(total, scan_parts[s]);
    }
    return WorkgroupScan(saturating_add(base, before), total);
}
#else
/// Every invocation of the workgroup must call this, and pass a barrier before the next call.
fn workgroup_scan(value: u32, place: SubgroupPlace) -> WorkgroupScan {
    scan_parts[place.lane] = value;
    workgroupBarrier();
    if place.lane < 16u {
        var sum = 0u;
        for (var i = 16u * place.lane; i < 16u * place.lane + 16u; i++) {
            let part = scan_parts[i];
            scan_parts[i] = sum;
            sum = saturating_add(sum, part);
        }
        scan_segments[place.lane] = sum;
    }
    workgroupBarrier();
    var total = 0u;
    var base = 0u;
    for (var s = 0u; s < 16u; s++) {
        base = select(base, total, s == place.lane / 16u);
        total = saturating_add(total, scan_segments[s]);
    }
    return WorkgroupScan(saturating_add(base, scan_parts[place.lane]), total);
}
#endif
