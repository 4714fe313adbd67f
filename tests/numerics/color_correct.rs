//! Colour-corrected PSNR against least squares in f64 by a second method, and its edge cases.

use gsscale::render::color_correct::{ColorCorrect, color_corrected_psnr, exposure_fitted_psnr};
use gsscale::render::metrics::psnr;
use gsscale::scene::image::{Image, Target};

const W: u32 = 23;
const H: u32 = 17;

/// Pseudo-random numbers in 0..1: a multiplicative hash of the index.
fn noise(i: usize, key: u64) -> f64 {
    let x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15 ^ key.wrapping_mul(0xd134_2543_de82_ef95));
    ((x ^ (x >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 11) as f64 / (1u64 << 53) as f64
}

/// A photo, and a render of it through another exposure, tint and some error.
fn pair() -> (Image, Target) {
    let n = (W * H) as usize;
    let rgb: Vec<u8> = (0..3 * n).map(|i| (noise(i, 1) * 255.0) as u8).collect();
    let mut image = Image::new(W, H);
    for i in 0..n {
        for c in 0..3 {
            let x = f64::from(rgb[3 * i + c]) / 255.0;
            let tinted = 0.62 * x + 0.1 * (c as f64 + 1.0) + 0.12 * x * x;
            image.rgb[c * n + i] = (tinted + 0.1 * (noise(3 * i + c, 2) - 0.5)) as f32;
        }
    }
    (image, Target::new([W, H], rgb))
}

/// Render (cut to 0..1) and photo of pixels that count.
fn pixels(image: &Image, target: &Target) -> Vec<([f64; 3], [f64; 3])> {
    let n = image.pixels();
    let counts = |i: &usize| target.mask.as_ref().is_none_or(|m| m[*i] != 0);
    let pixel = |i: usize| {
        let render = std::array::from_fn(|c| f64::from(image.rgb[c * n + i].clamp(0.0, 1.0)));
        (render, std::array::from_fn(|c| f64::from(target.rgb[3 * i + c]) / 255.0))
    };
    (0..n).filter(counts).map(pixel).collect()
}

/// Weights w of least |A w - b| by Householder reflections on A itself (no normal equations).
fn least_squares(mut a: Vec<Vec<f64>>, mut b: Vec<f64>) -> Vec<f64> {
    let (m, n) = (a.len(), a[0].len());
    for k in 0..n {
        let norm = (k..m).map(|i| a[i][k] * a[i][k]).sum::<f64>().sqrt();
        let alpha = if a[k][k] > 0.0 { -norm } else { norm };
        let mut v: Vec<f64> = (k..m).map(|i| a[i][k]).collect();
        v[0] -= alpha;
        let vv: f64 = v.iter().map(|x| x * x).sum();
        for j in k..n {
            let s = 2.0 * (k..m).map(|i| v[i - k] * a[i][j]).sum::<f64>() / vv;
            (k..m).for_each(|i| a[i][j] -= s * v[i - k]);
        }
        let s = 2.0 * (k..m).map(|i| v[i - k] * b[i]).sum::<f64>() / vv;
        (k..m).for_each(|i| b[i] -= s * v[i - k]);
    }
    let mut w = vec![0.0; n];
    for i in (0..n).rev() {
        w[i] = (b[i] - (i + 1..n).map(|j| a[i][j] * w[j]).sum::<f64>()) / a[i][i];
    }
    w
}

fn psnr_of(fitted: &[[f64; 3]], pixels: &[([f64; 3], [f64; 3])]) -> f64 {
    let squares: f64 =
        fitted.iter().zip(pixels).map(|(f, (_, p))| (0..3).map(|c| (f[c] - p[c]).powi(2)).sum::<f64>()).sum();
    -10.0 * (squares / (3 * pixels.len()) as f64).log10()
}

fn affine64(pixels: &[([f64; 3], [f64; 3])]) -> f64 {
    let fits: Vec<Vec<f64>> = (0..3)
        .map(|c| {
            let a = pixels.iter().map(|(_, photo)| vec![photo[c], 1.0]).collect();
            least_squares(a, pixels.iter().map(|(render, _)| render[c]).collect())
        })
        .collect();
    let fit = |(render, _): &([f64; 3], [f64; 3])| {
        std::array::from_fn(|c| ((render[c] - fits[c][1]) / fits[c][0]).clamp(0.0, 1.0))
    };
    psnr_of(&pixels.iter().map(fit).collect::<Vec<_>>(), pixels)
}

fn forward64(pixels: &[([f64; 3], [f64; 3])]) -> f64 {
    let fit = |c: usize| {
        let a = pixels.iter().map(|(render, _)| vec![render[c], 1.0]).collect();
        least_squares(a, pixels.iter().map(|(_, photo)| photo[c]).collect())
    };
    let fits = [fit(0), fit(1), fit(2)];
    let fitted = |(render, _): &([f64; 3], [f64; 3])| -> [f64; 3] {
        std::array::from_fn(|c| (fits[c][0] * render[c] + fits[c][1]).clamp(0.0, 1.0))
    };
    psnr_of(&pixels.iter().map(fitted).collect::<Vec<_>>(), pixels)
}

fn terms(x: &[f64; 3]) -> Vec<f64> {
    let [r, g, b] = *x;
    vec![r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, 1.0]
}

fn quadratic64(pixels: &[([f64; 3], [f64; 3])]) -> f64 {
    let clear = |x: f64| (0.5 / 255.0..=1.0 - 0.5 / 255.0).contains(&x);
    let mut now: Vec<[f64; 3]> = pixels.iter().map(|p| p.0).collect();
    for _ in 0..5 {
        let fits: Vec<Vec<f64>> = (0..3)
            .map(|c| {
                let used: Vec<usize> = (0..now.len())
                    .filter(|&i| clear(pixels[i].0[c]) && clear(now[i][c]) && clear(pixels[i].1[c]))
                    .collect();
                let a = used.iter().map(|&i| terms(&now[i])).collect();
                least_squares(a, used.iter().map(|&i| pixels[i].1[c]).collect())
            })
            .collect();
        let fit = |x: &[f64; 3]| -> [f64; 3] {
            let t = terms(x);
            std::array::from_fn(|c| t.iter().zip(&fits[c]).map(|(a, b)| a * b).sum::<f64>().clamp(0.0, 1.0))
        };
        now = now.iter().map(fit).collect();
    }
    psnr_of(&now, pixels)
}

#[test]
fn both_fits_are_least_squares() {
    let (image, mut target) = pair();
    let mut mask = vec![255u8; (W * H) as usize];
    mask[5..40].fill(0);
    for mask in [None, Some(mask)] {
        target.mask = mask;
        let pixels = pixels(&image, &target);
        // f64 both; the normal equations square a condition number of some 1e3: 1e-8 dB is far above that.
        let affine = color_corrected_psnr(&image, &target, ColorCorrect::Affine);
        assert!((affine - affine64(&pixels)).abs() < 1e-8, "{affine} {}", affine64(&pixels));
        let quadratic = color_corrected_psnr(&image, &target, ColorCorrect::Quadratic);
        assert!((quadratic - quadratic64(&pixels)).abs() < 1e-8, "{quadratic} {}", quadratic64(&pixels));
        let plain = psnr(&image, &target);
        assert!(affine > plain + 3.0 && quadratic > affine, "{plain} {affine} {quadratic}");
        let forward = exposure_fitted_psnr(&image, &target);
        assert!(
            (forward - forward64(&pixels)).abs() < 1e-8 && forward > plain + 3.0,
            "{forward} {}",
            forward64(&pixels)
        );
    }
}

#[test]
fn another_exposure_of_the_photo_is_no_error() {
    let (mut image, target) = pair();
    let n = image.pixels();
    for i in 0..n {
        for c in 0..3 {
            image.rgb[c * n + i] = 0.7 * f32::from(target.rgb[3 * i + c]) / 255.0 + 0.05 * (c as f32 + 1.0);
        }
    }
    assert!(psnr(&image, &target) < 20.0);
    // f32 renders: 6e-8 over the slope, 140 dB. The quadratic leaves saturated pixels out and has a few more roundings.
    assert!(color_corrected_psnr(&image, &target, ColorCorrect::Affine) > 130.0);
    assert!(color_corrected_psnr(&image, &target, ColorCorrect::Quadratic) > 120.0);
    assert!(exposure_fitted_psnr(&image, &target) > 120.0);
}

/// The fit that the field reports magnifies the errors of a render with little of its photo in it; the one that judges growth does not.
#[test]
fn a_render_that_hardly_resembles_its_photo_is_not_judged_worse_than_it_is() {
    let (mut image, target) = pair();
    let n = image.rgb.len() as u32;
    image
        .rgb
        .iter_mut()
        .zip(0u32..)
        .for_each(|(x, i)| *x = 0.1 * *x + 0.4 + 0.3 * ((i * 7919 % n) as f32 / n as f32 - 0.5));
    let plain = psnr(&image, &target);
    assert!(color_corrected_psnr(&image, &target, ColorCorrect::Affine) < plain - 1.0);
    assert!(exposure_fitted_psnr(&image, &target) >= plain);
}

#[test]
fn edges_have_an_answer() {
    let (image, mut target) = pair();
    let n = image.pixels();
    for how in [ColorCorrect::Affine, ColorCorrect::Quadratic] {
        // A flat photo and a flat render: there is nothing to fit, and the result is a number.
        let flat = Target::new([W, H], vec![128; 3 * n]);
        assert!(color_corrected_psnr(&image, &flat, how).is_finite());
        assert!(color_corrected_psnr(&Image::new(W, H), &target, how).is_finite());
        // A gray picture, whose terms are linearly dependent.
        let mut gray = image.clone();
        let red = gray.rgb[..n].to_vec();
        gray.rgb[n..2 * n].copy_from_slice(&red);
        gray.rgb[2 * n..].copy_from_slice(&red);
        let psnr = color_corrected_psnr(&gray, &target, how);
        assert!(psnr.is_finite() && psnr > 4.0, "{psnr}");
        let mut broken = image.clone();
        broken.rgb[7] = f32::NAN;
        assert!(color_corrected_psnr(&broken, &target, how).is_nan());
        target.mask = Some(vec![0; n]);
        assert!(color_corrected_psnr(&image, &target, how).is_nan(), "no pixel counts");
        target.mask = None;
    }
}

#[test]
fn threads_do_not_matter() {
    let (image, target) = pair();
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let of = |how| pool.install(|| color_corrected_psnr(&image, &target, how).to_bits());
        [of(ColorCorrect::Affine), of(ColorCorrect::Quadratic)]
    };
    assert_eq!(with(1), with(3));
}
