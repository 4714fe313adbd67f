//! Projection, forward and backward, against the float64 reference.
//!
//! The fixtures hold linear scales and opacities, so the row functions get these values. The stages read logs and
//! logits and are compared with a margin for the rounding of that conversion.

use crate::support::fixture::Fixture;
use crate::support::random_rotation;
use crate::support::reference64::{Rows64, Settings, project};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::kernels::project_bwd::{GeometryGradient, geometry_vjp, project_bwd};
use gsscale::kernels::project_fwd::{Footprint, Geometry, Projected, View, footprint, geometry, project_fwd};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;

const EPS2D: f32 = 0.3;
const FILES: [&str; 6] = ["random", "near", "needles", "offaxis", "quats", "scales"];

/// The reference run in f32 is 1e-7 to 3e-7 of the largest value off; the README beside the files suggests 2e-6.
const FORWARD_REL_MAX: f64 = 2e-6;
/// Close to the camera x/z divides by depths rounded in f32; suggested 1e-4.
const FORWARD_NEAR_REL_MAX: f64 = 1e-4;
/// Ordinary conics: the reference in f32 is 1e-6 off; suggested 1e-5.
const CONIC_REL: f64 = 1e-5;
/// Needles, with the determinant from minors: the README reports 1e-5 at most, times 5 for other roundings.
const CONIC_NEEDLE_REL: f64 = 5e-5;
/// The reference in f32 has 99 % of the rows' gradients below 5e-5 and all below 1e-4, needles and near rows excepted;
/// here those are within it too (5e-5 at most), so twice that is asked of all: tighter than the README suggests.
const GRADIENT_99: f64 = 1e-4;
const GRADIENT_MAX: f64 = 2e-4;
/// A box size that is within this of a whole number, relative to itself, may round either way in f32. The size is a
/// root of a variance, so its error is half of the variance's: [`FORWARD_REL_MAX`], close to the camera
/// [`FORWARD_NEAR_REL_MAX`].
const CEIL_REL: f64 = FORWARD_REL_MAX / 2.0;
const CEIL_NEAR_REL: f64 = FORWARD_NEAR_REL_MAX / 2.0;

/// Conics of stored columns: ln(scale) is up to 10 here, so rounding it to f32 moves the scale by 5e-7 relative and a
/// covariance by twice that.
const STORED_CONIC_REL: f64 = 2e-5;

struct Scene {
    file: Fixture,
    camera: Camera,
    rows: usize,
}

impl Scene {
    fn open(name: &str) -> Option<Scene> {
        let file = Fixture::open(&format!("projection_{name}"))?;
        let camera = file.camera();
        let rows = file.shape("means")[0];
        Some(Scene { file, camera, rows })
    }

    fn vector<const W: usize>(&self, name: &str, row: usize) -> [f64; W] {
        self.file.f64(name)[row * W..(row + 1) * W].try_into().unwrap()
    }

    fn input<const W: usize>(&self, name: &str, row: usize) -> [f32; W] {
        self.vector::<W>(name, row).map(|x| x as f32)
    }

    fn geometry(&self, view: &View, row: usize) -> Geometry {
        geometry(view, self.input("means", row), self.input("quats", row), self.input("scales", row))
    }

    fn footprint(&self, view: &View, row: usize) -> Footprint {
        footprint(view, &self.geometry(view, row), self.input::<1>("opacities", row)[0])
    }

    fn gradient(&self, view: &View, row: usize) -> GeometryGradient {
        let g = self.geometry(view, row);
        geometry_vjp(view, &g, self.input("v_means2d", row), self.input("v_conics", row))
    }

    fn visible(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.rows).filter(|&r| self.file.f64("visible")[r] != 0.0)
    }

    /// The rows as they are stored: logs and logits, rounded once from f64.
    fn columns(&self) -> Columns {
        let log = |x: &f64| libm::log(*x) as f32;
        let logit = |x: &f64| libm::log(x / (1.0 - x)) as f32;
        let f = &self.file;
        Columns {
            sh_degree: 0,
            means: f.f32("means"),
            quats: f.f32("quats"),
            scales: f.f64("scales").iter().map(log).collect(),
            opacities: f.f64("opacities").iter().map(logit).collect(),
            sh0: vec![0.0; 3 * self.rows],
            sh_n: Vec::new(),
        }
    }
}

fn norm(x: &[f64]) -> f64 {
    x.iter().map(|v| v * v).sum::<f64>().sqrt()
}

fn distance<const W: usize>(got: [f32; W], want: [f64; W]) -> f64 {
    norm(&std::array::from_fn::<f64, W, _>(|i| f64::from(got[i]) - want[i]))
}

