//! The loops of [`super::row_kernels`] in registers of eight floats ([`crate::base::eight`]), for AVX2.
//!
//! Sixteen registers cannot hold a row with its moments. The compiler's code for arrays would then store vectors in
//! pieces and load them whole, and such a load waits for every earlier store, including those of other rows. So here
//! each vector is loaded, processed and stored before the next one; a row that turns out to need slower code is written
//! a second time.
//!
//! A block of rows is processed once for the narrow columns and once for `sh_n`: fewer tables at a time, which the
//! hardware prefetcher follows better.
//!
//! Here: the code shared by both loops. Invariants: 1. the bits are those of [`super::row_kernels`]; 2. lanes that
//! belong to the next row are neither stored nor counted.

mod evaluate;
mod step;

use crate::base::eight::{Avx2, EIGHT, Eight};

/// Rows of a block: one bit of a word each.
const BLOCK: usize = 64;

/// Wraps a loop over rows, to run it in vectors of eight.
pub(super) struct Eights<K>(pub K);

/// Constants that every row is compared with or masked by.
struct Numbers {
    avx2: Avx2,
    zero: Eight,
    /// The sign bit.
    sign: Eight,
    /// The smallest normal float.
    smallest: Eight,
}

impl Numbers {
    #[inline(always)]
    fn new(avx2: Avx2) -> Self {
        let smallest = avx2.splat(f32::MIN_POSITIVE);
        Numbers { avx2, zero: avx2.splat(0.0), sign: avx2.splat(-0.0), smallest }
    }

    /// [`super::drift::flush`].
    #[inline(always)]
    fn flush(&self, x: Eight) -> Eight {
        x.and(self.sign.not_and(x).not_less(self.smallest))
    }

    /// [`super::drift::flush_positive`].
    #[inline(always)]
    fn flush_positive(&self, x: Eight) -> Eight {
        x.and(x.not_less(self.smallest))
    }
}

/// A value per lane of a row: of means, opacity and quats; of scales and sh0; of `sh_n`.
#[inline(always)]
fn of_lanes(avx2: Avx2, narrow: &[f32; 2 * EIGHT], sh_n: f32) -> [Eight; 3] {
    let narrow = narrow.as_chunks().0;
    [avx2.load(&narrow[0]), avx2.load(&narrow[1]), avx2.splat(sh_n)]
}

/// Loads eight values from `start` on.
#[inline(always)]
fn load(avx2: Avx2, values: &[f32], start: usize) -> Eight {
    avx2.load(&values[start..].as_chunks().0[0])
}

/// Eight values from `start` on, as a store target.
#[inline(always)]
fn eight_mut(values: &mut [f32], start: usize) -> &mut [f32; EIGHT] {
    &mut values[start..].as_chunks_mut().0[0]
}
