//! What a step changes on its pinned pages: rows, statistics, bounds.
//!
//! Invariants: 1. rows are changed in place, page by page, in parallel; the result does not depend on the number of
//! threads; 2. a page of which nothing was changed stays clean; 3. the bounds of every page that was changed are renewed.

use super::pages::PagedScene;
use crate::densify::strategy::DrawnRows;
use crate::optim::deferred::StepCounts;
use crate::paging::pinned::PinnedPage;
use crate::render::Gradients;
use crate::scene::columns::Columns;
use crate::scene::rows::ColumnsRef;
use rayon::prelude::*;

/// What a step hands to the update.
pub(super) struct StepGradients<'a> {
    /// 0-based step.
    pub step: u32,
    /// Rows of the pinned pages, numbered through, ascending.
    pub rows: &'a [u32],
    /// The listed rows as they were gathered at this step.
    pub columns: &'a Columns,
    /// One entry per listed row.
    pub gradients: &'a Gradients,
    /// Width and height of the view.
    pub size: [u32; 2],
}

/// The part of a step that belongs to one page.
struct PageShare<'a> {
    page: &'a mut PinnedPage,
    first_row: usize,
    /// Where its rows lie in the list.
    listed: std::ops::Range<usize>,
    rows: &'a [u32],
    values: ColumnsRef<'a>,
    grads: ColumnsRef<'a>,
    touched: bool,
}

/// Optimizer step, statistics (when they are collected) and bounds of the pages that had a gradient.
pub(super) fn update_pages(
    scene: &mut PagedScene,
    pages: &mut [PinnedPage],
    of_step: &StepGradients<'_>,
    collects: bool,
) -> StepCounts {
    let at = scene.rules.adam.at(of_step.step);
    let mut shares = shares(pages, of_step);
    let counts: Vec<StepCounts> = shares
        .par_iter_mut()
        .map(|share| {
            let counts = at.step_rows(share.page.rows_mut(share.first_row), share.rows, share.values, share.grads);
            share.touched = counts.updated > 0;
            counts
        })
        .collect();
    if collects {
        let Gradients { means2d, radii, .. } = of_step.gradients;
        let strategy = &scene.rules.strategy;
        for share in &mut shares {
            let drawn = DrawnRows {
                rows: share.rows,
                v_means2d: &means2d[share.listed.clone()],
                radii: &radii[share.listed.clone()],
                image_size: of_step.size,
            };
            let mut view = share.page.rows_mut(share.first_row);
            share.touched |= strategy.collect(&mut view, &drawn, &mut scene.histogram) > 0;
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

/// Cuts listed rows, their values and gradients at the borders of the pages.
fn shares<'a>(pages: &'a mut [PinnedPage], of_step: &StepGradients<'a>) -> Vec<PageShare<'a>> {
    let (mut rest, mut values, mut grads) = (of_step.rows, of_step.columns.view(), of_step.gradients.columns.view());
    let (mut first_row, mut first_listed) = (0, 0);
    let mut shares = Vec::with_capacity(pages.len());
    for page in pages {
        let (first, listed) = (first_row, first_listed);
        first_row += page.meta.rows as usize;
        let count = rest.partition_point(|&row| (row as usize) < first_row);
        let (rows, rest_rows) = rest.split_at(count);
        let (own_values, rest_values) = values.split_at(count);
        let (own_grads, rest_grads) = grads.split_at(count);
        first_listed += count;
        let listed = listed..first_listed;
        shares.push(PageShare {
            page,
            first_row: first,
            listed,
            rows,
            values: own_values,
            grads: own_grads,
            touched: false,
        });
        (rest, values, grads) = (rest_rows, rest_values, rest_grads);
    }
    shares
}
