//! Loss, its gradient and the metrics: against the fixtures, and against a direct double-precision SSIM (121 taps,
//! neither separable nor tiled) on odd sizes with masks. Finite differences of that SSIM give its gradient.

use crate::support::fixture::Fixture;
use crate::support::paths;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::kernels::image_loss::{ImageLoss, ImagePair, Reference, SsimVariant, mean_ssim};
use gsscale::render::metrics;
use gsscale::render::{LossOptions, LossValue, SsimPadding};
use gsscale::scene::image::{Image, Target};

const FILES: [&str; 5] = ["loss_edge", "loss_noise", "loss_smooth", "loss_tiny", "loss_u8gt"];

fn options(ssim_lambda: f32, padding: SsimPadding, simd: SimdPath) -> LossOptions {
    LossOptions { ssim_lambda, padding, simd }
}

/// Largest difference relative to the largest magnitude of `want`.
fn worst(got: &[f32], want: &[f32]) -> f64 {
    assert_eq!(got.len(), want.len());
    let scale = want.iter().fold(0.0f64, |m, &v| m.max(f64::from(v).abs()));
    let differences = got.iter().zip(want).map(|(&g, &w)| (f64::from(g) - f64::from(w)).abs());
    differences.fold(0.0, |m: f64, d| if d.is_nan() { d } else { m.max(d) }) / scale
}

/// A fixture's value is a scalar tensor; 1e-5 is the README's limit (measured f32 error of a reference: 1.2e-6).
fn assert_value(fixture: &Fixture, name: &str, got: f64, context: &str) {
    let want = fixture.f64(name)[0];
    assert!((got - want).abs() < 1e-5, "{context} {name}: {got}, want {want}");
}

/// 5e-4 of the largest entry is the README's limit (measured f32 error of a reference: 6e-5).
fn assert_gradient(fixture: &Fixture, name: &str, got: &[f32], context: &str) {
    let worst = worst(got, &fixture.planar(name));
    assert!(worst < 5e-4, "{context} {name}: worst error {worst} of the largest entry");
}

#[test]
fn values_and_gradients_match_the_fixtures() {
    for file in FILES {
        let Some(fixture) = Fixture::open(file) else { return };
        let (height, width) = (fixture.shape("img")[0], fixture.shape("img")[1]);
        let (rgb, gt) = (fixture.planar("img"), fixture.planar("gt"));
        let pair = ImagePair { width, height, rgb: &rgb, reference: Reference::Planar(&gt), mask: None, clamp: false };
        let lambda = fixture.f64("lambda")[0] as f32;
        let (mut loss, mut v) = (ImageLoss::default(), Vec::new());
        for path in paths() {
            let context = format!("{file} {}", path.name());
            let mut run = |lambda, padding| {
                let value = loss.pair_value_and_gradient(&pair, &options(lambda, padding, path), &mut v);
                (value, v.clone())
            };
            let (same, v_same) = run(lambda, SsimPadding::Same);
            let (valid, v_valid) = run(lambda, SsimPadding::Valid);
            let (_, v_l1) = run(0.0, SsimPadding::Same);
            let (_, v_ssim) = run(1.0, SsimPadding::Same);
            let v_ssim: Vec<f32> = v_ssim.iter().map(|g| -g).collect();
            assert_value(&fixture, "val_l1", same.l1, &context);
            assert_value(&fixture, "val_mse", same.mse, &context);
            assert_value(&fixture, "val_ssim_same", same.ssim, &context);
            assert_value(&fixture, "val_ssim_valid", valid.ssim, &context);
            assert_value(&fixture, "val_ssim_reflect", mean_ssim(&pair, SsimVariant::Reflect, path), &context);
            assert_value(&fixture, "val_loss_same", same.loss, &context);
            assert_value(&fixture, "val_loss_valid", valid.loss, &context);
            assert_gradient(&fixture, "g_l1", &v_l1, &context);
            assert_gradient(&fixture, "g_ssim_same", &v_ssim, &context);
            assert_gradient(&fixture, "g_loss_same", &v_same, &context);
            assert_gradient(&fixture, "g_loss_valid", &v_valid, &context);
            // dB: 10 log10 turns a relative error of 1e-6 into 4e-6.
            let psnr = -10.0 * libm::log10(same.mse);
            assert!((psnr - fixture.f64("val_psnr")[0]).abs() < 1e-4, "{context} psnr {psnr}");
        }
        // metrics::psnr takes 8-bit photos only; the definition is checked on the slices it is made from.
        let [rgb, gt] = [&rgb, &gt].map(|values| values.iter().map(|v| v.clamp(0.0, 1.0)).collect::<Vec<f32>>());
        let pair = ImagePair { rgb: &rgb, reference: Reference::Planar(&gt), ..pair };
        let options = options(0.2, SsimPadding::Same, SimdPath::best());
        let psnr = -10.0 * libm::log10(loss.pair_value_and_gradient(&pair, &options, &mut v).mse);
        assert!((psnr - fixture.f64("val_psnr_clamped")[0]).abs() < 1e-4, "{file}: {psnr}");
    }
}

