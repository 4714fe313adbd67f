// Constants that every implementation of the stages shares; the values of src/kernels/constants.rs.

/// Invocations of a workgroup; all workgroups are one-dimensional.
const WORKGROUP: u32 = 256u;
/// Side of a tile, pixels.
const TILE: u32 = 16u;
/// Contributions with an alpha below this are skipped.
const ALPHA_MIN: f32 = 0.003921569;
/// A pixel stops before the contribution that would bring its transmittance to this or less.
const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Largest extent of a footprint, in standard deviations.
const EXTENT_SIGMAS: f32 = 3.33;
