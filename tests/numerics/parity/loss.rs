//! image_loss: value, parts and gradient.

use super::pages::read;
use crate::support::gpu::open;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::gpu::{Gpu, GpuOptions, Subgroups};
use gsscale::kernels::image_loss::{ImageLoss, LossOptions, LossPlan, LossValue, SsimPadding};
use gsscale::kernels::uniforms::pack_target;
use gsscale::render::gpu_loss::{LossStage, value};
use gsscale::scene::image::{Image, Target};

/// Sizes: ordinary, odd, one pixel, one line, exactly a tile, exactly a window, below a window, none.
const SIZES: [[u32; 2]; 10] =
    [[96, 64], [65, 47], [1, 1], [1, 40], [50, 1], [16, 16], [11, 11], [10, 33], [0, 7], [0, 0]];

/// The device as it is, with subgroup operations if supported, and on the plain path.
fn devices() -> impl Iterator<Item = Gpu> {
    let all = [Subgroups::Best, Subgroups::Off].into_iter().chain([4, 16, 64].map(Subgroups::Emulated));
    all.filter_map(|subgroups| open(&GpuOptions { subgroups, ..GpuOptions::default() }))
}

fn options(ssim_lambda: f32, padding: SsimPadding) -> LossOptions {
    LossOptions { ssim_lambda, padding, simd: SimdPath::best() }
}

/// A smooth photo and a picture that resembles it, with noise.
fn pair(width: u32, height: u32) -> (Image, Target) {
    let mut rng = Stream::new(9, Purpose::Test, u64::from(width), u64::from(height));
    let mut image = Image::new(width, height);
    let mut target = Target { width, height, ..Target::default() };
    let n = image.pixels();
    for p in 0..n {
        let (x, y) = ((p % width as usize) as f64, (p / width as usize) as f64);
        for c in 0..3 {
            let smooth = 0.5 + 0.4 * libm::sin(0.21 * x + 0.13 * y + c as f64);
            target.rgb.push((255.0 * smooth) as u8);
            image.rgb[c * n + p] = (smooth + 0.2 * rng.range(-1.0, 1.0)) as f32;
        }
    }
    (image, target)
}

fn on_cpu(image: &Image, target: &Target, options: &LossOptions) -> (LossValue, Vec<f32>) {
    let mut v_rgb = Vec::new();
    let value = ImageLoss::default().value_and_gradient(image, target, options, &mut v_rgb);
    (value, v_rgb)
}

fn on_gpu(gpu: &Gpu, image: &Image, target: &Target, options: &LossOptions) -> (LossValue, Vec<f32>) {
    let stage = LossStage::new(gpu).unwrap();
    let size = [image.width, image.height];
    let plan = LossPlan::new(size[0] as usize, size[1] as usize, target.mask.as_deref(), options);
    let mut words = Vec::new();
    pack_target(target, &mut words);
    let mut recorder = gpu.begin("parity");
    let rgb = recorder.buffer_with("rgb", &image.rgb).unwrap();
    let target_pixels = recorder.buffer_with("target", &words).unwrap();
    let v_rgb = recorder.buffer_with("v_rgb", &vec![f32::NAN; image.rgb.len()]).unwrap();
    let sums = stage.run(gpu, &mut recorder, size, &plan, &rgb.view(), &target_pixels.view(), &v_rgb.view()).unwrap();
    gpu.submit(recorder).unwrap();
    let sums = sums.map_or([0.0; 4], |sums| read::<[f32; 4]>(gpu, &sums, 1)[0]);
    (value(&plan, sums), read(gpu, &v_rgb, image.rgb.len()))
}

#[track_caller]
fn assert_same(what: &str, gpu: &Gpu, image: &Image, target: &Target, options: &LossOptions) {
    let (want, want_v) = on_cpu(image, target, options);
    let (got, got_v) = on_gpu(gpu, image, target, options);
    // Differences and squares of f32, added in trees of f32: some twenty roundings of 6e-8.
    let close = |a: f64, b: f64, limit: f64| (a - b).abs() <= limit * b.abs().max(1e-3);
    assert!(close(got.l1, want.l1, 2e-6), "{what}: l1 {} {}", got.l1, want.l1);
    assert!(close(got.mse, want.mse, 2e-6), "{what}: mse {} {}", got.mse, want.mse);
    // A variance is a difference of two means near 1, each with roundings of 1e-7, divided by at least 9e-4.
    assert!((got.ssim - want.ssim).abs() <= 1e-5, "{what}: ssim {} {}", got.ssim, want.ssim);
    assert!((got.loss - want.loss).abs() <= 1e-5, "{what}: loss {} {}", got.loss, want.loss);
    assert_eq!(got_v.len(), want_v.len(), "{what}");
    let scale = want_v.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    for (i, (g, w)) in got_v.iter().zip(&want_v).enumerate() {
        // The same variances, in the gradient: it is a sum of terms up to 2 / 9e-4 that cancel.
        assert!((g - w).abs() <= LIMIT * scale, "{what}, value {i}: {g} {w}, largest {scale}");
        assert!(*w != 0.0 || *g == 0.0, "{what}, value {i}: {g}, want exactly 0");
    }
}

