//! Eight floats in one AVX2 register, for loops that the compiler vectorises poorly.
//!
//! An [`Eight`] can only be made through an [`Avx2`], and an [`Avx2`] only by [`with_avx2`], inside a function compiled
//! for AVX2: so code that holds a value runs on a processor that has the instructions. Every operation is one or two
//! instructions; comparisons give lanes of all ones or all zeros.
//!
//! Not here: the computations. Invariant: sums, differences, products, quotients and roots round as those of `f32`,
//! lane by lane, and nothing is contracted; so a loop of these gives the same bits as a scalar loop.
#![allow(unsafe_code)] // AVX2 instructions, which some processors lack

use super::simd::SimdPath;
use std::arch::x86_64::*;

/// Lanes of an [`Eight`].
pub const EIGHT: usize = 8;

/// Proof that the processor has AVX2.
#[derive(Clone, Copy)]
pub struct Avx2(());

/// A kernel written in [`Eight`]s.
pub trait EightKernel {
    type Out;
    /// Runs the kernel. Mark the implementation, and every function it calls in its inner loop, `#[inline(always)]`:
    /// other functions are compiled without AVX2 and receive their values through memory.
    fn run(self, avx2: Avx2) -> Self::Out;
}

/// Runs `kernel` if the processor has AVX2, otherwise returns it.
#[inline]
pub fn with_avx2<K: EightKernel>(kernel: K) -> Result<K::Out, K> {
    if !SimdPath::Avx2.is_supported() {
        return Err(kernel);
    }
    // SAFETY: the features of the callee were detected on this machine just now (the answer is cached by std).
    Ok(unsafe { run(kernel) })
}

// Compiled without fma, although `SimdPath::Avx2` has it: so nothing can be contracted.
#[target_feature(enable = "avx2")]
fn run<K: EightKernel>(kernel: K) -> K::Out {
    kernel.run(Avx2(()))
}

/// Eight floats.
#[derive(Clone, Copy)]
pub struct Eight(__m256);

impl Avx2 {
    /// The same value in every lane.
    #[inline(always)]
    pub fn splat(self, x: f32) -> Eight {
        // SAFETY: `self` proves AVX.
        Eight(unsafe { _mm256_set1_ps(x) })
    }

    /// Loads eight floats from memory.
    #[inline(always)]
    pub fn load(self, from: &[f32; EIGHT]) -> Eight {
        // SAFETY: `self` proves AVX; the reference covers all floats read.
        Eight(unsafe { _mm256_loadu_ps(from.as_ptr()) })
    }

    /// Lanes 0 to 2: a row of three; 3: `one`; 4 to 7: a row of four. `three` includes the next row, so that the load
    /// of a whole quarter stays in bounds; that row is not used.
    #[inline(always)]
    pub fn load_three_one_four(self, three: &[[f32; 3]; 2], one: f32, four: &[f32; 4]) -> Eight {
        // SAFETY: `self` proves AVX; four of the six floats of `three` and the four of `four` are read.
        Eight(unsafe {
            let low = _mm_insert_ps::<0x30>(_mm_loadu_ps(three.as_ptr().cast()), _mm_set_ss(one));
            _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), _mm_loadu_ps(four.as_ptr()))
        })
    }

    /// Lanes 0 to 3 and 4 to 7: each a row of three and the first value of the next row.
    #[inline(always)]
    pub fn load_threes(self, low: &[[f32; 3]; 2], high: &[[f32; 3]; 2]) -> Eight {
        // SAFETY: `self` proves AVX; four of the six floats of each argument are read.
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
            // SAFETY: AVX2 is available: only an `Avx2` makes values.
            Eight(unsafe { $body(x $(, $arg)*) })
        })*
    };
}

impl Eight {
    lane_by_lane! {
        plus(b) = _mm256_add_ps;
        minus(b) = _mm256_sub_ps;
        times(b) = _mm256_mul_ps;
        over(b) = _mm256_div_ps;
        sqrt() = _mm256_sqrt_ps;
        /// Bitwise and.
        and(b) = _mm256_and_ps;
        /// Bitwise or.
        or(b) = _mm256_or_ps;
        /// Bits of `b` that are not set in `self`.
        not_and(b) = _mm256_andnot_ps;
        /// Mask of lanes that are equal.
        equal(b) = _mm256_cmp_ps::<_CMP_EQ_OQ>;
        /// Mask of lanes that are at most those of `b`.
        at_most(b) = _mm256_cmp_ps::<_CMP_LE_OQ>;
        /// Mask of lanes that are not less than those of `b`; also set where one is NaN.
        not_less(b) = _mm256_cmp_ps::<_CMP_NLT_UQ>;
        /// The smaller lane; `b` where they are equal or one is NaN.
        smaller(b) = _mm256_min_ps;
        /// The larger lane; `b` where they are equal or one is NaN.
        larger(b) = _mm256_max_ps;
    }