#[test]
fn metrics_match_the_fixture_with_an_8_bit_photo() {
    let Some(fixture) = Fixture::open("loss_u8gt") else { return };
    let (height, width) = (fixture.shape("img")[0] as u32, fixture.shape("img")[1] as u32);
    let bytes: Vec<u8> = fixture.f64("gt").iter().map(|v| (v * 255.0).round() as u8).collect();
    for (byte, value) in bytes.iter().zip(fixture.f32("gt")) {
        assert_eq!(f32::from(*byte) / 255.0, value, "the fixture's photo is 8-bit");
    }
    let target = Target::new([width, height], bytes);
    let image = Image { rgb: fixture.planar("img"), ..Image::new(width, height) };
    let psnr = metrics::psnr(&image, &target);
    assert!((psnr - fixture.f64("val_psnr_clamped")[0]).abs() < 1e-4, "psnr {psnr}");
    let (mut loss, mut v) = (ImageLoss::default(), Vec::new());
    for (padding, name) in [(SsimPadding::Same, "val_loss_same"), (SsimPadding::Valid, "val_loss_valid")] {
        let value = loss.value_and_gradient(&image, &target, &options(0.2, padding, SimdPath::best()), &mut v);
        assert_value(&fixture, name, value.loss, "8-bit");
    }
    // The fixture's SSIM values are of the picture as it is: equal only where nothing was clamped, so clamp by hand.
    let clamped: Vec<f32> = image.rgb.iter().map(|v| v.clamp(0.0, 1.0)).collect();
    let by_hand = Case { width: width as usize, height: height as usize, rgb: clamped, target: target.clone() };
    for variant in SsimVariant::ALL {
        let (got, want) = (metrics::ssim(&image, &target, variant, SimdPath::best()), by_hand.direct_ssim(variant));
        assert!((got - want).abs() < 1e-5, "{variant}: {got}, want {want}");
    }
}

/// A random picture, its photo and a mask with a hole, and what the loss should be by the definition.
#[derive(Clone)]
struct Case {
    width: usize,
    height: usize,
    rgb: Vec<f32>,
    target: Target,
}

impl Case {
    fn new(width: usize, height: usize, masked: bool) -> Case {
        let mut draw = Stream::new(3, Purpose::Test, width as u64, height as u64);
        let n = width * height;
        let bytes: Vec<u8> = (0..3 * n).map(|_| draw.below(256) as u8).collect();
        // Related to the photo, so that SSIM is neither 0 nor 1; some values leave 0..1.
        let rgb = (0..3 * n).map(|i| {
            let photo = f64::from(bytes[3 * (i % n) + i / n]) / 255.0;
            (0.6 * photo + 0.25 + 0.2 * draw.normal()) as f32
        });
        let rgb = rgb.collect();
        let hole = |i: usize| (i % width) * 3 > width && (i % width) * 2 < width + 4 && i / width > height / 2;
        let mask = masked.then(|| (0..n).map(|i| if hole(i) || i % 23 == 0 { 0 } else { 255 }).collect());
        let target = Target { mask, ..Target::new([width as u32, height as u32], bytes) };
        Case { width, height, rgb, target }
    }

