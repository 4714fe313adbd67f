//! Brings pages into memory that are needed now.
//!
//! Invariants: 1. waits only when nothing can be started; 2. a page that is needed is pinned as soon as it is in
//! memory, so making room never takes it; 3. what was loaded ahead gives way like every other page, farthest next use
//! first, so the fewest frames that hold the working set are enough; 4. after an error nothing is pinned; 5. however many
//! pages are needed, no more of them are encoded in memory at once than [`Pager::prefetch_bytes`] tells.

use super::error::PagingError;
use super::pager::Pager;
use super::pinned::PinnedPage;
use super::transfers::{Failure, WRITES};
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::paging::frames::evict::NEVER;
use crate::paging::frames::frame::FrameState;
use std::collections::{BTreeMap, VecDeque};
use std::time::Instant;

/// Who asks for pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Asker {
    /// A training step, before it changes anything: a failed write ends the call, so that the step can be done again.
    Step,
    /// A training step that has changed rows already: uses and waits are the step's, and a failed write is left to the
    /// next step, since this one must not be done twice.
    RestOfStep,
    /// Somebody else: evaluation, export, checks.
    Other,
}

impl Asker {
    /// Whether uses, reads and waits count as a step's.
    pub fn is_step(self) -> bool {
        self != Asker::Other
    }

    /// Whether a failed write ends the call.
    pub fn minds_writes(self) -> bool {
        self == Asker::Step
    }
}

/// Pages on their way to a caller.
struct Fetch {
    /// For messages.
    what: String,
    pinned: Vec<Option<PinnedPage>>,
    /// Pages that are not pinned yet, with their place in the list.
    outstanding: BTreeMap<PageNo, usize>,
    asker: Asker,
    /// Of these, pages that are in memory, but which a commit must write first. Nothing is known of those behind the
    /// first one, so that an end costs no look at all of them.
    frozen: VecDeque<PageNo>,
}

impl Pager {
    /// Pins pages with rows, in this order.
    pub(super) fn fetch(&mut self, what: &str, pages: &[PageNo], asker: Asker) -> Result<Vec<PinnedPage>, PagingError> {
        let held = self.held_by_callers();
        if held + pages.len() > self.frames.frames_max() {
            return Err(self.working_set(what, held + pages.len()));
        }
        let pinned = pages.iter().map(|_| None).collect();
        let mut fetch =
            Fetch { what: what.to_string(), pinned, outstanding: BTreeMap::new(), asker, frozen: VecDeque::new() };
        fetch.outstanding.extend(pages.iter().copied().zip(0..));
        let result = self.fetch_into(&mut fetch, pages);
        let pinned = fetch.pinned.into_iter().flatten();
        if let Err(error) = result {
            pinned.for_each(|p| self.frames.unpin(p.page, p.buffer, false));
            return Err(error);
        }
        let pinned: Vec<PinnedPage> = pinned.collect();
        self.count_pinned();
        Ok(pinned)
    }

