//! The memory of a run between its steps: adjusts the number of frames and raises the budget, as [`crate::train::memory`]
//! computes them.
//!
//! Invariant: no bit of the result depends on it.

use crate::base::allocator::return_small_blocks;
use crate::base::units::format_bytes;
use crate::paging::error::PagingError;
use crate::photos::PhotoParameters;
use crate::render::Renderer;
use crate::scene::camera::Camera;
use crate::scene::columns::row_width;
use crate::train::memory::{HostBudget, PLAN_BYTES_LEAST, SPARE_SHARE, ViewMemory};
use crate::train::step::pages::{PagedScene, WorkingSet};

/// The number of frames rises only by more than 1/16, to avoid small changes at every step.
const FRAME_RISE_SHARE: usize = 16;

/// Renderer and working set keep the memory of a view that is up to this many times wider than the coming one, since most
/// views differ by less and an allocation takes time.
const WIDER_KEPT: u64 = 4;
/// Memory below this share of the budget is never freed: frames would gain little.
const KEPT_SHARE: u64 = 16;

/// The budget of a run, and what its views have taken so far.
#[derive(Debug)]
pub(crate) struct MemoryState {
    /// Memory budget from which the number of frames follows; `None` without a budget.
    pub budget: Option<HostBudget>,
    /// The most pages of a batch of a step.
    pub pages_most: usize,
    /// The largest share of the rows in its pages that a view has drawn so far.
    pub visible_share: f64,
    /// The most rows in the pages of a view that was one batch, since the working set was allocated.
    whole_rows: u64,
    /// The most rows in the pages of a view since the renderer freed its rows, and the bytes that the rows of the coming view
    /// need in the renderer.
    rendered_rows: u64,
    row_bytes_due: u64,
    /// Whether the user knows that a view exceeds the budget.
    is_exceeded: bool,
}

impl Default for MemoryState {
    fn default() -> MemoryState {
        let (budget, pages_most, visible_share) = (None, usize::MAX, 0.0);
        let (whole_rows, rendered_rows, row_bytes_due, is_exceeded) = (0, 0, 0, false);
        MemoryState { budget, pages_most, visible_share, whole_rows, rendered_rows, row_bytes_due, is_exceeded }
    }
}

impl MemoryState {
    /// Stores how many of the rows in the pages of a view were drawn, and whether the view was one batch.
    pub fn note_view(&mut self, visible: usize, in_pages: usize, is_whole: bool) {
        self.whole_rows = self.whole_rows.max(if is_whole { in_pages as u64 } else { 0 });
        self.rendered_rows = self.rendered_rows.max(in_pages as u64);
        self.visible_share = self.visible_share.max(visible as f64 / in_pages.max(1) as f64);
    }
}

/// A run whose memory is being fitted: the budget, and what holds the memory of a view.
pub(crate) struct RunMemory<'a> {
    pub memory: &'a mut MemoryState,
    pub scene: &'a mut PagedScene,
    pub renderer: &'a mut dyn Renderer,
    pub working: &'a mut WorkingSet,
    pub photos: &'a mut PhotoParameters,
    /// Steps done.
    pub step: u32,
    pub sh_degree_last: u8,
}

