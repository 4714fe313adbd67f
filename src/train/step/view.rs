//! A view as it is now, outside of a training step: for evaluation, and to see what a view takes before the first step.
//!
//! Rows go to the renderer batch by batch, as in a step, with the events that pages miss applied to copies.
//!
//! Invariants: 1. nothing is stored; 2. memory beside the renderer's is bounded by the rows of one batch, however many rows
//! the view has.

use super::comparison::Comparison;
use super::pages::PagedScene;
use super::working_set::WorkingSet;
use crate::base::ids::PageNo;
use crate::render::{RenderOptions, Renderer, RowBatches};
use crate::scene::camera::Camera;
use crate::train::error::TrainError;

/// Pages of a batch of an evaluation, at most.
const PAGES_PER_BATCH: usize = 64;

/// Renders the picture that `camera` has after `now` steps; [`Renderer::image`] gives it.
///
/// # Errors
/// Pages could not be had, or the renderer failed.
pub fn draw(
    (scene, now, working): (&mut PagedScene, u32, &mut WorkingSet),
    renderer: &mut dyn Renderer,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<(), TrainError> {
    let pages = scene.pager.pages_of_view(camera);
    let batches = batches(&pages, PAGES_PER_BATCH.min(scene.pager.pages_per_batch(pages.len())));
    begin(renderer, camera, options, &batches)?;
    for batch in batches {
        scene.gather_pages(batch, camera, now, working)?;
        renderer.rows_in(&working.columns)?;
    }
    Ok(renderer.picture()?)
}

/// Renders the view forwards and back, as a step does whose batches have at most `pages_most` pages, so that the memory of
/// the step is allocated. Returns the rows of the view.
///
/// # Errors
/// As [`draw`].
pub fn rehearse(
    (scene, now, working): (&mut PagedScene, u32, &mut WorkingSet),
    renderer: &mut dyn Renderer,
    camera: &Camera,
    (options, comparison): (&RenderOptions, &mut Comparison<'_>),
    pages_most: usize,
) -> Result<usize, TrainError> {
    let pages = scene.pager.pages_of_view(camera);
    let batches = batches(&pages, scene.pager.pages_per_batch(pages.len()).min(pages_most));
    begin(renderer, camera, options, &batches)?;
    let mut rows = 0;
    for batch in &batches {
        scene.gather_pages(batch, camera, now, working)?;
        renderer.rows_in(&working.columns)?;
        rows += working.columns.rows();
    }
    renderer.picture()?;
    comparison.loss_and_back(renderer)?;
    for (i, batch) in batches.iter().enumerate().rev() {
        if i + 1 < batches.len() {
            scene.gather_pages(batch, camera, now, working)?;
        }
        renderer.rows_out(i, &working.columns, &mut working.gradients)?;
    }
    renderer.loss_value()?;
    renderer.unusable_splats()?;
    Ok(rows)
}

/// At least one batch, though a view may see nothing.
pub(crate) fn batches(pages: &[PageNo], per_batch: usize) -> Vec<&[PageNo]> {
    if pages.is_empty() { vec![pages] } else { pages.chunks(per_batch.max(1)).collect() }
}

pub(crate) fn begin(
    renderer: &mut dyn Renderer,
    camera: &Camera,
    options: &RenderOptions,
    batches: &[&[PageNo]],
) -> Result<(), TrainError> {
    let how = if batches.len() == 1 { RowBatches::One } else { RowBatches::Several };
    Ok(renderer.begin_view(camera, options, how)?)
}