    fn fetch_into(&mut self, fetch: &mut Fetch, pages: &[PageNo]) -> Result<(), PagingError> {
        let failures = self.settle(false, &mut Vec::new());
        pages.iter().for_each(|&page| self.pin_into(fetch, page));
        fetch.frozen = fetch.outstanding.keys().copied().filter(|&page| self.holds_frozen(page)).collect();
        let frozen = fetch.frozen.len();
        self.judge(fetch, failures)?;
        let is_absent = |page: &PageNo| self.frames.state(*page).is_none();
        let mut to_read: VecDeque<PageNo> = pages.iter().copied().filter(is_absent).collect();
        if fetch.asker.is_step() {
            self.stats.pages_needed += pages.len() as u64;
            // Frozen pages are there, and only wait for their write.
            let misses = fetch.outstanding.len().saturating_sub(frozen);
            self.stats.misses += misses as u64;
            self.stats.hits += (pages.len() - misses) as u64;
            self.stats.absent += to_read.len() as u64;
        } else {
            let bytes = |page: &PageNo| self.slots[page.index()].map_or(0, |slot| slot.transfer_bytes() as u64);
            self.stats.other_pages_needed += pages.len() as u64;
            self.stats.other_bytes_read += to_read.iter().map(bytes).sum::<u64>();
        }
        loop {
            self.write_needed(fetch)?;
            while let Some(&page) = to_read.front().filter(|page| self.may_decode(**page)) {
                if self.begin_read(page, false) {
                    to_read.pop_front();
                } else if !self.make_room(to_read.len(), fetch.asker)? {
                    break;
                }
            }
            if fetch.outstanding.is_empty() {
                return Ok(());
            }
            if self.in_flight() == 0 {
                return Err(self.working_set(&fetch.what, self.held_by_callers() + fetch.outstanding.len()));
            }
            let mut ended = Vec::new();
            let is_delayed = self.frozen.as_ref().is_some_and(|f| f.delays(fetch.outstanding.keys().copied()));
            let started = Instant::now();
            let failures = self.settle_for(fetch.asker, &mut ended);
            self.commit_seconds += if is_delayed { started.elapsed().as_secs_f64() } else { 0.0 };
            ended.into_iter().for_each(|page| self.pin_into(fetch, page));
            self.judge(fetch, failures)?;
        }
    }

    /// Begins to write those pages that are frozen, a few at a time, and pins those that are so no more. One whose write
    /// has begun is pinned at its end.
    fn write_needed(&mut self, fetch: &mut Fetch) -> Result<(), PagingError> {
        while let Some(&page) = fetch.frozen.front() {
            if self.may_write_frozen(page) {
                if let Err(Failure { error, .. }) = self.begin_write(page, true) {
                    self.stop_writes(error, fetch.asker)?;
                }
            } else if self.holds_frozen(page) {
                // As many are being written as may be at once.
                return Ok(());
            }
            fetch.frozen.pop_front();
            self.pin_into(fetch, page);
        }
        Ok(())
    }

    /// Pins an outstanding page if it is resident and not frozen.
    fn pin_into(&mut self, fetch: &mut Fetch, page: PageNo) {
        let Some(&place) = fetch.outstanding.get(&page).filter(|_| !self.holds_frozen(page)) else { return };
        if let Some((buffer, dirty)) = self.frames.pin(page, fetch.asker.is_step()) {
            fetch.outstanding.remove(&page);
            fetch.pinned[place] = Some(PinnedPage { page, meta: self.index[page.index()], dirty, buffer });
        }
    }

    /// Failures end the fetch when they are about a page that it needs, or when a step would go on although pages
    /// cannot be written any more.
    fn judge(&mut self, fetch: &mut Fetch, failures: Vec<Failure>) -> Result<(), PagingError> {
        for Failure { page, is_write, error } in failures {
            if is_write {
                // It is in memory again.
                self.pin_into(fetch, page);
                self.stop_writes(error, fetch.asker)?;
            } else if fetch.outstanding.contains_key(&page) {
                return Err(error);
            }
        }
        Ok(())
    }

    /// No more writes until a step asks again. The error goes to the step that waits, or to the next one.
    pub(super) fn stop_writes(&mut self, error: PagingError, asker: Asker) -> Result<(), PagingError> {
        self.writes_stopped = true;
        if asker.minds_writes() {
            return Err(error);
        }
        self.failed_write.get_or_insert(error);
        Ok(())
    }

