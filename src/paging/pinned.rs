//! A pinned page: its meta and the memory of its frame.
//!
//! Invariants: 1. the buffer holds space for a slot's header, then the payload that [`PinnedPage::layout`] describes;
//! 2. whoever changes rows, meta or layout sets `dirty`.

use super::stored::layout_of;
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::HEADER_BYTES;
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageMeta;
use crate::scene::rows::{Rows, RowsMut};

/// One pinned page. Goes back by [`super::pager::Pager::release`].
#[derive(Debug)]
pub struct PinnedPage {
    /// Number in the index.
    pub page: PageNo,
    /// Its entry of the index; changes are taken over at the release.
    pub meta: PageMeta,
    /// Whether it differs from what the store holds.
    pub dirty: bool,
    /// Header space and payload.
    pub buffer: PageBuffer,
}

impl PinnedPage {
    /// Layout of the payload, by the meta.
    pub fn layout(&self) -> PageLayout {
        layout_of(&self.meta)
    }

    /// The rows, numbered from `first_row` in the working set.
    pub fn rows(&self, first_row: usize) -> Rows<'_> {
        self.layout().rows(&self.buffer.as_slice()[HEADER_BYTES..], first_row)
    }

    /// The rows for change, numbered from `first_row` in the working set. Set `dirty` when one changes.
    pub fn rows_mut(&mut self, first_row: usize) -> RowsMut<'_> {
        self.layout().rows_mut(&mut self.buffer.as_mut_slice()[HEADER_BYTES..], first_row)
    }

    /// All bytes behind the header, whatever the layout uses of them: to write a page with another layout.
    pub fn payload_mut(&mut self) -> &mut [u8] {
        &mut self.buffer.as_mut_slice()[HEADER_BYTES..]
    }
}
