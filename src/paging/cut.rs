//! Cuts: which pages the last commit names, and the pages of a commit that is being written beside training.
//!
//! A cut freezes every page that differs from what the store holds. Frozen pages are written little by little, in the
//! order of their next use. A step that needs a frozen page waits for the write of the page, since the step may change
//! the page. So a step waits at most for frozen pages of its own view, never for all pages in memory.
//!
//! Not here: the writes themselves (`tier`), and the calls of the trainer (`pager`).
//!
//! Invariants: 1. a page is written for the generation of the cut as it was at the cut, and everything else for the next
//! generation; 2. only an acknowledged commit counts as the last one. A commit that failed may be durable, so the next
//! commit also removes the pages of the failed one that no longer exist; 3. the versions of a cut that is given up stay
//! usable, and the commit before the cut stands.

use super::frames::table::{FrameState, FrameTable};
use super::index::PageIndex;
use super::stored::label;
use crate::base::ids::{PageId, PageNo};
use crate::page::format::slot_header::SlotRef;
use crate::page::map::commit::{CommitError, PageChange};
use crate::scene::page_meta::PageMeta;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Pages with the generations of their versions.
pub(super) type Versions = BTreeMap<PageId, u64>;

/// The pages of the last commit, and a cut that is being written.
#[derive(Debug, Default)]
pub(super) struct Cuts {
    /// Pages of the last acknowledged commit.
    committed: Versions,
    /// Pages of later commits that were not acknowledged. Such a commit may be durable all the same, and the next one starts
    /// from it.
    unsure: BTreeSet<PageId>,
    /// The cut that is not committed yet.
    pub frozen: Option<Frozen>,
}

/// A cut whose pages are being written.
#[derive(Debug, Default)]
pub(super) struct Frozen {
    pub generation: u64,
    /// Pages that are still to be written.
    waiting: BTreeSet<PageNo>,
    /// The same pages in the order of their next use; some may be written by now.
    order: VecDeque<PageNo>,
    /// Pages that are being written.
    writing: BTreeSet<PageNo>,
    /// What differs from the last commit, as far as it is written.
    pub changes: Vec<PageChange>,
    /// Pages of the cut that are written.
    pub now: Versions,
    /// Bytes written for the cut.
    pub bytes: u64,
    /// A page with rows that is nowhere: the cut cannot be committed.
    pub nowhere: Option<PageId>,
}

impl Cuts {
    /// A page that the store's last commit names.
    pub fn add_committed(&mut self, page: PageId, generation: u64) {
        self.committed.insert(page, generation);
    }

    /// Freezes the pages as they are, for `generation`; an earlier cut is given up.
    pub fn freeze<M>(&mut self, generation: u64, index: &PageIndex, frames: &FrameTable<M>) {
        let mut frozen = Frozen { generation, ..Frozen::default() };
        for (page, meta, slot) in index.with_rows() {
            match (slot, frames.state(page)) {
                (_, Some(FrameState::Writing)) => {
                    frozen.writing.insert(page);
                }
                (_, Some(_)) if frames.is_dirty(page) => {
                    frozen.waiting.insert(page);
                }
                (Some(slot), _) => {
                    frozen.now.insert(meta.id, slot.generation);
                    frozen.changes.extend(self.change(meta, slot));
                }
                (None, _) => frozen.nowhere = Some(meta.id),
            }
        }
        let held = frames.held().filter(|(_, held)| frozen.waiting.contains(&held.page));
        let mut order: Vec<(u32, PageNo)> = held.map(|(_, held)| (held.next_use, held.page)).collect();
        order.sort_unstable();
        frozen.order = order.into_iter().map(|(_, page)| page).collect();
        self.frozen = Some(frozen);
    }

    /// Whether every page of the cut is written.
    pub fn is_written(&self) -> bool {
        self.frozen.as_ref().is_some_and(|f| f.waiting.is_empty() && f.writing.is_empty())
    }

    /// Whether the cut still has to write a page before the page may be pinned.
    pub fn holds(&self, page: PageNo) -> bool {
        self.frozen.as_ref().is_some_and(|f| f.waiting.contains(&page))
    }

