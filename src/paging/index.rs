//! The page index: the entry of every page, and the slot of its version on the drive. Grows by pages that split, never shrinks.
//!
//! Invariant: entries and slots are as many, and a page keeps its number for the life of a run.

use super::stored::layout_of;
use crate::base::ids::PageNo;
use crate::page::format::slot_header::{SlotRef, transfer_bytes};
use crate::scene::page_meta::PageMeta;

/// The pages of a scene by number.
#[derive(Debug, Default)]
pub(super) struct PageIndex {
    metas: Vec<PageMeta>,
    /// By page: the version on the drive, current or not; `None` before the first write.
    slots: Vec<Option<SlotRef>>,
}

impl PageIndex {
    /// The entries of all pages.
    pub fn metas(&self) -> &[PageMeta] {
        &self.metas
    }

    pub fn meta(&self, page: PageNo) -> &PageMeta {
        &self.metas[page.index()]
    }

    pub fn slot(&self, page: PageNo) -> Option<SlotRef> {
        self.slots[page.index()]
    }

    pub fn has_rows(&self, page: PageNo) -> bool {
        self.meta(page).rows > 0
    }

    pub fn push(&mut self, meta: PageMeta, slot: Option<SlotRef>) -> PageNo {
        self.metas.push(meta);
        self.slots.push(slot);
        PageNo(self.metas.len() as u32 - 1)
    }

    /// Replaces the entry of a page.
    pub fn set_meta(&mut self, page: PageNo, meta: PageMeta) {
        self.metas[page.index()] = meta;
    }

    /// Replaces the slot of a page; returns the slot before.
    pub fn set_slot(&mut self, page: PageNo, slot: Option<SlotRef>) -> Option<SlotRef> {
        std::mem::replace(&mut self.slots[page.index()], slot)
    }

    /// The pages with rows, with their entries and slots.
    pub fn with_rows(&self) -> impl Iterator<Item = (PageNo, &PageMeta, Option<SlotRef>)> {
        let all = (0..).map(PageNo).zip(&self.metas).zip(&self.slots);
        all.filter(|((_, meta), _)| meta.rows > 0).map(|((page, meta), slot)| (page, meta, *slot))
    }

    /// Bytes that reading a page moves; of a page without a version, the bytes that a raw one would take.
    pub fn transfer_bytes(&self, page: PageNo) -> u64 {
        let raw = || transfer_bytes(layout_of(self.meta(page)).bytes());
        self.slot(page).map_or_else(raw, |slot| slot.transfer_bytes()) as u64
    }
}
