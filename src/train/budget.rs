//! Keeps a run within its memory while its scene grows: what a view takes is taken from the frames, and a scene that was
//! all in memory moves out of it when it does not fit any more (see `outgrown`).
//!
//! Invariants: 1. the number of frames follows from bytes alone: what the run holds beside its frames, and what is left;
//! never from a number of pages that was guessed at the start. Frames take memory when pages fill them; 2. frames are taken
//! away before the step that needs their memory, by the most that its view may have grown since the last one; what was
//! taken for growth that did not come is given back; 3. no run stops for growth that may come: a step gets the frames that
//! it needs as long as what the run holds now leaves memory for them. A run that was not told how much memory it may take
//! goes beyond its first share for that, as far as the machine has memory available; 4. no bit of the result depends on
//! any of this.

use super::memory::{INDEX_BYTES, MemoryEstimate, bytes_of_copies, frames_in_memory, within_reach};
use super::pages::PagedScene;
use super::staging::{PLAN_BYTES, PLAN_BYTES_LEAST, with_staging};
use crate::page::format::slot_header::HEADER_BYTES;

/// A page may hold more new rows than the mean of all pages: this many times its share.
const UNEVEN: f64 = 2.0;

/// Frames that are left in any case: with none nothing could be written out.
const FRAMES_LEAST: usize = 2;
/// A step that needs frames gets one in so many on top, and a run that needs memory one byte in so many, so that the next
/// steps of a growing scene need not ask again.
pub(super) const SPARE_SHARE: usize = 8;
/// Vectors of a view that is a little larger than those before it grow by an eighth.
const VIEW_SPARE: f64 = 1.125;

/// Memory of a page in memory beside its rows, bytes: the header, and half of the last page of the system's that they
/// begin. Nothing for pages of a thousand rows, a fifth for those of 32.
const AROUND_ROWS: f64 = HEADER_BYTES as f64 + 2048.0;

/// What one view takes, bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct ViewMemory {
    /// The largest view so far, as wide as its rows are with the bands that are in use.
    pub now: u64,
    /// The same with the bands of the last step.
    pub at_last: u64,
}

/// A view that needs more than there is.
#[derive(Debug, Clone, Copy)]
pub(super) struct ViewNeed {
    /// Pages that it needs at once, with those into which its pages will split.
    pub pages: usize,
    /// Its rows, over those of the largest view so far; at least 1.
    pub growth: f64,
}

/// The memory of a run whose frames follow from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostBudget {
    /// All that the run may take, bytes.
    pub(super) bytes: u64,
    /// What does not grow with the scene, staging apart.
    constant: u64,
    /// Whether rounds of densification copy pages.
    copies_pages: bool,
    /// For pages that move.
    pub(super) staging: u64,
    /// What of a view grows with its pixels alone.
    of_pixels: u64,
    /// The user named this memory: the run never takes more.
    is_named: bool,
    /// It is more than the run set out with.
    pub(super) is_raised: bool,
    /// The plan of the coming steps gave way to frames.
    is_plan_small: bool,
    /// Commits that there were when pages could not be moved out for want of space.
    pub(super) tried_after: Option<u64>,
    /// Pages in flight ahead of their step, each way, once those of a run in memory move.
    pub(super) prefetch_bytes: usize,
}

impl HostBudget {
    /// Of a run that may take `bytes`, which the user named or not, and is expected to take `memory`.
    pub fn new(bytes: u64, memory: &MemoryEstimate, is_named: bool) -> HostBudget {
        HostBudget {
            bytes,
            constant: memory.base + memory.targets,
            copies_pages: memory.copies > 0,
            staging: memory.staging,
            of_pixels: memory.view_pixels,
            is_named,
            is_raised: false,
            is_plan_small: false,
            tried_after: None,
            prefetch_bytes: 0,
        }
    }

    /// Of a run that takes more from its start than it would by itself, which was said.
    pub(super) fn raised_at_start(self) -> HostBudget {
        HostBudget { is_raised: true, ..self }
    }

