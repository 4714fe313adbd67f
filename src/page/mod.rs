//! Pages as bytes: buffers, slots on disk and the engines that move between them, the map of versions and the commits
//! that make them last. Nothing here knows what a page holds.
//!
//! | folder | what it is responsible for |
//! | --- | --- |
//! | [`engine`] | moving bytes between memory and segment files: io_uring, pread, mmap, memory |
//! | [`format`] | what the bytes are: slot headers, codecs, checksums, the FORMAT file |
//! | [`versions`] | which slot holds which version of a page |
//! | [`map`] | the page map, generations, commits, the witness |
//! | [`folder`] | the spill directory: lock, identity, clean-up |
//! | [`tool`] | looking at a store, building one, finding pages without a map |

pub mod engine;
pub mod folder;
pub mod format;
pub mod map;
pub mod tool;
pub mod versions;
