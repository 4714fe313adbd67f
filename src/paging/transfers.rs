//! Between cache and store: begins reads and writes, and takes their ends.
//!
//! Invariants: 1. every buffer that goes to the store comes back into its frame, however the transfer ends; 2. a failed
//! read leaves its page on the drive, a failed write leaves its page dirty in memory; 3. the slot of an older version is
//! given up only when the newer one is written.

use super::commit::WRITES_IN_FLIGHT;
use super::error::PagingError;
use super::fetch::Asker;
use super::label::label;
use super::pager::Pager;
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::{SlotRef, StoredAs};
use crate::page::versions::page_error::PageError;
use crate::page::versions::paged_store::{PageDone, PageMoved};
use crate::scene::page_layout::PageLayout;
use std::time::Instant;

/// Set in the token of a transfer that was started ahead of its need.
const AHEAD: u64 = 1 << 32;
/// Index into [`Pager::ahead`].
pub(super) const READS: usize = 0;
/// Index into [`Pager::ahead`].
pub(super) const WRITES: usize = 1;

/// A transfer that failed.
pub(super) struct Failure {
    pub page: PageNo,
    pub is_write: bool,
    pub error: PagingError,
}

/// Encoded pages on their way at once at least, so that a tool which reads nothing ahead has work for a few threads.
const STAGED_LEAST: usize = 4;

impl Pager {
    /// Transfers whose end was not taken yet.
    pub(super) fn in_flight(&self) -> usize {
        self.store.as_ref().map_or(0, |store| store.in_flight())
    }

    /// Whether another page may be on its way encoded, in a buffer beside its frame: no more than a run reckons with, which
    /// is what may be ahead. Where it may not, transfers are in flight, so whoever waits for it has an end to wait for.
    pub(super) fn has_staging(&self) -> bool {
        let most = match self.prefetch_bytes() {
            // Nobody reckoned with anything: pages that were all in memory are written.
            0 => WRITES_IN_FLIGHT,
            bytes => (bytes / self.config.frame_bytes()).max(STAGED_LEAST),
        };
        self.store.as_ref().is_none_or(|store| store.staged() < most)
    }

    /// Whether the version of a page on the drive may be read now, as far as buffers for encoded pages go.
    pub(super) fn may_decode(&self, page: PageNo) -> bool {
        self.has_staging() || self.slots[page.index()].is_some_and(|slot| slot.codec == StoredAs::Raw)
    }

    /// Begins to read a page that is not in memory, if there is a free frame for it.
    pub(super) fn begin_read(&mut self, page: PageNo, is_ahead: bool) -> bool {
        let (Some(store), Some(slot)) = (&mut self.store, self.slots[page.index()]) else { return false };
        let (frame_bytes, next_use) = (self.config.frame_bytes(), self.look_ahead.views.next_use(page));
        let make = || PageBuffer::mapped(frame_bytes);
        let Some(buffer) = self.frames.begin_load(page, next_use, make) else { return false };
        store.read(token(page, is_ahead), self.index[page.index()].id, &slot, buffer);
        self.ahead[READS] += if is_ahead { self.config.frame_bytes() } else { 0 };
        self.stats.pages_read += 1;
        true
    }

    /// Begins to write a resident dirty page.
    pub(super) fn begin_write(&mut self, page: PageNo, is_ahead: bool) -> Result<(), Failure> {
        let Some(store) = &mut self.store else { return Ok(()) };
        let meta = &self.index[page.index()];
        let layout = PageLayout { rows: meta.rows as usize, sh_degree: meta.sh_degree };
        let buffer = self.frames.begin_write(page);
        let cut = self.frozen.as_mut().and_then(|f| f.begin_write(page).then_some(f.generation));
        let generation = cut.unwrap_or(store.generation());
        match store.write_for(generation, token(page, is_ahead), meta.id, &label(meta), layout.bytes(), buffer) {
            Ok(()) => {
                self.ahead[WRITES] += if is_ahead { self.config.frame_bytes() } else { 0 };
                self.stats.pages_written += 1;
                Ok(())
            }
            Err((source, buffer)) => {
                self.thaw();
                self.frames.finish_write(page, buffer, false);
                Err(self.failure(page, true, source))
            }
        }
    }

    /// Evicts a clean resident page.
    pub(super) fn evict(&mut self, page: PageNo) {
        self.frames.evict(page);
        self.stats.evictions += 1;
    }

    /// Gives up the slot of a page.
    pub(super) fn free_slot(&mut self, page: PageNo) {
        if let (Some(store), Some(slot)) = (&mut self.store, self.slots[page.index()].take()) {
            store.free(&slot);
        }
    }

    /// The present version of a page is in this slot; the one before it is given up.
    fn take_version(&mut self, page: PageNo, slot: SlotRef) {
        let meta = &self.index[page.index()];
        let frozen = self.frozen.as_mut();
        let cut = frozen.and_then(|f| f.end_write(page, meta.id, slot, &label(meta)).then_some(f.generation));
        match (self.slots[page.index()].replace(slot), &mut self.store, cut) {
            (Some(before), Some(store), Some(cut)) => store.free_from(&before, cut),
            (Some(before), Some(store), None) => store.free(&before),
            _ => {}
        }
    }

    /// Waits for the end of a transfer, if any is in flight; the time counts as a step's or as somebody else's.
    pub(super) fn settle_for(&mut self, asker: Asker, ended: &mut Vec<PageNo>) -> Vec<Failure> {
        let before = self.stats.stall_seconds;
        let failures = self.settle(true, ended);
        if !asker.is_step() {
            self.stats.other_stall_seconds += self.stats.stall_seconds - before;
            self.stats.stall_seconds = before;
        }
        failures
    }

    /// Takes the ends of transfers; with `wait`, blocks until there is one, if any is in flight, and counts the time.
    /// `ended` gets the pages whose transfer ended well.
    pub(super) fn settle(&mut self, wait: bool, ended: &mut Vec<PageNo>) -> Vec<Failure> {
        let Some(store) = &mut self.store else { return Vec::new() };
        let mut done = Vec::new();
        let started = Instant::now();
        store.complete(wait, &mut done);
        if wait {
            self.stats.stall_seconds += started.elapsed().as_secs_f64();
        }
        let mut failures = Vec::new();
        for PageDone { token, buffer, result, .. } in done {
            let page = PageNo(token as u32);
            let is_read = self.frames.is_loading(page);
            if token & AHEAD != 0 {
                self.ahead[if is_read { READS } else { WRITES }] -= self.config.frame_bytes();
            }
            match result {
                Ok(PageMoved::Read { .. }) => self.frames.finish_load(page, buffer),
                Ok(PageMoved::Written(slot)) => {
                    self.frames.finish_write(page, buffer, true);
                    self.take_version(page, slot);
                }
                Err(source) => {
                    match is_read {
                        true => self.frames.fail_load(page, buffer),
                        false => {
                            self.thaw();
                            self.frames.finish_write(page, buffer, false);
                        }
                    }
                    failures.push(self.failure(page, !is_read, source));
                    continue;
                }
            }
            ended.push(page);
        }
        failures
    }

    fn failure(&self, page: PageNo, is_write: bool, source: PageError) -> Failure {
        let doing = if is_write { "writing" } else { "reading" };
        Failure { page, is_write, error: PagingError::Store { page: self.index[page.index()].id, doing, source } }
    }
}

fn token(page: PageNo, is_ahead: bool) -> u64 {
    u64::from(page.0) | if is_ahead { AHEAD } else { 0 }
}
