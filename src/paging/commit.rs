//! Commits: all pages on the drive, and what differs from the last commit; and pages back from a store that was opened.
//!
//! A commit is either done at once, between two steps ([`Pager::flush`], [`Pager::commit`]), or beside training
//! ([`Pager::freeze`] to [`Pager::commit_frozen`]; `cut` says how).
//!
//! Invariants: 1. after [`Pager::flush`] nothing is in flight and no page in memory is dirty; 2. a commit names every
//! page with rows, by exactly the version that was last released; 3. a frozen page is never pinned, so what is written is what
//! the page was at the cut; 4. when a write fails, the cut is given up; 5. entries from a store are taken over only if their slots
//! can hold what they say.

use super::cut::{Frozen, nowhere};
use super::error::PagingError;
use super::mover::WRITES_IN_FLIGHT;
use super::pager::{Pager, PagerConfig};
use super::stored::PageLimits;
use super::transfers::Failure;
use crate::base::ids::PageNo;
use crate::page::map::commit::{CommitError, Commits, Cut};
use crate::page::map::opening::StoredPage;
use crate::page::versions::paged_store::PagedStore;
use crate::paging::frames::frame::FrameState;
use std::time::Instant;

/// Frozen pages that are written at once at least, however little may be read ahead.
const FROZEN_WRITES_LEAST: usize = 8;

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
            pager.index.push(meta, Some(stored.slot));
            pager.cuts.add_committed(stored.page, stored.slot.generation);
        }
        Ok(pager)
    }

    /// Writes every dirty page back and waits until nothing is in flight. To be called between steps, when no page is pinned. A cut
    /// that is not committed is given up.
    ///
    /// # Errors
    /// A page could not be written. It is still in memory, and the call may be repeated.
    pub fn flush(&mut self) -> Result<(), PagingError> {
        debug_assert_eq!(self.frames.count(FrameState::Pinned), 0, "a step holds pages");
        self.abort_cut();
        // Pages whose write failed are still dirty: they are written again here.
        self.mover.take_failure();
        self.mover.resume_writes();
        self.wait_until_below(1)?;
        let mut dirty: Vec<PageNo> =
            self.frames.held().map(|(_, held)| held.page).filter(|&p| self.frames.is_dirty(p)).collect();
        dirty.sort_unstable();
        for page in dirty {
            self.wait_until_below(WRITES_IN_FLIGHT)?;
            self.begin_write(page, false).map_err(|f| f.error)?;
        }
        self.wait_until_below(1)
    }

    /// Waits until fewer than `most` transfers are in flight and another page may be encoded. Failed reads are ignored: the page
    /// is read when it is needed.
    pub(super) fn wait_until_below(&mut self, most: usize) -> Result<(), PagingError> {
        let mut first_error = None;
        while self.mover.in_flight() >= most || !self.mover.has_staging() {
            for Failure { is_write, error, .. } in self.collect_completions(true, &mut Vec::new()) {
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
        debug_assert!(self.mover.in_flight() == 0, "a commit comes after a flush");
        let Some(store) = self.mover.store_mut() else { return Ok(None) };
        let (changes, now) = self.cuts.changes(&self.index)?;
        let cut = Cut { changes: &changes, run_state, note, pin };
        let result = commits.commit(store, &mut Vec::new(), &cut);
        self.cuts.end_commit(now, result).map(Some)
    }

    /// Freezes the pages as they are. To be called between steps, when no page is pinned. An earlier cut that was not committed is
    /// given up. Without a store nothing is frozen.
    ///
    /// # Errors
    /// A write that ended meanwhile had failed.
    pub fn freeze(&mut self) -> Result<(), PagingError> {
        debug_assert_eq!(self.frames.count(FrameState::Pinned), 0, "a step holds pages");
        self.abort_cut();
        if let Some(Failure { error, .. }) =
            self.collect_completions(false, &mut Vec::new()).into_iter().find(|f| f.is_write)
        {
            return Err(error);
        }
        let Some(store) = self.mover.store_mut() else { return Ok(()) };
        let generation = store.cut();
        self.cuts.freeze(generation, &self.index, &self.frames);
        Ok(())
    }

    /// Gives up a cut that is not committed.
    pub fn abort_cut(&mut self) {
        self.cuts.abort();
    }

    /// Whether there is a cut that is not committed yet; a failed write has given it up.
    pub fn is_frozen(&self) -> bool {
        self.cuts.is_frozen()
    }

    /// Whether the write of a frozen page may begin because a step waits for it.
    pub(super) fn may_write_frozen(&self, page: PageNo) -> bool {
        self.cuts.holds(page)
            && self.cuts.writing() < WRITES_IN_FLIGHT
            && self.mover.has_staging()
            && self.frames.state(page) == Some(FrameState::Resident)
    }

    /// Whether every page of the cut is written.
    pub fn is_frozen_written(&self) -> bool {
        self.cuts.is_written()
    }

    /// Begins writes of frozen pages, as many as may be in flight ahead of other work; never blocks.
    pub fn write_frozen(&mut self) {
        let most = (self.config.prefetch_bytes / 2 / self.frame_bytes()).max(FROZEN_WRITES_LEAST);
        let started = Instant::now();
        while !self.mover.are_writes_stopped()
            && self.mover.has_staging()
            && self.cuts.writing() < most
            && let Some(page) = self.cuts.next_waiting()
        {
            if let Err(Failure { error, .. }) = self.begin_write(page, true) {
                // The next step gets the error.
                let _ = self.mover.stop_writes(error, false);
            }
        }
        if self.cuts.is_frozen() {
            self.counters.commit_seconds += started.elapsed().as_secs_f64();
        }
    }

    /// Writes what is left of the cut, and waits until nothing is in flight.
    ///
    /// # Errors
    /// A page could not be written: the cut is given up.
    pub fn finish_frozen(&mut self) -> Result<(), PagingError> {
        while let Some(page) = self.cuts.next_waiting() {
            self.wait_until_below(WRITES_IN_FLIGHT)?;
            self.begin_write(page, false).map_err(|f| f.error)?;
        }
        self.wait_until_below(1)
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
        debug_assert!(self.mover.in_flight() == 0, "a commit comes after its writes");
        let Some(frozen) = self.cuts.take() else { return Ok(None) };
        let Frozen { generation, mut changes, now, bytes, nowhere: lost, .. } = frozen;
        if let Some(page) = lost {
            return Err(nowhere(page));
        }
        changes.extend(self.cuts.removed_since(&now));
        let Some(store) = self.mover.store_mut() else { return Ok(None) };
        let cut = Cut { changes: &changes, run_state, note, pin: None };
        let result = commits.commit_cut(store, &mut Vec::new(), generation, &cut);
        self.cuts.end_commit(now, result).map(|generation| Some((generation, bytes)))
    }
}
