//! Eight floats in one register of AVX2, for the loops in which what the compiler makes of arrays is not good enough.
//!
//! Values come from an [`Avx2`] alone, and that comes from [`with_avx2`] alone, inside a function compiled for it:
//! whoever holds a value runs on a processor that has the instructions. Every operation is one or two of them;
//! comparisons give lanes of all ones or all zeros.
//!
//! Not here: what is computed. Invariant: sums, differences, products, quotients and roots round as those of `f32` do,
//! lane by lane, and nothing is contracted; so a loop of these gives the bits of a plain one.
#![allow(unsafe_code)] // instructions that not every processor has

use super::simd::SimdPath;
use std::arch::x86_64::*;

/// Lanes of an [`Eight`].
pub const EIGHT: usize = 8;

/// That the processor has AVX2.
#[derive(Clone, Copy)]
pub struct Avx2(());

/// Work that is written in [`Eight`]s.
pub trait EightKernel {
    /// What it returns.
    type Out;
    /// The work. Mark the implementation, and every function it calls in its inner loop, `#[inline(always)]`: what is not
    /// inlined is compiled without the instructions, and gets its values through memory.
    fn run(self, avx2: Avx2) -> Self::Out;
}

/// Runs `kernel` where the processor has AVX2, and hands it back elsewhere.
#[inline]
pub fn with_avx2<K: EightKernel>(kernel: K) -> Result<K::Out, K> {
    if !SimdPath::Avx2.is_supported() {
        return Err(kernel);
    }
    // SAFETY: the features of the callee were detected on this machine just now (the answer is cached by std).
    Ok(unsafe { run(kernel) })
}

// Without fma, which `SimdPath::Avx2` has as well: nothing can be contracted then.
#[target_feature(enable = "avx2")]
fn run<K: EightKernel>(kernel: K) -> K::Out {
    kernel.run(Avx2(()))
}

/// Eight floats.
#[derive(Clone, Copy)]
pub struct Eight(__m256);

impl Avx2 {
    /// The same in every lane.
    #[inline(always)]
    pub fn splat(self, x: f32) -> Eight {
        // SAFETY: AVX, which `self` stands for.
        Eight(unsafe { _mm256_set1_ps(x) })
    }

    /// Eight floats from memory.
    #[inline(always)]
    pub fn load(self, from: &[f32; EIGHT]) -> Eight {
        // SAFETY: AVX, which `self` stands for; the reference is to as many floats as are read.
        Eight(unsafe { _mm256_loadu_ps(from.as_ptr()) })
    }

    /// Lanes 0 to 3: a row of three and another value; 4 to 7: a row of four. The row behind the one of three is not used,
    /// but must be there: it makes the load a whole quarter.
    #[inline(always)]
    pub fn load_three_one_four(self, three: &[[f32; 3]; 2], one: f32, four: &[f32; 4]) -> Eight {
        // SAFETY: AVX, which `self` stands for; four of the six floats of `three` and the four of `four` are read.
        Eight(unsafe {
            let low = _mm_insert_ps::<0x30>(_mm_loadu_ps(three.as_ptr().cast()), _mm_set_ss(one));
            _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), _mm_loadu_ps(four.as_ptr()))
        })
    }

    /// Lanes 0 to 3 and 4 to 7: a row of three each, and the first value of the row behind it.
    #[inline(always)]
    pub fn load_threes(self, low: &[[f32; 3]; 2], high: &[[f32; 3]; 2]) -> Eight {
        // SAFETY: AVX, which `self` stands for; four of the six floats of each are read.
        Eight(unsafe {
            let low = _mm_loadu_ps(low.as_ptr().cast());
            _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), _mm_loadu_ps(high.as_ptr().cast()))
        })
    }
}

