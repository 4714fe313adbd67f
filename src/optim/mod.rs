//! Learning rates and Adam.

pub mod adam;
pub mod deferred;
pub mod rates;
