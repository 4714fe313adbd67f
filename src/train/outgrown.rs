//! Scenes that outgrow their memory. A scene in memory starts paging to the drive of its checkpoint. A view that needs
//! more pages than there are frames ends the run with a commit and an error that names the photo and enough memory.
//!
//! Invariant: no step is lost and no bit of the result changes. A step that lacked frames can be repeated.

use super::budget::ViewNeed;
use super::catch_up::visible_rows;
use super::error::TrainError;
use super::largest_view::largest_view;
use super::staging::PLAN_BYTES;
use super::trainer::Trainer;
use super::training_loop::LoopOutputs;
use crate::base::units::{MIB, format_bytes};
use crate::dataset::loader::Dataset;
use crate::paging::error::PagingError;
use crate::scene::camera::Camera;
use crate::scene::page_split::parts_of;

impl TrainError {
    /// Adds the name of the view to an error about missing frames.
    pub(super) fn with_view_name(mut self, name: &str) -> TrainError {
        if let TrainError::Paging(PagingError::WorkingSet { what, .. }) = &mut self {
            *what = format!("{what} ({name})");
        }
        self
    }

    /// Flags with which a run that lacked frames can resume; empty for other errors. They include room for more growth,
    /// since other views may outgrow the frames next.
    pub(super) fn memory_flags(&self) -> String {
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
    /// Starts paging in a run in memory whose pages no longer fit, between steps: commits all pages, so that they can
    /// be evicted and read again. If paging left too few frames for a view and the user set no budget, all pages stay
    /// in memory while the machine has it.
    ///
    /// # Errors
    /// The commit failed for a reason other than space.
    pub(super) fn start_paging_if_outgrown(&mut self, outputs: &mut LoopOutputs<'_>) -> Result<(), TrainError> {
        let Some(budget) = self.budget.filter(|_| self.is_in_memory()) else { return Ok(()) };
        let view = self.view_memory();
        if budget.holds_all(&self.scene, view.at_last) {
            return Ok(());
        }
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
            eprintln!("warning: {outgrown} (--host-mem), and no drive is set for its pages (--spill-dir)");
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
                eprintln!("warning: {outgrown} (--host-mem), and without commits its pages cannot be moved to a drive");
                return Ok(());
            }
            Err(error) if error.is_out_of_space() => {
                eprintln!("warning: {outgrown} (--host-mem), and its pages cannot be moved to a drive: {error}");
                // Try again after the next successful commit.
                self.budget = Some(budget.with_failure_after(commits));
                return Ok(());
            }
            Err(error) => return Err(error),
        }
        checkpoint.set_optional(false);
        eprintln!(
            "warning: {outgrown} (--host-mem): its pages move between memory and {}; a new run with --spill-dir can \
             choose a view order that moves fewer pages",
            checkpoint.folder().display()
        );
        self.budget = Some(budget);
        self.scene.pager.begin_paging(frames, budget.prefetch_bytes, PLAN_BYTES);
        Ok(())
    }

    /// Commits a run that has outgrown its frames, so that it can resume with more memory, and adds the least memory to
    /// the error.
    pub(super) fn commit_outgrown(
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
            match self.measure_need(&dataset.views[view].camera) {
                Ok(need) => needs.push(need),
                Err(second) => {
                    eprintln!("warning: the memory of the view {} is unknown: {second}", dataset.views[view].name);
                }
            }
        }
        if let PagingError::WorkingSet { pages, .. } = &mut source {
            // The error counts one frame for one split; further pages may split too.
            *pages = needs.iter().map(|need| need.pages).fold(*pages, usize::max);
            needs.push(ViewNeed { pages: *pages, growth: 1.0 });
        }
        let view = self.view_memory();
        let least = self.budget.map(|budget| budget.least_for(&self.scene, view, &needs));
        TrainError::Outgrown { source, least }
    }

    /// Measures what a step on a view needs, with pending events applied to copies of its pages.
    fn measure_need(&mut self, camera: &Camera) -> Result<ViewNeed, PagingError> {
        let (mut pages, mut rows, mut visible) = (0, 0, Vec::new());
        let (now, of_view) = (self.state.step, self.scene.pager.pages_of_view(camera));
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
