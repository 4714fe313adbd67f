//! Tests of the stages together: batches, ranges, threads and instruction paths give the same bits.

use super::*;
use crate::base::rng::{Purpose, Stream};
use crate::kernels::image_loss::SsimPadding;
use crate::scene::columns::Column;

/// `rows` Gaussians in front of a camera; some are large, opaque, behind the camera or off the picture.
fn scene(rows: usize, width: u32, height: u32) -> (Columns, Camera) {
    let mut draws = Stream::new(11, Purpose::Test, rows as u64, 0);
    let mut c = Columns::zeros(rows, 2);
    c.means.iter_mut().for_each(|x| *x = draws.range(-2.0, 2.0) as f32);
    c.quats.iter_mut().for_each(|x| *x = draws.normal() as f32);
    c.scales.iter_mut().for_each(|x| *x = draws.range(-5.0, -1.0) as f32);
    c.opacities.iter_mut().for_each(|x| *x = draws.range(-6.0, 7.0) as f32);
    c.sh0.iter_mut().chain(&mut c.sh_n).for_each(|x| *x = 0.5 * draws.normal() as f32);
    let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 1.5]];
    (c, Camera::pinhole(viewmat, [60.0, 65.0, 0.5 * width as f32, 0.5 * height as f32], [width, height]))
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|x| x.to_bits()).collect()
}

fn random_gradient(camera: &Camera) -> PictureGradient {
    let mut draws = Stream::new(12, Purpose::Test, 0, 0);
    let v_rgb = (0..3 * camera.pixels()).map(|_| draws.normal() as f32).collect();
    PictureGradient::new(v_rgb, (0..camera.pixels()).map(|_| draws.normal() as f32).collect())
}

/// Bits of image, alpha and all gradients for an instruction path and a number of threads.
fn render_bits(rows: &Columns, camera: &Camera, simd: SimdPath, threads: usize) -> Vec<Vec<u32>> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let mut renderer = CpuRenderer::new();
        let options = RenderOptions { sh_degree: 2, background: [0.2, 0.4, 0.1], simd, ..RenderOptions::default() };
        renderer.draw(rows, camera, &options).unwrap();
        *renderer.picture_gradient().unwrap() = random_gradient(camera);
        let mut grads = Gradients::default();
        renderer.backpropagate(rows, &mut grads).unwrap();
        let rgb = bits(&renderer.image().unwrap().rgb);
        let mut all = vec![rgb, bits(renderer.alpha()), bits(grads.means2d.as_flattened())];
        all.extend(Column::ALL.map(|c| bits(grads.columns.column(c))));
        all
    })
}

#[test]
fn threads_do_not_change_a_bit() {
    // Enough rows for several chunks in every stage.
    let (rows, camera) = scene(20_000, 123, 77);
    let one = render_bits(&rows, &camera, SimdPath::best(), 1);
    assert!(one.iter().flatten().any(|b| *b != 0));
    for threads in [2, 16] {
        assert!(one == render_bits(&rows, &camera, SimdPath::best(), threads), "{threads} threads");
    }
}

fn part(rows: &Columns, place: Range<usize>) -> Columns {
    let mut part = Columns { sh_degree: rows.sh_degree, ..Columns::default() };
    for column in Column::ALL {
        let width = column.width(rows.sh_degree);
        *part.column_mut(column) = rows.column(column)[place.start * width..place.end * width].to_vec();
    }
    part
}

/// As [`render_bits`] from a loss, with the rows in batches that end at `ends`; `rows_out` takes the last batch
/// first.
fn bits_of_batches(renderer: &mut CpuRenderer, rows: &Columns, camera: &Camera, ends: &[usize]) -> Vec<Vec<u32>> {
    let options = RenderOptions { sh_degree: 2, background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
    let firsts = std::iter::once(&0).chain(ends);
    let batches: Vec<Columns> = firsts.zip(ends).map(|(&first, &end)| part(rows, first..end)).collect();
    renderer.weigh_rows(true).unwrap();
    let how = if batches.len() == 1 { RowBatches::One } else { RowBatches::Several };
    renderer.begin_view(camera, &options, how).unwrap();
    batches.iter().for_each(|batch| renderer.rows_in(batch).unwrap());
    renderer.picture().unwrap();
    let rgb = (0..3 * camera.pixels()).map(|i| (i % 251) as u8).collect();
    let target = Target::new([camera.width, camera.height], rgb);
    let loss = LossOptions { ssim_lambda: 0.2, padding: SsimPadding::Valid, simd: SimdPath::best() };
    renderer.loss(&target, &loss).unwrap();
    renderer.picture_back().unwrap();
    let mut all = vec![Vec::new(); 9];
    for (i, batch) in batches.iter().enumerate().rev() {
        let mut grads = Gradients::default();
        renderer.rows_out(i, batch, &mut grads).unwrap();
        let mut of_batch = vec![bits(grads.means2d.as_flattened()), grads.radii.as_flattened().to_vec()];
        of_batch.push(bits(grads.weights.as_flattened()));
        of_batch.extend(Column::ALL.map(|c| bits(grads.columns.column(c))));
        for (all, mut of_batch) in all.iter_mut().zip(of_batch) {
            of_batch.append(all);
            *all = of_batch;
        }
    }
    let value = renderer.loss_value().unwrap().loss.to_bits();
    all.extend([bits(&renderer.image().unwrap().rgb), vec![value as u32, (value >> 32) as u32]]);
    all
}

#[test]
fn batches_do_not_change_a_bit() {
    // Batch sizes: no multiple of a block or chunk, one row, and zero rows. A larger view, then a smaller one.
    let mut renderer = CpuRenderer::new();
    for (n, cuts) in [(20_000, vec![vec![9_001], vec![1, 1, 4_096, 13_313], vec![0, 20_000]]), (900, vec![vec![450]])] {
        let (rows, camera) = scene(n, 123, 77);
        let one = bits_of_batches(&mut renderer, &rows, &camera, &[n]);
        assert!(one.iter().all(|values| values.iter().any(|b| *b != 0)));
        for mut ends in cuts {
            ends.push(n);
            assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &ends), "{n} rows, batches end at {ends:?}");
        }
    }
}

