//! Cuts: which pages the last commit names, and the pages of a commit that is being written beside training.
//!
//! A cut freezes every page that differs from what the store holds. Frozen pages are written little by little, those
//! that are needed next first. A step that needs a frozen page earlier waits until the page is written, since the step may change
//! it. So a commit costs the steps after it a part of their pages at most, not all that memory holds.
//!
//! Not here: the writes themselves (`tier`), and the calls of the trainer (`pager`).
//!
//! Invariants: 1. a page is written for the generation of the cut as it was at the cut, and everything else for the next
//! generation; 2. only an acknowledged commit counts as the last one, but pages of commits that were not acknowledged are taken
//! away by the next commit if they are gone by then; 3. a cut that is given up leaves versions like others, and the commit before
//! it stands.

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
    frozen: Option<Frozen>,
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

    /// Gives up a cut that is not committed.
    pub fn abort(&mut self) {
        self.frozen = None;
    }

    /// Takes the cut out, to commit it.
    pub fn take(&mut self) -> Option<Frozen> {
        self.frozen.take()
    }

    /// Whether there is a cut that is not committed.
    pub fn is_frozen(&self) -> bool {
        self.frozen.is_some()
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
    ///
    /// # Errors
    /// A page with rows was never written.
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

    /// Pages that the drive may hold as the last commit and that `now` has not.
    pub fn removed_since<'a>(&'a self, now: &'a Versions) -> impl Iterator<Item = PageChange> + 'a {
        let not_yet_named = self.unsure.iter().filter(|page| !self.committed.contains_key(page));
        let gone = self.committed.keys().chain(not_yet_named).filter(|page| !now.contains_key(page));
        gone.map(|&page| PageChange { page, version: None::<(SlotRef, Vec<u8>)> })
    }

    /// A commit of the pages `now` ended with `result`.
    ///
    /// # Errors
    /// Those of `result`.
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

/// A page with rows of which the drive has nothing: a commit without it would take it away.
pub(super) fn nowhere(page: PageId) -> CommitError {
    CommitError::Contradiction(format!("page {page} has rows and was never written"))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::page::engine::page_engine::Place;
    use crate::page::format::slot_header::StoredAs;
    use crate::paging::frames::evict::EvictPolicy;
    use crate::scene::page_meta::PageBounds;

    fn slot(generation: u64) -> SlotRef {
        let place = Place { segment: 0, offset: 0 };
        SlotRef { place, stored_bytes: 9, payload_bytes: 9, generation, checksum: 0, codec: StoredAs::Raw }
    }

    fn named(changes: &[PageChange]) -> Vec<PageId> {
        changes.iter().map(|change| change.page).collect()
    }

    /// Four pages of which the last commit names 0 and 9, which is gone. Page 0 is as committed and on the drive alone; page 1 is
    /// written and not committed; pages 2 and 3 are dirty in memory, 3 is needed first.
    fn world() -> (Cuts, PageIndex, FrameTable<()>) {
        let (mut cuts, mut index) = (Cuts::default(), PageIndex::default());
        let mut frames = FrameTable::new(4, EvictPolicy::default());
        let bounds = PageBounds { lo: [0.0; 3], hi: [1.0; 3], sigma_max: 0.1 };
        for (number, slot) in [(0, Some(slot(1))), (1, Some(slot(2))), (2, None), (3, None)] {
            let id = PageId::initial(number);
            index.push(PageMeta { id, rows: 1, sh_degree: 0, events_applied: 0, bounds }, slot);
        }
        for (number, next_use) in [(2, 9), (3, 5)].map(|(page, next_use)| (PageNo(page), next_use)) {
            frames.lend(|| ()).unwrap();
            frames.adopt(number);
            frames.set_next_use(number, next_use);
            frames.unpin(number, (), true);
        }
        [0, 9].into_iter().for_each(|page| cuts.add_committed(PageId::initial(page), 1));
        (cuts, index, frames)
    }

    #[test]
    fn a_cut_writes_what_differs_in_the_order_of_its_need() {
        let (mut cuts, mut index, frames) = world();
        cuts.freeze(2, &index, &frames);
        assert!(cuts.is_frozen() && !cuts.is_written() && !cuts.holds(PageNo(1)));
        for page in [PageNo(3), PageNo(2)] {
            assert!(cuts.holds(page) && cuts.next_waiting() == Some(page));
            assert_eq!((cuts.begin_write(page), cuts.begin_write(page)), (Some(2), None));
            assert!(!cuts.holds(page) && cuts.delays([page].into_iter()) && cuts.writing() == 1);
            assert_eq!(cuts.end_write(page, index.meta(page), slot(2)), Some(2));
            assert_eq!(cuts.end_write(page, index.meta(page), slot(3)), None, "a later write is not the cut's");
            index.set_slot(page, Some(slot(2)));
        }
        assert!(cuts.is_written() && cuts.next_waiting().is_none());
        let Frozen { generation, mut changes, now, nowhere, .. } = cuts.take().unwrap();
        changes.extend(cuts.removed_since(&now));
        assert_eq!((generation, nowhere, now.len()), (2, None, 4));
        assert_eq!(named(&changes), [1, 3, 2, 9].map(PageId::initial));
        // A commit at once names the same pages.
        assert_eq!(named(&cuts.changes(&index).unwrap().0), [1, 2, 3, 9].map(PageId::initial));
        cuts.end_commit(now, Ok(2)).unwrap();
        assert!(cuts.changes(&index).unwrap().0.is_empty());
    }

    #[test]
    fn a_page_that_was_never_written_cannot_be_committed() {
        let (mut cuts, index, _) = world();
        assert!(cuts.changes(&index).is_err());
        let frames: FrameTable<()> = FrameTable::new(4, EvictPolicy::default());
        cuts.freeze(2, &index, &frames);
        assert_eq!(cuts.take().unwrap().nowhere, Some(PageId::initial(3)));
        cuts.freeze(2, &index, &frames);
        cuts.abort();
        assert!(!cuts.is_frozen() && !cuts.is_written());
    }
}
