//! Pages as bytes: buffers, slots on disk, the engines that move bytes between them, the map of page versions, and
//! commits, which make versions durable. Nothing here knows what a page contains.
//!
//! | folder | what it is responsible for |
//! | --- | --- |
//! | [`engine`] | moving bytes between memory and segment files: io_uring, pread, mmap, memory |
//! | [`mod@format`] | the bytes of a slot: headers, codecs, checksums, the FORMAT file |
//! | [`versions`] | which slot holds which version of a page |
//! | [`map`] | the page map, generations, commits, the witness |
//! | [`folder`] | the spill directory: lock, identity, clean-up; what its drive is and how fast |
//! | [`tool`] | inspecting a store, building one, finding pages without a map |
//!
//! Dependencies point one way: `engine` <- `format` <- `versions`, `folder` <- `map` <- `tool`.

pub mod engine;
pub mod folder;
pub mod format;
pub mod map;
#[doc(hidden)]
pub mod mutants;
pub mod tool;
pub mod versions;
