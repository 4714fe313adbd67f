//! What a cache of pages does step by step: which pages enter and which are evicted. The model knows numbers of pages, no
//! bytes.
//!
//! The look-ahead of a run and the simulations (`gsscale-plan`, preflight) step this one model. A simulation starts with
//! an empty cache. A look-ahead starts with the pages that its run has in memory.
//!
//! Invariants: 1. all pages of a step are in the cache at once, and no step evicts a page that it needs; 2. no page is
//! evicted before its frame is needed; 3. pages are evicted in the order of [`EvictOrder`]. With the whole future known, no
//! cache of this size reads fewer pages than [`EvictPolicy::FarthestNextUse`] (for sets of pages Belady's exchange argument
//! holds as well, and a test compares with all possible choices). A model that reads ahead reads a little more, so that its
//! frames are free earlier; 4. the model is a function of the calls that it gets.

use super::steps::Plan;
use crate::base::ids::PageNo;
use crate::paging::frames::evict::{Candidate, EvictOrder, EvictPolicy, NEVER};
use std::fmt;
use std::ops::Range;

/// A page that is not needed for this number of steps may be evicted for a page that the next step would wait for. That
/// costs at most one more read in this number of steps. Measured on a large survey, with frames for a tenth of the
/// pages and views of 5 % of them: 4, 16 and 40 steps read 4.3, 1.7 and 1.4 % more than necessary, and steps waited for
/// 2.5, 3.1 and 3.1 % of their pages. (Only the list of the next step was renewed then; since more lists are, 40 steps
/// read .3 % more.) 40 was the fastest, in small surveys as well.
pub const FAR_STEPS: u32 = 40;

/// Steps before its own in which a page may be read: how far a run looks ahead.
pub const STEPS_AHEAD: u32 = 16;

/// Pages that enter and leave before a step, in the order in which they do.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct StepChange {
    /// Pages read from disk.
    pub admit: Vec<PageNo>,
    /// Pages evicted. Free frames serve the first pages of `admit`; the evicted pages make room for the rest, in order.
    pub evict: Vec<PageNo>,
    /// The step that last needed each evicted page, by [`CacheModel::batch`]'s clock.
    pub last_uses: Vec<u32>,
}

impl StepChange {
    /// The admitted pages, each with the page that is evicted for it; `None` where a frame is free.
    pub fn pairs(&self) -> impl Iterator<Item = (PageNo, Option<PageNo>)> {
        let free = self.admit.len() - self.evict.len();
        let evicted = std::iter::repeat_n(None, free).chain(self.evict.iter().copied().map(Some));
        self.admit.iter().copied().zip(evicted)
    }
}

/// A step needs more pages at once than there are frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("step {step} needs {needed} pages at once, but there are {frames} frames")]
pub struct TooFewFrames {
    pub step: u32,
    /// Pages that the step needs.
    pub needed: usize,
    pub frames: usize,
}

#[derive(Debug, Clone)]
pub struct CacheModel {
    frames: usize,
    reads_ahead: bool,
    /// Frames without a page.
    free: usize,
    /// Pages that the last batch needed, without order.
    present: Vec<PageNo>,
    /// Pages in memory that the last batch did not need.
    idle: EvictOrder,
    /// By page: 1 + the last batch that needed the page; 0 for a page that no batch needed.
    needed_by: Vec<u32>,
    /// The batch that needed the pages of `present`.
    last_batch: u32,
    /// Number of steps begun: the last use of the pages of `present`. The frame table of a run has the same clock. Pages that
    /// were in memory before the first step have 0.
    clock: u32,
}

impl CacheModel {
    /// An empty cache of `frames` frames that reads the pages of a step when the step begins.
    pub fn new(frames: usize, policy: EvictPolicy) -> CacheModel {
        CacheModel {
            frames,
            reads_ahead: false,
            free: frames,
            present: Vec::new(),
            idle: EvictOrder::new(policy),
            needed_by: Vec::new(),
            last_batch: 0,
            clock: 0,
        }
    }

    /// The same cache, but reading ahead as a run does. Reads then begin while the previous step still computes, so
    /// pages of that step are evicted only if every other page is needed within [`FAR_STEPS`].
    pub fn reading_ahead(self) -> CacheModel {
        CacheModel { reads_ahead: true, ..self }
    }

    /// Replaces the content of the cache and keeps allocations: `free` frames without a page, the pages `present` that
    /// `step` needs, and the other pages in memory, `idle`.
    pub fn restart(
        &mut self,
        step: u32,
        free: usize,
        present: impl Iterator<Item = PageNo>,
        idle: impl Iterator<Item = Candidate>,
    ) {
        self.present.clear();
        self.idle.clear();
        self.needed_by.fill(0);
        present.for_each(|page| self.add_present(page, step));
        idle.for_each(|candidate| self.idle.insert(candidate));
        (self.free, self.last_batch, self.clock) = (free, step, step.saturating_add(1));
        self.frames = free.saturating_add(self.present.len() + self.idle.len());
    }

    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Takes the cache through one step that needs `pages`, each named once. `next_use` tells the first step after this one
    /// that needs a page, as far as known. `change` is overwritten. Steps must ascend.
    /// Errors: there are fewer frames than pages; nothing has changed then.
    pub fn step(
        &mut self,
        step: u32,
        pages: &[PageNo],
        next_use: impl Fn(PageNo) -> Option<u32>,
        change: &mut StepChange,
    ) -> Result<(), TooFewFrames> {
        self.batch(step, step, pages, next_use, change)
    }

