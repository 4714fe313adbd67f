//! What is kept in memory of every page, resident or not.
//!
//! Invariants: 1. bounds are a function of the page's stored rows and the run's configuration alone, and are renewed
//! whenever the page is rewritten; 2. nothing here depends on caches or budgets.

use crate::base::ids::PageId;

/// Where the rows of a page can be, now and until the page is next rewritten.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PageBounds {
    /// Lower corner of the box of the means, local frame; the children of rows that may split before they are seen
    /// again are inside. Above `hi` for a page without rows.
    pub lo: [f32; 3],
    /// Upper corner.
    pub hi: [f32; 3],
    /// Largest standard deviation, any rotation.
    pub sigma_max: f32,
}

impl PageBounds {
    /// Bounds of no rows: no view sees them.
    pub const EMPTY: PageBounds = PageBounds { lo: [f32::INFINITY; 3], hi: [f32::NEG_INFINITY; 3], sigma_max: 0.0 };

    /// Whether there is nothing inside.
    pub fn is_empty(&self) -> bool {
        self.lo[0] > self.hi[0]
    }
}

/// One page of the resident index.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PageMeta {
    /// Name by lineage.
    pub id: PageId,
    /// Rows in it.
    pub rows: u32,
    /// Degree that it is stored with.
    pub sh_degree: u8,
    /// Entries of the event log that its rows contain.
    pub events_applied: u32,
    /// Where its rows can be.
    pub bounds: PageBounds,
}
