//! Logs of a run: metrics, progress on the terminal, facts about a finished run.
//!
//! Not here: results (`run::run_folder`), pictures and pages of the report ([`crate::report`]).

pub mod facts;
pub mod progress;
pub mod report;
