//! The device memory of a view, by part: what a view in one piece takes, and the least with which it can be drawn and
//! differentiated in chunks of rows and ranges of tiles.
//!
//! Not here: the allocation (`gpu`, which adapts to what it gets).
//!
//! Invariant: [`DeviceNeeds::least`] suffices. A test trains at the least that it states.

use super::gpu_gradients::chunk_row_bytes;
use super::gpu_range_plan::{BYTES_OF_ISECT, BYTES_OF_SPLAT, PART_ISECTS};
use super::gpu_ranges::PLACE_BYTES;
use super::gpu_rows::{DeviceColumns, SPLAT_BYTES};
use super::gpu_segments::CHUNK_STEP;
pub use super::view_sizes::ViewSizes;
use crate::gpu::staging_bytes;

/// Bytes a pixel: picture, transmittance, stops; photo, gradient and derivatives of the loss; the corrected picture or the
/// carried pixels of long lists; the errors that rows are weighed by.
const PIXEL_BYTES: u64 = 12 + 4 + 4 + 4 + 12 + 12 + 12 + 4;
/// Bytes of small buffers: uniforms, counts, sums, and the smallest staging.
const SMALL_BYTES: u64 = 192 << 10;

/// The device memory of a view, bytes. Size classes of the buffers, which add up to a quarter, are included.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DeviceNeeds {
    /// Rows and their gradients, all at once: a view in one piece.
    pub rows: u64,
    /// Splats and their gradients.
    pub splats: u64,
    /// All lists, and the sums of the backward pass: a view in one piece.
    pub lists: u64,
    /// Pictures.
    pub pixels: u64,
    /// Staging of uploads: a view in one piece.
    pub staging: u64,
    /// In place of `rows`: the smallest chunk.
    chunk: u64,
    /// In place of `lists`: places of the rows in a range, and the smallest part of a tile's list with its splats.
    part: u64,
}

impl DeviceNeeds {
    /// The needs of a view with `sh_degree` colour bands.
    pub fn new(view: ViewSizes, sh_degree: u8) -> DeviceNeeds {
        let with_class = |bytes: u64| bytes / 4 * 5;
        let row = chunk_row_bytes(sh_degree);
        DeviceNeeds {
            rows: with_class(view.rows * row),
            splats: with_class(2 * SPLAT_BYTES * view.rows),
            lists: with_class(BYTES_OF_ISECT * view.isects + 12 * view.rows),
            pixels: with_class(PIXEL_BYTES * view.pixels),
            staging: staging_bytes(DeviceColumns::row_bytes(sh_degree) * view.rows),
            chunk: with_class(2 * row * CHUNK_STEP as u64),
            part: with_class(PLACE_BYTES * view.rows + (BYTES_OF_SPLAT + BYTES_OF_ISECT) * PART_ISECTS),
        }
    }

    /// The memory of a view in one piece.
    pub fn whole(&self) -> u64 {
        self.rows + self.splats + self.lists + self.pixels + self.staging + SMALL_BYTES
    }

    /// The least memory with which the view can be drawn and differentiated.
    pub fn least(&self) -> u64 {
        // Staging takes a 64th of the budget for each of its two sets.
        let buffers = self.chunk + self.splats + self.part + self.pixels + SMALL_BYTES;
        buffers / 31 * 32
    }
}
