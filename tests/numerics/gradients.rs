//! Analytic gradients of every column against central finite differences of a second renderer in f64. The second
//! renderer is itself compared with the reference fixtures.
//!
//! Rendering is smooth except where an alpha crosses 1/255 or the clamp, a transmittance crosses its end, a colour
//! crosses 0, a slope crosses the cut of the Jacobian, or two depths cross each other. The second renderer measures the
//! distance of a scene from all these kinks. Scenes are drawn from successive seeds until neither the step nor f32
//! rounding crosses a kink. Contributions below 1/255 are therefore skipped on both sides, and the derivative is that
//! of the rendered function.

use crate::support::fixture::Fixture;
use crate::support::reference64::{Render64, Rows64, Settings, project, render};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::kernels::project_bwd::project_bwd;
use gsscale::kernels::project_fwd::{Projected, project_fwd};
use gsscale::kernels::sh_bwd::sh_bwd;
use gsscale::kernels::sh_fwd::sh_fwd;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{Gradients, PictureGradient, RenderOptions, Renderer};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};

/// Step of the differences. Their truncation is h^2 times third derivatives (1e-10 relative here), their rounding
/// 1e-16 |loss| / h (1e-7 relative for losses up to 200 times a gradient).
const STEP: f64 = 2e-7;
/// A step of a mean moves it by up to 1e-5 px, which changes an alpha at the rim of the smallest footprint by 1e-5;
/// f32 changes it by less.
const MARGIN_MIN: f64 = 5e-5;
/// Relative L2 error of a column: about ten times the error of f32 (2e-6 at most here).
const COLUMN_L2: f64 = 2e-5;
/// Error of a row relative to itself plus a thousandth of the root mean square. f32 leaves 1e-5; opacities near 1 have
/// tiny gradients, and the rounding of the differences leaves 3e-4 of these.
const ROW_MAX: f64 = 1e-3;

pub(super) fn camera() -> Camera {
    // A product of two rotations by 3-4-5 angles: orthonormal up to the rounding of its entries.
    let viewmat = [[0.8, 0.0, -0.6, 0.25], [0.36, 0.8, 0.48, -0.125], [0.48, -0.6, 0.64, 4.0]];
    Camera::pinhole(viewmat, [30.0, 28.0, 16.5, 11.0], [32, 24])
}

pub(super) struct Recipe {
    rows: usize,
    stored_degree: u8,
    sh_degree: u8,
    log_scales: [f64; 2],
    logits: [f64; 2],
    max_alpha: f32,
}

/// Faint, small, all bands.
pub(super) const FAINT: Recipe =
    Recipe { rows: 14, stored_degree: 3, sh_degree: 3, log_scales: [-2.0, -0.4], logits: [-1.5, 1.5], max_alpha: 0.99 };
/// Alphas at their clamp, pixels that end early, bands stored but not in use. The clamp is such that no power of
/// 1 - clamp is near the end of a pixel, 1e-4.
pub(super) const OPAQUE: Recipe =
    Recipe { rows: 20, stored_degree: 2, sh_degree: 1, log_scales: [-1.2, -0.2], logits: [1.0, 5.0], max_alpha: 0.92 };

impl Recipe {
    pub(super) fn options(&self) -> RenderOptions {
        RenderOptions {
            sh_degree: self.sh_degree,
            max_alpha: self.max_alpha,
            eps2d: 0.3,
            background: [0.2, 0.5, 0.7],
            ..RenderOptions::default()
        }
    }

    pub(super) fn settings(&self) -> Settings {
        let o = self.options();
        Settings {
            sh_degree: o.sh_degree,
            max_alpha: f64::from(o.max_alpha),
            eps2d: f64::from(o.eps2d),
            background: o.background.map(f64::from),
        }
    }

