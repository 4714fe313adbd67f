//! project_fwd, sh_fwd, sh_bwd and project_bwd.
//!
//! Source of the tolerances: devices may fuse multiplications with additions and may divide within 2.5 units in the
//! last place, so every quantity differs by some roundings of 6e-8. On lavapipe a conic differs by at most 2.6e-6.

use crate::support::gpu::open;
use crate::twins::update::judge;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::gpu::{Buffer, Gpu, GpuOptions, Recorder};
use gsscale::kernels::project_bwd::project_bwd;
use gsscale::kernels::project_fwd::{Projected, project_fwd};
use gsscale::kernels::sh_bwd::sh_bwd;
use gsscale::kernels::sh_fwd::sh_fwd;
use gsscale::render::gpu_rows::{
    DeviceColumns, RowGradients, RowStages, SPLAT_BYTES, SplatRows, put_bands, take_bands,
};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns, sh_n_width};

const EPS2D: f32 = 0.3;
/// Numbers of rows: none, one, below, at and above the workgroup, several workgroups.
const SIZES: [usize; 6] = [0, 1, 255, 256, 257, 5000];

pub fn camera() -> Camera {
    let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.8, -0.6, 0.2], [0.0, 0.6, 0.8, 3.0]];
    Camera::pinhole(viewmat, [70.0, 60.0, 33.0, 22.0], [65, 47])
}

fn random_rows(n: usize) -> Columns {
    let mut rng = Stream::new(3, Purpose::Test, n as u64, 1);
    let mut rows = Columns::zeros(n, 3);
    rows.means.fill_with(|| rng.range(-3.0, 3.0) as f32);
    rows.quats.fill_with(|| rng.range(-1.0, 1.0) as f32);
    rows.scales.fill_with(|| rng.range(-5.0, 0.0) as f32);
    rows.opacities.fill_with(|| rng.range(-6.0, 5.0) as f32);
    rows.sh0.fill_with(|| rng.range(-2.0, 2.0) as f32);
    rows.sh_n.fill_with(|| rng.range(-0.5, 0.5) as f32);
    rows
}

/// Random output of the tile stages: twelve floats for each row, as in `shaders/shared/splat.wgsl`.
fn random_gradients(n: usize) -> Vec<[f32; 12]> {
    let mut rng = Stream::new(4, Purpose::Test, n as u64, 1);
    let mut draw = || rng.normal() as f32;
    let one = |_| [draw(), draw(), 0.0, draw(), draw(), draw(), draw(), 0.0, draw(), draw(), draw(), 0.0];
    (0..n).map(one).collect()
}

fn record_of(p: &Projected, row: usize, [r, g, b]: [f32; 3]) -> [f32; 12] {
    let ([mx, my], [xx, xy, yy]) = (p.means2d[row], p.conics[row]);
    let [rx, ry] = p.radii[row].map(|r| r as f32);
    [mx, my, p.depths[row], p.opacities[row], xx, xy, yy, rx, r, g, b, ry]
}

/// Results of all stages for some rows.
struct Results {
    projected: Vec<[f32; 12]>,
    colors: Vec<[f32; 3]>,
    grads: Columns,
}

fn on_cpu(rows: &Columns, camera: &Camera, degree: u8, v: &[[f32; 12]]) -> Results {
    let simd = SimdPath::best();
    let (mut p, mut colors, mut grads) =
        (Projected::default(), vec![[0.0; 3]; rows.rows()], Columns::zeros(rows.rows(), 3));
    project_fwd(rows, camera, EPS2D, simd, 0, &mut p);
    sh_fwd(rows, camera, degree, &p.radii, simd, &mut colors);
    let v_colors: Vec<_> = v.iter().map(|v| [v[8], v[9], v[10]]).collect();
    let v_means2d: Vec<_> = v.iter().map(|v| [v[0], v[1]]).collect();
    let v_conics: Vec<_> = v.iter().map(|v| [v[4], v[5], v[6]]).collect();
    let v_opacities: Vec<_> = v.iter().map(|v| v[3]).collect();
    sh_bwd(rows, camera, degree, &p.radii, &colors, &v_colors, simd, &mut grads);
    project_bwd(rows, camera, EPS2D, &p.radii, &v_means2d, &v_conics, &v_opacities, simd, &mut grads);
    let projected = (0..rows.rows()).map(|i| record_of(&p, i, [0.0; 3])).collect();
    Results { projected, colors, grads }
}

