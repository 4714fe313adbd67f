// Stage "update": one step of Adam on the listed rows of pages that lie on the device, and their statistics. `step_geometry` and
// `step_colors` rewrite columns of the rows whose gradients all are usable; `finish` counts, stamps and collects statistics. The twin of
// tests/numerics/twins/update.rs.
//
// `clear_statistics` takes the place of a round that edits no row.
//
// Values come from the stage "gather" at the same step. A workgroup works on one page. A row is rewritten as a whole or not at all.
// Nothing is written behind a closed gate (gate.wgsl).
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/deferred.wgsl"
#import "shared/page.wgsl"
#import "shared/quotient.wgsl"
#import "shared/splat.wgsl"
#import "shared/camera.wgsl"
#import "shared/sh.wgsl"

struct UpdateUniforms {
    /// The slab that is bound.
    slab: u32,
    /// Rows of the columns that are bound; pages, in `clear_statistics`.
    row_count: u32,
    /// In `step_geometry` the first of the two columns.
    column: u32,
    /// Steps done.
    now: u32,
    /// Half of the image size, pixels.
    half_size: vec2<f32>,
    /// 1 / sqrt(1 - beta2^t).
    inv_root_correction: f32,
    /// 1: this step collects statistics.
    collects: u32,
    /// Position of the camera in the world.
    centre: vec3<f32>,
    /// 1: blending weights are among the statistics, and a row has two footprints.
    weighs: u32,
    /// Rates of the columns over the bias of the first moment.
    step_sizes: array<vec4<f32>, 2>,
    /// Number, in the batch, of the first listed row that is bound.
    first_bound: u32,
    /// The turns of the pages of this dispatch, and the chunks of each page.
    first_turn: u32,
    end_turn: u32,
    chunks: u32,
}

@group(0) @binding(0) var<uniform> u: UpdateUniforms;
@group(0) @binding(1) var<storage, read> pages: array<DevicePage>;
@group(0) @binding(2) var<storage, read_write> slab: array<u32>;
@group(0) @binding(3) var<storage, read> tables: array<u32>;
/// At `first_row` of a page on: its listed rows.
@group(0) @binding(4) var<storage, read> found: array<u32>;
/// `[listed row]`: words of the records of shared/splat.wgsl. The last word of a record is the largest magnitude of a gradient.
@group(0) @binding(5) var<storage, read> v_splats: array<u32>;
/// One word: 0 while the gate is open.
@group(0) @binding(6) var<storage, read> gate: array<u32>;
/// Values and gradients of the first and of the second column.
@group(0) @binding(7) var<storage, read> values: array<f32>;
@group(0) @binding(8) var<storage, read> grads: array<f32>;
@group(0) @binding(9) var<storage, read> second_values: array<f32>;
@group(0) @binding(10) var<storage, read> second_grads: array<f32>;
/// Gradient of the projected mean, radii; where rows are weighed, each is followed by the weight and three words of no use here.
@group(0) @binding(11) var<storage, read> footprints: array<vec4<f32>>;
/// `[page]`: the words of a PageResult.
@group(0) @binding(12) var<storage, read_write> results: array<atomic<u32>>;
/// Change of the number of rows by bin of the mean growth score and, behind these where rows are weighed, of the mean blending weight;
/// modulo 2^32.
@group(0) @binding(13) var<storage, read_write> bins: array<atomic<u32>>;
@group(0) @binding(14) var<storage, read> splats: array<vec4<f32>>;
/// Values of columns.
@group(0) @binding(15) var<storage, read> sh0: array<f32>;
#ifdef SH_DEGREE_1
@group(0) @binding(16) var<storage, read> means: array<f32>;
@group(0) @binding(17) var<storage, read> sh_n: array<f32>;
#endif

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

/// What the moments of a row keep over the steps that it missed.
struct Decays {
    first: f32,
    kept: f32,
    lost: f32,
    /// Key of the draws that round moments to 16 bits.
    key: u32,
}

/// The finaliser of MurmurHash3.
fn mixed(x: u32) -> u32 {
    let a = (x ^ (x >> 16u)) * 0x85ebca6bu;
    let b = (a ^ (a >> 13u)) * 0xc2b2ae35u;
    return b ^ (b >> 16u);
}

