//! Stands for `device_memory` in a program without the feature `gpu`: there is no device whose memory could be too small.

use super::error::TrainError;
use super::memory::MemoryEstimate;
use super::pages::PagedScene;
use crate::base::error::InputResult;
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;

/// Nothing to check.
pub(super) fn check(_: &TrainConfig, _: &[MemoryEstimate; 3]) -> InputResult<()> {
    Ok(())
}

/// The error as it is.
pub(super) fn refusal(error: TrainError, _: &TrainConfig, _: &Dataset, _: &PagedScene, _: &[usize]) -> TrainError {
    error
}

/// Nothing to say.
pub(super) fn describe(_: &TrainConfig, _: &MemoryEstimate) -> String {
    String::new()
}