    /// Number of pages that are being written for the cut.
    pub fn writing(&self) -> usize {
        self.frozen.as_ref().map_or(0, |f| f.writing.len())
    }

    /// Whether one of these pages is being written for the cut.
    pub fn delays(&self, mut pages: impl Iterator<Item = PageNo>) -> bool {
        self.frozen.as_ref().is_some_and(|f| pages.any(|page| f.writing.contains(&page)))
    }

    /// The next page to write for the cut, if any is left; the caller begins its write.
    pub fn next_waiting(&mut self) -> Option<PageNo> {
        let Frozen { order, waiting, .. } = self.frozen.as_mut()?;
        // A page that was evicted or needed early is written by now.
        std::iter::from_fn(|| order.pop_front()).find(|page| waiting.contains(page))
    }

    /// The write of a page begins: the generation of the cut if the write is the cut's.
    pub fn begin_write(&mut self, page: PageNo) -> Option<u64> {
        let frozen = self.frozen.as_mut().filter(|f| f.waiting.contains(&page))?;
        frozen.waiting.remove(&page);
        frozen.writing.insert(page).then_some(frozen.generation)
    }

    /// The write of page number `page` ended with the version in `slot`: the generation of the cut if the write was the cut's.
    pub fn end_write(&mut self, page: PageNo, meta: &PageMeta, slot: SlotRef) -> Option<u64> {
        let frozen = self.frozen.as_mut().filter(|f| f.writing.contains(&page))?;
        frozen.writing.remove(&page);
        frozen.bytes += slot.transfer_bytes() as u64;
        frozen.now.insert(meta.id, slot.generation);
        frozen.changes.push(PageChange { page: meta.id, version: Some((slot, label(meta).to_vec())) });
        Some(frozen.generation)
    }

    /// What differs from the last commit, and all pages with the generations of their versions, when every page is on the drive. A
    /// page that is written again after a commit belongs to a later generation, so the number tells versions of one page apart.
    /// Errors: a page with rows was never written.
    pub fn changes(&self, index: &PageIndex) -> Result<(Vec<PageChange>, Versions), CommitError> {
        let mut changes = Vec::new();
        let mut now = Versions::new();
        for (_, meta, slot) in index.with_rows() {
            let slot = slot.ok_or_else(|| nowhere(meta.id))?;
            now.insert(meta.id, slot.generation);
            changes.extend(self.change(meta, slot));
        }
        changes.extend(self.removed_since(&now));
        Ok((changes, now))
    }

    /// Removals of the pages that the last commit on the drive may name and that `now` lacks.
    pub fn removed_since<'a>(&'a self, now: &'a Versions) -> impl Iterator<Item = PageChange> + 'a {
        let not_yet_named = self.unsure.iter().filter(|page| !self.committed.contains_key(page));
        let gone = self.committed.keys().chain(not_yet_named).filter(|page| !now.contains_key(page));
        gone.map(|&page| PageChange { page, version: None::<(SlotRef, Vec<u8>)> })
    }

    /// A commit of the pages `now` ended with `result`.
    /// Errors: those of `result`.
    pub fn end_commit(&mut self, now: Versions, result: Result<u64, CommitError>) -> Result<u64, CommitError> {
        if result.is_ok() {
            self.committed = now;
            self.unsure.clear();
        } else {
            self.unsure.extend(now.into_keys());
        }
        result
    }

    /// The change of a page whose version is not the committed one.
    fn change(&self, meta: &PageMeta, slot: SlotRef) -> Option<PageChange> {
        let is_new = self.committed.get(&meta.id) != Some(&slot.generation);
        is_new.then(|| PageChange { page: meta.id, version: Some((slot, label(meta).to_vec())) })
    }
}

/// The error of a page with rows and no version on the drive: a commit without the page would lose its rows.
pub(super) fn nowhere(page: PageId) -> CommitError {
    CommitError::Contradiction(format!("page {page} has rows and was never written"))
}
