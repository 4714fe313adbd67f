//! Constants shared by every implementation of the stages.

/// Side of a tile, pixels.
pub const TILE: u32 = 16;
/// Contributions with a smaller alpha are skipped.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// A pixel stops before the contribution that would lower its transmittance to this or less.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
// The blur and the extent of footprints also determine what a camera can see.
pub use crate::scene::frustum::{EPS2D, EXTENT_SIGMAS};
