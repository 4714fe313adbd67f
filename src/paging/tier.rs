//! The tier of a pager: the pages in memory, their versions on the drive, and what moves between the two. Begins reads and
//! write-backs, takes their ends, and makes frames free.
//!
//! Not here: which pages a step needs (`fetch`), and which are moved ahead of their need (`prefetch`).
//!
//! Invariants: 1. every buffer that goes to the mover comes back into its frame, however the transfer ends; 2. a failed
//! read leaves its page on the drive, a failed write leaves its page dirty in memory and gives the cut up; 3. the slot of an
//! older version is given up only when the newer version is written.

use super::cut::Cuts;
use super::error::PagingError;
use super::frames::evict::NEVER;
use super::frames::table::{FrameState, FrameTable, Victim};
use super::index::PageIndex;
use super::mover::{Ended, Mover, WRITES_IN_FLIGHT};
use super::stats::Counters;
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::page_engine::Direction;
use crate::page::versions::page_error::PageError;
use crate::page::versions::paged_store::PageMoved;
use crate::scene::page_meta::PageMeta;
use std::time::Instant;

/// Frozen pages that are written at once at least, however little may be read ahead.
const FROZEN_WRITES_LEAST: usize = 8;

/// Who asks for pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Asker {
    /// A training step that can still be done again: a failed write ends the call.
    Step,
    /// A training step that has changed rows already: uses and waits count as the step's. A failed write is left to the next step,
    /// since this step must not be done twice.
    RestOfStep,
    /// Evaluation, export or checks.
    Other,
}

impl Asker {
    /// Whether uses, reads and waits count as a step's.
    pub fn is_step(self) -> bool {
        self != Asker::Other
    }

    /// Whether a failed write ends the call.
    pub fn fails_on_write_error(self) -> bool {
        self == Asker::Step
    }
}

/// A transfer that failed.
pub(super) struct Failure {
    pub page: PageNo,
    pub is_write: bool,
    pub error: PagingError,
}

/// The pages of a pager, wherever they are.
#[derive(Debug)]
pub(super) struct Tier {
    pub index: PageIndex,
    pub frames: FrameTable<PageBuffer>,
    pub mover: Mover,
    pub cuts: Cuts,
    pub counters: Counters,
}

impl Tier {
    /// Adds a page to the index that was made in memory, or has no rows.
    pub fn add_entry(&mut self, meta: PageMeta) -> PageNo {
        let page = self.index.push(meta, None);
        if self.mover.has_store() {
            self.counters.bound.add(page);
        }
        page
    }

    /// Begins to read a page that is not in memory, if a frame is free for it. `next_use` is the step that needs the page.
    pub fn begin_read(&mut self, page: PageNo, next_use: u32, is_ahead: bool) -> bool {
        let Some(slot) = self.index.slot(page).filter(|_| self.mover.has_store()) else { return false };
        let make = || PageBuffer::mapped(self.mover.frame_bytes);
        let Some(buffer) = self.frames.begin_load(page, next_use, make) else { return false };
        self.mover.read(page, self.index.meta(page), &slot, buffer, is_ahead);
        self.counters.stats.pages_read += 1;
        true
    }

    /// Counts the bytes of a read that has begun for an asker that is no step.
    pub fn count_read(&mut self, page: PageNo, asker: Asker) {
        if !asker.is_step() {
            let bytes = self.index.slot(page).map_or(0, |slot| slot.transfer_bytes() as u64);
            self.counters.stats.other_bytes_read += bytes;
        }
    }

    /// Begins to write a resident dirty page back.
    pub fn begin_write(&mut self, page: PageNo, is_ahead: bool) -> Result<(), PagingError> {
        if !self.mover.has_store() {
            return Ok(());
        }
        let buffer = self.frames.begin_write(page);
        let cut = self.cuts.begin_write(page);
        match self.mover.write(page, self.index.meta(page), cut, buffer, is_ahead) {
            Ok(()) => {
                self.counters.stats.pages_written += 1;
                Ok(())
            }
            Err((source, buffer)) => {
                self.cuts.frozen = None;
                self.frames.finish_write(page, buffer, false);
                Err(self.failure(page, true, source).error)
            }
        }
    }

