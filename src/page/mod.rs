//! Pages as bytes: buffers, slots on disk and the engines that move between them. Nothing here knows what a page holds.

pub mod buffer;
pub mod codec;
pub mod drive_rate;
pub mod encoding;
pub mod engine;
pub mod faulty_store;
pub mod file_system;
pub mod format;
pub mod io_measure;
pub mod memory_store;
pub mod mmap_store;
mod page_cache;
mod page_done;
pub mod page_error;
pub mod paged_store;
pub mod pread_store;
mod resume;
pub mod segment_files;
mod segment_io;
#[cfg(target_os = "linux")]
mod slab;
pub mod slots;
pub mod spill_dir;
pub mod spill_format;
pub mod store;
mod transfer_pool;
#[cfg(target_os = "linux")]
pub mod uring_store;
pub mod verify;
