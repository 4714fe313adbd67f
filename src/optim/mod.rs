//! Learning rates and Adam: dense as the definition, deferred as what runs.

pub mod adam;
pub mod deferred;
pub mod drift;
pub mod rates;
