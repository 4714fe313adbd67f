//! Stage "update": one step of Adam on the listed rows of pages, in the words of their payloads, and their statistics.
//! The twin of `shaders/update.wgsl`, in which the functions are entry points.
//!
//! [`judge`] finds the largest gradient of a row, as the stages that make gradients do; [`step`] rewrites a column of the rows
//! whose gradients all are usable; [`finish`] counts, stamps and collects statistics.
//!
//! [`clear_statistics`] takes the place of a round that edits no row.
//!
//! Sums of growth scores stay floats, as in pages that the host updates. What host and device both decide by is the bin of
//! a mean score, and that is the same integer on both: devices divide exactly (`shaders/shared/quotient.wgsl`).
//!
//! Not here: the values of the rows, which come from the stage "gather" at the same step.
//!
//! Invariants: 1. a row is rewritten as a whole or not at all; 2. nothing that is not finite enters a payload; 3. growth
//! scores go to the same bins as on the CPU.

use super::deferred::{TableWords, flush};
use super::page_words::{Table, count_at, grad2d_at, row_at, stamp_at};
use gsscale::base::math::LARGEST_GRAD;
use gsscale::densify::stats::weight_bin;
use gsscale::kernels::uniforms::{DevicePage, PageResult, UpdateUniforms};
use gsscale::scene::columns::Column;
use gsscale::scene::rows::mean_grad2d;
use gsscale::scene::sightings::{is_full, with_view};

/// What the stage reads beside the slab.
#[derive(Debug, Clone, Copy)]
pub struct UpdateInput<'a> {
    pub uniforms: &'a UpdateUniforms,
    pub pages: &'a [DevicePage],
    /// Listed rows: number of the page, number of the row in it.
    pub rows: &'a [[u32; 2]],
    pub tables: TableWords<'a>,
    /// `[listed row]`: the largest magnitude of a gradient, bits.
    pub largest: &'a [u32],
}

/// The records of gradients of splats with gradients of colours, and the largest magnitudes in their last words, as the stages that make
/// gradients leave them.
pub fn records(v_colors: &[[f32; 3]], largest: &[u32]) -> Vec<[u32; 12]> {
    let record = |([r, g, b], largest): ([u32; 3], u32)| [0, 0, 0, 0, 0, 0, 0, 0, r, g, b, largest];
    v_colors.iter().map(|v| v.map(f32::to_bits)).zip(largest.iter().copied()).map(record).collect()
}

/// Bins of mean scores; those of mean weights follow.
const BINS: usize = 1 << 15;

fn is_usable(bits: u32) -> bool {
    bits != 0 && bits <= LARGEST_GRAD.to_bits()
}

/// Raises `largest` to the largest magnitude in a column of gradients, `width` floats a row. Bits of floats without
/// signs are ordered as integers, with those that are not finite after all others.
pub fn judge(width: usize, grads: &[f32], largest: &mut [u32]) {
    for (grads, largest) in grads.chunks_exact(width).zip(largest) {
        *largest = grads.iter().fold(*largest, |most, g| most.max(g.abs().to_bits()));
    }
}

/// Rewrites a column of the listed rows in the slab whose gradients are usable, from the values of stage "gather".
pub fn step(
    input: &UpdateInput<'_>,
    (column, width): (Column, usize),
    values: &[f32],
    grads: &[f32],
    slab: &mut [u32],
) {
    let UpdateUniforms { now, inv_root_correction, step_sizes, .. } = *input.uniforms;
    let (step_size, tables) = (step_sizes.as_flattened()[column as usize], input.tables);
    let [one_minus_beta1, one_minus_beta2] = tables.one_minus_betas();
    for (i, &[p, row]) in input.rows.iter().enumerate() {
        let page = &input.pages[p as usize];
        if page.slab != input.uniforms.slab || !is_usable(input.largest[i]) {
            continue;
        }
        let missed = now - slab[stamp_at(page, row as usize)];
        let ([first, ..], [_, kept, lost]) = (tables.decay(missed), tables.decay(missed + 1));
        for e in 0..width {
            let [value_at, m_at, v_at] = [Table::Values, Table::ExpAvg, Table::ExpAvgSq]
                .map(|table| row_at(page, column, table, row as usize) + e);
            let g = grads[i * width + e];
            let decayed = flush(f32::from_bits(slab[m_at]) * first);
            let m = flush(decayed + (g - decayed) * one_minus_beta1);
            let old = f32::from_bits(slab[v_at]);
            let v = flush(old * kept + (g * g * one_minus_beta2 - old * lost)).max(0.0);
            let root = v.sqrt() * inv_root_correction + tables.eps();
            let mut value = flush(values[i * width + e] - step_size * (m / root));
            if column == Column::Scales {
                let [low, high] = tables.log_scales();
                value = value.min(high).max(low);
            }
            (slab[value_at], slab[m_at], slab[v_at]) = (value.to_bits(), m.to_bits(), v.to_bits());
        }
    }
}

