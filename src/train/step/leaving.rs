//! A page of a device tier whose slot has another payload already, and whose frame is still to be filled.
//!
//! Not here: how pages leave, and how their frames are filled (`device_leaving`).
//!
//! Invariant: the bytes of the page exist in the copy back that is under way, and nowhere else.

use crate::base::ids::PageNo;
use crate::paging::pinned::PinnedPage;
use crate::render::pages::DeviceSlot;

/// A page that is leaving.
#[derive(Debug)]
pub(super) struct Leaving {
    pub page: PageNo,
    /// The slot that is copied back.
    pub slot: DeviceSlot,
    /// The step that was submitted last when the copy back began.
    pub behind: u32,
    /// `None` while a step in flight, or the batch of a step, has the page.
    pub pinned: Option<PinnedPage>,
}
