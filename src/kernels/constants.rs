//! Constants that every implementation of the stages shares.

/// Side of a tile, pixels.
pub const TILE: u32 = 16;
/// Contributions with an alpha below this are skipped.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// A pixel stops before the contribution that would bring its transmittance to this or less.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Blur added to both diagonal elements of the projected covariance, px^2.
pub const EPS2D: f32 = 0.3;
/// Largest extent of a footprint, in standard deviations: beyond it alpha is below 1/255 even at opacity 1.
pub const EXTENT_SIGMAS: f32 = 3.33;
