//! Whole views: the GPU renderer against the CPU renderer and against the float64 reference.
//!
//! Source of the tolerances: a stage differs between the backends by some roundings of 6e-8 (see the other files here);
//! a pixel adds up to a few hundred of them. Rarely, a rounding flips a decision (one tile more, a stop one Gaussian
//! later). Such a pixel may differ by the threshold of that decision, at most 1/255 of a colour.

use crate::support::fixture::{Fixture, RASTER_FILES, split_sh};
use crate::support::gpu::open;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::gpu::{FaultKind, GpuError, GpuOptions, InjectedFault};
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::gpu::GpuRenderer;
use gsscale::render::{
    Gradients, LossOptions, LossValue, PictureGradient, RenderError, RenderOptions, Renderer, RowBatches,
};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::image::{Image, Target};

pub fn renderer(options: &GpuOptions) -> Option<GpuRenderer> {
    open(options).map(|gpu| GpuRenderer::new(gpu).unwrap())
}

/// `rows` Gaussians in front of a camera; some are large, opaque, behind it, off the picture or not finite.
pub fn scene(rows: usize, width: u32, height: u32) -> (Columns, Camera) {
    let mut draws = Stream::new(41, Purpose::Test, rows as u64, u64::from(width));
    let mut c = Columns::zeros(rows, 3);
    c.means.fill_with(|| draws.range(-2.0, 2.0) as f32);
    c.quats.fill_with(|| draws.normal() as f32);
    c.scales.fill_with(|| draws.range(-5.0, -1.0) as f32);
    c.opacities.fill_with(|| draws.range(-6.0, 7.0) as f32);
    c.sh0.iter_mut().chain(&mut c.sh_n).for_each(|x| *x = 0.5 * draws.normal() as f32);
    let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 1.5]];
    (c, Camera::pinhole(viewmat, [60.0, 65.0, 0.5 * width as f32, 0.5 * height as f32], [width, height]))
}

/// The rows of a table in batches that end at `ends`, the first of which is where they begin.
fn batches_of(rows: &Columns, ends: &[usize]) -> Vec<Columns> {
    let batch = |ends: &[usize]| {
        let mut batch = Columns { sh_degree: rows.sh_degree, ..Columns::default() };
        for column in Column::ALL {
            let width = column.width(rows.sh_degree);
            *batch.column_mut(column) = rows.column(column)[ends[0] * width..ends[1] * width].to_vec();
        }
        batch
    };
    ends.windows(2).map(batch).collect()
}

/// A smooth photo with a hole in its mask.
pub fn photo(width: u32, height: u32, masked: bool) -> Target {
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let rgb = pixels.clone().flat_map(|(x, y)| [(3 * x % 256) as u8, (2 * y + x) as u8, 90]).collect();
    let mask = masked.then(|| pixels.map(|(x, y)| if x / 9 == 1 && y > 5 { 0 } else { 255 }).collect());
    Target { mask, ..Target::new([width, height], rgb) }
}

pub struct Results {
    pub image: Image,
    pub value: LossValue,
    pub grads: Gradients,
}

fn results(renderer: &mut dyn Renderer, view: &(Columns, Camera), options: &RenderOptions, target: &Target) -> Results {
    results_with(renderer, view, options, target, &LossOptions::default()).unwrap()
}

pub fn results_with(
    renderer: &mut dyn Renderer,
    (rows, camera): &(Columns, Camera),
    options: &RenderOptions,
    target: &Target,
    loss: &LossOptions,
) -> Result<Results, RenderError> {
    let mut grads = Gradients::default();
    renderer.draw(rows, camera, options)?;
    renderer.loss(target, loss)?;
    renderer.backpropagate(rows, &mut grads)?;
    let value = renderer.loss_value()?;
    assert_eq!(renderer.unusable_splats()?, 0);
    Ok(Results { image: renderer.image()?.clone(), value, grads })
}

