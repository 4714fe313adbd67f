//! Bytes that the stages of a step on a device must move: one read of every input and one write of every output; a
//! gather counts every gathered element. Colours use all bands.

use gsscale::scene::camera::Camera;

/// Mean counts of a step, which determine its bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Counts {
    /// Rows in view.
    pub rows: f64,
    /// Intersections.
    pub isects: f64,
    pub pixels: f64,
    pub tiles: f64,
}

impl Counts {
    pub fn add(&mut self, rows: u64, isects: u64, camera: &Camera) {
        self.rows += rows as f64;
        self.isects += isects as f64;
        self.pixels += camera.pixels() as f64;
        self.tiles += f64::from(camera.width.div_ceil(16) * camera.height.div_ceil(16));
    }

    /// Divides the sums by the number of steps.
    pub fn divide(&mut self, steps: f64) {
        for sum in [&mut self.rows, &mut self.isects, &mut self.pixels, &mut self.tiles] {
            *sum /= steps;
        }
    }
}

/// Bytes of a splat or its gradient.
const SPLAT: f64 = 48.0;
/// Bytes of means, quats, scales and opacities; of sh0; of the higher bands.
const GEOMETRY: f64 = 44.0;
const SH0: f64 = 12.0;
const BANDS: f64 = 180.0;
/// Key bits per pass of the sort.
const DIGIT_BITS: f64 = 8.0;

/// Bytes of a stage in a step; 0 for a stage without an entry.
pub fn stage_bytes(stage: &str, counts: &Counts) -> f64 {
    let Counts { rows, isects, pixels, tiles } = *counts;
    // A pass reads the keys for the histogram, then reads and writes keys and values.
    let sort = |n: f64, bits: f64| (bits / DIGIT_BITS).ceil() * 20.0 * n;
    let tile_bits = (tiles + 1.0).log2().ceil();
    match stage {
        // With the keys and values of the sort by depth.
        "project_fwd" => rows * (GEOMETRY + SPLAT + 8.0),
        // Reads the radius, the mean for the direction, and the coefficients; writes the colour.
        "sh_fwd" => rows * (16.0 + 12.0 + SH0 + BANDS + 16.0),
        // By 32 bits of depth, then by tile.
        "radix_sort" => sort(rows, 32.0) + sort(isects, tile_bits),
        "scan" => 8.0 * rows,
        "isect_emit" => rows * (4.0 + SPLAT + 4.0) + isects * (SPLAT + 12.0),
        "isect_offsets" => 4.0 * isects + 4.0 * tiles,
        "rasterize_fwd" => isects * (8.0 + SPLAT) + pixels * 20.0,
        // Three channels: picture and photo in, three maps out; the same in and the gradient out.
        "image_loss" => 3.0 * pixels * (8.0 + 12.0 + 12.0 + 8.0 + 4.0),
        // The list again and nine sums per entry; then sums and splats in, gradients of splats out.
        "rasterize_bwd" => isects * (8.0 + SPLAT + 36.0) + pixels * 20.0 + isects * 40.0 + rows * (2.0 * SPLAT + 12.0),
        "sh_bwd" => rows * (32.0 + 16.0 + 12.0 + BANDS + 12.0 + SH0 + BANDS),
        "project_bwd" => rows * (GEOMETRY + 16.0 + 32.0 + 16.0 + 12.0 + GEOMETRY + 16.0),
        _ => 0.0,
    }
}
