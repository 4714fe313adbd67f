// Stage "update": one step of Adam on the listed rows of pages that lie on the device, and their statistics. `step` rewrites a
// column of the rows whose gradients all are usable; `finish` counts, stamps and collects statistics. The twin of
// tests/numerics/twins/update.rs.
//
// `clear_statistics` takes the place of a round that edits no row.
//
// Values come from the stage "gather" at the same step. A row is rewritten as a whole or not at all. Nothing is written behind a
// closed gate (gate.wgsl).
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/deferred.wgsl"
#import "shared/page.wgsl"
#import "shared/quotient.wgsl"
#import "shared/splat.wgsl"

struct UpdateUniforms {
    /// The slab that is bound.
    slab: u32,
    /// Listed rows of this dispatch; pages, in `clear_statistics`.
    row_count: u32,
    /// Column to rewrite, and floats per row of its values and gradients.
    column: u32,
    width: u32,
    /// Steps done.
    now: u32,
    /// Rate of the column over the bias of the first moment.
    step_size: f32,
    /// Half of the image size, pixels.
    half_size: vec2<f32>,
    /// 1 / sqrt(1 - beta2^t).
    inv_root_correction: f32,
    /// 1: this step collects statistics.
    collects: u32,
    /// 1: blending weights are among them, and a row has two footprints.
    weighs: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> u: UpdateUniforms;
@group(0) @binding(1) var<storage, read> pages: array<DevicePage>;
@group(0) @binding(2) var<storage, read_write> slab: array<u32>;
@group(0) @binding(3) var<storage, read> tables: array<u32>;
/// Number of the page, or UNLISTED, and number of the row in it.
@group(0) @binding(4) var<storage, read> rows: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> values: array<f32>;
/// Gradients of a column.
@group(0) @binding(6) var<storage, read> grads: array<f32>;
/// `[listed row]`: the records of shared/splat.wgsl, of which the last word is read: the largest magnitude of a gradient.
@group(0) @binding(7) var<storage, read> v_splats: array<u32>;
/// Gradient of the projected mean, radii; where rows are weighed, each is followed by the weight and three words of no use here.
@group(0) @binding(8) var<storage, read> footprints: array<vec4<f32>>;
/// `[page]`: the words of a PageResult.
@group(0) @binding(9) var<storage, read_write> results: array<atomic<u32>>;
/// Change of the number of rows by bin of the mean growth score and, behind these where rows are weighed, of the mean blending weight;
/// modulo 2^32.
@group(0) @binding(10) var<storage, read_write> bins: array<atomic<u32>>;
/// One word: 0 while the gate is open.
@group(0) @binding(11) var<storage, read> gate: array<u32>;

/// Bits of 1e18, the largest usable gradient (src/base/math.rs).
const LARGEST_GRAD: u32 = 0x5d5e0b6bu;
const RESULT_WORDS: u32 = 12u;
/// Words of a PageResult.
const UPDATED: u32 = 0u;
const SKIPPED: u32 = 1u;
const DRAWN: u32 = 2u;
const COLLECTED: u32 = 3u;
/// Bins of scores; those of weights follow.
const BINS: u32 = 32768u;
/// Least and greatest weight, as in src/scene/sightings.rs.
const WEIGHT_LEAST: f32 = 1e-30;
const WEIGHT_MOST: f32 = 1e30;

/// Bits of the largest magnitude of a gradient of a listed row.
fn largest(i: u32) -> u32 {
    return v_splats[4u * SPLAT_STRIDE * i + 11u];
}

/// Without signs, floats are ordered as integers, with those that are not finite after all others.
fn is_usable(bits: u32) -> bool {
    return bits != 0u && bits <= LARGEST_GRAD;
}

/// First word of the decay over some steps: factor of the first moment, factor of the second, share that it loses.
fn decay_at(steps: u32) -> u32 {
    return tables[DECAYS] + 3u * min(steps, tables[DECAYS_LENGTH] - 1u);
}

/// One invocation for each float of the column.
@compute @workgroup_size(256)
fn step(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
    if i >= u.row_count * u.width || gate[0] != 0u {
        return;
    }
    let row = i / u.width;
    let listed = rows[row];
    if listed.x == UNLISTED {
        return;
    }
    let page = pages[listed.x];
    if page.slab != u.slab || !is_usable(largest(row)) {
        return;
    }
    let at = listed.y * column_width(u.column, page.sh_n_width) + i - row * u.width;
    let value_at = column_at(page, u.column) + at;
    let m_at = value_at + table_words(page, u.column);
    let v_at = m_at + table_words(page, u.column);
    let missed = u.now - slab[stamps_at(page) + listed.y];
    let first = bitcast<f32>(tables[decay_at(missed)]);
    let second = decay_at(missed + 1u) + 1u;
    let kept = bitcast<f32>(tables[second]);
    let lost = bitcast<f32>(tables[second + 1u]);
    let g = grads[i];
    let decayed = flush(bitcast<f32>(slab[m_at]) * first);
    let m = flush(decayed + (g - decayed) * bitcast<f32>(tables[ONE_MINUS_BETA1]));
    let gained = g * g * bitcast<f32>(tables[ONE_MINUS_BETA2]);
    let old_v = bitcast<f32>(slab[v_at]);
    let v = max(flush(old_v * kept + (gained - old_v * lost)), 0.0);
    let root = sqrt(v) * u.inv_root_correction + bitcast<f32>(tables[EPS]);
    var value = flush(values[i] - u.step_size * (m / root));
    if u.column == SCALES {
        value = max(min(value, bitcast<f32>(tables[LOG_SCALE_HIGH])), bitcast<f32>(tables[LOG_SCALE_LOW]));
    }
    slab[value_at] = bitcast<u32>(value);
    slab[m_at] = bitcast<u32>(m);
    slab[v_at] = bitcast<u32>(v);
}

/// Bin of a mean growth score, as in src/densify/stats.rs.
fn bin(sum: f32, count: u32) -> u32 {
    return bitcast<u32>(quotient(sum, max(count & VIEWS_MOST, 1u))) >> 16u;
}

/// The word of sightings after one more view, weighed or not, as in src/scene/sightings.rs. A weight that is NaN counts as the least.
fn with_view(word: u32, weight: f32) -> u32 {
    if u.weighs == 0u {
        return word + 1u;
    }
    let bits = bitcast<u32>(weight);
    let limited = clamp(weight, WEIGHT_LEAST, WEIGHT_MOST);
    let added = select(limited, select(WEIGHT_LEAST, WEIGHT_MOST, bits == 0x7f800000u), !is_finite(weight));
    let sum = min(weight_sum(word) + added, WEIGHT_MOST);
    return (((bitcast<u32>(sum) + (1u << (DROPPED_BITS - 1u))) >> DROPPED_BITS) << VIEWS_BITS) | ((word & VIEWS_MOST) + 1u);
}

/// Changes the number of rows in the bin of a mean weight, if enough views have weighed the row.
fn count_weight(word: u32, change: u32) {
    if is_weighed(word) {
        atomicAdd(&bins[BINS + (bitcast<u32>(mean_weight(word)) >> 16u)], change);
    }
}

/// Adds a growth score and a weight to the statistics of a row, unless the score is not finite or the row counts no more views.
fn collect(page: DevicePage, p: u32, row: u32, footprint: vec4<f32>, weight: f32) {
    let scaled = footprint.xy * u.half_size;
    let score = sqrt(scaled.x * scaled.x + scaled.y * scaled.y);
    let sum_at = grad2d_at(page) + row;
    let views_at = count_at(page) + row;
    let count = slab[views_at];
    if !is_finite(score) || (count & VIEWS_MOST) == VIEWS_MOST {
        return;
    }
    let sum = bitcast<f32>(slab[sum_at]);
    // A sum that overflows stays the largest number, for which compilers take no decimal literal.
    let added = select(sum + score, bitcast<f32>(INFINITY_BITS - 1u), !is_finite(sum + score));
    if count > 0u {
        atomicSub(&bins[bin(sum, count)], 1u);
    }
    let word = with_view(count, weight);
    slab[sum_at] = bitcast<u32>(added);
    slab[views_at] = word;
    atomicAdd(&bins[bin(added, word)], 1u);
    if u.weighs != 0u {
        count_weight(count, 0xffffffffu);
        count_weight(word, 1u);
    }
    atomicAdd(&results[RESULT_WORDS * p + COLLECTED], 1u);
}

/// One invocation for each row; after all columns.
@compute @workgroup_size(256)
fn finish(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
    if i >= u.row_count || gate[0] != 0u {
        return;
    }
    let listed = rows[i];
    if listed.x == UNLISTED {
        return;
    }
    let page = pages[listed.x];
    if page.slab != u.slab {
        return;
    }
    let most = largest(i);
    if is_usable(most) {
        slab[stamps_at(page) + listed.y] = u.now + 1u;
        atomicAdd(&results[RESULT_WORDS * listed.x + UPDATED], 1u);
    } else if most != 0u {
        atomicAdd(&results[RESULT_WORDS * listed.x + SKIPPED], 1u);
    }
    let of_row = select(1u, 2u, u.weighs != 0u);
    let footprint = footprints[of_row * i];
    if footprint.z > 0.0 && footprint.w > 0.0 {
        atomicAdd(&results[RESULT_WORDS * listed.x + DRAWN], 1u);
        if u.collects != 0u {
            collect(page, listed.x, listed.y, footprint, footprints[of_row * i + of_row - 1u].x);
        }
    }
}

/// One workgroup for each page.
@compute @workgroup_size(256)
fn clear_statistics(workgroup: Group, place: Place) {
    let p = linear_group(workgroup);
    if p >= u.row_count || pages[p].slab != u.slab {
        return;
    }
    let page = pages[p];
    for (var row = place.lane; row < page.rows; row += 256u) {
        slab[grad2d_at(page) + row] = 0u;
        slab[count_at(page) + row] = 0u;
    }
}