    /// Begins to write a page back that nobody waits for: the next step gets the error.
    pub fn write_back_early(&mut self, page: PageNo) {
        if let Err(error) = self.begin_write(page, true) {
            self.mover.stop_writes(error);
        }
    }

    /// Begins writes of frozen pages, as many as may be in flight ahead of other work; never blocks.
    pub fn write_frozen(&mut self) {
        let most = (self.mover.ahead_max / 2 / self.mover.frame_bytes).max(FROZEN_WRITES_LEAST);
        let started = Instant::now();
        while !self.mover.writes_stopped
            && self.mover.has_staging()
            && self.cuts.writing() < most
            && let Some(page) = self.cuts.next_waiting()
        {
            self.write_back_early(page);
        }
        if self.cuts.frozen.is_some() {
            self.counters.commit_seconds += started.elapsed().as_secs_f64();
        }
    }

    /// Evicts a clean resident page.
    pub fn evict(&mut self, page: PageNo) {
        self.frames.evict(page);
        self.counters.stats.evictions += 1;
    }

    /// Takes the ends of transfers. With `wait`, blocks until one has ended, if any is in flight; the time counts as waited by that
    /// asker. `ended` gets the pages whose transfer ended well.
    pub fn collect(&mut self, wait: Option<Asker>, ended: &mut Vec<PageNo>) -> Vec<Failure> {
        if !self.mover.has_store() {
            return Vec::new();
        }
        let started = Instant::now();
        let done = self.mover.complete(wait.is_some());
        let (waited, stats) = (started.elapsed().as_secs_f64(), &mut self.counters.stats);
        match wait {
            Some(asker) if asker.is_step() => stats.stall_seconds += waited,
            Some(_) => stats.other_stall_seconds += waited,
            None => {}
        }
        let mut failures = Vec::new();
        for Ended { page, direction, buffer, result } in done {
            match (result, direction) {
                (Ok(PageMoved::Read { .. }), _) => self.frames.finish_load(page, buffer),
                (Ok(PageMoved::Written(slot)), _) => {
                    self.frames.finish_write(page, buffer, true);
                    let cut = self.cuts.end_write(page, self.index.meta(page), slot);
                    if let Some(before) = self.index.set_slot(page, Some(slot)) {
                        self.mover.free(&before, cut);
                    }
                }
                (Err(source), Direction::Read) => {
                    self.frames.fail_load(page, buffer);
                    failures.push(self.failure(page, false, source));
                    continue;
                }
                (Err(source), Direction::Write) => {
                    self.cuts.frozen = None;
                    self.frames.finish_write(page, buffer, false);
                    failures.push(self.failure(page, true, source));
                    continue;
                }
            }
            ended.push(page);
        }
        failures
    }

    /// As [`Tier::collect`], for a caller whom failed reads do not concern: such a page is read when it is needed.
    /// Errors: the first write that failed.
    pub fn collect_writes(&mut self, wait: Option<Asker>) -> Result<(), PagingError> {
        let failures = self.collect(wait, &mut Vec::new()).into_iter();
        failures.filter(|f| f.is_write).map(|f| Err(f.error)).next().unwrap_or(Ok(()))
    }

    /// Takes the ends of transfers that nobody waits for: the next step gets the error.
    pub fn poll(&mut self, wait: bool) {
        if let Err(error) = self.collect_writes(wait.then_some(Asker::Step)) {
            self.mover.stop_writes(error);
        }
    }

    /// Waits until fewer than `most` transfers are in flight and another page may be encoded.
    /// Errors: the first write that failed.
    pub fn wait_until_below(&mut self, most: usize) -> Result<(), PagingError> {
        let mut first = Ok(());
        while self.mover.in_flight() >= most || !self.mover.has_staging() {
            first = first.and(self.collect_writes(Some(Asker::Step)));
        }
        first
    }

    /// Writes pages and waits until nothing is in flight.
    /// Errors: a page could not be written. It is still in memory.
    pub fn write_all(&mut self, mut next: impl FnMut(&mut Tier) -> Option<PageNo>) -> Result<(), PagingError> {
        while let Some(page) = next(self) {
            self.wait_until_below(WRITES_IN_FLIGHT)?;
            self.begin_write(page, false)?;
        }
        self.wait_until_below(1)
    }

