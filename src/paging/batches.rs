//! Batches: the pages of a view that is larger than the frames, pinned part by part, forwards and then backwards.
//!
//! [`Pager::begin_view`] lists the pages; `plan::batches` says how many of them are pinned at once. In the middle of such a
//! step the plan of the coming steps does not know which pages this step still needs. So the step says so by
//! [`Pager::set_use_in_step`], and pages that it still needs are evicted after all others.
//!
//! Invariants: 1. pages that the step needs again are evicted only for pages that it needs earlier; 2. a step that is one
//! batch costs none of this; 3. nothing here changes what a step gets.

use super::error::PagingError;
use super::frames::frame::FrameState;
use super::pager::Pager;
use super::pinned::PinnedPage;
use super::plan::batches::pages_per_batch;
use super::timing::{Asker, Transfers};
use crate::base::ids::PageNo;

/// How the present step, which walks its view in batches, still uses a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UseInStep {
    /// A batch that is still to come in the present pass needs the page.
    Coming,
    /// The page has been in, and the pass out needs the page again.
    Returning,
    /// The step is done with the page.
    Done,
}

/// Next use of a page that a coming batch of the present step needs: before every step.
const COMING: u32 = 0;

impl Pager {
    /// The most pages of a view of `pages` pages that a step pins at once.
    pub fn pages_per_batch(&self, pages: usize) -> usize {
        pages_per_batch(pages, self.frames.frames_max())
    }

    /// Pins the next batch of a step's view, in this order, leaving out pages without rows. Blocks only for pages that are not
    /// in memory.
    ///
    /// # Errors
    /// As [`Pager::acquire`]. Nothing of this batch is pinned then.
    pub fn pin_batch(&mut self, step: u32, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        self.pin_batch_for(step, pages, Asker::Step)
    }

    /// As [`Pager::pin_batch`], for a step that has changed rows already: a failed write is left to the next step.
    ///
    /// # Errors
    /// As [`Pager::acquire`]. Nothing of this batch is pinned then.
    pub fn pin_batch_again(&mut self, step: u32, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        self.pin_batch_for(step, pages, Asker::RestOfStep)
    }

    fn pin_batch_for(&mut self, step: u32, pages: &[PageNo], asker: Asker) -> Result<Vec<PinnedPage>, PagingError> {
        let pages: Vec<PageNo> = pages.iter().copied().filter(|&p| self.index.has_rows(p)).collect();
        let pinned = match self.fetch(&format!("the view of step {step}"), &pages, asker) {
            // The failed write that left no frame says more than the lack of frames.
            Err(error @ PagingError::WorkingSet { .. }) => return Err(self.mover.take_failure().unwrap_or(error)),
            pinned => pinned?,
        };
        self.count_bound(&pages);
        Ok(pinned)
    }

    /// Says how the present step still uses these pages.
    pub fn set_use_in_step(&mut self, step: u32, pages: impl IntoIterator<Item = PageNo>, how: UseInStep) {
        if how == UseInStep::Done && self.uses_in_step.is_empty() {
            return;
        }
        for page in pages {
            match how {
                UseInStep::Coming => self.uses_in_step.insert(page, COMING),
                UseInStep::Returning => self.uses_in_step.insert(page, step),
                UseInStep::Done => self.uses_in_step.remove(&page),
            };
            self.frames.set_next_use(page, self.next_use(page));
        }
    }

    /// Makes sure that the drive has room for everything that may be written back before `pages` pages of the present step are
    /// updated: these pages, the dirty pages in memory, and the pages of a cut.
    ///
    /// # Errors
    /// The drive is full.
    pub fn reserve_slots(&mut self, pages: usize) -> Result<(), PagingError> {
        let dirty = self.frames.held().filter(|(_, held)| self.frames.is_dirty(held.page)).count();
        let pages = (pages + dirty) as u64;
        let store = self.mover.store_mut();
        store.map_or(Ok(()), |store| store.reserve(pages)).map_err(|source| PagingError::Room { pages, source })
    }

    /// The step has ended, well or not: it uses no page any more.
    pub fn end_batches(&mut self) {
        for (page, _) in std::mem::take(&mut self.uses_in_step) {
            self.frames.set_next_use(page, self.next_use(page));
        }
    }

    /// Begins to read the pages of the next batch of the present step, as far as frames of pages that the step does not need
    /// earlier can be had, and bytes in flight allow it. Never blocks. Calling it again continues.
    pub fn prefetch_batch(&mut self, pages: &[PageNo]) {
        self.prefetch_for(pages, Asker::Step);
    }

    /// As [`Pager::prefetch_batch`], between steps: of pages that are acquired next.
    pub fn prefetch_pages(&mut self, pages: impl Iterator<Item = PageNo>) {
        if self.transfers == Transfers::Demand || !self.mover.has_store() {
            return;
        }
        let pages: Vec<PageNo> = pages.collect();
        // So that none of them is evicted for another one.
        self.set_use_in_step(0, pages.iter().copied(), UseInStep::Coming);
        self.prefetch_for(&pages, Asker::Other);
        self.end_batches();
    }

    fn prefetch_for(&mut self, pages: &[PageNo], asker: Asker) {
        if self.transfers == Transfers::Demand || !self.mover.has_store() {
            return;
        }
        self.poll_completions(false);
        self.write_frozen();
        let mut lacking = 0;
        for &page in pages {
            if !self.index.has_rows(page) || self.frames.state(page).is_some() {
                continue;
            }
            if !self.mover.may_read_ahead() {
                break;
            }
            if !self.frames.has_free() {
                match self.frames.victim().filter(|victim| victim.next_use > COMING) {
                    Some(victim) if !victim.dirty => self.evict(victim.page),
                    Some(victim) => {
                        lacking += 1;
                        if self.frames.count(FrameState::Writing) < lacking && self.mover.may_write_ahead() {
                            self.write_back_early(victim);
                        }
                        continue;
                    }
                    None => break,
                }
            }
            if self.begin_read(page, true) {
                self.count_read(page, asker);
            }
        }
        self.mover.begin_writes();
    }
}
