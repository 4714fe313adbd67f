//! One training step, top to bottom. Nothing here opens a file.
//!
//! Invariants: 1. every pinned page is released, on errors too; 2. a step whose rendering fails or whose loss is not
//! finite changes no row, but pending events of the pinned pages stay applied; 3. the result is the same for any number
//! of threads and frames.

use super::batch::{gather, update};
use super::error::TrainError;
use super::pages::PagedScene;
use super::working_set::WorkingSet;
use crate::render::{LossOptions, LossValue, RenderError, RenderOptions, Renderer};
use crate::scene::camera::Camera;
use crate::scene::image::Target;

/// Result of a step.
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
    /// Rows left unchanged because a gradient or a result was not finite.
    pub rows_skipped: u64,
    /// The loss was not finite, so the step changed no row.
    pub skipped: bool,
}

/// Trains on one view at 0-based `step`; all pages of the view form one batch. The step pins the pages, applies pending
/// events, gathers the rows, renders forward and backward, updates the rows and releases the pages.
///
/// # Errors
/// Pages could not be pinned, or the renderer failed; no row has changed then.
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
    // Prefetch several times per step: completed reads and writes free staging for more.
    scene.pager.prefetch(step);
    gather(&scene.rules, &pages, step, camera, working);
    let rendered = differentiate(working, renderer, (camera, target), (render, loss), || scene.pager.prefetch(step));
    scene.pager.prefetch(step);
    let rows_pinned = pages.iter().map(|page| page.meta.rows as usize).sum();
    let rows = working.row_from_working.len();
    let mut outcome = StepOutcome { rows, rows_pinned, pages: pages.len(), ..StepOutcome::default() };
    if let Ok(value) = rendered {
        outcome.loss = value;
        outcome.skipped = !value.loss.is_finite();
    }
    if rendered.is_ok() && !outcome.skipped {
        let counts = update(scene, &mut pages, step, camera, working, collects);
        outcome.updated = counts.updated as u64;
        outcome.rows_skipped = counts.skipped_non_finite as u64;
    }
    scene.pager.release(pages);
    rendered?;
    Ok(outcome)
}

/// Renders the working set, computes the loss against the photo, and propagates gradients back to the rows.
/// `meanwhile` runs while a device may still render the picture.
///
/// # Errors
/// Those of the renderer.
pub(super) fn differentiate(
    working: &mut WorkingSet,
    renderer: &mut dyn Renderer,
    (camera, target): (&Camera, &Target),
    (render, loss): (&RenderOptions, &LossOptions),
    meanwhile: impl FnOnce(),
) -> Result<LossValue, RenderError> {
    let WorkingSet { columns, gradients, .. } = working;
    renderer.begin_view(camera, render, 1)?;
    renderer.rows_in(columns)?;
    renderer.picture()?;
    meanwhile();
    renderer.loss(target, loss)?;
    renderer.picture_back()?;
    renderer.rows_out(0, columns, gradients)?;
    renderer.loss_value()
}
