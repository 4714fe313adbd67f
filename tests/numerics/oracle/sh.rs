//! Spherical harmonics, forward and backward, against the float64 reference.

use crate::support::fixture::Fixture;
use gsscale::base::simd::SimdPath;
use gsscale::kernels::project_fwd::View;
use gsscale::kernels::sh_bwd::sh_bwd;
use gsscale::kernels::sh_fwd::{basis_len, sh_basis, sh_fwd, viewing_direction};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;

/// The reference run in f32 is off by 3e-7 (colours absolute, gradients relative to the largest); suggested 2e-6.
const TOLERANCE: f64 = 2e-6;

/// A camera at the origin, so that a row's mean is its viewing direction.
fn camera_at_origin() -> Camera {
    Camera::pinhole([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], [1.0, 1.0, 0.0, 0.0], [1, 1])
}

/// Rows of the fixture stored with `stored` bands, the bands above the fixture's own filled with a value that must
/// not be used.
fn rows_of(file: &Fixture, degree: u8, stored: u8) -> Columns {
    let n = file.shape("dirs")[0];
    let k = basis_len(degree);
    let coeffs = file.f32("coeffs");
    let mut rows = Columns::zeros(n, stored);
    rows.sh_n.fill(7.0);
    rows.means = file.f32("dirs");
    let width = 3 * (basis_len(stored) - 1);
    for r in 0..n {
        let own = &coeffs[r * 3 * k..(r + 1) * 3 * k];
        rows.sh0[3 * r..3 * r + 3].copy_from_slice(&own[..3]);
        rows.sh_n[r * width..][..3 * (k - 1)].copy_from_slice(&own[3..]);
    }
    rows
}

fn assert_close(what: &str, got: impl Iterator<Item = f32>, want: &[f64], scale: f64) {
    let got: Vec<f32> = got.collect();
    assert_eq!(got.len(), want.len(), "{what}");
    let worst = got.iter().zip(want).map(|(g, w)| (f64::from(*g) - w).abs() / scale).fold(0.0, f64::max);
    println!("{what}: {worst:.1e}");
    assert!(worst < TOLERANCE, "{what}: off by {worst:e}");
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(1e-300, |m, x| m.max(x.abs()))
}

#[test]
fn the_basis_agrees() {
    let at_origin = View::new(&camera_at_origin(), 0.0);
    for degree in 0..=3u8 {
        let Some(file) = Fixture::open(&format!("sh_deg{degree}")) else { return };
        let dirs = file.f32("dirs");
        let k = basis_len(degree);
        let basis = dirs.as_chunks::<3>().0.iter().flat_map(|d| {
            let b = sh_basis(degree, viewing_direction(&at_origin, *d).0);
            assert!(b[k..].iter().all(|x| *x == 0.0), "bands above {degree} are zero");
            b.into_iter().take(k)
        });
        assert_close(&format!("basis {degree}"), basis, file.f64("basis"), 1.0);
    }
}

#[test]
fn colours_and_gradients_agree() {
    for degree in 0..=3u8 {
        let Some(file) = Fixture::open(&format!("sh_deg{degree}")) else { return };
        for stored in degree..=3 {
            compare(&file, degree, stored);
        }
    }
}

fn compare(file: &Fixture, degree: u8, stored: u8) {
    let what = |name: &str| format!("degree {degree} of {stored}, {name}");
    let rows = rows_of(file, degree, stored);
    let (n, camera, simd) = (rows.rows(), camera_at_origin(), SimdPath::best());
    // All of them are drawn.
    let (radii, mut colors) = (vec![[1, 1]; n], vec![[0.0; 3]; n]);
    sh_fwd(&rows, &camera, degree, &radii, simd, &mut colors);
    let want = file.f64("colors");
    assert_close(&what("colours"), colors.iter().flatten().copied(), want, largest(want).max(1.0));

    let v_colors = file.f32("v_colors").as_chunks::<3>().0.to_vec();
    // A channel whose value is within the rounding of 0 may be cut on one side only.
    for (raw, color) in file.f64("sh_raw").iter().zip(colors.iter().flatten()) {
        assert!((raw + 0.5).abs() < 1e-5 || (raw + 0.5 > 0.0) == (*color > 0.0), "gate at {raw}");
    }
    let mut grads = Columns::zeros(n, stored);
    for column in [&mut grads.means, &mut grads.sh0, &mut grads.sh_n] {
        column.fill(9.0);
    }
    sh_bwd(&rows, &camera, degree, &radii, &colors, &v_colors, simd, &mut grads);
    let k = basis_len(degree);
    let width = 3 * (basis_len(stored) - 1);
    let in_use = (0..n).flat_map(|r| {
        let row = &grads.sh_n[r * width..(r + 1) * width];
        assert!(row[3 * (k - 1)..].iter().all(|x| *x == 0.0), "bands out of use get exactly 0");
        grads.sh0[3 * r..3 * r + 3].iter().chain(&row[..3 * (k - 1)]).copied()
    });
    let want = file.f64("g_coeffs");
    assert_close(&what("coefficients"), in_use, want, largest(want));
    // Directions of very different lengths: each row is compared on its own scale.
    let lengths = file.f64("dirs").as_chunks::<3>().0.iter().map(|d| d.iter().map(|x| x * x).sum::<f64>().sqrt());
    let lengths: Vec<f64> = lengths.collect();
    let per_unit = |i: usize, x: f64| x * lengths[i / 3];
    let want: Vec<f64> = file.f64("g_dirs").iter().enumerate().map(|(i, x)| per_unit(i, *x)).collect();
    let got = grads.means.iter().enumerate().map(|(i, x)| per_unit(i, f64::from(*x)) as f32);
    assert_close(&what("directions"), got, &want, largest(&want));
}