/// A view whose rows come in batches that end at `ends` (see [`batches_of`]), which come out backwards.
pub fn in_batches(
    gpu: &mut GpuRenderer,
    (rows, camera): &(Columns, Camera),
    options: &RenderOptions,
    (ends, how): (&[usize], RowBatches),
    target: &Target,
    loss: &LossOptions,
) -> Results {
    let batches = batches_of(rows, ends);
    gpu.begin_view(camera, options, how).unwrap();
    batches.iter().for_each(|batch| gpu.rows_in(batch).unwrap());
    gpu.picture().unwrap();
    gpu.loss(target, loss).unwrap();
    gpu.picture_back().unwrap();
    let mut parts: Vec<Gradients> = vec![Gradients::default(); batches.len()];
    for (i, batch) in batches.iter().enumerate().rev() {
        gpu.rows_out(i, batch, &mut parts[i]).unwrap();
    }
    let value = gpu.loss_value().unwrap();
    let mut grads = Gradients::default();
    for part in &parts {
        for column in Column::ALL {
            grads.columns.column_mut(column).extend_from_slice(part.columns.column(column));
        }
        grads.means2d.extend_from_slice(&part.means2d);
        grads.radii.extend_from_slice(&part.radii);
        grads.weights.extend_from_slice(&part.weights);
    }
    Results { image: gpu.image().unwrap().clone(), value, grads }
}

fn l2(got: &[f32], want: &[f32]) -> f64 {
    assert_eq!(got.len(), want.len());
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    let error = norm(&mut got.iter().zip(want).map(|(g, w)| f64::from(*g) - f64::from(*w)));
    error / norm(&mut want.iter().map(|w| f64::from(*w))).max(1e-30)
}

/// Relative L2 of a gradient column: a thousand times the rounding of one stage, for sums whose terms cancel.
const GRADIENT_L2: f64 = 2e-4;
/// Error of a pixel without a flipped decision.
const PIXEL: f32 = 5e-5;

fn assert_same(what: &str, got: &Results, want: &Results) {
    let pixels = got.image.rgb.iter().zip(&want.image.rgb);
    let (mut off, mut worst) = (0usize, 0.0f32);
    for (g, w) in pixels {
        let d = (g - w).abs();
        assert!(d < 1.0 / 255.0, "{what}: pixel {g}, want {w}");
        off += usize::from(d > PIXEL);
        worst = worst.max(d);
    }
    println!("{what}: worst pixel {worst:.1e}, {off} off; loss {} {}", got.value.loss, want.value.loss);
    assert!(off * 1000 <= want.image.rgb.len(), "{what}: {off} values of the picture are off");
    // 1e-5 of the SSIM's small variances, see loss.rs, and a few pixels with moved decisions.
    assert!((got.value.loss - want.value.loss).abs() < 2e-5, "{what}: {:?} {:?}", got.value, want.value);
    for column in Column::ALL {
        let (g, w) = (got.grads.columns.column(column), want.grads.columns.column(column));
        let error = l2(g, w);
        println!("{what}: {column:?} {error:.1e}");
        assert!(error < GRADIENT_L2, "{what}: {column:?} {error}");
    }
    let error = l2(got.grads.means2d.as_flattened(), want.grads.means2d.as_flattened());
    assert!(error < GRADIENT_L2, "{what}: means2d {error}");
    // A half extent is rounded up: a rounding may move it by one.
    assert_eq!(got.grads.radii.len(), want.grads.radii.len());
    let moved = got.grads.radii.iter().zip(&want.grads.radii).filter(|(g, w)| g != w).count();
    assert!(moved * 500 <= want.grads.radii.len(), "{what}: {moved} radii differ");
}

pub fn bits(results: &Results) -> Vec<u32> {
    let columns = Column::ALL.into_iter().flat_map(|c| results.grads.columns.column(c));
    let floats = results.image.rgb.iter().chain(columns).chain(results.grads.means2d.as_flattened());
    let loss = results.value.loss.to_bits();
    floats.map(|x| x.to_bits()).chain([loss as u32, (loss >> 32) as u32]).collect()
}

