//! Errors of the pager.
//!
//! Invariant: after an error the failed call has no page pinned, no buffer is lost, and every page that was in
//! memory is still in memory: a run can stop cleanly and write its pages.

use crate::base::ids::PageId;
use crate::base::units::format_bytes;
use crate::page::versions::page_error::PageError;

/// Why the pager could not provide pages.
#[derive(Debug, thiserror::Error)]
pub enum PagingError {
    /// A working set is larger than the frames.
    #[error(
        "{what} needs {pages} pages in memory at once ({}), but there are {frames} frames ({})\n  remedy: a larger \
         --host-mem or --frames (at least {pages}), or in a new run smaller --page-rows or --max-gaussians; a lower resolution hardly helps",
        format_bytes(*pages as u64 * *frame_bytes as u64),
        format_bytes(*frames as u64 * *frame_bytes as u64)
    )]
    WorkingSet {
        /// Who asked: `the view of step 17`, `a list of pages`.
        what: String,
        /// Pages needed at once, at least.
        pages: usize,
        frames: usize,
        frame_bytes: usize,
    },
    /// No room on the drive for pages that a step will write back.
    #[error("making room for {pages} pages failed: {source}")]
    Room {
        pages: u64,
        /// What the store said.
        source: PageError,
    },
    #[error("{doing} page {page} failed: {source}")]
    Store {
        page: PageId,
        /// `reading` or `writing`.
        doing: &'static str,
        /// What the store said.
        source: PageError,
    },
}

impl PagingError {
    /// Whether it is only space on the drive that is missing: the same call may work later.
    pub fn is_out_of_space(&self) -> bool {
        match self {
            PagingError::Store { source, .. } | PagingError::Room { source, .. } => source.is_out_of_space(),
            PagingError::WorkingSet { .. } => false,
        }
    }
}