/// Moments of float `e` of a column of a row that contains `steps` steps, rounded to 16 bits: up with the probability of what is cut.
pub fn rounded(moments: [f32; 2], uid: u64, steps: u32, (column, e): (Column, usize)) -> [f32; 2] {
    let mixed = |x: u32| {
        let a = (x ^ (x >> 16)).wrapping_mul(0x85eb_ca6b);
        let b = (a ^ (a >> 13)).wrapping_mul(0xc2b2_ae35);
        b ^ (b >> 16)
    };
    let number = Column::ALL.iter().take_while(|c| **c != column).map(|c| c.width(0)).sum::<usize>() + e;
    let key = mixed(uid as u32 ^ mixed((uid >> 32) as u32 ^ mixed(steps)));
    let draw = mixed(key.wrapping_add((number as u32).wrapping_mul(0x9e37_79b9)));
    let cut = |x: f32, draw: u32| f32::from_bits(x.to_bits().wrapping_add(draw) & 0xffff_0000);
    [cut(moments[0], draw & 0xffff), cut(moments[1], draw >> 16)]
}

/// Stamps the rows that [`step`] rewrote, counts, and collects statistics. `footprints` holds the gradient of the
/// projected mean and the radii of each listed row, each followed by its weight where rows are weighed; `bins` the change of the number
/// of rows by bin of the mean score, then by bin of the mean weight.
pub fn finish(
    input: &UpdateInput<'_>,
    footprints: &[[f32; 4]],
    slab: &mut [u32],
    results: &mut [PageResult],
    bins: &mut [u32],
) {
    for (i, &[p, row]) in input.rows.iter().enumerate() {
        let (page, result) = (&input.pages[p as usize], &mut results[p as usize]);
        if page.slab != input.uniforms.slab {
            continue;
        }
        if is_usable(input.largest[i]) {
            slab[stamp_at(page, row as usize)] = input.uniforms.now + 1;
            result.updated += 1;
        } else {
            result.skipped += u32::from(input.largest[i] != 0);
        }
        let of_row = if input.uniforms.weighs != 0 { 2 } else { 1 };
        let footprint = footprints[of_row * i];
        let weight = (of_row == 2).then(|| footprints[2 * i + 1][0]);
        if footprint[2] > 0.0 && footprint[3] > 0.0 {
            result.drawn += 1;
            if input.uniforms.collects != 0 {
                let at = [grad2d_at(page, row as usize), count_at(page, row as usize)];
                result.collected += u32::from(collect((footprint, weight), input.uniforms.half_size, at, slab, bins));
            }
        }
    }
}

pub fn clear_statistics(pages: &[DevicePage], bound: u32, slab: &mut [u32]) {
    for page in pages.iter().filter(|page| page.slab == bound) {
        let rows = page.rows as usize;
        slab[grad2d_at(page, 0)..][..rows].fill(0);
        slab[count_at(page, 0)..][..rows].fill(0);
    }
}

/// Adds a growth score and a weight to the statistics of a row; whether it did.
fn collect(
    (footprint, weight): ([f32; 4], Option<f32>),
    half_size: [f32; 2],
    [sum_at, count_at]: [usize; 2],
    slab: &mut [u32],
    bins: &mut [u32],
) -> bool {
    let (x, y) = (footprint[0] * half_size[0], footprint[1] * half_size[1]);
    let (score, count) = ((x * x + y * y).sqrt(), slab[count_at]);
    if !score.is_finite() || is_full(count) {
        return false;
    }
    let sum = f32::from_bits(slab[sum_at]);
    let added = (sum + score).min(f32::MAX);
    if count > 0 {
        let bin = &mut bins[bin(sum, count)];
        *bin = bin.wrapping_sub(1);
    }
    (slab[sum_at], slab[count_at]) = (added.to_bits(), with_view(count, weight));
    let bin = &mut bins[bin(added, slab[count_at])];
    *bin = bin.wrapping_add(1);
    if weight.is_some() {
        for (word, change) in [(count, u32::MAX), (slab[count_at], 1)] {
            if let Some(of_weight) = weight_bin(word) {
                let bin = &mut bins[BINS + of_weight as usize];
                *bin = bin.wrapping_add(change);
            }
        }
    }
    true
}

/// Bin of a mean score: as `gsscale::densify::stats`.
fn bin(sum: f32, count: u32) -> usize {
    (mean_grad2d(sum, count).to_bits() >> 16) as usize
}