#[test]
fn views_are_those_of_the_cpu() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let mut cpu = CpuRenderer::new();
    // One renderer for all views: leftovers of an earlier view must not show.
    for (rows, width, height, sh_degree) in [(4000, 160, 112, 3), (3, 65, 47, 2), (20_000, 123, 77, 1), (900, 40, 9, 0)]
    {
        let view = scene(rows, width, height);
        let options = RenderOptions { sh_degree, background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
        for masked in [false, true] {
            let target = photo(width, height, masked);
            let what = format!("{rows} rows, {width}x{height}, degree {sh_degree}, masked {masked}");
            let want = results(&mut cpu, &view, &options, &target);
            let got = results(&mut gpu, &view, &options, &target);
            assert_same(&what, &got, &want);
            let again = results(&mut gpu, &view, &options, &target);
            assert!(bits(&got) == bits(&again), "{what}: another run gives other bits");
        }
    }
}

#[test]
fn a_view_without_rows_is_the_background() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (mut rows, camera) = scene(0, 33, 17);
    let options = RenderOptions { background: [0.25, 0.5, 0.75], ..RenderOptions::default() };
    let target = photo(33, 17, false);
    let nothing = results(&mut gpu, &(rows.clone(), camera), &options, &target);
    let pixels = nothing.image.pixels();
    assert!(nothing.image.rgb[pixels..2 * pixels].iter().all(|&x| x == 0.5));
    assert_eq!(nothing.grads.columns.rows(), 0);
    // All behind the camera.
    rows = scene(50, 33, 17).0;
    rows.means.iter_mut().skip(2).step_by(3).for_each(|z| *z = -9.0);
    let behind = results(&mut gpu, &(rows, camera), &options, &target);
    assert_eq!(behind.image, nothing.image);
    assert!(Column::ALL.iter().all(|&c| behind.grads.columns.column(c).iter().all(|&x| x == 0.0)));
    assert!(behind.grads.means2d.iter().all(|v| *v == [0.0; 2]) && behind.grads.radii.iter().all(|r| *r == [0, 0]));
}

#[test]
fn values_that_are_not_finite_do_as_on_the_cpu() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let mut view = scene(600, 80, 60);
    view.0.means[4] = f32::NAN;
    view.0.scales[10] = f32::INFINITY;
    view.0.quats[80..84].fill(0.0);
    view.0.opacities[30] = f32::NAN;
    let (options, target) = (RenderOptions::default(), photo(80, 60, false));
    let want = results(&mut CpuRenderer::new(), &view, &options, &target);
    assert!(want.value.loss.is_finite(), "rows that are not finite are culled");
    assert_same("poison", &results(&mut gpu, &view, &options, &target), &want);
}

#[test]
fn buffers_that_are_too_small_are_made_larger() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (view, options, target) = (scene(4000, 160, 112), RenderOptions::default(), photo(160, 112, false));
    let want = bits(&results(&mut gpu, &view, &options, &target));
    assert_eq!(gpu.frames_rerecorded(), 0);
    gpu.set_capacity(100);
    assert!(bits(&results(&mut gpu, &view, &options, &target)) == want);
    assert_eq!(gpu.frames_rerecorded(), 1);
    results(&mut gpu, &view, &options, &target);
    assert_eq!(gpu.frames_rerecorded(), 1, "the room is kept");
}

#[test]
fn tiles_in_bands_change_no_bit() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (view, options, target) = (scene(1500, 80, 64), RenderOptions::default(), photo(80, 64, false));
    let want = bits(&results(&mut gpu, &view, &options, &target));
    // A dispatch for each row of tiles.
    gpu.set_dispatch_pairs(1);
    assert!(bits(&results(&mut gpu, &view, &options, &target)) == want);
    // And a submission: a whole view has five of them, so that the sixth is of the next view.
    let fault = Some(InjectedFault { kind: FaultKind::OutOfMemory, submission: 6 });
    let fails = |pairs: Option<u64>| {
        let mut gpu = renderer(&GpuOptions { fault, ..GpuOptions::default() }).unwrap();
        pairs.iter().for_each(|&pairs| gpu.set_dispatch_pairs(pairs));
        let mut grads = Gradients::default();
        let (rows, camera) = &view;
        gpu.begin_view(camera, &options, RowBatches::One)
            .and_then(|()| gpu.rows_in(rows).map(|_| ()))
            .and_then(|()| gpu.picture().map(|_| ()))
            .and_then(|()| gpu.loss(&target, &LossOptions::default()).map(|_| ()))
            .and_then(|()| gpu.picture_back().map(|_| ()))
            .and_then(|()| gpu.rows_out(0, rows, &mut grads).map(|_| ()))
            .is_err()
    };
    assert_eq!([fails(None), fails(Some(1))], [false, true]);
}

