//! Numeric inputs that break other trainers, one row each: what is put in, what comes out, and the tests that hold it.
//! Most of these tests lie where the code that they test is tested; those that had no other place are here, on the CPU and,
//! where there is one, a GPU.
//!
//! | put in | comes out | tests |
//! | --- | --- | --- |
//! | log-scales of 89, 1e38, infinity | clamped to the range of the scene, or culled | rates_beyond_reason_reach_no_page_with_infinities, log_scales_and_opacities_of_a_ply_are_brought_into_range_and_said, rows_whose_log_scales_drift_beyond_reason_stay_finite, non_finite_rows_are_culled_as_on_the_cpu_and_do_not_spread |
//! | quaternions of zero, tiny and huge length | culled, nothing is NaN | bad_rows_are_culled_and_leave_no_nan, unit_quat_is_stable_and_total |
//! | needles, scales of zero, edges seen end-on | drawn with the blur, gradients of finite differences | flat_rows_and_rows_of_size_zero_are_drawn, gradients_agree_needles_included |
//! | Gaussians at the near plane, at the camera, behind it | culled without a gradient, or drawn | gaussians_about_the_camera_leave_picture_and_gradients_finite |
//! | coordinates of 500 km, points at infinity | recentred in f64; dropped with a count | a_map_offset_gives_the_same_dataset, unusual_scenes_train |
//! | views that see nothing, scenes of no Gaussian | the background, no gradient; a run of such views stops | empty_scenes_show_the_background, a_run_that_sees_loses_or_draws_no_gaussian_stops |
//! | lists longer than the memory | ranges of tiles, the same bytes | splats_that_fill_large_photos_stay_within_the_memory |
//! | fewer intersections than tiles | only their tiles are drawn | three_splats_on_many_tiles_are_drawn_alone |
//! | a thousand opaque layers | alpha is clamped, blending stops; finite | an_opaque_scene_has_the_gradients_of_finite_differences, a_thousand_opaque_layers_stay_finite |
//! | opacities of exactly 0 and 1 | read as 1e-6 and .999999 | log_scales_and_opacities_of_a_ply_are_brought_into_range_and_said, values_out_of_range_are_refused_by_name |
//! | Gaussians that were never seen, in a round | no statistics, so no growth; nothing is divided by zero | only_drawn_rows_count_and_the_histogram_follows, a_round_does_what_a_plain_implementation_does |
//! | equal points, one point | a size from the scene; trains | unusual_scenes_train, degenerate_clouds_get_sane_scales |
//! | flat photos, photos below a window, masks of everything | SSIM as defined, a loss; a run of such masks stops | flat_bright_patches_and_equal_pictures, small_and_empty_pictures_have_a_loss, a_run_whose_masks_are_all_black_stops |
//! | second moments at the size of epsilon, far apart in time | the values of dense Adam in f64 | adam_deferred_equals_torch_at_every_snapshot, bounds_hold_for_every_allowed_eps |
//! | 2,000 missed steps under a rate that decays | the values of dense Adam in f64 | adam_deferred_equals_torch_at_every_snapshot, values_follow_dense_adam_in_f64 |
//! | a row from a later step | it does not move | rows_do_not_move_into_the_past_nor_without_end |
//! | step numbers of 2^32 - 1, counts that are full | limits, no wrap | rows_do_not_move_into_the_past_nor_without_end, rows_that_were_never_counted_are_noticed_and_no_counter_wraps, a_decay_over_any_gap_errs_by_a_rounding_or_two |
//! | moments below the smallest float after long gaps | flushed to zero, on every path | tiny_results_are_flushed_to_zero_and_none_is_negative |
//! | second moments in 16 bits | rounded without bias, never zero where the first is not | rounding_is_unbiased_and_keeps_exact_numbers, so_they_do_with_moments_in_sixteen_bits |
//! | bias corrections at steps 1 to 3 and 10 million | in f64 on the host | adam_dense_f64_equals_torch, rows_do_not_move_into_the_past_nor_without_end |
//! | resets and rounds while a row sleeps | late equals on time | events_that_pages_replay_late_give_the_rows_of_events_applied_at_once |
//! | the same run again, with more threads | the same bytes | a_run_goes_on_on_another_path_of_the_same_bits, the_matrix_has_every_pair |
//! | Gaussians of one depth | the order of their rows decides | gaussians_of_one_depth_are_blended_in_the_order_of_their_rows |
//! | rows evaluated at several steps on the way | the same bits as at once | reading_any_number_of_times_changes_no_bit_and_late_equals_on_time |
//! | a bit that flips in a page | found and named | every_flipped_bit_is_found_and_named, flipped_bits_in_pages_are_named_and_older_versions_take_their_place |
//! | one camera, cameras in one place | a scene scale above zero | degenerate_scenes_have_a_positive_scale |
//! | black photos, exposures that run away | bounded values, finite pictures | values_stay_within_bounds, a_black_photo_spoils_nothing_of_a_run_with_appearance |

