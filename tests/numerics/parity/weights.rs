//! Blending weights of rows on a device, alone and times the squared error of the picture, against those of the CPU.

use super::frame::{bits, in_batches, photo, renderer, results_with, scene};
use super::ranges::{least, wide_scene};
use gsscale::base::math::LARGEST_SPLAT_GRAD;
use gsscale::gpu::GpuOptions;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{Gradients, LossOptions, RenderOptions, Renderer, RowBatches};

/// Relative L2 distance over the rows: sums of some hundred products of f32, as for the gradients (see `frame`), whose terms do
/// not cancel; a flipped decision moves one pixel of one row.
const ROWS_L2: f64 = 2e-5;

fn compare(what: &str, got: &[[f32; 2]], want: &[[f32; 2]]) {
    assert_eq!(got.len(), want.len(), "{what}");
    for (i, name) in ["weights", "weights times errors"].into_iter().enumerate() {
        let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
        let total = norm(&mut want.iter().map(|w| f64::from(w[i])));
        let l2 = norm(&mut got.iter().zip(want).map(|(g, w)| f64::from(g[i]) - f64::from(w[i]))) / total;
        println!("{what}: {name} {l2:.1e}");
        assert!(total > 0.1 && l2 < ROWS_L2, "{what}: {name} {l2:e} of {total}");
    }
    let drawn = |weights: &[[f32; 2]]| weights.iter().filter(|w| w[0] > 0.0).count();
    assert!(drawn(got) > 0 && drawn(got) < got.len(), "{what}: all rows or none are drawn");
}

#[test]
fn weights_are_those_of_the_cpu_and_cost_nothing_when_off() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (mut cpu, loss) = (CpuRenderer::new(), LossOptions::default());
    cpu.weigh_rows(true).unwrap();
    for (rows, width, height, sh_degree, masked) in
        [(2000, 160, 112, 3, false), (5000, 123, 77, 1, true), (900, 40, 9, 0, false), (900, 40, 9, 0, true)]
    {
        let view = scene(rows, width, height);
        let options = RenderOptions { sh_degree, background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
        let (target, what) = (photo(width, height, masked), format!("{rows} rows, masked {masked}"));
        let mut run = |weighs: bool| {
            gpu.weigh_rows(weighs).unwrap();
            results_with(&mut gpu, &view, &options, &target, &loss).unwrap()
        };
        let (without, with, again, off) = (run(false), run(true), run(true), run(false));
        let want = results_with(&mut cpu, &view, &options, &target, &loss).unwrap();
        compare(&what, &with.grads.weights, &want.grads.weights);
        assert!(with.grads.weights == again.grads.weights, "{what}: another run gives other bits");
        assert!(without.grads.weights.is_empty() && off.grads.weights.is_empty());
        assert!(bits(&with) == bits(&without) && bits(&off) == bits(&without), "{what}: weighing changes a gradient");
    }
}

/// Ranges of tiles, parts of one tile's list, batches, and a frame that is recorded again: the bits of a view in one piece.
#[test]
fn weights_have_the_same_bits_for_any_cut() {
    let rows = 3000;
    let view = wide_scene(rows);
    let (target, loss) = (photo(208, 144, true), LossOptions::default());
    let options = RenderOptions::default();
    let Some(mut whole) = renderer(&GpuOptions::default()) else { return };
    whole.weigh_rows(true).unwrap();
    let want = results_with(&mut whole, &view, &options, &target, &loss).unwrap().grads.weights;
    whole.set_capacity(100);
    assert!(results_with(&mut whole, &view, &options, &target, &loss).unwrap().grads.weights == want);
    assert!(whole.frames_rerecorded() > 0);
    let batches = (&[0, 1100, rows][..], RowBatches::Several);
    assert!(in_batches(&mut whole, &view, &options, batches, &target, &loss).grads.weights == want);
    let least = least(&whole);
    let mut most = 0;
    for budget in [least, least + least / 4] {
        let Some(mut gpu) = renderer(&GpuOptions { budget: Some(budget), ..GpuOptions::default() }) else { return };
        gpu.weigh_rows(true).unwrap();
        let got = results_with(&mut gpu, &view, &options, &target, &loss).unwrap();
        assert!(got.grads.weights == want, "{budget} bytes, {} ranges", gpu.ranges());
        assert!(gpu.gpu().traffic().device_bytes_peak <= budget);
        most = most.max(gpu.ranges());
    }
    assert!(most > 2, "{most} ranges at most");
}

/// The errors are those of a corrected picture; without a loss there are none.
#[test]
fn errors_are_those_of_what_was_compared() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (view, target, options) = (scene(2000, 80, 60), photo(80, 60, false), RenderOptions::default());
    let weights = |renderer: &mut dyn Renderer, is_compared: bool| {
        renderer.weigh_rows(true).unwrap();
        renderer.draw(&view.0, &view.1, &options).unwrap();
        if is_compared {
            renderer.picture_mut().unwrap().iter_mut().for_each(|x| *x = 0.5 * *x + 0.1);
            renderer.loss(&target, &LossOptions::default()).unwrap();
        }
        renderer.picture_gradient().unwrap();
        let mut grads = Gradients::default();
        renderer.backpropagate(&view.0, &mut grads).unwrap();
        grads.weights
    };
    compare("corrected", &weights(&mut gpu, true), &weights(&mut CpuRenderer::new(), true));
    let alone = weights(&mut gpu, false);
    assert!(alone.iter().any(|w| w[0] > 0.0) && alone.iter().all(|w| w[1] == 0.0));
}

/// Weights are no gradients: those of a bright picture make no row unusable.
#[test]
fn weights_of_a_bright_picture_make_no_row_unusable() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (rows, camera) = scene(2000, 80, 60);
    let options = RenderOptions { background: [1e7; 3], ..RenderOptions::default() };
    for renderer in [&mut CpuRenderer::new() as &mut dyn Renderer, &mut gpu] {
        renderer.weigh_rows(true).unwrap();
        renderer.draw(&rows, &camera, &options).unwrap();
        renderer.loss(&photo(80, 60, false), &LossOptions::default()).unwrap();
        let mut grads = Gradients::default();
        renderer.backpropagate(&rows, &mut grads).unwrap();
        let most = grads.weights.iter().fold(0.0f32, |most, weights| most.max(weights[1]));
        assert!(most > LARGEST_SPLAT_GRAD, "{}: no weight is larger than a gradient may be: {most:e}", renderer.name());
        assert_eq!(renderer.unusable_splats().unwrap(), 0, "{}", renderer.name());
    }
}