#[test]
fn limits_and_forms_of_a_device_change_no_bit() {
    let plain = GpuOptions::default();
    let Some(mut whole) = renderer(&plain) else { return };
    let (view, target) = (few_isects(4000), photo(64, 48, true));
    let options = RenderOptions { background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
    let want = results(&mut whole, &view, &options, &target);
    assert!(want.grads.radii.iter().filter(|r| r[0] > 0).count() > 500, "most rows are drawn");
    // The widest column has 180 bytes a row: 4000 rows are cut in four, the splats (48 bytes) just fit.
    let cut = GpuOptions { max_binding_bytes: Some(48 * 4000), ..plain };
    // No more intersections than the lowered binding holds with their gradients.
    for (what, form, capacity) in [
        ("windows", cut, 5000),
        ("uniforms in blocks", GpuOptions { uniform_blocks: Some(true), ..plain }, 5000),
        ("uniforms in storage", GpuOptions { uniform_blocks: Some(false), ..plain }, 5000),
        ("a wait for each submission", GpuOptions { serial: true, ..plain }, 5000),
        ("windows, waits, lists that are too short at first", GpuOptions { serial: true, ..cut }, 100),
        ("windows, uniforms in blocks", GpuOptions { uniform_blocks: Some(true), ..cut }, 5000),
    ] {
        let mut gpu = renderer(&form).unwrap();
        gpu.set_capacity(capacity);
        assert!(bits(&want) == bits(&results(&mut gpu, &view, &options, &target)), "{what}");
        assert_eq!(gpu.frames_rerecorded() > 0, capacity == 100, "{what}");
    }
}

#[test]
fn sums_of_intersections_in_windows_give_the_same_bits() {
    // Nine sums of 4 bytes: the sums of a third of what the keys of as many intersections take fit one binding.
    let limit = 4 << 16;
    let (Some(mut whole), Some(mut cut)) = (
        renderer(&GpuOptions::default()),
        renderer(&GpuOptions { max_binding_bytes: Some(limit), ..GpuOptions::default() }),
    ) else {
        return;
    };
    let (mut view, target) = (scene(2500, 144, 112), photo(144, 112, false));
    view.0.scales.iter_mut().for_each(|s| *s += 0.8);
    let options = RenderOptions { background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
    let want = results(&mut whole, &view, &options, &target);
    let got = results(&mut cut, &view, &options, &target);
    let windows = (36 * u64::from(cut.isects())).div_ceil(limit);
    println!("{} intersections, {windows} windows", cut.isects());
    assert!(windows >= 3);
    for column in Column::ALL {
        let (g, w) = (got.grads.columns.column(column), want.grads.columns.column(column));
        let moved: Vec<usize> = (0..g.len()).filter(|&i| g[i].to_bits() != w[i].to_bits()).collect();
        let first = moved.first().map(|&i| (i, g[i], w[i]));
        assert!(moved.is_empty(), "{column:?}: {} of {} values differ, first {first:?}", moved.len(), g.len());
    }
    assert!(bits(&got) == bits(&want) && got.value == want.value && got.grads.radii == want.grads.radii);
}

/// More intersections than sums fit one binding of 128 MiB, at its real size: some 10 s of CPU time on a software adapter.
#[test]
fn a_view_beyond_one_binding_of_sums_is_that_of_the_cpu() {
    // Every adapter is limited to the smallest accepted binding.
    let limit = 128 << 20;
    let Some(mut gpu) = renderer(&GpuOptions { max_binding_bytes: Some(limit), ..GpuOptions::default() }) else {
        return;
    };
    let (mut view, target) = (scene(85_000, 640, 480), photo(640, 480, false));
    (view.1.fx, view.1.fy) = (300.0, 300.0);
    view.0.scales.iter_mut().for_each(|s| *s = 0.1 * *s - 1.7);
    let options = RenderOptions { background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
    let got = results(&mut gpu, &view, &options, &target);
    let isects = u64::from(gpu.isects());
    println!("{isects} intersections, {} frames again, {:?}", gpu.frames_rerecorded(), gpu.traffic());
    assert!(36 * isects > limit, "{isects} intersections need one window");
    assert_same("a large view", &got, &results(&mut CpuRenderer::new(), &view, &options, &target));
}

/// Small Gaussians, hardly any of which touches two tiles.
fn few_isects(rows: usize) -> (Columns, Camera) {
    let (mut columns, camera) = scene(rows, 64, 48);
    columns.scales.iter_mut().for_each(|s| *s = 0.1 * *s - 6.0);
    (columns, camera)
}

#[test]
fn a_picture_beyond_one_binding_is_an_error_that_names_need_limit_and_remedy() {
    let Some(mut gpu) = renderer(&GpuOptions { max_binding_bytes: Some(64 << 10), ..GpuOptions::default() }) else {
        return;
    };
    let (rows, camera) = scene(4000, 160, 112);
    let error = gpu.draw(&rows, &camera, &RenderOptions::default()).unwrap_err();
    assert!(error.remedy().is_some_and(|text| text.contains("--max-resolution")), "{error}");
    let RenderError::Device(GpuError::BindingTooLarge { binding, need, limit, .. }) = error else { panic!("{error}") };
    assert!(binding == "rgb" && need == 12 * 160 * 112 && need > limit, "{binding}: {need} of {limit}");
    let dispatches = gpu.gpu().traffic().work.dispatches;
    assert!(dispatches < 100, "the lists were cut {dispatches} times in vain");
    let error = gpu.image().unwrap_err();
    assert!(matches!(error, RenderError::OutOfOrder { .. }), "no picture after an error: {error}");
    // Smaller views still work.
    let (small, camera) = scene(20, 32, 32);
    gpu.draw(&small, &camera, &RenderOptions::default()).unwrap();
}

#[test]
fn a_view_allocates_nothing_once_warm_and_uploads_its_rows_only() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (view, options, target) = (scene(4000, 160, 112), RenderOptions::default(), photo(160, 112, false));
    let mut step = || {
        let before = gpu.traffic();
        results(&mut gpu, &view, &options, &target);
        let after = gpu.traffic();
        (after.device_allocations - before.device_allocations, after.bytes_uploaded - before.bytes_uploaded)
    };
    step();
    step();
    let (allocations, uploaded) = step();
    assert_eq!(allocations, 0);
    // 59 floats a row, a word a pixel; 64 KiB of counts and uniforms.
    let least = 4000 * 59 * 4 + 160 * 112 * 4;
    assert!((least..least + (64 << 10)).contains(&uploaded), "{uploaded} bytes, {least} at least");
}

/// The stages are calls of their own, but the device gets no more submissions than their overlap needs: five a view. The
/// stage in which a fault at a submission ends the view says which stage submitted it.
#[test]
fn stages_share_five_submissions() {
    let (rows, camera) = scene(300, 40, 30);
    let (target, options) = (photo(40, 30, false), RenderOptions::default());
    let loss = LossOptions::default();
    let submitted = ["rows_in", "picture", "loss", "rows_out", "rows_out"];
    for (submission, want) in (1..).zip(submitted.into_iter().chain(submitted)) {
        let fault = Some(InjectedFault { kind: FaultKind::OutOfMemory, submission });
        let Some(mut gpu) = renderer(&GpuOptions { fault, ..GpuOptions::default() }) else { return };
        let mut grads = Gradients::default();
        let mut view = || -> Result<(), (&str, RenderError)> {
            let of = |stage| move |error| (stage, error);
            gpu.begin_view(&camera, &options, RowBatches::One).map_err(of("begin_view"))?;
            gpu.rows_in(&rows).map_err(of("rows_in"))?;
            gpu.picture().map_err(of("picture"))?;
            gpu.loss(&target, &loss).map_err(of("loss"))?;
            gpu.picture_back().map_err(of("picture_back"))?;
            gpu.rows_out(0, &rows, &mut grads).map_err(of("rows_out"))?;
            gpu.loss_value().map(|_| ()).map_err(of("loss_value"))
        };
        let (stage, error) = view().and_then(|()| view()).unwrap_err();
        assert_eq!(stage, want, "submission {submission}: {error}");
        let is_gone = gpu.loss_value().unwrap_err();
        assert!(matches!(is_gone, RenderError::OutOfOrder { .. }), "no view after an error of the device: {is_gone}");
    }
}

/// The rows of a view in one batch and in several, which come out backwards: the same bits of picture, loss and gradients.
#[test]
fn batches_of_rows_change_no_bit() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (view, target) = (scene(3000, 100, 70), photo(100, 70, true));
    let (options, loss) = (RenderOptions::default(), LossOptions::default());
    let mut run = |ends: &[usize], how| in_batches(&mut gpu, &view, &options, (ends, how), &target, &loss);
    let one = run(&[0, 3000], RowBatches::One);
    let has_values = |values: &[f32]| values.iter().any(|x| *x != 0.0);
    assert!(has_values(&one.image.rgb) && has_values(one.grads.means2d.as_flattened()));
    assert!(Column::ALL.iter().all(|&column| has_values(one.grads.columns.column(column))));
    // Starts that are not aligned, a batch of one row, and one without rows.
    for ends in [&[0, 3000][..], &[0, 1501, 3000], &[0, 1, 1, 777, 3000], &[0, 0, 3000, 3000]] {
        assert!(bits(&run(ends, RowBatches::Several)) == bits(&one), "batches end at {ends:?}");
    }
}

#[test]
fn misuse_is_an_error() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (rows, camera) = scene(10, 32, 32);
    let loss = LossOptions::default();
    let mut grads = Gradients::default();
    let is_order = |result: Result<(), RenderError>| matches!(result, Err(RenderError::OutOfOrder { .. }));
    let (options, small) = (RenderOptions::default(), scene(9, 32, 32).0);
    assert!(
        is_order(gpu.rows_in(&rows)) && is_order(gpu.picture()) && is_order(gpu.loss(&photo(32, 32, false), &loss))
    );
    gpu.begin_view(&camera, &options, RowBatches::One).unwrap();
    assert!(is_order(gpu.picture()));
    gpu.rows_in(&rows).unwrap();
    assert!(is_order(gpu.rows_in(&rows)) && is_order(gpu.picture_back()));
    gpu.picture().unwrap();
    let wrong = gpu.loss(&photo(16, 32, false), &loss).unwrap_err();
    assert!(matches!(wrong, RenderError::TargetSize { .. }));
    assert!(is_order(gpu.picture_back()) && is_order(gpu.loss_value().map(|_| ())));
    gpu.loss(&photo(32, 32, false), &loss).unwrap();
    gpu.picture_back().unwrap();
    assert!(is_order(gpu.image().map(|_| ())) && is_order(gpu.loss(&photo(32, 32, false), &loss)));
    let wrong = gpu.rows_out(0, &small, &mut grads).unwrap_err();
    assert_eq!(wrong, RenderError::BatchRows { batch: 0, given: 9 });
    gpu.rows_out(0, &rows, &mut grads).unwrap();
    assert!(is_order(gpu.rows_out(0, &rows, &mut grads)));
    gpu.picture_gradient().unwrap().v_rgb.pop();
    assert_eq!(gpu.picture_back(), Err(RenderError::GradientSize { pixels: 32 * 32 }));
    // Begun, and begun anew before the recorded colours were submitted.
    gpu.begin_view(&camera, &options, RowBatches::One).unwrap();
    gpu.rows_in(&rows).unwrap();
    gpu.draw(&small, &camera, &options).unwrap();
    gpu.begin_view(&camera, &options, RowBatches::One).unwrap();
    gpu.rows_in(&rows).unwrap();
    assert!(is_order(gpu.rows_in(&rows)), "the view has one batch");
    let high = RenderOptions { sh_degree: 3, ..RenderOptions::default() };
    assert!(matches!(gpu.draw(&Columns::zeros(1, 1), &camera, &high), Err(RenderError::ShDegree { .. })));
}

