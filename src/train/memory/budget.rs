//! The memory budget of a growing scene: how many frames remain beside the other memory of a run, and when a scene in
//! memory no longer fits (`outgrown` then starts paging).
//!
//! Invariants: 1. the number of frames follows from bytes: the budget minus what the run holds beside its frames. It never
//! follows from a page count guessed at the start. A frame takes memory once a page fills it; 2. frames shrink before the
//! step that needs their memory, by the largest growth that its view may have had since the last step; frames that were
//! removed for growth that did not happen are added again; 3. possible growth never stops a run: a step gets the frames
//! that it needs while the run's current memory leaves room for them. For such frames, a run without --host-mem exceeds its
//! first share, up to the available memory of the machine; 4. no bit of the result depends on the budget.

use super::estimate::{INDEX_BYTES, MemoryEstimate, bytes_of_copies, frames_in_memory, obtainable_bytes};
use super::staging::{PLAN_BYTES, PLAN_BYTES_LEAST, with_staging};
use crate::page::format::slot_header::HEADER_BYTES;
use crate::train::step::pages::{PAGES_PER_BATCH, PagedScene};

/// A page may gain this many times the mean growth of all pages.
const UNEVEN: f64 = 2.0;

/// Fewest frames of a run: write back needs some.
pub(crate) const FRAMES_LEAST: usize = 2;
/// An extension of frames or memory adds 1/8 on top, so that the next steps of a growing scene need no extension.
pub(crate) const SPARE_SHARE: usize = 8;
/// Vectors grow by an eighth for a view that is slightly larger than earlier views.
const VIEW_SPARE: f64 = 1.125;

/// Bytes of a page in memory beside its rows: the header and half a memory page of rounding. Negligible for pages of
/// 1,000 rows, a fifth of pages of 32 rows.
const AROUND_ROWS: f64 = HEADER_BYTES as f64 + 2048.0;

/// Memory of the largest view so far, bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViewMemory {
    /// With the current SH degree.
    pub now: u64,
    /// With the SH degree of the last step.
    pub at_last: u64,
}

/// The memory budget of a run, from which its number of frames follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostBudget {
    /// The whole budget, bytes.
    pub(crate) bytes: u64,
    /// Bytes that do not grow with the scene, without staging.
    constant: u64,
    /// Whether densification rounds copy pages.
    copies_pages: bool,
    /// Bytes for pages in transfer and the plan.
    pub(crate) staging: u64,
    /// Bytes of a view that depend on its pixels alone.
    view_pixels: u64,
    /// The user set the budget (--host-mem), so it never rises.
    is_named: bool,
    /// The budget has risen above the run's first share.
    pub(crate) is_raised: bool,
    /// The plan has shrunk to leave memory for frames.
    is_plan_small: bool,
    /// Number of commits when paging could not start for lack of drive space.
    pub(crate) failed_after: Option<u64>,
    /// Bytes in flight ahead of their step, each way, if a run in memory starts paging.
    pub(crate) prefetch_bytes: usize,
}

impl HostBudget {
    /// A budget of `bytes`, set by the user if `is_named`, for a run with the estimate `memory`.
    pub fn new(bytes: u64, memory: &MemoryEstimate, is_named: bool) -> HostBudget {
        HostBudget {
            bytes,
            constant: memory.base + memory.targets,
            copies_pages: memory.copies > 0,
            staging: memory.staging,
            view_pixels: memory.view_pixels,
            is_named,
            is_raised: false,
            is_plan_small: false,
            failed_after: None,
            prefetch_bytes: 0,
        }
    }

    /// Marks a budget that was raised at the start, with a warning.
    pub(crate) fn raised_at_start(self) -> HostBudget {
        HostBudget { is_raised: true, ..self }
    }

    /// Adds the staging that a run in memory needs if it starts paging.
    pub fn in_memory(self, prefetch_bytes: usize, staging: u64) -> HostBudget {
        HostBudget { prefetch_bytes, staging, ..self }
    }

    /// Notes that paging could not start for lack of drive space after this many commits.
    pub(crate) fn with_failure_after(self, commits: Option<u64>) -> HostBudget {
        HostBudget { failed_after: commits, ..self }
    }

    /// Frames for a step whose view needs `needed` pages: the budget minus the run's current memory and the growth that
    /// the view may have had since its rows were last counted. If the view needs more frames, it gets them, with spare
    /// frames for splits, from the memory reserved for growth.
    pub(crate) fn frames(&self, scene: &PagedScene, view: ViewMemory, needed: usize) -> usize {
        let with_splits = self.frames_left(scene, view.at_last, 1.0).min(needed + needed / 4 + 1);
        let bare = self.frames_at_most(scene, view).min(needed);
        self.frames_left(scene, view.at_last, growth_due(scene)).max(with_splits).max(bare).max(FRAMES_LEAST)
    }

    /// How a step walks a view that does not fit in one batch: the frames, and the most pages of a batch. The renderer holds
    /// `rendering` bytes, and the working set `working_row` bytes for each row of a batch. A batch takes as many frames again for the
    /// next batch and for pages that split, its share of the working set, and copies of its pages in a densification round.
    pub(crate) fn batches(&self, scene: &PagedScene, rendering: u64, working_row: usize) -> (usize, usize) {
        let taken = self.bytes_beside_frames(scene, rendering, growth_due(scene)) - self.copies(scene) + self.staging;
        let left = self.bytes.saturating_sub(taken);
        let frame = scene.pager.frame_bytes() as u64;
        let working = (scene.rules.page_rows() * working_row) as u64;
        frames_and_batch(left, frame, working, self.copies_pages)
    }

