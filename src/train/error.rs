//! What can end a run early: every way in which training, commits, resume and the tools on checkpoints fail.
//!
//! Knows no state of a run, so that every file of the room may name it.

use crate::base::error::InputError;
use crate::page::map::commit::CommitError;
use crate::paging::error::PagingError;
use crate::render::RenderError;
use crate::scene::page_split::SplitTooDeep;

/// What can end a run early.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// Something that the user gave.
    #[error(transparent)]
    Input(#[from] InputError),
    /// The renderer.
    #[error("rendering failed: {0}{remedy}", remedy = .0.remedy().map_or(String::new(), |r| format!("\n  remedy: {r}")))]
    Render(#[from] RenderError),
    /// Pages could not be had.
    #[error(transparent)]
    Paging(#[from] PagingError),
    /// A page cannot be split.
    #[error(transparent)]
    Split(#[from] SplitTooDeep),
    /// A commit failed, or a checkpoint cannot be opened.
    #[error(transparent)]
    Commit(#[from] CommitError),
    /// The drive is full, and nobody freed space in time.
    #[error(
        "the drive of {folder} is full: it needs {needed} more{stands}\n  remedy: free space on it, then go on from the last \
         commit with gsscale-train --resume and the output folder; a run that committed nothing starts again with --overwrite",
        stands = .last_step.map_or(String::new(), |step| format!("; the commit after step {step} stands"))
    )]
    DriveFull {
        /// The spill directory, or that of the file that found no space.
        folder: String,
        /// Bytes, for people.
        needed: String,
        /// Step of the last commit of this process.
        last_step: Option<u32>,
    },
    /// The scene has outgrown its frames.
    #[error("{source}")]
    Outgrown {
        /// Who needed how many.
        source: PagingError,
        /// Memory with which the step could have been done, where frames follow from it.
        least: Option<u64>,
    },
    /// A step failed after it had updated some of the batches of its view.
    #[error(
        "{source}\n  the step had updated a part of its view, so what is in memory is not committed: go on from the last commit with \
         gsscale-train --resume and the output folder, once the cause is mended"
    )]
    Torn {
        /// What failed.
        source: Box<TrainError>,
    },
    /// The loss was not finite several times in a row.
    #[error("the loss of view {view} was not finite at step {step}, {count} steps in a row\n  remedy: {remedy}")]
    NonFinite {
        /// Last of the steps.
        step: u32,
        /// View of that step.
        view: String,
        /// How many in a row.
        count: u32,
        /// What to do.
        remedy: &'static str,
    },
}

/// The error of a page that could not be stored, on its way through an import.
pub(super) fn not_stored(error: &impl std::fmt::Display) -> InputError {
    InputError::new("--spill-dir", format!("a page could not be stored: {error}"), "see the cause")
}