    fn image(&self) -> Image {
        Image { rgb: self.rgb.clone(), ..Image::new(self.width as u32, self.height as u32) }
    }

    fn counts(&self, i: usize) -> bool {
        self.target.mask.as_ref().is_none_or(|mask| mask[i] != 0)
    }

    /// (picture after the mask's replacement, photo) at a place that may lie outside.
    fn at(&self, variant: SsimVariant, c: usize, x: isize, y: isize) -> (f64, f64) {
        let place = |i: isize, side: usize| -> Option<usize> {
            let last = side as isize - 1;
            match variant {
                _ if (0..=last).contains(&i) => Some(i as usize),
                SsimVariant::Reflect => Some(if i < 0 { -i } else { 2 * last - i } as usize),
                _ => None,
            }
        };
        let (Some(x), Some(y)) = (place(x, self.width), place(y, self.height)) else { return (0.0, 0.0) };
        let i = y * self.width + x;
        let photo = f64::from(f32::from(self.target.rgb[3 * i + c]) / 255.0);
        let picture = f64::from(self.rgb[c * self.width * self.height + i]);
        (if self.counts(i) { picture } else { photo }, photo)
    }

    fn direct_ssim_at(&self, variant: SsimVariant, c: usize, x: usize, y: usize) -> f64 {
        let (mut sums, mut total) = ([0.0f64; 5], 0.0);
        for dy in -5isize..=5 {
            for dx in -5isize..=5 {
                let w = libm::exp(-((dx * dx + dy * dy) as f64) / 4.5);
                let (a, b) = self.at(variant, c, x as isize + dx, y as isize + dy);
                total += w;
                for (sum, v) in sums.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                    *sum += w * v;
                }
            }
        }
        let [mx, my, xx, yy, xy] = sums.map(|s| s / total);
        let (sx, sy, sxy) = (xx - mx * mx, yy - my * my, xy - mx * my);
        (2.0 * mx * my + 1e-4) * (2.0 * sxy + 9e-4) / ((mx * mx + my * my + 1e-4) * (sx + sy + 9e-4))
    }

    fn direct_ssim(&self, variant: SsimVariant) -> f64 {
        let margin = if variant == SsimVariant::Valid { 5 } else { 0 };
        let (mut sum, mut count) = (0.0, 0.0);
        for y in margin..self.height - margin {
            for x in margin..self.width - margin {
                if self.counts(y * self.width + x) {
                    sum += (0..3).map(|c| self.direct_ssim_at(variant, c, x, y)).sum::<f64>();
                    count += 3.0;
                }
            }
        }
        sum / count
    }

    fn direct_loss(&self, lambda: f64, variant: SsimVariant) -> f64 {
        let n = self.width * self.height;
        let counted: Vec<usize> = (0..n).filter(|&i| self.counts(i)).collect();
        let difference = |i: usize, c: usize| {
            let (a, b) = self.at(variant, c, (i % self.width) as isize, (i / self.width) as isize);
            (a - b).abs()
        };
        let l1 = counted.iter().map(|&i| (0..3).map(|c| difference(i, c)).sum::<f64>()).sum::<f64>();
        (1.0 - lambda) * l1 / (3.0 * counted.len() as f64) + lambda * (1.0 - self.direct_ssim(variant))
    }
}

