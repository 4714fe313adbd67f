//! Rust twins of the uniform structs of the tile stages' shaders. Values only; what they mean stands in the shaders.

use super::splats::Grid;

/// Sums that the backward rasterizer leaves for each intersection.
pub const SUMS: u32 = 9;
/// Values of one workgroup of the scan.
pub const SCAN_BLOCK: u32 = 2048;
/// Keys of one workgroup of the sort.
pub const SORT_BLOCK: u32 = 2048;
/// Bits of a pass of the sort.
pub const DIGIT_BITS: u32 = 4;
/// Values of a digit.
pub const DIGITS: u32 = 1 << DIGIT_BITS;
/// Rows of one workgroup of `fold_rows`.
pub const FOLD_ROWS: u32 = 28;
/// Words of a splat and of its gradient: three vec4.
pub const SPLAT_WORDS: u32 = 12;
/// List entries of one dispatch of the forward rasterizer: an invocation makes one iteration for each, and one for
/// each batch of 64, of at most 65,535.
pub const SEGMENT_FWD: u32 = 32_768;
/// List entries of one dispatch of the backward rasterizer, which makes up to 5.5 iterations for each.
pub const SEGMENT_BWD: u32 = 8192;

/// Flag of [`RasterUniforms`]: the first dispatch in the order in which the direction goes.
pub const SEGMENT_FIRST: u32 = 1;
/// Flag of [`RasterUniforms`]: the last dispatch.
pub const SEGMENT_LAST: u32 = 2;
/// Flag of [`RasterUniforms`]: there is a gradient of the coverage.
pub const HAS_V_ALPHA: u32 = 4;

crate::wgsl_struct! {
    /// Of `scan.wgsl`.
    pub struct ScanUniforms {
        /// Values of this level.
        pub count: u32,
        /// 1: there are bases to add.
        pub has_bases: u32,
        /// Unused.
        pub pad: [u32; 2],
    }
}

crate::wgsl_struct! {
    /// Of `radix_sort.wgsl`.
    pub struct SortUniforms {
        /// Most keys; for `depth_keys`, rows.
        pub capacity: u32,
        /// Where the number of keys stands.
        pub live_at: u32,
        /// Workgroups of the pass.
        pub blocks: u32,
        /// Lowest bit of the digit.
        pub shift: u32,
    }
}

crate::wgsl_struct! {
    /// Of `isect_emit.wgsl`.
    pub struct IsectUniforms {
        /// Width, height, tile columns, tile rows.
        pub grid: [u32; 4],
        /// Rows of the view.
        pub row_count: u32,
        /// Most intersections.
        pub capacity: u32,
        /// Unused.
        pub pad: [u32; 2],
    }
}

crate::wgsl_struct! {
    /// Of `isect_offsets.wgsl`.
    pub struct OffsetsUniforms {
        /// Tiles of the grid.
        pub tile_count: u32,
        /// Most intersections.
        pub capacity: u32,
        /// Where the number of intersections stands.
        pub live_at: u32,
        /// Unused.
        pub pad: u32,
    }
}

crate::wgsl_struct! {
    /// Of `rasterize_fwd.wgsl` and `rasterize_bwd.wgsl`.
    pub struct RasterUniforms {
        /// Width, height, tile columns, tile rows.
        pub grid: [u32; 4],
        /// RGB behind everything.
        pub background: [f32; 3],
        /// Upper clamp of alpha.
        pub max_alpha: f32,
        /// Its log2.
        pub log2_max_alpha: f32,
        /// First list index of the segment.
        pub first: u32,
        /// One past its last.
        pub end: u32,
        /// Sum of flags.
        pub flags: u32,
        /// Rows of the view.
        pub row_count: u32,
        /// Their intersections.
        pub isect_count: u32,
        /// First intersection, by emit index, whose sums are kept.
        pub window_first: u32,
        /// One past the last.
        pub window_end: u32,
    }
}

/// A grid as the shaders hold it.
pub fn grid_words(grid: Grid) -> [u32; 4] {
    [grid.width, grid.height, grid.tiles_x, grid.tiles_y]
}
