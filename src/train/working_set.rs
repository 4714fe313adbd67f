//! The rows that a view needs, on their way through a step.

use crate::render::Gradients;
use crate::scene::columns::Columns;

/// The rows that a view needs, evaluated at its step, and their gradients; kept between steps for its allocations.
#[derive(Default)]
pub struct WorkingSet {
    /// Row of the pinned pages, numbered through, for each row of the working set, ascending.
    pub row_from_working: Vec<u32>,
    /// Values now; the renderer reads them, and the update goes on from them.
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
