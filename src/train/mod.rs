//! Training: the module where all others meet. Its rooms, each of which may use those above it in the table:
//!
//! | room | task |
//! | --- | --- |
//! | [`error`] | errors of training, commits and tools |
//! | [`inputs`] | the prepared dataset, first Gaussians from files, threads and renderer of the machine |
//! | [`log`] | metrics, progress, facts |
//! | [`memory`] | the estimate by part, the budget of frames |
//! | [`step`] | one step ([`step::train_step`]) and the pages under it |
//! | [`state`] | the trainer, the plan of coming views, evaluation, how many Gaussians the scene needs |
//! | [`commits`] | when and to which folder a run commits; full drives |
//! | [`stores`] | whose a store is, opening one, and what `gsscale-ckpt` does with it |
//! | [`start`] | the first scene and the tiers |
//! | [`preflight`] | does the run fit, and what will it cost |
//! | [`run`] | [`run::begin`], the loop, resume, restart, results |
//!
//! `tests/tidy.rs` holds that neither rooms nor the files of a room form a circle.

pub mod commits;
pub mod error;
pub mod inputs;
pub mod log;
pub mod memory;
pub mod preflight;
pub mod run;
pub mod start;
pub mod state;
pub mod step;
pub mod stores;
