//! Instruction paths: the same kernel code compiled for several instruction sets, chosen at run time.
//!
//! A kernel implements [`Kernel::run`] once, `#[inline(always)]`, on plain slices in 16-wide inner loops that the
//! compiler vectorises; [`dispatch`] calls it inside a function compiled for the path. `FMA` tells the kernel whether
//! the path has fused multiply-add: use [`fma`], which is fused on AVX2 and AVX-512 and rounds twice on the baseline.
//! So AVX2 and AVX-512 give the same bits, and the baseline gives others. Equal bits are promised per class of paths
//! ([`BitsClass`]). A checkpoint records the path, and a run may resume with any path of the same class.
//!
//! The `unsafe` of the crate's compute half is confined to this file.
#![allow(unsafe_code)] // calling a function compiled for a detected instruction set

use super::names::names;
use std::sync::OnceLock;

/// Width of inner loops: one tile row, one AVX-512 register, two AVX2 registers.
pub const LANES: usize = 16;

/// A class of instruction paths that give the same bits.
///
/// Tests compare the paths available on their machine: the picture, its gradients and the loss
/// (`the_paths_of_a_class_give_the_same_bits` of the oracle tests), the optimizer (`tests/numerics/deferred.rs`, where
/// the baseline gives the same bits too, because nothing is fused there), culling (`tests/numerics/cull.rs`), bounds of
/// pages (their unit test), and a whole run (`tests/programs/resume/paths.rs`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BitsClass {
    /// AVX2 and AVX-512: multiply-add is one instruction that rounds once. Inner loops are 16 wide on both, so sums are
    /// taken in the same order.
    Fused,
    /// The baseline: multiply-add is two instructions that round twice. Emulating the fused one in software would be
    /// far slower.
    RoundedTwice,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SimdPath {
    /// AVX-512 F/BW/DQ/VL with FMA.
    Avx512,
    /// AVX2 with FMA.
    Avx2,
    /// The target's baseline (SSE2 on x86-64).
    Baseline,
}

// Best first.
names!(SimdPath { Avx512 = "avx512", Avx2 = "avx2", Baseline = "baseline" });

impl SimdPath {
    /// The class of paths that give the same bits as this one.
    pub fn bits_class(self) -> BitsClass {
        match self {
            SimdPath::Avx512 | SimdPath::Avx2 => BitsClass::Fused,
            SimdPath::Baseline => BitsClass::RoundedTwice,
        }
    }

    #[cfg(target_arch = "x86_64")]
    pub fn is_supported(self) -> bool {
        match self {
            SimdPath::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl")
                    && SimdPath::Avx2.is_supported()
            }
            SimdPath::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            SimdPath::Baseline => true,
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    pub fn is_supported(self) -> bool {
        self == SimdPath::Baseline
    }

    pub fn best() -> SimdPath {
        static BEST: OnceLock<SimdPath> = OnceLock::new();
        *BEST.get_or_init(|| SimdPath::ALL.into_iter().find(|p| p.is_supported()).unwrap_or(SimdPath::Baseline))
    }
}

/// A kernel that [`dispatch`] compiles for each path.
pub trait Kernel {
    type Out;
    /// Runs the kernel. Mark the implementation, and every function it calls in its inner loop, `#[inline(always)]`.
    fn run<const FMA: bool>(self) -> Self::Out;
}

/// `a * b + c`: fused if `FMA`, otherwise rounded twice.
#[inline(always)]
pub fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Prefetches the cache line of `values[at]`; does nothing on processors without such an instruction. `at` may be out
/// of bounds: a check would cost more than the prefetch.
#[inline(always)]
pub fn prefetch<T>(values: &[T], at: usize) {
    let address = values.as_ptr().wrapping_add(at);
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: SSE is part of x86-64, and a prefetch reads nothing, whatever the address.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(address.cast()) };
    }
    let _ = address;
}

/// Runs `kernel` on `path`, or on the baseline if this machine lacks `path`.
#[inline]
pub fn dispatch<K: Kernel>(path: SimdPath, kernel: K) -> K::Out {
    #[cfg(target_arch = "x86_64")]
    {
        match path {
            // SAFETY: the features of the callee were detected on this machine just now (the answer is cached by std).
            SimdPath::Avx512 if path.is_supported() => return unsafe { run_avx512(kernel) },
            // SAFETY: as above.
            SimdPath::Avx2 if path.is_supported() => return unsafe { run_avx2(kernel) },
            _ => {}
        }
    }
    let _ = path;
    kernel.run::<false>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")]
fn run_avx512<K: Kernel>(kernel: K) -> K::Out {
    kernel.run::<true>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<K: Kernel>(kernel: K) -> K::Out {
    kernel.run::<true>()
}
