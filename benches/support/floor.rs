//! The best rates of this machine, measured with bare loops: blending in registers, copying memory.

use super::steady_time;
use gsscale::base::simd::{Kernel, LANES, SimdPath, dispatch, fma};
use gsscale::kernels::raster::exp2_bounded;
use gsscale::kernels::splats::LOG2_ALPHA_MIN;
use rayon::prelude::*;
use std::time::Duration;

/// Passes of the bare loop over its splats per run.
const REPEATS: usize = 50;

/// Pixel-Gaussians per CPU second and thread of a bare loop, timed for at least `least`. The splats stay in the first
/// cache level and the state of all pixels of a 16x16 tile in registers; there are no lists, early stops or edges.
pub fn bare_blend_rate(simd: SimdPath, least: Duration) -> f64 {
    let threads = rayon::current_num_threads();
    let splats: Vec<[f32; 8]> = (0..512)
        .map(|i| [(i % 16) as f32, (i / 32) as f32, -0.02, 0.01, -0.03, -6.0, 0.5, 0.25 + i as f32 * 1e-3])
        .collect();
    let t = steady_time(least, || {
        let sums: Vec<f32> =
            (0..threads).into_par_iter().map(|_| dispatch(simd, Bare { splats: &splats, repeats: REPEATS })).collect();
        assert!(sums.iter().all(|s| s.is_finite()));
    });
    (threads * REPEATS * splats.len() * 256) as f64 / t.cpu
}

/// Bytes read and written per CPU second and thread of a plain copy of `words` floats a thread.
pub fn copy_rate(words: usize, least: Duration) -> f64 {
    let threads = rayon::current_num_threads();
    let mut pairs: Vec<(Vec<f32>, Vec<f32>)> = (0..threads).map(|_| (vec![1.0; words], vec![0.0; words])).collect();
    let t = steady_time(least, || {
        pairs.par_iter_mut().for_each(|(from, to)| to.copy_from_slice(std::hint::black_box(from)));
        std::hint::black_box(&pairs);
    });
    (threads * words * 8) as f64 / t.cpu
}

struct Bare<'a> {
    splats: &'a [[f32; 8]],
    repeats: usize,
}

impl Kernel for Bare<'_> {
    type Out = f32;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> f32 {
        let mut sum = 0.0;
        for _ in 0..self.repeats {
            for row in 0..16 {
                let (mut t, mut rgb) = ([1.0f32; LANES], [[0.0f32; LANES]; 3]);
                for s in std::hint::black_box(self.splats) {
                    let dy = row as f32 - s[1];
                    let (bdy, cdy) = (s[3] * dy, fma::<FMA>(s[4] * dy, dy, s[5]));
                    for lane in 0..LANES {
                        let dx = lane as f32 - s[0];
                        let e = fma::<FMA>(fma::<FMA>(s[2], dx, bdy), dx, cdy);
                        let alpha = if e >= LOG2_ALPHA_MIN { exp2_bounded::<FMA>(e) } else { 0.0 };
                        let w = alpha * t[lane];
                        t[lane] -= w;
                        rgb[0][lane] = fma::<FMA>(w, s[5], rgb[0][lane]);
                        rgb[1][lane] = fma::<FMA>(w, s[6], rgb[1][lane]);
                        rgb[2][lane] = fma::<FMA>(w, s[7], rgb[2][lane]);
                    }
                }
                sum += rgb.iter().flatten().sum::<f32>();
            }
        }
        sum
    }
}
