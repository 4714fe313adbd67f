//! What a commit needs of the pages: all of them on the drive, and which differ from those of the last commit; and pages
//! back from a store that was opened.
//!
//! Invariants: 1. after [`Pager::flush`] nothing is in flight and no page in memory is dirty; 2. a commit names every
//! page with rows, by exactly the version that was last released; 3. only an acknowledged commit counts as the last one,
//! but whatever the drive holds of those that were not acknowledged goes with the next; 4. entries from a store are taken
//! over only if their slots can hold what they say.

use super::error::PagingError;
use super::label::label;
use super::pager::{Pager, PagerConfig};
use super::stored::PageLimits;
use super::transfers::Failure;
use crate::base::ids::{PageId, PageNo};
use crate::page::format::slot_header::SlotRef;
use crate::page::map::commit::{CommitError, Commits, Cut, PageChange};
use crate::page::map::opening::StoredPage;
use crate::page::versions::paged_store::PagedStore;
use crate::paging::frames::frame::FrameState;
use std::collections::BTreeMap;

/// Writes in flight at once: each may need a buffer of its own to be encoded in.
pub(super) const WRITES_IN_FLIGHT: usize = 32;

impl Pager {
    /// A pager over a store that holds these pages, none of them in memory. `events` is the length of the event log.
    ///
    /// # Errors
    /// An entry contradicts itself or its slot.
    pub fn open(
        config: PagerConfig,
        store: PagedStore,
        pages: &[StoredPage],
        events: usize,
    ) -> Result<Pager, CommitError> {
        let mut pager = Pager::new(config, store);
        for stored in pages {
            let limits = PageLimits { page_rows: config.page_rows, sh_degree: config.sh_degree, events };
            let meta = limits
                .meta_of(stored.page, &stored.slot, &stored.label)
                .map_err(|what| CommitError::Contradiction(format!("page {}: {what}", stored.page)))?;
            pager.index.push(meta);
            pager.slots.push(Some(stored.slot));
            pager.committed.insert(stored.page, stored.slot.generation);
        }
        Ok(pager)
    }

    /// Writes every dirty page and waits until nothing is in flight. Between steps: no page is pinned. A cut that is not
    /// committed is given up.
    ///
    /// # Errors
    /// A page could not be written. It is still in memory, and the call may be repeated.
    pub fn flush(&mut self) -> Result<(), PagingError> {
        debug_assert_eq!(self.frames.count(FrameState::Pinned), 0, "a step holds pages");
        self.thaw();
        // Pages whose write failed are dirty still: what was wrong with them is tried again here.
        self.failed_write = None;
        self.writes_stopped = false;
        self.settle_below(1)?;
        let mut dirty: Vec<PageNo> =
            self.frames.held().map(|(_, held)| held.page).filter(|&p| self.frames.is_dirty(p)).collect();
        dirty.sort_unstable();
        for page in dirty {
            self.settle_below(WRITES_IN_FLIGHT)?;
            self.begin_write(page, false).map_err(|f| f.error)?;
        }
        self.settle_below(1)
    }

    /// Waits until fewer than `most` transfers are in flight and another page may be encoded. A page that could not be
    /// read ahead is read when it is needed.
    pub(super) fn settle_below(&mut self, most: usize) -> Result<(), PagingError> {
        let mut first_error = None;
        while self.in_flight() >= most || !self.has_staging() {
            for Failure { is_write, error, .. } in self.settle(true, &mut Vec::new()) {
                if is_write {
                    first_error.get_or_insert(error);
                }
            }
        }
        first_error.map_or(Ok(()), Err)
    }

    /// Commits the pages as they are, right after [`Pager::flush`], under the name `pin` if there is one; returns the
    /// generation, `None` for a pager without a store.
    ///
    /// # Errors
    /// As [`Commits::commit`].
    pub fn commit(
        &mut self,
        commits: &mut Commits,
        run_state: &[u8],
        note: &[u8],
        pin: Option<&str>,
    ) -> Result<Option<u64>, CommitError> {
        debug_assert!(self.in_flight() == 0, "a commit comes after a flush");
        if self.store.is_none() {
            return Ok(None);
        }
        let (changes, now) = self.changes()?;
        let Some(store) = &mut self.store else { return Ok(None) };
        let cut = Cut { changes: &changes, run_state, note, pin };
        let result = commits.commit(store, &mut Vec::new(), &cut);
        self.end_commit(now, result).map(Some)
    }

    /// Takes over the end of a commit of the pages `now`.
    pub(super) fn end_commit(
        &mut self,
        now: BTreeMap<PageId, u64>,
        result: Result<u64, CommitError>,
    ) -> Result<u64, CommitError> {
        if result.is_ok() {
            self.committed = now;
            self.unsure.clear();
        } else {
            self.unsure.extend(now.into_keys());
        }
        result
    }

    /// Pages that the drive may hold as the last commit and that `now` has not.
    pub(super) fn gone_from<'a>(&'a self, now: &'a BTreeMap<PageId, u64>) -> impl Iterator<Item = PageChange> + 'a {
        let not_yet_named = self.unsure.iter().filter(|page| !self.committed.contains_key(page));
        let gone = self.committed.keys().chain(not_yet_named).filter(|page| !now.contains_key(page));
        gone.map(|&page| PageChange { page, version: None::<(SlotRef, Vec<u8>)> })
    }

    /// What differs from the last commit, and all pages with the generations of their versions. A page that is written
    /// again after a commit belongs to a later generation, so the number tells versions of one page apart.
    fn changes(&self) -> Result<(Vec<PageChange>, BTreeMap<PageId, u64>), CommitError> {
        let mut changes = Vec::new();
        let mut now = BTreeMap::new();
        for (meta, slot) in self.index.iter().zip(&self.slots) {
            if meta.rows == 0 {
                continue;
            }
            let slot = slot.ok_or_else(|| nowhere(meta.id))?;
            now.insert(meta.id, slot.generation);
            if self.committed.get(&meta.id) != Some(&slot.generation) {
                changes.push(PageChange { page: meta.id, version: Some((slot, label(meta).to_vec())) });
            }
        }
        changes.extend(self.gone_from(&now));
        Ok((changes, now))
    }
}

/// A page with rows of which the drive has nothing: a commit without it would take it away.
pub(super) fn nowhere(page: PageId) -> CommitError {
    CommitError::Contradiction(format!("page {page} has rows and was never written"))
}
