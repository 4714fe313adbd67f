//! One file per stage of the pipeline, on plain slices. No files, no GPU types, no optimizer of the scene.

pub mod constants;