    /// Per lane the larger of the bits as integers.
    #[inline(always)]
    #[must_use]
    pub fn larger_bits(self, b: Eight) -> Eight {
        // SAFETY: AVX2 is available: only an `Avx2` makes values.
        Eight(unsafe { _mm256_castsi256_ps(_mm256_max_epi32(_mm256_castps_si256(self.0), _mm256_castps_si256(b.0))) })
    }

    /// Lanes of `b` where those of `mask` are all ones, lanes of `self` elsewhere.
    #[inline(always)]
    #[must_use]
    pub fn blend(self, mask: Eight, b: Eight) -> Eight {
        // SAFETY: AVX is available: only an `Avx2` makes values.
        Eight(unsafe { _mm256_blendv_ps(self.0, b.0, mask.0) })
    }

    /// Lanes 0 to 2 of `b`, 3 to 7 of `self`.
    #[inline(always)]
    #[must_use]
    pub fn blend_first_three(self, b: Eight) -> Eight {
        // SAFETY: AVX is available: only an `Avx2` makes values.
        Eight(unsafe { _mm256_blend_ps::<0b111>(self.0, b.0) })
    }

    /// Whether the sign bit of any lane is set: for a mask, whether any lane is set.
    #[inline(always)]
    pub fn any(self) -> bool {
        // SAFETY: AVX is available: only an `Avx2` makes values.
        unsafe { _mm256_testz_ps(self.0, self.0) == 0 }
    }

    /// Whether any bit of any lane is set.
    #[inline(always)]
    pub fn any_bit(self) -> bool {
        // SAFETY: AVX is available: only an `Avx2` makes values.
        unsafe {
            let bits = _mm256_castps_si256(self.0);
            _mm256_testz_si256(bits, bits) == 0
        }
    }

    /// Whether the bits of any lane, as an integer, exceed `most`.
    #[inline(always)]
    pub fn any_bits_above(self, most: i32) -> bool {
        // SAFETY: AVX2 is available: only an `Avx2` makes values.
        unsafe {
            let above = _mm256_cmpgt_epi32(_mm256_castps_si256(self.0), _mm256_set1_epi32(most));
            _mm256_testz_si256(above, above) == 0
        }
    }

    /// Stores all lanes to memory.
    #[inline(always)]
    pub fn store(self, to: &mut [f32; EIGHT]) {
        // SAFETY: AVX is available; the reference covers all floats written.
        unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) }
    }

    /// Stores lanes 0 to 2, lane 3, and lanes 4 to 7.
    #[inline(always)]
    pub fn store_three_one_four(self, three: &mut [f32; 3], one: &mut f32, four: &mut [f32; 4]) {
        // SAFETY: AVX is available; `four` covers all floats written.
        let low = unsafe {
            _mm_storeu_ps(four.as_mut_ptr(), _mm256_extractf128_ps::<1>(self.0));
            _mm256_castps256_ps128(self.0)
        };
        store_three(low, three);
        // SAFETY: SSE4.1 is available wherever AVX is.
        *one = f32::from_bits(unsafe { _mm_extract_ps::<3>(low) } as u32);
    }

    /// Stores lanes 0 to 2 and 4 to 6.
    #[inline(always)]
    pub fn store_threes(self, low: &mut [f32; 3], high: &mut [f32; 3]) {
        // SAFETY: AVX is available.
        let halves = unsafe { (_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0)) };
        store_three(halves.0, low);
        store_three(halves.1, high);
    }
}

/// Stores the first three lanes.
#[inline(always)]
fn store_three(from: __m128, to: &mut [f32; 3]) {
    // SAFETY: SSE4.1 is available wherever an `Eight` was made. Two of the three floats of `to` are written by an
    // instruction that takes any address (in Rust the one for doubles, `_mm_storel_pd`, requires a multiple of 8).
    unsafe {
        _mm_storeu_si64(to.as_mut_ptr().cast(), _mm_castps_si128(from));
        to[2] = f32::from_bits(_mm_extract_ps::<2>(from) as u32);
    }
}
