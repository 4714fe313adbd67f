//! The coming steps with the pages that they need, and when each page is needed next.
//!
//! A [`Plan`] is a window: steps are pushed at its end as their views become known and popped at its front as they are
//! done, both at the cost of their own pages. Not here: what a cache does with it (`model`), which views come (`order`), and
//! pages that move or split while a run goes on (`paging`'s own window).
//!
//! Invariants: 1. steps are consecutive; 2. the entries of one page form a chain in the order of steps, so the next use
//! of a page is at the front of its chain; 3. entries never take more than the bytes given, whatever is pushed (but one
//! step always fits); 4. beyond the end nothing is known: `None`.

use super::model::{CacheModel, StepChange, TooFewFrames};
use crate::base::ids::PageNo;
use std::collections::VecDeque;
use std::fmt;
use std::ops::Range;

/// No entry.
const NONE: u64 = u64::MAX;

/// One page in one step.
#[derive(Debug, Clone, Copy)]
struct Entry {
    page: PageNo,
    step: u32,
    /// Entries from here to the next one of the same page; 0 while there is none.
    next: u32,
}

/// First and last entry of a page's chain, by running number.
#[derive(Debug, Clone, Copy)]
struct Chain {
    first: u64,
    last: u64,
}

/// The window of planned steps.
#[derive(Debug, Clone)]
pub struct Plan {
    entries: VecDeque<Entry>,
    /// Running number of the front entry.
    front: u64,
    /// Entries of each step.
    counts: VecDeque<u32>,
    first_step: u32,
    chains: Vec<Chain>,
    max_entries: usize,
}

impl Plan {
    /// An empty plan that starts at `first_step` and whose entries take at most `max_bytes`.
    pub fn new(first_step: u32, max_bytes: u64) -> Plan {
        Plan {
            entries: VecDeque::new(),
            front: 0,
            counts: VecDeque::new(),
            first_step,
            chains: Vec::new(),
            max_entries: (max_bytes / size_of::<Entry>() as u64).try_into().unwrap_or(usize::MAX),
        }
    }

    /// The planned steps.
    pub fn steps(&self) -> Range<u32> {
        self.first_step..self.first_step + self.counts.len() as u32
    }

    /// Bytes that the plan has reserved.
    pub fn bytes(&self) -> u64 {
        (self.entries.capacity() * size_of::<Entry>()
            + self.counts.capacity() * size_of::<u32>()
            + self.chains.capacity() * size_of::<Chain>()) as u64
    }

    /// Forgets all steps and begins again at `first_step`; keeps the allocations.
    pub fn restart(&mut self, first_step: u32) {
        self.front += self.entries.len() as u64;
        self.entries.clear();
        self.counts.clear();
        self.chains.fill(Chain { first: NONE, last: NONE });
        self.first_step = first_step;
    }

    /// Plans the step after the last one: `pages` are what it needs, each once. Returns false, and changes nothing, when
    /// the bytes are used up: pop first.
    pub fn push(&mut self, pages: &[PageNo]) -> bool {
        let needed = self.entries.len() + pages.len();
        if needed > self.max_entries && !self.counts.is_empty() {
            return false;
        }
        if needed > self.entries.capacity() {
            // Twice as many, but no more than promised.
            let capacity = (2 * needed).min(self.max_entries).max(needed);
            self.entries.reserve_exact(capacity - self.entries.len());
        }
        let step = self.steps().end;
        for &page in pages {
            let at = self.front + self.entries.len() as u64;
            self.entries.push_back(Entry { page, step, next: 0 });
            if self.chains.len() <= page.index() {
                self.chains.resize(page.index() + 1, Chain { first: NONE, last: NONE });
            }
            let chain = &mut self.chains[page.index()];
            if chain.first == NONE {
                chain.first = at;
            } else {
                self.entries[(chain.last - self.front) as usize].next = (at - chain.last) as u32;
            }
            chain.last = at;
        }
        self.counts.push_back(pages.len() as u32);
        true
    }

    /// Drops the first step, which is done. Does nothing when there is none.
    pub fn pop(&mut self) {
        let Some(count) = self.counts.pop_front() else { return };
        for _ in 0..count {
            let Some(entry) = self.entries.pop_front() else { break };
            let chain = &mut self.chains[entry.page.index()];
            chain.first = if entry.next == 0 { NONE } else { chain.first + u64::from(entry.next) };
            self.front += 1;
        }
        self.first_step += 1;
    }

    /// The pages that a planned step needs; nothing for a step outside of the plan.
    pub fn pages(&self, step: u32) -> impl Iterator<Item = PageNo> {
        let at = step.wrapping_sub(self.first_step) as usize;
        let range = if self.steps().contains(&step) {
            // Few steps lie between the front and the one that is asked for: no index of starts is kept.
            let start: usize = self.counts.range(..at).map(|&c| c as usize).sum();
            start..start + self.counts[at] as usize
        } else {
            0..0
        };
        self.entries.range(range).map(|entry| entry.page)
    }

    /// The first planned step at or after `step` that needs `page`; `None` when the plan has none.
    pub fn next_use(&self, page: PageNo, step: u32) -> Option<u32> {
        let mut at = self.chains.get(page.index())?.first;
        while at != NONE {
            let entry = &self.entries[(at - self.front) as usize];
            if entry.step >= step {
                return Some(entry.step);
            }
            at = if entry.next == 0 { NONE } else { at + u64::from(entry.next) };
        }
        None
    }

    /// What the cache, which stands before the first of `steps`, will admit and evict in these steps if nothing becomes
    /// known that is not known now. `steps` must start with the plan; it is cut at its end.
    ///
    /// # Errors
    /// A step needs more frames than there are.
    pub fn changes(&self, cache: &CacheModel, steps: Range<u32>) -> Result<Vec<PlannedStep>, TooFewFrames> {
        let mut cache = cache.clone();
        let mut pages = Vec::new();
        let mut planned = Vec::new();
        for step in steps.start..steps.end.min(self.steps().end) {
            pages.clear();
            pages.extend(self.pages(step));
            let mut change = StepChange::default();
            cache.step(step, &pages, |page| self.next_use(page, step + 1), &mut change)?;
            planned.push(PlannedStep { step, pages: pages.len(), change });
        }
        Ok(planned)
    }
}

/// One step of a plan as a cache will go through it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlannedStep {
    /// The step.
    pub step: u32,
    /// Pages that it needs.
    pub pages: usize,
    /// What enters and leaves the cache before it.
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

impl fmt::Display for Plan {
    /// One line a step: its pages.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let steps = self.steps();
        write!(f, "plan of steps {}..{}, {} entries", steps.start, steps.end, self.entries.len())?;
        let mut entries = self.entries.iter();
        for (step, &count) in steps.zip(&self.counts) {
            write!(f, "\nstep {step}:")?;
            entries.by_ref().take(count as usize).try_for_each(|entry| write!(f, " {}", entry.page.0))?;
        }
        Ok(())
    }
}
