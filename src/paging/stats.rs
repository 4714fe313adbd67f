//! What a pager did so far, and how full its store is.

/// Totals since the pager was made, or since the run began that it goes on with ([`super::pager::Pager::count_on`]);
/// subtract two of them for one step.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PagerStats {
    /// Bytes read from the store.
    pub bytes_read: u64,
    /// Bytes written to the store.
    pub bytes_written: u64,
    /// Pages read from the store.
    pub pages_read: u64,
    /// Pages written to the store.
    pub pages_written: u64,
    /// Pages that steps asked for.
    pub pages_needed: u64,
    /// Of these, pages that lay in memory.
    pub hits: u64,
    /// Of these, pages that did not: on their way, or still to be read.
    pub misses: u64,
    /// Of the misses, those that were not even on their way.
    pub absent: u64,
    /// Of the misses, those that the plan of a planned step had left out.
    pub late_misses: u64,
    /// Pages that lost their frame.
    pub evictions: u64,
    /// Seconds that steps waited for the store, commits between them included.
    pub stall_seconds: f64,
    /// Seconds that steps lost to commits beside them: waited for frozen pages, or spent on writing them.
    pub commit_seconds: f64,
    /// Pages that all others asked for: evaluation, export, looking at views before the first step.
    pub other_pages_needed: u64,
    /// Bytes that were read for them.
    pub other_bytes_read: u64,
    /// Seconds that they and the import waited for the store.
    pub other_stall_seconds: f64,
    /// Bytes that steps would have made a cache of this size read that knows the future
    /// ([`crate::paging::plan::bound::FewestReads`]).
    pub belady_bytes_read: u64,
    /// The most pages pinned at once.
    pub pinned_max: usize,
    /// Frames in use now, and the most that there may be (`usize::MAX` for as many as needed).
    pub frames: usize,
    /// See `frames`.
    pub frames_max: usize,
}

/// Slots of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotSpace {
    /// All.
    pub total: u64,
    /// Those that may be written at once.
    pub free: u64,
    /// Those with past versions, which commits make free.
    pub retired: u64,
    /// What the drive must have for more of them.
    pub segment_bytes: u64,
}
