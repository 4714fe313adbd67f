//! Pages as bytes: buffers, slots on disk and the engines that move between them. Nothing here knows what a page holds.

pub mod buffer;
pub mod codec;
pub mod format;
pub mod memory_store;
pub mod page_error;
pub mod paged_store;
pub mod segment_files;
pub mod slots;
pub mod store;
pub mod verify;
