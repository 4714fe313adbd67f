//! The folder of a store: creation, checks, lock, clean-up; and the drive that the folder is on: its kind, its speed.

pub mod file_system;
pub mod measure;
pub mod protocol_files;
pub mod spill_dir;