/// Runs `stage` on a fresh recorder and reads `buffer` back.
fn read<'g>(gpu: &'g Gpu, buffer: &Buffer, stage: impl FnOnce(&mut Recorder<'g>)) -> Vec<f32> {
    let mut recorder = gpu.begin("parity");
    stage(&mut recorder);
    gpu.submit(recorder).unwrap();
    super::pages::read(gpu, buffer, (buffer.size() / 4) as usize)
}

/// The same on the device; sh_fwd and the backward stages get the CPU's splats.
fn on_gpu(gpu: &Gpu, rows: &Columns, camera: &Camera, degree: u8, v: &[[f32; 12]], cpu: &Results) -> Results {
    let n = rows.rows();
    let stages = RowStages::new(gpu).unwrap();
    let columns = DeviceColumns::new(gpu, n as u32, degree).unwrap();
    let room = RowGradients::new(gpu, n as u32, degree, false).unwrap();
    let grads = &room.columns;
    let splats = gpu.buffer("splats", SPLAT_BYTES * n as u64).unwrap();
    let v_splats = gpu.buffer("v_splats", SPLAT_BYTES * n as u64).unwrap();
    let projected = read(gpu, &splats, |r| {
        columns.upload_geometry(r, rows, &(0..n)).unwrap();
        columns.upload_colors(r, rows, &(0..n), &mut Vec::new()).unwrap();
        // Every entry must be overwritten: earlier contents must not show.
        for (_, buffer, width) in grads.columns() {
            r.upload(&buffer.view(), &vec![f32::NAN; width * n]).unwrap();
        }
        r.upload(&splats.view(), &vec![f32::NAN; 12 * n]).unwrap();
        r.upload(&v_splats.view(), v).unwrap();
        stages.project_fwd(gpu, r, camera, EPS2D, &columns, (&splats).into(), None).unwrap();
    });
    let colored = read(gpu, &splats, |r| {
        r.upload(&splats.view(), &cpu.projected).unwrap();
        stages.sh_fwd(gpu, r, camera, &columns, (&splats).into()).unwrap();
    });
    let with_colors: Vec<_> = cpu.projected.iter().zip(&cpu.colors).map(|(p, c)| with_color(*p, *c)).collect();
    let mut out = Columns::zeros(n, 3);
    out.opacities = read(gpu, &grads.opacities, |r| {
        r.upload(&splats.view(), &with_colors).unwrap();
        let [s, v_s] = [&splats, &v_splats].map(SplatRows::from);
        stages.sh_bwd(gpu, r, camera, &columns, s, v_s, &room).unwrap();
        stages.project_bwd(gpu, r, camera, EPS2D, &columns, s, v_s, &room).unwrap();
    });
    let packed = read(gpu, &room.footprints, |_| {});
    for (i, (got, record)) in packed.as_chunks::<4>().0.iter().zip(&with_colors).enumerate() {
        let want = if record[7] > 0.0 { [v[i][0], v[i][1], record[7], record[11]] } else { [0.0; 4] };
        assert_eq!(got.map(f32::to_bits), want.map(f32::to_bits), "row {i}: {got:?}, want {want:?}");
    }
    out.means = read(gpu, &grads.means, |_| {});
    out.quats = read(gpu, &grads.quats, |_| {});
    out.scales = read(gpu, &grads.scales, |_| {});
    out.sh0 = read(gpu, grads.sh0.as_ref().unwrap(), |_| {});
    if let Some(sh_n) = &grads.sh_n {
        put_bands(&read(gpu, sh_n, |_| {}), sh_n_width(degree), &mut out.sh_n, sh_n_width(3));
    }
    let mut largest = vec![0; n];
    for column in Column::ALL {
        judge(column.width(3), out.column(column), &mut largest);
    }
    let records = read(gpu, &v_splats, |_| {});
    let of_device: Vec<u32> = records.iter().skip(11).step_by(12).map(|largest| largest.to_bits()).collect();
    assert!(of_device == largest, "the largest gradient of each row");
    let (projected, _) = projected.as_chunks::<12>();
    let (colored, _) = colored.as_chunks::<12>();
    for (got, want) in colored.iter().zip(&cpu.projected) {
        assert_eq!(with_color(*got, [0.0; 3]), *want, "sh_fwd changes nothing but the colour");
    }
    let colors = colored.iter().map(|c| [c[8], c[9], c[10]]).collect();
    Results { projected: projected.to_vec(), colors, grads: out }
}

