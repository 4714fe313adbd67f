//! Sorts the visible rows front to back.
//!
//! Invariants: 1. the key is the bits of the depth, which for depths beyond the near plane (positive floats) sort like
//! the depths; 2. rows of equal depth stay in row order; 3. the result does not depend on the number of threads: the
//! number of chunks depends on the number of rows alone.
//!
//! Least-significant-digit radix sort with 11-bit digits. Every chunk owns the places that its histogram reserved, so
//! the parallel scatter writes each place once; relaxed atomic stores express this in safe Rust.

use crate::base::room;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

const DIGIT_BITS: u32 = 11;
const DIGITS: usize = 1 << DIGIT_BITS;
const ROWS_PER_CHUNK: usize = 16_384;
const CHUNKS_MAX: usize = 32;

/// Scratch memory of [`DepthSort::sort`], kept between views.
#[derive(Debug, Default)]
pub struct DepthSort {
    /// Depth bits in the high half, row in the low half.
    keys: Vec<AtomicU64>,
    other: Vec<AtomicU64>,
    /// `[chunks][DIGITS]`: counts, then places.
    places: Vec<u32>,
}

/// Chunk length for `n` items: a function of `n` alone.
pub(crate) fn chunk_len(n: usize, least: usize, chunks_max: usize) -> usize {
    n.div_ceil(chunks_max).max(least)
}

impl DepthSort {
    /// Writes the rows with `radii` other than [0, 0] to `order`, by depth, ties by row. `depths` and `radii` have one
    /// entry per row; there are fewer than 2^32 rows.
    pub fn sort(&mut self, depths: &[f32], radii: &[[u32; 2]], order: &mut Vec<u32>) {
        let of_chunk = |radii: &[[u32; 2]]| radii.iter().filter(|r| **r != [0, 0]).count();
        let counts: Vec<usize> = radii.par_chunks(ROWS_PER_CHUNK).map(of_chunk).collect();
        let visible = counts.iter().sum();
        room::resize_with(&mut self.keys, visible, AtomicU64::default);
        room::resize_with(&mut self.other, visible, AtomicU64::default);
        let mut rest = &mut self.keys[..];
        let places = counts.into_iter().map(|count| rest.split_off_mut(..count).unwrap_or_default());
        let chunks: Vec<(usize, &mut [AtomicU64])> = places.enumerate().collect();
        chunks.into_par_iter().for_each(|(chunk, keys)| {
            let rows = chunk * ROWS_PER_CHUNK..radii.len().min((chunk + 1) * ROWS_PER_CHUNK);
            let drawn = rows.filter(|&row| radii[row] != [0, 0]);
            for (key, row) in keys.iter_mut().zip(drawn) {
                *key.get_mut() = u64::from(depths[row].to_bits()) << 32 | row as u64;
            }
        });
        for shift in [32, 32 + DIGIT_BITS, 32 + 2 * DIGIT_BITS] {
            self.pass(shift);
        }
        self.keys.par_iter().with_min_len(ROWS_PER_CHUNK).map(|key| key.load(Relaxed) as u32).collect_into_vec(order);
    }

    /// One stable pass by the digit at `shift`; skipped when all keys share it.
    fn pass(&mut self, shift: u32) {
        let n = self.keys.len();
        let digit = |key: &AtomicU64| (key.load(Relaxed) >> shift) as usize & (DIGITS - 1);
        let len = chunk_len(n, ROWS_PER_CHUNK, CHUNKS_MAX);
        self.places.clear();
        room::resize(&mut self.places, n.div_ceil(len) * DIGITS, 0);
        self.places.par_chunks_mut(DIGITS).zip(self.keys.par_chunks(len)).for_each(|(counts, keys)| {
            for key in keys {
                counts[digit(key)] += 1;
            }
        });
        let mut sum = 0u32;
        for d in 0..DIGITS {
            let before = sum;
            for place in self.places.iter_mut().skip(d).step_by(DIGITS) {
                sum += std::mem::replace(place, sum);
            }
            if (sum - before) as usize == n {
                return;
            }
        }
        let other = &self.other;
        self.places.par_chunks_mut(DIGITS).zip(self.keys.par_chunks(len)).for_each(|(places, keys)| {
            for key in keys {
                let place = &mut places[digit(key)];
                other[*place as usize].store(key.load(Relaxed), Relaxed);
                *place += 1;
            }
        });
        std::mem::swap(&mut self.keys, &mut self.other);
    }

    /// Frees the scratch memory.
    pub fn free(&mut self) {
        *self = DepthSort::default();
    }

    /// Bytes kept between views.
    pub fn bytes(&self) -> u64 {
        (8 * (self.keys.capacity() + self.other.capacity()) + 4 * self.places.capacity()) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    fn check(depths: &[f32], radii: &[[u32; 2]], sorter: &mut DepthSort) {
        let mut want: Vec<u32> = (0..depths.len() as u32).filter(|&r| radii[r as usize] != [0, 0]).collect();
        want.sort_by(|&a, &b| depths[a as usize].total_cmp(&depths[b as usize]));
        let mut got = vec![7; 3];
        sorter.sort(depths, radii, &mut got);
        assert_eq!(got, want);
    }

    #[test]
    fn order_is_by_depth_then_row() {
        let mut sorter = DepthSort::default();
        let mut draws = Stream::new(3, Purpose::Test, 0, 0);
        for n in [0, 1, 2, 1000, 70_000] {
            // A few hundred distinct depths over many magnitudes, so that ties are common.
            let depths: Vec<f32> = (0..n).map(|_| 0.01 * 1.1f32.powi(draws.below(300) as i32)).collect();
            let radii: Vec<_> = (0..n).map(|_| [draws.below(3) as u32, draws.below(2) as u32]).collect();
            check(&depths, &radii, &mut sorter);
        }
        check(&[2.5; 500], &[[1, 1]; 500], &mut sorter);
        check(&[2.5; 500], &[[0, 0]; 500], &mut sorter);
    }
}
