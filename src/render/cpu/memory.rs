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
//! Invariants: 1. no result depends on whether a view is crowded; 2. other views keep all buffers, so they allocate
//! nothing once a view of their size was rendered.

use super::CpuRenderer;
use crate::kernels::fold::{FootprintGradients, Partial, WeightPartial};
use crate::kernels::splats::Packed;
#[cfg(test)]
use crate::kernels::splats::{Span, Splat};
use std::ops::Range;
use std::sync::atomic::AtomicU64;

/// Bytes of one intersection: its entry in a list, and its sums in the backward pass.
pub(super) const LIST_BYTES: u64 = (size_of::<AtomicU64>() + size_of::<Partial>()) as u64;

/// Most bytes that a crowded view holds for a visible row, beside lists, pixels and weights: conic, radii, opacity and depth
/// order; packed splat, span and count; gradients of the splat, and the count of a range.
#[cfg(test)]
pub(super) const CROWDED_ROW_BYTES: usize =
    (12 + 8 + 4 + 4) + (size_of::<Splat>() + size_of::<Span>() + 4) + (8 + 12 + 12 + 4) + 4;

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
        self.bytes_most = self.bytes_most.max(self.scratch_bytes());
    }

    /// Host memory that this renderer holds now, bytes.
    pub fn scratch_bytes(&self) -> u64 {
        self.bytes_of_rows() + self.bytes_of_lists_and_pixels()
    }

    fn bytes_of_rows(&self) -> u64 {
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
