//! Pages as bytes: buffers, slots on disk and the engines that move between them. Nothing here knows what a page holds.

pub mod buffer;
pub mod codec;
pub mod engine;
pub mod format;
pub mod memory_store;
pub mod mmap_store;
mod page_cache;
pub mod page_error;
pub mod paged_store;
pub mod pread_store;
mod resume;
pub mod segment_files;
mod segment_io;
#[cfg(target_os = "linux")]
mod slab;
pub mod slots;
pub mod store;
mod transfer_pool;
#[cfg(target_os = "linux")]
pub mod uring_store;
pub mod verify;
