//! Commits of a run: when, to which folder, and what happens on a full drive.

pub mod checkpoint;
pub mod results;
