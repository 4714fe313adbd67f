//! The working set: the rows of one view and their gradients during a step.

use crate::render::Gradients;
use crate::scene::columns::Columns;

/// The rows of a view, evaluated at one step, and their gradients. Steps reuse one working set and its allocations.
#[derive(Default)]
pub struct WorkingSet {
    /// For each row of the working set, its row number in the pinned pages (consecutive across pages); ascending.
    pub row_from_working: Vec<u32>,
    /// Values at this step; input of the renderer and of the update.
    pub columns: Columns,
    /// Gradients of the step.
    pub gradients: Gradients,
}

impl WorkingSet {
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let columns = self.columns.bytes() + self.gradients.columns.bytes();
        self.row_from_working.capacity() * 4 + columns + self.gradients.means2d.capacity() * 16
    }
}