use crate::support::gpu::open;
use gsscale::base::simd::SimdPath;
use gsscale::gpu::GpuOptions;
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::drift::DriftTables;
use gsscale::optim::rates::Rates;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::gpu::GpuRenderer;
use gsscale::render::{Gradients, LossOptions, RenderOptions, Renderer};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::image::Target;
use std::path::{Path, PathBuf};

fn sources(folder: &Path, texts: &mut String) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path: PathBuf = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, texts);
        } else if path.extension().is_some_and(|e| e == "rs") {
            texts.push_str(&std::fs::read_to_string(path).unwrap());
        }
    }
}

#[test]
fn each_input_has_its_tests() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut texts = String::new();
    ["src", "tests"].iter().for_each(|folder| sources(&root.join(folder), &mut texts));
    let rows: Vec<&str> = include_str!("poison.rs").lines().filter_map(|line| line.strip_prefix("//! | ")).collect();
    assert!(rows.len() > 27, "{}", rows.len());
    for row in &rows[2..] {
        let (what, tests) = row.trim_end_matches(" |").rsplit_once(" | ").unwrap();
        for test in tests.split(", ") {
            let head = format!("#[test]\nfn {test}()");
            let nested = format!("#[test]\n    fn {test}()");
            assert!(texts.contains(&head) || texts.contains(&nested), "{what}: there is no test {test}");
        }
    }
}

fn renderers() -> Vec<Box<dyn Renderer>> {
    let gpu = open(&GpuOptions::default()).map(|gpu| Box::new(GpuRenderer::new(gpu).unwrap()) as Box<dyn Renderer>);
    let cpu = Box::new(CpuRenderer::new()) as Box<dyn Renderer>;
    std::iter::once(cpu).chain(gpu).collect()
}

fn camera(width: u32, height: u32) -> Camera {
    let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    Camera::pinhole(viewmat, [60.0, 60.0, 0.5 * width as f32, 0.5 * height as f32], [width, height])
}

/// Grey Gaussians of size e^-3 at these places, of this logit opacity.
fn gaussians(means: &[[f32; 3]], opacity: f32) -> Columns {
    let mut rows = Columns::zeros(means.len(), 0);
    rows.means = means.concat();
    rows.quats.chunks_exact_mut(4).for_each(|quat| quat[0] = 1.0);
    rows.scales.fill(-3.0);
    rows.opacities.fill(opacity);
    rows
}

/// Picture and gradients against a white photo; both are finite.
fn drawn(renderer: &mut dyn Renderer, rows: &Columns, camera: &Camera) -> (Vec<f32>, Gradients) {
    let options = RenderOptions { sh_degree: 0, simd: SimdPath::best(), ..RenderOptions::default() };
    let photo = Target::new([camera.width, camera.height], vec![255; 3 * camera.pixels()]);
    let mut grads = Gradients::default();
    renderer.draw(rows, camera, &options).unwrap();
    let picture = renderer.image().unwrap().rgb.clone();
    renderer.loss(&photo, &LossOptions::default()).unwrap();
    renderer.backpropagate(rows, &mut grads).unwrap();
    assert!(renderer.loss_value().unwrap().loss.is_finite() && picture.iter().all(|x| x.is_finite()));
    for column in Column::ALL {
        assert!(grads.columns.column(column).iter().all(|x| x.is_finite()), "{column:?} on {}", renderer.name());
    }
    (picture, grads)
}

