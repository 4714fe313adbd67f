//! Updates the pinned pages of a step: rows, statistics, bounds.
//!
//! Invariants: 1. rows are updated in place, pages in parallel, with the same result for any number of threads; 2. an
//! unchanged page stays clean; 3. every changed page gets new bounds.

use super::pages::PagedScene;
use crate::densify::strategy::DrawnRows;
use crate::optim::row_kernels::{StepCounts, step_rows};
use crate::paging::pinned::PinnedPage;
use crate::render::Gradients;
use crate::scene::columns::Columns;
use crate::scene::rows::ColumnsRef;
use rayon::prelude::*;

/// Input of the update.
pub(super) struct StepGradients<'a> {
    /// 0-based step.
    pub step: u32,
    /// Row numbers in the pinned pages, consecutive across pages, ascending.
    pub rows: &'a [u32],
    /// Values of the listed rows, as gathered at this step.
    pub columns: &'a Columns,
    /// One entry per listed row.
    pub gradients: &'a Gradients,
    /// Width and height of the view.
    pub size: [u32; 2],
}

/// The part of a step's rows that lies in one page.
struct PageShare<'a> {
    page: &'a mut PinnedPage,
    first_row: usize,
    /// Positions of the page's rows in [`StepGradients::rows`].
    listed: std::ops::Range<usize>,
    rows: &'a [u32],
    values: ColumnsRef<'a>,
    grads: ColumnsRef<'a>,
    touched: bool,
}

/// Runs the optimizer step, collects statistics if `collects`, and renews the bounds of changed pages.
pub(super) fn update_pages(
    scene: &mut PagedScene,
    pages: &mut [PinnedPage],
    input: &StepGradients<'_>,
    collects: bool,
) -> StepCounts {
    let at = scene.rules.adam.at(input.step);
    let strategy = &scene.rules.strategy;
    let mut shares = shares(pages, input);
    let counts: Vec<StepCounts> = shares
        .par_iter_mut()
        .map(|share| {
            let counts = step_rows(&at, share.page.rows_mut(share.first_row), share.rows, share.values, share.grads);
            share.touched = counts.updated > 0;
            if share.touched {
                strategy.after_update(&mut share.page.rows_mut(share.first_row), share.rows, input.step);
            }
            counts
        })
        .collect();
    if collects {
        let Gradients { means2d, radii, weights, .. } = input.gradients;
        for share in &mut shares {
            let drawn = DrawnRows {
                step: input.step,
                rows: share.rows,
                v_means2d: &means2d[share.listed.clone()],
                radii: &radii[share.listed.clone()],
                weights: weights.get(share.listed.clone()).unwrap_or_default(),
                image_size: input.size,
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

/// Splits the listed rows, their values and their gradients by page.
fn shares<'a>(pages: &'a mut [PinnedPage], input: &StepGradients<'a>) -> Vec<PageShare<'a>> {
    let (mut rest, mut values, mut grads) = (input.rows, input.columns.view(), input.gradients.columns.view());
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
