//! Time of the image loss and its gradient, per instruction path, on one thread and on all.
//!
//! `cargo bench --bench image_loss` prints medians in milliseconds and per megapixel, and the ratio to a plain copy of
//! the same bytes. A test run measures one small picture.

mod support;

use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::kernels::image_loss::ImageLoss;
use gsscale::render::{LossOptions, SsimPadding};
use gsscale::scene::image::{Image, Target};
use std::time::Duration;
use support::floor::copy_rate;
use support::{Args, Hash, machine, steady_time};

fn pictures(width: u32, height: u32) -> (Image, Target) {
    let mut draw = Stream::new(1, Purpose::Test, u64::from(width), u64::from(height));
    let mut image = Image::new(width, height);
    image.rgb.iter_mut().for_each(|v| *v = draw.uniform() as f32);
    let rgb = (0..image.rgb.len()).map(|_| draw.below(256) as u8).collect();
    (image, Target::new([width, height], rgb))
}

/// Median wall and CPU milliseconds, and the bits of the loss.
fn median_ms(width: u32, height: u32, simd: SimdPath, time: Duration) -> (f64, f64, u64) {
    let (image, target) = pictures(width, height);
    let options = LossOptions { ssim_lambda: 0.2, padding: SsimPadding::Valid, simd };
    let (mut loss, mut v_rgb) = (ImageLoss::default(), Vec::new());
    let mut bits = 0;
    let t = steady_time(time, || {
        let value = loss.value_and_gradient(&image, &target, &options, &mut v_rgb);
        assert!(value.loss.is_finite());
        bits = value.loss.to_bits();
    });
    (1e3 * t.wall, 1e3 * t.cpu, bits)
}

/// One small picture on every path; returns a hash of the losses.
pub fn tiny() -> u64 {
    let mut hash = Hash::default();
    for path in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
        hash.add(median_ms(40, 30, path, Duration::ZERO).2);
    }
    hash.0
}

fn main() {
    let args = Args::read();
    if !args.real {
        assert!(tiny() != 0);
        return;
    }
    println!("{}", machine(args.simd()));
    let floor = copy_rate(1 << 24, Duration::from_secs(1));
    for threads in [1, rayon::current_num_threads()] {
        let Ok(pool) = rayon::ThreadPoolBuilder::new().num_threads(threads).build() else { return };
        for (width, height) in [(395, 297), (1600, 1064)] {
            let mega = f64::from(width * height) / 1e6;
            // Three floats and three bytes read, three floats written.
            let floor_ms = 1e3 * mega * 1e6 * 27.0 / floor;
            for path in SimdPath::ALL.into_iter().filter(|p| p.is_supported()) {
                let (wall, cpu, bits) = pool.install(|| median_ms(width, height, path, Duration::from_secs(1)));
                println!(
                    "{width}x{height} {threads} threads {}: {wall:.2} ms wall, {cpu:.2} ms CPU ({:.1} a megapixel, {:.0} \
                     times a copy's), loss {bits:016x}",
                    path.name(),
                    cpu / mega,
                    cpu / floor_ms
                );
            }
        }
    }
}
