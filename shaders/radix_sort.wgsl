// One pass of a stable sort of 32-bit keys with 32-bit values by 4 bits of the key: every block of 2048 keys moves its
// keys to the places that the scanned histogram keeps for it. On a device this serves twice: rows by the bits of their
// depth (the twin of src/kernels/radix_sort.rs), and intersections by tile.
//
// No workgroup waits for another, and which order workgroups run in cannot change a place.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/radix.wgsl"

@group(0) @binding(0) var<uniform> sort: SortUniforms;
@group(0) @binding(1) var<storage, read> live: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
/// [digits][blocks]: exclusive prefix sum of the histogram.
@group(0) @binding(4) var<storage, read> places: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

/// Invocations of a word stand side by side with one word of padding after every 8, against bank conflicts.
const WORD_STRIDE: u32 = 288u;
/// [words][invocations]: counts, then counts of the invocations before.
var<workgroup> counts_before: array<u32, 2304>;
/// [words][parts]
var<workgroup> part_counts: array<u32, 512>;
/// Where this block's keys of each digit begin.
var<workgroup> block_places: array<u32, 16>;

fn counts_at(word: u32, lane: u32) -> u32 {
    return word * WORD_STRIDE + lane + lane / 8u;
}

@compute @workgroup_size(256)
fn radix_sort(
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
    if lane < DIGITS && block < sort.blocks {
        block_places[lane] = places[lane * sort.blocks + block];
    }
    var counts = DigitCounts(0u, 0u);
    var key: array<u32, KEYS>;
    /// Keys of the same digit that the invocation has before this one.
    var rank: array<u32, KEYS>;
    for (var i = 0u; i < KEYS; i++) {
        if first + i < count {
            key[i] = keys[first + i];
            let digit = (key[i] >> sort.shift) & (DIGITS - 1u);
            rank[i] = digit_count(counts, digit);
            counts = digit_add(counts, digit);
        }
    }
#ifdef SUBGROUPS
    for (var word = 0u; word < WORDS; word++) {
        let mine = digit_word(counts, word);
        let before = subgroupExclusiveAdd(mine);
        let sum = subgroupAdd(mine);
        counts_before[counts_at(word, lane)] = before;
        if subgroup_lane == 0u {
            part_counts[word * subgroups + subgroup] = sum;
        }
    }
    workgroupBarrier();
    for (var word = 0u; word < WORDS; word++) {
        var base = 0u;
        for (var part = 0u; part < subgroup; part++) {
            base += part_counts[word * subgroups + part];
        }
        // An invocation's own entry.
        counts_before[counts_at(word, lane)] += base;
    }
#else
    for (var word = 0u; word < WORDS; word++) {
        counts_before[counts_at(word, lane)] = digit_word(counts, word);
    }
    workgroupBarrier();
    // 32 parts of 8 invocations to a word: each invocation takes one part of one word.
    let word = lane / 32u;
    let part = lane % 32u;
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        let at = counts_at(word, 8u * part + i);
        let mine = counts_before[at];
        counts_before[at] = sum;
        sum += mine;
    }
    part_counts[lane] = sum;
    workgroupBarrier();
    var base = 0u;
    for (var p = 0u; p < part; p++) {
        base += part_counts[word * 32u + p];
    }
    for (var i = 0u; i < 8u; i++) {
        counts_before[counts_at(word, 8u * part + i)] += base;
    }
    workgroupBarrier();
#endif
    for (var i = 0u; i < KEYS; i++) {
        if first + i < count {
            let digit = (key[i] >> sort.shift) & (DIGITS - 1u);
            let pair = counts_before[counts_at(digit & 7u, lane)];
            let place = block_places[digit] + ((pair >> (16u * (digit / 8u))) & 0xffffu) + rank[i];
            keys_out[place] = key[i];
            values_out[place] = values[first + i];
        }
    }
}
