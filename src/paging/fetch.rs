//! Fetch: brings pages into memory that a caller needs now, and pins them.
//!
//! Invariants: 1. a fetch waits only when nothing can be started; 2. a needed page is pinned as soon as it is in
//! memory, so making room never evicts it; 3. prefetched pages are evicted like all others, so the frames of the working set
//! are enough; 4. after an error the fetch has nothing pinned; 5. however many pages are needed, no more of them are encoded in
//! memory at once than [`Pager::prefetch_bytes`] says.

use super::error::PagingError;
use super::pager::Pager;
use super::pinned::PinnedPage;
use super::timing::Asker;
use super::transfers::Failure;
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::paging::frames::evict::NEVER;
use crate::paging::frames::frame::FrameState;
use std::collections::{BTreeMap, VecDeque};
use std::time::Instant;

/// Pages on their way to a caller.
struct Fetch {
    /// For messages.
    what: String,
    pinned: Vec<Option<PinnedPage>>,
    /// Pages that are not pinned yet, with their place in the list.
    outstanding: BTreeMap<PageNo, usize>,
    asker: Asker,
    /// Outstanding pages that are in memory, and that a commit must write first. Only the first one is kept up to date, so that the
    /// end of a transfer costs no search.
    frozen: VecDeque<PageNo>,
}

impl Pager {
    /// Pins pages with rows, in this order.
    pub(super) fn fetch(&mut self, what: &str, pages: &[PageNo], asker: Asker) -> Result<Vec<PinnedPage>, PagingError> {
        let held = self.frames.held_by_callers();
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
        if !asker.is_step() {
            self.counters.stats.other_pages_needed += pinned.len() as u64;
        }
        self.count_pinned();
        Ok(pinned)
    }

    fn fetch_into(&mut self, fetch: &mut Fetch, pages: &[PageNo]) -> Result<(), PagingError> {
        let failures = self.collect_completions(false, &mut Vec::new());
        pages.iter().for_each(|&page| self.pin_into(fetch, page));
        fetch.frozen = fetch.outstanding.keys().copied().filter(|&page| self.cuts.holds(page)).collect();
        let frozen = fetch.frozen.len();
        self.handle_failures(fetch, failures)?;
        let is_absent = |page: &PageNo| self.frames.state(*page).is_none();
        let mut to_read: VecDeque<PageNo> = pages.iter().copied().filter(is_absent).collect();
        if fetch.asker.is_step() {
            self.counters.stats.pages_needed += pages.len() as u64;
            // Frozen pages are in memory, and only wait for their write.
            let misses = fetch.outstanding.len().saturating_sub(frozen);
            self.counters.stats.misses += misses as u64;
            self.counters.stats.hits += (pages.len() - misses) as u64;
            self.counters.stats.absent += to_read.len() as u64;
        }
        loop {
            self.write_needed(fetch)?;
            while let Some(&page) = to_read.front().filter(|page| self.mover.may_decode(self.index.slot(**page))) {
                if self.begin_read(page, false) {
                    to_read.pop_front();
                    self.count_read(page, fetch.asker);
                } else if !self.make_room(to_read.len(), fetch.asker)? {
                    break;
                }
            }
            if fetch.outstanding.is_empty() {
                return Ok(());
            }
            if self.mover.in_flight() == 0 {
                return Err(self.working_set(&fetch.what, self.frames.held_by_callers() + fetch.outstanding.len()));
            }
            let mut ended = Vec::new();
            let is_delayed = self.cuts.delays(fetch.outstanding.keys().copied());
            let started = Instant::now();
            let failures = self.wait_for_completion(fetch.asker, &mut ended);
            self.counters.commit_seconds += if is_delayed { started.elapsed().as_secs_f64() } else { 0.0 };
            ended.into_iter().for_each(|page| self.pin_into(fetch, page));
            self.handle_failures(fetch, failures)?;
        }
    }

    /// Counts the bytes of a read that has begun for an asker that is no step.
    pub(super) fn count_read(&mut self, page: PageNo, asker: Asker) {
        if !asker.is_step() {
            let bytes = self.index.slot(page).map_or(0, |slot| slot.transfer_bytes() as u64);
            self.counters.stats.other_bytes_read += bytes;
        }
    }

