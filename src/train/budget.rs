//! Keeps a run within its memory while its scene grows: what a view takes is taken from the frames, and a scene that was
//! all in memory is so no more when it does not fit (see `outgrown`).
//!
//! Invariants: 1. frames are taken away before the step that needs their memory, by the most that its view may have grown
//! since the last one; what was taken for growth that did not come is given back; 2. nobody stops for growth that may come:
//! the view of a step has its frames as long as what is known to be needed leaves them; 3. no bit of the result depends
//! on it.

use super::memory::{INDEX_BYTES, MemoryEstimate, frames_in_memory};
use super::pages::PagedScene;
use super::trainer::Trainer;
use crate::scene::camera::Camera;
use crate::scene::columns::row_width;

/// A page may hold more new rows than the mean of all pages: this many times its share.
const UNEVEN: f64 = 2.0;

/// Frames that are left in any case: with none nothing could be written out.
const FRAMES_LEAST: usize = 2;
/// Frames are given back when there are more than one in so many.
const WORTH_GIVING: usize = 16;

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
    /// Frames that the run has a use for.
    frames_most: usize,
    /// The user named this memory, so that it counts more than going on.
    pub(super) is_named: bool,
    /// Commits that there were when pages could not be moved out for want of space.
    pub(super) tried_after: Option<u64>,
    /// Pages in flight ahead of their step, each way, once those of a run in memory move.
    pub(super) prefetch_bytes: usize,
}

impl HostBudget {
    /// Of a run that may take `bytes` and is expected to take `memory`.
    pub fn new(bytes: u64, memory: &MemoryEstimate) -> HostBudget {
        let (constant, of_pixels) = (memory.base + memory.targets, memory.view_pixels);
        HostBudget {
            bytes,
            constant,
            of_pixels,
            staging: memory.staging,
            frames_most: usize::MAX,
            is_named: false,
            tried_after: None,
            prefetch_bytes: 0,
        }
    }

    /// Of a run that has no use for more than so many frames.
    pub fn with_frames(self, frames_most: usize) -> HostBudget {
        HostBudget { frames_most, ..self }
    }

    /// Of a run in memory: what moving its pages would take, if it comes to that, and whether the user named the memory.
    pub fn in_memory(self, prefetch_bytes: usize, staging: u64, is_named: bool) -> HostBudget {
        HostBudget { prefetch_bytes, staging, is_named, ..self }
    }

    /// The same, once pages could not be moved out for want of space, after so many commits.
    pub(super) fn tried(self, commits: Option<u64>) -> HostBudget {
        HostBudget { tried_after: commits, ..self }
    }

    /// All that the run may take, bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Frames for a step whose view needs `needed` pages: those that are left beside what the run holds now and what the view
    /// may need more, since its rows may have become more after they were last counted; but no fewer than the view needs, with
    /// some for pages that split, if what the run holds now leaves them. `view` is what the largest view took so far, bytes.
    pub(super) fn frames(&self, scene: &PagedScene, view: u64, needed: usize) -> usize {
        let left = |growth| {
            let taken = self.taken(scene, view, growth) + self.staging;
            (self.bytes.saturating_sub(taken) / scene.pager.frame_bytes() as u64) as usize
        };
        let enough = left(1.0).min(needed + needed / 4 + 1);
        left(growth_due(scene)).max(enough).clamp(FRAMES_LEAST, self.frames_most.max(FRAMES_LEAST))
    }

    /// Memory with which a view that needs `needed` pages would have its frames.
    pub(super) fn least_for(&self, scene: &PagedScene, view: u64, needed: usize) -> u64 {
        self.taken(scene, view, growth_due(scene)) + self.staging + (needed * scene.pager.frame_bytes()) as u64
    }

    /// Whether all pages fit beside it, of a run that keeps them in memory.
    pub fn holds_all(&self, scene: &PagedScene, view: u64) -> bool {
        let left = self.bytes.saturating_sub(self.taken(scene, view, growth_due(scene)));
        let pages = |have_split| frames_in_memory(scene.rows_bound(), scene.rules.sh_degree(), have_split);
        // Pages are looked at only where it depends on them.
        pages(true) <= left || (pages(false) <= left && !scene.pager.index().iter().any(|page| page.id.is_part()))
    }

    fn taken(&self, scene: &PagedScene, view: u64, growth: f64) -> u64 {
        let of_rows = view.saturating_sub(self.of_pixels) as f64 * growth;
        let index = scene.pager.index().len() as f64 * growth * INDEX_BYTES as f64;
        self.constant + self.of_pixels + (of_rows + index) as u64
    }
}

/// How many times as many rows a view may have as when they were last counted.
fn growth_due(scene: &PagedScene) -> f64 {
    let (rows, bound) = (scene.rows().max(1) as f64, scene.rows_bound() as f64);
    1.0 + UNEVEN * (bound / rows - 1.0).max(0.0)
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

    /// Takes away the frames that the scene, as it has grown, leaves no memory for, and gives back what was taken for growth
    /// that did not come. Between steps; the next one has this camera.
    pub(super) fn fit_frames(&mut self, camera: &Camera) {
        let Some(budget) = self.budget.filter(|_| !self.is_in_memory()) else { return };
        let needed = self.scene.pager.pages_of_view(camera).len();
        let frames = budget.frames(&self.scene, self.view_at_last(), needed);
        let pager = &mut self.scene.pager;
        let now = pager.stats().frames_max;
        if frames > now + now / WORTH_GIVING || (frames > now && needed >= now) {
            pager.allow_frames(frames);
        } else {
            pager.limit_frames(frames);
        }
    }

    /// Whether no page ever leaves memory.
    pub(super) fn is_in_memory(&self) -> bool {
        self.scene.pager.stats().frames_max == usize::MAX
    }
}
