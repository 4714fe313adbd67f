//! The folder of a store: made, checked, locked, cleaned up.

pub mod file_system;
pub mod protocol_files;
pub mod spill_dir;
pub mod uncommitted;
