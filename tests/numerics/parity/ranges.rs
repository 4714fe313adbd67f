//! Views that device memory cannot hold at once: rows in chunks, pictures in ranges of tiles. The results have the bits of the
//! view that fits, for any budget and any binding, down to the least that is stated.

use super::frame::{bits, in_batches, photo, renderer, results_with, scene};
use gsscale::gpu::{GpuError, GpuOptions};
use gsscale::render::device_needs::DeviceNeeds;
use gsscale::render::gpu::GpuRenderer;
use gsscale::render::{LossOptions, RenderError, RenderOptions, Renderer, RowBatches, SsimPadding};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;

/// A view whose Gaussians cross many tile columns.
pub fn wide_scene(rows: usize) -> (Columns, Camera) {
    let (mut columns, camera) = scene(rows, 208, 144);
    columns.scales.iter_mut().for_each(|s| *s *= 0.3);
    columns.opacities.iter_mut().for_each(|o| *o -= 3.0);
    (columns, camera)
}

/// The least memory that the renderer states for a view.
pub fn least(gpu: &GpuRenderer) -> u64 {
    DeviceNeeds::new(gpu.device_sizes().unwrap(), RenderOptions::default().sh_degree).least()
}

#[test]
fn budgets_down_to_the_least_change_no_bit() {
    for (rows, masked, padding) in [(6000, true, SsimPadding::Valid), (3000, false, SsimPadding::Same)] {
        let (view, target) = (wide_scene(rows), photo(208, 144, masked));
        let loss = LossOptions { padding, ..LossOptions::default() };
        let options = RenderOptions { background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
        let Some(mut whole) = renderer(&GpuOptions::default()) else { return };
        let want = bits(&results_with(&mut whole, &view, &options, &target, &loss).unwrap());
        assert_eq!(whole.ranges(), 1);
        let plenty = whole.gpu().traffic().device_bytes_peak;
        let sizes = whole.device_sizes().unwrap();
        assert_eq!((sizes.rows, sizes.pixels, sizes.isects), (rows as u64, 208 * 144, u64::from(whole.isects())));
        let needs = DeviceNeeds::new(sizes, options.sh_degree);
        let least = needs.least();
        // The pool keeps the buffers of a first frame that was too small, a tenth; stages share buffers.
        let whole = needs.whole();
        assert!(whole + whole / 10 >= plenty && whole <= 2 * plenty, "{whole} stated, {plenty} taken");
        println!("{rows} rows: {plenty} bytes in one piece, the least is {least}");
        assert!(least < plenty);
        let mut most_ranges = 0;
        for share in [0, 1, 3, 6] {
            let budget = least + (plenty - least) * share / 8;
            let Some(mut gpu) = renderer(&GpuOptions { budget: Some(budget), ..GpuOptions::default() }) else { return };
            // Twice: the second view meets what the first one learned.
            for _ in 0..2 {
                let got = results_with(&mut gpu, &view, &options, &target, &loss);
                let got = got.unwrap_or_else(|error| panic!("{budget} bytes: {error}"));
                assert!(bits(&got) == want, "{budget} bytes");
            }
            let traffic = gpu.gpu().traffic();
            println!("{budget} bytes: {} ranges, peak {}", gpu.ranges(), traffic.device_bytes_peak);
            assert!(traffic.device_bytes_peak <= budget);
            most_ranges = most_ranges.max(gpu.ranges());
        }
        assert!(most_ranges >= 8, "{most_ranges} ranges at most");
    }
}

/// The budget holds for everything that the API allocates. A view of four times the memory; some 20 s on a software adapter.
#[test]
fn a_budget_covers_what_the_driver_allocates() {
    let budget = 128 << 20;
    let Some(mut gpu) = renderer(&GpuOptions { budget: Some(budget), ..GpuOptions::default() }) else { return };
    let (mut view, target) = (scene(85_000, 640, 480), photo(640, 480, false));
    (view.1.fx, view.1.fy) = (300.0, 300.0);
    view.0.scales.iter_mut().for_each(|s| *s = 0.1 * *s - 1.7);
    let (options, loss) = (RenderOptions::default(), LossOptions::default());
    for _ in 0..2 {
        results_with(&mut gpu, &view, &options, &target, &loss).unwrap();
        let traffic = gpu.gpu().traffic();
        let Some([allocated, reserved]) = gpu.gpu().allocator_bytes() else { return };
        println!(
            "{} ranges, peak {}: {allocated} allocated, {reserved} reserved",
            gpu.ranges(),
            traffic.device_bytes_peak
        );
        assert!(gpu.ranges() >= 4 && traffic.device_bytes_peak <= budget);
        // Beside the buffers the API holds its own small ones, for example for its checks.
        assert!(allocated <= traffic.device_bytes_peak + (1 << 20), "{allocated} of {}", traffic.device_bytes_peak);
        assert!(reserved <= budget, "{reserved} of {budget}");
    }
}

#[test]
fn bindings_smaller_than_the_splats_change_no_bit() {
    let rows = 12_000;
    let (view, target) = (wide_scene(rows), photo(208, 144, true));
    let (options, loss) = (RenderOptions::default(), LossOptions::default());
    let Some(mut whole) = renderer(&GpuOptions::default()) else { return };
    let want = bits(&results_with(&mut whole, &view, &options, &target, &loss).unwrap());
    // The picture alone needs 12 bytes a pixel.
    let pixels = 12 * 208 * 144;
    for limit in [pixels, pixels + 40_000] {
        let limits = GpuOptions { max_binding_bytes: Some(limit), ..GpuOptions::default() };
        let Some(mut cut) = renderer(&limits) else { return };
        let got = results_with(&mut cut, &view, &options, &target, &loss).unwrap();
        println!("bindings of {limit} bytes: {} ranges", cut.ranges());
        assert!(bits(&got) == want && cut.ranges() > 1, "bindings of {limit} bytes");
    }
}

/// All splats reach the one tile of the picture, and some have the same depth: its list is cut front to back.
#[test]
fn the_list_of_one_tile_is_cut_front_to_back() {
    let rows = 5000;
    let (mut view, target) = (scene(rows, 16, 16), photo(16, 16, true));
    (view.1.fx, view.1.fy) = (4.0, 4.0);
    view.0.opacities.iter_mut().for_each(|o| *o -= 4.0);
    for row in 0..rows / 5 {
        let same: [f32; 3] = std::array::from_fn(|i| view.0.means[i]);
        view.0.means[3 * row..3 * row + 3].copy_from_slice(&same);
    }
    let (options, loss) = (RenderOptions::default(), LossOptions::default());
    let Some(mut whole) = renderer(&GpuOptions::default()) else { return };
    let want = bits(&results_with(&mut whole, &view, &options, &target, &loss).unwrap());
    let sizes = whole.device_sizes().unwrap();
    assert!(sizes.isects > 2000, "{sizes:?}");
    let least = least(&whole);
    let mut most = 0;
    for budget in [least + (128 << 10), least] {
        let Some(mut gpu) = renderer(&GpuOptions { budget: Some(budget), ..GpuOptions::default() }) else { return };
        let got = results_with(&mut gpu, &view, &options, &target, &loss).unwrap();
        assert!(bits(&got) == want, "{budget} bytes");
        let batches = (&[0, 2222, rows][..], RowBatches::Several);
        let got = in_batches(&mut gpu, &view, &options, batches, &target, &loss);
        assert!(bits(&got) == want, "{budget} bytes, in batches");
        println!("{budget} bytes: {} parts", gpu.ranges());
        most = most.max(gpu.ranges());
    }
    // A range of tiles cannot be smaller than the one tile.
    assert!(most > 1, "{most} parts");
}

#[test]
fn batches_in_little_memory_change_no_bit() {
    let rows = 3000;
    let (view, target) = (wide_scene(rows), photo(208, 144, true));
    let (options, loss) = (RenderOptions::default(), LossOptions::default());
    let Some(mut whole) = renderer(&GpuOptions::default()) else { return };
    let want = bits(&results_with(&mut whole, &view, &options, &target, &loss).unwrap());
    let budget = Some(least(&whole));
    let Some(mut gpu) = renderer(&GpuOptions { budget, ..GpuOptions::default() }) else { return };
    for ends in [&[0, 3000][..], &[0, 1501, 3000], &[0, 1, 1, 777, 3000]] {
        let got = in_batches(&mut gpu, &view, &options, (ends, RowBatches::Several), &target, &loss);
        assert!(bits(&got) == want, "batches end at {ends:?}");
        assert!(gpu.ranges() > 1);
    }
}

#[test]
fn below_the_least_the_error_names_need_budget_and_remedy_and_smaller_views_still_work() {
    let Some(mut gpu) = renderer(&GpuOptions { budget: Some(400 << 10), ..GpuOptions::default() }) else { return };
    let (rows, camera) = scene(4000, 160, 112);
    let error = gpu.draw(&rows, &camera, &RenderOptions::default()).unwrap_err();
    assert!(error.to_string().contains("--device-mem"), "{error}");
    let RenderError::Device(GpuError::OutOfBudget { need, in_use, budget, .. }) = error else { panic!("{error}") };
    assert!(need + in_use > budget);
    let error = gpu.image().unwrap_err();
    assert!(matches!(error, RenderError::OutOfOrder { .. }), "no picture after an error: {error}");
    let (view, target, loss) = (scene(60, 64, 48), photo(64, 48, false), LossOptions::default());
    let options = RenderOptions::default();
    let got = bits(&results_with(&mut gpu, &view, &options, &target, &loss).unwrap());
    let Some(mut whole) = renderer(&GpuOptions::default()) else { return };
    assert!(got == bits(&results_with(&mut whole, &view, &options, &target, &loss).unwrap()));
}