#[test]
fn visibility_and_boxes_agree() {
    for name in FILES {
        let Some(scene) = Scene::open(name) else { return };
        let view = View::new(&scene.camera, EPS2D);
        let margin = if name == "near" { CEIL_NEAR_REL } else { CEIL_REL };
        let mut compared = 0;
        for row in 0..scene.rows {
            let want = scene.vector::<2>("radii_opacity", row);
            let real = scene.vector::<2>("radii_opacity_real", row);
            if real.iter().any(|r| (r - r.round()).abs() < margin * r) {
                continue;
            }
            let got = scene.footprint(&view, row);
            assert_eq!(got.radii.map(f64::from), want, "{name} row {row}: radii");
            assert_eq!(got.visible, scene.file.f64("visible")[row] != 0.0, "{name} row {row}: visible");
            compared += 1;
        }
        assert!(10 * compared > 9 * scene.rows, "{name}: only {compared} of {} rows compared", scene.rows);
    }
}

/// A camera of some size that looks at the origin's surroundings from a random side.
fn random_camera(draws: &mut Stream, width: u32, height: u32) -> Camera {
    let rotation = random_rotation(draws);
    let mut viewmat = [[0.0f32; 4]; 3];
    for i in 0..3 {
        for j in 0..3 {
            viewmat[i][j] = rotation[i][j] as f32;
        }
        viewmat[i][3] = draws.normal() as f32;
    }
    let focal = f64::from(width) * draws.range(0.7, 1.5);
    let off = |size: u32, draws: &mut Stream| (f64::from(size) * draws.range(0.4, 0.6)) as f32;
    let principal = [off(width, draws), off(height, draws)];
    Camera::pinhole(viewmat, [focal as f32, (focal * 1.02) as f32, principal[0], principal[1]], [width, height])
}

/// Rows in front of a camera, of 0.1 to 400 pixels and all shapes down to 1:20, some beyond the picture's edges.
fn random_rows(draws: &mut Stream, camera: &Camera, rows: usize) -> Columns {
    let mut columns = Columns::zeros(rows, 0);
    let m = camera.viewmat.map(|r| r.map(f64::from));
    for row in 0..rows {
        let z = libm::exp(draws.range(libm::log(0.5), libm::log(50.0)));
        let size = [camera.width, camera.height].map(f64::from);
        let focal = f64::from(camera.fx);
        let slopes = size.map(|s| draws.range(-0.65, 0.65) * s / focal);
        let p = [slopes[0] * z - m[0][3], slopes[1] * z - m[1][3], z - m[2][3]];
        let largest = libm::log(draws.range(0.1, 1.0) * 400.0 * z / focal) - draws.range(0.0, 6.0);
        for c in 0..3 {
            columns.means[3 * row + c] = (0..3).map(|i| m[i][c] * p[i]).sum::<f64>() as f32;
            columns.scales[3 * row + c] = (largest - draws.range(0.0, 3.0)) as f32;
        }
        (0..4).for_each(|c| columns.quats[4 * row + c] = draws.normal() as f32);
        columns.opacities[row] = (2.0 * draws.normal()) as f32;
    }
    columns
}

/// The stage on stored columns, on rows and cameras of many seeds and sizes, against the plain renderer in f64.
#[test]
fn projections_of_other_seeds_agree() {
    const ROWS: usize = 2000;
    let settings = Settings { sh_degree: 0, max_alpha: 0.99, eps2d: f64::from(EPS2D), background: [0.0; 3] };
    for (seed, [width, height]) in
        [[64, 48], [333, 500], [640, 480], [1920, 1080], [4096, 3000]].into_iter().enumerate()
    {
        let mut draws = Stream::new(seed as u64, Purpose::Test, 0, 0);
        let camera = random_camera(&mut draws, width, height);
        let rows = random_rows(&mut draws, &camera, ROWS);
        let mut projected = Projected::default();
        project_fwd(&rows, &camera, EPS2D, SimdPath::best(), 0, &mut projected);
        let rows = Rows64::new(&rows);
        let (mut compared, mut drawn, mut largest, mut worst) = (0, 0, 0, [0.0f64; 3]);
        for row in 0..ROWS {
            let Some(want) = project(&rows, &camera, &settings, row) else { continue };
            let is_faint = 255.0 * want.opacity <= 1.0 + 1e-6;
            let reach = libm::sqrt(2.0 * libm::log(255.0 * want.opacity).max(0.0)).min(3.33);
            let sizes = want.variances.map(|v| reach * v.sqrt());
            let got = projected.radii[row];
            if got == [0, 0] {
                // Left out: too faint, or beside the picture by all but a rounding of its box.
                let beside = |i: usize, size: u32| {
                    let [low, high] = [-1.0, 1.0].map(|side| want.mean2d[i] + side * sizes[i].ceil());
                    high < 1e-3 || low > f64::from(size) - 1e-3
                };
                assert!(is_faint || beside(0, width) || beside(1, height), "seed {seed} row {row}: {want:?}");
                continue;
            }
            drawn += 1;
            // The logarithm is of an opacity in f32, and its error large beside it where that is close to 1/255.
            let margin = CEIL_REL + 1e-6 / libm::log(255.0 * want.opacity);
            if sizes.iter().all(|r| (r - r.round()).abs() >= margin * r) {
                assert_eq!(got.map(f64::from), sizes.map(f64::ceil), "seed {seed} row {row}: {sizes:?}");
                compared += 1;
                largest = largest.max(got[0].max(got[1]));
            }
            let extent = f64::from(width.max(height));
            let errors = [
                distance(projected.means2d[row], want.mean2d) / extent,
                (f64::from(projected.depths[row]) - want.depth).abs() / want.depth.max(1.0),
                distance(projected.conics[row], want.conic) / norm(&want.conic),
            ];
            worst = std::array::from_fn(|i| worst[i].max(errors[i]));
        }
        println!("{width}x{height}: {compared} of {drawn} boxes, up to {largest} px; worst {worst:?}");
        assert!(drawn > ROWS / 2 && 10 * compared > 9 * drawn, "seed {seed}: {compared} of {drawn} boxes compared");
        assert!(largest > width.min(640) / 2, "seed {seed}: no large box");
        let limits = [FORWARD_REL_MAX, FORWARD_REL_MAX, STORED_CONIC_REL];
        assert!(worst.iter().zip(limits).all(|(error, limit)| *error < limit), "seed {seed}: {worst:?}");
    }
}

