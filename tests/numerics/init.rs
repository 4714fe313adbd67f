//! First Gaussians: gsplat's scales on ordinary point clouds, finite and positive scales on degenerate ones.

use gsscale::base::rng::{Purpose, Stream};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::init::{InitOptions, SH_C0, gaussians_from_points, random_points_in_frusta};

fn cloud(n: u64) -> Vec<[f32; 3]> {
    let point = |i| {
        let mut s = Stream::new(1, Purpose::Test, i, 0);
        std::array::from_fn(|_| s.normal() as f32)
    };
    (0..n).map(point).collect()
}

fn init(points: &[[f32; 3]], options: &InitOptions) -> Columns {
    let columns = gaussians_from_points(points, &vec![[10, 128, 255]; points.len()], options);
    for column in Column::ALL {
        assert_eq!(columns.column(column).len(), columns.rows() * column.width(options.sh_degree));
        assert!(columns.column(column).iter().all(|v| v.is_finite()), "{column:?}");
    }
    columns
}

#[test]
fn ordinary_clouds_start_as_gsplat_starts_them() {
    let points = cloud(400);
    let options = InitOptions { scale_factor: 0.5, seed: 9, ..InitOptions::default() };
    let columns = init(&points, &options);
    assert_eq!(columns.means, points.as_flattened());
    for (row, p) in points.iter().enumerate() {
        let dist2 = |q: &[f32; 3]| (0..3).map(|i| (f64::from(p[i]) - f64::from(q[i])).powi(2)).sum::<f64>();
        let mut all: Vec<f64> = points.iter().map(dist2).collect();
        all.sort_by(f64::total_cmp);
        let want = (((all[1] + all[2] + all[3]) / 3.0).sqrt() * 0.5).ln();
        for &scale in columns.row(Column::Scales, row) {
            // f32 squares are within 4e-7 of themselves, half of that in the log; then one rounding of values below 8.
            assert!((f64::from(scale) - want).abs() < 7e-7, "{scale} {want}");
        }
        let norm2: f64 = columns.row(Column::Quats, row).iter().map(|&v| f64::from(v).powi(2)).sum();
        // Four squares, each within 1.2e-7 of itself.
        assert!((norm2 - 1.0).abs() < 2.5e-7);
        for (sh0, byte) in columns.row(Column::Sh0, row).iter().zip([10.0, 128.0, 255.0]) {
            // One rounding of values below 2.
            assert!((f64::from(*sh0) * SH_C0 + 0.5 - byte / 255.0).abs() < 1e-7);
        }
        let opacity = 1.0 / (1.0 + (-f64::from(columns.opacities[row])).exp());
        // One rounding of the logit -2.197 (1.2e-7) times the slope 0.09.
        assert!((opacity - 0.1).abs() < 2e-8);
    }
    assert!(columns.sh_n.iter().all(|&v| v == 0.0));
}

#[test]
fn rotations_are_uniform_and_follow_the_seed() {
    let points = cloud(20_000);
    let first = init(&points, &InitOptions { sh_degree: 0, ..InitOptions::default() });
    let other = init(&points, &InitOptions { sh_degree: 0, seed: 1, ..InitOptions::default() });
    assert_eq!(first.means, other.means);
    assert_ne!(first.quats, other.quats);
    for i in 0..4 {
        let of = |power: i32| first.quats.chunks(4).map(|q| f64::from(q[i]).powi(power)).sum::<f64>() / 20_000.0;
        // Moments of a coordinate of the 4-sphere: 0, 1/4, 0, 1/8. Five standard errors: 5 sqrt(var / 20,000) with
        // var = 1/4, and 1/8 - 1/16.
        assert!(of(1).abs() < 0.018, "{}", of(1));
        assert!((of(2) - 0.25).abs() < 0.009, "{}", of(2));
    }
}

