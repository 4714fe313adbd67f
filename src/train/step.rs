//! One training step, top to bottom. Nothing here opens a file.

use super::catch_up::{gather, visible_rows};
use crate::densify::stats::{GradHistogram, accumulate};
use crate::optim::deferred::DeferredAdam;
use crate::render::{Gradients, LossOptions, LossValue, RenderError, RenderOptions, Renderer};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::Target;
use crate::scene::state::SceneState;

/// The rows that a view needs, evaluated at its step, and their gradients; kept between steps for its allocations.
#[derive(Default)]
pub struct WorkingSet {
    /// Row of the state for each row of the working set, ascending.
    pub row_from_working: Vec<u32>,
    /// Values now.
    pub columns: Columns,
    /// Gradients of the step.
    pub gradients: Gradients,
}

impl WorkingSet {
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let columns = self.columns.bytes() + self.gradients.columns.bytes();
        self.row_from_working.capacity() * 4 + columns + self.gradients.means2d.capacity() * 16
    }
}

/// What a step did.
#[derive(Debug, Clone, Copy, Default)]
pub struct StepOutcome {
    /// Loss of the view.
    pub loss: LossValue,
    /// Rows in the working set.
    pub rows: usize,
    /// Rows that the optimizer rewrote.
    pub updated: u64,
    /// Rows left as they were because a gradient or a result was not finite.
    pub rows_skipped: u64,
    /// The loss was not finite: nothing was changed.
    pub skipped: bool,
}

/// Trains on one view at 0-based `step`: cull, gather, forward, loss, backward, optimizer, and the statistics of
/// densification while they are collected.
///
/// # Errors
/// The renderer failed; the state is as it was before the step.
pub fn train_step(
    state: &mut SceneState,
    working: &mut WorkingSet,
    renderer: &mut dyn Renderer,
    adam: &DeferredAdam,
    (step, camera, target): (u32, &Camera, &Target),
    (render, loss): (&RenderOptions, &LossOptions),
    statistics: Option<&mut GradHistogram>,
) -> Result<StepOutcome, RenderError> {
    visible_rows(state, adam, step, camera, &mut working.row_from_working);
    gather(state, adam, step, &working.row_from_working, &mut working.columns);
    renderer.forward(&working.columns, camera, render)?;
    let value = renderer.loss_backward(&working.columns, target, loss, &mut working.gradients)?;
    let mut outcome = StepOutcome { loss: value, rows: working.row_from_working.len(), ..StepOutcome::default() };
    if !value.loss.is_finite() {
        outcome.skipped = true;
        return Ok(outcome);
    }
    let counts = adam.step(state, &working.row_from_working, &working.gradients.columns, step);
    outcome.updated = counts.updated as u64;
    outcome.rows_skipped = counts.skipped_non_finite as u64;
    if let Some(histogram) = statistics {
        let (rows, gradients) = (&working.row_from_working, &working.gradients);
        let size = [camera.width, camera.height];
        accumulate(&mut state.view_mut(), rows, &gradients.means2d, &gradients.radii, size, histogram);
    }
    Ok(outcome)
}
