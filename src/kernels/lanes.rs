//! Blocks of rows as arrays of components, which let the per-row stages run vectorised.
//!
//! Invariants: 1. a block holds [`LANES`] rows, and lanes beyond the last row hold zeros; 2. chunks have a fixed number
//! of rows for any number of threads, and rows are independent of each other, so results do not depend on threads.

use crate::base::simd::LANES;

/// Rows per parallel task: a multiple of [`LANES`], some 100 KiB of columns.
pub const ROWS_PER_CHUNK: usize = 2048;

/// One value for each lane: a row of a block, or a pixel of a tile's row.
pub type Lane = [f32; LANES];

/// `W` components of a block of rows, one array per component.
pub type Lanes<const W: usize> = [Lane; W];

/// Gathers a block from row-major values: `src` holds up to [`LANES`] rows of `W` floats.
#[inline(always)]
pub fn gather<const W: usize>(src: &[f32]) -> Lanes<W> {
    let mut out = [[0.0; LANES]; W];
    let (rows, _) = src.as_chunks::<W>();
    if let Some(rows) = rows.first_chunk::<LANES>() {
        for lane in 0..LANES {
            for c in 0..W {
                out[c][lane] = rows[lane][c];
            }
        }
    } else {
        for (lane, row) in rows.iter().enumerate() {
            for c in 0..W {
                out[c][lane] = row[c];
            }
        }
    }
    out
}

/// Scatters a block to row-major values: as many rows as `dst` holds.
#[inline(always)]
pub fn scatter<const W: usize>(src: &Lanes<W>, dst: &mut [f32]) {
    let (rows, _) = dst.as_chunks_mut::<W>();
    for (lane, row) in rows.iter_mut().take(LANES).enumerate() {
        for c in 0..W {
            row[c] = src[c][lane];
        }
    }
}

#[inline(always)]
pub fn lane<const W: usize>(block: &Lanes<W>, lane: usize) -> [f32; W] {
    std::array::from_fn(|c| block[c][lane])
}

/// Writes one lane of a block.
#[inline(always)]
pub fn set_lane<const W: usize>(block: &mut Lanes<W>, lane: usize, value: [f32; W]) {
    for c in 0..W {
        block[c][lane] = value[c];
    }
}

/// The part of row-major values of width `width` that belongs to block `block` of [`LANES`] rows.
#[inline(always)]
pub fn block_of<T>(values: &[T], block: usize, width: usize) -> &[T] {
    let start = block * LANES * width;
    &values[start..values.len().min(start + LANES * width)]
}

/// As [`block_of`], mutable.
#[inline(always)]
pub fn block_of_mut<T>(values: &mut [T], block: usize, width: usize) -> &mut [T] {
    let start = block * LANES * width;
    let end = values.len().min(start + LANES * width);
    &mut values[start..end]
}

/// The part of row-major values of width `width` that belongs to chunk `chunk` of [`ROWS_PER_CHUNK`] rows.
pub fn chunk_of<T>(values: &[T], chunk: usize, width: usize) -> &[T] {
    let start = chunk * ROWS_PER_CHUNK * width;
    &values[start..values.len().min(start + ROWS_PER_CHUNK * width)]
}
