//! A run from its request to its results: begin, the loop, resume, restart, the output folder.
//!
//! [`begin`] is the page to read first.

pub mod begin;
mod changes;
pub mod eval_file;
pub mod live;
mod more_steps;
pub mod out_folder;
pub mod request;
pub mod resume;
mod run_folder;
pub mod training_loop;
