//! Pages as bytes: buffers, slots on disk, the engines that move bytes between them, the map of page versions, and
//! commits, which make versions durable. Nothing here knows what a page contains.
//!
//! | folder | what it is responsible for |
//! | --- | --- |
//! | [`engine`] | moving bytes between memory and segment files: io_uring, pread, mmap, memory |
//! | [`mod@format`] | the bytes of a slot: headers, codecs, checksums, the FORMAT file |
//! | [`versions`] | which slot holds which version of a page |
//! | [`map`] | the page map, generations, commits, the witness |
//! | [`folder`] | the spill directory: lock, identity, clean-up |
//! | [`tool`] | inspecting a store, building one, finding pages without a map |

pub mod engine;
pub mod folder;
pub mod format;
pub mod map;
pub mod tool;
pub mod versions;
