//! The memory of a [`CpuRenderer`]: what it holds, and what a crowded view gives up.
//!
//! A view is crowded if its visible rows alone need longer lists of intersections than the budget allows, since every
//! visible row has at least one intersection. Such a view frees each buffer after the last stage that reads the buffer:
//!
//! | bytes a row | buffer | freed |
//! | --- | --- | --- |
//! | 36 + 4 | gradients of splats, and counts of a range | when the next view begins |
//! | 16 | keys of the sort | after the sort |
//! | 4 | depths | after the sort |
//! | 8 + 12 | projected means and colours, which the packed splats hold too | after packing |
//!
//! At most 152 bytes a row are held at once, instead of 192, and 12 bytes for each row of one batch, whose colours are taken
//! from the packed splats. Sums of weights, where a strategy collects them, come on top.
//!
//! Between views, the owner of a renderer can free all buffers that grow with rows: frames of pages need the memory of a
//! view that is far wider than the coming ones.
//!
//! Invariants: 1. no result depends on whether a view is crowded, nor on when buffers are freed; 2. views that are not crowded
//! keep all buffers, so they allocate nothing once a view of their size was rendered.

use super::CpuRenderer;
use crate::kernels::fold::{FootprintGradients, Partial, WeightPartial};
use crate::kernels::project_fwd::Projected;
use crate::kernels::splats::{Packed, Span, Splat};
use std::ops::Range;
use std::sync::atomic::AtomicU64;

/// Bytes of one intersection: its entry in a list, and its sums in the backward pass.
pub(super) const LIST_BYTES: u64 = (size_of::<AtomicU64>() + size_of::<Partial>()) as u64;

/// Most bytes that a crowded view holds for a visible row, beside lists, pixels and weights: conic, radii, opacity and depth
/// order; packed splat, span and count; gradients of the splat, and the count of a range.
pub(super) const CROWDED_ROW_BYTES: usize =
    (12 + 8 + 4 + 4) + (size_of::<Splat>() + size_of::<Span>() + 4) + (8 + 12 + 12 + 4) + 4;

/// Bytes that a view with room holds for a visible row on top: keys of the sort, depth, projected mean and colour.
const ROOMY_ROW_BYTES: usize = 16 + 4 + 8 + 12;
/// Bytes that a crowded view holds on top for a row of one batch: colour.
const BATCH_ROW_BYTES: usize = 12;

/// Buffers keep at most an eighth to spare ([`crate::base::room`]).
const SPARE_SHARE: u64 = 8;
/// Bytes of the depth sort that do not grow with rows: its tables.
const SORT_TABLES_BYTES: u64 = 256 << 10;

impl CpuRenderer {
    /// Most intersections that are listed at once.
    pub(super) fn isects_most(&self) -> Option<u64> {
        let isect_bytes = LIST_BYTES + if self.weighs { size_of::<WeightPartial>() as u64 } else { 0 };
        self.list_bytes.map(|bytes| bytes / isect_bytes)
    }

    /// Whether the visible rows alone need longer lists than the budget allows.
    pub(super) fn lists_are_short(&self) -> bool {
        let visible = || self.projected.radii.iter().filter(|radii| **radii != [0, 0]).count() as u64;
        self.isects_most().is_some_and(|most| visible() > most)
    }

    /// Frees what only the backward pass of the view before has read.
    pub(super) fn free_after_view(&mut self) {
        self.note_bytes();
        if self.is_crowded {
            self.footprints = FootprintGradients::default();
            self.range_counts = Vec::new();
        }
    }

    /// Frees what only the sort reads.
    pub(super) fn free_after_sort(&mut self) {
        self.note_bytes();
        if self.is_crowded {
            self.depth_sort.free();
            self.projected.depths = Vec::new();
        }
    }

    /// Frees the buffers whose content the packed splats repeat.
    pub(super) fn free_after_pack(&mut self) {
        self.note_bytes();
        if self.is_crowded {
            self.projected.means2d = Vec::new();
            self.colors = Vec::new();
        }
    }

    /// The range of `colors` that holds the colours of a batch of rows, made again from the packed splats if they were freed.
    pub(super) fn colors_of(&mut self, rows: Range<usize>) -> Range<usize> {
        if !self.is_crowded {
            return rows;
        }
        self.colors.clear();
        self.colors.extend(self.packed.splats[rows].iter().map(|splat| splat.color));
        0..self.colors.len()
    }

    /// Notes the bytes held now.
    pub(super) fn note_bytes(&mut self) {
        self.row_bytes_most = self.row_bytes_most.max(self.bytes_of_rows());
        self.bytes_most = self.bytes_most.max(self.scratch_bytes());
    }

    /// The most bytes that a view with `rows` visible rows, in one batch, holds in buffers that grow with rows, if these buffers
    /// are empty before the view.
    pub(super) fn bytes_for_rows(&self, rows: u64) -> u64 {
        let is_crowded = self.isects_most().is_some_and(|most| rows > most);
        let weights = if self.weighs_next { size_of::<[f32; 2]>() } else { 0 };
        let row_bytes = CROWDED_ROW_BYTES + weights + if is_crowded { BATCH_ROW_BYTES } else { ROOMY_ROW_BYTES };
        (rows + rows / SPARE_SHARE) * row_bytes as u64 + SORT_TABLES_BYTES
    }

    /// Frees all buffers that grow with rows.
    pub(super) fn free_all_rows(&mut self) {
        self.projected = Projected::default();
        self.colors = Vec::new();
        self.depth_sort.free();
        self.order = Vec::new();
        self.packed = Packed::default();
        self.range_counts = Vec::new();
        self.weights = Vec::new();
        self.footprints = FootprintGradients::default();
        (self.bytes_most, self.row_bytes_most) = (0, 0);
    }

    /// Host memory that this renderer holds now, bytes.
    pub fn scratch_bytes(&self) -> u64 {
        self.bytes_of_rows() + self.bytes_of_lists_and_pixels()
    }

    /// Host memory in buffers that grow with the rows of a view, held now, bytes.
    pub(super) fn bytes_of_rows(&self) -> u64 {
        let (p, f) = (&self.projected, &self.footprints);
        let Packed { splats, spans, counts, .. } = &self.packed;
        self.depth_sort.bytes()
            + (bytes(&p.means2d) + bytes(&p.conics) + bytes(&p.depths) + bytes(&p.radii) + bytes(&p.opacities))
            + (bytes(&self.colors) + bytes(&self.order) + bytes(splats) + bytes(spans) + bytes(counts))
            + (bytes(&self.range_counts) + bytes(&self.weights))
            + (bytes(&f.v_means2d) + bytes(&f.v_conics) + bytes(&f.v_colors) + bytes(&f.v_opacities))
    }

    /// Grows with intersections, chunks of rows, tiles and pixels.
    pub(super) fn bytes_of_lists_and_pixels(&self) -> u64 {
        (bytes(&self.isects) + bytes(&self.partials) + bytes(&self.weight_partials))
            + (bytes(&self.packed.chunk_counts) + bytes(&self.chunk_offsets) + bytes(&self.range_chunk_counts))
            + (bytes(&self.tile_counts) + bytes(&self.tile_offsets) + bytes(&self.cursors))
            + (bytes(&self.image.rgb) + bytes(&self.alpha) + bytes(&self.errors))
            + (self.raster.bytes() + self.gradient.bytes())
    }
}

fn bytes<T>(v: &Vec<T>) -> u64 {
    (v.capacity() * size_of::<T>()) as u64
}