/// A second term of the loss adds its gradient on the host: both backends go on from the sum.
#[test]
fn gradients_that_the_caller_adds_to_reach_the_rows() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    let (rows, camera) = scene(900, 65, 47);
    let (target, options) = (photo(65, 47, true), RenderOptions::default());
    let loss = LossOptions::default();
    let mut draws = Stream::new(5, Purpose::Test, 0, 0);
    let scale = 1.0 / camera.pixels() as f32;
    let term: Vec<f32> = (0..3 * camera.pixels()).map(|_| scale * draws.normal() as f32).collect();
    // A correction of the picture before the loss, through which its gradient is taken back; and a second term.
    let run = |renderer: &mut dyn Renderer, exposure: Option<f32>, weight: Option<f32>| {
        let mut grads = Gradients::default();
        renderer.draw(&rows, &camera, &options).unwrap();
        if let Some(exposure) = exposure {
            renderer.picture_mut().unwrap().iter_mut().for_each(|x| *x *= exposure);
        }
        renderer.loss(&target, &loss).unwrap();
        if let Some(exposure) = exposure {
            renderer.picture_gradient().unwrap().v_rgb.iter_mut().for_each(|v| *v *= exposure);
        }
        if let Some(weight) = weight {
            let gradient = renderer.picture_gradient().unwrap();
            gradient.v_rgb.iter_mut().zip(&term).for_each(|(v, term)| *v += weight * term);
        }
        renderer.backpropagate(&rows, &mut grads).unwrap();
        let value = renderer.loss_value().unwrap();
        Results { image: renderer.image().unwrap().clone(), value, grads }
    };
    let (plain, want) = (run(&mut gpu, None, None), run(&mut CpuRenderer::new(), None, Some(1.0)));
    assert!(bits(&run(&mut gpu, None, Some(0.0))) == bits(&plain), "to the host and back no bit changes");
    let got = run(&mut gpu, None, Some(1.0));
    assert_same("a second term", &got, &want);
    assert!(l2(&got.grads.columns.sh0, &plain.grads.columns.sh0) > 0.1, "the term is not lost in the loss");
    assert_eq!(got.value, plain.value, "the value is that of the loss alone");
    assert!(bits(&run(&mut gpu, Some(1.0), None)) == bits(&plain));
    let (corrected, want) = (run(&mut gpu, Some(1.25), None), run(&mut CpuRenderer::new(), Some(1.25), None));
    assert_same("an exposure", &corrected, &want);
    assert!((corrected.value.loss - plain.value.loss).abs() > 1e-3, "the loss compares the corrected picture");
    // A capacity that was too small is detected by the first reader of a result: here the caller that wants the
    // gradient.
    gpu.set_capacity(100);
    assert!(bits(&run(&mut gpu, None, Some(1.0))) == bits(&got));
    assert_eq!(gpu.frames_rerecorded(), 1);
}

