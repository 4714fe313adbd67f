//! One training step, top to bottom: the pass in, the picture, the pass out. Nothing here opens a file.
//!
//! A step needs all rows of its view twice and the picture once. So it walks the pages of the view in batches: the pass in
//! turns the rows of each batch into splats, the pass out turns the gradients of the splats into an update of each batch.
//! A view whose pages fit into the frames is one batch, which stays pinned between the two passes. A larger view is several
//! batches; its pass out walks them backwards, since the last batches are still in memory then.
//!
//! Invariants: 1. every pinned page is released, whatever happens; 2. a step whose rendering fails, or which is skipped
//! ([`Skipped`]), changes no row, except that events which were due on the pages are applied; 3. the result is the same for any
//! number of threads and frames, and for any cut into batches; 4. an error after the first update of several batches is
//! [`TrainError::Torn`]: the pages in memory belong to no step then.

use super::batch::{AtStep, RowBackend, UpdateCounts};
use super::comparison::Comparison;
use super::pages::{PagedScene, WorkingSet};
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::densify::strategy::ViewGradients;
use crate::paging::error::PagingError;
use crate::paging::pinned::PinnedPage;
use crate::paging::plan::look_ahead::UseInStep;
use crate::render::{LossValue, RenderOptions, RowBatches};
use crate::scene::camera::Camera;
use crate::train::error::TrainError;
use std::collections::VecDeque;

/// A step is skipped if more than one in this many rows has unusable gradients.
pub(super) const ROWS_PER_UNUSABLE: u64 = 10_000;

/// Whether a step is skipped because `unusable` of the `rows` rows of its view have unusable gradients.
fn are_too_many(unusable: u64, rows: usize) -> bool {
    unusable.saturating_mul(ROWS_PER_UNUSABLE) > rows as u64
}

/// Why a step changed nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Skipped {
    /// The loss was not finite.
    Loss,
    /// More than .01 % of the rows of the view had gradients that were not finite or far too large; how many.
    Gradients(u64),
}

#[derive(Debug, Clone, Copy, Default)]
pub struct StepOutcome {
    pub loss: LossValue,
    pub rows: usize,
    /// Rows in the pages of the view.
    pub rows_pinned: usize,
    pub pages: usize,
    pub batches: usize,
    /// Rows that the optimizer rewrote.
    pub updated: u64,
    /// Rows that kept their values because a gradient or a result was not finite.
    pub rows_skipped: u64,
    /// Why nothing was changed; `None` for a step that was taken.
    pub skipped: Option<Skipped>,
    /// The view was compared with its photo only ([`Comparison::is_left_out`]); nothing was changed.
    pub is_left_out: bool,
    /// No pixel of the view's photo counts.
    pub is_masked: bool,
    /// Rows of the view that were drawn; 0 in steps that updated rows.
    pub drawn: u64,
}

impl StepOutcome {
    /// Whether something is wrong with the numbers of the view: the step was skipped, or more than .01 % of its rows were.
    pub fn is_unsound(&self) -> bool {
        self.skipped.is_some() || are_too_many(self.rows_skipped, self.rows)
    }
}

#[derive(Debug, Clone, Copy)]
pub struct StepView<'a> {
    /// 0-based step.
    pub step: u32,
    pub camera: &'a Camera,
    pub render: &'a RenderOptions,
    /// Whether the step collects statistics for densification.
    pub collects: bool,
    pub pages_most: usize,
}

/// Trains on one view: pins its pages batch by batch, applies the events that are due, gathers the rows,
/// renders them forward and backward, updates the rows, and releases the pages.
/// Errors: a page could not be read, or the renderer failed. The rows are as they were before the step, except under
/// [`TrainError::Torn`].
pub fn train_step(
    scene: &mut PagedScene,
    working: &mut WorkingSet,
    backend: &mut dyn RowBackend,
    view: &StepView<'_>,
    comparison: &mut Comparison<'_>,
) -> Result<StepOutcome, TrainError> {
    backend.renderer().weigh_rows(view.collects && scene.rules.strategy.needs_weights())?;
    let pages = scene.pager.begin_view(view.step, view.camera)?;
    let (batches, pinned, outcome) = (Vec::new(), Vec::new(), StepOutcome::default());
    let mut passes = Passes { scene, working, backend, view, comparison, batches, pinned, outcome };
    let done = passes
        .rows_in(pages)
        .and_then(|()| passes.picture())
        .and_then(|()| if passes.comparison.is_left_out { passes.leave_out() } else { passes.rows_out() });
    passes.release();
    let outcome = passes.outcome;
    scene.pager.end_batches();
    done.map(|()| outcome)
}

