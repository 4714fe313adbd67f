//! Fetch: brings pages into memory that a caller needs now, and pins them.
//!
//! Invariants: 1. a fetch waits only when nothing can be started; 2. a needed page is pinned as soon as it is in
//! memory, so making room never evicts it; 3. prefetched pages are evicted like all others, so the frames of the working set
//! are enough; 4. after an error the fetch has nothing pinned; 5. however many pages are needed, no more of them are encoded in
//! memory at once than the mover allows.

use super::error::PagingError;
use super::frames::table::FrameState;
use super::mover::WRITES_IN_FLIGHT;
use super::pinned::PinnedPage;
use super::plan::look_ahead::LookAhead;
use super::tier::{Asker, Failure, Tier};
use crate::base::ids::PageNo;
use std::collections::{BTreeMap, VecDeque};
use std::time::Instant;

/// Pages on their way to a caller.
pub(super) struct Fetch<'a> {
    tier: &'a mut Tier,
    look_ahead: &'a LookAhead,
    /// For messages.
    what: String,
    pinned: Vec<Option<PinnedPage>>,
    /// Pages that are not pinned yet, with their place in the list.
    outstanding: BTreeMap<PageNo, usize>,
    asker: Asker,
    /// Outstanding pages in memory that a commit must write first. Only the front is checked against the cut, so that
    /// the end of a transfer costs no search.
    frozen: VecDeque<PageNo>,
}

impl<'a> Fetch<'a> {
    /// Pins the pages with rows among `pages`, in this order.
    pub fn pin(
        tier: &'a mut Tier,
        look_ahead: &'a LookAhead,
        what: String,
        pages: &[PageNo],
        asker: Asker,
    ) -> Result<Vec<PinnedPage>, PagingError> {
        let pages: Vec<PageNo> = pages.iter().copied().filter(|&p| tier.index.has_rows(p)).collect();
        let held = tier.frames.held_by_callers();
        if held + pages.len() > tier.frames.frames_max() {
            return Err(tier.working_set(&what, held + pages.len()));
        }
        let pinned = pages.iter().map(|_| None).collect();
        let outstanding = pages.iter().copied().zip(0..).collect();
        let mut fetch = Fetch { tier, look_ahead, what, pinned, outstanding, asker, frozen: VecDeque::new() };
        let result = fetch.run(&pages);
        let Fetch { tier, pinned, .. } = fetch;
        let pinned = pinned.into_iter().flatten();
        if let Err(error) = result {
            pinned.for_each(|p| tier.frames.unpin(p.page, p.buffer, false));
            return Err(error);
        }
        if !asker.is_step() {
            tier.counters.stats.other_pages_needed += pages.len() as u64;
        }
        tier.counters.count_pinned(tier.frames.count(FrameState::Pinned));
        Ok(pinned.collect())
    }

    fn run(&mut self, pages: &[PageNo]) -> Result<(), PagingError> {
        let failures = self.tier.collect(None, &mut Vec::new());
        pages.iter().for_each(|&page| self.pin_if_ready(page));
        self.frozen = self.outstanding.keys().copied().filter(|&page| self.tier.cuts.holds(page)).collect();
        let frozen = self.frozen.len();
        self.handle_failures(failures)?;
        let is_absent = |page: &PageNo| self.tier.frames.state(*page).is_none();
        let mut to_read: VecDeque<PageNo> = pages.iter().copied().filter(is_absent).collect();
        if self.asker.is_step() {
            let stats = &mut self.tier.counters.stats;
            stats.pages_needed += pages.len() as u64;
            // Frozen pages are in memory, and only wait for their write.
            let misses = self.outstanding.len().saturating_sub(frozen);
            stats.misses += misses as u64;
            stats.hits += (pages.len() - misses) as u64;
            stats.absent += to_read.len() as u64;
        }
        loop {
            self.write_needed()?;
            while let Some(&page) =
                to_read.front().filter(|page| self.tier.mover.may_decode(self.tier.index.slot(**page)))
            {
                if self.tier.begin_read(page, self.look_ahead.next_use(page), false) {
                    to_read.pop_front();
                    self.tier.count_read(page, self.asker);
                } else if !self.tier.make_room(to_read.len(), self.asker)? {
                    break;
                }
            }
            if self.outstanding.is_empty() {
                return Ok(());
            }
            if self.tier.mover.in_flight() == 0 {
                let needed = self.tier.frames.held_by_callers() + self.outstanding.len();
                return Err(self.tier.working_set(&self.what, needed));
            }
            let mut ended = Vec::new();
            let is_delayed = self.tier.cuts.delays(self.outstanding.keys().copied());
            let started = Instant::now();
            let failures = self.tier.collect(Some(self.asker), &mut ended);
            self.tier.counters.commit_seconds += if is_delayed { started.elapsed().as_secs_f64() } else { 0.0 };
            ended.into_iter().for_each(|page| self.pin_if_ready(page));
            self.handle_failures(failures)?;
        }
    }

    /// Begins to write needed pages that are frozen, a few at a time, and pins pages that are not frozen any more. A page whose
    /// write has begun is pinned when the write ends.
    fn write_needed(&mut self) -> Result<(), PagingError> {
        while let Some(&page) = self.frozen.front() {
            let Tier { frames, mover, cuts, .. } = &mut *self.tier;
            let may_write = cuts.holds(page)
                && cuts.writing() < WRITES_IN_FLIGHT
                && mover.has_staging()
                && frames.state(page) == Some(FrameState::Resident);
            if may_write {
                if let Err(error) = self.tier.begin_write(page, true) {
                    self.tier.stop_writes(error, self.asker)?;
                }
            } else if cuts.holds(page) {
                // This write must wait for writes in flight.
                return Ok(());
            }
            self.frozen.pop_front();
            self.pin_if_ready(page);
        }
        Ok(())
    }

    /// Pins an outstanding page if it is resident and not frozen.
    fn pin_if_ready(&mut self, page: PageNo) {
        let Some(&place) = self.outstanding.get(&page).filter(|_| !self.tier.cuts.holds(page)) else { return };
        if let Some((buffer, dirty)) = self.tier.frames.pin(page, self.asker.is_step()) {
            self.outstanding.remove(&page);
            let meta = *self.tier.index.meta(page);
            self.pinned[place] = Some(PinnedPage { page, meta, dirty, buffer });
        }
    }

    /// A failed read ends the fetch if the fetch needs the page. A failed write ends the fetch of a step that can still
    /// be done again.
    fn handle_failures(&mut self, failures: Vec<Failure>) -> Result<(), PagingError> {
        for Failure { page, is_write, error } in failures {
            if is_write {
                // It is in memory again.
                self.pin_if_ready(page);
                self.tier.stop_writes(error, self.asker)?;
            } else if self.outstanding.contains_key(&page) {
                return Err(error);
            }
        }
        Ok(())
    }
}
