//! Stage "gather": the rows of pages, as they are now, from the words of their payloads. The twin of
//! `shaders/gather.wgsl`, in which the functions are entry points.
//!
//! [`cull`] lists the rows of each page that the camera may draw, [`gather`] evaluates a column of the listed rows (a device takes
//! several at once), and [`bounds`] finds the bounds of a page after its update. Where the host does not wait for the numbers of
//! rows, [`place`] finds where the rows of each page begin. The columns then have spare room, and entries without a row
//! ([`UNLISTED`]) are transparent. [`list`] writes down which row each entry has; a device finds its row without such a list.
//!
//! [`survey`] finds what decides whether a round of densification edits rows of a page, so that a page whose statistics a round only
//! clears need not come to the host.
//!
//! One workgroup of a device finds the bounds of a page, by minima and maxima in its own memory. Bounds therefore need no
//! atomic operations on floats in the form of ordered integers.
//!
//! Not here: which pages a step needs (`paging`), uploads (`render`).
//!
//! Invariants: 1. listed rows ascend by page and row; 2. a row that the projection would draw is listed; 3. bounds hold
//! for every later step, in the arithmetic of a device; 4. no row has a larger mean score or a lower opacity than a survey says.

use super::deferred::{FOR_EVER, TableWords};
use super::page_words::{Table, count_at, grad2d_at, row_at, stamp_at};
use gsscale::base::math::exp32;
use gsscale::densify::stats::WEIGHED_VIEWS;
use gsscale::kernels::uniforms::{DevicePage, GatherUniforms, PageResult, PageSurvey};
use gsscale::scene::columns::Column;
use gsscale::scene::optimizer_numbers::SeriesSums;
use gsscale::scene::rows::mean_grad2d;
use gsscale::scene::sightings::{mean_weight, views};

/// Slacks of bounds: see `gsscale::optim::bounds`. That of values is twice the CPU's, for devices that divide and take
/// roots less exactly.
const MOVEMENT_SLACK: f32 = 1e-3;
const VALUE_SLACK: f32 = 16.0 * 0.5 * f32::EPSILON;
const FLUSH_SLACK: f32 = 2.0 * f32::MIN_POSITIVE;
const SIGMA_SLACK: f32 = 4e-6;
const SIGMA_MOST: f32 = 1e30;
const REACH_SLACK: f32 = 1.0001;
/// Quotients of smaller sums are not exact on devices: a mean score above 0 counts as at least this one.
const SMALLEST_MEAN: f32 = 1e-30;

/// Number of the page of an entry without a row, behind the listed rows.
pub const UNLISTED: u32 = u32::MAX;
/// Opacity, before activation, of entries without a row.
const HIDDEN_LOGIT: f32 = -100.0;

/// Input of the stage: the pages of a batch, the slab that is bound, and the optimizer's numbers.
#[derive(Debug, Clone, Copy)]
pub struct GatherInput<'a> {
    pub uniforms: &'a GatherUniforms,
    pub pages: &'a [DevicePage],
    pub slab: &'a [u32],
    pub tables: TableWords<'a>,
    /// Sums of this step by missed steps.
    pub recent: &'a [SeriesSums],
}

impl GatherInput<'_> {
    /// The value of element `e` of a row after `end` steps.
    fn element(&self, page: &DevicePage, column: Column, row: usize, e: usize, end: u32) -> f32 {
        let rate = self.uniforms.rates.as_flattened()[column as usize];
        let of = |table| f32::from_bits(self.slab[row_at(page, column, table, row) + e]);
        let state = [of(Table::Values), of(Table::ExpAvg), of(Table::ExpAvgSq)];
        let stamp = self.slab[stamp_at(page, row)];
        self.tables.evaluate(state, stamp, end, self.recent, column == Column::Means, rate)
    }

    /// Whether the camera may draw a row at `p` with this largest sigma. NaN counts as drawn.
    fn may_draw(&self, p: [f32; 3], sigma_max: f32) -> bool {
        let GatherUniforms { world_to_camera: m, slopes, offsets, reach, depth_range, slack, side_slack, .. } =
            *self.uniforms;
        let [x, y, z] = m.map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3]);
        let slack = slack[0] + slack[1] * (p[0].abs() + p[1].abs() + p[2].abs());
        let reach = reach.map(|reach| reach * sigma_max + slack * side_slack);
        let outside = z <= depth_range[0] - slack
            || z >= depth_range[1] + slack
            || -x - offsets[0] > slopes[0] * z + reach[0]
            || x - offsets[1] > slopes[1] * z + reach[0]
            || -y - offsets[2] > slopes[2] * z + reach[1]
            || y - offsets[3] > slopes[3] * z + reach[1];
        !outside || !(x + y + z).is_finite() || !sigma_max.is_finite()
    }

    fn is_seen(&self, page: &DevicePage, row: usize) -> bool {
        let now = self.uniforms.now;
        let mean = [0, 1, 2].map(|c| self.element(page, Column::Means, row, c, now));
        let scale = [0, 1, 2].map(|c| self.element(page, Column::Scales, row, c, now));
        self.may_draw(mean, exp32(scale[0].max(scale[1]).max(scale[2])))
    }

    fn hull(&self, page: &DevicePage, column: Column, row: usize, e: usize) -> [f32; 2] {
        let value = f32::from_bits(self.slab[row_at(page, column, Table::Values, row) + e]);
        let limit = self.element(page, column, row, e, FOR_EVER);
        let (low, high) = (value.min(limit), value.max(limit));
        let slack = MOVEMENT_SLACK * (high - low) + VALUE_SLACK * low.abs().max(high.abs()) + FLUSH_SLACK;
        [low - slack, high + slack]
    }

    fn mean_score(&self, page: &DevicePage, row: usize) -> f32 {
        mean_grad2d(f32::from_bits(self.slab[grad2d_at(page, row)]), self.slab[count_at(page, row)])
    }

    fn split_reach(&self, page: &DevicePage, row: usize, sigma: f32) -> f32 {
        let mean = self.mean_score(page, row);
        let is_split = mean > self.uniforms.grow_grad2d && sigma > self.uniforms.split_scale;
        if is_split { self.uniforms.split_reach * REACH_SLACK * sigma } else { 0.0 }
    }

    fn is_bound(&self, page: &DevicePage) -> bool {
        page.slab == self.uniforms.slab
    }
}

