//! The map of page versions and the commits that make it durable: which version of every page belongs to which
//! generation.

pub mod commit;
pub mod entries;
pub mod generations;
pub mod manifest;
pub mod map_file;
pub mod opening;
pub mod witness;
