//! Shared by every layer: errors, identities, random draws, deterministic math, instruction paths, sizes, files and
//! folders that are written whole. Knows neither Gaussians, pictures nor disk formats.

pub mod allocator;
pub mod count;
pub mod environment;
pub mod error;
pub mod even_sample;
pub mod identity;
pub mod ids;
pub mod machine;
pub mod math;
pub mod names;
pub mod png_pixels;
pub mod png_rows;
pub mod rng;
pub mod room;
pub mod say;
pub mod simd;
pub mod text;
pub mod trace;
pub mod units;
pub mod whole_file;
pub mod whole_folder;
pub mod without_proc;
