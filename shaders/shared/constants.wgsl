// Constants shared by every implementation of the stages; a test keeps them equal to src/kernels/constants.rs.

// Side of a tile, pixels.
const TILE: u32 = 16u;
// Contributions with a smaller alpha are skipped.
const ALPHA_MIN: f32 = 1.0 / 255.0;
// A pixel stops before the contribution that would lower its transmittance to this or less.
const TRANSMITTANCE_MIN: f32 = 1e-4;
// Blur added to both diagonal elements of the projected covariance, px^2.
const EPS2D: f32 = 0.3;
// Largest extent of a footprint, in standard deviations.
const EXTENT_SIGMAS: f32 = 3.33;
