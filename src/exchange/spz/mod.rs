//! SPZ, version 3: Gaussians in a tenth of a PLY's bytes (`github.com/nianticlabs/spz`).
//!
//! Not here: reading it.
//!
//! A file is one gzip stream: a header of 16 bytes, then one array for each attribute, one element a Gaussian: positions,
//! opacities, colours, scales, rotations, harmonics. The axes are x right, y up, z to the back, which is half a turn about x
//! from those of a PLY.
//!
//! Written here and not by a crate: those that write SPZ (`spz` 0.0, `wgpu-3dgs-core` 0.7) take all Gaussians at once, and a city's do
//! not fit in memory.
//!
//! Invariants: 1. the bytes depend on the rows, their order and the metadata alone; 2. the target is replaced as a whole or
//! not at all.

mod pack;
mod write;

pub use write::{SPZ_UP, SpzWriter};
