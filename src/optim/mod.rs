//! Learning rates and deferred Adam.

pub mod adam;
pub mod bounds;
mod decay;
pub mod deferred;
pub mod drift;
pub(crate) mod lanes;
pub mod method;
pub mod moments;
pub mod one_step;
pub mod rates;
pub mod row_kernels;
mod row_vectors;
