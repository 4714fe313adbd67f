//! Pages as bytes: buffers, slots on disk and the engines that move between them, the map of versions and the commits
//! that make them last. Nothing here knows what a page holds.

pub mod buffer;
pub mod encoding;
pub mod manifest;
pub mod map_file;
#[doc(hidden)]
pub mod mutants;
pub mod store;
pub mod witness;
