//! I/O engines: move page bytes between memory and segment files. The trait that every engine implements, the four
//! engines (memory, pread, mmap, io_uring), and their shared code. Knows neither versions nor commits.

pub mod buffer;
pub mod memory;
pub(in crate::page) mod mmap;
pub mod open;
pub mod page_engine;
#[cfg(target_os = "linux")]
pub(in crate::page) mod registered;
pub mod segment_files;
pub(in crate::page) mod short_transfers;
pub mod threaded;
#[cfg(target_os = "linux")]
pub mod uring;
