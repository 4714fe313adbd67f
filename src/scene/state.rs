//! The trainable state of rows: values, moments, stamps, identities, statistics.
//!
//! Invariants: 1. every vector has one entry (or one column width) per row; 2. `columns` is the value that the last
//! update left, not the value now: [`crate::optim::deferred`] evaluates what it is now; 3. a row is rewritten whole.

use super::columns::Columns;

/// Rows with all that training keeps of them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SceneState {
    /// Values after the last update of each row.
    pub columns: Columns,
    /// First moments after it, without bias correction.
    pub exp_avg: Columns,
    /// Second moments after it.
    pub exp_avg_sq: Columns,
    /// Number of optimizer steps already contained in the row: a row that was updated in 0-based step s holds s + 1.
    pub stamp: Vec<u32>,
    /// Identity that survives moves: the initial index, then a hash of (parent, event, child).
    pub uid: Vec<u64>,
    /// Sum of the norms of the screen-space mean gradients (NDC units) since the last round.
    pub grad2d: Vec<f32>,
    /// Views that drew the row since the last round.
    pub count: Vec<u32>,
}
