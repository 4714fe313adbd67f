// One pass of a stable sort of 32-bit keys with 32-bit values, by a digit of 8 bits of the key: radix_histogram counts the digits of every
// block of 1024 keys, scan.wgsl turns the counts into places, and in radix_sort every block sorts its keys in workgroup memory, by one
// half of the digit and then by the other, and moves them to its places, keys of a digit side by side. Used twice: for rows by the bits of their depth (the
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
/// Number of keys of each digit, with which the scan of the histogram begins; zero before radix_histogram.
@group(0) @binding(9) var<storage, read_write> totals: array<atomic<u32>>;

/// Keys per invocation; they are adjacent, so that the order within a block is that of the invocations.
const KEYS: u32 = 8u;
const LANES: u32 = 128u;
const BLOCK_KEYS: u32 = 1024u;
const DIGITS: u32 = 256u;
/// Words with an invocation's counts: halves of digits w and w + 8 in the halves of word w.
const WORDS: u32 = 8u;

/// Number of keys of each half of a digit in one invocation, 4 bits each (a count of 8 fits): digits 0 to 7, then 8 to 15.
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
const WORD_STRIDE: u32 = 144u;
/// [words][invocations]: counts, then counts of the invocations before.
var<workgroup> counts_before: array<u32, 1152>;
/// [words][parts]
var<workgroup> part_counts: array<u32, 256>;
/// By half of a digit: keys of the block, then those with a lower one.
var<workgroup> half_counts: array<u32, 16>;
var<workgroup> half_first: array<u32, 16>;
/// Keys and values of the block, in their order so far.
var<workgroup> block_keys: array<u32, BLOCK_KEYS>;
var<workgroup> block_values: array<u32, BLOCK_KEYS>;
/// Place in the block of the first key of each digit.
var<workgroup> digit_first: array<u32, DIGITS>;
var<workgroup> digit_counts: array<atomic<u32>, DIGITS>;

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

/// Number of keys of a block.
fn keys_of(block: u32) -> u32 {
    let count = min(live[sort.live_at], sort.capacity);
    return min(count - min(count, block * BLOCK_KEYS), BLOCK_KEYS);
}

fn digit_of(key: u32) -> u32 {
    return (key >> sort.shift) & (DIGITS - 1u);
}

/// First half of a pass: fills the histogram.
@compute @workgroup_size(128)
fn radix_histogram(workgroup: Group, place: Place) {
    let block = linear_group(workgroup);
    let size = keys_of(block);
    for (var digit = place.lane; digit < DIGITS; digit += LANES) {
        atomicStore(&digit_counts[digit], 0u);
    }
    workgroupBarrier();
    for (var i = place.lane; i < size; i += LANES) {
        atomicAdd(&digit_counts[digit_of(keys[block * BLOCK_KEYS + i])], 1u);
    }
    workgroupBarrier();
    for (var digit = place.lane; digit < DIGITS && block < sort.blocks; digit += LANES) {
        let count = atomicLoad(&digit_counts[digit]);
        histogram[digit * sort.blocks + block] = count;
        if count > 0u {
            atomicAdd(&totals[digit], count);
        }
    }
}

/// Sorts the keys of the block, of which there are `size`, by the 4 bits from `shift` on.
fn sort_block(place: SubgroupPlace, size: u32, shift: u32) {
    let first = place.lane * KEYS;
    var key: array<u32, KEYS>;
    var value: array<u32, KEYS>;
    /// Number of earlier keys of the same half digit in this invocation.
    var rank: array<u32, KEYS>;
    var counts = DigitCounts(0u, 0u);
    for (var i = 0u; i < KEYS; i++) {
        if first + i < size {
            key[i] = block_keys[first + i];
            value[i] = block_values[first + i];
            let half = (key[i] >> shift) & 15u;
            rank[i] = digit_count(counts, half);
            counts = digit_add(counts, half);
        }
    }
#ifdef SUBGROUPS
    let parts = subgroups_of(place, LANES);
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
    // 16 parts of 8 invocations per word: each invocation processes one part of one word.
    let parts = 16u;
    let word = place.lane / parts;
    let part = place.lane % parts;
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
        base += part_counts[word * parts + p];
    }
    for (var i = 0u; i < 8u; i++) {
        counts_before[counts_at(word, 8u * part + i)] += base;
    }
#endif
    if place.lane < 16u {
        var total = 0u;
        for (var part = 0u; part < parts; part++) {
            total += part_counts[(place.lane & 7u) * parts + part];
        }
        half_counts[place.lane] = (total >> (16u * (place.lane / 8u))) & 0xffffu;
    }
    workgroupBarrier();
    if place.lane < 16u {
        var before = 0u;
        for (var half = 0u; half < place.lane; half++) {
            before += half_counts[half];
        }
        half_first[place.lane] = before;
    }
    workgroupBarrier();
    for (var i = 0u; i < KEYS; i++) {
        if first + i < size {
            let half = (key[i] >> shift) & 15u;
            let pair = counts_before[counts_at(half & 7u, place.lane)];
            let to = half_first[half] + ((pair >> (16u * (half / 8u))) & 0xffffu) + rank[i];
            block_keys[to] = key[i];
            block_values[to] = value[i];
        }
    }
    workgroupBarrier();
}

/// Second half of a pass, after the scan of the histogram: moves keys and values.
@compute @workgroup_size(128)
fn radix_sort(workgroup: Group, place: SubgroupPlace) {
    let block = linear_group(workgroup);
    let size = keys_of(block);
    for (var i = place.lane; i < size; i += LANES) {
        block_keys[i] = keys[block * BLOCK_KEYS + i];
        block_values[i] = values[block * BLOCK_KEYS + i];
    }
    workgroupBarrier();
    sort_block(place, size, sort.shift);
    sort_block(place, size, sort.shift + 4u);
    for (var i = place.lane; i < size; i += LANES) {
        let digit = digit_of(block_keys[i]);
        if i == 0u || digit_of(block_keys[max(i, 1u) - 1u]) != digit {
            digit_first[digit] = i;
        }
    }
    workgroupBarrier();
    for (var i = place.lane; i < size; i += LANES) {
        let key = block_keys[i];
        let digit = digit_of(key);
        let to = places[digit * sort.blocks + block] + i - digit_first[digit];
        keys_out[to] = key;
        values_out[to] = block_values[i];
    }
}