#[test]
fn odd_sizes_and_masks_match_the_definition() {
    // 11x11 has one valid window; 260 columns are cut into two tiles, 70 rows into two bands.
    for (width, height) in [(17, 29), (11, 11), (40, 12), (12, 70), (260, 11)] {
        for masked in [false, true] {
            let case = Case::new(width, height, masked);
            for padding in [SsimPadding::Same, SsimPadding::Valid] {
                let (mut loss, mut v) = (ImageLoss::default(), Vec::new());
                let options = options(0.3, padding, SimdPath::best());
                let got = loss.value_and_gradient(&case.image(), &case.target, &options, &mut v);
                let context = format!("{width}x{height} masked {masked} {padding:?}");
                let variant = padding.into();
                let want = case.direct_loss(f64::from(0.3f32), variant);
                // Limits as for the fixtures.
                assert!((got.loss - want).abs() < 1e-5, "{context}: {}, want {want}", got.loss);
                let (got, want) = (got.ssim, case.direct_ssim(variant));
                assert!((got - want).abs() < 1e-5, "{context}: {got}, want {want}");
            }
            let reflect = metrics_ssim_unclamped(&case, SsimVariant::Reflect);
            let want = case.direct_ssim(SsimVariant::Reflect);
            assert!((reflect - want).abs() < 1e-5, "{width}x{height} reflect: {reflect}, want {want}");
        }
    }
}

fn metrics_ssim_unclamped(case: &Case, variant: SsimVariant) -> f64 {
    mean_ssim(&ImagePair::new(&case.image(), &case.target), variant, SimdPath::best())
}

#[test]
fn gradients_match_finite_differences_of_the_definition() {
    for (width, height, padding) in [
        (17, 29, SsimPadding::Same),
        (17, 29, SsimPadding::Valid),
        (11, 11, SsimPadding::Valid),
        (40, 12, SsimPadding::Same),
    ] {
        let case = Case::new(width, height, true);
        let n = width * height;
        let mut v = Vec::new();
        let options = options(0.3, padding, SimdPath::best());
        ImageLoss::default().value_and_gradient(&case.image(), &case.target, &options, &mut v);
        let largest = v.iter().fold(0.0f64, |m, &g| m.max(f64::from(g).abs()));
        for i in (0..3 * n).step_by(3 * n / 24) {
            let (place, c) = (i % n, i / n);
            let h = 2.0f32.powi(-10);
            let photo = f32::from(case.target.rgb[3 * place + c]) / 255.0;
            if (case.rgb[i] - photo).abs() < 2.0 * h {
                continue; // the kink of L1
            }
            let mut moved = case.clone();
            moved.rgb[i] = case.rgb[i] + h;
            let (high, above) = (moved.rgb[i], moved.direct_loss(f64::from(0.3f32), padding.into()));
            moved.rgb[i] = case.rgb[i] - h;
            let (low, below) = (moved.rgb[i], moved.direct_loss(f64::from(0.3f32), padding.into()));
            let want = (above - below) / f64::from(high - low);
            let got = f64::from(v[i]);
            // The README's 5e-4 of the largest entry, and as much again for the h^2 term of the central difference.
            assert!((got - want).abs() < 1e-3 * largest, "{width}x{height} {padding:?} [{i}]: {got}, want {want}");
            if !case.counts(place) {
                assert_eq!(got, 0.0, "masked pixels have no gradient");
            }
        }
    }
}

/// Everything a call returns, as bits.
fn bits(case: &Case, path: SimdPath) -> (Vec<u32>, [u64; 4], u64) {
    let mut v = Vec::new();
    let options = options(0.2, SsimPadding::Valid, path);
    let LossValue { loss, l1, ssim, mse } =
        ImageLoss::default().value_and_gradient(&case.image(), &case.target, &options, &mut v);
    let reflect = mean_ssim(&ImagePair::new(&case.image(), &case.target), SsimVariant::Reflect, path);
    let v = v.iter().map(|g| g.to_bits()).collect();
    (v, [loss, l1, ssim, mse].map(f64::to_bits), reflect.to_bits())
}

#[test]
fn the_bits_do_not_depend_on_threads() {
    let case = Case::new(300, 201, true);
    for path in paths() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| bits(&case, path))
        };
        let one = run(1);
        assert_eq!(one, run(2));
        assert_eq!(one, run(16));
    }
}

