//! Gather and update: how a step reads and writes the rows of a batch of pinned pages. [`RowBackend`] is the interface,
//! [`RowsInHost`] the form for rows in host memory, whatever device draws them. The form for pages on a device is
//! [`super::device_tier`].
//!
//! Invariants: 1. between [`RowBackend::rows_in`] and [`RowBackend::update`] of a batch, the rows stay unchanged, because the
//! update starts from the gathered values; 2. rows are updated in place, pages in parallel, with the same result for any number of
//! threads; 3. an unchanged page stays clean; every changed page gets new bounds; a frozen page ([`crate::base::ids::PageId::frozen`]) is never
//! changed.

use super::catch_up;
use super::pages::{PagedScene, SceneRules, WorkingSet, row_tables};
use crate::base::ids::PageNo;
use crate::densify::stats::DrawnRows;
use crate::optim::row_kernels::{StepCounts, step_rows};
use crate::paging::pinned::PinnedPage;
use crate::render::Renderer;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::rows::ColumnsRef;
use crate::train::error::TrainError;
use rayon::prelude::*;

/// What an update did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct UpdateCounts {
    /// Rows that the optimizer rewrote.
    pub updated: u64,
    /// Rows left as they were because a gradient or a result was not finite.
    pub skipped: u64,
    /// Rows that were drawn; counted only where no row was rewritten.
    pub drawn: u64,
}

/// A step, as gather and update see it.
#[derive(Debug, Clone, Copy)]
pub struct AtStep<'a> {
    /// 0-based step.
    pub step: u32,
    pub camera: &'a Camera,
}

/// Where the rows of a step are gathered and updated. Calls come in the order of the methods, for each batch; the renderer's own
/// stages (`begin_view`, `picture`, loss) lie between them.
pub trait RowBackend {
    fn renderer(&mut self) -> &mut dyn Renderer;

    fn pages_most(&self) -> usize {
        usize::MAX
    }

    /// The most pages of a batch of a view of `pages` pages: at most [`RowBackend::pages_most`].
    fn pages_per_batch(&self, pages: usize) -> usize {
        self.pages_most().min(pages)
    }

    /// Pages outside of a batch that must be written back some time and that the pager takes for clean.
    fn pages_held(&self) -> usize {
        0
    }

    /// Pins the pages of a batch; again if `is_again`, on the way out.
    /// Errors: as [`crate::paging::pager::Pager::pin_batch`].
    fn pin(
        &mut self,
        scene: &mut PagedScene,
        step: u32,
        pages: &[PageNo],
        is_again: bool,
    ) -> Result<Vec<PinnedPage>, TrainError> {
        Ok(scene.pager.pin_batch(step, pages, is_again)?)
    }

    /// Brings the pinned frames up to date that events are about to change.
    /// Errors: the device failed.
    fn before_events(&mut self, scene: &PagedScene, pinned: &mut [PinnedPage]) -> Result<(), TrainError>;

    /// Gathers the rows of the pages that the view may draw, as they are at the step, and hands them to the renderer. The pages
    /// must have applied all events. Returns how many.
    /// Errors: the renderer failed.
    fn rows_in(
        &mut self,
        scene: &mut PagedScene,
        pinned: &[PinnedPage],
        at: AtStep<'_>,
        working: &mut WorkingSet,
    ) -> Result<usize, TrainError>;

    /// Propagates the gradients of the splats to the rows of a batch. `batch_again`: the number of the batch, and
    /// whether its pages were pinned again; then the rows are gathered again, too.
    /// Errors: the renderer failed.
    fn rows_out(
        &mut self,
        scene: &mut PagedScene,
        batch_again: (usize, bool),
        pinned: &[PinnedPage],
        at: AtStep<'_>,
        working: &mut WorkingSet,
    ) -> Result<(), TrainError>;

    /// Whether the working set has the rows of a batch and their gradients after [`RowBackend::rows_out`].
    fn has_gradients(&self) -> bool {
        false
    }

    /// Applies the gradients to the pages: optimizer, bounds and, if `collects`, densification statistics.
    /// Errors: the device failed; the pages in memory belong to no step then ([`TrainError::Torn`]).
    fn update(
        &mut self,
        scene: &mut PagedScene,
        batch: usize,
        pinned: &mut [PinnedPage],
        at: AtStep<'_>,
        working: &WorkingSet,
        collects: bool,
    ) -> Result<UpdateCounts, TrainError>;

    /// Unpins the pages of a batch.
    fn release(&mut self, scene: &mut PagedScene, pinned: Vec<PinnedPage>) {
        scene.pager.release(pinned);
    }
}

pub struct RowsInHost<'a> {
    renderer: &'a mut dyn Renderer,
}

impl<'a> RowsInHost<'a> {
    /// Rows in host memory, drawn by `renderer`.
    pub fn new(renderer: &'a mut dyn Renderer) -> RowsInHost<'a> {
        RowsInHost { renderer }
    }
}

/// Culls the rows of the pages for `camera` and evaluates the visible rows at 0-based `step`. The pages must have
/// applied all events.
pub fn gather(rules: &SceneRules, pages: &[PinnedPage], step: u32, camera: &Camera, working: &mut WorkingSet) {
    let tables = row_tables(pages);
    let WorkingSet { row_from_working, columns, .. } = working;
    catch_up::visible_rows(&tables, &rules.adam, step, camera, row_from_working);
    catch_up::gather(&tables, rules.sh_degree, &rules.adam, step, row_from_working, columns);
}

impl RowBackend for RowsInHost<'_> {
    fn renderer(&mut self) -> &mut dyn Renderer {
        self.renderer
    }