fn with_color(mut splat: [f32; 12], color: [f32; 3]) -> [f32; 12] {
    splat[8..11].copy_from_slice(&color);
    splat
}

/// Largest difference relative to the largest value of the row; zeros must be zeros, what is not finite must agree.
fn difference(got: &[f32], want: &[f32]) -> f64 {
    let scale = want.iter().filter(|w| w.is_finite()).fold(0.0f32, |m, w| m.max(w.abs()));
    got.iter().zip(want).fold(0.0f64, |worst, (g, w)| {
        let same = g == w || (g.is_nan() && w.is_nan());
        let relative = f64::from((g - w).abs()) / f64::from(scale);
        worst.max(if same {
            0.0
        } else if relative.is_nan() {
            f64::INFINITY
        } else {
            relative
        })
    })
}

#[track_caller]
fn assert_rows(what: &str, got: &[f32], want: &[f32], width: usize, limit: impl Fn(usize) -> f64) {
    assert_eq!(got.len(), want.len(), "{what}");
    for (row, (got, want)) in got.chunks(width).zip(want.chunks(width)).enumerate() {
        let d = difference(got, want);
        assert!(d <= limit(row), "{what}, row {row}: {got:?}, want {want:?}: {d:e} > {:e}", limit(row));
    }
}

/// Compares all results; `radius_flips`: rows whose radius may be rounded up by one pixel more or less.
fn assert_same(got: &Results, want: &Results, radius_flips: usize) {
    let drawn = |s: &[f32; 12]| s[7] > 0.0;
    let mut flips = 0;
    for (row, (g, w)) in got.projected.iter().zip(&want.projected).enumerate() {
        assert_eq!(drawn(g), drawn(w), "row {row}: {g:?}, want {w:?}");
        flips += usize::from([g[7], g[11]] != [w[7], w[11]]);
        assert!((g[7] - w[7]).abs() <= 1.0 && (g[11] - w[11]).abs() <= 1.0, "row {row}: {g:?}, want {w:?}");
    }
    assert!(flips <= radius_flips, "{flips} radii differ");
    // The camera-space position is a sum of terms up to 10 that nearly cancel close to the camera; the footprint goes
    // with its square.
    let near = |row: usize| 1.0 + 10.0 / f64::from(want.projected[row][2].max(0.01));
    let part = |r: &Results, at: usize, width: usize| -> Vec<f32> {
        r.projected.iter().flat_map(|s| s[at..at + width].to_vec()).collect()
    };
    for (what, at, width, units) in [("means2d", 0, 2, 1.0), ("depths", 2, 1, 1.0), ("conics", 4, 3, 4.0)] {
        let limit = |row: usize| 1e-6 * units * near(row);
        assert_rows(what, &part(got, at, width), &part(want, at, width), width, limit);
    }
    // Ten roundings of exp and sigmoid.
    assert_rows("opacities", &part(got, 3, 1), &part(want, 3, 1), 1, |_| 1e-6);
    // 16 products of up to 3 in size, against the colours' size.
    let (got_colors, want_colors) = (got.colors.as_flattened(), want.colors.as_flattened());
    for (row, (g, w)) in got.colors.iter().zip(&want.colors).enumerate() {
        assert!(g.iter().zip(w).all(|(g, w)| (g - w).abs() <= 5e-6 || g == w), "colour {row}: {g:?}, want {w:?}");
    }
    assert_eq!(got_colors.len(), want_colors.len());
    let (g, w) = (&got.grads, &want.grads);
    assert_rows("v_sh0", &g.sh0, &w.sh0, 3, |_| 1e-6);
    // Basis functions of a direction with roundings: their terms are up to 3.
    assert_rows("v_sh_n", &g.sh_n, &w.sh_n, 45, |_| 5e-6);
    assert_rows("v_opacities", &g.opacities, &w.opacities, 1, |_| 2e-6);
    // Sums over products of conics, each with its roundings, some of which cancel: where axes are nearly equal, a
    // turn changes nothing. Lavapipe: 4.4e-5 at most.
    assert_rows("v_scales", &g.scales, &w.scales, 3, |row| 2e-5 * near(row));
    assert_rows("v_quats", &g.quats, &w.quats, 4, |row| 1e-4 * near(row));
    assert_rows("v_means", &g.means, &w.means, 3, |row| 2e-5 * near(row));
}

