//! The steps of a trainer within its memory: frames are taken and given back as the scene grows ([`super::budget`] says how many).

use super::budget::{HostBudget, SPARE_SHARE, ViewMemory};
use super::staging::PLAN_BYTES_LEAST;
use super::trainer::Trainer;
use crate::base::units::format_bytes;
use crate::paging::error::PagingError;
use crate::scene::camera::Camera;
use crate::scene::columns::row_width;

/// Frames are given back when there are more than one in so many.
const WORTH_GIVING: usize = 16;

impl Trainer {
    /// Stays within this memory from now on, as far as frames that give way can do it.
    pub fn set_budget(&mut self, budget: HostBudget) {
        self.budget = Some(budget);
    }

    /// What the largest view took so far.
    pub(super) fn view_memory(&self) -> ViewMemory {
        let [working, rendering] = self.view_bytes();
        let width = row_width(self.working.columns.sh_degree) as u64;
        let [now, at_last] = [self.scene.rules.sh_degree(), self.sh_degrees().1]
            .map(|degree| working / width * row_width(degree) as u64 + rendering);
        ViewMemory { now, at_last }
    }

    /// Takes away the frames that the scene, as it has grown, leaves no memory for, and gives back what was taken for growth
    /// that did not come. Between steps; the next one has this camera.
    pub(super) fn fit_frames(&mut self, camera: &Camera) {
        let Some(budget) = self.budget.filter(|_| !self.is_in_memory()) else { return };
        let needed = self.scene.pager.pages_of_view(camera).len();
        let mut frames = budget.frames(&self.scene, self.view_memory(), needed);
        if frames < needed && self.raise_for_frames(budget, needed) {
            frames = needed;
        }
        let pager = &mut self.scene.pager;
        let now = pager.frames_max();
        if frames > now + now / WORTH_GIVING || (frames > now && needed >= now) {
            pager.allow_frames(frames);
        } else {
            pager.limit_frames(frames);
        }
    }

    /// Gives a step the frames that `error` says it lacked, if memory is left for them; then the step can be tried again.
    /// Each time there are more frames than before.
    pub(super) fn find_frames(&mut self, error: &PagingError) -> bool {
        let PagingError::WorkingSet { pages: needed, frames: now, .. } = *error else { return false };
        let Some(budget) = self.budget.filter(|_| !self.is_in_memory() && needed > now) else { return false };
        let mut most = budget.frames_at_most(&self.scene, self.view_memory());
        if most < needed && !self.raise_for_frames(budget, needed) {
            // The plan is advice: with a small one the run reads more, and goes on.
            let Some(smaller) = budget.with_small_plan() else { return false };
            most = smaller.frames_at_most(&self.scene, self.view_memory());
            if most < needed {
                return false;
            }
            self.scene.pager.limit_plan(PLAN_BYTES_LEAST);
            self.budget = Some(smaller);
        }
        let wanted = needed + needed / SPARE_SHARE;
        self.scene.pager.allow_frames(wanted.min(most).max(needed));
        true
    }

    /// Takes more memory for a step that needs so many frames, if nobody named the run's memory and the machine has it.
    fn raise_for_frames(&mut self, budget: HostBudget, needed: usize) -> bool {
        let frames = (needed * self.scene.pager.frame_bytes()) as u64;
        let bytes = budget.taken(&self.scene, self.view_memory().now, 1.0) + budget.staging + frames;
        self.raise_budget(budget, bytes)
    }

    /// Takes more memory to go on with all pages in it, if nobody named the run's memory and the machine has it.
    pub(super) fn raise_for_all(&mut self, budget: HostBudget) -> bool {
        let bytes = budget.bytes_of_all(&self.scene, self.view_memory().at_last, true);
        self.raise_budget(budget, bytes)
    }

    fn raise_budget(&mut self, budget: HostBudget, bytes: u64) -> bool {
        let Some(raised) = budget.raised(bytes) else { return false };
        if !budget.is_raised {
            eprintln!(
                "warning: from step {} on the scene needs more than {}, the share of the free memory that a run takes by itself: \
                 it takes more as long as the machine has it; --host-mem sets a limit",
                self.step,
                format_bytes(budget.bytes)
            );
        }
        self.budget = Some(raised);
        true
    }

    /// Whether no page ever leaves memory.
    pub(super) fn is_in_memory(&self) -> bool {
        self.scene.pager.frames_max() == usize::MAX
    }
}
