//! The dataset readers on generated scenes, good and bad, and on real scenes.

mod colmap_bad;
mod colmap_good;
mod encodings;
mod exports;
mod layouts;
mod mega_nerf;
mod real;
mod transforms_bad;
mod transforms_good;
pub mod write;
