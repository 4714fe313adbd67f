//! Keeps a run within its memory while its scene grows: what a view takes is taken from the frames, and a scene that was
//! all in memory is so no more when it does not fit (see `outgrown`).
//!
//! Invariants: 1. frames are only ever taken away; 2. they are taken before the step that needs their memory, by the most
//! that its view may have grown since the last one; 3. no bit of the result depends on it.

use super::memory::{INDEX_BYTES, MemoryEstimate, frames_in_memory};
use super::pages::PagedScene;
use super::trainer::Trainer;
use crate::scene::columns::row_width;

/// A page may hold more new rows than the mean of all pages: this many times its share.
const UNEVEN: f64 = 2.0;

/// The memory of a run whose frames follow from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostBudget {
    /// All that the run may take, bytes.
    bytes: u64,
    /// What does not grow with the scene, staging apart.
    constant: u64,
    /// For pages that move.
    staging: u64,
    /// What of a view grows with its pixels alone.
    of_pixels: u64,
    /// Pages in flight ahead of their step, each way, once those of a run in memory move.
    pub(super) prefetch_bytes: usize,
}

impl HostBudget {
    /// Of a run that may take `bytes` and is expected to take `memory`.
    pub fn new(bytes: u64, memory: &MemoryEstimate) -> HostBudget {
        let constant = memory.base + memory.targets;
        HostBudget { bytes, constant, staging: memory.staging, of_pixels: memory.view_pixels, prefetch_bytes: 0 }
    }

    /// Of a run in memory: what moving its pages would take, if it comes to that.
    pub fn with_staging(self, prefetch_bytes: usize, staging: u64) -> HostBudget {
        HostBudget { prefetch_bytes, staging, ..self }
    }

    /// All that the run may take, bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Frames that are left beside what the run holds now, and what the next view may need more: its rows may have become
    /// more since they were last counted. `view` is what the largest view took so far, bytes.
    pub fn frames(&self, scene: &PagedScene, view: u64) -> usize {
        let taken = self.taken(scene, view) + self.staging;
        (self.bytes.saturating_sub(taken) / scene.pager.frame_bytes() as u64) as usize
    }

    /// Whether all pages fit beside it, of a run that keeps them in memory.
    pub fn holds_all(&self, scene: &PagedScene, view: u64) -> bool {
        let left = self.bytes.saturating_sub(self.taken(scene, view));
        let pages = |have_split| frames_in_memory(scene.rows_bound(), scene.rules.sh_degree(), have_split);
        // Pages are looked at only where it depends on them.
        pages(true) <= left || (pages(false) <= left && !scene.pager.index().iter().any(|page| page.id.is_part()))
    }

    fn taken(&self, scene: &PagedScene, view: u64) -> u64 {
        let (rows, bound) = (scene.rows().max(1) as f64, scene.rows_bound() as f64);
        let growth = 1.0 + UNEVEN * (bound / rows - 1.0).max(0.0);
        let of_rows = view.saturating_sub(self.of_pixels) as f64 * growth;
        let index = scene.pager.index().len() as f64 * growth * INDEX_BYTES as f64;
        self.constant + self.of_pixels + (of_rows + index) as u64
    }
}

impl Trainer {
    /// Stays within this memory from now on, as far as frames that give way can do it.
    pub fn set_budget(&mut self, budget: HostBudget) {
        self.budget = Some(budget);
    }

    /// What the largest view took so far, as wide as its rows will be when all bands are in use.
    pub(super) fn view_at_last(&self) -> u64 {
        let [working, rendering] = self.view_bytes();
        let [now, last] = [self.working.columns.sh_degree, self.sh_degrees().1].map(|degree| row_width(degree) as u64);
        working / now * last + rendering
    }

    /// Takes away the frames that the scene, as it has grown, leaves no memory for. Between steps.
    pub(super) fn fit_frames(&mut self) {
        if let Some(budget) = self.budget.filter(|_| !self.is_in_memory()) {
            self.scene.pager.limit_frames(budget.frames(&self.scene, self.view_at_last()));
        }
    }

    /// Whether no page ever leaves memory.
    pub(super) fn is_in_memory(&self) -> bool {
        self.scene.pager.stats().frames_max == usize::MAX
    }
}