    fn copies(&self, scene: &PagedScene) -> u64 {
        let pages = scene.pager.index().len();
        if self.copies_pages { bytes_of_copies(pages, scene.pager.frame_bytes()) } else { 0 }
    }

    /// Frames that fit beside the run's current memory, without growth.
    pub(crate) fn frames_at_most(&self, scene: &PagedScene, view: ViewMemory) -> usize {
        self.frames_left(scene, view.now, 1.0)
    }

    fn frames_left(&self, scene: &PagedScene, view: u64, growth: f64) -> usize {
        let taken = self.bytes_beside_frames(scene, view, growth) + self.staging;
        (self.bytes.saturating_sub(taken) / scene.pager.frame_bytes() as u64) as usize
    }

    /// The least budget, larger than this one, with which a resumed run has `pages` frames.
    pub(crate) fn least_for(&self, scene: &PagedScene, view: ViewMemory, pages: usize) -> u64 {
        // A resumed run has the full plan again.
        let staging = self.staging + if self.is_plan_small { (PLAN_BYTES - PLAN_BYTES_LEAST) as u64 } else { 0 };
        let frame_bytes = scene.pager.frame_bytes() as u64;
        let of_rows = view.at_last.saturating_sub(self.view_pixels) as f64 * VIEW_SPARE;
        let beside_frames = self.bytes_beside_frames(scene, self.view_pixels + of_rows as u64, 1.0);
        let least = with_staging(beside_frames + pages as u64 * frame_bytes, staging, self.bytes);
        // A sixteenth of margin: the resumed run measures its memory anew.
        (least + least / 16).max(self.bytes + frame_bytes)
    }

    /// This budget with a small plan, which leaves memory for more frames; `None` if the plan is small already.
    pub(crate) fn with_small_plan(&self) -> Option<HostBudget> {
        let spare = (PLAN_BYTES - PLAN_BYTES_LEAST) as u64;
        let staging = self.staging.checked_sub(spare).filter(|_| !self.is_plan_small)?;
        Some(HostBudget { staging, is_plan_small: true, ..*self })
    }

    /// This budget raised to `bytes` and 1/8 more. `None` if the user set the budget or the machine lacks the memory.
    pub(crate) fn raised(&self, bytes: u64) -> Option<HostBudget> {
        let most = if self.is_named { None } else { obtainable_bytes() }?;
        let raised = (bytes + bytes / SPARE_SHARE as u64).min(most).max(self.bytes);
        (bytes <= most).then_some(HostBudget { bytes: raised, is_raised: true, ..*self })
    }

    /// Whether a run with this budget can keep all pages in memory.
    pub fn holds_all(&self, scene: &PagedScene, view: u64) -> bool {
        // Scan the index for split pages only if the answer depends on them.
        self.bytes_of_all(scene, view, true) <= self.bytes
            || (self.bytes_of_all(scene, view, false) <= self.bytes
                && !scene.pager.index().iter().any(|page| page.id.is_part()))
    }

    /// Bytes of a run with all pages in memory; `have_split` if pages have split.
    pub(crate) fn bytes_of_all(&self, scene: &PagedScene, view: u64, have_split: bool) -> u64 {
        let growth = growth_due(scene);
        let rows = frames_in_memory(scene.rows_bound(), scene.rules.sh_degree(), have_split);
        let around_rows = scene.pager.index().len() as f64 * growth * AROUND_ROWS;
        self.bytes_beside_frames(scene, view, growth) + rows + around_rows as u64
    }

    /// Bytes of a run without frames and staging, when its rows have grown `growth` times.
    pub(crate) fn bytes_beside_frames(&self, scene: &PagedScene, view: u64, growth: f64) -> u64 {
        let of_rows = view.saturating_sub(self.view_pixels) as f64 * growth;
        let pages = scene.pager.index().len();
        let index = pages as f64 * growth * INDEX_BYTES as f64;
        self.constant + self.copies(scene) + self.view_pixels + (of_rows + index) as u64
    }
}

/// Frames and pages of a batch within `left` bytes: twice the frames of a batch, and for each page of a batch `working` bytes of
/// the working set and, if densification `copies` pages, a copy. At least one page and [`FRAMES_LEAST`] frames, though they may not fit.
pub(crate) fn frames_and_batch(left: u64, frame: u64, working: u64, copies: bool) -> (usize, usize) {
    let copied = if copies { PAGES_PER_BATCH as u64 } else { 0 };
    let few = left / (2 * frame + working + if copies { frame } else { 0 });
    let many = left.saturating_sub(copied * frame) / (2 * frame + working);
    let pages = if few > copied { many } else { few }.max(1);
    let beside = pages * working + pages.min(copied) * frame;
    let frames = (left.saturating_sub(beside) / frame).max(2 * pages).max(FRAMES_LEAST as u64);
    (frames as usize, pages as usize)
}

/// Largest growth factor of a view's rows since they were last counted.
fn growth_due(scene: &PagedScene) -> f64 {
    let (rows, bound) = (scene.rows().max(1) as f64, scene.rows_bound() as f64);
    1.0 + UNEVEN * (bound / rows - 1.0).max(0.0)
}