fn decays_of(page: DevicePage, row: u32) -> Decays {
    let missed = u.now - slab[stamps_at(page) + row];
    let second = decay_at(missed + 1u) + 1u;
#ifdef HALF_MOMENTS
    let uid = page.base + 2u * row;
    let key = mixed(slab[uid] ^ mixed(slab[uid + 1u] ^ mixed(u.now + 1u)));
#else
    let key = 0u;
#endif
    return Decays(
        bitcast<f32>(tables[decay_at(missed)]),
        bitcast<f32>(tables[second]),
        bitcast<f32>(tables[second + 1u]),
        key,
    );
}

/// Number of the first float of a column in draws.
fn drawn_first(column: u32) -> u32 {
    return array<u32, 6>(0u, 3u, 7u, 10u, 11u, 14u)[column];
}

/// One step on float `e` of a column of a row, at word `at`; its moments follow after `words` and, with 32 bits, again `words` words.
fn step_float(column: u32, e: u32, at: u32, words: u32, d: Decays, value: f32, g: f32) {
    let m_at = at + words;
    let v_at = m_at + words;
#ifdef HALF_MOMENTS
    let old = moments_of(slab[m_at]);
#else
    let old = vec2<f32>(bitcast<f32>(slab[m_at]), bitcast<f32>(slab[v_at]));
#endif
    let decayed = flush(old.x * d.first);
    let m = flush(decayed + (g - decayed) * bitcast<f32>(tables[ONE_MINUS_BETA1]));
    let gained = g * g * bitcast<f32>(tables[ONE_MINUS_BETA2]);
    let v = max(flush(old.y * d.kept + (gained - old.y * d.lost)), 0.0);
    let root = sqrt(v) * u.inv_root_correction + bitcast<f32>(tables[EPS]);
    var moved = flush(value - u.step_sizes[column / 4u][column % 4u] * (m / root));
    if column == SCALES {
        moved = max(min(moved, bitcast<f32>(tables[LOG_SCALE_HIGH])), bitcast<f32>(tables[LOG_SCALE_LOW]));
    }
    slab[at] = bitcast<u32>(moved);
#ifdef HALF_MOMENTS
    // Rounded up with the probability of what is cut, as src/optim/moments.rs explains.
    let draw = mixed(d.key + (drawn_first(column) + e) * 0x9e3779b9u);
    slab[m_at] = ((bitcast<u32>(m) + (draw & 0xffffu)) & 0xffff0000u) | ((bitcast<u32>(v) + (draw >> 16u)) >> 16u);
#else
    slab[m_at] = bitcast<u32>(m);
    slab[v_at] = bitcast<u32>(v);
#endif
}

/// The chunk of a workgroup, of at most `size` rows.
fn chunk(workgroup: Group, size: u32) -> Chunk {
    let n = linear_group(workgroup);
    let turn = u.first_turn + n / u.chunks;
    if turn >= u.end_turn || gate[0] != 0u {
        return Chunk();
    }
    let p = pages[turn].page_from_turn;
    return chunk_of(pages[p], p, n % u.chunks, size, u.first_bound, u.row_count);
}

/// One workgroup for each chunk: its floats of two columns of the geometry.
@compute @workgroup_size(256)
fn step_geometry(workgroup: Group, place: Place) {
    let c = chunk(workgroup, CHUNK_ROWS);
    let page = pages[c.page];
    let widths = vec4<u32>(3u, column_width(u.column + 1u, 0u), 0u, 0u);
    for (var k = place.lane; k < (widths.x + widths.y) * c.rows; k += 256u) {
        let f = float_of(k, c.rows, u.column, widths);
        let i = f.at / f.width;
        if !is_usable(largest(c.at + i)) {
            continue;
        }
        let entry = f.width * c.at + f.at;
        var value: f32;
        var g: f32;
        if f.column == u.column {
            value = values[entry];
            g = grads[entry];
        } else {
            value = second_values[entry];
            g = second_grads[entry];
        }
        let row = found[page.first_row + c.first + i];
        let e = f.at - i * f.width;
        let at = column_at(page, f.column) + row * f.width + e;
        step_float(f.column, e, at, table_words(page, f.column), decays_of(page, row), value, g);
    }
}

/// Basis functions, and floats of a row.
#ifdef SH_DEGREE_1
const BASIS: u32 = 1u + SH_WIDTH / 3u;
#else
const BASIS: u32 = 1u;
#endif
const COLOR_FLOATS: u32 = 3u * BASIS;

/// What the floats of a row share.
struct ColorRow {
    /// First word of sh0 and of the higher bands, and words of their tables; the last is 0 for a row that is not updated.
    sh_n_at: u32,
    sh_n_words: u32,
    sh0_at: u32,
    sh0_words: u32,
    decays: Decays,
    /// Gradient of the colour.
    v: vec3<f32>,
}

