//! Bytes that the parts of a step on the CPU must move: one read of every input and one write of every output; a gather
//! counts every gathered element. Colours use all bands. Data that stays in a cache between two parts counts too, so a
//! small view can be faster than its floor.

/// Mean counts of a step, which determine its bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CpuCounts {
    /// Rows in the pinned pages.
    pub pinned: f64,
    /// Rows in view.
    pub rows: f64,
    /// Rows that the optimizer rewrites.
    pub updated: f64,
    /// Intersections.
    pub isects: f64,
    pub pixels: f64,
}

/// Bytes of means, quats, scales and opacities; of sh0; of the higher bands.
const GEOMETRY: f64 = 44.0;
const SH0: f64 = 12.0;
const BANDS: f64 = 180.0;
/// Bytes of all values of a row.
const ROW: f64 = GEOMETRY + SH0 + BANDS;
/// Bytes per row of the projection's output: position, conic, depth, extent, opacity.
const FOOTPRINT: f64 = 36.0;
/// Bytes per row of the input of the tile loops: splat, span and count.
const SPLAT: f64 = 64.0;
const SPAN: f64 = 20.0;
/// Bytes of the nine gradient sums.
const PARTIAL: f64 = 36.0;

/// Bytes of a part of a step; 0 for a part without an entry.
pub fn part_bytes(part: &str, counts: &CpuCounts) -> f64 {
    let CpuCounts { pinned, rows, updated, isects, pixels } = *counts;
    match part {
        // Of all rows means and scales with both moments, and the stamp; of rows in view all values with both moments in, the
        // values out.
        "cull+gather" => pinned * (2.0 * 36.0 + 4.0) + 4.0 * rows + rows * (3.0 * ROW + 8.0 + ROW),
        "project_fwd" => rows * (GEOMETRY + FOOTPRINT),
        "sh_fwd" => rows * (8.0 + 12.0 + SH0 + BANDS + 12.0),
        // Three passes over keys of 8 bytes, each read twice and written once.
        "radix_sort" => rows * (12.0 + 8.0 + 3.0 * 24.0 + 12.0),
        "scan" => rows * (FOOTPRINT + 12.0 + SPLAT + SPAN),
        "isect_offsets" => rows * (4.0 + SPAN),
        "isect_emit" => rows * (4.0 + SPAN) + isects * 8.0,
        "rasterize_fwd" => isects * (8.0 + SPLAT) + pixels * 20.0,
        // Picture and photo in, gradient out.
        "image_loss" => pixels * (12.0 + 3.0 + 12.0),
        // The list again and the sums of each entry; then sums and splats in, gradients of footprints and colours out.
        "rasterize_bwd" => isects * (8.0 + SPLAT + 2.0 * PARTIAL) + pixels * 20.0 + rows * (SPLAT + PARTIAL),
        "sh_bwd" => rows * (8.0 + 12.0 + 12.0 + 12.0 + BANDS + 12.0 + SH0 + BANDS),
        "project_bwd" => rows * (GEOMETRY + FOOTPRINT + 24.0 + 12.0 + GEOMETRY),
        // Values, both moments and the gradient in, all but the gradient out.
        "adam+statistics+bounds" => updated * 7.0 * ROW,
        _ => 0.0,
    }
}
