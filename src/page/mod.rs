//! Pages as bytes: buffers, slots on disk and the engines that move between them, the map of versions and the commits
//! that make them last. Nothing here knows what a page holds.

pub mod buffer;
pub mod codec;
pub mod commit;
pub mod encoding;
pub mod faulty_store;
pub mod file_system;
pub mod folder;
pub mod format;
pub mod generations;
pub mod manifest;
pub mod map_file;
pub mod memory_store;
#[doc(hidden)]
pub mod mutants;
pub mod opening;
mod page_done;
pub mod page_error;
pub mod paged_store;
pub mod seal;
pub mod segment_files;
pub mod slots;
pub mod spill_dir;
pub mod spill_format;
pub mod store;
pub mod verify;
pub mod witness;
