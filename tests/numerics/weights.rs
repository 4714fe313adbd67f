//! Blending weights of rows, alone and times the squared error of the picture, against the second renderer in f64.

use crate::gradients::{FAINT, OPAQUE, Recipe, camera};
use crate::support::paths;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{Gradients, LossOptions, RenderOptions, Renderer, SsimPadding};
use gsscale::scene::image::Target;

/// Relative L2 error over the rows, and of the worst row relative to itself plus a thousandth of the root mean square:
/// sums of some hundred products in f32, each 1e-7 off; transmittances are found back by up to 20 divisions.
const ROWS_L2: f64 = 2e-5;
const ROW_MAX: f64 = 1e-3;

fn photo(is_masked: bool) -> Target {
    let (camera, mut draws) = (camera(), Stream::new(41, Purpose::Test, 0, 0));
    let rgb = (0..3 * camera.pixels()).map(|_| draws.below(256) as u8).collect();
    let mask = is_masked.then(|| (0..camera.pixels()).map(|_| if draws.below(3) == 0 { 0 } else { 255 }).collect());
    Target { mask, ..Target::new([camera.width, camera.height], rgb) }
}

fn compare(what: &str, got: &[f64], want: &[f64]) {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
    let total = norm(&mut want.iter().copied());
    assert!(total > 1e-2, "{what}: nothing to compare");
    let l2 = norm(&mut got.iter().zip(want).map(|(g, w)| g - w)) / total;
    let rms = total / (want.len() as f64).sqrt();
    let worst = got.iter().zip(want).map(|(g, w)| (g - w).abs() / (w + 1e-3 * rms)).fold(0.0, f64::max);
    println!("{what}: L2 {l2:.1e}, worst row {worst:.1e}");
    assert!(l2 < ROWS_L2 && worst < ROW_MAX, "{what}: {l2:e}, {worst:e}");
}

fn check(recipe: &Recipe, target: &Target, simd: SimdPath) {
    let (rows, picture) = recipe.scene();
    let (camera, options) = (camera(), RenderOptions { simd, ..recipe.options() });
    let mut renderer = CpuRenderer::new();
    renderer.weigh_rows(true).unwrap();
    renderer.draw(&rows, &camera, &options).unwrap();
    let loss = LossOptions { ssim_lambda: 0.2, padding: SsimPadding::Valid, simd };
    renderer.loss(target, &loss).unwrap();
    let mut grads = Gradients::default();
    renderer.backpropagate(&rows, &mut grads).unwrap();
    let mut want = vec![[0.0; 2]; rows.rows()];
    for &(row, pixel, weight) in &picture.weights {
        let is_used = target.mask.as_ref().is_none_or(|mask| mask[pixel] > 0);
        let photo = |c: usize| f64::from(target.rgb[3 * pixel + c]) / 255.0;
        let error = (0..3).map(|c| (picture.rgb[pixel][c] - photo(c)).powi(2)).sum::<f64>() / 3.0;
        want[row][0] += weight;
        want[row][1] += if is_used { weight * error } else { 0.0 };
    }
    for (i, what) in ["weights", "weights times errors"].into_iter().enumerate() {
        let got: Vec<f64> = grads.weights.iter().map(|w| f64::from(w[i])).collect();
        compare(what, &got, &want.iter().map(|w| w[i]).collect::<Vec<_>>());
    }
}

#[test]
fn weights_of_rows_are_those_of_a_plain_renderer() {
    for simd in paths() {
        for is_masked in [false, true] {
            let target = photo(is_masked);
            check(&FAINT, &target, simd);
            check(&OPAQUE, &target, simd);
        }
    }
}

#[test]
fn weighing_changes_no_bit_of_the_gradients_and_is_off_unless_asked_for() {
    let (rows, _) = OPAQUE.scene();
    let (camera, options, target) = (camera(), OPAQUE.options(), photo(false));
    let loss = LossOptions { ssim_lambda: 0.2, padding: SsimPadding::Valid, simd: options.simd };
    let mut renderer = CpuRenderer::new();
    let mut run = |is_wanted: bool| {
        renderer.weigh_rows(is_wanted).unwrap();
        renderer.draw(&rows, &camera, &options).unwrap();
        renderer.loss(&target, &loss).unwrap();
        let mut grads = Gradients::default();
        renderer.backpropagate(&rows, &mut grads).unwrap();
        grads
    };
    let (without, with, again) = (run(false), run(true), run(false));
    assert!(without.columns == with.columns && without.means2d == with.means2d && again.columns == with.columns);
    assert!(without.weights.is_empty() && again.weights.is_empty());
    assert_eq!(with.weights.len(), rows.rows());
}
