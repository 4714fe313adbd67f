//! The state of a training run and what reads it between steps: the trainer, the turns of views, memory, evaluation, and how many
//! Gaussians the scene needs.

pub mod eval;
mod growth_checks;
pub(crate) mod run_memory;
pub mod trainer;
pub(crate) mod turns;
