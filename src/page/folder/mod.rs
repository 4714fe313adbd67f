//! The folder of a store: creation, checks, lock, clean-up.

pub mod file_system;
pub mod protocol_files;
pub mod spill_dir;
pub mod uncommitted;
