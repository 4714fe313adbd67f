//! A view as it is now, outside of a training step: for evaluation, checks of growth and pictures, and to see what a view takes before
//! the first step. Steps change rows, and have their own passes (`train_step`).
//!
//! Rows go to the renderer batch by batch (`ViewPass`), as in a step, with the events that pages miss applied to copies. While a batch is
//! gathered, the pages of the next one are read.
//!
//! Invariants: 1. nothing is stored; 2. memory beside the renderer's is bounded by the rows of one batch, however many rows
//! the view has.

use super::comparison::Comparison;
use super::pages::{PagedScene, WorkingSet};
use crate::base::ids::PageNo;
use crate::kernels::sh_fwd::C0;
use crate::render::{Gradients, LossOptions, RenderOptions, Renderer, RowBatches};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::Target;
use crate::train::error::TrainError;
use std::iter::Peekable;
use std::vec::IntoIter;

/// Pages of a batch of an evaluation, at most.
const PAGES_PER_BATCH: usize = 64;

/// The scene after `step` steps, the renderer that draws it, and room for the rows of a batch.
pub struct SceneNow<'a> {
    pub scene: &'a mut PagedScene,
    pub step: u32,
    pub working: &'a mut WorkingSet,
    pub renderer: &'a mut dyn Renderer,
}

/// The passes of a renderer over the pages of one view: in, as often as wanted, and out.
pub(crate) struct ViewPass<'a> {
    camera: &'a Camera,
    options: &'a RenderOptions,
    pages: Vec<PageNo>,
    per_batch: usize,
}

/// Batches of a pass that are still to come, each with its number. While one is gathered, the next one is prefetched.
struct Batches<'p> {
    camera: &'p Camera,
    coming: Peekable<IntoIter<(usize, &'p [PageNo])>>,
}

impl<'a> ViewPass<'a> {
    /// Lists the pages that the camera may see; a batch has at most `pages_most` of them.
    pub fn new(scene: &PagedScene, camera: &'a Camera, options: &'a RenderOptions, pages_most: usize) -> ViewPass<'a> {
        let pages = scene.pager.pages_of_view(camera);
        let per_batch = scene.pager.pages_per_batch(pages.len()).min(pages_most).max(1);
        ViewPass { camera, options, pages, per_batch }
    }

    /// The pass in: hands the rows to the renderer, each batch as `edit` leaves it; [`Renderer::picture`] is next. Returns the rows of
    /// the view before they were edited.
    /// Errors: pages could not be had, or the renderer failed.
    pub fn rows_in(&self, now: &mut SceneNow<'_>, mut edit: impl FnMut(&mut Columns)) -> Result<usize, TrainError> {
        let batches = self.batches();
        let how = if batches.len() == 1 { RowBatches::One } else { RowBatches::Several };
        now.renderer.begin_view(self.camera, self.options, how)?;
        let mut batches = Batches { camera: self.camera, coming: batches.into_iter().peekable() };
        let mut rows = 0;
        while batches.gather_next(now)?.is_some() {
            rows += now.working.columns.rows();
            edit(&mut now.working.columns);
            now.renderer.rows_in(&now.working.columns)?;
        }
        Ok(rows)
    }

    /// The pass out, from the last batch to the first, after a pass in with the same working set that edited no row; `each` gets the
    /// gradients of a batch.
    /// Errors: as [`ViewPass::rows_in`].
    pub fn rows_out(&self, now: &mut SceneNow<'_>, mut each: impl FnMut(&Gradients)) -> Result<(), TrainError> {
        let mut batches = self.batches();
        // The pass in has left the rows of the last batch in the working set.
        let mut gathered = batches.pop().map(|(number, _)| number);
        batches.reverse();
        let mut batches = Batches { camera: self.camera, coming: batches.into_iter().peekable() };
        while let Some(number) = gathered {
            now.renderer.rows_out(number, &now.working.columns, &mut now.working.gradients)?;
            each(&now.working.gradients);
            gathered = batches.gather_next(now)?;
        }
        Ok(())
    }

    /// At least one batch, though a view may see nothing.
    fn batches(&self) -> Vec<(usize, &[PageNo])> {
        let no_pages: &[PageNo] = &[];
        let first = self.pages.is_empty().then_some(no_pages);
        first.into_iter().chain(self.pages.chunks(self.per_batch)).enumerate().collect()
    }
}

