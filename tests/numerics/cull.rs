//! The culling of rows against the projection kernel: every row that the projection would draw is kept, and few others are.

use crate::support::{paths, random_rotation};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::densify::strategy::StrategyName;
use gsscale::kernels::constants::EPS2D;
use gsscale::kernels::project_fwd::{Projected, project_fwd};
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::rates::Rates;
use gsscale::optim::row_kernels::take_step;
use gsscale::paging::error::PagingError;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::render::Renderer;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::image::Target;
use gsscale::scene::state::SceneState;
use gsscale::train::step::batch::RowsInHost;
use gsscale::train::step::catch_up::{evaluate_all, gather, visible_rows};
use gsscale::train::step::comparison::Comparison;
use gsscale::train::step::pages::{PagedScene, WorkingSet};
use gsscale::train::step::train_step::{StepView, train_step};

fn camera(draws: &mut Stream) -> Camera {
    let r = random_rotation(draws);
    let viewmat =
        std::array::from_fn(|i| [r[i][0] as f32, r[i][1] as f32, r[i][2] as f32, (draws.normal() * 4.0) as f32]);
    let (width, height) = (200 + draws.below(400) as u32, 100 + draws.below(400) as u32);
    // Wide to narrow views; principal points up to far outside the image.
    let f = f64::from(width) * draws.range(0.3, 2.5);
    let [fy, cx, cy] = [
        f * draws.range(0.8, 1.2),
        f64::from(width) * draws.range(-0.3, 1.3),
        f64::from(height) * draws.range(-0.3, 1.3),
    ];
    let pinhole = Camera::pinhole(viewmat, [f, fy, cx, cy].map(|x| x as f32), [width, height]);
    Camera { near_plane: 0.05, far_plane: 12.0, ..pinhole }
}

/// Rows around the cameras, small and huge, some moving (moments from a few steps).
fn scene(rows: usize, adam: &DeferredAdam) -> SceneState {
    let mut columns = Columns::zeros(rows, 0);
    let mut draws = Stream::new(1, Purpose::Test, 9, 9);
    columns.means.iter_mut().for_each(|x| *x = (draws.normal() * 6.0) as f32);
    columns.quats.iter_mut().for_each(|x| *x = draws.normal() as f32);
    columns.scales.iter_mut().for_each(|x| *x = (draws.normal() * 1.5 - 4.0) as f32);
    // Nearly opaque, so that footprints have their full extent.
    columns.opacities.fill(6.0);
    let mut state = SceneState::from_columns(columns);
    for step in 0..12 {
        let listed: Vec<u32> = (0..rows as u32).filter(|_| draws.below(3) == 0).collect();
        let mut grads = Columns::zeros(listed.len(), 0);
        for column in [Column::Means, Column::Scales] {
            // Down to sizes where eps matters.
            grads.column_mut(column).iter_mut().for_each(|g| {
                *g = (draws.normal() * libm::pow(10.0, -draws.range(0.0, 16.0))) as f32;
            });
        }
        take_step(adam, &mut state, &listed, &grads, step);
    }
    state
}

#[test]
fn no_row_that_the_projection_kernel_draws_is_left_out() {
    let simd = SimdPath::best();
    // A large learning rate, so that rows move far between their last update and now.
    let adam = DeferredAdam::new(Rates::new(100.0, 500), AdamConfig::default(), simd);
    let state = scene(20_000, &adam);
    let mut draws = Stream::new(3, Purpose::Test, 1, 2);
    let (mut drawn, mut listed, mut out, mut projected) = (0, 0, Vec::new(), Projected::default());
    for now in 12..212 {
        let camera = camera(&mut draws);
        visible_rows(&[state.view()], &adam, now, &camera, &mut out);
        assert!(out.windows(2).all(|pair| pair[0] < pair[1]));
        listed += out.len();
        project_fwd(&evaluate_all(&[state.view()], 0, &adam, now), &camera, EPS2D, simd, 0, &mut projected);
        for (row, radii) in projected.radii.iter().enumerate().filter(|(_, r)| **r != [0, 0]) {
            drawn += 1;
            assert!(out.binary_search(&(row as u32)).is_ok(), "row {row} with radii {radii:?} is missing");
        }
    }
    // Culling uses the largest sigma for every direction. That lists a third more rows here, with needles up to the
    // size of the scene and principal points outside the picture.
    assert!(drawn > 50_000 && listed * 2 < drawn * 3, "{listed} listed for {drawn} drawn");
}

