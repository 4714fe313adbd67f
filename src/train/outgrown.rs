//! Scenes that outgrow their memory. One that was all in memory goes on with pages on the drive of its checkpoint. A view
//! that needs more pages than there are frames ends the run: which photo it is of, what is kept, and what would do.
//!
//! Invariant: nothing is lost, and no bit is another. The step that could not be done changed nothing that doing it again
//! does not.

use super::tiers::PLAN_BYTES;
use super::trainer::{LoopOutputs, TrainError, Trainer};
use crate::base::units::{MIB, format_bytes};
use crate::paging::error::PagingError;

impl TrainError {
    /// The same of a step on the photo `name`.
    pub(super) fn of_view(mut self, name: &str) -> TrainError {
        if let TrainError::Paging(PagingError::WorkingSet { what, .. }) = &mut self {
            *what = format!("{what} ({name})");
        }
        self
    }

    /// Flags with which a run that stopped for want of frames may go on; empty for other errors. It may have been the first
    /// view of many to outgrow them, so that there is some room to grow.
    pub(super) fn more_memory(&self) -> String {
        match self {
            TrainError::Outgrown { least: Some(least), .. } => {
                format!(" --host-mem {}MiB (at least {}MiB)", (least + least / 2) / MIB, least.div_ceil(MIB))
            }
            TrainError::Outgrown { source: PagingError::WorkingSet { pages, .. }, .. } => {
                format!(" --frames {pages} (at least)")
            }
            _ => String::new(),
        }
    }
}

impl Trainer {
    /// Lets the pages of a run in memory leave it from now on, if they do not fit any more: all of them are committed, and
    /// what is committed can be read again. Between steps.
    ///
    /// # Errors
    /// They could not be committed, for another reason than space.
    pub(super) fn move_out_if_outgrown(&mut self, outputs: &mut LoopOutputs<'_>) -> Result<(), TrainError> {
        let Some(budget) = self.budget.filter(|_| self.is_in_memory()) else { return Ok(()) };
        let view = self.view_at_last();
        if budget.holds_all(&self.scene, view) {
            return Ok(());
        }
        let outgrown =
            format!("from step {} on the scene does not fit into {}", self.step, format_bytes(budget.bytes()));
        // Once: what cannot be helped now is not tried at every step.
        self.budget = None;
        let Some(checkpoint) = outputs.checkpoint.as_deref_mut() else {
            eprintln!("warning: {outgrown} (--host-mem), and there is no drive to move its pages to (--spill-dir)");
            return Ok(());
        };
        let commits = Some(checkpoint.commits_done());
        if budget.tried_after == commits {
            self.budget = Some(budget);
            return Ok(());
        }
        let needed = self.scene.pager.stats().pinned_max;
        let frames = budget.frames(&self.scene, view, needed);
        if frames < needed && !budget.is_named {
            eprintln!(
                "warning: {outgrown}, and a view needs more than it holds: all of it stays in memory (--host-mem)"
            );
            return Ok(());
        }
        match checkpoint.commit(self, outputs.metrics) {
            Ok(()) if checkpoint.has_commit() => {}
            Ok(()) => {
                eprintln!("warning: {outgrown} (--host-mem), and without commits its pages cannot be moved to a drive");
                return Ok(());
            }
            Err(error) if error.is_out_of_space() => {
                eprintln!("warning: {outgrown} (--host-mem), and its pages cannot be moved to a drive: {error}");
                // After the next commit that finds space.
                self.budget = Some(budget.tried(commits));
                return Ok(());
            }
            Err(error) => return Err(error),
        }
        checkpoint.set_optional(false);
        eprintln!(
            "warning: {outgrown} (--host-mem): its pages move between memory and {}; with --spill-dir from its start a \
             run may choose an order of views that moves fewer",
            checkpoint.folder().display()
        );
        self.budget = Some(budget);
        self.scene.pager.begin_paging(frames, budget.prefetch_bytes, PLAN_BYTES);
        Ok(())
    }

    /// Commits the run as it is when it has outgrown its frames, so that it can go on with more memory.
    pub(super) fn keep_outgrown(&mut self, error: TrainError, outputs: &mut LoopOutputs<'_>) -> TrainError {
        let TrainError::Paging(source @ PagingError::WorkingSet { pages, .. }) = error else { return error };
        if let Some(checkpoint) = outputs.checkpoint.as_deref_mut().filter(|_| !self.is_torn)
            && let Err(second) = checkpoint.commit(self, outputs.metrics)
        {
            eprintln!("warning: the run could not be committed: {second}");
        }
        let least = self.budget.map(|budget| budget.least_for(&self.scene, self.view_at_last(), pages));
        TrainError::Outgrown { source, least }
    }
}