var<workgroup> color_rows: array<ColorRow, CHUNK_ROWS>;
var<workgroup> bases: array<f32, CHUNK_ROWS * BASIS>;

/// Finds what the floats of a row of the chunk share.
fn share_color(c: Chunk, own: u32) {
    color_rows[own].sh0_words = 0u;
    let i = c.at + own;
    if own >= c.rows || !is_usable(largest(i)) {
        return;
    }
    let page = pages[c.page];
    let row = found[page.first_row + c.first + own];
    let at = 4u * SPLAT_STRIDE * i + 8u;
    let v = vec3<f32>(bitcast<f32>(v_splats[at]), bitcast<f32>(v_splats[at + 1u]), bitcast<f32>(v_splats[at + 2u]));
    color_rows[own] = ColorRow(
        column_at(page, SH_N) + row * page.sh_n_width,
        table_words(page, SH_N),
        column_at(page, SH0) + row * 3u,
        table_words(page, SH0),
        decays_of(page, row),
        // A channel clamped at 0 passes no gradient.
        select(vec3<f32>(), v, splats[SPLAT_STRIDE * i + 2u].xyz > vec3<f32>()),
    );
    bases[BASIS * own] = SH_C0;
#ifdef SH_DEGREE_1
    let dir = viewing_direction(u.centre, vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u])).unit;
    let basis1 = sh_band1(dir);
#repeat K 0u 1u 2u
    bases[BASIS * own + 1u + K] = basis1[K];
#end
#ifdef SH_DEGREE_2
    let basis2 = sh_band2(dir);
#repeat K 0u 1u 2u 3u 4u
    bases[BASIS * own + 4u + K] = basis2[K];
#end
#ifdef SH_DEGREE_3
    let basis3 = sh_band3(dir);
#repeat K 0u 1u 2u 3u 4u 5u 6u
    bases[BASIS * own + 9u + K] = basis3[K];
#end
#endif
#endif
#endif
}

/// One workgroup for each chunk. Makes the gradients of the coefficients, as sh_bwd does where the host wants them, and takes the step
/// at once: the gradients, four fifths of a row's, are never stored. A compiler may order the products of a basis function otherwise
/// than in sh_bwd, which moves the last bit of a gradient (Mesa does for one of the sixteen), never whether a row is updated: that is
/// judged by what sh_bwd found.
@compute @workgroup_size(256)
fn step_colors(workgroup: Group, place: Place) {
    let c = chunk(workgroup, CHUNK_ROWS);
    if place.lane < CHUNK_ROWS {
        share_color(c, place.lane);
    }
    workgroupBarrier();
    for (var k = place.lane; k < c.rows * COLOR_FLOATS; k += 256u) {
        let own = k / COLOR_FLOATS;
        let e = k % COLOR_FLOATS;
        let row = color_rows[own];
        if row.sh0_words == 0u {
            continue;
        }
        let g = bases[BASIS * own + e / 3u] * row.v[e % 3u];
#ifdef SH_DEGREE_1
        if e >= 3u {
            let value = sh_n[SH_WIDTH * (c.at + own) + e - 3u];
            step_float(SH_N, e - 3u, row.sh_n_at + e - 3u, row.sh_n_words, row.decays, value, g);
            continue;
        }
#endif
        step_float(SH0, e, row.sh0_at + e, row.sh0_words, row.decays, sh0[3u * (c.at + own) + e], g);
    }
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

/// One workgroup for each chunk, an invocation for each of its rows; after all columns.
@compute @workgroup_size(256)
fn finish(workgroup: Group, place: Place) {
    let c = chunk(workgroup, 256u);
    if place.lane >= c.rows {
        return;
    }
    let page = pages[c.page];
    let row = found[page.first_row + c.first + place.lane];
    let i = c.at + place.lane;
    let most = largest(i);
    if is_usable(most) {
        slab[stamps_at(page) + row] = u.now + 1u;
        atomicAdd(&results[RESULT_WORDS * c.page + UPDATED], 1u);
    } else if most != 0u {
        atomicAdd(&results[RESULT_WORDS * c.page + SKIPPED], 1u);
    }
    let of_row = select(1u, 2u, u.weighs != 0u);
    let footprint = footprints[of_row * i];
    if footprint.z > 0.0 && footprint.w > 0.0 {
        atomicAdd(&results[RESULT_WORDS * c.page + DRAWN], 1u);
        if u.collects != 0u {
            collect(page, c.page, row, footprint, footprints[of_row * i + of_row - 1u].x);
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