/// A batch after the pass in: the renderer has its rows.
struct Batch {
    /// Pages with rows, ascending by id, with the parts of pages that split.
    pages: Vec<PageNo>,
    /// As [`WorkingSet::row_from_working`]; empty for the batch that is pinned.
    row_from_working: Vec<u32>,
}

/// A step in progress.
struct Passes<'a, 'c> {
    scene: &'a mut PagedScene,
    working: &'a mut WorkingSet,
    backend: &'a mut dyn RowBackend,
    view: &'a StepView<'a>,
    comparison: &'a mut Comparison<'c>,
    /// Batches whose rows the renderer has and whose gradients are still due.
    batches: Vec<Batch>,
    /// The pages of the last of them, where they are pinned.
    pinned: Vec<PinnedPage>,
    outcome: StepOutcome,
}

impl Passes<'_, '_> {
    /// The pass in: brings the pages up to date with all events, batch by batch, and hands their rows to the renderer. The last
    /// batch stays pinned.
    fn rows_in(&mut self, pages: Vec<PageNo>) -> Result<(), TrainError> {
        let pages_most = self.view.pages_most.min(self.backend.pages_per_batch(pages.len()));
        let mut per_batch = self.scene.pager.pages_per_batch(pages.len()).min(pages_most).max(1);
        let mut coming = VecDeque::from(pages);
        if per_batch < coming.len() {
            self.scene.pager.set_use_in_step(self.view.step, coming.iter().copied(), UseInStep::Coming);
        }
        loop {
            let batch: Vec<PageNo> = coming.drain(..per_batch.min(coming.len())).collect();
            let span = trace::span("pin pages").with("pages", batch.len() as u64);
            self.pinned = self.backend.pin(self.scene, self.view.step, &batch, false)?;
            drop(span);
            self.prefetch(&coming, per_batch);
            self.backend.before_events(self.scene, &mut self.pinned)?;
            let span = trace::span("apply events");
            let applied = self.scene.apply_pending(&mut self.pinned);
            drop(span);
            // Parts of pages that split found no frame, or no slot: a smaller batch leaves more of them.
            if applied.is_err() || self.pinned.len() > self.backend.pages_most() {
                let pages: Vec<PageNo> = self.pinned.iter().map(|pinned| pinned.page).collect();
                if !matches!(applied, Ok(()) | Err(TrainError::Paging(PagingError::WorkingSet { .. })))
                    || pages.len() < 2
                {
                    return applied;
                }
                self.release();
                per_batch = (per_batch.min(pages.len()) / 2).max(1);
                pages.into_iter().rev().for_each(|page| coming.push_front(page));
                self.scene.pager.set_use_in_step(self.view.step, coming.iter().copied(), UseInStep::Coming);
                continue;
            }
            // Again and again, since what was read and written since may let more be read.
            self.prefetch(&coming, per_batch);
            self.batch_in(&coming)?;
            if coming.is_empty() {
                return Ok(());
            }
        }
    }

    /// Hands the rows of the pinned batch to the renderer, and unpins the batch unless it is the last one.
    fn batch_in(&mut self, coming: &VecDeque<PageNo>) -> Result<(), TrainError> {
        if self.batches.is_empty() {
            let batches = if coming.is_empty() { RowBatches::One } else { RowBatches::Several };
            self.backend.renderer().begin_view(self.view.camera, self.view.render, batches)?;
        }
        let at = AtStep { step: self.view.step, camera: self.view.camera };
        let span = trace::span("rows in");
        self.outcome.rows += self.backend.rows_in(self.scene, &self.pinned, at, self.working)?;
        drop(span);
        let with_rows = self.pinned.iter().filter(|pinned| pinned.meta.rows > 0);
        let pages: Vec<PageNo> = with_rows.map(|pinned| pinned.page).collect();
        self.outcome.rows_pinned += self.pinned.iter().map(|pinned| pinned.meta.rows as usize).sum::<usize>();
        self.outcome.pages += self.pinned.len();
        self.outcome.batches += 1;
        let mut row_from_working = Vec::new();
        if !coming.is_empty() {
            row_from_working = self.working.row_from_working.clone();
            self.scene.pager.set_use_in_step(self.view.step, pages.iter().copied(), UseInStep::Returning);
            self.release();
        }
        self.batches.push(Batch { pages, row_from_working });
        Ok(())
    }

    /// Renders the picture of all splats, and takes its loss back to the splats.
    fn picture(&mut self) -> Result<(), TrainError> {
        let _span = trace::span("picture and loss");
        self.backend.renderer().picture()?;
        // A device may be at work on the picture.
        self.prefetch_before_last();
        self.comparison.loss_and_back(self.backend.renderer())?;
        if self.batches.len() > 1 && !self.comparison.is_left_out {
            // A drive that is full is found while the step can still be given up.
            let of_view: usize = self.batches.iter().map(|batch| batch.pages.len()).sum();
            self.scene.pager.reserve_slots(of_view + self.backend.pages_held())?;
        }
        Ok(())
    }

