//! The target of an export: a file in some format that takes rows in parts.
//!
//! Not here: the formats, which rows are exported.

use super::meta::ExportFrame;
use crate::base::error::{InputError, InputResult};
use crate::scene::columns::Columns;
use std::path::Path;

/// Most levels of detail of a format.
pub const LEVELS_MAX: usize = 4;

/// Rows of a format with levels of detail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LevelCounts {
    /// Of each level, the finest first.
    pub rows: [u64; LEVELS_MAX],
    /// Of giants, which viewers show beside any level.
    pub always_shown: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Written {
    /// `Local` instead of a requested `Dataset` if f32 cannot hold the offset. Tell the user.
    pub frame: ExportFrame,
    pub rows: u64,
    /// Number of rows left out because a value was not finite.
    pub skipped: u64,
    pub bytes: u64,
    /// Rows by level, if the format has levels.
    pub levels: Option<LevelCounts>,
}

impl std::fmt::Display for LevelCounts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let levels: Vec<String> = self.rows.iter().map(u64::to_string).collect();
        write!(f, "levels of {} Gaussians", levels.join(", "))?;
        if self.always_shown > 0 {
            write!(f, ", and {} giants that are always shown", self.always_shown)?;
        }
        Ok(())
    }
}

/// The error of a sink without rows, of the `given` ones.
pub(super) fn no_finite_row(path: &Path, given: u64) -> InputError {
    let problem = format!("none of the {given} Gaussians is finite, so there is no row to write");
    InputError::new(path, problem, "the training diverged or lost all Gaussians: lower the rates")
}

/// A file of Gaussians that is being written. Dropping a sink leaves the target as it was.
pub trait GaussianSink {
    /// Appends rows of the local frame; ones with values that are not finite are left out and counted.
    /// Errors: the disk fails, or there are more rows or bands than were announced.
    fn write(&mut self, columns: &Columns) -> InputResult<()>;

    /// Makes the file appear at its target, complete and synced.
    /// Errors: the disk fails, or no row is finite. The target then stays unchanged.
    fn finish(self: Box<Self>) -> InputResult<Written>;
}
