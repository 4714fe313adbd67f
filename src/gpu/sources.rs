//! The table of shaders built into the program. `tests/shaders.rs` fails if a shader file is missing from it.

use super::shader::Source;

macro_rules! sources {
    ($($name:literal),* $(,)?) => {
        /// Every file under `shaders/`, by its path there.
        pub const SOURCES: &[Source] = &[
            $(Source { name: $name, text: include_str!(concat!("../../shaders/", $name)) }),*
        ];
    };
}

sources![
    "image_loss.wgsl",
    "isect_emit.wgsl",
    "isect_offsets.wgsl",
    "project_bwd.wgsl",
    "project_fwd.wgsl",
    "radix_sort.wgsl",
    "rasterize_bwd.wgsl",
    "rasterize_fwd.wgsl",
    "scan.wgsl",
    "sh_bwd.wgsl",
    "sh_fwd.wgsl",
    "shared/camera.wgsl",
    "shared/constants.wgsl",
    "shared/covariance.wgsl",
    "shared/dispatch.wgsl",
    "shared/footprint.wgsl",
    "shared/math.wgsl",
    "shared/raster.wgsl",
    "shared/sh.wgsl",
    "shared/splat.wgsl",
    "shared/workgroup_scan.wgsl",
];