macro_rules! lane_by_lane {
    ($($(#[$doc:meta])* $name:ident($($arg:ident),*) = $body:expr;)*) => {
        $($(#[$doc])*
        #[inline(always)]
        #[must_use]
        pub fn $name(self $(, $arg: Eight)*) -> Eight {
            let x = self.0;
            $(let $arg = $arg.0;)*
            // SAFETY: AVX2, which there is: only an `Avx2` makes values.
            Eight(unsafe { $body(x $(, $arg)*) })
        })*
    };
}

impl Eight {
    lane_by_lane! {
        /// Sum.
        plus(b) = _mm256_add_ps;
        /// Difference.
        minus(b) = _mm256_sub_ps;
        /// Product.
        times(b) = _mm256_mul_ps;
        /// Quotient.
        over(b) = _mm256_div_ps;
        /// Root.
        sqrt() = _mm256_sqrt_ps;
        /// The bits that both have.
        and(b) = _mm256_and_ps;
        /// The bits that either has.
        or(b) = _mm256_or_ps;
        /// The bits of `b` that this has not.
        not_and(b) = _mm256_andnot_ps;
        /// Where the lanes are equal.
        equal(b) = _mm256_cmp_ps::<_CMP_EQ_OQ>;
        /// Where the lane is at most that of `b`.
        at_most(b) = _mm256_cmp_ps::<_CMP_LE_OQ>;
        /// Where the lane is not less than that of `b`: so where one is no number, too.
        not_less(b) = _mm256_cmp_ps::<_CMP_NLT_UQ>;
        /// The smaller one; `b` where they are equal or one is no number.
        smaller(b) = _mm256_min_ps;
        /// The larger one; `b` where they are equal or one is no number.
        larger(b) = _mm256_max_ps;
    }

    /// The larger one of the bits as whole numbers.
    #[inline(always)]
    #[must_use]
    pub fn larger_bits(self, b: Eight) -> Eight {
        // SAFETY: AVX2, which there is: only an `Avx2` makes values.
        Eight(unsafe { _mm256_castsi256_ps(_mm256_max_epi32(_mm256_castps_si256(self.0), _mm256_castps_si256(b.0))) })
    }

    /// Lanes of `b` where those of `mask` are all ones, of `self` elsewhere.
    #[inline(always)]
    #[must_use]
    pub fn but(self, mask: Eight, b: Eight) -> Eight {
        // SAFETY: AVX, which there is: only an `Avx2` makes values.
        Eight(unsafe { _mm256_blendv_ps(self.0, b.0, mask.0) })
    }

    /// Lanes 0 to 2 of `b`, 3 to 7 of `self`.
    #[inline(always)]
    #[must_use]
    pub fn but_first_three(self, b: Eight) -> Eight {
        // SAFETY: AVX, which there is: only an `Avx2` makes values.
        Eight(unsafe { _mm256_blend_ps::<0b111>(self.0, b.0) })
    }

    /// Whether a lane has its sign: after a comparison, whether it holds somewhere.
    #[inline(always)]
    pub fn any(self) -> bool {
        // SAFETY: AVX, which there is: only an `Avx2` makes values.
        unsafe { _mm256_testz_ps(self.0, self.0) == 0 }
    }

    /// Whether a bit of a lane is set.
    #[inline(always)]
    pub fn any_bit(self) -> bool {
        // SAFETY: AVX, which there is: only an `Avx2` makes values.
        unsafe {
            let bits = _mm256_castps_si256(self.0);
            _mm256_testz_si256(bits, bits) == 0
        }
    }

    /// Whether the bits of a lane are above `most` as whole numbers.
    #[inline(always)]
    pub fn any_bits_above(self, most: i32) -> bool {
        // SAFETY: AVX2, which there is: only an `Avx2` makes values.
        unsafe {
            let above = _mm256_cmpgt_epi32(_mm256_castps_si256(self.0), _mm256_set1_epi32(most));
            _mm256_testz_si256(above, above) == 0
        }
    }

    /// To memory.
    #[inline(always)]
    pub fn store(self, to: &mut [f32; EIGHT]) {
        // SAFETY: AVX, which there is; the reference is to as many floats as are written.
        unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) }
    }

    /// Lanes 0 to 2, 3 and 4 to 7.
    #[inline(always)]
    pub fn store_three_one_four(self, three: &mut [f32; 3], one: &mut f32, four: &mut [f32; 4]) {
        // SAFETY: AVX, which there is; `four` is as many floats as are written.
        let low = unsafe {
            _mm_storeu_ps(four.as_mut_ptr(), _mm256_extractf128_ps::<1>(self.0));
            _mm256_castps256_ps128(self.0)
        };
        store_three(low, three);
        // SAFETY: SSE4.1, which there is with AVX.
        *one = f32::from_bits(unsafe { _mm_extract_ps::<3>(low) } as u32);
    }

    /// Lanes 0 to 2 and 4 to 6.
    #[inline(always)]
    pub fn store_threes(self, low: &mut [f32; 3], high: &mut [f32; 3]) {
        // SAFETY: AVX, which there is.
        let halves = unsafe { (_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0)) };
        store_three(halves.0, low);
        store_three(halves.1, high);
    }
}

/// The first three lanes.
#[inline(always)]
fn store_three(from: __m128, to: &mut [f32; 3]) {
    // SAFETY: SSE4.1, which there is where an `Eight` was; two of the three floats of `to` are written, by an instruction that
    // takes any address (that of doubles, `_mm_storel_pd`, wants one that is a multiple of 8 in Rust).
    unsafe {
        _mm_storeu_si64(to.as_mut_ptr().cast(), _mm_castps_si128(from));
        to[2] = f32::from_bits(_mm_extract_ps::<2>(from) as u32);
    }
}
