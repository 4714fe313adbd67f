//! What the host and a device's shaders exchange: uniforms, packed photos, pages and their results as words.
//!
//! Not here: buffers and dispatches. The layout of a page's payload is that of [`crate::scene::page_layout`], so a payload is copied
//! between host and device as it is, or packed ([`PageLayout::pack`]); it lies in one slab, a buffer of at most one binding.
//!
//! Invariants: 1. each struct has the layout of its twin in `shaders/`, which documents its fields; 2. numbers that
//! both backends need are computed once, by the same code.

use super::splats::Grid;
use super::tile_range::TileRange;
use crate::kernels::image_loss::LossPlan;
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, sh_n_width};
use crate::scene::frustum::Frustum;
use crate::scene::image::Target;
use crate::scene::optimizer_numbers::{RunNumbers, SplitLimits, StepNumbers};
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageBounds;
use bytemuck::Zeroable;

crate::wgsl_struct! {
    /// Uniform of `image_loss`: `LossUniforms` in `shaders/image_loss.wgsl`.
    pub struct LossUniforms {
        pub width: u32,
        pub height: u32,
        pub first_channel: u32,
        pub channel_count: u32,
        pub margin: u32,
        pub l1_weight: f32,
        pub ssim_weight: f32,
        pub partial_count: u32,
    }
}

impl LossUniforms {
    /// Partial sums per workgroup of `sum_partials`.
    pub const PARTIALS_PER_GROUP: u32 = 4096;

    /// Uniforms for all three channels in one dispatch; `partial_count` is that of the first run of `sum_partials`.
    pub fn new(width: u32, height: u32, plan: &LossPlan) -> Self {
        LossUniforms {
            width,
            height,
            first_channel: 0,
            channel_count: 3,
            margin: plan.margin() as u32,
            l1_weight: plan.l1_weight,
            ssim_weight: plan.ssim_weight,
            partial_count: 3 * Self::tiles(width, height),
        }
    }

    /// Workgroups of `ssim_map` and `gradient` per channel.
    pub fn tiles(width: u32, height: u32) -> u32 {
        let side = super::constants::TILE;
        width.div_ceil(side) * height.div_ceil(side)
    }
}

/// Packs a photo for `image_loss`: one word per pixel, red in the lowest byte, then green, blue and the mask.
pub fn pack_target(target: &Target, words: &mut Vec<u32>) {
    let (pixels, _) = target.rgb.as_chunks::<3>();
    words.clear();
    match &target.mask {
        None => words.extend(pixels.iter().map(|&[r, g, b]| u32::from_le_bytes([r, g, b, 255]))),
        Some(mask) => {
            words.extend(pixels.iter().zip(mask).map(|(&[r, g, b], &byte)| u32::from_le_bytes([r, g, b, byte])));
        }
    }
}