    fn has_gradients(&self) -> bool {
        true
    }

    /// The frames hold the rows.
    fn before_events(&mut self, _: &PagedScene, _: &mut [PinnedPage]) -> Result<(), TrainError> {
        Ok(())
    }

    fn rows_in(
        &mut self,
        scene: &mut PagedScene,
        pinned: &[PinnedPage],
        AtStep { step, camera }: AtStep<'_>,
        working: &mut WorkingSet,
    ) -> Result<usize, TrainError> {
        gather(&scene.rules, pinned, step, camera, working);
        self.renderer.rows_in(&working.columns)?;
        Ok(working.row_from_working.len())
    }

    fn rows_out(
        &mut self,
        scene: &mut PagedScene,
        (batch, is_again): (usize, bool),
        pinned: &[PinnedPage],
        AtStep { step, .. }: AtStep<'_>,
        working: &mut WorkingSet,
    ) -> Result<(), TrainError> {
        let WorkingSet { row_from_working, columns, gradients } = working;
        if is_again {
            let rules = &scene.rules;
            catch_up::gather(&row_tables(pinned), rules.sh_degree, &rules.adam, step, row_from_working, columns);
        }
        Ok(self.renderer.rows_out(batch, columns, gradients)?)
    }

    fn update(
        &mut self,
        scene: &mut PagedScene,
        _: usize,
        pinned: &mut [PinnedPage],
        AtStep { step, camera }: AtStep<'_>,
        working: &WorkingSet,
        collects: bool,
    ) -> Result<UpdateCounts, TrainError> {
        let WorkingSet { row_from_working, columns, gradients } = working;
        let image_size = [camera.width, camera.height];
        let drawn = DrawnRows { step, rows: row_from_working, gradients, first: 0, image_size };
        let counts = update_pages(scene, pinned, columns, &drawn, collects);
        let is_drawn = |radii: &&[u32; 2]| **radii != [0, 0];
        let drawn = if counts.updated == 0 { gradients.radii.iter().filter(is_drawn).count() } else { 0 };
        Ok(UpdateCounts {
            updated: counts.updated as u64,
            skipped: counts.skipped_non_finite as u64,
            drawn: drawn as u64,
        })
    }
}

/// The part of a step's rows that lies in one page.
struct PageShare<'a> {
    page: &'a mut PinnedPage,
    first_row: usize,
    drawn: DrawnRows<'a>,
    values: ColumnsRef<'a>,
    grads: ColumnsRef<'a>,
    touched: bool,
}

/// Runs the optimizer step, collects statistics if `collects`, and renews the bounds of changed pages. The numbers of drawn rows are
/// consecutive across pages; `columns` are their values, as gathered at this step.
pub(super) fn update_pages(
    scene: &mut PagedScene,
    pages: &mut [PinnedPage],
    columns: &Columns,
    drawn: &DrawnRows<'_>,
    collects: bool,
) -> StepCounts {
    let at = scene.rules.adam.at(drawn.step);
    let strategy = &scene.rules.strategy;
    let mut shares = shares(pages, columns, drawn);
    let counts: Vec<StepCounts> = shares
        .par_iter_mut()
        .map(|share| {
            if share.page.meta.id.is_frozen() {
                return StepCounts::default();
            }
            let rows = share.drawn.rows;
            let counts = step_rows(&at, share.page.rows_mut(share.first_row), rows, share.values, share.grads);
            share.touched = counts.updated > 0;
            if share.touched {
                strategy.after_update(&mut share.page.rows_mut(share.first_row), rows, drawn.step);
            }
            counts
        })
        .collect();
    if collects {
        for share in shares.iter_mut().filter(|share| !share.page.meta.id.is_frozen()) {
            let mut view = share.page.rows_mut(share.first_row);
            share.touched |= strategy.collect(&mut view, &share.drawn, &mut scene.histogram) > 0;
        }
    }
    let rules = &scene.rules;
    shares.par_iter_mut().filter(|share| share.touched).for_each(|share| {
        share.page.dirty = true;
        share.page.meta.bounds = rules.bounds(&share.page.rows(0));
    });
    counts.iter().fold(StepCounts::default(), |sum, c| StepCounts {
        updated: sum.updated + c.updated,
        skipped_non_finite: sum.skipped_non_finite + c.skipped_non_finite,
    })
}

/// Splits the drawn rows, their values and their gradients by page.
fn shares<'a>(pages: &'a mut [PinnedPage], columns: &'a Columns, drawn: &DrawnRows<'a>) -> Vec<PageShare<'a>> {
    let (mut rest, mut values, mut grads) = (drawn.rows, columns.view(), drawn.gradients.columns.view());
    let (mut end_row, mut first) = (0, 0);
    let mut shares = Vec::with_capacity(pages.len());
    for page in pages {
        let first_row = end_row;
        end_row += page.meta.rows as usize;
        let count = rest.partition_point(|&row| (row as usize) < end_row);
        let (rows, rest_rows) = rest.split_at(count);
        let (own_values, rest_values) = values.split_at(count);
        let (own_grads, rest_grads) = grads.split_at(count);
        let drawn = DrawnRows { rows, first, ..*drawn };
        first += count;
        shares.push(PageShare { page, first_row, drawn, values: own_values, grads: own_grads, touched: false });
        (rest, values, grads) = (rest_rows, rest_values, rest_grads);
    }
    shares
}
