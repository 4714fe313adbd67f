//! The map of page versions and the commits that make it durable: which version of every page belongs to which
//! generation.

pub mod commit;
pub mod generations;
pub mod manifest;
pub(in crate::page) mod manifest_write;
pub mod map_file;
#[doc(hidden)]
pub mod mutants;
pub mod opening;
pub mod witness;
