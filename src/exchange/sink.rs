//! Where exported Gaussians go: a file of some format that takes rows in parts.
//!
//! Not here: the formats, which rows are exported.

use super::meta::ExportFrame;
use crate::base::error::InputResult;
use crate::scene::columns::Columns;

/// Summary of what was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Written {
    /// Frame of the values: `Local` instead of a requested `Dataset` if f32 cannot hold the offset. Tell the user.
    pub frame: ExportFrame,
    /// Rows in the file.
    pub rows: u64,
    /// Number of rows left out because a value was not finite.
    pub skipped: u64,
    /// Bytes written.
    pub bytes: u64,
}

/// A file of Gaussians that is being written. Dropping a sink leaves the target as it was.
pub trait GaussianSink {
    /// Appends rows of the local frame; ones with values that are not finite are left out and counted.
    ///
    /// # Errors
    /// The disk fails, or there are more rows or bands than were announced.
    fn write(&mut self, columns: &Columns) -> InputResult<()>;

    /// Makes the file appear at its target, complete and synced.
    ///
    /// # Errors
    /// The disk fails, or no row is finite. The target then stays unchanged.
    fn finish(self: Box<Self>) -> InputResult<Written>;
}
