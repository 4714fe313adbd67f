//! The target of an export: a file in some format that takes rows in parts.
//!
//! Not here: the formats, which rows are exported.

use super::frames::{ExportRow, ExportRows};
use super::meta::ExportFrame;
use crate::base::error::{InputError, InputResult};
use crate::scene::columns::Columns;
use std::path::{Path, PathBuf};

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

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Written {
    /// `Local` instead of a requested `Dataset` if f32 cannot hold the offset. Tell the user.
    pub frame: ExportFrame,
    pub rows: u64,
    /// Rows left out because a value was not finite, or is none that the format can hold.
    pub skipped: u64,
    pub bytes: u64,
    /// Rows by level, if the format has levels.
    pub levels: Option<LevelCounts>,
    /// What the format changes of these rows. Tell the user.
    pub warnings: Vec<String>,
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

/// A file of Gaussians that is being written. Dropping a sink leaves the target as it was.
pub trait GaussianSink {
    /// Appends rows of the local frame; ones with values that are not finite are left out and counted.
    /// Errors: the disk fails, or there are more rows or bands than were announced.
    fn write(&mut self, columns: &Columns) -> InputResult<()>;

    /// Makes the file appear at its target, complete and synced.
    /// Errors: the disk fails, or no row is finite. The target then stays unchanged.
    fn finish(self: Box<Self>) -> InputResult<Written>;
}

pub(super) trait Format {
    /// Takes a row in the frame of the file; false if no file of this format can hold it.
    fn put(&mut self, row: &ExportRow) -> InputResult<bool>;

    /// Completes the file of at least one row; returns its bytes, and the rows of its levels.
    fn complete(self) -> InputResult<(u64, Option<LevelCounts>)>;

    /// What the format changes of the rows that it was given, for people.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }

    /// The error, if the format could hold none of the `given` rows.
    fn holds_none(&self, _given: u64) -> Option<InputError> {
        None
    }
}

/// The sink of a format: [`ExportRows`] says how values change on the way.
pub struct FormatSink<F> {
    path: PathBuf,
    sh_degree: u8,
    to_file: ExportRows,
    given: u64,
    rows: u64,
    format: F,
}

impl<F> FormatSink<F> {
    pub(super) fn new(path: &Path, sh_degree: u8, to_file: ExportRows, format: F) -> FormatSink<F> {
        FormatSink { path: path.to_path_buf(), sh_degree, to_file, given: 0, rows: 0, format }
    }
}

impl<F: Format> GaussianSink for FormatSink<F> {
    fn write(&mut self, columns: &Columns) -> InputResult<()> {
        if columns.sh_degree > self.sh_degree {
            return Err(InputError::new(&self.path, "rows have more SH bands than announced", "report this as a bug"));
        }
        for row in 0..columns.rows() {
            self.given += 1;
            if let Some(row) = self.to_file.row(columns, row) {
                self.rows += u64::from(self.format.put(&row)?);
            }
        }
        Ok(())
    }

    fn finish(self: Box<Self>) -> InputResult<Written> {
        let FormatSink { path, to_file, given, rows, format, .. } = *self;
        if rows == 0 {
            return Err(format.holds_none(given).unwrap_or_else(|| {
                let problem = format!("none of the {given} Gaussians is finite, so there is no row to write");
                InputError::new(path, problem, "the training diverged or lost all Gaussians: leave out flags of rates")
            }));
        }
        let warnings = format.warnings().into_iter().map(|problem| format!("{}: {problem}", path.display())).collect();
        let (bytes, levels) = format.complete()?;
        Ok(Written { frame: to_file.frame(), rows, skipped: given - rows, bytes, levels, warnings })
    }
}
