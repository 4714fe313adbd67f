//! Pages as bytes: buffers, slots on disk and the engines that move between them. Nothing here knows what a page holds.

pub mod buffer;
pub mod codec;
pub mod encoding;
pub mod faulty_store;
pub mod file_system;
pub mod format;
pub mod memory_store;
mod page_done;
pub mod page_error;
pub mod paged_store;
pub mod segment_files;
pub mod slots;
pub mod spill_dir;
pub mod spill_format;
pub mod store;
pub mod verify;