#[test]
fn degenerate_clouds_get_sane_scales() {
    let options = InitOptions { scene_scale: 2.0, ..InitOptions::default() };
    assert_eq!(init(&[], &options).rows(), 0);
    for points in [vec![[0.0; 3]], vec![[7.0, -1.0, 3.0]; 200]] {
        let columns = init(&points, &options);
        assert_eq!(columns.rows(), points.len());
        // One point has no neighbours: 0.01 scene scales.
        assert!(columns.scales.iter().all(|s| (s - 0.02f32.ln()).abs() < 1e-6));
    }
    // Two and three points: the mean over the existing neighbours.
    let pair = init(&[[0.0; 3], [0.0, 0.5, 0.0]], &options);
    assert!(pair.scales.iter().all(|s| (s - 0.5f32.ln()).abs() < 1e-6));
    // Five coincident points in an ordinary cloud get its median distance.
    let mut points = cloud(200);
    points.extend([points[0]; 4]);
    let columns = init(&points, &options);
    let lone = columns.row(Column::Scales, 0)[0];
    assert_eq!(lone, columns.row(Column::Scales, 203)[0]);
    let mut all: Vec<f32> = (0..204).map(|row| columns.row(Column::Scales, row)[0]).collect();
    all.sort_by(f32::total_cmp);
    assert!(all[60] < lone && lone < all[140], "{lone}");
    // The limits of scales, in scene scales.
    let spread = init(&[[0.0; 3], [1e-9, 0.0, 0.0], [1e6, 0.0, 0.0]], &options);
    let near_ln = |scale: f32, x: f32| (scale - x.ln()).abs() < 1e-6;
    assert!(near_ln(spread.row(Column::Scales, 2)[0], 20.0), "{:?}", spread.scales);
    let tight = init(&[[0.0; 3], [1e-9, 0.0, 0.0]], &options);
    assert!(near_ln(tight.row(Column::Scales, 0)[0], 2e-6), "{:?}", tight.scales);
}

#[test]
fn points_that_are_not_finite_get_no_row() {
    let mut points = cloud(50);
    points[3][1] = f32::NAN;
    points[20][0] = f32::INFINITY;
    points[21] = [1e30; 3];
    let columns = init(&points, &InitOptions::default());
    assert_eq!(columns.rows(), 48);
    assert_eq!(columns.row(Column::Means, 3), points[4]);
}

#[test]
fn too_many_points_are_thinned_the_same_way_every_time() {
    let points = cloud(5000);
    let options = InitOptions { max_gaussians: Some(1000), sh_degree: 1, ..InitOptions::default() };
    let columns = init(&points, &options);
    assert_eq!(columns.rows(), 1000);
    assert_eq!(columns, init(&points, &options));
    let index_of = |mean: &[f32]| points.iter().position(|p| p == mean).unwrap();
    let kept: Vec<usize> = columns.means.chunks(3).map(index_of).collect();
    assert!(kept.is_sorted());
    // Uniform: the first half holds 500 of them within five standard deviations of the hypergeometric draw (14.1).
    let first_half = kept.iter().filter(|&&i| i < 2500).count();
    assert!((430..570).contains(&first_half), "{first_half}");
    let reseeded = init(&points, &InitOptions { seed: 4, ..options });
    assert_ne!(reseeded.means, columns.means);
    // Scales belong to the thinner cloud: those of the full one would be smaller by about the cube root of 5.
    let mean = |c: &Columns| c.scales.iter().map(|&s| f64::from(s)).sum::<f64>() / c.scales.len() as f64;
    let full = init(&points, &InitOptions { sh_degree: 1, ..InitOptions::default() });
    let growth = mean(&columns) - mean(&full);
    assert!((growth - 5f64.ln() / 3.0).abs() < 0.1, "{growth}");
}

#[test]
fn points_in_frusta_are_seen() {
    let turned = [[0.0, 0.0, -1.0, 2.0], [0.0, 1.0, 0.0, -3.0], [1.0, 0.0, 0.0, 5.0]];
    let straight = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let camera = |viewmat| Camera::pinhole(viewmat, [300.0, 310.0, 200.0, 90.0], [400, 200]);
    let sees = |c: &Camera, p: &[f32; 3]| {
        let at = |r: usize| c.viewmat[r][0] * p[0] + c.viewmat[r][1] * p[1] + c.viewmat[r][2] * p[2] + c.viewmat[r][3];
        let (u, v, z) = (at(0) / at(2) * c.fx + c.cx, at(1) / at(2) * c.fy + c.cy, at(2));
        // 0.01 px and 1e-4 of depth for the roundings of f32 on the way there and back.
        (-0.01..400.01).contains(&u) && (-0.01..200.01).contains(&v) && (1.9999..30.0001).contains(&z)
    };
    let cameras = [camera(turned), camera(straight)];
    let (points, colors) = random_points_in_frusta(&cameras, 3000, 2.0, 30.0, 5);
    assert_eq!((points.len(), colors.len()), (3000, 3000));
    let by: Vec<usize> = cameras.iter().map(|c| points.iter().filter(|p| sees(c, p)).count()).collect();
    assert!(points.iter().all(|p| cameras.iter().any(|c| sees(c, p))));
    assert!(by[0] > 1300 && by[1] > 1300, "{by:?}");
    // The first points do not depend on how many are drawn.
    assert_eq!(random_points_in_frusta(&cameras, 10, 2.0, 30.0, 5).0, points[..10]);
    assert!(random_points_in_frusta(&[], 10, 2.0, 30.0, 5).0.is_empty());
}