/// Error relative to the largest gradient: five times lavapipe's.
const LIMIT: f32 = 1e-4;

#[test]
fn values_and_gradients_are_those_of_the_cpu() {
    for gpu in devices() {
        for [width, height] in SIZES {
            let (image, target) = pair(width, height);
            for padding in [SsimPadding::Valid, SsimPadding::Same] {
                for lambda in [0.0, 0.2, 1.0] {
                    let what = format!("{width}x{height} {padding:?} {lambda}");
                    assert_same(&what, &gpu, &image, &target, &options(lambda, padding));
                }
            }
        }
    }
}

#[test]
fn sums_of_many_tiles_take_two_rounds() {
    // 3 channels of 100 x 15 tiles: more than one workgroup of partial sums.
    let (image, target) = pair(1600, 240);
    for gpu in devices() {
        assert_same("1600x240", &gpu, &image, &target, &options(0.2, SsimPadding::Valid));
    }
}

#[test]
fn masks_are_those_of_the_cpu() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let (image, mut target) = pair(65, 47);
    let n = image.pixels();
    let mut rng = Stream::new(10, Purpose::Test, 0, 0);
    let masks: [(&str, Vec<u8>); 4] = [
        ("random", (0..n).map(|_| if rng.below(3) == 0 { 0 } else { 255 }).collect()),
        ("nothing counts", vec![0; n]),
        // With valid windows only, no window counts, but pixels do.
        ("the border only", (0..n).map(|p| u8::from(p % 65 < 4 || p / 65 < 4)).collect()),
        ("everything", vec![1; n]),
    ];
    for (what, mask) in masks {
        target.mask = Some(mask);
        for padding in [SsimPadding::Valid, SsimPadding::Same] {
            assert_same(&format!("{what} {padding:?}"), &gpu, &image, &target, &options(0.2, padding));
        }
    }
}

#[test]
fn non_finite_pixels_show_unless_masked() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let (clean, mut target) = pair(65, 47);
    let place = 30 * 65 + 33;
    let options = options(0.2, SsimPadding::Valid);
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        target.mask = None;
        let mut image = clean.clone();
        image.rgb[place] = poison;
        assert!(!on_gpu(&gpu, &image, &target, &options).0.loss.is_finite(), "{poison}");
        // Masked pixels have no effect.
        let mut mask = vec![255; image.pixels()];
        mask[place] = 0;
        target.mask = Some(mask);
        let masked = on_gpu(&gpu, &image, &target, &options);
        assert!(masked == on_gpu(&gpu, &clean, &target, &options), "{poison}");
        assert_same(&format!("masked {poison}"), &gpu, &image, &target, &options);
    }
    target.mask = None;
    let mut image = clean;
    image.rgb[place] = 1e-41;
    image.rgb[place + 1] = -0.0;
    assert_same("denormal", &gpu, &image, &target, &options);
}

#[test]
fn flat_bright_patches_and_equal_pictures() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let (mut image, mut target) = pair(40, 30);
    target.rgb.fill(255);
    image.rgb.fill(1.0);
    let options = options(0.2, SsimPadding::Same);
    let (value, v_rgb) = on_gpu(&gpu, &image, &target, &options);
    assert_eq!((value.l1, value.mse), (0.0, 0.0));
    assert!((value.ssim - 1.0).abs() < 1e-6 && v_rgb.iter().all(|v| v.is_finite()), "{value:?}");
    image.rgb.fill(0.9);
    let (got, want) = (on_gpu(&gpu, &image, &target, &options).0, on_cpu(&image, &target, &options).0);
    // Variances of exactly 0 are computed as some 1e-7, against 9e-4.
    assert!((got.loss - want.loss).abs() < 1e-4, "{got:?} {want:?}");
}

#[test]
fn runs_are_bit_identical() {
    let (image, target) = pair(129, 83);
    let options = options(0.2, SsimPadding::Valid);
    for gpu in devices() {
        let first = on_gpu(&gpu, &image, &target, &options);
        for _ in 0..5 {
            assert!(on_gpu(&gpu, &image, &target, &options) == first);
        }
    }
}