    fn draw(&self, seed: u64) -> Columns {
        let mut rng = Stream::new(seed, Purpose::Test, 1, 0);
        let mut rows = Columns::zeros(self.rows, self.stored_degree);
        rows.means.fill_with(|| rng.range(-1.2, 1.2) as f32);
        rows.quats.fill_with(|| rng.normal() as f32);
        rows.scales.fill_with(|| rng.range(self.log_scales[0], self.log_scales[1]) as f32);
        rows.opacities.fill_with(|| rng.range(self.logits[0], self.logits[1]) as f32);
        rows.sh0.fill_with(|| rng.range(-0.5, 1.5) as f32);
        rows.sh_n.fill_with(|| rng.range(-0.4, 0.4) as f32);
        // One wide row beside the image, where the Jacobian's slope is cut: at camera (3.9, 0, 4).
        rows.means[..3].copy_from_slice(&[2.97, 0.1, -2.19]);
        rows.scales[..3].copy_from_slice(&[-0.3, 0.2, 0.0]);
        rows
    }

    /// The scene of the first seed that is far from every discontinuity.
    pub(super) fn scene(&self) -> (Columns, Render64) {
        let candidates = (0..200).map(|seed| {
            let rows = self.draw(seed);
            let picture = render(&Rows64::new(&rows), &camera(), &self.settings());
            (rows, picture)
        });
        candidates.into_iter().find(|(_, picture)| picture.margin > MARGIN_MIN).expect("a scene away from all kinks")
    }
}

fn differences(rows: &Columns, column: Column, loss: impl Fn(&Rows64) -> f64) -> Vec<f64> {
    let mut moved = Rows64::new(rows);
    (0..rows.column(column).len())
        .map(|i| {
            let stored = moved.column_mut(column)[i];
            moved.column_mut(column)[i] = stored + STEP;
            let above = loss(&moved);
            moved.column_mut(column)[i] = stored - STEP;
            let below = loss(&moved);
            moved.column_mut(column)[i] = stored;
            (above - below) / (2.0 * STEP)
        })
        .collect()
}

fn norm(x: impl Iterator<Item = f64>) -> f64 {
    x.map(|v| v * v).sum::<f64>().sqrt()
}

/// Compares `width` values of each row of a column, starting at `first`.
fn compare(what: &str, got: &[f32], want: &[f64], row_width: usize, first: usize, width: usize) {
    let part = |row: usize| row * row_width + first..row * row_width + first + width;
    let rows = want.len() / row_width;
    let error = |r: usize| norm(part(r).map(|i| f64::from(got[i]) - want[i]));
    let size = |r: usize| norm(part(r).map(|i| want[i]));
    let total = norm((0..rows).map(size));
    assert!(total > 1e-2, "{what}: nothing to compare ({total:e})");
    let rms = total / (rows as f64).sqrt();
    let l2 = norm((0..rows).map(error)) / total;
    let worst = (0..rows).map(|r| error(r) / (size(r) + 1e-3 * rms)).fold(0.0, f64::max);
    println!("{what}: column {l2:.1e}, worst row {worst:.1e}");
    assert!(l2 < COLUMN_L2, "{what}: relative L2 error {l2:e}");
    assert!(worst < ROW_MAX, "{what}: worst row {worst:e}");
}

/// Compares all columns, `sh_n` band by band; bands out of use must be exactly 0.
fn compare_all(rows: &Columns, sh_degree: u8, grads: &Columns, loss: impl Fn(&Rows64) -> f64) {
    for column in Column::ALL {
        let want = differences(rows, column, &loss);
        let (got, width) = (grads.column(column), column.width(rows.sh_degree));
        assert_eq!(got.len(), want.len(), "{column:?}");
        if column != Column::ShN {
            compare(&format!("{column:?}"), got, &want, width, 0, width);
            continue;
        }
        for band in 1..=rows.sh_degree {
            let (first, end) = (3 * (usize::from(band).pow(2) - 1), 3 * ((usize::from(band) + 1).pow(2) - 1));
            if band <= sh_degree {
                compare(&format!("shN band {band}"), got, &want, width, first, end - first);
            } else {
                let zero = |row: &[f32]| row[first..end].iter().all(|g| *g == 0.0);
                assert!(got.chunks_exact(width).all(zero), "band {band} is not in use");
            }
        }
    }
}