#[test]
fn stages_on_rows_are_those_of_the_cpu() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    for n in SIZES {
        let rows = random_rows(n);
        let v = random_gradients(n);
        for degree in 0..=3u8 {
            let want = on_cpu(&rows, &camera(), degree, &v);
            let got = on_gpu(&gpu, &rows, &camera(), degree, &v, &want);
            // A radius is rounded up: one row in a thousand may stand within 1e-4 px of a whole number.
            assert_same(&got, &want, n / 1000);
        }
    }
}

/// A row in front of the camera that is drawn.
fn plain_row(rows: &mut Columns, row: usize) {
    rows.means[3 * row..3 * row + 3].copy_from_slice(&[0.1, -0.2, 0.3]);
    rows.quats[4 * row..4 * row + 4].copy_from_slice(&[0.9, 0.1, -0.3, 0.2]);
    rows.scales[3 * row..3 * row + 3].copy_from_slice(&[-2.0, -1.5, -2.5]);
    rows.opacities[row] = 0.5;
}

/// Logit of an opacity of exactly 1/255, moved by a part of itself.
fn logit_of_alpha_min(by: f32) -> f32 {
    -5.537_334_3 * (1.0 - by)
}

/// A change of a row that makes it odd, with the row's number.
type Poison = (&'static str, fn(&mut Columns, usize));

const POISON: [Poison; 30] = [
    ("nothing", |_, _| {}),
    ("NaN mean", |r, i| r.means[3 * i + 1] = f32::NAN),
    ("infinite mean", |r, i| r.means[3 * i] = f32::INFINITY),
    ("mean at minus infinity", |r, i| r.means[3 * i + 2] = f32::NEG_INFINITY),
    ("far to the side", |r, i| r.means[3 * i] = 1e30),
    ("largest mean", |r, i| r.means[3 * i] = f32::MAX),
    ("denormal mean", |r, i| r.means[3 * i] = 1e-40),
    ("behind the camera", |r, i| r.means[3 * i + 2] = -30.0),
    ("beside the image", |r, i| r.means[3 * i] = 30.0),
    ("just beyond the near plane", |r, i| set_depth(r, i, 0.0102)),
    ("just before the near plane", |r, i| set_depth(r, i, 0.0098)),
    ("at the camera", |r, i| set_depth(r, i, 0.0)),
    ("zero quaternion", |r, i| r.quats[4 * i..4 * i + 4].fill(0.0)),
    ("tiny quaternion", |r, i| r.quats[4 * i..4 * i + 4].fill(1e-25)),
    ("huge quaternion", |r, i| r.quats[4 * i..4 * i + 4].fill(1e25)),
    ("denormal quaternion", |r, i| r.quats[4 * i..4 * i + 4].fill(1e-41)),
    ("small but usable quaternion", |r, i| r.quats[4 * i..4 * i + 4].fill(1e-13)),
    ("NaN quaternion", |r, i| r.quats[4 * i + 3] = f32::NAN),
    ("infinite quaternion", |r, i| r.quats[4 * i + 3] = f32::INFINITY),
    ("infinite scale", |r, i| r.scales[3 * i] = 1e3),
    ("squares overflow", |r, i| r.scales[3 * i..3 * i + 3].fill(60.0)),
    ("NaN scale", |r, i| r.scales[3 * i + 2] = f32::NAN),
    ("no size along one axis", |r, i| r.scales[3 * i] = -200.0),
    ("no size", |r, i| r.scales[3 * i..3 * i + 3].fill(f32::NEG_INFINITY)),
    ("opacity just below 1/255", |r, i| r.opacities[i] = logit_of_alpha_min(-1e-5)),
    ("opacity just above 1/255", |r, i| r.opacities[i] = logit_of_alpha_min(1e-5)),
    ("opacity of 0", |r, i| r.opacities[i] = f32::NEG_INFINITY),
    ("opacity of 1", |r, i| r.opacities[i] = f32::INFINITY),
    ("NaN opacity", |r, i| r.opacities[i] = f32::NAN),
    ("NaN and infinite coefficients", |r, i| {
        r.sh0[3 * i] = f32::NAN;
        r.sh_n[45 * i + 1] = f32::INFINITY;
        r.sh_n[45 * i + 2] = 1e-42;
    }),
];

/// Puts a row on the axis of the camera at this depth.
fn set_depth(rows: &mut Columns, row: usize, depth: f32) {
    let m = camera().viewmat;
    for c in 0..3 {
        rows.means[3 * row + c] = (0..3).map(|i| m[i][c] * (if i == 2 { depth } else { 0.0 } - m[i][3])).sum();
    }
}

#[test]
fn non_finite_rows_are_culled_as_on_the_cpu_and_do_not_spread() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let n = 10 * POISON.len() + 3;
    let mut rows = random_rows(n);
    for (k, (_, edit)) in POISON.iter().enumerate() {
        plain_row(&mut rows, 10 * k);
        edit(&mut rows, 10 * k);
    }
    let mut v = random_gradients(n);
    let first = on_cpu(&rows, &camera(), 3, &v);
    // Gradients of rows that are not drawn must have no effect.
    for (v, splat) in v.iter_mut().zip(&first.projected) {
        if splat[7] == 0.0 {
            *v = [f32::NAN; 12];
        }
    }
    let want = on_cpu(&rows, &camera(), 3, &v);
    let got = on_gpu(&gpu, &rows, &camera(), 3, &v, &want);
    for (k, (what, _)) in POISON.iter().enumerate() {
        let (g, w) = (got.projected[10 * k], want.projected[10 * k]);
        assert_eq!(g[7] > 0.0, w[7] > 0.0, "{what}: {g:?}, want {w:?}");
        if w[7] == 0.0 {
            assert_eq!(g, [0.0; 12], "{what}");
        }
        assert!(g.iter().all(|x| x.is_finite()), "{what}: {g:?}");
        let color = got.colors[10 * k];
        assert!(color.iter().all(|c| !c.is_nan()), "{what}: {color:?}");
    }
    // Gradients through an infinite coefficient are as undefined on the CPU; everything else is compared.
    let last = POISON.len() - 1;
    let without = |r: Results| {
        let Results { projected, mut colors, mut grads } = r;
        colors[10 * last].fill(0.0);
        grads.means[30 * last..30 * last + 3].fill(0.0);
        Results { projected, colors, grads }
    };
    let drawn = POISON.iter().enumerate().filter(|(k, _)| want.projected[10 * k][7] > 0.0).count();
    assert!((5..20).contains(&drawn), "{drawn} of the poisoned rows are drawn");
    assert_same(&without(got), &without(want), 0);
}

