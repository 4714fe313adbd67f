//! Commits of a run: when, to which folder, and what happens on a full drive.

pub mod checkpoint;
pub(crate) mod first_commit;
pub(crate) mod results_wait;
pub mod save;
