//! Pages as bytes: buffers, slots on disk and the engines that move between them, the map of versions and the commits
//! that make them last. Nothing here knows what a page holds.

pub mod buffer;
pub mod codec;
pub mod commit;
mod cut;
pub mod drive_rate;
pub mod encoding;
pub mod engine;
pub mod faulty_store;
pub mod file_system;
pub mod folder;
pub mod format;
pub mod generations;
pub mod halves;
pub mod io_measure;
pub mod manifest;
mod manifest_write;
pub mod map_file;
pub mod memory_store;
pub mod mmap_store;
#[doc(hidden)]
pub mod mutants;
pub mod new_store;
pub mod opening;
mod page_cache;
mod page_done;
pub mod page_error;
pub mod paged_store;
pub mod pread_store;
pub mod reading;
#[cfg(target_os = "linux")]
mod registered;
mod resume;
pub mod scan;
pub mod seal;
pub mod segment_files;
mod segment_io;
#[cfg(target_os = "linux")]
mod slab;
pub mod slot_reader;
pub mod slots;
pub mod spill_dir;
pub mod spill_format;
pub mod store;
mod transfer_pool;
pub mod uncommitted;
#[cfg(target_os = "linux")]
pub mod uring_store;
pub mod verify;
mod waiting;
pub mod witness;
