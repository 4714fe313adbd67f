//! The stages of one training step, in execution order. Every backend follows this table: a stage's name is its file stem here and in
//! `shaders/`, and its key in profiles. The CPU form of a stage that only devices run is in `tests/numerics/twins`.

/// The stages in order. The first and the last run where pages lie on a device; elsewhere the host gathers and updates.
///
/// A device sorts intersections by tile between `isect_emit` and `isect_offsets`. The CPU uses a counting sort instead:
/// `isect_offsets` converts the tiles' counts to places, and `isect_emit` writes each intersection to its place.
pub const STAGES: [&str; 13] = [
    "gather",        // rows of pages on a device as they are now; culls
    "project_fwd",   // rows to footprints on the screen; culls
    "sh_fwd",        // colours of the visible rows from their view directions
    "radix_sort",    // visible rows front to back by the bits of their depth, ties by row
    "scan",          // packs rows and turns the tiles that each touches into 64-bit offsets
    "isect_emit",    // one intersection for each row and tile that it touches
    "isect_offsets", // where each tile's list of intersections begins
    "rasterize_fwd", // blends each tile's list front to back
    "image_loss",    // loss of the image and its gradient
    "rasterize_bwd", // gradients of footprints and colours, back to front
    "sh_bwd",        // gradients of colours to coefficients and means
    "project_bwd",   // gradients of footprints to means, quats, scales, opacities
    "update",        // Adam on the rows of pages on a device, their statistics and bounds
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stage_has_its_file() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let has = |folder: &str, name: &str| root.join(folder).join(format!("{name}.rs")).is_file();
        for name in STAGES {
            let is_for_devices = ["gather", "update"].contains(&name);
            let folder = if is_for_devices { "tests/numerics/twins" } else { "src/kernels" };
            assert!(has(folder, name), "{name}");
        }
    }
}
