//! What the coming steps need, and what a cache makes of it. Runs and simulations use the same plan, the same model of a cache
//! and the same order of eviction. No I/O.

pub mod batches;
pub mod bound;
pub mod cache_model;
pub mod look_ahead;
pub mod steps;
pub(super) mod views;
