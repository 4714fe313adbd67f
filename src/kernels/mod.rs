//! The stages of the pipeline on the CPU, one file each, on plain slices. Knows no files, GPU types or optimizer.
//!
//! Of the stages that only devices run (gather, update, gate) the structs and tables are here; their twins on slices are in
//! `tests/numerics/twins`.

pub mod constants;
pub mod deferred;
pub mod fold;
pub mod gate;
pub mod image_loss;
mod image_pair;
pub mod isect_emit;
pub mod isect_offsets;
pub mod lanes;
pub mod project_bwd;
pub mod project_fwd;
pub mod radix_sort;
pub mod raster;
pub mod rasterize_bwd;
pub mod rasterize_fwd;
pub mod scan;
pub mod sh_bwd;
pub mod sh_fwd;
pub mod splats;
pub mod squared_error;
mod ssim_band;
pub mod stages;
mod tile_block;
pub mod tile_range;
pub mod uniforms;
