//! The coming steps, the pages that each of them needs, and when each page is needed next.
//!
//! A [`Plan`] is a window over the steps of a run: steps are pushed at its end as their views become known, and popped at its
//! front as they are done. Runs and simulations use the same plan. Not here: what a cache does with it (`cache_model`), which
//! views come (`schedule::order`), and how cameras and bounds give pages (`views`).
//!
//! Invariants: 1. steps are consecutive; 2. the lists of steps and the uses of pages say the same, and the uses of a page
//! ascend; 3. the plan holds at most as many uses as its bytes allow, but at least one step always fits; 4. a plan knows
//! nothing beyond its end.

use crate::base::ids::PageNo;
use std::collections::VecDeque;
use std::ops::Range;

/// Bytes that one use of one page takes at most: 4 in the list of its step, and 4 in the queue of its page, which grows by
/// doubling. The header of a page's queue comes on top, once for each page.
pub const USE_BYTES: usize = 12;

/// The window of planned steps.
#[derive(Debug, Clone)]
pub struct Plan {
    uses_max: usize,
    uses_held: usize,
    first_step: u32,
    steps: VecDeque<Vec<PageNo>>,
    /// By page: the planned steps that need it.
    uses: Vec<VecDeque<u32>>,
}

impl Plan {
    /// An empty plan that starts at `first_step` and whose uses take at most `max_bytes`.
    pub fn new(first_step: u32, max_bytes: u64) -> Plan {
        let uses_max = (max_bytes / USE_BYTES as u64).try_into().unwrap_or(usize::MAX);
        Plan { uses_max, uses_held: 0, first_step, steps: VecDeque::new(), uses: Vec::new() }
    }

    /// Limits the plan to about `max_bytes` bytes from now on; steps that do not fit stay until they are dropped.
    pub fn limit(&mut self, max_bytes: u64) {
        self.uses_max = (max_bytes / USE_BYTES as u64).try_into().unwrap_or(usize::MAX);
    }

    /// Whether it holds more than it may.
    pub fn is_over(&self) -> bool {
        self.uses_held > self.uses_max
    }

    pub fn steps(&self) -> Range<u32> {
        self.first_step..self.first_step + self.steps.len() as u32
    }

    /// Number of pages of all planned steps together.
    pub fn uses(&self) -> usize {
        self.uses_held
    }

    /// Forgets all steps and begins again at `first_step`; keeps the allocations of the pages.
    pub fn restart(&mut self, first_step: u32) {
        self.steps.clear();
        self.uses.iter_mut().for_each(VecDeque::clear);
        (self.uses_held, self.first_step) = (0, first_step);
    }

    /// Plans the step after the last one: `pages` are the pages that it needs, each once. Returns `false` and changes nothing
    /// when the bytes are used up: pop first.
    pub fn push(&mut self, pages: &[PageNo]) -> bool {
        if self.uses_held + pages.len() > self.uses_max && !self.steps.is_empty() {
            return false;
        }
        let step = self.steps().end;
        for &page in pages {
            self.uses_of(page).push_back(step);
        }
        self.uses_held += pages.len();
        self.steps.push_back(pages.to_vec());
        true
    }

    /// Drops the first step, which is done; returns its pages.
    pub fn pop(&mut self) -> Option<Vec<PageNo>> {
        let pages = self.steps.pop_front()?;
        pages.iter().for_each(|page| {
            self.uses[page.index()].pop_front();
        });
        self.uses_held -= pages.len();
        self.first_step += 1;
        Some(pages)
    }

    /// Drops the last step; returns its pages.
    pub fn pop_last(&mut self) -> Option<Vec<PageNo>> {
        let pages = self.steps.pop_back()?;
        pages.iter().for_each(|page| {
            self.uses[page.index()].pop_back();
        });
        self.uses_held -= pages.len();
        Some(pages)
    }

    /// Replaces the pages of a planned step and returns those that it had; both lists ascend. A step outside of the plan
    /// keeps what it has: nothing.
    pub fn replace(&mut self, step: u32, pages: Vec<PageNo>) -> Vec<PageNo> {
        let Some(at) = self.position(step) else { return Vec::new() };
        let old = std::mem::take(&mut self.steps[at]);
        for page in missing_from(&pages, &old) {
            self.uses[page.index()].retain(|&s| s != step);
        }
        for page in missing_from(&old, &pages) {
            let uses = self.uses_of(page);
            uses.insert(uses.partition_point(|&s| s < step), step);
        }
        self.uses_held = self.uses_held + pages.len() - old.len();
        self.steps[at] = pages;
        old
    }

    /// Adds pages to a planned step: ascending, and greater than the pages that it has.
    pub fn extend(&mut self, step: u32, pages: &[PageNo]) {
        let Some(at) = self.position(step) else { return };
        for &page in pages {
            let uses = self.uses_of(page);
            uses.insert(uses.partition_point(|&s| s < step), step);
        }
        self.uses_held += pages.len();
        self.steps[at].extend_from_slice(pages);
    }

    /// Whether the bytes are used up.
    pub fn is_full(&self) -> bool {
        self.uses_held >= self.uses_max
    }

    /// The pages of a planned step; no pages for a step outside of the plan.
    pub fn pages(&self, step: u32) -> &[PageNo] {
        self.position(step).map_or(&[], |at| &self.steps[at])
    }

    /// The first planned step at or after `step` that needs `page`; `None` when the plan has none.
    pub fn next_use(&self, page: PageNo, step: u32) -> Option<u32> {
        self.uses.get(page.index())?.iter().copied().find(|&s| s >= step)
    }

    fn position(&self, step: u32) -> Option<usize> {
        self.steps().contains(&step).then(|| (step - self.first_step) as usize)
    }

    fn uses_of(&mut self, page: PageNo) -> &mut VecDeque<u32> {
        if self.uses.len() <= page.index() {
            self.uses.resize_with(page.index() + 1, VecDeque::new);
        }
        &mut self.uses[page.index()]
    }
}

/// The pages of `of` that are not in `list`; both ascend.
pub(super) fn missing_from<'a>(list: &'a [PageNo], of: &'a [PageNo]) -> impl Iterator<Item = PageNo> + 'a {
    of.iter().copied().filter(|page| list.binary_search(page).is_err())
}
