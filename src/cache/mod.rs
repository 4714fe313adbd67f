//! Which pages are in host memory, in which frame and in what state; and which of them goes next. Moves buffers, never
//! bytes; starts no transfer.

pub mod evict;
pub mod frame;
pub mod host_cache;
