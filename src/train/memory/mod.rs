//! Memory by part: the estimate of a run, the budget of frames, staging, the largest view, an evaluation.
//!
//! Not here: whether a run fits (`preflight`).

pub mod budget;
pub mod estimate;
pub(crate) mod eval_needs;
pub(crate) mod largest_view;
pub mod staging;
