//! Logs of a run: metrics, progress on the terminal.
//!
//! Not here: results (`run::run_folder`), pictures and pages of the report ([`crate::report`]).

pub mod progress;
pub mod report;
