//! Errors of training, commits, resume and checkpoint tools.
//!
//! This file uses no other file of the module, so that all others can use it.

use crate::base::error::InputError;
use crate::base::units::MIB;
use crate::gpu::GpuError;
use crate::page::map::commit::CommitError;
use crate::paging::error::PagingError;
use crate::render::RenderError;
use crate::scene::page_split::SplitTooDeep;

/// Error that ends a run.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    #[error(transparent)]
    Input(#[from] InputError),
    /// A photo cannot be read. The scene is that of the last step.
    #[error(transparent)]
    Photo(InputError),
    #[error("rendering failed: {0}{remedy}", remedy = .0.remedy().map_or(String::new(), |r| format!("\n  remedy: {r}")))]
    Render(#[from] RenderError),
    /// Pages could not be pinned or stored.
    #[error(transparent)]
    Paging(#[from] PagingError),
    /// A page cannot be split.
    #[error(transparent)]
    Split(#[from] SplitTooDeep),
    /// A commit failed, or a checkpoint cannot be opened.
    #[error(transparent)]
    Commit(#[from] CommitError),
    /// The drive is full, and no space was freed in time.
    #[error(
        "the drive of {folder} is full: it needs {needed} more{kept}\n  remedy: free space on it, then continue from \
         the last commit with gsscale-train --resume and the output folder, which begins a run without commits again{elsewhere}",
        kept = .last_step.map_or(String::new(), |step| format!("; the commit after step {step} is intact"))
    )]
    DriveFull {
        /// The spill directory, or the folder of the file that found no space.
        folder: String,
        /// Bytes needed, as text.
        needed: String,
        /// Step of the last commit of this process.
        last_step: Option<u32>,
        /// What can be saved on another drive now, as text that follows the remedy; may be empty.
        elsewhere: String,
    },
    /// The scene has outgrown its frames.
    #[error("{source}")]
    Outgrown {
        source: PagingError,
        /// Least budget with which the step fits, bytes; `None` if frames do not follow from a budget.
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
    /// Loss or gradients were not finite several times in a row.
    #[error(
        "the run diverged: {problem} at step {step}, view {view}, the last of {count} such steps in a row\n  remedy: {remedy}"
    )]
    NonFinite {
        /// What is not finite.
        problem: String,
        /// The last of these steps.
        step: u32,
        view: String,
        /// Consecutive steps.
        count: u32,
        remedy: String,
    },
}

impl TrainError {
    /// An error after which the pages may hold half a step.
    pub(crate) fn torn(error: impl Into<TrainError>) -> TrainError {
        match error.into() {
            torn @ TrainError::Torn { .. } => torn,
            error => TrainError::Torn { source: Box::new(error) },
        }
    }

    /// Whether the cause is a lack of drive space, so that a later attempt may succeed.
    pub fn is_out_of_space(&self) -> bool {
        match self {
            TrainError::Commit(error) => error.is_out_of_space(),
            TrainError::Paging(error) => error.is_out_of_space(),
            TrainError::Input(error) => error.is_out_of_space(),
            _ => false,
        }
    }

    /// Whether the cause is the loss of the device, so that the run can go on once the device is back.
    pub fn is_device_lost(&self) -> bool {
        match self {
            TrainError::Render(RenderError::Device(error)) => matches!(error, GpuError::DeviceLost { .. }),
            TrainError::Torn { source } => source.is_device_lost(),
            _ => false,
        }
    }

    /// Adds the name of the view to an error about missing frames.
    pub(crate) fn with_view_name(mut self, name: &str) -> TrainError {
        if let TrainError::Paging(PagingError::WorkingSet { what, .. }) = &mut self {
            *what = format!("{what} ({name})");
        }
        self
    }

    /// Flags with which a run that lacked frames can resume; empty for other errors. They include room for more growth,
    /// since other views may outgrow the frames next.
    pub(super) fn memory_flags(&self) -> String {
        match self {
            TrainError::Outgrown { least: Some(least), .. } => {
                format!(" --host-mem {}MiB (at least {}MiB)", (least + least / 2) / MIB, least.div_ceil(MIB))
            }
            TrainError::Outgrown { source: PagingError::WorkingSet { pages, .. }, .. } => {
                format!(" --frames {pages} (at least)")
            }
            _ => String::new(),
        }
    }
}

/// Wraps an error of storing a page, so that an import can return it.
pub(crate) fn not_stored(error: &impl std::fmt::Display) -> InputError {
    InputError::new("--spill-dir", format!("a page could not be stored: {error}"), "see the cause")
}