impl RunMemory<'_> {
    /// Bytes of one view: `[working set, renderer with picture and photos]`; what is held now, with what the coming view needs on top.
    pub fn view_bytes(&self) -> [u64; 2] {
        let due = self.memory.row_bytes_due.saturating_sub(self.renderer.host_bytes_of_rows());
        let photos: u64 = self.photos.iter().map(|parameter| parameter.buffer_bytes()).sum();
        [self.working.bytes() as u64, self.renderer.host_bytes() + due + photos]
    }

    /// Whether a scene in memory no longer fits into its budget.
    pub fn is_outgrown(&self) -> bool {
        let budget = self.memory.budget.filter(|_| self.scene.is_in_memory());
        budget.is_some_and(|budget| !budget.holds_all(self.scene, self.view_memory().at_last))
    }

    /// Memory of the largest view so far.
    pub fn view_memory(&self) -> ViewMemory {
        let [working, rendering] = self.view_bytes();
        let width = row_width(self.working.columns.sh_degree) as u64;
        let [now, at_last] = [self.scene.rules.sh_degree, self.sh_degree_last]
            .map(|degree| working / width * row_width(degree) as u64 + rendering);
        ViewMemory { now, at_last }
    }

    /// Memory of a view whose pages hold `rows` rows, in one batch: the memory held now, if a view of that many rows has
    /// been one batch before.
    fn view_memory_of(&self, rows: u64) -> ViewMemory {
        let (held, [_, rendering]) = (self.view_memory(), self.view_bytes());
        if rows <= self.memory.whole_rows {
            return held;
        }
        let visible = (rows as f64 * self.memory.visible_share) as u64;
        let [now, at_last] = [self.scene.rules.sh_degree, self.sh_degree_last]
            .map(|degree| visible * WorkingSet::row_bytes(degree) as u64 + rendering);
        ViewMemory { now: held.now.max(now), at_last: held.at_last.max(at_last) }
    }

    /// Prepares memory for a view whose pages hold `rows` rows. Frees memory of renderer and working set that only far wider views
    /// need, so that frames can have it. Counts what the renderer will need if no view as wide was rendered since its rows were freed.
    fn expect_rows(&mut self, rows: u64, budget: HostBudget) {
        let visible = (rows as f64 * self.memory.visible_share) as u64;
        let due = self.renderer.host_bytes_for_rows(visible);
        let is_too_large =
            |held: u64, due: u64| held > due.saturating_mul(WIDER_KEPT) && held > budget.bytes / KEPT_SHARE;
        if is_too_large(self.renderer.host_bytes_of_rows(), due) {
            self.renderer.free_rows();
            self.memory.rendered_rows = 0;
        }
        let working_due = visible * WorkingSet::row_bytes(self.scene.rules.sh_degree) as u64;
        if is_too_large(self.working.bytes() as u64, working_due) {
            self.shrink_working_set(visible as usize);
        }
        self.memory.row_bytes_due = if rows <= self.memory.rendered_rows { 0 } else { due };
    }

    /// Frees the memory of a working set that has room for many more than `rows` rows, and what photos take beside it.
    fn shrink_working_set(&mut self, rows: usize) {
        if self.working.shrink_to(rows) {
            self.photos.iter_mut().for_each(|parameter| parameter.free_buffers());
            self.memory.whole_rows = 0;
        }
    }

    /// [`RunMemory::fit_frames`] for the camera that sees the most pages, before pictures outside of steps.
    pub fn fit_frames_to_widest<'a>(&mut self, cameras: impl IntoIterator<Item = &'a Camera>) {
        if self.memory.budget.is_some() && !self.scene.is_in_memory() {
            let widest = cameras.into_iter().max_by_key(|camera| self.scene.pager.pages_of_view(camera).len());
            widest.into_iter().for_each(|camera| self.fit_frames(camera));
        }
    }

    /// [`RunMemory::fit_frames`] before a picture of the live page: any camera may ask for one, so it never raises the budget. A picture is
    /// drawn in batches.
    pub fn fit_frames_to_picture(&mut self, camera: &Camera) {
        self.fit_frames_within(camera, false);
    }

    /// Adjusts the number of frames to the grown scene, in both directions, before a step with this camera. A view that does not
    /// fit in one batch is cut into batches that do.
    pub fn fit_frames(&mut self, camera: &Camera) {
        self.fit_frames_within(camera, true);
    }

    fn fit_frames_within(&mut self, camera: &Camera, may_raise: bool) {
        let Some(budget) = self.memory.budget.filter(|_| !self.scene.is_in_memory()) else { return };
        let pages = self.scene.pager.pages_of_view(camera);
        let rows = self.scene.pager.rows_of(&pages);
        let needed = pages.len();
        self.expect_rows(rows, budget);
        let view = self.view_memory_of(rows);
        let mut frames = budget.frames(self.scene, view, needed);
        self.memory.pages_most = usize::MAX;
        if frames < needed && may_raise && self.raise_for_frames(budget, needed) {
            frames = needed;
        } else if frames < needed {
            let row_bytes = WorkingSet::row_bytes(self.sh_degree_last);
            // Between the passes, the batches keep the numbers of their rows in view.
            let numbers = (rows as f64 * self.memory.visible_share) as u64 * size_of::<u32>() as u64;
            let lacking;
            (frames, self.memory.pages_most, lacking) =
                budget.batches(self.scene, self.view_bytes()[1] + numbers, row_bytes);
            self.warn_of_excess(budget, lacking);
            self.shrink_working_set(self.memory.pages_most.saturating_mul(self.scene.rules.page_rows));
        }
        let pager = &mut self.scene.pager;
        let now = pager.frames_max();
        if frames > now + now / FRAME_RISE_SHARE || (frames > now && needed >= now) {
            pager.allow_frames(frames);
        } else {
            pager.limit_frames(frames);
            if frames < now - now / FRAME_RISE_SHARE {
                return_small_blocks();
            }
        }
    }

    /// Warns once that a view takes `lacking` bytes more than the budget, however small its batches are.
    fn warn_of_excess(&mut self, budget: HostBudget, lacking: u64) {
        if lacking == 0 || std::mem::replace(&mut self.memory.is_exceeded, true) {
            return;
        }
        crate::tell!(
            "warning: from step {} on one view of the grown scene takes about {} more than {}: the run goes on with the least that it can; \
             fewer Gaussians (--max-gaussians) or smaller photos need less",
            self.step,
            format_bytes(lacking),
            format_bytes(budget.bytes)
        );
    }

    /// Adds the frames that a step lacked, as `error` reports, if memory is left for them. On true the step can be
    /// repeated, with more frames than before.
    pub fn add_missing_frames(&mut self, error: &PagingError) -> bool {
        let PagingError::WorkingSet { pages: needed, frames: now, .. } = *error else { return false };
        let Some(budget) = self.memory.budget.filter(|_| !self.scene.is_in_memory() && needed > now) else {
            return false;
        };
        let mut most = budget.frames_at_most(self.scene, self.view_memory());
        if most < needed && !self.raise_for_frames(budget, needed) {
            // The plan is optional: with a small plan the run reads more pages and continues.
            let Some(smaller) = budget.with_small_plan() else { return false };
            most = smaller.frames_at_most(self.scene, self.view_memory());
            if most < needed {
                return false;
            }
            self.scene.pager.limit_plan(PLAN_BYTES_LEAST);
            self.memory.budget = Some(smaller);
        }
        let wanted = needed + needed / SPARE_SHARE;
        self.scene.pager.allow_frames(wanted.min(most).max(needed));
        true
    }

    /// Raises the budget for a step that needs `needed` frames; see [`HostBudget::raised`].
    fn raise_for_frames(&mut self, budget: HostBudget, needed: usize) -> bool {
        let frames = (needed * self.scene.pager.frame_bytes()) as u64;
        let bytes = budget.bytes_beside_frames(self.scene, self.view_memory().now, 1.0) + budget.staging + frames;
        self.raise_budget(budget, bytes)
    }

    /// Raises the budget to keep all pages in memory; see [`HostBudget::raised`].
    pub fn raise_for_all_pages(&mut self, budget: HostBudget) -> bool {
        let bytes = budget.bytes_of_all(self.scene, self.view_memory().at_last, true);
        self.raise_budget(budget, bytes)
    }

    fn raise_budget(&mut self, budget: HostBudget, bytes: u64) -> bool {
        let Some(raised) = budget.raised(bytes) else { return false };
        if !budget.is_raised {
            crate::tell!(
                "warning: from step {} on the scene needs more than {}, the default share of the free memory: the run \
                 takes more as long as the machine has it; --host-mem sets a limit",
                self.step,
                format_bytes(budget.bytes)
            );
        }
        self.memory.budget = Some(raised);
        true
    }
}
