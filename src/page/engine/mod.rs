//! I/O engines: move page bytes between memory and segment files. The trait that every engine implements, the four
//! engines (memory, pread, mmap, io_uring), their shared code, and the measurement of drives. Knows neither versions
//! nor commits.

pub mod buffer;
pub mod drive_rate;
pub mod measure;
pub mod memory;
pub mod mmap;
pub mod open;
pub(in crate::page) mod page_cache;
pub mod page_engine;
pub mod pread;
#[cfg(target_os = "linux")]
pub(in crate::page) mod registered;
pub mod segment_files;
pub(in crate::page) mod segment_io;
pub(in crate::page) mod short_transfers;
pub(in crate::page) mod transfer_pool;
#[cfg(target_os = "linux")]
pub mod uring;
