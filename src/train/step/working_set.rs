//! The working set: the rows of one batch of a view and their gradients during a step.

use crate::render::Gradients;
use crate::scene::columns::{Columns, row_width};

/// The rows of a batch, evaluated at one step, and their gradients. Steps reuse one working set and its allocations.
#[derive(Default)]
pub struct WorkingSet {
    /// For each row of the working set, its row number in the pinned pages (consecutive across pages); ascending. Empty for rows that
    /// [`super::pages::PagedScene::gather_pages`] has gathered, since their pages are not pinned.
    pub row_from_working: Vec<u32>,
    /// Values at this step; input of the renderer and of the update.
    pub columns: Columns,
    /// Gradients of the step.
    pub gradients: Gradients,
}

impl WorkingSet {
    /// Bytes held for rows.
    pub fn bytes(&self) -> usize {
        let columns = self.columns.bytes() + self.gradients.columns.bytes();
        self.row_from_working.capacity() * 4 + columns + self.gradients.means2d.capacity() * 16
    }

    /// Bytes of one row that is stored with `sh_degree`: its number, values, gradients, and the footprint's gradient and radii.
    pub fn row_bytes(sh_degree: u8) -> usize {
        4 + 2 * 4 * row_width(sh_degree) + 16
    }

    /// Frees the memory of a working set that has room for many more than `rows` rows. Returns whether it did.
    pub fn shrink_to(&mut self, rows: usize) -> bool {
        let is_large = self.row_from_working.capacity() > rows + rows / 4;
        if is_large {
            *self = WorkingSet::default();
        }
        is_large
    }
}