/// Lists the rows that the camera may draw, of the pages in the slab: `counts[page]` rows, in `found` from the page's
/// first row on.
pub fn cull(input: &GatherInput<'_>, counts: &mut [u32], found: &mut [u32]) {
    for (p, page) in input.pages.iter().enumerate().filter(|(_, page)| input.is_bound(page)) {
        counts[p] = 0;
        for row in (0..page.rows).filter(|&row| input.is_seen(page, row as usize)) {
            found[(page.first_row + counts[p]) as usize] = row;
            counts[p] += 1;
        }
    }
}

/// Finds where the listed rows of each page begin; returns how many there are.
pub fn place(pages: &mut [DevicePage], counts: &[u32]) -> u32 {
    pages.iter_mut().zip(counts).fold(0, |listed, (page, count)| {
        (page.first_listed, page.listed) = (listed, *count);
        listed + count
    })
}

/// Packs the lists of [`cull`], of all slabs: number of the page, number of the row in it. Rows without room are left out.
pub fn list(pages: &[DevicePage], counts: &[u32], found: &[u32], rows: &mut [[u32; 2]]) {
    for (p, page) in pages.iter().enumerate() {
        let room = rows.len().saturating_sub(page.first_listed as usize);
        for i in (0..counts[p]).take(room) {
            rows[(page.first_listed + i) as usize] = [p as u32, found[(page.first_row + i) as usize]];
        }
    }
}

/// Evaluates a column of the listed rows whose pages are in the slab.
pub fn gather(input: &GatherInput<'_>, (column, width): (Column, usize), rows: &[[u32; 2]], out: &mut [f32]) {
    let now = input.uniforms.now;
    for (listed, out) in rows.iter().zip(out.chunks_exact_mut(width)) {
        if listed[0] == UNLISTED {
            out.fill(if column == Column::Opacities { HIDDEN_LOGIT } else { 0.0 });
            continue;
        }
        let page = &input.pages[listed[0] as usize];
        if input.is_bound(page) {
            for (e, out) in out.iter_mut().enumerate() {
                *out = input.element(page, column, listed[1] as usize, e, now);
            }
        }
    }
}

pub fn bounds(input: &GatherInput<'_>, results: &mut [PageResult]) {
    for (page, result) in input.pages.iter().zip(results).filter(|(page, _)| input.is_bound(page)) {
        let (mut low, mut high, mut sigma_max) = ([3.4e38f32; 3], [-3.4e38f32; 3], 0.0f32);
        for row in 0..page.rows as usize {
            let tops = [0, 1, 2].map(|c| input.hull(page, Column::Scales, row, c)[1]);
            let sigma = (exp32(tops[0].max(tops[1]).max(tops[2])) * (1.0 + SIGMA_SLACK)).min(SIGMA_MOST);
            let reach = input.split_reach(page, row, sigma);
            for c in 0..3 {
                let [from, to] = input.hull(page, Column::Means, row, c);
                let (from, to) = (from - reach, to + reach);
                let slack = if reach > 0.0 { f32::EPSILON } else { 0.0 };
                low[c] = low[c].min(from - slack * from.abs());
                high[c] = high[c].max(to + slack * to.abs());
            }
            sigma_max = sigma_max.max(sigma);
        }
        (result.low, result.high) = (low.map(f32::to_bits), high.map(f32::to_bits));
        result.sigma_max = sigma_max.to_bits();
    }
}

/// Finds what decides whether a round edits rows of the pages in the slab.
pub fn survey(input: &GatherInput<'_>, surveys: &mut [PageSurvey]) {
    for (page, survey) in input.pages.iter().zip(surveys).filter(|(page, _)| input.is_bound(page)) {
        let (mut lowest, mut largest, mut weight) = (3.4e38f32, 0.0f32, 3.4e38f32);
        for row in 0..page.rows as usize {
            let word = input.slab[count_at(page, row)];
            if views(word) >= WEIGHED_VIEWS {
                weight = mean_weight(word).map_or(weight, |mean| mean.min(weight));
            }
            lowest = lowest.min(input.hull(page, Column::Opacities, row, 0)[0]);
            let score = input.mean_score(page, row);
            largest = largest.max(if score > 0.0 { score.max(SMALLEST_MEAN) } else { score });
        }
        (survey.lowest_opacity, survey.largest_mean) = (lowest.to_bits(), largest.to_bits());
        survey.least_weight = weight.to_bits();
    }
}
