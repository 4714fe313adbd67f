//! Scenes that outgrow their memory. A scene in memory starts paging to the drive of its checkpoint. A run that ends for
//! lack of memory commits first, and its error names the photo and the memory that suffices.
//!
//! Not here: views in batches (`step`), frames of a growing scene (`fitting`).
//!
//! Invariant: no step is lost and no bit of the result changes. A step that lacked frames can be repeated.

use super::training_loop::LoopOutputs;
use crate::base::units::format_bytes;
use crate::paging::error::PagingError;
use crate::train::error::TrainError;
use crate::train::memory::staging::PLAN_BYTES;
use crate::train::state::trainer::Trainer;

impl Trainer {
    /// Whether a scene in memory no longer fits into its budget.
    pub(super) fn is_outgrown(&self) -> bool {
        let budget = self.budget.filter(|_| self.is_in_memory());
        budget.is_some_and(|budget| !budget.holds_all(&self.scene, self.view_memory().at_last))
    }

    /// Starts paging in a run in memory whose pages no longer fit, between steps: commits all pages, so that they can
    /// be evicted and read again. If paging left too few frames for a view and the user set no budget, all pages stay
    /// in memory while the machine has it.
    ///
    /// # Errors
    /// The commit failed for a reason other than space.
    pub(super) fn start_paging_if_outgrown(&mut self, outputs: &mut LoopOutputs<'_>) -> Result<(), TrainError> {
        let Some(budget) = self.budget.filter(|_| self.is_outgrown()) else { return Ok(()) };
        let view = self.view_memory();
        let needed = self.scene.pager.stats().pinned_max;
        let frames = budget.frames(&self.scene, view, needed);
        let is_tight = budget.frames_at_most(&self.scene, view) < needed;
        if is_tight && self.raise_for_all_pages(budget) {
            return Ok(());
        }
        let outgrown =
            format!("from step {} on the scene does not fit into {}", self.state.step, format_bytes(budget.bytes()));
        // Warn once: without the budget, later steps do not try again.
        self.budget = None;
        let Some(checkpoint) = outputs.checkpoint.as_deref_mut() else {
            crate::tell!("warning: {outgrown} (--host-mem), and no drive is set for its pages (--spill-dir)");
            return Ok(());
        };
        let commits = Some(checkpoint.commits_done());
        if budget.failed_after == commits {
            self.budget = Some(budget);
            return Ok(());
        }
        match checkpoint.commit(self, outputs.metrics) {
            Ok(()) if checkpoint.has_commit() => {}
            Ok(()) => {
                crate::tell!(
                    "warning: {outgrown} (--host-mem), and without commits its pages cannot be moved to a drive"
                );
                return Ok(());
            }
            Err(error) if error.is_out_of_space() => {
                crate::tell!("warning: {outgrown} (--host-mem), and its pages cannot be moved to a drive: {error}");
                // Try again after the next successful commit.
                self.budget = Some(budget.with_failure_after(commits));
                return Ok(());
            }
            Err(error) => return Err(error),
        }
        checkpoint.set_optional(false);
        crate::tell!(
            "warning: {outgrown} (--host-mem): its pages move between memory and {}; a new run with --spill-dir can \
             choose a view order that moves fewer pages",
            checkpoint.folder().display()
        );
        self.budget = Some(budget);
        self.scene.pager.begin_paging(frames, budget.prefetch_bytes, PLAN_BYTES);
        Ok(())
    }

    /// Commits what a run can be resumed from, before it ends with `error`: the last good step of a run that lacked frames or
    /// whose renderer failed, or the cut in progress of a step that failed half-way. Adds the least memory to an error about
    /// frames.
    pub(super) fn commit_before_end(&mut self, error: TrainError, outputs: &mut LoopOutputs<'_>) -> TrainError {
        let is_last_step_good =
            matches!(error, TrainError::Render(_) | TrainError::Paging(PagingError::WorkingSet { .. }));
        if let Some(checkpoint) = outputs.checkpoint.as_deref_mut() {
            let done = match self.is_torn {
                true => checkpoint.finish_cut(self),
                false if is_last_step_good => checkpoint.commit(self, outputs.metrics),
                false => Ok(()),
            };
            if let Err(second) = done {
                crate::tell!("warning: the run could not be committed: {second}");
            }
        }
        let TrainError::Paging(source @ PagingError::WorkingSet { pages, .. }) = error else { return error };
        let least = self.budget.map(|budget| budget.least_for(&self.scene, self.view_memory(), pages));
        TrainError::Outgrown { source, least }
    }
}
