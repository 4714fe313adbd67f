//! Stands for `device_memory` in a program without the feature `gpu`: there is no device whose memory could be too small.

use crate::base::error::InputResult;
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::train::error::TrainError;
use crate::train::memory::MemoryEstimate;
use crate::train::step::pages::PagedScene;

/// Nothing to check.
pub(crate) fn check_device_memory(_: &TrainConfig, _: &[MemoryEstimate; 3]) -> InputResult<()> {
    Ok(())
}

pub(crate) fn refusal(error: TrainError, _: &TrainConfig, _: &Dataset, _: &PagedScene, _: &[usize]) -> TrainError {
    error
}

/// Nothing to say.
pub(crate) fn describe(_: &TrainConfig, _: &MemoryEstimate) -> String {
    String::new()
}