#[test]
fn views_are_those_of_the_reference() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    for name in RASTER_FILES {
        let Some(file) = Fixture::open(name) else { return };
        let (rows, camera, options) = file.scene();
        gpu.draw(&rows, &camera, &options).unwrap();
        let (rgb, want) = (gpu.image().unwrap().rgb.clone(), file.planar("rgb"));
        let (alpha, want_alpha) = (gpu.alpha().unwrap(), file.f64("alpha"));
        let (ambiguous, pixels) = (file.f64("ambiguous"), camera.pixels());
        for p in (0..pixels).filter(|&p| ambiguous[p] == 0.0) {
            for c in 0..3 {
                let (g, w) = (rgb[c * pixels + p], want[c * pixels + p]);
                assert!((g - w).abs() < 5e-5, "{name}: pixel {p}: {g}, want {w}");
            }
            assert!((f64::from(alpha[p]) - want_alpha[p]).abs() < 5e-5, "{name}: coverage of pixel {p}");
        }
        let mut grads = Gradients::default();
        let (v_rgb, v_alpha) = (file.planar("v_rgb"), file.f32("v_alpha").to_vec());
        *gpu.picture_gradient().unwrap() = PictureGradient::new(v_rgb, v_alpha);
        gpu.backpropagate(&rows, &mut grads).unwrap();
        assert_gradients(name, &file, &grads);
    }
}