/// Sums that the backward rasterizer writes for each intersection.
pub const SUMS: u32 = 9;
/// As [`SUMS`], with weight and weight times error.
pub const WEIGHED_SUMS: u32 = 11;
/// Values per workgroup of the scan.
pub const SCAN_BLOCK: u32 = 2048;
/// Most sums and values before it that a workgroup of the scan reads: on average two for each of its own values, which costs no more
/// than another dispatch.
pub const SCAN_SUMS: u32 = 4 * SCAN_BLOCK;
/// Keys per workgroup of the sort.
pub const SORT_BLOCK: u32 = 1024;
/// Bits per pass of the sort.
pub const DIGIT_BITS: u32 = 8;
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
    pub struct ScanUniforms {
        pub count: u32,
        pub values_of_sum: u32,
        pub are_sums_scanned: u32,
        pub pad: u32,
    }

    /// Uniform of `radix_sort.wgsl`.
    pub struct SortUniforms {
        pub capacity: u32,
        pub live_at: u32,
        pub blocks: u32,
        pub shift: u32,
    }

    /// Uniform of `isect_emit.wgsl`.
    pub struct IsectUniforms {
        pub grid: [u32; 4],
        pub row_count: u32,
        pub capacity: u32,
        pub pad: [u32; 2],
        pub range: [u32; 4],
    }

    /// Uniform of `tile_range.wgsl`.
    pub struct RangeUniforms {
        pub grid: [u32; 4],
        pub range: [u32; 4],
        pub segment: u32,
        pub row_count: u32,
        pub capacity: u32,
        pub bin_bits: u32,
        pub depths: [u32; 2],
        pub pad: [u32; 2],
    }

    /// Uniform of `isect_offsets.wgsl`.
    pub struct OffsetsUniforms {
        pub tile_count: u32,
        pub capacity: u32,
        pub live_at: u32,
        pub pad: u32,
    }

    /// Uniform of `rasterize_fwd.wgsl` and `rasterize_bwd.wgsl`.
    pub struct RasterUniforms {
        pub grid: [u32; 4],
        pub background: [f32; 3],
        pub max_alpha: f32,
        pub log2_max_alpha: f32,
        pub first: u32,
        pub end: u32,
        pub flags: u32,
        pub row_count: u32,
        pub isect_count: u32,
        pub window_first: u32,
        pub window_end: u32,
        pub range: [u32; 4],
        pub list_base: u32,
        pub pad0: u32,
        pub pad1: u32,
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

crate::wgsl_struct! {
    pub struct GatherUniforms {
        pub world_to_camera: [[f32; 4]; 3],
        pub slopes: [f32; 4],
        pub offsets: [f32; 4],
        pub reach: [f32; 2],
        pub depth_range: [f32; 2],
        pub slack: [f32; 2],
        pub side_slack: f32,
        pub now: u32,
        pub slab: u32,
        pub page_count: u32,
        pub row_count: u32,
        pub sh_n_width: u32,
        pub rates: [[f32; 4]; 2],
        pub grow_grad2d: f32,
        pub split_scale: f32,
        pub split_reach: f32,
        pub first_bound: u32,
        pub first_turn: u32,
        pub end_turn: u32,
        pub chunks: u32,
        pub pad: u32,
    }

    pub struct UpdateUniforms {
        pub slab: u32,
        pub row_count: u32,
        pub column: u32,
        pub now: u32,
        pub half_size: [f32; 2],
        pub inv_root_correction: f32,
        pub collects: u32,
        pub centre: [f32; 3],
        pub weighs: u32,
        pub step_sizes: [[f32; 4]; 2],
        pub first_bound: u32,
        pub first_turn: u32,
        pub end_turn: u32,
        pub chunks: u32,
    }
}

impl GatherUniforms {
    /// Uniforms of a step on the pages of a batch; slab, rows and chunks are set for each dispatch.
    pub fn new(camera: &Camera, run: &RunNumbers, now: u32, splits: &SplitLimits, page_count: u32) -> GatherUniforms {
        let frustum = Frustum::new(camera);
        GatherUniforms {
            world_to_camera: frustum.viewmat,
            slopes: frustum.slopes,
            offsets: frustum.offsets,
            reach: frustum.reach,
            depth_range: frustum.depth_range,
            slack: frustum.slack(),
            side_slack: frustum.side_slack,
            now,
            page_count,
            rates: of_columns(&run.base_rates),
            grow_grad2d: splits.grow_grad2d,
            split_scale: splits.split_scale,
            split_reach: splits.reach,
            ..GatherUniforms::zeroed()
        }
    }
}

/// A number for each column, in the order of [`Column::ALL`], as shaders index them.
pub fn of_columns(numbers: &[f32; Column::ALL.len()]) -> [[f32; 4]; 2] {
    let [a, b, c, d, e, f] = *numbers;
    [[a, b, c, d], [e, f, 0.0, 0.0]]
}

impl UpdateUniforms {
    /// Uniforms of a step; slab, rows, chunks and column are set for each dispatch.
    pub fn new(camera: &Camera, step: &StepNumbers, collects: bool, weighs: bool) -> UpdateUniforms {
        UpdateUniforms {
            now: step.now,
            inv_root_correction: step.inv_root_correction,
            half_size: [camera.width, camera.height].map(|n| n as f32 * 0.5),
            collects: u32::from(collects),
            centre: camera.centre(),
            weighs: u32::from(weighs),
            step_sizes: of_columns(&step.step_sizes),
            ..UpdateUniforms::zeroed()
        }
    }
}

crate::wgsl_struct! {
    /// One page of a batch: `DevicePage` in `shaders/shared/page.wgsl`.
    pub struct DevicePage {
        pub rows: u32,
        /// The slab that holds the page.
        pub slab: u32,
        /// First word of the payload in the slab.
        pub base: u32,
        /// Floats per row of the higher SH bands.
        pub sh_n_width: u32,
        /// Number, in the batch, of the page's first row.
        pub first_row: u32,
        /// Number, in the batch, of the page's first listed row.
        pub first_listed: u32,
        /// Listed rows.
        pub listed: u32,
        /// Number of the page that comes in turn i, in entry i. Turns follow the slabs: the pages of a slab are neighbours.
        pub page_from_turn: u32,
    }

    /// What an update did to a page, and its bounds: `PageResult` in `shaders/shared/page.wgsl`.
    pub struct PageResult {
        /// Rows that the optimizer rewrote.
        pub updated: u32,
        /// Rows left as they were because a gradient was not finite or too large.
        pub skipped: u32,
        /// Rows that were drawn.
        pub drawn: u32,
        /// Rows whose statistics changed.
        pub collected: u32,
        /// Lower corner of the box of the means, bits.
        pub low: [u32; 3],
        /// Upper corner, bits.
        pub high: [u32; 3],
        /// Largest standard deviation, bits.
        pub sigma_max: u32,
        pub pad: u32,
    }

    /// What decides whether a round edits rows of a page: `PageSurvey` in `shaders/shared/page.wgsl`.
    pub struct PageSurvey {
        /// Largest mean growth score of a row, bits.
        pub largest_mean: u32,
        /// Lower bound of the opacities, before activation, for all later steps without an update; bits.
        pub lowest_opacity: u32,
        /// Least mean blending weight of the rows that are judged by it, bits; a number above 1e30 without such rows.
        pub least_weight: u32,
        pub pad: u32,
    }
}

impl DevicePage {
    /// A page whose payload begins at word `base` of a slab.
    pub fn new(layout: PageLayout, slab: u32, base: u32, first_row: u32) -> DevicePage {
        let (rows, sh_n_width) = (layout.rows as u32, sh_n_width(layout.sh_degree) as u32);
        DevicePage { rows, slab, base, sh_n_width, first_row, first_listed: 0, listed: 0, page_from_turn: 0 }
    }
}

impl PageResult {
    /// The bounds of the page, if the update changed it.
    pub fn bounds(&self) -> Option<PageBounds> {
        let is_changed = self.updated > 0 || self.collected > 0;
        let [lo, hi] = [self.low, self.high].map(|corner| corner.map(f32::from_bits));
        is_changed.then(|| PageBounds { lo, hi, sigma_max: f32::from_bits(self.sigma_max) })
    }
}