    /// Makes a frame free: at once if a clean page leaves first, otherwise by beginning to write dirty ones, as many as
    /// there are frames wanted. Returns whether a page has left: its frame is free now, unless there were
    /// more than there may be.
    pub(super) fn make_room(&mut self, wanted: usize, asker: Asker) -> Result<bool, PagingError> {
        loop {
            // Pages that are written to leave come first: a nearer one must not leave in their place.
            let leaving = self.frames.count(FrameState::Writing) - self.ahead[WRITES] / self.config.frame_bytes();
            if leaving >= wanted + self.frames.excess() {
                return Ok(false);
            }
            let victim = if self.writes_stopped { self.frames.clean_victim() } else { self.frames.victim() };
            match victim {
                Some(victim) if !victim.dirty => {
                    self.evict(victim.page);
                    return Ok(true);
                }
                Some(_) if !self.has_staging() => return Ok(false),
                Some(victim) if self.store.is_some() => {
                    if let Err(Failure { error, .. }) = self.begin_write(victim.page, false) {
                        self.stop_writes(error, asker)?;
                    }
                }
                _ if !asker.minds_writes()
                    && self.writes_stopped
                    && self.in_flight() == 0
                    && self.held_by_callers() == 0 =>
                {
                    // Everything in memory is dirty and cannot leave: one frame more lets the scene be written out.
                    self.frames.add_frame();
                    return Ok(true);
                }
                _ => return Ok(false),
            }
        }
    }

    /// A frame for the upper half of a page that splits; its bytes are whatever was there before. Goes back by
    /// [`Pager::add_split`] or [`Pager::return_frame`]. A step that has begun to change pages is seen through where only
    /// space is missing, with a frame more than allowed: the next step gets the error.
    ///
    /// # Errors
    /// Every frame is pinned, or the store failed while one was emptied.
    pub fn take_frame(&mut self) -> Result<PageBuffer, PagingError> {
        let error = match self.frame_for(Asker::Step) {
            Err(error) => error,
            frame => return frame,
        };
        let cause = self.failed_write.take().unwrap_or(error);
        if !cause.is_out_of_space() {
            return Err(cause);
        }
        self.failed_write = Some(cause);
        self.frames.add_frame();
        self.frame_for(Asker::Step)
    }

    /// A frame without a page, emptied if need be, for a step or for the import; a failed write ends the call for both.
    pub(super) fn frame_for(&mut self, asker: Asker) -> Result<PageBuffer, PagingError> {
        loop {
            if let Some(buffer) = self.frames.lend(|| PageBuffer::mapped(self.config.frame_bytes())) {
                return Ok(buffer);
            }
            if self.make_room(1, Asker::Step)? {
                continue;
            }
            if self.in_flight() == 0 {
                return Err(self.working_set("a page that splits", self.frames.frames_max() + 1));
            }
            for Failure { is_write, error, .. } in self.settle_for(asker, &mut Vec::new()) {
                if is_write {
                    self.stop_writes(error, Asker::Step)?;
                }
            }
        }
    }

    /// Keeps an import at the speed of the drive: a frame that is clean already for the next page, and writes of those
    /// that are not.
    pub(super) fn write_behind(&mut self) -> Result<(), PagingError> {
        if self.frames.has_free() || self.store.is_none() {
            return Ok(());
        }
        for Failure { is_write, error, .. } in self.settle(false, &mut Vec::new()) {
            if is_write {
                self.stop_writes(error, Asker::Step)?;
            }
        }
        while self.may_write_ahead()
            && let Some(victim) = self.frames.dirty_victim()
        {
            if let Err(Failure { error, .. }) = self.begin_write(victim.page, true) {
                self.stop_writes(error, Asker::Step)?;
            }
        }
        if let Some(victim) = self.frames.clean_victim().filter(|v| v.next_use == NEVER) {
            self.evict(victim.page);
        }
        Ok(())
    }

    fn held_by_callers(&self) -> usize {
        self.frames.held_by_callers()
    }

    fn working_set(&self, what: &str, pages: usize) -> PagingError {
        let (frames, frame_bytes) = (self.frames.frames_max(), self.config.frame_bytes());
        PagingError::WorkingSet { what: what.to_string(), pages, frames, frame_bytes }
    }
}