/// From pages to picture: rows that were not selected would not have changed one bit of the picture.
#[test]
fn no_row_outside_of_the_selected_pages_changes_a_picture() {
    const STEPS: u32 = 60;
    let config = TrainConfig { page_rows: 32, sh_degree: 0, means_lr: 0.02, ..TrainConfig::default() };
    let options = RunOptions::new(&TrainConfig { strategy: StrategyName::None, ..config }, 1.0);
    let adam = DeferredAdam::new(options.rates, AdamConfig::default(), SimdPath::best());
    let columns = scene(4000, &adam).columns;
    let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
    let mut pages = PagedScene::new(&columns, pager, &options).unwrap();
    let (mut working, mut renderer) = (WorkingSet::default(), CpuRenderer::new());
    let mut draws = Stream::new(7, Purpose::Test, 1, 2);
    let small = |camera: Camera| {
        let [width, height] = [camera.width / 4, camera.height / 4];
        let [fx, fy, cx, cy] = [camera.fx, camera.fy, camera.cx, camera.cy].map(|x| x / 4.0);
        Camera { width, height, fx, fy, cx, cy, ..camera }
    };
    for step in 0..STEPS {
        let camera = small(camera(&mut draws));
        let rgb = (0..3 * camera.pixels()).map(|_| draws.below(256) as u8).collect();
        let target = Target::new([camera.width, camera.height], rgb);
        let (rows, comparison) = (&mut RowsInHost::new(&mut renderer), &mut Comparison::new(&target, options.loss));
        let (camera, render) = (&camera, &options.render);
        let view = StepView { step, camera, render, collects: false, pages_most: usize::MAX };
        train_step(&mut pages, &mut working, rows, &view, comparison).unwrap();
    }
    let mut all = Columns::zeros(0, 0);
    let mut append = |rows: &Columns| {
        Column::ALL.iter().for_each(|&column| all.column_mut(column).extend_from_slice(rows.column(column)));
        Ok::<(), PagingError>(())
    };
    pages.for_all_rows(STEPS, &mut append).unwrap();
    let (mut left_out, mut drawn, mut selected) = (0, 0, 0);
    for view in 0..150 {
        let camera = small(camera(&mut draws));
        selected += pages.pager.pages_of_view(&camera).len();
        let seen = pages.pager.pages_of_view(&camera);
        pages.gather_pages(&seen, &[], &camera, STEPS, &mut working).unwrap();
        left_out += all.rows() - working.columns.rows();
        let [of_view, of_all] = [&working.columns, &all].map(|rows| {
            renderer.draw(rows, &camera, &options.render).unwrap();
            renderer.image().unwrap().rgb.clone()
        });
        drawn += usize::from(of_all.iter().any(|&x| x != 0.0));
        assert!(of_view.iter().zip(&of_all).all(|(a, b)| a.to_bits() == b.to_bits()), "view {view}: {camera:?}");
    }
    // Views look in all directions, many past the scene; more page boxes than rows meet a view.
    let share = selected as f64 / (150 * pages.pager.index().len()) as f64;
    assert!(
        drawn > 100 && left_out > 150 * 1000 && share < 0.9,
        "{drawn} drawn, {left_out} left out, {share} selected"
    );
}

#[test]
fn lists_do_not_depend_on_threads_or_on_the_instruction_path() {
    let lists = |simd: SimdPath, threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let adam = DeferredAdam::new(Rates::new(100.0, 500), AdamConfig::default(), simd);
            let state = scene(5000, &adam);
            let mut draws = Stream::new(2, Purpose::Test, 1, 2);
            let mut out = Vec::new();
            let mut values = Columns::default();
            let runs = (0..8).map(|i| {
                visible_rows(&[state.view()], &adam, 12 + i * 60, &camera(&mut draws), &mut out);
                gather(&[state.view()], 0, &adam, 12 + i * 60, &out, &mut values);
                (out.clone(), values.clone())
            });
            runs.collect::<Vec<_>>()
        })
    };
    let want = lists(SimdPath::Baseline, 1);
    for simd in paths() {
        assert!(lists(simd, 3) == want, "{}", simd.name());
    }
}
