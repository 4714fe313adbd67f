//! The mover: reads and write-backs between frames and the store. The mover counts the transfers in flight, bounds the
//! bytes of prefetches and early write-backs, and remembers writes that failed while nobody waited for them.
//!
//! Not here: which page moves (`fetch`, `prefetch`), and what an end means for frames and index (`tier`).
//!
//! Invariants: 1. every buffer that goes to the store comes back, however the transfer ends; 2. a transfer begins ahead of its need only where
//! [`Mover::may_read_ahead`] or [`Mover::may_write_ahead`] allows it; a cut may write a few more pages; 3. after a failed write no other write
//! begins ahead of its need until a step asks for pages again; 4. a mover without a store moves nothing: its run keeps all pages in memory.

use super::error::PagingError;
use super::stats::SlotSpace;
use super::stored::{label, layout_of};
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::page_engine::Direction;
use crate::page::format::slot_header::{SlotRef, StoredAs};
use crate::page::versions::page_error::PageError;
use crate::page::versions::paged_store::{PageDone, PageMoved, PageTraffic, PagedStore};
use crate::scene::page_meta::PageMeta;

/// Writes in flight at once: each may need a buffer of its own to be encoded in.
pub(super) const WRITES_IN_FLIGHT: usize = 32;
/// Encoded pages in flight that are always allowed, so that a tool which reads nothing ahead has work for a few threads.
const STAGED_LEAST: usize = 4;

/// Set in the token of a transfer that was started ahead of its need.
const AHEAD: u64 = 1 << 32;
/// Set in the token of a read.
const READ: u64 = 1 << 33;

/// A transfer that ended.
#[derive(Debug)]
pub(super) struct Ended {
    pub page: PageNo,
    pub direction: Direction,
    pub buffer: PageBuffer,
    pub result: Result<PageMoved, PageError>,
}

/// What moves the pages of a pager.
#[derive(Debug)]
pub(super) struct Mover {
    /// `None` for a pager whose pages never leave memory.
    store: Option<PagedStore>,
    pub frame_bytes: usize,
    /// The most bytes that may be in flight ahead of their need, reads and writes each.
    pub ahead_max: usize,
    /// Reads and writes in flight that were started ahead of their need, bytes.
    ahead: [usize; 2],
    /// A write that failed while nobody waited for it.
    pub failed_write: Option<PagingError>,
    /// A write failed, and no step has asked for pages since: no other write begins ahead of its need.
    pub writes_stopped: bool,
}

impl Mover {
    /// A mover without a store.
    pub fn new(frame_bytes: usize, ahead_max: usize) -> Mover {
        Mover { store: None, frame_bytes, ahead_max, ahead: [0; 2], failed_write: None, writes_stopped: false }
    }

    /// Gives the mover its store.
    pub fn attach(&mut self, store: PagedStore) {
        assert!(self.store.is_none(), "a pager has one store for life");
        self.store = Some(store);
    }

    pub fn has_store(&self) -> bool {
        self.store.is_some()
    }

    /// The store, for commits.
    pub fn store_mut(&mut self) -> Option<&mut PagedStore> {
        self.store.as_mut()
    }

    /// Transfers whose end was not taken yet.
    pub fn in_flight(&self) -> usize {
        self.store.as_ref().map_or(0, PagedStore::in_flight)
    }

    /// Bytes moved so far.
    pub fn traffic(&self) -> PageTraffic {
        self.store.as_ref().map(PagedStore::traffic).unwrap_or_default()
    }

    /// Memory of buffers for encoded pages, bytes.
    pub fn staging_bytes(&self) -> u64 {
        self.store.as_ref().map_or(0, PagedStore::staging_bytes)
    }

    /// The slots of the store; `None` without a store.
    pub fn slot_space(&self) -> Option<SlotSpace> {
        let slots = self.store.as_ref()?.slots();
        let segment_bytes = slots.layout().segment_bytes();
        Some(SlotSpace { total: slots.total(), free: slots.free(), retired: slots.retired(), segment_bytes })
    }

    /// Whether another encoded page may be in flight, in a staging buffer beside its frame. If not, some transfer is in
    /// flight, so a caller can wait for its end.
    pub fn has_staging(&self) -> bool {
        let most = match 2 * self.ahead_max {
            // No budget was set aside for staging: pages that were all in memory are written.
            0 => WRITES_IN_FLIGHT,
            bytes => (bytes / self.frame_bytes).max(STAGED_LEAST),
        };
        self.store.as_ref().is_none_or(|store| store.staged() < most)
    }

