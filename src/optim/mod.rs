//! Learning rates and deferred Adam.

pub mod adam;
mod adam_now;
pub mod bounds;
mod decay;
pub mod deferred;
pub mod drift;
#[cfg(target_arch = "x86_64")]
mod eights;
pub(crate) mod lanes;
pub mod method;
pub mod moments;
mod numbers;
pub mod one_step;
pub mod rates;
mod row_kernels;
mod row_vectors;