fn assert_gradients(name: &str, file: &Fixture, grads: &Gradients) {
    let c = &grads.columns;
    let scales: Vec<f32> = file.f64("g_scales").iter().zip(file.f64("scales")).map(|(g, s)| (g * s) as f32).collect();
    let logits = file.f64("g_opacities").iter().zip(file.f64("opacities"));
    let opacities: Vec<f32> = logits.map(|(g, o)| (g * o * (1.0 - o)) as f32).collect();
    let (sh0, sh_n) = split_sh(&file.f32("g_sh"), c.rows());
    for (column, got, want) in [
        ("means2d", grads.means2d.as_flattened(), &file.f32("g_means2d")),
        ("means", &c.means[..], &file.f32("g_means")),
        ("quats", &c.quats, &file.f32("g_quats")),
        ("scales", &c.scales, &scales),
        ("opacities", &c.opacities, &opacities),
        ("sh0", &c.sh0, &sh0),
        ("sh_n", &c.sh_n, &sh_n),
    ] {
        let error = l2(got, want);
        println!("{name}: {column} {error:.1e}");
        let limit = if name == "raster_stress" { 5e-3 } else { 5e-5 };
        assert!(error < limit, "{name}: {column} {error}");
    }
}

/// Rows under a pixel whose gradient is not finite, or enormous, are counted alike on both devices, in one batch and in
/// several; rows elsewhere are not.
#[test]
fn unusable_gradients_are_counted_on_both_devices() {
    let (rows, camera) = scene(4000, 160, 112);
    let count = |renderer: &mut dyn Renderer, value: Option<f32>, batches: RowBatches| {
        let half = rows.rows() / 2;
        let cuts = match batches {
            RowBatches::One => vec![0, rows.rows()],
            RowBatches::Several => vec![0, half, rows.rows()],
        };
        let parts = batches_of(&rows, &cuts);
        renderer.begin_view(&camera, &RenderOptions::default(), batches).unwrap();
        parts.iter().for_each(|part| renderer.rows_in(part).unwrap());
        renderer.picture().unwrap();
        let gradient = renderer.picture_gradient().unwrap();
        gradient.v_rgb.fill(1e-4);
        if let Some(value) = value {
            gradient.v_rgb[56 * 160 + 80] = value;
        }
        renderer.picture_back().unwrap();
        assert!(renderer.unusable_splats().is_err(), "no batch is out");
        let mut grads = Gradients::default();
        renderer.rows_out(parts.len() - 1, &parts[parts.len() - 1], &mut grads).unwrap();
        renderer.unusable_splats().unwrap()
    };
    let mut gpu = renderer(&GpuOptions::default());
    let mut renderers: Vec<&mut dyn Renderer> = Vec::new();
    let mut cpu = CpuRenderer::new();
    renderers.push(&mut cpu);
    renderers.extend(gpu.as_mut().map(|gpu| gpu as &mut dyn Renderer));
    for renderer in renderers {
        for batches in [RowBatches::One, RowBatches::Several] {
            assert_eq!(count(&mut *renderer, None, batches), 0);
            for value in [f32::NAN, f32::INFINITY, 1e30] {
                let unusable = count(&mut *renderer, Some(value), batches);
                // One pixel is under some of the rows, and not under most.
                assert!((1..1000).contains(&unusable), "{} {value}: {unusable}", renderer.name());
            }
        }
    }
}
