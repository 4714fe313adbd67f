//! Between frames, mover and index: begins reads and write-backs, and takes their ends.
//!
//! Invariants: 1. every buffer that goes to the mover comes back into its frame, however the transfer ends; 2. a failed
//! read leaves its page on the drive, a failed write leaves its page dirty in memory; 3. the slot of an older version is
//! given up only when the newer version is written.

use super::error::PagingError;
use super::mover::{Direction, Ended};
use super::pager::Pager;
use super::timing::Asker;
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::SlotRef;
use crate::page::versions::page_error::PageError;
use crate::page::versions::paged_store::PageMoved;
use std::time::Instant;

/// A transfer that failed.
pub(super) struct Failure {
    pub page: PageNo,
    pub is_write: bool,
    pub error: PagingError,
}

impl Pager {
    /// Begins to read a page that is not in memory, if a frame is free for it.
    pub(super) fn begin_read(&mut self, page: PageNo, is_ahead: bool) -> bool {
        let Some(slot) = self.index.slot(page).filter(|_| self.mover.has_store()) else { return false };
        let (frame_bytes, next_use) = (self.frame_bytes(), self.next_use(page));
        let make = || PageBuffer::mapped(frame_bytes);
        let Some(buffer) = self.frames.begin_load(page, next_use, make) else { return false };
        self.mover.read(page, self.index.meta(page), &slot, buffer, is_ahead);
        self.counters.stats.pages_read += 1;
        true
    }

    /// Begins to write a resident dirty page back.
    pub(super) fn begin_write(&mut self, page: PageNo, is_ahead: bool) -> Result<(), Failure> {
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
                self.cuts.abort();
                self.frames.finish_write(page, buffer, false);
                Err(self.failure(page, true, source))
            }
        }
    }

    /// Evicts a clean resident page.
    pub(super) fn evict(&mut self, page: PageNo) {
        self.frames.evict(page);
        self.counters.stats.evictions += 1;
    }

    /// Gives up the slot of a page.
    pub(super) fn free_slot(&mut self, page: PageNo) {
        if let Some(slot) = self.index.set_slot(page, None) {
            self.mover.free(&slot, None);
        }
    }

    /// The version of a page in `slot` is written; the one before it is given up.
    fn take_version(&mut self, page: PageNo, slot: SlotRef) {
        let cut = self.cuts.end_write(page, self.index.meta(page), slot);
        if let Some(before) = self.index.set_slot(page, Some(slot)) {
            self.mover.free(&before, cut);
        }
    }

    /// Takes the ends of transfers and waits for one, if any is in flight; the time counts as waited by `asker`.
    pub(super) fn wait_for_completion(&mut self, asker: Asker, ended: &mut Vec<PageNo>) -> Vec<Failure> {
        let before = self.counters.stats.stall_seconds;
        let failures = self.collect_completions(true, ended);
        let stats = &mut self.counters.stats;
        if !asker.is_step() {
            stats.other_stall_seconds += stats.stall_seconds - before;
            stats.stall_seconds = before;
        }
        failures
    }

    /// Takes the ends of transfers; with `wait`, blocks until one has ended, if any is in flight, and counts the time.
    /// `ended` gets the pages whose transfer ended well.
    pub(super) fn collect_completions(&mut self, wait: bool, ended: &mut Vec<PageNo>) -> Vec<Failure> {
        if !self.mover.has_store() {
            return Vec::new();
        }
        let started = Instant::now();
        let done = self.mover.complete(wait);
        if wait {
            self.counters.stats.stall_seconds += started.elapsed().as_secs_f64();
        }
        let mut failures = Vec::new();
        for Ended { page, direction, buffer, result } in done {
            match (result, direction) {
                (Ok(PageMoved::Read { .. }), _) => self.frames.finish_load(page, buffer),
                (Ok(PageMoved::Written(slot)), _) => {
                    self.frames.finish_write(page, buffer, true);
                    self.take_version(page, slot);
                }
                (Err(source), Direction::Read) => {
                    self.frames.fail_load(page, buffer);
                    failures.push(self.failure(page, false, source));
                    continue;
                }
                (Err(source), Direction::Write) => {
                    self.cuts.abort();
                    self.frames.finish_write(page, buffer, false);
                    failures.push(self.failure(page, true, source));
                    continue;
                }
            }
            ended.push(page);
        }
        failures
    }

    /// Takes the ends of transfers that nobody waits for.
    pub(super) fn poll_completions(&mut self, wait: bool) {
        for Failure { is_write, error, .. } in self.collect_completions(wait, &mut Vec::new()) {
            if is_write {
                // The next step gets the error.
                let _ = self.mover.stop_writes(error, false);
            }
        }
    }

    fn failure(&self, page: PageNo, is_write: bool, source: PageError) -> Failure {
        let doing = if is_write { "writing" } else { "reading" };
        Failure { page, is_write, error: PagingError::Store { page: self.index.meta(page).id, doing, source } }
    }
}