    /// Whether a version may be read now, as far as buffers for encoded pages go.
    pub fn may_decode(&self, slot: Option<SlotRef>) -> bool {
        self.has_staging() || slot.is_some_and(|slot| slot.codec == StoredAs::Raw)
    }

    /// Whether a read may begin ahead of its need.
    pub fn may_read_ahead(&self) -> bool {
        self.has_staging() && self.may_be_ahead(Direction::Read)
    }

    /// Whether a write may begin ahead of its need.
    pub fn may_write_ahead(&self) -> bool {
        !self.writes_stopped && self.has_staging() && self.may_be_ahead(Direction::Write)
    }

    /// Writes in flight that were started ahead of their need.
    pub fn writes_ahead(&self) -> usize {
        self.ahead[Direction::Write as usize] / self.frame_bytes
    }

    /// Begins to read a version into a frame's memory.
    pub fn read(&mut self, page: PageNo, meta: &PageMeta, slot: &SlotRef, buffer: PageBuffer, is_ahead: bool) {
        if let Some(store) = &mut self.store {
            store.read(token(page, Direction::Read, is_ahead), meta.id, slot, buffer);
            self.ahead[Direction::Read as usize] += if is_ahead { self.frame_bytes } else { 0 };
        }
    }

    /// Begins to write a page back, for the generation of a cut or else for the current one.
    /// Errors: the store accepts no write; the buffer comes back.
    pub fn write(
        &mut self,
        page: PageNo,
        meta: &PageMeta,
        cut: Option<u64>,
        buffer: PageBuffer,
        is_ahead: bool,
    ) -> Result<(), (PageError, PageBuffer)> {
        let Some(store) = &mut self.store else { return Ok(()) };
        let token = token(page, Direction::Write, is_ahead);
        let generation = cut.unwrap_or(store.generation());
        store.write_for(generation, token, meta.id, &label(meta), layout_of(meta).bytes(), buffer)?;
        self.ahead[Direction::Write as usize] += if is_ahead { self.frame_bytes } else { 0 };
        Ok(())
    }

    /// Hands accepted writes to the drive.
    pub fn begin_writes(&mut self) {
        if let Some(store) = &mut self.store {
            store.begin_writes();
        }
    }

    /// Takes the transfers that ended; with `wait`, blocks until one has ended, if any is in flight.
    pub fn complete(&mut self, wait: bool) -> Vec<Ended> {
        let Some(store) = &mut self.store else { return Vec::new() };
        let mut done = Vec::new();
        store.complete(wait, &mut done);
        done.into_iter().map(|done| self.ended(done)).collect()
    }

    fn ended(&mut self, done: PageDone) -> Ended {
        let PageDone { token, buffer, result, .. } = done;
        let direction = if token & READ != 0 { Direction::Read } else { Direction::Write };
        if token & AHEAD != 0 {
            self.ahead[direction as usize] -= self.frame_bytes;
        }
        Ended { page: PageNo(token as u32), direction, buffer, result }
    }

    /// Gives a slot up: from the generation `cut` on, or else from the current one.
    pub fn free(&mut self, slot: &SlotRef, cut: Option<u64>) {
        match (&mut self.store, cut) {
            (Some(store), Some(cut)) => store.free_from(slot, cut),
            (Some(store), None) => store.free(slot),
            (None, _) => {}
        }
    }

    /// No more writes until a step asks for pages again, which gets the error.
    pub fn stop_writes(&mut self, error: PagingError) {
        self.writes_stopped = true;
        self.keep_failure(error);
    }

    /// Keeps an error for the next step; the first one counts.
    pub fn keep_failure(&mut self, error: PagingError) {
        self.failed_write.get_or_insert(error);
    }

    fn may_be_ahead(&self, direction: Direction) -> bool {
        self.ahead[direction as usize] + self.frame_bytes <= self.ahead_max
    }
}

fn token(page: PageNo, direction: Direction, is_ahead: bool) -> u64 {
    u64::from(page.0) | if is_ahead { AHEAD } else { 0 } | if direction == Direction::Read { READ } else { 0 }
}