    /// Of a run in memory: what moving its pages would take, if it comes to that.
    pub fn in_memory(self, prefetch_bytes: usize, staging: u64) -> HostBudget {
        HostBudget { prefetch_bytes, staging, ..self }
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
    /// may need more, since its rows may have become more after they were last counted. If those are too few for the view, it
    /// gets what it needs, with some for pages that split, from what would be left if nothing grew.
    pub(super) fn frames(&self, scene: &PagedScene, view: ViewMemory, needed: usize) -> usize {
        let with_splits = self.left(scene, view.at_last, 1.0).min(needed + needed / 4 + 1);
        let bare = self.frames_at_most(scene, view).min(needed);
        self.left(scene, view.at_last, growth_due(scene)).max(with_splits).max(bare).max(FRAMES_LEAST)
    }

    /// Frames that what the run holds now leaves memory for.
    pub(super) fn frames_at_most(&self, scene: &PagedScene, view: ViewMemory) -> usize {
        self.left(scene, view.now, 1.0)
    }

    fn left(&self, scene: &PagedScene, view: u64, growth: f64) -> usize {
        let taken = self.taken(scene, view, growth) + self.staging;
        (self.bytes.saturating_sub(taken) / scene.pager.frame_bytes() as u64) as usize
    }

    /// Memory with which a run that goes on from here gets the frames that all of these views need: always more than this.
    pub(super) fn least_for(&self, scene: &PagedScene, view: ViewMemory, needs: &[ViewNeed]) -> u64 {
        // The run that goes on has its whole plan again.
        let staging = self.staging + if self.is_plan_small { (PLAN_BYTES - PLAN_BYTES_LEAST) as u64 } else { 0 };
        let frame_bytes = scene.pager.frame_bytes() as u64;
        let need = |need: &ViewNeed| {
            let of_rows = view.at_last.saturating_sub(self.of_pixels) as f64 * need.growth * VIEW_SPARE;
            let rest = self.taken(scene, self.of_pixels + of_rows as u64, 1.0) + need.pages as u64 * frame_bytes;
            with_staging(rest, staging, self.bytes)
        };
        let least = needs.iter().map(need).max().unwrap_or(0);
        // A sixteenth for what the run that goes on measures anew before its first step.
        (least + least / 16).max(self.bytes + frame_bytes)
    }

    /// This budget with a small plan, which leaves more for frames; `None` where the plan is small already.
    pub(super) fn with_small_plan(&self) -> Option<HostBudget> {
        let spare = (PLAN_BYTES - PLAN_BYTES_LEAST) as u64;
        let staging = self.staging.checked_sub(spare).filter(|_| !self.is_plan_small)?;
        Some(HostBudget { staging, is_plan_small: true, ..*self })
    }

    /// This budget with `bytes` bytes and some to spare, where nobody named it and the machine has them; `None` where not.
    pub(super) fn raised(&self, bytes: u64) -> Option<HostBudget> {
        let most = if self.is_named { None } else { within_reach() }?;
        let raised = (bytes + bytes / SPARE_SHARE as u64).min(most).max(self.bytes);
        (bytes <= most).then_some(HostBudget { bytes: raised, is_raised: true, ..*self })
    }

    /// Whether all pages fit beside it, of a run that keeps them in memory.
    pub fn holds_all(&self, scene: &PagedScene, view: u64) -> bool {
        // Pages are looked at only where it depends on them.
        self.bytes_of_all(scene, view, true) <= self.bytes
            || (self.bytes_of_all(scene, view, false) <= self.bytes
                && !scene.pager.index().iter().any(|page| page.id.is_part()))
    }

    /// Memory of a run that keeps all pages in it, with those that split if they do.
    pub(super) fn bytes_of_all(&self, scene: &PagedScene, view: u64, have_split: bool) -> u64 {
        let growth = growth_due(scene);
        let rows = frames_in_memory(scene.rows_bound(), scene.rules.sh_degree(), have_split);
        let around_rows = scene.pager.index().len() as f64 * growth * AROUND_ROWS;
        self.taken(scene, view, growth) + rows + around_rows as u64
    }

    pub(super) fn taken(&self, scene: &PagedScene, view: u64, growth: f64) -> u64 {
        let of_rows = view.saturating_sub(self.of_pixels) as f64 * growth;
        let pages = scene.pager.index().len();
        let index = pages as f64 * growth * INDEX_BYTES as f64;
        let copies = if self.copies_pages { bytes_of_copies(pages, scene.pager.frame_bytes()) } else { 0 };
        self.constant + copies + self.of_pixels + (of_rows + index) as u64
    }
}

/// How many times as many rows a view may have as when they were last counted.
fn growth_due(scene: &PagedScene) -> f64 {
    let (rows, bound) = (scene.rows().max(1) as f64, scene.rows_bound() as f64);
    1.0 + UNEVEN * (bound / rows - 1.0).max(0.0)
}