fn check_pipeline(recipe: &Recipe) -> Render64 {
    let (rows, picture) = recipe.scene();
    let (camera, options, settings) = (camera(), recipe.options(), recipe.settings());
    let pixels = camera.pixels();
    let mut rng = Stream::new(77, Purpose::Test, 2, 0);
    let v_rgb: Vec<f32> = (0..3 * pixels).map(|_| rng.normal() as f32).collect();
    let v_alpha: Vec<f32> = (0..pixels).map(|_| rng.normal() as f32).collect();
    let mut renderer = CpuRenderer::new();
    renderer.draw(&rows, &camera, &options).unwrap();
    let image = renderer.image().unwrap();
    for (i, rgb) in picture.rgb.iter().enumerate() {
        for c in 0..3 {
            // f32 sums of some ten contributions of size 1.
            assert!((f64::from(image.rgb[c * pixels + i]) - rgb[c]).abs() < 1e-5, "pixel {i}");
        }
    }
    let mut grads = Gradients::default();
    *renderer.picture_gradient().unwrap() = PictureGradient::new(v_rgb.clone(), v_alpha.clone());
    renderer.backpropagate(&rows, &mut grads).unwrap();
    let loss = |rows: &Rows64| -> f64 {
        let picture = render(rows, &camera, &settings);
        let of_pixel = |i: usize| {
            let rgb = (0..3).map(|c| f64::from(v_rgb[c * pixels + i]) * picture.rgb[i][c]).sum::<f64>();
            rgb + f64::from(v_alpha[i]) * picture.alpha[i]
        };
        (0..pixels).map(of_pixel).sum()
    };
    compare_all(&rows, recipe.sh_degree, &grads.columns, loss);
    picture
}

#[test]
fn a_faint_scene_has_the_gradients_of_finite_differences() {
    let picture = check_pipeline(&FAINT);
    assert!(picture.blended > 2 * camera().pixels(), "only {} contributions", picture.blended);
}

#[test]
fn an_opaque_scene_has_the_gradients_of_finite_differences() {
    let picture = check_pipeline(&OPAQUE);
    assert!(picture.clamped > 10, "{} clamped contributions", picture.clamped);
    assert!(picture.ended > 10, "{} pixels ended early", picture.ended);
}

/// The per-row stages alone: every row has its own random upstream, so an error in one output cannot hide in a sum
/// over pixels.
#[test]
fn projection_and_colours_have_the_gradients_of_finite_differences() {
    let (rows, _) = FAINT.scene();
    let (camera, settings, simd) = (camera(), FAINT.settings(), SimdPath::best());
    let (n, degree) = (rows.rows(), FAINT.sh_degree);
    let (mut projected, mut colors) = (Projected::default(), vec![[0.0; 3]; n]);
    project_fwd(&rows, &camera, 0.3, simd, 0, &mut projected);
    let radii = &projected.radii;
    sh_fwd(&rows, &camera, degree, radii, simd, &mut colors);
    assert!(radii.iter().all(|r| *r != [0, 0]), "every row is drawn");
    let mut rng = Stream::new(78, Purpose::Test, 3, 0);
    let mut draw = || rng.normal() as f32;
    let v_means2d: Vec<[f32; 2]> = (0..n).map(|_| std::array::from_fn(|_| draw())).collect();
    // Conics are some 0.1 px^-2: a larger upstream makes their part of the gradient as large as the others'.
    let v_conics: Vec<[f32; 3]> = (0..n).map(|_| std::array::from_fn(|_| 100.0 * draw())).collect();
    let v_colors: Vec<[f32; 3]> = (0..n).map(|_| std::array::from_fn(|_| 10.0 * draw())).collect();
    let v_opacities: Vec<f32> = (0..n).map(|_| draw()).collect();
    let mut grads = Columns::default();
    sh_bwd(&rows, &camera, degree, radii, &colors, &v_colors, simd, &mut grads);
    project_bwd(&rows, &camera, 0.3, radii, &v_means2d, &v_conics, &v_opacities, simd, &mut grads);
    let weigh = |v: &[f32], x: &[f64]| v.iter().zip(x).map(|(v, x)| f64::from(*v) * x).sum::<f64>();
    let loss = |rows: &Rows64| -> f64 {
        let of_row = |r: usize| {
            let s = project(rows, &camera, &settings, r).expect("in front of the camera");
            let geometry = weigh(&v_means2d[r], &s.mean2d) + weigh(&v_conics[r], &s.conic);
            geometry + weigh(&v_colors[r], &s.color) + f64::from(v_opacities[r]) * s.opacity
        };
        (0..n).map(of_row).sum()
    };
    compare_all(&rows, degree, &grads, loss);
}

