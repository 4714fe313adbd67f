// First half of a pass of the radix sort (radix_sort.wgsl): how many keys of each digit every block of 2048 keys has.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/radix.wgsl"

@group(0) @binding(0) var<uniform> sort: SortUniforms;
@group(0) @binding(1) var<storage, read> live: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
/// [digits][blocks]; every entry is written, also of blocks without keys.
@group(0) @binding(3) var<storage, read_write> histogram: array<u32>;

/// [words][parts]: counts of runs of invocations.
var<workgroup> counts_of_parts: array<u32, 2048>;

@compute @workgroup_size(256)
fn radix_histogram(
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
    let count = min(live[sort.live_at], sort.capacity);
    let first = block * BLOCK_KEYS + lane * KEYS;
    var counts = DigitCounts(0u, 0u);
    for (var i = 0u; i < KEYS; i++) {
        if first + i < count {
            counts = digit_add(counts, (keys[first + i] >> sort.shift) & (DIGITS - 1u));
        }
    }
#ifdef SUBGROUPS
    let parts = subgroups;
    for (var word = 0u; word < WORDS; word++) {
        let sum = subgroupAdd(digit_word(counts, word));
        if subgroup_lane == 0u {
            counts_of_parts[word * parts + subgroup] = sum;
        }
    }
    workgroupBarrier();
#else
    let parts = 32u;
    for (var word = 0u; word < WORDS; word++) {
        counts_of_parts[word * 256u + lane] = digit_word(counts, word);
    }
    workgroupBarrier();
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        sum += counts_of_parts[lane * 8u + i];
    }
    workgroupBarrier();
    counts_of_parts[lane] = sum;
    workgroupBarrier();
#endif
    if lane < DIGITS && block < sort.blocks {
        var total = 0u;
        for (var part = 0u; part < parts; part++) {
            total += counts_of_parts[(lane & 7u) * parts + part];
        }
        histogram[lane * sort.blocks + block] = (total >> (16u * (lane / 8u))) & 0xffffu;
    }
}
