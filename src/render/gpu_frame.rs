//! What the tile stages work on: splats in depth order, tile lists, the picture, and how large the lists turned out to be.
//!
//! Not here: the stages (`gpu_tiles`, `gpu_tiles_bwd`).
//!
//! Invariant: [`Demand`] reports what a frame needed, also where its buffers were too small.

use crate::gpu::{Buffer, Gpu, GpuResult, Readback};
use crate::kernels::splats::Grid;
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms::{RasterUniforms, SPLAT_WORDS, grid_words, range_words};
use bytemuck::Zeroable;

/// Bytes of `count` 32-bit words.
pub(super) fn words(count: u32) -> u64 {
    4 * u64::from(count)
}

/// Bytes of the splats of `rows` rows, or of their gradients.
pub fn splat_bytes(rows: u32) -> u64 {
    u64::from(SPLAT_WORDS) * words(rows)
}

/// The parameters of blending besides splats.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blend {
    /// Tiles of the picture.
    pub grid: Grid,
    /// Background colour, weighted by the transmittance that is left.
    pub background: [f32; 3],
    /// Upper clamp of alpha.
    pub max_alpha: f32,
}

/// Keys and values of a sort, 32-bit words.
#[derive(Debug)]
pub struct Pairs {
    /// `[capacity]` u32.
    pub keys: Buffer,
    /// `[capacity]` u32.
    pub values: Buffer,
}

impl Pairs {
    /// Room for `capacity` pairs, with arbitrary contents.
    pub fn new(gpu: &Gpu, capacity: u32) -> GpuResult<Pairs> {
        let buffer = |label| gpu.buffer(label, 4 * u64::from(capacity));
        Ok(Pairs { keys: buffer("sort keys")?, values: buffer("sort values")? })
    }
}

/// The rows of a view in depth order, with the offsets of their intersections.
#[derive(Debug)]
pub struct Ranks {
    pub rows: u32,
    /// `[rows]` u32: row of each rank; rows that are not drawn come last.
    pub order: Buffer,
    /// `[rows + 1]` u32: first intersection of each rank; the last entry is the number of intersections.
    pub offsets: Buffer,
}

/// The picture of a view.
#[derive(Debug)]
pub struct Pixels {
    /// `[3][height][width]` f32.
    pub rgb: Buffer,
    /// `[height][width]` f32: final transmittance T; the coverage is 1 - T.
    pub t_final: Buffer,
    /// `[height][width]` u32: list index at which the pixel stopped, or 2^32 - 1.
    pub stops: Buffer,
}

impl Pixels {
    /// The buffers of a picture, with arbitrary contents.
    /// Errors: a picture that does not fit one binding, before the ranges of its tiles are made smaller in vain.
    pub fn new(gpu: &Gpu, grid: Grid) -> GpuResult<Pixels> {
        let pixels = u64::from(grid.width) * u64::from(grid.height);
        gpu.check_binding("rasterize_fwd", "rgb", 12 * pixels)?;
        Ok(Pixels {
            rgb: gpu.buffer("picture", 12 * pixels)?,
            t_final: gpu.buffer("transmittance", 4 * pixels)?,
            stops: gpu.buffer("stops of pixels", 4 * pixels)?,
        })
    }
}

/// The sizes of the buffers of a [`Frame`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameRoom {
    /// Intersections.
    pub capacity: u32,
    /// Longest list that the segments of the blending cover.
    pub list_max: u32,
}

/// The part of its tiles' lists that a frame holds: everything, or the entries of one tile between two depths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ListPart {
    /// At least the list entries of the nearer parts.
    pub base: u32,
    /// Whether no part is nearer.
    pub is_nearest: bool,
    /// Whether no part is farther.
    pub is_farthest: bool,
}

impl ListPart {
    /// Whole lists.
    pub const ALL: ListPart = ListPart { base: 0, is_nearest: true, is_farthest: true };
}

/// Tile lists of a view, or of a range of its tiles.
#[derive(Debug)]
pub struct Frame {
    /// Tiles, background and clamp.
    pub blend: Blend,
    /// The tiles with lists.
    pub range: TileRange,
    pub part: ListPart,
    /// Capacity of the buffers, and longest list that the recorded segments cover.
    pub room: FrameRoom,
    /// `[capacity]` u32: row of each intersection, by emit index.
    pub row_from_isect: Buffer,
    /// `[capacity]` u32: emit indices, tile by tile.
    pub isects: Buffer,
    /// `[tiles + 1]` u32: first list entry of each tile of the picture.
    pub tile_offsets: Buffer,
    /// One u32: the length of the longest list.
    pub longest: Buffer,
}

/// Pending readback of a frame's [`Demand`].
#[derive(Debug)]
pub struct DemandReadback {
    /// The number of intersections.
    pub(super) total: Readback,
    /// The length of the longest list.
    pub(super) longest: Readback,
}

/// The buffer sizes that a frame needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Demand {
    /// Intersections, saturated: 2^32 - 1 means 2^32 - 1 or more.
    pub isects: u32,
    /// Longest tile list among the intersections within the capacity.
    pub list_max: u32,
}

impl DemandReadback {
    pub fn wait(self) -> GpuResult<Demand> {
        let (mut isects, mut list_max) = ([0u32], [0u32]);
        self.total.copy_to(&mut isects)?;
        self.longest.copy_to(&mut list_max)?;
        Ok(Demand { isects: isects[0], list_max: list_max[0] })
    }
}

/// Uniforms of one rasterizer dispatch over the list entries [`length` * `segment`, `length` * (`segment` + 1)).
pub(super) fn raster_uniforms(
    blend: &Blend,
    range: TileRange,
    segment: u32,
    length: u32,
    flags: u32,
) -> RasterUniforms {
    RasterUniforms {
        grid: grid_words(blend.grid),
        background: blend.background,
        max_alpha: blend.max_alpha,
        log2_max_alpha: libm::log2f(blend.max_alpha),
        first: segment.saturating_mul(length),
        end: segment.saturating_add(1).saturating_mul(length),
        flags,
        range: range_words(range),
        ..RasterUniforms::zeroed()
    }
}
