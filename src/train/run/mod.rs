//! A run from its request to its results: begin, the loop, resume, restart, the output folder; and the viewer of what came out.
//!
//! [`begin`] is the page to read first.

pub mod begin;
mod changes;
pub mod eval_file;
pub mod live;
pub mod model_of_run;
mod more_steps;
pub mod out_folder;
pub mod request;
pub mod resume;
mod run_folder;
mod scene_picture;
pub mod training_loop;
pub mod viewer;
