//! The sums of a row over its tiles, folded in a fixed order, and the gradients that follow from them.
//!
//! The backward pass of the rasterizer writes nine sums for every intersection of a row with a tile
//! ([`super::rasterize_bwd`]). This file adds them up by row. The gradients of a footprint are linear in the nine sums, so they
//! are computed once per row.
//!
//! Invariants: 1. the sums of a row are folded over its tiles from left to right in emit order (tiles column by column),
//! starting from zero: this order is part of the result's definition, so that a view may be cut at tile columns without
//! changing a bit; 2. threads cannot change a bit.

use super::project_fwd::Projected;
use super::splats::ROWS_PER_CHUNK;
use crate::base::math::LARGEST_SPLAT_GRAD;
use crate::base::room;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Sums of one intersection: h, hx, hy, hxx, hxy, hyy, red, green, blue.
pub const SUMS: usize = 9;

/// The sums of one intersection as f32 bits. Every place is written by one tile only; relaxed stores express this in
/// safe Rust.
pub type Partial = [AtomicU32; SUMS];

/// Weight, and weight times error, of one intersection, as [`Partial`].
pub type WeightPartial = [AtomicU32; 2];

/// Gradients of footprints and colours, one entry per row; zeros for rows that are not drawn.
#[derive(Debug, Clone, Default)]
pub struct FootprintGradients {
    /// Pixel units, signed.
    pub v_means2d: Vec<[f32; 2]>,
    /// xx, xy, yy of the conic, xy counted once.
    pub v_conics: Vec<[f32; 3]>,
    /// With respect to the colour after its clamp at 0.
    pub v_colors: Vec<[f32; 3]>,
    /// With respect to the opacity after activation.
    pub v_opacities: Vec<f32>,
}

/// Adds `partials` to `sums`, one after the other.
fn fold<const N: usize>(mut sums: [f32; N], partials: &[[AtomicU32; N]]) -> [f32; N] {
    for partial in partials {
        for (sum, part) in sums.iter_mut().zip(partial) {
            *sum += f32::from_bits(part.load(Relaxed));
        }
    }
    sums
}

/// Folds the weights of each row as [`fold_rows`] folds the nine sums, into `[weight, weight times error]` for each of
/// `rows` rows; zeros for rows that are not drawn.
pub fn fold_weights(
    is_first: bool,
    (rows, counts): (usize, &[u32]),
    chunk_offsets: &[u64],
    partials: &[WeightPartial],
    out: &mut Vec<[f32; 2]>,
) {
    room::resize(out, rows, [0.0; 2]);
    out.par_chunks_mut(ROWS_PER_CHUNK).enumerate().for_each(|(chunk, out)| {
        let mut first = chunk_offsets[chunk] as usize;
        for (out, &count) in out.iter_mut().zip(&counts[chunk * ROWS_PER_CHUNK..]) {
            let last = first + count as usize;
            *out = fold(if is_first { [0.0; 2] } else { *out }, &partials[first..last]);
            first = last;
        }
    });
}

/// Which of the ranges of a picture is folded: the sums of a row are carried from the first to the last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoldPart {
    /// Sums begin at zero.
    pub is_first: bool,
    /// Sums become gradients.
    pub is_last: bool,
}

impl FoldPart {
    /// A picture that is one range.
    pub const WHOLE: FoldPart = FoldPart { is_first: true, is_last: true };
}