    /// As [`CacheModel::step`], for one batch of `step`. Batches are counted over all steps, and next uses are numbers of
    /// batches. Last uses are numbers of steps, as in a run: all batches of a step use their pages at the same time.
    /// Errors: there are fewer frames than pages; nothing has changed then.
    pub fn batch(
        &mut self,
        batch: u32,
        step: u32,
        pages: &[PageNo],
        next_use: impl Fn(PageNo) -> Option<u32>,
        change: &mut StepChange,
    ) -> Result<(), TooFewFrames> {
        if pages.len() > self.frames {
            return Err(TooFewFrames { step, needed: pages.len(), frames: self.frames });
        }
        change.admit.clear();
        change.evict.clear();
        change.last_uses.clear();
        let mut past = std::mem::take(&mut self.present);
        for &page in pages {
            if !self.idle.remove(page) && !self.is_present(page) {
                change.admit.push(page);
            }
        }
        pages.iter().for_each(|&page| self.add_present(page, batch));
        past.retain(|page| self.needed_by[page.index()] != batch + 1);
        // The pages of the batch before are evicted last by a cache that reads ahead.
        if !self.reads_ahead {
            self.add_idle(&mut past, &next_use);
        }
        let free = self.free.min(change.admit.len());
        self.free -= free;
        for _ in free..change.admit.len() {
            let far = self.first_exact(&next_use).filter(|page| self.may_evict(page, batch, past.is_empty()));
            if far.is_none() {
                self.add_idle(&mut past, &next_use);
            }
            let Some(victim) = far.or_else(|| self.first_exact(&next_use)) else { break };
            self.idle.remove(victim.page);
            change.evict.push(victim.page);
            change.last_uses.push(victim.last_use.saturating_sub(1));
        }
        self.add_idle(&mut past, &next_use);
        (self.last_batch, self.clock) = (batch, step.saturating_add(1));
        Ok(())
    }

    /// The changes of this cache in `steps`, by `plan` and what is known now. The cache must stand before the first of
    /// `steps`. `steps` must begin where the plan begins, and end where it ends or earlier.
    /// Errors: a step needs more frames than there are.
    pub fn changes(&self, plan: &Plan, steps: Range<u32>) -> Result<Vec<PlannedStep>, TooFewFrames> {
        let mut cache = self.clone();
        let mut planned = Vec::new();
        for step in steps.start..steps.end.min(plan.steps().end) {
            let pages = plan.pages(step);
            let mut change = StepChange::default();
            cache.step(step, pages, |page| plan.next_use(page, step + 1), &mut change)?;
            planned.push(PlannedStep { step, pages: pages.len(), change });
        }
        Ok(planned)
    }

    /// Whether a page may be evicted while the batch before `batch` still computes. With `is_last`, no other page can go.
    fn may_evict(&self, victim: &Candidate, batch: u32, is_last: bool) -> bool {
        let ignores_plan = self.idle.policy().ignores_plan();
        is_last || ignores_plan || victim.next_use > batch.saturating_add(FAR_STEPS)
    }

    /// The page that is evicted first, by the next uses known now. What has become known since a page entered the order
    /// can only bring the next use of the page nearer. So the first page whose next use is up to date is the farthest.
    fn first_exact(&mut self, next_use: impl Fn(PageNo) -> Option<u32>) -> Option<Candidate> {
        loop {
            let first = self.idle.first()?;
            let exact = next_use(first.page).unwrap_or(NEVER);
            if self.idle.policy().ignores_plan() || exact >= first.next_use {
                return Some(first);
            }
            self.idle.insert(Candidate { next_use: exact, ..first });
        }
    }

    /// Moves pages of the last batch to the pages that can be evicted.
    fn add_idle(&mut self, past: &mut Vec<PageNo>, next_use: impl Fn(PageNo) -> Option<u32>) {
        let last_use = self.clock;
        for page in past.drain(..) {
            self.idle.insert(Candidate { page, next_use: next_use(page).unwrap_or(NEVER), last_use });
        }
    }

    fn is_present(&self, page: PageNo) -> bool {
        !self.idle.contains(page) && self.needed_by.get(page.index()).is_some_and(|&batch| batch == self.last_batch + 1)
    }

    fn add_present(&mut self, page: PageNo, batch: u32) {
        if self.needed_by.len() <= page.index() {
            self.needed_by.resize(page.index() + 1, 0);
        }
        self.needed_by[page.index()] = batch + 1;
        self.present.push(page);
    }
}

/// One step of a plan as a cache will go through it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlannedStep {
    pub step: u32,
    /// Number of pages that the step needs.
    pub pages: usize,
    /// Pages that enter and leave the cache before the step.
    pub change: StepChange,
}

impl fmt::Display for PlannedStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let StepChange { admit, evict, .. } = &self.change;
        write!(f, "step {}: {} pages, admit {}, evict {}", self.step, self.pages, admit.len(), evict.len())?;
        for (sign, list) in [('+', admit), ('-', evict)] {
            if !list.is_empty() {
                write!(f, "\n  {sign}")?;
                list.iter().try_for_each(|page| write!(f, " {}", page.0))?;
            }
        }
        Ok(())
    }
}