#[test]
fn positions_depths_and_covariances_agree() {
    for name in FILES {
        let Some(scene) = Scene::open(name) else { return };
        let view = View::new(&scene.camera, EPS2D);
        let limit = if name == "near" { FORWARD_NEAR_REL_MAX } else { FORWARD_REL_MAX };
        let largest = |tensor: &str, width: usize| -> f64 {
            let v = scene.file.f64(tensor);
            scene.visible().flat_map(|r| &v[r * width..(r + 1) * width]).fold(0.0, |m, x| m.max(x.abs()))
        };
        let (max2d, max_depth, max_cov) = (largest("means2d", 2), largest("depths", 1), largest("cov2d", 3));
        for row in scene.visible() {
            let f = scene.footprint(&view, row);
            let cov = scene.geometry(&view, row).cov2d;
            let errors = [
                distance(f.mean2d, scene.vector("means2d", row)) / max2d,
                distance([f.depth], scene.vector("depths", row)) / max_depth,
                distance(cov, scene.vector("cov2d", row)) / max_cov,
            ];
            assert!(errors.iter().all(|e| *e < limit), "{name} row {row}: {errors:?}");
        }
    }
}

#[test]
fn conics_agree() {
    for name in FILES {
        let Some(scene) = Scene::open(name) else { return };
        let view = View::new(&scene.camera, EPS2D);
        for row in scene.visible() {
            let cond = scene.vector::<1>("cond", row)[0];
            let limit = match name {
                "near" => FORWARD_NEAR_REL_MAX,
                _ if cond < 20.0 => CONIC_REL,
                _ => CONIC_NEEDLE_REL,
            };
            let want = scene.vector::<3>("conics", row);
            let error = distance(scene.footprint(&view, row).conic, want) / norm(&want);
            assert!(error < limit, "{name} row {row}: conic off by {error:e}, condition {cond:e}");
        }
    }
}

