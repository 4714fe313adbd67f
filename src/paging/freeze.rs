//! Commits beside training: the pages as they are between two steps, written while the following steps go on.
//!
//! A cut freezes every page that differs from what the store holds. Frozen pages are written little by little, those
//! that are needed next first; a step that needs one earlier waits until it is written, since it may change it. So a
//! commit costs the steps after it a part of their pages at most, not all that memory holds.
//!
//! Invariants: 1. a frozen page is never pinned, so what is written is what it was at the cut; 2. it is written for the
//! generation of the cut, and everything else for the next one; 3. when a write fails, the cut is given up: what it has
//! written are versions like others, and the commit before it stands.

use super::commit::{WRITES_IN_FLIGHT, nowhere};
use super::error::PagingError;
use super::fetch::Asker;
use super::label::label;
use super::pager::Pager;
use super::transfers::Failure;
use crate::base::ids::{PageId, PageNo};
use crate::page::format::slot_header::SlotRef;
use crate::page::map::commit::{CommitError, Commits, Cut, PageChange};
use crate::paging::frames::frame::FrameState;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Instant;

/// Frozen pages that are written at once at least, however little may be read ahead.
const FROZEN_WRITES_LEAST: usize = 8;

/// A cut whose pages are being written.
#[derive(Debug, Default)]
pub(super) struct Frozen {
    pub generation: u64,
    /// Pages that are still to be written.
    waiting: BTreeSet<PageNo>,
    /// The same in the order of their next use; some may be written by now.
    order: VecDeque<PageNo>,
    /// Pages that are being written.
    writing: BTreeSet<PageNo>,
    /// What differs from the last commit, as far as it is written.
    changes: Vec<PageChange>,
    /// Pages of the cut that are written, with the generations of their versions.
    now: BTreeMap<PageId, u64>,
    /// Bytes written for the cut.
    bytes: u64,
    /// A page with rows that is nowhere: the cut cannot be committed.
    nowhere: Option<PageId>,
}

impl Frozen {
    /// A write of a page begins: whether it is the one that the cut waits for.
    pub fn begin_write(&mut self, page: PageNo) -> bool {
        let is_ours = self.waiting.remove(&page);
        is_ours && self.writing.insert(page)
    }

    /// A write of page number `page` ended with this version: whether it was the cut's.
    pub fn end_write(&mut self, page: PageNo, id: PageId, slot: SlotRef, label: &[u8]) -> bool {
        let is_ours = self.writing.remove(&page);
        if is_ours {
            self.bytes += slot.transfer_bytes() as u64;
            self.now.insert(id, slot.generation);
            self.changes.push(PageChange { page: id, version: Some((slot, label.to_vec())) });
        }
        is_ours
    }

    /// Whether one of these pages is being written for the cut.
    pub fn delays(&self, mut pages: impl Iterator<Item = PageNo>) -> bool {
        pages.any(|page| self.writing.contains(&page))
    }
}

impl Pager {
    /// Freezes the pages as they are: between steps, no page is pinned. An earlier cut that was not committed is given
    /// up. Nothing is frozen without a store.
    ///
    /// # Errors
    /// A write that ended meanwhile had failed.
    pub fn freeze(&mut self) -> Result<(), PagingError> {
        debug_assert_eq!(self.frames.count(FrameState::Pinned), 0, "a step holds pages");
        self.thaw();
        if let Some(Failure { error, .. }) = self.settle(false, &mut Vec::new()).into_iter().find(|f| f.is_write) {
            return Err(error);
        }
        let Some(store) = &mut self.store else { return Ok(()) };
        let mut frozen = Frozen { generation: store.cut(), ..Frozen::default() };
        for (page, (meta, slot)) in (0..).map(PageNo).zip(self.index.iter().zip(&self.slots)) {
            if meta.rows == 0 {
                continue;
            }
            match (slot, self.frames.state(page)) {
                (_, Some(FrameState::Writing)) => {
                    frozen.writing.insert(page);
                }
                (_, Some(_)) if self.frames.is_dirty(page) => {
                    frozen.waiting.insert(page);
                }
                (Some(slot), _) => {
                    frozen.now.insert(meta.id, slot.generation);
                    if self.committed.get(&meta.id) != Some(&slot.generation) {
                        frozen.changes.push(PageChange { page: meta.id, version: Some((*slot, label(meta).to_vec())) });
                    }
                }
                (None, _) => frozen.nowhere = Some(meta.id),
            }
        }
        let held = self.frames.held().filter(|(_, held)| frozen.waiting.contains(&held.page));
        let mut order: Vec<(u32, PageNo)> = held.map(|(_, held)| (held.next_use, held.page)).collect();
        order.sort_unstable();
        frozen.order = order.into_iter().map(|(_, page)| page).collect();
        self.frozen = Some(frozen);
        Ok(())
    }

