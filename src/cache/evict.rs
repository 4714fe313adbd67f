//! Which page leaves first.
//!
//! Invariants: 1. the order is total: two runs with the same history evict the same pages; 2. finding the next victim
//! costs a search in an ordered set, never a look at every frame.

use std::collections::BTreeSet;

/// Next use of a page that no planned step needs.
pub const NEVER: u32 = u32::MAX;

/// What decides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EvictPolicy {
    /// The page whose next use is farthest leaves first; among equals the one that was not used for longest.
    #[default]
    FarthestNextUse,
    /// The page that was not used for longest leaves first, whatever is planned: for comparison.
    LeastRecentlyUsed,
}

/// Frames that can be evicted, in the order of leaving: the last one first.
#[derive(Debug)]
pub(super) struct EvictQueue {
    policy: EvictPolicy,
    /// (next use, time since the last use, frame).
    order: BTreeSet<(u32, u32, u32)>,
}

impl EvictQueue {
    pub fn new(policy: EvictPolicy) -> Self {
        EvictQueue { policy, order: BTreeSet::new() }
    }

    /// Everything that changes the key of a frame takes it out with the old key and puts it in with the new one.
    pub fn insert(&mut self, frame: u32, next_use: u32, last_use: u32) {
        self.order.insert(self.key(frame, next_use, last_use));
    }

    pub fn remove(&mut self, frame: u32, next_use: u32, last_use: u32) {
        let was_there = self.order.remove(&self.key(frame, next_use, last_use));
        debug_assert!(was_there, "frame {frame} was queued with another key");
    }

    /// The key of the frame that leaves first: larger leaves earlier.
    pub fn first(&self) -> Option<(u32, u32, u32)> {
        self.order.last().copied()
    }

    fn key(&self, frame: u32, next_use: u32, last_use: u32) -> (u32, u32, u32) {
        let next_use = match self.policy {
            EvictPolicy::FarthestNextUse => next_use,
            EvictPolicy::LeastRecentlyUsed => 0,
        };
        (next_use, u32::MAX - last_use, frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn policies_order_as_they_say() {
        // (next use, last use) of frames 0..4.
        let frames = [(5, 1), (NEVER, 4), (9, 2), (NEVER, 3), (9, 2)];
        let order = |policy| {
            let mut queue = EvictQueue::new(policy);
            (0..5).for_each(|i| queue.insert(i, frames[i as usize].0, frames[i as usize].1));
            let mut left = Vec::new();
            while let Some((_, _, frame)) = queue.first() {
                let (next_use, last_use) = frames[frame as usize];
                queue.remove(frame, next_use, last_use);
                left.push(frame);
            }
            left
        };
        assert_eq!(order(EvictPolicy::FarthestNextUse), [3, 1, 4, 2, 0]);
        assert_eq!(order(EvictPolicy::LeastRecentlyUsed), [0, 4, 2, 3, 1]);
    }
}
