// Stage "gather": the rows of pages that lie on the device, as they are now. `cull` lists the rows of each page that the
// camera may draw, `gather_geometry` and `gather_colors` evaluate the columns of the listed rows, page after page,
// and `bounds` finds the bounds of a page after its update. `survey` computes the largest mean score, the lowest opacity
// and the least mean weight of a page, from which the host decides whether a round edits rows. Where the host does not wait for the
// numbers of rows, `place` finds where the rows of each page begin, and the room behind the last row is filled with entries that no
// stage draws. The twin of tests/numerics/twins/gather.rs.
//
// A payload lies in one slab, and a dispatch works on the pages of one slab; a workgroup works on one page. Everything that evaluates a
// row is in this file, so that one compiled formula decides what is seen, drawn, updated and bounded.
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/deferred.wgsl"
#import "shared/page.wgsl"
#import "shared/quotient.wgsl"
#import "shared/workgroup_scan.wgsl"

struct GatherUniforms {
    /// The half-spaces of the camera (src/scene/frustum.rs): rows of the pose, slopes, offsets, reaches, depths.
    world_to_camera: array<vec4<f32>, 3>,
    slopes: vec4<f32>,
    offsets: vec4<f32>,
    reach: vec2<f32>,
    depth_range: vec2<f32>,
    /// Rounding slack of a camera coordinate: a constant part, and a factor on |x| + |y| + |z|.
    slack: vec2<f32>,
    /// Factor on the slack for the side planes.
    side_slack: f32,
    /// Steps done.
    now: u32,
    /// The slab that is bound.
    slab: u32,
    page_count: u32,
    /// Rows of the columns that are bound.
    row_count: u32,
    /// Floats per row of the higher SH bands of the output.
    sh_n_width: u32,
    /// Base rates of the columns.
    rates: array<vec4<f32>, 2>,
    /// Limits within which rows may split.
    grow_grad2d: f32,
    split_scale: f32,
    split_reach: f32,
    /// Number, in the batch, of the first listed row that is bound.
    first_bound: u32,
    /// The turns of the pages of this dispatch, and the chunks of each page.
    first_turn: u32,
    end_turn: u32,
    chunks: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> u: GatherUniforms;
@group(0) @binding(1) var<storage, read> pages: array<DevicePage>;
@group(0) @binding(2) var<storage, read> slab: array<u32>;
@group(0) @binding(3) var<storage, read> tables: array<u32>;
/// `[missed steps]`: sums of this step.
@group(0) @binding(4) var<storage, read> recent: array<f32>;
/// `[page]`: rows that the camera may draw; behind them their sum, after `place`.
@group(0) @binding(5) var<storage, read_write> counts: array<u32>;
/// At `first_row` of a page on: the rows that the camera may draw, ascending.
@group(0) @binding(6) var<storage, read_write> found: array<u32>;
/// Columns of the listed rows.
@group(0) @binding(7) var<storage, read_write> means: array<f32>;
@group(0) @binding(8) var<storage, read_write> quats: array<f32>;
@group(0) @binding(9) var<storage, read_write> scales: array<f32>;
@group(0) @binding(10) var<storage, read_write> opacities: array<f32>;
@group(0) @binding(11) var<storage, read_write> sh0: array<f32>;
@group(0) @binding(12) var<storage, read_write> sh_n: array<f32>;
@group(0) @binding(13) var<storage, read_write> results: array<PageResult>;
/// The pages, for `place`.
@group(0) @binding(14) var<storage, read_write> placed: array<DevicePage>;
@group(0) @binding(15) var<storage, read_write> surveys: array<PageSurvey>;

/// Relative slack of a movement, slack of a value and of a flushed value, as in src/optim/bounds.rs. The slack of values
/// is twice the CPU's, for devices that divide and take roots less exactly.
#ifdef HALF_MOMENTS
const MOVEMENT_SLACK: f32 = 2e-2;
#else
const MOVEMENT_SLACK: f32 = 1e-3;
#endif
const VALUE_SLACK: f32 = 16.0 * 5.9604645e-8;
const FLUSH_SLACK: f32 = 2.3509887e-38;
const SIGMA_SLACK: f32 = 4e-6;
const SIGMA_MOST: f32 = 1e30;
const REACH_SLACK: f32 = 1.0001;
const EPSILON: f32 = 1.1920929e-7;
/// Quotients of smaller sums are not exact: a mean score above 0 counts as at least this one.
const SMALLEST_MEAN: f32 = 1e-30;
/// Number of the page of entries without a row.
const NO_PAGE: u32 = 0xffffffffu;
/// Opacity, before activation, of entries without a row.
const HIDDEN_LOGIT: f32 = -100.0;

var<workgroup> parts: array<array<f32, 256>, 7>;

fn number(place: u32) -> f32 {
    return bitcast<f32>(tables[place]);
}

/// The movement at unit base rate, term by term, smallest terms first.
fn direct_sum(m: f32, v: f32, stamp: u32, end: u32, of_means: bool) -> f32 {
    let root = sqrt(v);
    let terms = min(end - stamp, tables[DIRECT_TERMS]);
    let bias = tables[BIAS];
    let bias_last = tables[BIAS_LENGTH] - 1u;
    let factors = tables[RATE_FACTORS] + select(1u, 0u, of_means);
    let factors_last = tables[RATE_FACTORS_LENGTH] - 1u;
    var sum = 0.0;
    for (var left = terms; left > 0u; left--) {
        let t = stamp + left;
        let at = bias + 2u * min(t, bias_last);
        let power = tables[DECAY_POWERS] + 2u * left;
        let rate = number(factors + 2u * min(t - 1u, factors_last));
        sum += rate * number(at) * number(power) * m / (root * number(power + 1u) * number(at + 1u) + number(EPS));
    }
    return sum;
}

/// The value of a state of `stamp` steps after `end` steps.
fn evaluate(value: f32, m: f32, v: f32, stamp: u32, end: u32, of_means: bool, rate: f32) -> f32 {
    if stamp >= end || m == 0.0 {
        return value;
    }
    if v <= number(FLOOR) {
        return flush(value - direct_sum(m, v, stamp, end, of_means) * rate);
    }
    let kind = select(4u, 0u, of_means);
    var sums: SeriesSums;
    let missed = end - stamp;
    if missed < arrayLength(&recent) / SUMS_WORDS {
        let at = SUMS_WORDS * missed + kind;
        sums = SeriesSums(recent[at], recent[at + 1u], recent[at + 2u]);
    } else {
        let at = tables[LIMITS] + SUMS_WORDS * min(stamp, tables[LIMITS_LENGTH] - 1u) + kind;
        sums = SeriesSums(number(at), number(at + 1u), number(at + 2u));
    }
    return drifted(value, m, v, sums, rate, number(EPS));
}

/// The value of one element of a row of a page after `end` steps.
fn element(page: DevicePage, column: u32, row: u32, e: u32, end: u32) -> f32 {
    let at = column_at(page, column) + row * column_width(column, page.sh_n_width) + e;
    let words = table_words(page, column);
    let value = bitcast<f32>(slab[at]);
#ifdef HALF_MOMENTS
    let moments = moments_of(slab[at + words]);
#else
    let moments = vec2<f32>(bitcast<f32>(slab[at + words]), bitcast<f32>(slab[at + 2u * words]));
#endif
    return evaluate(value, moments.x, moments.y, slab[stamps_at(page) + row], end, column == MEANS, u.rates[column / 4u][column % 4u]);
}

/// Whether the camera may draw a row at `p` with this largest sigma. NaN counts as drawn.
fn may_draw(p: vec3<f32>, sigma_max: f32) -> bool {
    let m = u.world_to_camera;
    let x = m[0].x * p.x + m[0].y * p.y + m[0].z * p.z + m[0].w;
    let y = m[1].x * p.x + m[1].y * p.y + m[1].z * p.z + m[1].w;
    let z = m[2].x * p.x + m[2].y * p.y + m[2].z * p.z + m[2].w;
    let slack = u.slack.x + u.slack.y * (abs(p.x) + abs(p.y) + abs(p.z));
    let side = slack * u.side_slack;
    let reach = u.reach * sigma_max + vec2<f32>(side);
    let outside = z <= u.depth_range.x - slack
        || z >= u.depth_range.y + slack
        || -x - u.offsets.x > u.slopes.x * z + reach.x
        || x - u.offsets.y > u.slopes.y * z + reach.x
        || -y - u.offsets.z > u.slopes.z * z + reach.y
        || y - u.offsets.w > u.slopes.w * z + reach.y;
    return !outside || !is_finite(x + y + z) || !is_finite(sigma_max);
}

fn is_seen(page: DevicePage, row: u32) -> bool {
    var mean: vec3<f32>;
    var scale: vec3<f32>;
    for (var c = 0u; c < 3u; c++) {
        mean[c] = element(page, MEANS, row, c, u.now);
        scale[c] = element(page, SCALES, row, c, u.now);
    }
    return may_draw(mean, exp32(max(max(scale.x, scale.y), scale.z)));
}

/// One workgroup for each page.
@compute @workgroup_size(256)
fn cull(workgroup: Group, place: SubgroupPlace) {
    let p = linear_group(workgroup);
    // The same for the whole workgroup.
    if p >= u.page_count || pages[p].slab != u.slab {
        return;
    }
    let page = pages[p];
    var before = 0u;
    for (var first = 0u; first < page.rows; first += 256u) {
        let row = first + place.lane;
        var seen = false;
        if row < page.rows {
            seen = is_seen(page, row);
        }
        let scanned = workgroup_scan(u32(seen), place);
        if seen {
            found[page.first_row + before + scanned.before] = row;
        }
        before += scanned.total;
        workgroupBarrier();
    }
    if place.lane == 0u {
        counts[p] = before;
    }
}

/// One workgroup, for the pages of all slabs: where the listed rows of each page begin, and how many there are.
@compute @workgroup_size(256)
fn place(workgroup: Group, place: SubgroupPlace) {
    var before = 0u;
    for (var first = 0u; first < u.page_count; first += 256u) {
        let p = first + place.lane;
        var count = 0u;
        if p < u.page_count {
            count = counts[p];
        }
        let scanned = workgroup_scan(count, place);
        if p < u.page_count {
            placed[p].first_listed = before + scanned.before;
            placed[p].listed = count;
        }
        before += scanned.total;
        workgroupBarrier();
    }
    if place.lane == 0u {
        counts[u.page_count] = before;
    }
}

/// The chunk of a workgroup. Workgroups behind those of the pages fill entries without a row, as far as there are any.
fn chunk(workgroup: Group) -> Chunk {
    let n = linear_group(workgroup);
    let turn = u.first_turn + n / u.chunks;
    if turn < u.end_turn {
        let p = pages[turn].page_from_turn;
        return chunk_of(pages[p], p, n % u.chunks, CHUNK_ROWS, u.first_bound, u.row_count);
    }
    let last = pages[u.page_count - 1u];
    let first = CHUNK_ROWS * (n - (u.end_turn - u.first_turn) * u.chunks);
    let begin = max(first, max(last.first_listed + last.listed, u.first_bound) - u.first_bound);
    let end = min(first + CHUNK_ROWS, u.row_count);
    return Chunk(NO_PAGE, 0u, begin, max(end, begin) - begin);
}

/// A float of a row of a chunk.
fn gathered(c: Chunk, f: Float) -> f32 {
    if c.page == NO_PAGE {
        return select(0.0, HIDDEN_LOGIT, f.column == OPACITIES);
    }
    let page = pages[c.page];
    let row = f.at / f.width;
    return element(page, f.column, found[page.first_row + c.first + row], f.at - row * f.width, u.now);
}

/// One workgroup for each chunk: its floats of means, quats, scales and opacities.
@compute @workgroup_size(256)
fn gather_geometry(workgroup: Group, place: Place) {
    let c = chunk(workgroup);
    for (var k = place.lane; k < 11u * c.rows; k += 256u) {
        let f = float_of(k, c.rows, MEANS, vec4<u32>(3u, 4u, 3u, 1u));
        let value = gathered(c, f);
        let at = f.width * c.at + f.at;
        switch f.column {
            case MEANS: { means[at] = value; }
            case QUATS: { quats[at] = value; }
            case SCALES: { scales[at] = value; }
            default: { opacities[at] = value; }
        }
    }
}

/// One workgroup for each chunk: its floats of the colours.
@compute @workgroup_size(256)
fn gather_colors(workgroup: Group, place: Place) {
    let c = chunk(workgroup);
    for (var k = place.lane; k < (3u + u.sh_n_width) * c.rows; k += 256u) {
        let f = float_of(k, c.rows, SH0, vec4<u32>(3u, u.sh_n_width, 0u, 0u));
        let value = gathered(c, f);
        let at = f.width * c.at + f.at;
        if f.column == SH0 {
            sh0[at] = value;
        } else {
            sh_n[at] = value;
        }
    }
}

/// The range that a value passes through on its way to its limit.
fn hull(page: DevicePage, column: u32, row: u32, e: u32) -> vec2<f32> {
    let value = bitcast<f32>(slab[column_at(page, column) + row * column_width(column, page.sh_n_width) + e]);
    let limit = element(page, column, row, e, FOR_EVER);
    let low = min(value, limit);
    let high = max(value, limit);
    let slack = MOVEMENT_SLACK * (high - low) + VALUE_SLACK * max(abs(low), abs(high)) + FLUSH_SLACK;
    return vec2<f32>(low - slack, high + slack);
}

/// Mean growth score of a row.
fn mean_score(page: DevicePage, row: u32) -> f32 {
    let views = slab[count_at(page) + row] & VIEWS_MOST;
    return quotient(bitcast<f32>(slab[grad2d_at(page) + row]), max(views, 1u));
}

/// Largest distance of a row's children from it.
fn split_reach(page: DevicePage, row: u32, sigma: f32) -> f32 {
    let mean = mean_score(page, row);
    return select(0.0, u.split_reach * REACH_SLACK * sigma, mean > u.grow_grad2d && sigma > u.split_scale);
}

/// Bounds of the pages that an update has changed: one workgroup for each page.
@compute @workgroup_size(256)
fn bounds(workgroup: Group, place: Place) {
    let p = linear_group(workgroup);
    if p >= u.page_count || pages[p].slab != u.slab {
        return;
    }
    let page = pages[p];
    // Numbers that no finite bound exceeds.
    var low = vec3<f32>(3.4e38);
    var high = vec3<f32>(-3.4e38);
    var sigma_max = 0.0;
    for (var row = place.lane; row < page.rows; row += 256u) {
        var log_scale = -3.4e38;
        for (var c = 0u; c < 3u; c++) {
            log_scale = max(log_scale, hull(page, SCALES, row, c).y);
        }
        let sigma = min(exp32(log_scale) * (1.0 + SIGMA_SLACK), SIGMA_MOST);
        let reach = split_reach(page, row, sigma);
        for (var c = 0u; c < 3u; c++) {
            let range = hull(page, MEANS, row, c);
            let below = range.x - reach;
            let above = range.y + reach;
            let slack = select(0.0, EPSILON, reach > 0.0);
            low[c] = min(low[c], below - slack * abs(below));
            high[c] = max(high[c], above + slack * abs(above));
        }
        sigma_max = max(sigma_max, sigma);
    }
    for (var c = 0u; c < 3u; c++) {
        parts[c][place.lane] = low[c];
        parts[3u + c][place.lane] = high[c];
    }
    parts[6][place.lane] = sigma_max;
    for (var half = 128u; half > 0u; half = half / 2u) {
        workgroupBarrier();
        if place.lane < half {
            for (var c = 0u; c < 3u; c++) {
                parts[c][place.lane] = min(parts[c][place.lane], parts[c][place.lane + half]);
                parts[3u + c][place.lane] = max(parts[3u + c][place.lane], parts[3u + c][place.lane + half]);
            }
            parts[6][place.lane] = max(parts[6][place.lane], parts[6][place.lane + half]);
        }
    }
    if place.lane == 0u {
        for (var c = 0u; c < 3u; c++) {
            results[p].low[c] = bitcast<u32>(parts[c][0]);
            results[p].high[c] = bitcast<u32>(parts[3u + c][0]);
        }
        results[p].sigma_max = bitcast<u32>(parts[6][0]);
    }
}

/// One workgroup for each page.
@compute @workgroup_size(256)
fn survey(workgroup: Group, place: Place) {
    let p = linear_group(workgroup);
    if p >= u.page_count || pages[p].slab != u.slab {
        return;
    }
    let page = pages[p];
    var lowest = 3.4e38;
    var mean = 0.0;
    var weight = 3.4e38;
    for (var row = place.lane; row < page.rows; row += 256u) {
        lowest = min(lowest, hull(page, OPACITIES, row, 0u).x);
        let word = slab[count_at(page) + row];
        if is_weighed(word) {
            weight = min(weight, mean_weight(word));
        }
        let score = mean_score(page, row);
        mean = max(mean, select(score, max(score, SMALLEST_MEAN), score > 0.0));
    }
    parts[0][place.lane] = lowest;
    parts[1][place.lane] = mean;
    parts[2][place.lane] = weight;
    for (var half = 128u; half > 0u; half = half / 2u) {
        workgroupBarrier();
        if place.lane < half {
            parts[0][place.lane] = min(parts[0][place.lane], parts[0][place.lane + half]);
            parts[1][place.lane] = max(parts[1][place.lane], parts[1][place.lane + half]);
            parts[2][place.lane] = min(parts[2][place.lane], parts[2][place.lane + half]);
        }
    }
    if place.lane == 0u {
        surveys[p].least_weight = bitcast<u32>(parts[2][0]);
        surveys[p].lowest_opacity = bitcast<u32>(parts[0][0]);
        surveys[p].largest_mean = bitcast<u32>(parts[1][0]);
    }
}