#[test]
fn ranges_of_tiles_do_not_change_a_bit() {
    let mut renderer = CpuRenderer::new();
    let (rows, camera) = scene(20_000, 123, 77);
    let one = bits_of_batches(&mut renderer, &rows, &camera, &[20_000]);
    let isects = renderer.stats().isects;
    assert_eq!(renderer.ranges().len(), 1);
    // A few ranges, some fifty with parts of columns, and one for each of the 8 x 5 tiles.
    for (most, least_ranges) in [(isects / 3, 3), (isects / 30, 30), (0, 40)] {
        renderer.set_list_bytes(Some(most * LIST_BYTES));
        assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &[9_001, 20_000]), "lists of {most}");
        assert!(renderer.ranges().len() >= least_ranges, "{} ranges of {most}", renderer.ranges().len());
        let many = one == bits_of_batches(&mut renderer, &rows, &camera, &[20_000]);
        assert!(many, "lists of {most}, the same memory again");
    }
    renderer.set_list_bytes(None);
    assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &[20_000]));
}

/// A view whose rows alone overflow the lists holds the stated bytes a row, and gives the bits of a view with room.
#[test]
fn a_crowded_view_gives_buffers_up_and_keeps_its_bits() {
    let (rows, camera) = scene(60_000, 123, 77);
    let mut roomy = CpuRenderer::new();
    let one = bits_of_batches(&mut roomy, &rows, &camera, &[60_000]);
    let (visible, isects) = (roomy.stats().visible, roomy.stats().isects);
    for (most, is_crowded) in [(visible + visible / 8, false), (visible / 8, true)] {
        assert!(most < isects, "lists of {most} hold all {isects} intersections");
        let mut renderer = CpuRenderer::new();
        renderer.set_list_bytes(Some(most * (LIST_BYTES + 8)));
        for ends in [vec![60_000], vec![17, 31_001, 60_000], vec![60_000]] {
            assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &ends), "lists of {most}, {ends:?}");
            assert_eq!(renderer.is_crowded, is_crowded);
            let of_rows = (renderer.host_bytes() - renderer.bytes_of_lists_and_pixels()) as usize;
            // Weights of rows come on top, the colours of a batch (here of up to all rows), and the tables of the depth
            // sort, which do not grow with the rows.
            let stated = 60_000 * (CROWDED_ROW_BYTES + 8 + 12) + (256 << 10);
            assert_eq!(of_rows <= stated, is_crowded, "{of_rows} bytes, {stated} stated, {ends:?}");
        }
        renderer.set_list_bytes(None);
        assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &[60_000]), "with room again");
    }
}

/// A renderer says before a view what the rows of the view will take, and gives this memory back.
#[test]
fn memory_of_rows_is_stated_before_a_view_and_freed_after_it() {
    let (rows, camera) = scene(60_000, 123, 77);
    for list_bytes in [None, Some(7_500 * (LIST_BYTES + 8))] {
        let mut renderer = CpuRenderer::new();
        renderer.set_list_bytes(list_bytes);
        renderer.weigh_rows(true).unwrap();
        let stated = renderer.host_bytes_for_rows(60_000);
        let one = bits_of_batches(&mut renderer, &rows, &camera, &[60_000]);
        let held = renderer.host_bytes_of_rows();
        assert!(held <= stated, "{held} bytes, {stated} stated, lists {list_bytes:?}");
        // A first allocation spares nothing, and a crowded view does not hold its largest buffers at one time.
        assert!(stated <= held + held / 3, "{stated} bytes stated, {held} held, lists {list_bytes:?}");
        let beside = renderer.host_bytes() - held;
        renderer.free_rows();
        assert_eq!(renderer.host_bytes_of_rows(), 0);
        assert!(renderer.host_bytes() <= beside, "{} bytes, {beside} beside the rows", renderer.host_bytes());
        assert!(one == bits_of_batches(&mut renderer, &rows, &camera, &[60_000]), "lists {list_bytes:?}");
    }
}