#[test]
fn windows_and_runs_change_no_bit() {
    let Some(whole) = open(&GpuOptions::default()) else { return };
    let n = 1000;
    // 180 bytes of the widest column: windows of 384 rows, so three of them; and of 64 rows.
    for limit in [70_000, 16_000] {
        let options = GpuOptions { max_binding_bytes: Some(limit), ..GpuOptions::default() };
        let cut = open(&options).expect("it opened before");
        assert!(cut.max_binding_bytes() <= limit);
        let (rows, v) = (random_rows(n), random_gradients(n));
        let cpu = on_cpu(&rows, &camera(), 3, &v);
        let run = |gpu: &Gpu| {
            let r = on_gpu(gpu, &rows, &camera(), 3, &v, &cpu);
            (r.projected, r.colors, r.grads)
        };
        let want = run(&whole);
        assert!(run(&cut) == want, "windows of {limit} bytes");
        assert!(run(&whole) == want, "a second run");
    }
}

/// Few rows are copied by one thread, many by several.
#[test]
fn bands_are_cut_out_and_put_back() {
    for n in [7, 9001] {
        let rows = random_rows(n);
        for width in [9, 24] {
            let (mut bands, mut back) = (Vec::new(), vec![0.0; rows.sh_n.len()]);
            take_bands(&rows.sh_n, 45, width, &mut bands);
            put_bands(&bands, width, &mut back, 45);
            let want = |(i, value): (usize, &f32)| if i % 45 < width { *value } else { 0.0 };
            assert_eq!(back, rows.sh_n.iter().enumerate().map(want).collect::<Vec<_>>());
        }
    }
}
