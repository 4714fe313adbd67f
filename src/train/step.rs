//! One training step, top to bottom. Nothing here opens a file.
//!
//! Invariants: 1. every pinned page is released, whatever happens; 2. a step whose rendering fails, or whose loss is not
//! finite, changes no row, except that events which were due on the pinned pages are applied; 3. from gathering to the update
//! nobody changes the pinned rows or the working set's values: the update goes on from these; 4. the result is the same
//! for any number of threads and frames.

use super::catch_up::{gather, visible_rows};
use super::error::TrainError;
use super::pages::{PagedScene, numbered};
use super::update::{StepGradients, update_pages};
use super::working_set::WorkingSet;
use crate::render::{LossOptions, LossValue, RenderOptions, Renderer};
use crate::scene::camera::Camera;
use crate::scene::image::Target;

/// What a step did.
#[derive(Debug, Clone, Copy, Default)]
pub struct StepOutcome {
    /// Loss of the view.
    pub loss: LossValue,
    /// Rows in the working set.
    pub rows: usize,
    /// Rows in the pinned pages.
    pub rows_pinned: usize,
    /// Pages pinned.
    pub pages: usize,
    /// Rows that the optimizer rewrote.
    pub updated: u64,
    /// Rows left as they were because a gradient or a result was not finite.
    pub rows_skipped: u64,
    /// The loss was not finite: nothing was changed.
    pub skipped: bool,
}

/// Trains on one view at 0-based `step`: acquire, catch up with events, cull, gather, forward, loss, backward, optimizer,
/// and the statistics of densification while they are collected, bounds, release.
///
/// # Errors
/// Pages could not be had, or the renderer failed; the rows are as they were before the step.
pub fn train_step(
    scene: &mut PagedScene,
    working: &mut WorkingSet,
    renderer: &mut dyn Renderer,
    (step, camera, target): (u32, &Camera, &Target),
    (render, loss): (&RenderOptions, &LossOptions),
    collects: bool,
) -> Result<StepOutcome, TrainError> {
    let mut pages = scene.pager.acquire(step, camera)?;
    scene.pager.prefetch(step);
    if let Err(error) = scene.apply_pending(&mut pages) {
        scene.pager.release(pages);
        return Err(error);
    }
    // Again and again, since what was read and written since may let more be read.
    scene.pager.prefetch(step);
    let WorkingSet { row_from_working, columns, gradients } = working;
    let tables = numbered(&pages);
    visible_rows(&tables, &scene.rules.adam, step, camera, row_from_working);
    gather(&tables, scene.rules.sh_degree(), &scene.rules.adam, step, row_from_working, columns);
    let rows_pinned = tables.iter().map(|t| t.rows()).sum();
    let rendered = renderer.forward(columns, camera, render).and_then(|()| {
        scene.pager.prefetch(step);
        renderer.loss_backward(columns, target, loss, gradients)
    });
    scene.pager.prefetch(step);
    let mut outcome =
        StepOutcome { rows: row_from_working.len(), rows_pinned, pages: pages.len(), ..StepOutcome::default() };
    if let Ok(value) = rendered {
        outcome.loss = value;
        outcome.skipped = !value.loss.is_finite();
    }
    if rendered.is_ok() && !outcome.skipped {
        let of_step =
            StepGradients { step, rows: row_from_working, columns, gradients, size: [camera.width, camera.height] };
        let counts = update_pages(scene, &mut pages, &of_step, collects);
        outcome.updated = counts.updated as u64;
        outcome.rows_skipped = counts.skipped_non_finite as u64;
    }
    scene.pager.release(pages);
    rendered?;
    Ok(outcome)
}