#[test]
fn stages_out_of_order_are_errors_and_change_nothing() {
    let (rows, camera) = scene(600, 40, 30);
    let (options, mut grads) = (RenderOptions { sh_degree: 2, ..RenderOptions::default() }, Gradients::default());
    let is_order = |result: Result<(), RenderError>| matches!(result, Err(RenderError::OutOfOrder { .. }));
    let mut renderer = CpuRenderer::new();
    assert!(is_order(renderer.rows_in(&rows)) && is_order(renderer.picture()));
    renderer.begin_view(&camera, &options, RowBatches::One).unwrap();
    assert!(is_order(renderer.picture()), "the rows are missing");
    renderer.rows_in(&rows).unwrap();
    assert!(is_order(renderer.rows_in(&rows)), "the view has one batch");
    renderer.begin_view(&camera, &options, RowBatches::Several).unwrap();
    renderer.rows_in(&rows).unwrap();
    renderer.rows_in(&rows).unwrap();
    assert!(is_order(renderer.image().map(|_| ())));
    renderer.picture().unwrap();
    assert!(is_order(renderer.rows_in(&rows)), "the picture has no more rows");
    assert!(is_order(renderer.picture_back()) && is_order(renderer.loss_value().map(|_| ())));
    *renderer.picture_gradient().unwrap() = random_gradient(&camera);
    assert!(is_order(renderer.rows_out(0, &rows, &mut grads)));
    renderer.picture_back().unwrap();
    renderer.rows_out(1, &rows, &mut grads).unwrap();
    let want = grads.clone();
    assert!(is_order(renderer.rows_out(1, &rows, &mut grads)), "this batch was processed already");
    assert!(is_order(renderer.picture_gradient().map(|_| ())), "the other batch is still due");
    let other = RenderError::BatchRows { batch: 0, given: 1 };
    assert_eq!(renderer.rows_out(0, &part(&rows, 0..1), &mut grads), Err(other));
    let beyond = RenderError::BatchRows { batch: 2, given: 600 };
    assert_eq!(renderer.rows_out(2, &rows, &mut grads), Err(beyond));
    renderer.rows_out(0, &rows, &mut grads).unwrap();
    // The backward pass may run again, from the same gradient.
    renderer.picture_back().unwrap();
    renderer.rows_out(1, &rows, &mut grads).unwrap();
    assert!(grads.columns == want.columns && grads.radii == want.radii);
    renderer.rows_out(0, &rows, &mut grads).unwrap();
    renderer.picture_gradient().unwrap().v_alpha = Some(Vec::new());
    assert_eq!(renderer.picture_back(), Err(RenderError::GradientSize { pixels: 40 * 30 }));
}

#[test]
fn empty_scenes_show_the_background() {
    let options = RenderOptions { sh_degree: 0, background: [0.25, 0.5, 0.75], ..RenderOptions::default() };
    let mut renderer = CpuRenderer::new();
    let mut grads = Gradients::default();
    for (n, width, height) in [(0, 33, 17), (50, 1, 1), (50, 16, 16), (0, 0, 0)] {
        let (mut rows, camera) = scene(n, width, height);
        // All rows behind the camera.
        rows.means.iter_mut().for_each(|x| *x -= 10.0);
        renderer.draw(&rows, &camera, &options).unwrap();
        let pixels = camera.pixels();
        let want: Vec<f32> = [0.25, 0.5, 0.75].iter().flat_map(|&c| vec![c; pixels]).collect();
        assert_eq!(renderer.image().unwrap().rgb, want);
        renderer.picture_gradient().unwrap().v_rgb = want;
        renderer.backpropagate(&rows, &mut grads).unwrap();
        assert_eq!(grads.columns, Columns::zeros(n, 2));
        assert_eq!(grads.radii, vec![[0, 0]; n]);
        assert_eq!(renderer.stats(), RenderStats::default());
    }
}

#[test]
fn memory_stops_growing_once_warm() {
    let (rows, camera) = scene(5000, 123, 77);
    let options = RenderOptions { sh_degree: 1, ..RenderOptions::default() };
    let mut renderer = CpuRenderer::new();
    let mut grads = Gradients::default();
    let mut held = Vec::new();
    for _ in 0..3 {
        renderer.draw(&rows, &camera, &options).unwrap();
        let v_rgb = renderer.image().unwrap().rgb.clone();
        renderer.picture_gradient().unwrap().v_rgb.copy_from_slice(&v_rgb);
        renderer.backpropagate(&rows, &mut grads).unwrap();
        held.push(renderer.scratch_bytes());
    }
    assert!(held[0] > 0 && held[1] == held[0] && held[2] == held[0], "{held:?}");
}
