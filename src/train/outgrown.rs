//! Scenes that outgrow their memory. One that was all in memory goes on with pages on the drive of its checkpoint. A view
//! that needs more pages than memory has frames for ends the run: which photo it is of, what is kept, and what would do.
//!
//! Invariant: nothing is lost, and no bit is another. The step that could not be done changed nothing that doing it again
//! does not.

use super::budget::ViewNeed;
use super::catch_up::visible_rows;
use super::error::TrainError;
use super::preflight::largest_view;
use super::staging::PLAN_BYTES;
use super::trainer::Trainer;
use super::training_loop::LoopOutputs;
use crate::base::units::{MIB, format_bytes};
use crate::dataset::loader::Dataset;
use crate::paging::error::PagingError;
use crate::scene::camera::Camera;
use crate::scene::page_split::parts_of;

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
    /// what is committed can be read again. Between steps. A run whose memory nobody named, and which would have
    /// too few frames for its views then, keeps all pages in memory as long as the machine has it.
    ///
    /// # Errors
    /// They could not be committed, for another reason than space.
    pub(super) fn move_out_if_outgrown(&mut self, outputs: &mut LoopOutputs<'_>) -> Result<(), TrainError> {
        let Some(budget) = self.budget.filter(|_| self.is_in_memory()) else { return Ok(()) };
        let view = self.view_memory();
        if budget.holds_all(&self.scene, view.at_last) {
            return Ok(());
        }
        let needed = self.scene.pager.stats().pinned_max;
        let frames = budget.frames(&self.scene, view, needed);
        let is_tight = budget.frames_at_most(&self.scene, view) < needed;
        if is_tight && self.raise_for_all(budget) {
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

    /// Commits the run as it is when it has outgrown its frames, so that it can go on with more memory, and finds out how
    /// much that must be.
    pub(super) fn keep_outgrown(
        &mut self,
        error: TrainError,
        dataset: &Dataset,
        outputs: &mut LoopOutputs<'_>,
    ) -> TrainError {
        let TrainError::Paging(mut source @ PagingError::WorkingSet { .. }) = error else { return error };
        if let Some(checkpoint) = outputs.checkpoint.as_deref_mut().filter(|_| !self.is_torn)
            && let Err(second) = checkpoint.commit(self, outputs.metrics)
        {
            eprintln!("warning: the run could not be committed: {second}");
        }
        let next = Some(self.next_view());
        let largest = largest_view(dataset, self.scene.pager.index()).view.filter(|view| Some(*view) != next);
        let mut needs = Vec::new();
        for view in next.into_iter().chain(largest) {
            match self.need_of(&dataset.views[view].camera) {
                Ok(need) => needs.push(need),
                Err(second) => {
                    eprintln!("warning: what the view {} needs is not known: {second}", dataset.views[view].name);
                }
            }
        }
        if let PagingError::WorkingSet { pages, .. } = &mut source {
            // A page that splits asked for one frame more; there may be many behind it.
            *pages = needs.iter().map(|need| need.pages).fold(*pages, usize::max);
            needs.push(ViewNeed { pages: *pages, growth: 1.0 });
        }
        let view = self.view_memory();
        let least = self.budget.map(|budget| budget.least_for(&self.scene, view, &needs));
        TrainError::Outgrown { source, least }
    }

    /// What a step on a view needs, with the events that its pages miss applied to copies of them.
    fn need_of(&mut self, camera: &Camera) -> Result<ViewNeed, PagingError> {
        let (mut pages, mut rows, mut visible) = (0, 0, Vec::new());
        let (now, of_view) = (self.step, self.scene.pager.pages_of_view(camera));
        self.scene.visit(&of_view, &mut |rules, tables| {
            pages += tables.iter().map(|table| parts_of(table.rows(), rules.page_rows())).sum::<usize>();
            visible_rows(tables, &rules.adam, now, camera, &mut visible);
            rows += visible.len();
            Ok::<(), PagingError>(())
        })?;
        let largest = self.working.row_from_working.capacity().max(1);
        Ok(ViewNeed { pages, growth: (rows as f64 / largest as f64).max(1.0) })
    }
}
