//! One frame: the place of one page in a tier of memory.
//!
//! Invariant: a frame has its memory exactly when it is free or resident. Otherwise somebody else has the memory: the mover
//! (loading, writing), the caller (pinned, lent), or the system (retired).

use super::evict::{Candidate, NEVER};
use crate::base::ids::PageNo;

/// What a frame is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameState {
    /// Holds no page.
    Free,
    /// Reserved for a page that has no number yet; the caller has the memory.
    Lent,
    /// The page is being read into the memory.
    Loading,
    /// Holds a page that can be pinned, written or evicted.
    Resident,
    /// The caller has the page's memory.
    Pinned,
    /// The page is being written back; it can be neither pinned nor evicted until the write ends.
    Writing,
    /// Has no memory: the memory was given back to the system, and may be allocated again.
    Retired,
}

impl FrameState {
    pub(super) const COUNT: usize = FrameState::Retired as usize + 1;
}

/// A frame and what the table knows of its page.
#[derive(Debug)]
pub(super) struct Frame<M> {
    pub state: FrameState,
    /// The page; meaningless for free, lent and retired frames.
    pub page: PageNo,
    /// Whether the page differs from its version in the tier below.
    pub dirty: bool,
    /// The next planned step that needs the page, or [`NEVER`].
    pub next_use: u32,
    /// Time of the last pin.
    pub last_use: u32,
    pub memory: Option<M>,
}

impl<M> Frame<M> {
    pub fn lent() -> Frame<M> {
        Frame { state: FrameState::Lent, page: PageNo(0), dirty: false, next_use: NEVER, last_use: 0, memory: None }
    }

    pub fn candidate(&self) -> Candidate {
        Candidate { page: self.page, next_use: self.next_use, last_use: self.last_use }
    }
}
