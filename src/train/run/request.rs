//! The request for a run, and its outcome.

use crate::config::file::TrainConfig;
use crate::report::live::Live;
use crate::train::log::report::Summary;
use std::path::PathBuf;
use std::time::Duration;

/// Treatment of an existing output folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Existing {
    /// Refuse the folder unless it is empty.
    Refuse,
    /// Remove the earlier run's results and its checkpoint in the folder.
    Overwrite,
    /// Use the folder: this run was cut off there before its first commit.
    BeginAgain,
}

#[derive(Debug, Clone)]
pub struct RunRequest {
    /// Scene folder (or transforms.json).
    pub scene: PathBuf,
    /// Output folder; empty for a forecast, which has no results.
    pub out: PathBuf,
    /// Checked config.
    pub config: TrainConfig,
    /// Print the plan and stop.
    pub dry_run: bool,
    /// Treatment of an existing output folder.
    pub existing: Existing,
    /// Print only warnings and errors.
    pub quiet: bool,
    /// The page that shows the run while it trains.
    pub live: Option<Live>,
    /// Stop when the steps have taken so long, after one at least, as a signal would ask for it.
    pub leg: Option<Duration>,
}

/// How a run ended.
#[derive(Debug, Clone)]
pub struct RunOutcome {
    /// Content of summary.json; `None` for a dry run.
    pub summary: Option<Summary>,
    /// Exit code of the process: 0, or that of the stop request.
    pub exit_code: i32,
    pub out: PathBuf,
    /// The run keeps its checkpoint after its end.
    pub keeps_checkpoint: bool,
}

impl RunOutcome {
    /// The outcome of a dry run that was to end in `out`.
    pub fn of_nothing(out: PathBuf) -> RunOutcome {
        RunOutcome { summary: None, exit_code: 0, out, keeps_checkpoint: false }
    }
}
