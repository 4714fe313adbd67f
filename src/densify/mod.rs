//! Statistics, decisions and edits that change the number of Gaussians.

pub mod ops;
pub mod policy;
pub mod replay;
pub mod stats;
