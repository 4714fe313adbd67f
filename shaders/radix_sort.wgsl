// One pass of a stable sort of 32-bit keys with 32-bit values, by 4 bits of the key: every block of 2048 keys moves its
// keys to the places that the scanned histogram reserves for it. Used twice: for rows by the bits of their depth (the
// twin of src/kernels/radix_sort.rs), and for intersections by tile.
//
// No workgroup waits for another, and the execution order of workgroups cannot change a place.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/subgroups.wgsl"
#import "shared/splat.wgsl"

struct SortUniforms {
    /// The number of keys is live[live_at], limited to this.
    capacity: u32,
    live_at: u32,
    /// Number of blocks in the histogram.
    blocks: u32,
    /// Lowest bit of this pass's digit.
    shift: u32,
}

@group(0) @binding(0) var<uniform> sort: SortUniforms;
@group(0) @binding(1) var<storage, read> live: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
/// [digits][blocks]: exclusive prefix sum of the histogram.
@group(0) @binding(4) var<storage, read> places: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;
/// [digits][blocks]: number of keys of each digit in every block; every entry is written, even for blocks without keys.
@group(0) @binding(7) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(8) var<storage, read> splats: array<vec4<f32>>;

/// Keys per invocation; they are adjacent, so that the order within a block is that of the invocations.
const KEYS: u32 = 8u;
const BLOCK_KEYS: u32 = 2048u;
const DIGITS: u32 = 16u;
/// Words with an invocation's counts: digits w and w + 8 in the halves of word w.
const WORDS: u32 = 8u;

/// Number of keys of each digit in one invocation, 4 bits each (a count of 8 fits): digits 0 to 7, then 8 to 15.
struct DigitCounts {
    low: u32,
    high: u32,
}

fn digit_count(counts: DigitCounts, digit: u32) -> u32 {
    return (select(counts.high, counts.low, digit < 8u) >> (4u * (digit & 7u))) & 15u;
}

fn digit_add(counts: DigitCounts, digit: u32) -> DigitCounts {
    let one = 1u << (4u * (digit & 7u));
    return DigitCounts(
        counts.low + select(0u, one, digit < 8u),
        counts.high + select(one, 0u, digit < 8u),
    );
}

/// Counts of digits `word` and `word` + 8.
fn digit_word(counts: DigitCounts, word: u32) -> u32 {
    return ((counts.low >> (4u * word)) & 15u) | (((counts.high >> (4u * word)) & 15u) << 16u);
}

/// The invocations' entries of a word are adjacent, with one word of padding after every 8, against bank conflicts.
const WORD_STRIDE: u32 = 288u;
/// [words][invocations]: counts, then counts of the invocations before.
var<workgroup> counts_before: array<u32, 2304>;
/// [words][parts]
var<workgroup> part_counts: array<u32, 512>;
/// First place of this block's keys of each digit.
var<workgroup> block_places: array<u32, 16>;

fn counts_at(word: u32, lane: u32) -> u32 {
    return word * WORD_STRIDE + lane + lane / 8u;
}

/// Keys and values of the sort by depth: the bits of a drawn row's depth (positive, so they sort like the depths) and
/// the row. Rows that are not drawn come last. The capacity is the number of rows.
@compute @workgroup_size(256)
fn depth_keys(workgroup: Group, place: Place) {
    let row = linear_index(workgroup, place, 256u);
    if row >= sort.capacity {
        return;
    }
    let radius_x = splats[SPLAT_STRIDE * row + 1u].w;
    keys_out[row] = select(0xffffffffu, bitcast<u32>(splats[SPLAT_STRIDE * row].z), radius_x > 0.0);
    values_out[row] = row;
}

/// [words][parts]: counts of runs of invocations.
var<workgroup> counts_of_parts: array<u32, 2048>;

/// First half of a pass: fills the histogram.
@compute @workgroup_size(256)
fn radix_histogram(workgroup: Group, place: SubgroupPlace) {
    let block = linear_group(workgroup);
    let count = min(live[sort.live_at], sort.capacity);
    let first = block * BLOCK_KEYS + place.lane * KEYS;
    var counts = DigitCounts(0u, 0u);
    for (var i = 0u; i < KEYS; i++) {
        if first + i < count {
            counts = digit_add(counts, (keys[first + i] >> sort.shift) & (DIGITS - 1u));
        }
    }
#ifdef SUBGROUPS
    let parts = subgroups_of(place, 256u);
    for (var word = 0u; word < WORDS; word++) {
        let sum = subgroup_scan_u32(digit_word(counts, word), place.lane).y;
        if subgroup_lane_of(place) == 0u {
            counts_of_parts[word * parts + subgroup_of(place)] = sum;
        }
    }
    workgroupBarrier();
#else
    let parts = 32u;
    for (var word = 0u; word < WORDS; word++) {
        counts_of_parts[word * 256u + place.lane] = digit_word(counts, word);
    }
    workgroupBarrier();
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        sum += counts_of_parts[place.lane * 8u + i];
    }
    workgroupBarrier();
    counts_of_parts[place.lane] = sum;
    workgroupBarrier();
#endif
    if place.lane < DIGITS && block < sort.blocks {
        var total = 0u;
        for (var part = 0u; part < parts; part++) {
            total += counts_of_parts[(place.lane & 7u) * parts + part];
        }
        histogram[place.lane * sort.blocks + block] = (total >> (16u * (place.lane / 8u))) & 0xffffu;
    }
}

/// Second half of a pass, after the scan of the histogram: moves keys and values.
@compute @workgroup_size(256)
fn radix_sort(workgroup: Group, place: SubgroupPlace) {
    let block = linear_group(workgroup);
    let count = min(live[sort.live_at], sort.capacity);
    let first = block * BLOCK_KEYS + place.lane * KEYS;
    if place.lane < DIGITS && block < sort.blocks {
        block_places[place.lane] = places[place.lane * sort.blocks + block];
    }
    var counts = DigitCounts(0u, 0u);
    var key: array<u32, KEYS>;
    /// Number of earlier keys of the same digit in this invocation.
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
    let parts = subgroups_of(place, 256u);
    for (var word = 0u; word < WORDS; word++) {
        let sums = subgroup_scan_u32(digit_word(counts, word), place.lane);
        counts_before[counts_at(word, place.lane)] = sums.x;
        if subgroup_lane_of(place) == 0u {
            part_counts[word * parts + subgroup_of(place)] = sums.y;
        }
    }
    workgroupBarrier();
    for (var word = 0u; word < WORDS; word++) {
        var base = 0u;
        for (var part = 0u; part < subgroup_of(place); part++) {
            base += part_counts[word * parts + part];
        }
        // An invocation's own entry.
        counts_before[counts_at(word, place.lane)] += base;
    }
#else
    for (var word = 0u; word < WORDS; word++) {
        counts_before[counts_at(word, place.lane)] = digit_word(counts, word);
    }
    workgroupBarrier();
    // 32 parts of 8 invocations per word: each invocation processes one part of one word.
    let word = place.lane / 32u;
    let part = place.lane % 32u;
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        let at = counts_at(word, 8u * part + i);
        let mine = counts_before[at];
        counts_before[at] = sum;
        sum += mine;
    }
    part_counts[place.lane] = sum;
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
            let pair = counts_before[counts_at(digit & 7u, place.lane)];
            let to = block_places[digit] + ((pair >> (16u * (digit / 8u))) & 0xffffu) + rank[i];
            keys_out[to] = key[i];
            values_out[to] = values[first + i];
        }
    }
}