    /// Begins to write needed pages that are frozen, a few at a time, and pins pages that are not frozen any more. A page whose
    /// write has begun is pinned when the write ends.
    fn write_needed(&mut self, fetch: &mut Fetch) -> Result<(), PagingError> {
        while let Some(&page) = fetch.frozen.front() {
            if self.may_write_frozen(page) {
                if let Err(Failure { error, .. }) = self.begin_write(page, true) {
                    self.mover.stop_writes(error, fetch.asker.fails_on_write_error())?;
                }
            } else if self.cuts.holds(page) {
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
        let Some(&place) = fetch.outstanding.get(&page).filter(|_| !self.cuts.holds(page)) else { return };
        if let Some((buffer, dirty)) = self.frames.pin(page, fetch.asker.is_step()) {
            fetch.outstanding.remove(&page);
            fetch.pinned[place] = Some(PinnedPage { page, meta: *self.index.meta(page), dirty, buffer });
        }
    }

    /// Failures end the fetch when they are about a page that it needs, or when a step would go on although pages
    /// cannot be written any more.
    fn handle_failures(&mut self, fetch: &mut Fetch, failures: Vec<Failure>) -> Result<(), PagingError> {
        for Failure { page, is_write, error } in failures {
            if is_write {
                // It is in memory again.
                self.pin_into(fetch, page);
                self.mover.stop_writes(error, fetch.asker.fails_on_write_error())?;
            } else if fetch.outstanding.contains_key(&page) {
                return Err(error);
            }
        }
        Ok(())
    }

    /// Makes a frame free: at once if a clean page leaves first, otherwise by beginning to write dirty ones, as many as
    /// there are frames wanted. Returns whether a page has left: its frame is free now, unless there were
    /// more than there may be.
    pub(super) fn make_room(&mut self, wanted: usize, asker: Asker) -> Result<bool, PagingError> {
        loop {
            // Pages that are written to leave come first: a nearer one must not leave in their place.
            let leaving = self.frames.count(FrameState::Writing) - self.mover.writes_ahead();
            if leaving >= wanted + self.frames.excess() {
                return Ok(false);
            }
            let victim =
                if self.mover.are_writes_stopped() { self.frames.clean_victim() } else { self.frames.victim() };
            match victim {
                Some(victim) if !victim.dirty => {
                    self.evict(victim.page);
                    return Ok(true);
                }
                Some(_) if !self.mover.has_staging() => return Ok(false),
                Some(victim) if self.mover.has_store() => {
                    if let Err(Failure { error, .. }) = self.begin_write(victim.page, false) {
                        self.mover.stop_writes(error, asker.fails_on_write_error())?;
                    }
                }
                _ if !asker.fails_on_write_error()
                    && self.mover.are_writes_stopped()
                    && self.mover.in_flight() == 0
                    && self.frames.held_by_callers() == 0 =>
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
        let cause = self.mover.take_failure().unwrap_or(error);
        if !cause.is_out_of_space() {
            return Err(cause);
        }
        self.mover.keep_failure(cause);
        self.frames.add_frame();
        self.frame_for(Asker::Step)
    }

    /// A frame without a page, emptied if need be, for a step or for the import; a failed write ends the call for both.
    pub(super) fn frame_for(&mut self, asker: Asker) -> Result<PageBuffer, PagingError> {
        let frame_bytes = self.frame_bytes();
        loop {
            if let Some(buffer) = self.frames.lend(|| PageBuffer::mapped(frame_bytes)) {
                return Ok(buffer);
            }
            if self.make_room(1, Asker::Step)? {
                continue;
            }
            if self.mover.in_flight() == 0 {
                return Err(self.working_set("a page that splits", self.frames.frames_max() + 1));
            }
            for Failure { is_write, error, .. } in self.wait_for_completion(asker, &mut Vec::new()) {
                if is_write {
                    self.mover.stop_writes(error, true)?;
                }
            }
        }
    }

    /// Keeps an import at the speed of the drive: a frame that is clean already for the next page, and writes of those
    /// that are not.
    pub(super) fn write_behind(&mut self) -> Result<(), PagingError> {
        if self.frames.has_free() || !self.mover.has_store() {
            return Ok(());
        }
        for Failure { is_write, error, .. } in self.collect_completions(false, &mut Vec::new()) {
            if is_write {
                self.mover.stop_writes(error, true)?;
            }
        }
        while self.mover.may_write_ahead()
            && let Some(victim) = self.frames.dirty_victim()
        {
            if let Err(Failure { error, .. }) = self.begin_write(victim.page, true) {
                self.mover.stop_writes(error, true)?;
            }
        }
        if let Some(victim) = self.frames.clean_victim().filter(|v| v.next_use == NEVER) {
            self.evict(victim.page);
        }
        Ok(())
    }

    fn working_set(&self, what: &str, pages: usize) -> PagingError {
        let (frames, frame_bytes) = (self.frames.frames_max(), self.frame_bytes());
        PagingError::WorkingSet { what: what.to_string(), pages, frames, frame_bytes }
    }
}