/// The fixtures give linear scales and opacities; their logs are exact enough in f64.
fn fixture_rows(file: &Fixture) -> Rows64 {
    let n = file.shape("means")[0];
    let coefficients = file.shape("sh")[1];
    let degree = (1..=4).find(|d| d * d == coefficients).unwrap() - 1;
    let mut rows = Rows64::new(&Columns::zeros(n, degree as u8));
    let sh = file.f64("sh").chunks_exact(3 * coefficients);
    *rows.column_mut(Column::Means) = file.f64("means").to_vec();
    *rows.column_mut(Column::Quats) = file.f64("quats").to_vec();
    *rows.column_mut(Column::Scales) = file.f64("scales").iter().map(|s| libm::log(*s)).collect();
    *rows.column_mut(Column::Opacities) = file.f64("opacities").iter().map(|o| libm::log(o / (1.0 - o))).collect();
    *rows.column_mut(Column::Sh0) = sh.clone().flat_map(|row| row[..3].to_vec()).collect();
    *rows.column_mut(Column::ShN) = sh.flat_map(|row| row[3..].to_vec()).collect();
    rows
}

#[test]
fn the_second_renderer_draws_the_fixtures() {
    for name in ["single", "small", "odd_bg", "white_bg", "stress"] {
        let Some(file) = Fixture::open(&format!("raster_{name}")) else { return };
        let camera = file.camera();
        let settings = Settings {
            sh_degree: file.metadata["sh_degree"].parse().unwrap(),
            max_alpha: file.metadata["max_alpha"].parse().unwrap(),
            eps2d: 0.3,
            background: file.f64("background").try_into().unwrap(),
        };
        let picture = render(&fixture_rows(&file), &camera, &settings);
        let ambiguous = file.f64("ambiguous");
        let error = |got: f64, want: f64| (got - want).abs() / want.abs().max(1.0);
        let mut worst = 0f64;
        for i in (0..camera.pixels()).filter(|&i| ambiguous[i] == 0.0) {
            worst = worst.max(error(picture.alpha[i], file.f64("alpha")[i]));
            for c in 0..3 {
                worst = worst.max(error(picture.rgb[i][c], file.f64("rgb")[3 * i + c]));
            }
        }
        println!("{name}: {worst:.1e}");
        // Both are f64; the file is rounded to f32, half an ulp of which is 6e-8. "stress" has a row a few hundredths
        // in front of the camera, whose viewing direction shows that the reference takes the camera's centre from the
        // inverse of the pose and this project from the transpose (1e-7 apart, the rotation being rounded to f32).
        let limit = if name == "stress" { 2e-6 } else { 1e-7 };
        assert!(worst < limit, "{name}: off by {worst:e}");
    }
}
