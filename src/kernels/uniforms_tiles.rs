//! Rust twins of the uniform structs of the tile stages' shaders; the shaders document the fields.

use super::splats::Grid;
use super::tile_range::TileRange;

/// Sums that the backward rasterizer writes for each intersection.
pub const SUMS: u32 = 9;
/// As [`SUMS`], with weight and weight times error.
pub const WEIGHED_SUMS: u32 = 11;
/// Values per workgroup of the scan.
pub const SCAN_BLOCK: u32 = 2048;
/// Keys per workgroup of the sort.
pub const SORT_BLOCK: u32 = 2048;
/// Bits per pass of the sort.
pub const DIGIT_BITS: u32 = 4;
/// Number of values of a digit.
pub const DIGITS: u32 = 1 << DIGIT_BITS;
/// Rows per workgroup of `fold_rows`.
pub const FOLD_ROWS: u32 = 28;
/// As [`FOLD_ROWS`], with [`WEIGHED_SUMS`].
pub const WEIGHED_FOLD_ROWS: u32 = 23;
/// Words of a splat, and of its gradient: three vec4.
pub const SPLAT_WORDS: u32 = 12;
/// List entries per dispatch of the forward rasterizer: an invocation makes one iteration per entry and one per batch
/// of 64, and at most 65,535.
pub const SEGMENT_FWD: u32 = 32_768;
/// List entries per dispatch of the backward rasterizer, which makes up to 5.5 iterations per entry.
pub const SEGMENT_BWD: u32 = 8192;

/// Flag of [`RasterUniforms`]: the first dispatch in the direction of processing.
pub const SEGMENT_FIRST: u32 = 1;
/// Flag of [`RasterUniforms`]: the last dispatch.
pub const SEGMENT_LAST: u32 = 2;
/// Flag of [`RasterUniforms`]: a gradient of the coverage is given.
pub const HAS_V_ALPHA: u32 = 4;
/// Flag of [`RasterUniforms`] for `fold_rows`: the rows continue the sums that the gradients' buffer holds.
pub const FOLD_CARRIED: u32 = 8;
/// Flag of [`RasterUniforms`] for `fold_rows`: the rows store their sums, because another range of tiles follows.
pub const FOLD_UNFINISHED: u32 = 16;
/// Flag of [`RasterUniforms`] for `fold_rows`: there are no lists; a row's rank is its number.
pub const FOLD_WITHOUT_LISTS: u32 = 32;

/// Bins of `range_depths`.
pub const DEPTH_BINS: u32 = 1 << 10;

crate::wgsl_struct! {
    /// Uniform of `scan.wgsl`.
    pub struct ScanUniforms {
        /// Number of values of this level.
        pub count: u32,
        /// 1 if there are bases to add.
        pub has_bases: u32,
        /// Unused.
        pub pad: [u32; 2],
    }

    /// Uniform of `radix_sort.wgsl`.
    pub struct SortUniforms {
        /// Most keys; for `depth_keys`, most rows.
        pub capacity: u32,
        /// Index of the number of keys.
        pub live_at: u32,
        /// Number of workgroups of the pass.
        pub blocks: u32,
        /// Lowest bit of the digit.
        pub shift: u32,
    }

    /// Uniform of `isect_emit.wgsl`.
    pub struct IsectUniforms {
        /// Width, height, tile columns, tile rows.
        pub grid: [u32; 4],
        /// Number of rows of the view.
        pub row_count: u32,
        /// Most intersections.
        pub capacity: u32,
        /// Unused.
        pub pad: [u32; 2],
        /// First column, end of the columns, first row, end of the rows of the tiles that are listed.
        pub range: [u32; 4],
    }

    /// Uniform of `tile_range.wgsl`.
    pub struct RangeUniforms {
        /// Width, height, tile columns, tile rows.
        pub grid: [u32; 4],
        /// First column, end of the columns, first row, end of the rows.
        pub range: [u32; 4],
        /// The number of the segment.
        pub segment: u32,
        /// Rows of the segment.
        pub row_count: u32,
        /// Room of the copy, rows.
        pub capacity: u32,
        /// The keys of a depth bin differ in this number of low bits.
        pub bin_bits: u32,
        /// First depth key of the rows that are wanted, and one past the last.
        pub depths: [u32; 2],
        /// Unused.
        pub pad: [u32; 2],
    }

    /// Uniform of `isect_offsets.wgsl`.
    pub struct OffsetsUniforms {
        pub tile_count: u32,
        /// Most intersections.
        pub capacity: u32,
        /// Index of the number of intersections.
        pub live_at: u32,
        /// Unused.
        pub pad: u32,
    }

    /// Uniform of `rasterize_fwd.wgsl` and `rasterize_bwd.wgsl`.
    pub struct RasterUniforms {
        /// Width, height, tile columns, tile rows.
        pub grid: [u32; 4],
        pub background: [f32; 3],
        /// Upper clamp of alpha.
        pub max_alpha: f32,
        /// log2 of `max_alpha`.
        pub log2_max_alpha: f32,
        /// First list index of the segment.
        pub first: u32,
        /// One past the last list index of the segment.
        pub end: u32,
        /// Sum of flags.
        pub flags: u32,
        /// Number of rows of the view.
        pub row_count: u32,
        /// Number of intersections of these rows.
        pub isect_count: u32,
        /// First intersection, by emit index, whose sums are kept.
        pub window_first: u32,
        /// One past the last.
        pub window_end: u32,
        /// First column, end of the columns, first row, end of the rows of the tiles that are blended.
        pub range: [u32; 4],
        /// List entries of the tile in earlier parts.
        pub list_base: u32,
        /// Unused.
        pub pad0: u32,
        /// Unused.
        pub pad1: u32,
        /// Unused.
        pub pad2: u32,
    }
}

/// A range of tiles as the shaders store it.
pub fn range_words(TileRange { columns, rows }: TileRange) -> [u32; 4] {
    [columns[0], columns[1], rows[0], rows[1]].map(u32::from)
}

/// A grid as the shaders store it.
pub fn grid_words(grid: Grid) -> [u32; 4] {
    [grid.width, grid.height, grid.tiles_x, grid.tiles_y]
}
