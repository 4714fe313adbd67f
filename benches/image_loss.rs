//! Time of the image loss with its gradient, per instruction path, on one thread and on all.
//! `cargo bench --bench image_loss` prints the best of several runs in milliseconds and per megapixel; inside a test
//! run (no `--bench`) it does one small picture and prints nothing, so that it cannot rot.

use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::kernels::image_loss::ImageLoss;
use gsscale::render::{LossOptions, SsimPadding};
use gsscale::scene::image::{Image, Target};
use std::time::Instant;

fn pictures(width: u32, height: u32) -> (Image, Target) {
    let mut draw = Stream::new(1, Purpose::Test, u64::from(width), u64::from(height));
    let mut image = Image::new(width, height);
    image.rgb.iter_mut().for_each(|v| *v = draw.uniform() as f32);
    let rgb = (0..image.rgb.len()).map(|_| draw.below(256) as u8).collect();
    (image, Target { width, height, rgb, mask: None })
}

fn best_ms(width: u32, height: u32, simd: SimdPath, runs: usize) -> f64 {
    let (image, target) = pictures(width, height);
    let options = LossOptions { ssim_lambda: 0.2, padding: SsimPadding::Valid, simd };
    let (mut loss, mut v_rgb) = (ImageLoss::new(), Vec::new());
    let mut best = f64::INFINITY;
    for _ in 0..runs {
        let start = Instant::now();
        let value = loss.value_and_gradient(&image, &target, &options, &mut v_rgb);
        assert!(value.loss.is_finite());
        best = best.min(start.elapsed().as_secs_f64() * 1e3);
    }
    best
}

fn main() {
    if !std::env::args().any(|arg| arg == "--bench") {
        best_ms(40, 30, SimdPath::best(), 1);
        return;
    }
    for threads in [1, std::thread::available_parallelism().map_or(1, usize::from)] {
        let Ok(pool) = rayon::ThreadPoolBuilder::new().num_threads(threads).build() else { return };
        for (width, height) in [(395, 297), (1600, 1064)] {
            for path in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
                let ms = pool.install(|| best_ms(width, height, path, 30));
                let mega = f64::from(width * height) / 1e6;
                let name = path.name();
                println!("{width}x{height} {threads} threads {name}: {ms:.2} ms, {:.1} ms/Mpixel", ms / mega);
            }
        }
    }
}
