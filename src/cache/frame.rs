//! One frame: the place in host memory of one page.
//!
//! Invariant: a frame has its buffer exactly when it is free or resident; otherwise somebody else holds it: the store
//! (loading, writing) or the caller (pinned, lent), or it was given back to the system (retired).

use super::evict::NEVER;
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;

/// What a frame is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameState {
    /// Holds no page.
    Free,
    /// Taken for a page that does not have a number yet; the buffer is with the caller.
    Lent,
    /// The store fills the buffer.
    Loading,
    /// Holds a page that can be pinned, written or evicted.
    Resident,
    /// The page's buffer is with the caller.
    Pinned,
    /// The store writes the buffer; the page is free for nothing else meanwhile.
    Writing,
    /// Has no memory: it was taken away, and may be given back.
    Retired,
}

impl FrameState {
    /// How many there are.
    pub(super) const COUNT: usize = FrameState::Retired as usize + 1;
}

/// A frame and what the cache knows of its page.
#[derive(Debug)]
pub(super) struct Frame {
    pub state: FrameState,
    /// The page; meaningless for free, lent and retired frames.
    pub page: PageNo,
    /// Whether the page differs from what the store holds.
    pub dirty: bool,
    /// Next step that is known to need the page.
    pub next_use: u32,
    /// Clock of the last pin.
    pub last_use: u32,
    pub buffer: Option<PageBuffer>,
}

impl Frame {
    pub fn lent() -> Frame {
        Frame { state: FrameState::Lent, page: PageNo(0), dirty: false, next_use: NEVER, last_use: 0, buffer: None }
    }
}
