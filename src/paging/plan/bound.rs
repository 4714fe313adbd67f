//! Belady's bound: the fewest pages that any cache could have read for the steps so far, updated at every step.
//!
//! A page that two steps need, and no step between them, is either kept for the whole interval between the two or read again.
//! Keeping the page takes a frame at every step of the interval, beside the pages that those steps need. To keep as many
//! intervals as possible, take the intervals by their ends, the shorter of equal ends first, and keep each that still fits: an
//! interval that is left out could only replace one that ends no earlier. (Jain and Lin,
//! "Back to the Future: Leveraging Belady's Algorithm for Improved Cache Replacement", ISCA 2016, do it for one access at
//! a time.) So the bound needs no knowledge of the future, only of the past.
//!
//! Invariants: 1. no cache of that many frames reads less than the bound, and a cache that knows the future reads as much;
//! 2. memory grows with the pages and with the steps since the last one that left no frame free.

use crate::base::ids::PageNo;
use std::collections::VecDeque;

/// Never in memory so far.
const ABSENT: u32 = u32::MAX;

/// The bound so far.
#[derive(Debug, Clone, Default)]
pub struct FewestReads {
    /// By page: the step that last had it, counted here.
    last_use: Vec<u32>,
    /// Spare frames at each step from `first` on: all frames less those of the step's own pages and of the pages that are kept across the step.
    spare: VecDeque<u32>,
    /// No interval reaches back before this step: the step before it has no spare frame.
    first: u32,
    /// Bytes read.
    bytes: u64,
    /// For the order in which the pages of a step are looked at.
    order: Vec<(u32, PageNo, u64)>,
}

impl FewestReads {
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Adds a page that was made in memory: at the start, or by a split in the last step.
    pub fn add(&mut self, page: PageNo) {
        let now = (self.first + self.spare.len() as u32).saturating_sub(1);
        self.set_last_use(page, now);
    }

    /// A page lost its copy after the last step, whatever the cache does: the next step that needs the page reads it.
    pub fn lose(&mut self, page: PageNo) {
        if let Some(last) = self.last_use.get_mut(page.index()) {
            *last = ABSENT;
        }
    }

    /// Adds the next step: the pages that it needs, each named once, with their bytes on the drive, and the number of frames at
    /// this step.
    pub fn step(&mut self, frames: usize, pages: impl Iterator<Item = (PageNo, u64)>) {
        let frames = u32::try_from(frames).unwrap_or(u32::MAX);
        if self.first == 0 && self.spare.is_empty() {
            // Step 0 made the first pages, and at step 1 those that were chosen are in the frames.
            self.spare.extend([frames, frames]);
        }
        let now = self.first + self.spare.len() as u32;
        self.order.clear();
        for (page, bytes) in pages {
            let last = self.last_use.get(page.index()).copied().unwrap_or(ABSENT);
            self.order.push((last, page, bytes));
        }
        // The latest use first; pages that were never in memory count as the oldest.
        self.order.sort_unstable_by_key(|&(last, page, _)| (std::cmp::Reverse(last.wrapping_add(1)), page));
        let needed = self.order.len() as u32;
        let order = std::mem::take(&mut self.order);
        for &(last, page, bytes) in &order {
            if !self.keep(last, now) {
                self.bytes += bytes;
            }
            self.set_last_use(page, now);
        }
        self.order = order;
        self.spare.push_back(frames.saturating_sub(needed));
        if needed >= frames {
            self.forget_until(now);
        }
    }

    /// Keeps a page between two steps, if every step between them has a spare frame.
    fn keep(&mut self, last: u32, now: u32) -> bool {
        // Steps without a spare frame lie before `first`. The two steps that need the page have a frame for it.
        if last == ABSENT || last + 1 < self.first {
            return false;
        }
        let mut full = None;
        for step in last + 1..now {
            let spare = &mut self.spare[(step - self.first) as usize];
            *spare -= 1;
            if *spare == 0 {
                full = Some(step);
            }
        }
        if let Some(step) = full {
            self.forget_until(step);
        }
        true
    }

    /// Nothing can be kept across `step`.
    fn forget_until(&mut self, step: u32) {
        self.spare.drain(..(step + 1 - self.first) as usize);
        self.first = step + 1;
    }

    fn set_last_use(&mut self, page: PageNo, step: u32) {
        if self.last_use.len() <= page.index() {
            self.last_use.resize(page.index() + 1, ABSENT);
        }
        self.last_use[page.index()] = step;
    }
}
