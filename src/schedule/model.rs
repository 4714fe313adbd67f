//! What a cache of pages does step by step: which pages enter, which leave. A model: numbers of pages, no bytes.
//!
//! Invariants: 1. all pages of a step are in the cache at once, and no page leaves in the step that needs it; 2. no page
//! leaves before its frame is needed; 3. under [`Policy::Farthest`] the page whose next use is farthest leaves first,
//! and with the whole future known no cache of this size reads fewer pages (Belady 1966, "A study of replacement
//! algorithms for virtual-storage computers"; for sets of pages the same exchange argument holds, and a test compares
//! with all possible choices); [`Policy::Ahead`] reads a little more, so that its frames are free earlier; 4. ties leave in
//! the order of their last use, then by page number, so a run of the model is a function of what it is told.

use crate::base::ids::PageNo;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// A page that the plan does not know a use of.
const UNKNOWN: u32 = u32::MAX;

/// A page that is not needed for so many steps may leave for a page that the next step would wait for: at most one read
/// more in so many steps. With frames for a tenth of a large survey, of which a view needs 5 % of the pages, 4, 16 and 40
/// steps read 4.3, 1.7 and 1.4 % more than need be (measured while only the next step was planned anew: .3 % since), and 2.5,
/// 3.1 and 3.1 % of the pages had to be waited for; with less reading 40 was the fastest, in small surveys as well.
pub const FAR_STEPS: u32 = 40;

/// Which page leaves first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// The one with the farthest next use.
    Farthest,
    /// As [`Policy::Farthest`], but a page of the step before only where no other is unneeded for [`FAR_STEPS`]: the frame
    /// of another is free while that step computes. So does a run that reads ahead.
    Ahead,
    /// The one with the oldest last use.
    LeastRecent,
}

impl Policy {
    /// The best and the most common.
    pub const COMPARED: [Policy; 2] = [Policy::Farthest, Policy::LeastRecent];

    /// Name on command lines and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Policy::Farthest => "belady",
            Policy::Ahead => "ahead",
            Policy::LeastRecent => "lru",
        }
    }
}

/// Pages that enter and leave before a step, in the order in which they do.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct StepChange {
    /// Read from disk.
    pub admit: Vec<PageNo>,
    /// Their frames are taken.
    pub evict: Vec<PageNo>,
    /// The step that last needed each of these.
    pub last_uses: Vec<u32>,
}

/// A step needs more pages at once than there are frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("step {step} needs {needed} pages at once, but there are {frames} frames")]
pub struct TooFewFrames {
    /// The step.
    pub step: u32,
    /// Pages that it needs.
    pub needed: usize,
    /// Frames that there are.
    pub frames: usize,
}

#[derive(Debug, Clone, Copy, Default)]
struct PageState {
    is_resident: bool,
    last_use: u32,
}

/// Order of leaving: next use, then older last use, then lower number.
type Key = (u32, Reverse<u32>, Reverse<PageNo>);

/// The model.
#[derive(Debug, Clone)]
pub struct CacheModel {
    frames: usize,
    policy: Policy,
    pages: Vec<PageState>,
    resident: usize,
    /// At least one entry for each resident page. An entry is out of date when the page was used since or left. A next
    /// use may have become known since, which only brings it nearer: so entries are bounds from above, and the first
    /// that is found to be exact is the farthest.
    heap: BinaryHeap<Key>,
}

impl CacheModel {
    /// An empty cache of `frames` frames.
    pub fn new(frames: usize, policy: Policy) -> CacheModel {
        CacheModel { frames, policy, pages: Vec::new(), resident: 0, heap: BinaryHeap::new() }
    }

    /// Frames.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Whether a page is in the cache.
    pub fn holds(&self, page: PageNo) -> bool {
        self.pages.get(page.index()).is_some_and(|p| p.is_resident)
    }

    /// Goes through one step that needs `pages`, each named once. `next_use` tells the step after this one in which a
    /// page is needed next, if that is known. `change` is overwritten. Steps must ascend.
    ///
    /// # Errors
    /// There are fewer frames than pages; nothing has changed then.
    pub fn step(
        &mut self,
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
        if let Some(last) = pages.iter().max()
            && self.pages.len() <= last.index()
        {
            self.pages.resize(last.index() + 1, PageState::default());
        }
        let policy = self.policy;
        let next_use = |page| match policy {
            Policy::Farthest | Policy::Ahead => next_use(page).unwrap_or(UNKNOWN),
            Policy::LeastRecent => UNKNOWN,
        };
        for &page in pages {
            let state = &mut self.pages[page.index()];
            // New last uses put the entries of these pages out of date: none of them can leave.
            state.last_use = step;
            if !state.is_resident {
                change.admit.push(page);
            }
        }
        // Pages of the step before, while others leave in their place.
        let mut spared = Vec::new();
        let mut spares = policy == Policy::Ahead;
        while self.resident + change.admit.len() > self.frames {
            let top = self.pop_exact(next_use);
            if spares {
                match top {
                    Some(key) if key.1.0 + 1 == step => spared.push(key),
                    Some(key) if key.0 > step.saturating_add(FAR_STEPS) => self.evict(key, change),
                    other => {
                        spares = false;
                        self.heap.extend(spared.drain(..).chain(other));
                    }
                }
                continue;
            }
            let Some(key) = top else { break };
            self.evict(key, change);
        }
        self.heap.extend(spared);
        for &page in &change.admit {
            self.pages[page.index()].is_resident = true;
        }
        self.resident += change.admit.len();
        self.heap.extend(pages.iter().map(|&page| (next_use(page), Reverse(step), Reverse(page))));
        self.drop_old_entries();
        Ok(())
    }

    /// The page that leaves first of those that are not needed now.
    fn pop_exact(&mut self, next_use: impl Fn(PageNo) -> u32) -> Option<Key> {
        loop {
            let (bound, last_use, page) = self.heap.pop()?;
            let state = self.pages[page.0.index()];
            if !state.is_resident || state.last_use != last_use.0 {
                continue;
            }
            let exact = next_use(page.0);
            if exact >= bound {
                return Some((bound, last_use, page));
            }
            self.heap.push((exact, last_use, page));
        }
    }

    fn evict(&mut self, (_, last_use, page): Key, change: &mut StepChange) {
        self.pages[page.0.index()].is_resident = false;
        self.resident -= 1;
        change.evict.push(page.0);
        change.last_uses.push(last_use.0);
    }

    /// Entries that are out of date but never reach the top are dropped when they are the greater part.
    fn drop_old_entries(&mut self) {
        if self.heap.len() > 4 * self.frames + 1024 {
            let pages = &self.pages;
            self.heap.retain(|&(_, Reverse(last_use), Reverse(page))| {
                let state = pages[page.index()];
                state.is_resident && state.last_use == last_use
            });
        }
    }
}
