//! What every layer may use: errors, identities, random draws, deterministic math, instruction paths, sizes.
//! Nothing here knows a Gaussian, a picture or a disk format.

#[cfg(target_arch = "x86_64")]
pub(crate) mod eight;
pub mod error;
pub mod identity;
pub mod ids;
pub mod machine;
pub mod math;
pub mod png_pixels;
pub mod rng;
pub mod room;
pub mod say;
pub mod simd;
pub mod units;
