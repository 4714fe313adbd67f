//! The stages of one training step, in execution order. Every backend follows this table: a stage's name is its file stem here and in
//! `shaders/`, and its key in profiles. The CPU form of a stage that only devices run is in `tests/numerics/twins`.

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stage {
    /// File stem and profile key.
    pub name: &'static str,
    /// One-line description.
    pub doc: &'static str,
}

/// The stages in order. The first and the last run where pages lie on a device; elsewhere the host gathers and updates.
///
/// A device sorts intersections by tile between `isect_emit` and `isect_offsets`. The CPU uses a counting sort instead:
/// `isect_offsets` converts the tiles' counts to places, and `isect_emit` writes each intersection to its place.
pub const STAGES: [Stage; 13] = [
    Stage { name: "gather", doc: "rows of pages on a device as they are now; culls" },
    Stage { name: "project_fwd", doc: "rows to footprints on the screen; culls" },
    Stage { name: "sh_fwd", doc: "colours of the visible rows from their view directions" },
    Stage { name: "radix_sort", doc: "visible rows front to back by the bits of their depth, ties by row" },
    Stage { name: "scan", doc: "packs rows and turns the tiles that each touches into 64-bit offsets" },
    Stage { name: "isect_emit", doc: "one intersection for each row and tile that it touches" },
    Stage { name: "isect_offsets", doc: "where each tile's list of intersections begins" },
    Stage { name: "rasterize_fwd", doc: "blends each tile's list front to back" },
    Stage { name: "image_loss", doc: "loss of the image and its gradient" },
    Stage { name: "rasterize_bwd", doc: "gradients of footprints and colours, back to front" },
    Stage { name: "sh_bwd", doc: "gradients of colours to coefficients and means" },
    Stage { name: "project_bwd", doc: "gradients of footprints to means, quats, scales, opacities" },
    Stage { name: "update", doc: "Adam on the rows of pages on a device, their statistics and bounds" },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stage_has_its_file() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let has = |folder: &str, name: &str| root.join(folder).join(format!("{name}.rs")).is_file();
        for Stage { name, .. } in STAGES {
            let is_for_devices = ["gather", "update"].contains(&name);
            let folder = if is_for_devices { "tests/numerics/twins" } else { "src/kernels" };
            assert!(has(folder, name), "{name}");
        }
    }
}
