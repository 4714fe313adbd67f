//! The state of a training run and what reads it between steps: the trainer, the plan of coming views, evaluation, and how
//! many Gaussians the scene needs.

pub mod eval;
pub mod eval_file;
mod growth_checks;
pub(crate) mod held_out;
mod in_flight;
mod leave_out;
mod look_ahead;
mod photos;
pub mod trainer;
