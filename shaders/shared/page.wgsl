// The rows of a page in its bytes on a device, as words. The layout is that of src/scene/page_layout.rs: with moments of 32 bits a payload
// is copied between host and device as it is. With the switch HALF_MOMENTS the first and the second moment of a value share a word.

/// One page of a batch.
struct DevicePage {
    /// Rows.
    rows: u32,
    /// The slab that holds the page.
    slab: u32,
    /// First word of the payload in the slab.
    base: u32,
    /// Floats per row of the higher SH bands.
    sh_n_width: u32,
    /// Number, in the batch, of the page's first row.
    first_row: u32,
    /// Number, in the batch, of the page's first listed row.
    first_listed: u32,
    /// Listed rows.
    listed: u32,
    /// Number of the page that comes in turn i, in entry i. Turns follow the slabs: the pages of a slab are neighbours.
    page_from_turn: u32,
}

/// Rows of a chunk of columns.
const CHUNK_ROWS: u32 = 64u;

/// Consecutive listed rows of a page: what a workgroup gathers or updates.
struct Chunk {
    /// Number of the page.
    page: u32,
    /// First of the rows, among the listed rows of the page.
    first: u32,
    /// Its place in the columns that are bound.
    at: u32,
    /// Rows; 0 where the workgroup has nothing to do.
    rows: u32,
}

/// The rows of chunk `n` of page `p`, in chunks of `size` listed rows. Of these only those count that the bound columns hold: `bound` listed
/// rows of the batch, from number `first_bound` on.
fn chunk_of(page: DevicePage, p: u32, n: u32, size: u32, first_bound: u32, bound: u32) -> Chunk {
    let begin = max(page.first_listed + min(size * n, page.listed), first_bound);
    let end = min(page.first_listed + min(size * n + size, page.listed), first_bound + bound);
    return Chunk(p, begin - page.first_listed, begin - first_bound, max(end, begin) - begin);
}

/// What an update did to a page, and its bounds.
struct PageResult {
    /// Rows that the optimizer rewrote.
    updated: u32,
    /// Rows left as they were because a gradient was not finite or too large.
    skipped: u32,
    /// Rows that were drawn.
    drawn: u32,
    /// Rows whose statistics changed.
    collected: u32,
    /// Box of the means, and largest standard deviation; bits of floats.
    low: array<u32, 3>,
    high: array<u32, 3>,
    sigma_max: u32,
    pad: u32,
}

/// What decides whether a round edits rows of a page.
struct PageSurvey {
    /// Largest mean growth score of a row, bits of a float.
    largest_mean: u32,
    /// Lower bound of the opacities, before activation, for all later steps without an update; bits of a float.
    lowest_opacity: u32,
    /// Least mean blending weight of the rows that are judged by it, bits of a float; a number above 1e30 without such rows.
    least_weight: u32,
    pad: u32,
}

/// Columns in storage order, and the tables of each.
const MEANS: u32 = 0u;
const QUATS: u32 = 1u;
const SCALES: u32 = 2u;
const OPACITIES: u32 = 3u;
const SH0: u32 = 4u;
const SH_N: u32 = 5u;

/// Words of a table, padded to 64 bytes.
fn padded(words: u32) -> u32 {
    return (words + 15u) & 0xfffffff0u;
}

/// First words of the tables of steps, of sums and of counts; identities come first, two words a row.
fn stamps_at(page: DevicePage) -> u32 {
    return page.base + padded(2u * page.rows);
}

fn grad2d_at(page: DevicePage) -> u32 {
    return stamps_at(page) + padded(page.rows);
}

fn count_at(page: DevicePage) -> u32 {
    return grad2d_at(page) + padded(page.rows);
}

fn column_width(column: u32, sh_n_width: u32) -> u32 {
    switch column {
        case QUATS: { return 4u; }
        case OPACITIES: { return 1u; }
        case SH_N: { return sh_n_width; }
        default: { return 3u; }
    }
}

/// A float of a column of rows.
struct Float {
    column: u32,
    /// Floats per row of the column.
    width: u32,
    /// Number of the float in the column.
    at: u32,
}

/// The i-th float of so many rows of at most four columns from `first` on, of these widths, one column behind the other; `i` is below
/// their sum.
fn float_of(i: u32, row_count: u32, first: u32, widths: vec4<u32>) -> Float {
    let two = widths.x + widths.y;
    let ends = row_count * vec3<u32>(widths.x, two, two + widths.z);
    if i < ends.x {
        return Float(first, widths.x, i);
    }
    if i < ends.y {
        return Float(first + 1u, widths.y, i - ends.x);
    }
    if i < ends.z {
        return Float(first + 2u, widths.z, i - ends.y);
    }
    return Float(first + 3u, widths.w, i - ends.z);
}

/// Tables of a column: values and moments.
#ifdef HALF_MOMENTS
const TABLES: u32 = 2u;

/// The first and the second moment in a word.
fn moments_of(both: u32) -> vec2<f32> {
    return vec2<f32>(bitcast<f32>(both & 0xffff0000u), bitcast<f32>(both << 16u));
}
#else
const TABLES: u32 = 3u;
#endif

/// Words of the table of values of a column, which are those of its moments.
fn table_words(page: DevicePage, column: u32) -> u32 {
    return padded(page.rows * column_width(column, page.sh_n_width));
}

/// First word of the values of a column; the tables of its moments follow, each after `table_words`. The sum over the columns before is
/// written out, because every float of a step asks for it.
fn column_at(page: DevicePage, column: u32) -> u32 {
    let threes = padded(3u * page.rows);
    var before = select(0u, threes, column > MEANS);
    before += select(0u, padded(4u * page.rows), column > QUATS);
    before += select(0u, threes, column > SCALES);
    before += select(0u, padded(page.rows), column > OPACITIES);
    before += select(0u, threes, column > SH0);
    return count_at(page) + padded(page.rows) + TABLES * before;
}