/// Errors of rows, relative to the row plus a thousandth of the root mean square of all, sorted.
fn row_errors<const W: usize>(scene: &Scene, tensor: &str, got: impl Fn(usize) -> [f32; W]) -> Vec<f64> {
    let rows: Vec<usize> = scene.visible().collect();
    let squares: f64 = rows.iter().map(|&r| norm(&scene.vector::<W>(tensor, r)).powi(2)).sum();
    let rms = (squares / rows.len() as f64).sqrt();
    let relative = |&r: &usize| {
        let want = scene.vector::<W>(tensor, r);
        distance(got(r), want) / (norm(&want) + 1e-3 * rms)
    };
    let mut errors: Vec<f64> = rows.iter().map(relative).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

fn check_errors(what: &str, errors: &[f64]) {
    let at = |q: f64| errors[((errors.len() - 1) as f64 * q) as usize];
    println!("{what}: median {:.1e}, 99 % {:.1e}, max {:.1e}", at(0.5), at(0.99), at(1.0));
    assert!(at(0.99) < GRADIENT_99 && at(1.0) < GRADIENT_MAX, "{what}: 99 % {:e}, max {:e}", at(0.99), at(1.0));
}

#[test]
fn gradients_agree_needles_included() {
    for name in FILES {
        let Some(scene) = Scene::open(name) else { return };
        let view = View::new(&scene.camera, EPS2D);
        let grads: Vec<GeometryGradient> = (0..scene.rows).map(|r| scene.gradient(&view, r)).collect();
        check_errors(&format!("{name} means"), &row_errors(&scene, "g_means", |r| grads[r].mean));
        check_errors(&format!("{name} quats"), &row_errors(&scene, "g_quats", |r| grads[r].quat));
        check_errors(&format!("{name} scales"), &row_errors(&scene, "g_log_scales", |r| grads[r].log_scale));
    }
}

#[test]
fn each_upstream_alone_agrees() {
    for name in FILES {
        let Some(scene) = Scene::open(name) else { return };
        let view = View::new(&scene.camera, EPS2D);
        let vjp = |r: usize, by_mean: bool| {
            let (zero2, zero3) = ([0.0; 2], [0.0; 3]);
            let v_mean = if by_mean { scene.input("v_means2d", r) } else { zero2 };
            let v_conic = if by_mean { zero3 } else { scene.input("v_conics", r) };
            geometry_vjp(&view, &scene.geometry(&view, r), v_mean, v_conic)
        };
        check_errors(&format!("{name} m2d"), &row_errors(&scene, "g_m2d_means", |r| vjp(r, true).mean));
        check_errors(&format!("{name} conic"), &row_errors(&scene, "g_conic_means", |r| vjp(r, false).mean));
        check_errors(&format!("{name} conic quats"), &row_errors(&scene, "g_conic_quats", |r| vjp(r, false).quat));
    }
}

#[test]
fn stages_on_stored_columns_agree() {
    for name in ["random", "quats", "scales"] {
        let Some(scene) = Scene::open(name) else { return };
        let rows = scene.columns();
        let mut projected = Projected::default();
        project_fwd(&rows, &scene.camera, EPS2D, SimdPath::best(), 0, &mut projected);
        let wanted = |tensor: &str| scene.file.f32(tensor);
        let v_means2d = wanted("v_means2d").as_chunks::<2>().0.to_vec();
        let v_conics = wanted("v_conics").as_chunks::<3>().0.to_vec();
        let v_opacities = vec![1.0; scene.rows];
        let mut grads = Columns::zeros(scene.rows, 0);
        grads.means.fill(5.0);
        let (camera, simd) = (&scene.camera, SimdPath::best());
        project_bwd(&rows, camera, EPS2D, &projected.radii, &v_means2d, &v_conics, &v_opacities, simd, &mut grads);
        let mut culled = 0;
        for row in 0..scene.rows {
            let opacity = scene.vector::<1>("opacities", row)[0];
            if projected.radii[row] == [0, 0] {
                assert_eq!(scene.file.f64("visible")[row], 0.0, "{name} row {row}: culled");
                assert_eq!(&grads.means[3 * row..3 * row + 3], &[5.0; 3]);
                assert_eq!(&grads.quats[4 * row..4 * row + 4], &[0.0; 4]);
                assert_eq!(&grads.scales[3 * row..3 * row + 3], &[0.0; 3]);
                assert_eq!(grads.opacities[row], 0.0);
                culled += 1;
                continue;
            }
            let want = scene.vector::<3>("conics", row);
            let error = distance(projected.conics[row], want) / norm(&want);
            assert!(error < STORED_CONIC_REL, "{name} row {row}: {error:e}");
            assert!((f64::from(projected.opacities[row]) - opacity).abs() < 1e-6, "{name} row {row}: opacity");
            // Rounding the logit (up to about 5) moves it by 3e-7, and the slope by less.
            assert!((f64::from(grads.opacities[row]) - opacity * (1.0 - opacity)).abs() < 1e-6);
        }
        let at = |column: &[f32], row: usize| -> [f32; 3] { column[3 * row..3 * row + 3].try_into().unwrap() };
        // The 5 that was there first stays: gradients are added to it.
        let added = |r: usize| at(&grads.means, r).map(|g| g - 5.0);
        let rms = norm(scene.file.f64("g_means")) / (scene.rows as f64).sqrt();
        for r in scene.visible() {
            let want = scene.vector::<3>("g_means", r);
            // 5 + g is rounded to half an ulp of the sum.
            let limit = GRADIENT_MAX * (norm(&want) + 1e-3 * rms) + 1e-6;
            assert!(distance(added(r), want) < limit, "{name} row {r}: means");
        }
        check_errors(&format!("{name} stored scales"), &row_errors(&scene, "g_log_scales", |r| at(&grads.scales, r)));
        assert!(culled < scene.rows, "{name}: everything was culled");
    }
}