    /// Gives up a cut that is not committed.
    pub fn thaw(&mut self) {
        self.frozen = None;
    }

    /// Whether there is a cut that is not committed yet; a failed write has given it up.
    pub fn is_frozen(&self) -> bool {
        self.frozen.is_some()
    }

    /// Whether a page must be written before it is pinned.
    pub(super) fn holds_frozen(&self, page: PageNo) -> bool {
        self.frozen.as_ref().is_some_and(|f| f.waiting.contains(&page))
    }

    /// Whether the write of a frozen page may begin because a step waits for it.
    pub(super) fn may_write_frozen(&self, page: PageNo) -> bool {
        self.frozen.as_ref().is_some_and(|f| f.waiting.contains(&page) && f.writing.len() < WRITES_IN_FLIGHT)
            && self.has_staging()
            && self.frames.state(page) == Some(FrameState::Resident)
    }

    /// Whether every page of the cut is written.
    pub fn is_frozen_written(&self) -> bool {
        self.frozen.as_ref().is_some_and(|f| f.waiting.is_empty() && f.writing.is_empty())
    }

    /// Begins writes of frozen pages, as many as may be in flight ahead of other work; never blocks.
    pub fn write_frozen(&mut self) {
        let most = (self.config.prefetch_bytes / 2 / self.config.frame_bytes()).max(FROZEN_WRITES_LEAST);
        let started = Instant::now();
        while !self.writes_stopped
            && self.has_staging()
            && let Some(frozen) = self.frozen.as_mut().filter(|f| f.writing.len() < most)
            && let Some(page) = frozen.order.pop_front()
        {
            // One that was evicted or needed early is written by now.
            if frozen.waiting.contains(&page)
                && let Err(Failure { error, .. }) = self.begin_write(page, true)
            {
                // The next step gets the error.
                let _ = self.stop_writes(error, Asker::Other);
            }
        }
        if self.frozen.is_some() {
            self.commit_seconds += started.elapsed().as_secs_f64();
        }
    }

    /// Writes what is left of the cut, and waits until nothing is in flight.
    ///
    /// # Errors
    /// A page could not be written: the cut is given up.
    pub fn finish_frozen(&mut self) -> Result<(), PagingError> {
        while let Some(page) = self.frozen.as_mut().and_then(|f| f.order.pop_front()) {
            if self.frozen.as_ref().is_some_and(|f| f.waiting.contains(&page)) {
                self.settle_below(WRITES_IN_FLIGHT)?;
                self.begin_write(page, false).map_err(|f| f.error)?;
            }
        }
        self.settle_below(1)
    }

    /// Commits the cut, right after [`Pager::finish_frozen`]; returns its generation and the bytes that were written for
    /// it, `None` where nothing is frozen.
    ///
    /// # Errors
    /// As [`Commits::commit`]: the cut is given up.
    pub fn commit_frozen(
        &mut self,
        commits: &mut Commits,
        run_state: &[u8],
        note: &[u8],
    ) -> Result<Option<(u64, u64)>, CommitError> {
        debug_assert!(self.in_flight() == 0, "a commit comes after its writes");
        let Some(frozen) = self.frozen.take() else { return Ok(None) };
        let Frozen { generation, mut changes, now, bytes, nowhere: lost, .. } = frozen;
        if let Some(page) = lost {
            return Err(nowhere(page));
        }
        changes.extend(self.gone_from(&now));
        let Some(store) = &mut self.store else { return Ok(None) };
        let cut = Cut { changes: &changes, run_state, note, pin: None };
        let result = commits.commit_cut(store, &mut Vec::new(), generation, &cut);
        self.end_commit(now, result).map(|generation| Some((generation, bytes)))
    }
}
