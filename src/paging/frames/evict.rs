//! The order in which pages are evicted. The frame table, the look-ahead of a run and the simulations use this one order.
//!
//! Under [`EvictPolicy::FarthestNextUse`] the order is Belady's (1966, "A study of replacement algorithms for
//! virtual-storage computers"): the page whose next use is farthest is evicted first.
//!
//! Invariants: 1. the order is total and depends on pages alone, never on the frames that hold them: ties in the next use
//! go to the page with the older last use, then to the lower page number; 2. the next victim costs a heap operation, never a
//! search through all pages; 3. memory grows with the pages, not with the number of changes.

use crate::base::ids::PageNo;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Next use of a page that no planned step needs.
pub const NEVER: u32 = u32::MAX;

/// Outdated entries that the heap may always hold before they are dropped.
const OUTDATED_LEAST: usize = 1024;

/// Which page is evicted first: of a run and of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EvictPolicy {
    /// The page with the farthest next use; ties go to the least recently used page.
    #[default]
    FarthestNextUse,
    /// The least recently used page. It ignores the plan and serves for comparison.
    LeastRecentlyUsed,
}

impl EvictPolicy {
    /// All policies, the default first.
    pub const ALL: [EvictPolicy; 2] = [EvictPolicy::FarthestNextUse, EvictPolicy::LeastRecentlyUsed];

    /// Whether the order of eviction is the same whatever is planned.
    pub fn ignores_plan(self) -> bool {
        match self {
            EvictPolicy::FarthestNextUse => false,
            EvictPolicy::LeastRecentlyUsed => true,
        }
    }

    /// The place of a page in the order.
    pub fn key(self, candidate: Candidate) -> Key {
        let age = u32::MAX - candidate.last_use;
        let by = match self {
            EvictPolicy::FarthestNextUse => [candidate.next_use, age],
            EvictPolicy::LeastRecentlyUsed => [age, 0],
        };
        Key { by, page: Reverse(candidate.page) }
    }
}

/// A page that could be evicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Candidate {
    pub page: PageNo,
    /// The next planned step that needs the page, or [`NEVER`].
    pub next_use: u32,
    /// Number of steps begun at the last use, in runs and in simulations; 0: no use yet. Smaller is older.
    pub last_use: u32,
}

/// Place of a page in the order: the greatest key is evicted first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    /// Two numbers that the policy orders by.
    by: [u32; 2],
    page: Reverse<PageNo>,
}

/// Pages that can be evicted, in the order of eviction.
#[derive(Debug, Clone)]
pub struct EvictOrder {
    policy: EvictPolicy,
    /// By page: next use and last use of the pages in the order.
    uses: Vec<Option<(u32, u32)>>,
    len: usize,
    /// The keys of all pages in the order, and outdated keys of pages that have left or changed since.
    heap: BinaryHeap<Key>,
}

impl EvictOrder {
    pub fn new(policy: EvictPolicy) -> EvictOrder {
        EvictOrder { policy, uses: Vec::new(), len: 0, heap: BinaryHeap::new() }
    }

    pub fn policy(&self) -> EvictPolicy {
        self.policy
    }

    pub fn len(&self) -> usize {
        self.len
    }

    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    pub fn contains(&self, page: PageNo) -> bool {
        self.uses.get(page.index()).is_some_and(Option::is_some)
    }

    /// Removes all pages; keeps the allocations.
    pub fn clear(&mut self) {
        self.uses.fill(None);
        self.heap.clear();
        self.len = 0;
    }

    /// Adds a page, or changes the uses of a page that is in the order.
    pub fn insert(&mut self, candidate: Candidate) {
        let Candidate { page, next_use, last_use } = candidate;
        if self.uses.len() <= page.index() {
            self.uses.resize(page.index() + 1, None);
        }
        let key = self.policy.key(candidate);
        match self.uses[page.index()].replace((next_use, last_use)) {
            // The heap has this key already.
            Some((next_use, last_use)) if self.policy.key(Candidate { page, next_use, last_use }) == key => return,
            Some(_) => {}
            None => self.len += 1,
        }
        self.heap.push(key);
        self.drop_outdated();
    }

    /// Removes a page; `false` if the page was not in the order.
    pub fn remove(&mut self, page: PageNo) -> bool {
        let was_there = self.uses.get_mut(page.index()).and_then(Option::take).is_some();
        self.len -= usize::from(was_there);
        was_there
    }

    /// The page that is evicted first.
    pub fn first(&mut self) -> Option<Candidate> {
        self.first_key()?;
        let page = self.heap.peek()?.page.0;
        let (next_use, last_use) = (*self.uses.get(page.index())?)?;
        Some(Candidate { page, next_use, last_use })
    }

    /// The key of the page that is evicted first, to compare two orders of one policy.
    pub(super) fn first_key(&mut self) -> Option<Key> {
        while let Some(&key) = self.heap.peek() {
            if self.is_current(key) {
                return Some(key);
            }
            self.heap.pop();
        }
        None
    }

    fn is_current(&self, key: Key) -> bool {
        let page = key.page.0;
        self.uses[page.index()]
            .is_some_and(|(next_use, last_use)| self.policy.key(Candidate { page, next_use, last_use }) == key)
    }

    /// Drops outdated keys when they are the greater part of the heap.
    fn drop_outdated(&mut self) {
        if self.heap.len() > 4 * self.len + OUTDATED_LEAST {
            let mut heap = std::mem::take(&mut self.heap);
            heap.retain(|&key| self.is_current(key));
            self.heap = heap;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    /// Against a search through all pages, over insertions, changes and removals.
    #[test]
    fn the_first_page_is_always_the_greatest_and_the_heap_stays_small() {
        let mut draws = Stream::new(7, Purpose::Test, 3, 1);
        for policy in EvictPolicy::ALL {
            let mut order = EvictOrder::new(policy);
            let mut held = [None; 50];
            for _ in 0..20_000 {
                let page = draws.below(50) as usize;
                if draws.below(3) == 0 {
                    assert_eq!(order.remove(PageNo(page as u32)), held[page].take().is_some());
                } else {
                    let (next_use, last_use) = (draws.below(9) as u32, draws.below(9) as u32);
                    let candidate = Candidate { page: PageNo(page as u32), next_use, last_use };
                    order.insert(candidate);
                    held[page] = Some(candidate);
                }
                let of_policy = |c: &Candidate| match policy {
                    EvictPolicy::FarthestNextUse => (c.next_use, Reverse(c.last_use), Reverse(c.page)),
                    EvictPolicy::LeastRecentlyUsed => (0, Reverse(c.last_use), Reverse(c.page)),
                };
                assert_eq!(order.first(), held.iter().flatten().copied().max_by_key(of_policy));
                assert_eq!(order.len(), held.iter().flatten().count());
                assert!(order.heap.len() <= 4 * 50 + OUTDATED_LEAST + 1);
            }
        }
    }
}