#[test]
fn gaussians_about_the_camera_leave_picture_and_gradients_finite() {
    for mut renderer in renderers() {
        // Behind, at the camera, in front of the near plane; then just beyond it, with the camera inside the Gaussian.
        let depths = [-1.0, -1e-6, 0.0, 1e-6, 0.0099, 0.0101, 0.02];
        let means = depths.map(|z| [0.001, 0.0, z]);
        let (_, grads) = drawn(&mut *renderer, &gaussians(&means, 0.0), &camera(48, 32));
        for (row, radii) in grads.radii.iter().enumerate().take(5) {
            assert_eq!((*radii, &grads.columns.means[3 * row..3 * row + 3]), ([0, 0], &[0.0; 3][..]), "row {row}");
        }
    }
}

#[test]
fn three_splats_on_many_tiles_are_drawn_alone() {
    for mut renderer in renderers() {
        let (side, means) = (512, [[0.0, 0.0, 1.0], [2.0, 2.0, 1.0], [-2.0, 1.0, 1.0]]);
        let (picture, grads) = drawn(&mut *renderer, &gaussians(&means, 0.0), &camera(side, side));
        assert!(grads.radii.iter().all(|radii| *radii != [0, 0]), "{}", renderer.name());
        // Grey of alpha one half in the middle of each, black between them.
        let at = |x: usize, y: usize| picture[y * side as usize + x];
        for (x, y) in [(256, 256), (376, 376), (136, 316)] {
            assert!((at(x, y) - 0.25).abs() < 0.01, "{} at {x}, {y} on {}", at(x, y), renderer.name());
        }
        assert_eq!([at(0, 0), at(300, 256), at(511, 511)], [0.0; 3]);
    }
}

#[test]
fn a_thousand_opaque_layers_stay_finite() {
    for mut renderer in renderers() {
        let means: Vec<[f32; 3]> = (0..1000).map(|i| [0.0, 0.0, 1.0 + 1e-3 * i as f32]).collect();
        let (picture, _) = drawn(&mut *renderer, &gaussians(&means, 20.0), &camera(48, 32));
        let middle = picture[16 * 48 + 24];
        assert!((middle - 0.5).abs() < 1e-3, "grey through and through, not {middle}, on {}", renderer.name());
    }
}

#[test]
fn gaussians_of_one_depth_are_blended_in_the_order_of_their_rows() {
    for mut renderer in renderers() {
        let mut rows = gaussians(&[[0.0, 0.0, 1.0]; 2], 2.0);
        let mut first_is_red = |red: usize| {
            rows.sh0 = vec![-1.7; 6];
            rows.sh0[3 * red] = 1.7;
            rows.sh0[3 * (1 - red) + 2] = 1.7;
            let (picture, _) = drawn(&mut *renderer, &rows, &camera(48, 32));
            picture[16 * 48 + 24] > picture[2 * 48 * 32 + 16 * 48 + 24]
        };
        assert!(first_is_red(0) && !first_is_red(1));
    }
}

#[test]
fn rows_do_not_move_into_the_past_nor_without_end() {
    let rates = Rates {
        means: 1e-2,
        means_final_factor: 0.01,
        others_final_factor: 0.1,
        scales: 5e-3,
        quats: 1e-3,
        opacities: 5e-2,
        sh0: 2.5e-3,
        sh_n: 1e-4,
        steps: 1000,
    };
    let drift = DriftTables::new(rates, AdamConfig::default());
    for of_means in [false, true] {
        let moved = |stamp: u32, now: u32| drift.movement([1e-3, 1e-6], stamp, now, of_means);
        for stamp in [0, 1, 7, 1000, u32::MAX] {
            assert_eq!([moved(stamp, stamp), moved(stamp, 0), moved(stamp, stamp / 2)], [0.0; 3], "stamp {stamp}");
        }
        // At a ratio of 1 a row moves r / (1 - r) = 9 rates at most; at the first steps the correction of the moments adds to it.
        for (stamp, now) in [(1, 2), (1, 4), (1, u32::MAX), (999, 10_000_000), (10_000_000, u32::MAX)] {
            let far = moved(stamp, now).abs();
            assert!(far > 0.0 && far < 100.0, "from {stamp} to {now}: {far} rates");
        }
    }
}