    /// Makes room for `wanted` pages: takes the victims in order, begins to write dirty ones back, and evicts the first clean one. Stops when the
    /// write-backs under way suffice. Returns whether a page was evicted: its frame is free now, or retired if there were more frames than allowed.
    pub fn make_room(&mut self, wanted: usize, asker: Asker) -> Result<bool, PagingError> {
        loop {
            // Pages whose write-back has begun will make room; evict no page with a nearer next use in their place.
            let leaving = self.frames.count(FrameState::Writing) - self.mover.writes_ahead();
            if leaving >= wanted + self.frames.excess() {
                return Ok(false);
            }
            let victim = if self.mover.writes_stopped { self.frames.clean_victim() } else { self.frames.victim() };
            match victim {
                Some(victim) if !victim.dirty => {
                    self.evict(victim.page);
                    return Ok(true);
                }
                Some(_) if !self.mover.has_staging() => return Ok(false),
                Some(victim) if self.mover.has_store() => {
                    if let Err(error) = self.begin_write(victim.page, false) {
                        self.stop_writes(error, asker)?;
                    }
                }
                _ if !asker.fails_on_write_error()
                    && self.mover.writes_stopped
                    && self.mover.in_flight() == 0
                    && self.frames.held_by_callers() == 0 =>
                {
                    // All pages in memory are dirty and cannot be written: one more frame lets an export still read the scene.
                    self.frames.add_frame();
                    return Ok(true);
                }
                _ => return Ok(false),
            }
        }
    }

    /// No more writes until a step asks for pages again. An asker that fails on it gets the error, else the next step.
    /// Errors: `error`, if it ends the call of `asker`.
    pub fn stop_writes(&mut self, error: PagingError, asker: Asker) -> Result<(), PagingError> {
        if asker.fails_on_write_error() {
            self.mover.writes_stopped = true;
            return Err(error);
        }
        self.mover.stop_writes(error);
        Ok(())
    }

    /// A frame without a page, emptied if need be, for a step or for the import; a failed write ends the call for both.
    pub fn frame_for(&mut self, asker: Asker) -> Result<PageBuffer, PagingError> {
        loop {
            if let Some(buffer) = self.frames.lend(|| PageBuffer::mapped(self.mover.frame_bytes)) {
                return Ok(buffer);
            }
            if self.make_room(1, Asker::Step)? {
                continue;
            }
            if self.mover.in_flight() == 0 {
                return Err(self.working_set("a page that splits", self.frames.frames_max() + 1));
            }
            if let Err(error) = self.collect_writes(Some(asker)) {
                self.stop_writes(error, Asker::Step)?;
            }
        }
    }

    /// Keeps an import at the speed of the drive: evicts a clean page, so that the next page has a frame, and begins to
    /// write dirty pages back.
    pub fn write_behind(&mut self) -> Result<(), PagingError> {
        if self.frames.has_free() || !self.mover.has_store() {
            return Ok(());
        }
        let mut written = self.collect_writes(None);
        while written.is_ok()
            && self.mover.may_write_ahead()
            && let Some(Victim { page, .. }) = self.frames.dirty_victim()
        {
            written = self.begin_write(page, true);
        }
        if let Err(error) = written {
            self.stop_writes(error, Asker::Step)?;
        }
        if let Some(victim) = self.frames.clean_victim().filter(|v| v.next_use == NEVER) {
            self.evict(victim.page);
        }
        Ok(())
    }

    /// The error of an asker that needs `pages` pages at once.
    pub fn working_set(&self, what: &str, pages: usize) -> PagingError {
        let (frames, frame_bytes) = (self.frames.frames_max(), self.mover.frame_bytes);
        PagingError::WorkingSet { what: what.to_string(), pages, frames, frame_bytes }
    }

    fn failure(&self, page: PageNo, is_write: bool, source: PageError) -> Failure {
        let doing = if is_write { "writing" } else { "reading" };
        Failure { page, is_write, error: PagingError::Store { page: self.index.meta(page).id, doing, source } }
    }
}