#[test]
fn avx2_and_avx512_give_the_same_bits() {
    if !(SimdPath::Avx512.is_supported() && SimdPath::Avx2.is_supported()) {
        println!("SKIPPED: this machine lacks AVX-512 or AVX2");
        return;
    }
    let case = Case::new(270, 90, true);
    assert_eq!(bits(&case, SimdPath::Avx512), bits(&case, SimdPath::Avx2));
}

#[test]
fn a_wholly_masked_picture_has_no_loss() {
    let mut case = Case::new(20, 15, false);
    case.target.mask = Some(vec![0; 300]);
    let mut v = vec![7.0; 5];
    let options = options(0.2, SsimPadding::Valid, SimdPath::best());
    let value = ImageLoss::default().value_and_gradient(&case.image(), &case.target, &options, &mut v);
    assert_eq!(value, LossValue { loss: 0.0, l1: 0.0, ssim: 1.0, mse: 0.0 });
    assert_eq!(v, vec![0.0; 900]);
}

#[test]
fn a_border_alone_leaves_l1() {
    let mut case = Case::new(20, 15, false);
    let border = |i: usize| i / 20 < 2;
    case.target.mask = Some((0..300).map(|i| u8::from(border(i))).collect());
    let mut v = Vec::new();
    let options = options(0.2, SsimPadding::Valid, SimdPath::best());
    let value = ImageLoss::default().value_and_gradient(&case.image(), &case.target, &options, &mut v);
    assert_eq!(value.ssim, 1.0);
    // 0.8 in f64 from an f32 lambda.
    assert!((value.loss - 0.8 * value.l1).abs() < 1e-7 && value.l1 > 0.0);
    for (i, g) in v.iter().enumerate() {
        let difference = g.abs() - if border(i % 300) { 0.8 / 120.0 } else { 0.0 };
        assert!(difference.abs() < 1e-8, "one f32 rounding of 0.8 / 120");
    }
}

#[test]
fn broken_pictures_give_a_broken_loss_and_masked_ones_do_not() {
    let clean = Case::new(33, 21, true);
    let masked = (0..33 * 21).find(|&i| !clean.counts(i)).unwrap();
    let counted = (0..33 * 21).find(|&i| clean.counts(i)).unwrap();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for padding in [SsimPadding::Same, SsimPadding::Valid] {
            let options = options(0.2, padding, SimdPath::best());
            let run = |place: usize| {
                let mut case = clean.clone();
                case.rgb[place] = bad;
                let mut v = Vec::new();
                let value = ImageLoss::default().value_and_gradient(&case.image(), &case.target, &options, &mut v);
                (value.loss.is_finite(), v.iter().all(|g| g.is_finite()))
            };
            assert_eq!(run(masked), (true, true));
            assert!(!run(counted).0, "{bad} {padding:?}");
        }
    }
}

#[test]
fn small_and_empty_pictures_have_a_loss() {
    for (width, height) in [(1, 1), (3, 40), (10, 10), (0, 4), (4, 0)] {
        let mut case = Case::new(width.max(1), height.max(1), false);
        (case.width, case.height) = (width, height);
        case.rgb.truncate(3 * width * height);
        case.target.rgb.truncate(3 * width * height);
        (case.target.width, case.target.height) = (width as u32, height as u32);
        let run = |padding| {
            let mut v = Vec::new();
            let options = options(0.2, padding, SimdPath::best());
            let value = ImageLoss::default().value_and_gradient(&case.image(), &case.target, &options, &mut v);
            (value, v)
        };
        let (same, valid) = (run(SsimPadding::Same), run(SsimPadding::Valid));
        assert_eq!(same, valid, "no valid window: the loss falls back to every pixel");
        assert_eq!(same.1.len(), 3 * width * height);
        if width * height > 0 {
            let want = case.direct_loss(f64::from(0.2f32), SsimVariant::Same);
            assert!((same.0.loss - want).abs() < 1e-5, "{width}x{height}: {}, want {want}", same.0.loss);
        }
    }
}