/// Folds the sums of each row over its intersections with the tiles of a range, and converts them to gradients after the last
/// range; before that `out` holds the sums as they are. `counts` holds the number of intersections of each row in the range,
/// and `counts_of_all` that in all tiles. Returns, after the last range, the number of rows with a gradient beyond
/// [`LARGEST_SPLAT_GRAD`] or NaN.
pub fn fold_rows(
    part: FoldPart,
    [counts, counts_of_all]: [&[u32]; 2],
    chunk_offsets: &[u64],
    partials: &[Partial],
    projected: &Projected,
    out: &mut FootprintGradients,
) -> u64 {
    let rows = projected.rows();
    room::resize(&mut out.v_means2d, rows, [0.0; 2]);
    room::resize(&mut out.v_conics, rows, [0.0; 3]);
    room::resize(&mut out.v_colors, rows, [0.0; 3]);
    room::resize(&mut out.v_opacities, rows, 0.0);
    let geometry = (out.v_means2d.par_chunks_mut(ROWS_PER_CHUNK), out.v_conics.par_chunks_mut(ROWS_PER_CHUNK));
    let looks = (out.v_colors.par_chunks_mut(ROWS_PER_CHUNK), out.v_opacities.par_chunks_mut(ROWS_PER_CHUNK));
    let chunks = geometry.into_par_iter().zip(looks.into_par_iter()).enumerate();
    let of_chunk = |(chunk, ((v_means2d, v_conics), (v_colors, v_opacities))): (usize, FoldedChunk<'_>)| {
        let (mut first, mut unusable) = (chunk_offsets[chunk] as usize, 0);
        for i in 0..v_means2d.len() {
            let row = chunk * ROWS_PER_CHUNK + i;
            let last = first + counts[row] as usize;
            let mut sums = [0.0f32; SUMS];
            if !part.is_first {
                let ([hx, hy], [hxx, hxy, hyy]) = (v_means2d[i], v_conics[i]);
                let [red, green, blue] = v_colors[i];
                sums = [v_opacities[i], hx, hy, hxx, hxy, hyy, red, green, blue];
            }
            let [h, hx, hy, hxx, hxy, hyy, red, green, blue] = fold(sums, &partials[first..last]);
            first = last;
            v_colors[i] = [red, green, blue];
            if !part.is_last {
                (v_means2d[i], v_conics[i], v_opacities[i]) = ([hx, hy], [hxx, hxy, hyy], h);
            } else if counts_of_all[row] == 0 {
                // The footprint of a culled row is not valid.
                (v_means2d[i], v_conics[i], v_opacities[i]) = ([0.0; 2], [0.0; 3], 0.0);
            } else {
                // dL/dsigma = -h; sigma = (A dx^2 + C dy^2) / 2 + B dx dy with dx = pixel - mean.
                let [a, b, c] = projected.conics[row];
                v_means2d[i] = [a * hx + b * hy, b * hx + c * hy];
                v_conics[i] = [-0.5 * hxx, -hxy, -0.5 * hyy];
                v_opacities[i] = h / projected.opacities[row];
                let ([x, y], [xx, xy, yy]) = (v_means2d[i], v_conics[i]);
                let all = [x, y, xx, xy, yy, red, green, blue, v_opacities[i]];
                unusable += u64::from(!all.into_iter().all(|v| v.abs() <= LARGEST_SPLAT_GRAD));
            }
        }
        unusable
    };
    chunks.map(of_chunk).sum()
}

/// Gradients of the rows of a chunk: means2d and conics, colours and opacities.
type FoldedChunk<'a> = ((&'a mut [[f32; 2]], &'a mut [[f32; 3]]), (&'a mut [[f32; 3]], &'a mut [f32]));

#[cfg(test)]
mod tests {
    use super::*;

    /// 1e8 - 1e8 + 1 is 1 from the left; from the right, or paired otherwise, the 1 is lost to rounding.
    #[test]
    fn sums_of_a_row_are_folded_from_the_left() {
        let partial = |x: f32| -> Partial { std::array::from_fn(|_| AtomicU32::new(x.to_bits())) };
        let partials = [5.0, 1e8, -1e8, 1.0].map(partial);
        let mut projected = Projected::default();
        projected.resize(2);
        projected.opacities.fill(1.0);
        let mut out = FootprintGradients::default();
        fold_rows(FoldPart::WHOLE, [&[1, 3]; 2], &[0], &partials, &projected, &mut out);
        assert_eq!(out.v_colors, [[5.0; 3], [1.0; 3]]);
        assert_eq!(out.v_opacities, [5.0, 1.0]);
    }
}