    /// Ends the step of a view that is left out: its pages stay as they are.
    fn leave_out(&mut self) -> Result<(), TrainError> {
        self.outcome.is_left_out = true;
        self.read_loss()?;
        let pages = self.batches.drain(..).flat_map(|batch| batch.pages);
        self.scene.pager.set_use_in_step(self.view.step, pages, UseInStep::Done);
        Ok(())
    }

    /// Waits for the loss of the step.
    fn read_loss(&mut self) -> Result<(), TrainError> {
        self.outcome.loss = self.comparison.loss_value(self.backend.renderer())?;
        Ok(())
    }

    /// The pass out: takes the gradients back to the rows, and updates the rows, from the last batch to the first.
    fn rows_out(&mut self) -> Result<(), TrainError> {
        let several = self.batches.len() > 1;
        let mut is_changed = false;
        while let Some(batch) = self.batches.pop() {
            let out = self.batch_out(batch);
            self.release();
            match out {
                Ok(is_done) if is_done => return Ok(()),
                Ok(_) => is_changed = several,
                Err(error) => return Err(if is_changed { TrainError::torn(error) } else { error }),
            }
        }
        Ok(())
    }

    /// One batch of the pass out: the first batch if its pages are still pinned. Returns whether the step ends here because it is
    /// skipped.
    fn batch_out(&mut self, batch: Batch) -> Result<bool, TrainError> {
        let is_first = self.batches.len() + 1 == self.outcome.batches;
        if !is_first {
            self.pinned = self.backend.pin(self.scene, self.view.step, &batch.pages, true)?;
            self.working.row_from_working = batch.row_from_working;
        }
        self.scene.pager.set_use_in_step(self.view.step, batch.pages, UseInStep::Done);
        self.prefetch_before_last();
        let (number, at) = (self.batches.len(), AtStep { step: self.view.step, camera: self.view.camera });
        let span = trace::span("rows out");
        self.backend.rows_out(self.scene, (number, !is_first), &self.pinned, at, self.working)?;
        if self.backend.has_gradients() {
            let (WorkingSet { columns, gradients, .. }, degree) = (&mut *self.working, self.scene.rules.sh_degree);
            let parameters = self.comparison.photos.iter_mut();
            parameters
                .for_each(|parameter| parameter.row_gradients(columns, &gradients.columns, self.view.camera, degree));
            // After the gradients of poses, which follow from those of the loss alone.
            let mut view = ViewGradients { columns, gradients, rows_of_view: self.outcome.rows };
            self.scene.rules.strategy.add_gradients(&mut view);
        }
        drop(span);
        if is_first {
            self.read_loss()?;
            self.outcome.skipped = self.skip_reason()?;
        }
        self.prefetch_before_last();
        if self.outcome.skipped.is_some() {
            return Ok(true);
        }
        let _span = trace::span("update");
        let UpdateCounts { updated, skipped, drawn } =
            self.backend.update(self.scene, number, &mut self.pinned, at, self.working, self.view.collects)?;
        self.outcome.updated += updated;
        self.outcome.rows_skipped += skipped;
        self.outcome.drawn += drawn;
        Ok(false)
    }

    /// Why the step is skipped, decided for the whole view before its first batch is updated.
    fn skip_reason(&mut self) -> Result<Option<Skipped>, TrainError> {
        if !self.outcome.loss.loss.is_finite() {
            return Ok(Some(Skipped::Loss));
        }
        let unusable = self.backend.renderer().unusable_splats()?;
        Ok(are_too_many(unusable, self.outcome.rows).then_some(Skipped::Gradients(unusable)))
    }

    /// Begins reads during the pass in: of the next batch or, after the last batch, of the next steps.
    fn prefetch(&mut self, coming: &VecDeque<PageNo>, per_batch: usize) {
        if coming.is_empty() && self.batches.is_empty() {
            return self.scene.pager.prefetch(self.view.step);
        }
        let next: Vec<PageNo> = coming.iter().copied().take(per_batch).collect();
        self.scene.pager.prefetch_batch(&next);
    }

    /// Begins reads during the pass out: of the preceding batch or, at the first batch, of the next steps.
    fn prefetch_before_last(&mut self) {
        // While a batch is taken out, it is no longer in the list.
        let is_out = usize::from(self.outcome.batches != self.batches.len());
        match (self.batches.len() + is_out).checked_sub(2) {
            Some(before) => self.scene.pager.prefetch_batch(&self.batches[before].pages),
            None => self.scene.pager.prefetch(self.view.step),
        }
    }

    fn release(&mut self) {
        self.backend.release(self.scene, std::mem::take(&mut self.pinned));
    }
}
