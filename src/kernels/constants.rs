//! Constants that every implementation of the stages shares.

/// Side of a tile, pixels.
pub const TILE: u32 = 16;
/// Contributions with an alpha below this are skipped.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// A pixel stops before the contribution that would bring its transmittance to this or less.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
// The blur and the extent of footprints also decide what a camera can see at all.
pub use crate::scene::frustum::{EPS2D, EXTENT_SIGMAS};