impl Batches<'_> {
    /// Gathers the rows of the next batch; returns its number, `None` after the last.
    fn gather_next(&mut self, now: &mut SceneNow<'_>) -> Result<Option<usize>, TrainError> {
        let Some((number, pages)) = self.coming.next() else { return Ok(None) };
        let next = self.coming.peek().map_or(&[][..], |(_, pages)| *pages);
        now.scene.gather_pages(pages, next, self.camera, now.step, now.working)?;
        Ok(Some(number))
    }
}

/// Renders the picture that `camera` has; [`Renderer::image`] gives it.
/// Errors: pages could not be had, or the renderer failed.
pub fn draw(now: &mut SceneNow<'_>, camera: &Camera, options: &RenderOptions) -> Result<(), TrainError> {
    ViewPass::new(now.scene, camera, options, PAGES_PER_BATCH).rows_in(now, |_| {})?;
    Ok(now.renderer.picture()?)
}

/// As [`draw`], with the nearness of each Gaussian's centre in place of its colours: grey at the depth `middle`, brighter before it,
/// black at infinity.
pub fn draw_depth(
    now: &mut SceneNow<'_>,
    camera: &Camera,
    options: &RenderOptions,
    middle: f32,
) -> Result<(), TrainError> {
    let [_, _, [x, y, z, w]] = camera.viewmat;
    ViewPass::new(now.scene, camera, options, PAGES_PER_BATCH).rows_in(now, |columns| {
        columns.sh_n.fill(0.0);
        for (mean, sh0) in columns.means.chunks_exact(3).zip(columns.sh0.chunks_exact_mut(3)) {
            let depth = x * mean[0] + y * mean[1] + z * mean[2] + w;
            let nearness = (0.5 * middle / depth.max(camera.near_plane)).min(1.0);
            sh0.fill((nearness - 0.5) / C0);
        }
    })?;
    Ok(now.renderer.picture()?)
}

/// The blending weight of each page in the picture that `camera` has: alpha T of its rows, summed over the pixels. Only pages that the
/// camera may see are listed, in the order of their ids.
/// Errors: as [`draw`].
pub fn weigh_pages(
    now: &mut SceneNow<'_>,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<Vec<(PageNo, f64)>, TrainError> {
    now.renderer.weigh_rows(true)?;
    // A page in a batch, so that the gradients come page by page.
    let pass = ViewPass::new(now.scene, camera, options, 1);
    pass.rows_in(now, |_| {})?;
    now.renderer.picture()?;
    let target = Target::new([camera.width, camera.height], vec![0; 3 * camera.pixels()]);
    now.renderer.loss(&target, &LossOptions::default())?;
    now.renderer.picture_back()?;
    let mut weights = Vec::new();
    pass.rows_out(now, |gradients| weights.push(gradients.weights.iter().map(|[weight, _]| f64::from(*weight)).sum()))?;
    now.renderer.weigh_rows(false)?;
    weights.reverse();
    Ok(pass.pages.into_iter().zip(weights).collect())
}

/// Renders the view forwards and back, as a step does whose batches have at most `pages_most` pages, so that the memory of
/// the step is allocated. Returns the rows of the view.
/// Errors: as [`draw`].
pub fn rehearse(
    now: &mut SceneNow<'_>,
    camera: &Camera,
    options: &RenderOptions,
    comparison: &mut Comparison<'_>,
    pages_most: usize,
) -> Result<usize, TrainError> {
    let pass = ViewPass::new(now.scene, camera, options, pages_most);
    let rows = pass.rows_in(now, |_| {})?;
    now.renderer.picture()?;
    comparison.loss_and_back(now.renderer)?;
    pass.rows_out(now, |_| {})?;
    now.renderer.loss_value()?;
    now.renderer.unusable_splats()?;
    Ok(rows)
}
