//! The resident index: what memory holds of every page, even of evicted ones.
//!
//! Invariants: 1. bounds are a function of the page's stored rows and the run's configuration alone, and are recomputed
//! whenever the page is rewritten; 2. nothing here depends on caches or budgets.

use crate::base::ids::PageId;

/// Bounds of a page's rows, valid until the page is next rewritten.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PageBounds {
    /// Lower corner of the box of the means, local frame. The box includes children of rows that may split before they
    /// are seen again. Greater than `hi` for a page without rows.
    pub lo: [f32; 3],
    pub hi: [f32; 3],
    /// Largest standard deviation, for any rotation.
    pub sigma_max: f32,
}

impl PageBounds {
    /// Bounds without rows: no view sees them.
    pub const EMPTY: PageBounds = PageBounds { lo: [f32::INFINITY; 3], hi: [f32::NEG_INFINITY; 3], sigma_max: 0.0 };

    pub fn centre(&self) -> [f32; 3] {
        std::array::from_fn(|i| 0.5 * (self.lo[i] + self.hi[i]))
    }

    pub fn is_empty(&self) -> bool {
        self.lo[0] > self.hi[0]
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PageMeta {
    pub id: PageId,
    pub rows: u32,
    pub sh_degree: u8,
    /// Number of events of the log that its rows have applied.
    pub events_applied: u32,
    pub bounds: PageBounds,
}
