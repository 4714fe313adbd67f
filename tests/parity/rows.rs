//! project_fwd, sh_fwd, sh_bwd and project_bwd.

use crate::device::{Lab, bits, floats, lab};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::kernels::project_bwd::project_bwd;
use gsscale::kernels::project_fwd::{Projected, project_fwd};
use gsscale::kernels::sh_bwd::sh_bwd;
use gsscale::kernels::sh_fwd::sh_fwd;
use gsscale::kernels::uniforms::RowsUniforms;
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;

const EPS2D: f32 = 0.3;
const DEFINES: [&str; 3] = ["SH_DEGREE_1", "SH_DEGREE_2", "SH_DEGREE_3"];
/// Floats of a row in each band's buffer, and where they begin in a row of `sh_n`.
const BANDS: [(usize, usize); 3] = [(9, 0), (15, 9), (21, 24)];

fn camera() -> Camera {
    Camera {
        viewmat: [[1.0, 0.0, 0.0, 0.1], [0.0, 0.8, -0.6, 0.2], [0.0, 0.6, 0.8, 3.0]],
        fx: 70.0,
        fy: 60.0,
        cx: 33.0,
        cy: 22.0,
        width: 65,
        height: 47,
        near_plane: 0.01,
        far_plane: 1e10,
    }
}

fn random_rows(n: usize, sh_degree: u8) -> Columns {
    let mut rng = Stream::new(3, Purpose::Test, n as u64, 1);
    let mut rows = Columns::zeros(n, sh_degree);
    rows.means.fill_with(|| rng.range(-3.0, 3.0) as f32);
    rows.quats.fill_with(|| rng.range(-1.0, 1.0) as f32);
    rows.scales.fill_with(|| rng.range(-5.0, 0.0) as f32);
    rows.opacities.fill_with(|| rng.range(-6.0, 5.0) as f32);
    rows.sh0.fill_with(|| rng.range(-2.0, 2.0) as f32);
    rows.sh_n.fill_with(|| rng.range(-0.5, 0.5) as f32);
    rows
}

/// Numbers of rows: none, one, below, at and above the workgroup, several workgroups.
const SIZES: [usize; 6] = [0, 1, 255, 256, 257, 5000];

/// Twelve floats of a row, as `shaders/shared/splat.wgsl` says.
fn record(mean2d: [f32; 2], depth: f32, opacity: f32, conic: [f32; 3], radii: [f32; 2], color: [f32; 3]) -> [f32; 12] {
    let ([mx, my], [xx, xy, yy], [r, g, b]) = (mean2d, conic, color);
    [mx, my, depth, opacity, xx, xy, yy, radii[0], r, g, b, radii[1]]
}

fn splats_of(p: &Projected, colors: &[[f32; 3]]) -> Vec<f32> {
    (0..p.rows())
        .flat_map(|i| {
            let radii = p.radii[i].map(|r| r as f32);
            record(p.means2d[i], p.depths[i], p.opacities[i], p.conics[i], radii, colors[i])
        })
        .collect()
}

fn band(rows: &Columns, band: usize) -> Vec<f32> {
    let (width, from) = BANDS[band];
    let row_width = rows.sh_n.len() / rows.rows().max(1);
    rows.sh_n.chunks(row_width.max(1)).flat_map(|row| row[from..from + width].iter().copied()).collect()
}

fn groups(rows: usize) -> u32 {
    rows.div_ceil(256) as u32
}

fn uniform(camera: &Camera, first_row: usize, rows: usize) -> RowsUniforms {
    RowsUniforms::new(camera, EPS2D, first_row as u32, rows as u32)
}

/// Runs project_fwd over windows of `window` rows.
fn project_on(lab: &Lab, rows: &Columns, camera: &Camera, window: usize) -> Vec<f32> {
    let n = rows.rows();
    let mut splats = vec![f32::NAN.to_bits(); 12 * n];
    for first in (0..n).step_by(window.max(1)) {
        let end = n.min(first + window);
        let mut means = bits(&rows.means[3 * first..3 * end]);
        let mut quats = bits(&rows.quats[4 * first..4 * end]);
        let mut scales = bits(&rows.scales[3 * first..3 * end]);
        let mut opacities = bits(&rows.opacities[first..end]);
        lab.run(
            "project_fwd.wgsl",
            "project_fwd",
            &[],
            bytemuck::bytes_of(&uniform(camera, first, end - first)),
            &mut [(1, &mut means), (2, &mut quats), (3, &mut scales), (4, &mut opacities), (5, &mut splats)],
            groups(end - first),
        );
    }
    floats(&splats)
}

fn projected(rows: &Columns, camera: &Camera) -> Projected {
    let mut p = Projected::default();
    project_fwd(rows, camera, EPS2D, SimdPath::best(), &mut p);
    p
}

fn measure(what: &str, got: &[f32], want: &[f32], width: usize) {
    let mut worst = (0.0f64, 0usize);
    for (i, (g, w)) in got.chunks(width).zip(want.chunks(width)).enumerate() {
        let scale = w.iter().fold(1e-30f64, |m, x| m.max(f64::from(x.abs())));
        let d = g.iter().zip(w).fold(0.0f64, |m, (a, b)| { let d = f64::from((a - b).abs()); if d.is_nan() { f64::INFINITY } else { m.max(d) } }) / scale;
        if d > worst.0 { worst = (d, i); }
    }
    println!("{what}: {worst:?} {:?} {:?}", got.chunks(width).nth(worst.1), want.chunks(width).nth(worst.1));
}

#[test]
fn probe() {
    let Some(lab) = lab() else { return };
    for n in SIZES {
        let rows = random_rows(n, 3);
        let p = projected(&rows, &camera());
        let mut colors = Vec::new();
        let got = project_on(lab, &rows, &camera(), 2048);
        let want = splats_of(&p, &vec![[0.0; 3]; n]);
        let flips = (0..n).filter(|i| (got[12 * i + 7] > 0.0) != (want[12 * i + 7] > 0.0)).count();
        let radii = (0..n).filter(|i| got[12 * i + 7] != want[12 * i + 7] || got[12 * i + 11] != want[12 * i + 11]).count();
        println!("{n}: flips {flips}, radii {radii}");
        for (c, w) in [(0, 2), (2, 1), (3, 1), (4, 3)] {
            let take = |v: &[f32]| -> Vec<f32> { v.chunks(12).flat_map(|r| r[c..c + w].to_vec()).collect() };
            measure(&format!("at {c}"), &take(&got), &take(&want), w);
        }
        for degree in 0..=3u8 {
            sh_fwd(&rows, &camera(), degree, &p, SimdPath::best(), &mut colors);
            let mut splats = bits(&splats_of(&p, &vec![[0.0; 3]; n]));
            let mut means = bits(&rows.means);
            let mut sh0 = bits(&rows.sh0);
            let mut bands: Vec<_> = (0..degree as usize).map(|b| bits(&band(&rows, b))).collect();
            let mut bind = vec![(1, &mut means), (2, &mut splats), (3, &mut sh0)];
            for (b, data) in bands.iter_mut().enumerate() { bind.push((4 + b as u32, data)); }
            let u = uniform(&camera(), 0, n);
            lab.run("sh_fwd.wgsl", "sh_fwd", &DEFINES[..degree as usize], bytemuck::bytes_of(&u), &mut bind, groups(n));
            measure("sh_fwd", &floats(&splats), &splats_of(&p, &colors), 12);

            let mut rng = Stream::new(4, Purpose::Test, n as u64, 1);
            let mut draw = |k: f32| rng.normal() as f32 * k;
            let v_means2d: Vec<[f32; 2]> = (0..n).map(|_| [draw(1.0), draw(1.0)]).collect();
            let v_conics: Vec<[f32; 3]> = (0..n).map(|_| [draw(1.0), draw(1.0), draw(1.0)]).collect();
            let v_colors: Vec<[f32; 3]> = (0..n).map(|_| [draw(1.0), draw(1.0), draw(1.0)]).collect();
            let v_opacities: Vec<f32> = (0..n).map(|_| draw(1.0)).collect();
            let mut grads = Columns::zeros(n, 3);
            sh_bwd(&rows, &camera(), degree, &p, &colors, &v_colors, SimdPath::best(), &mut grads);
            let mut splats = bits(&splats_of(&p, &colors));
            let mut v_splats = bits(&(0..n).flat_map(|i| record(v_means2d[i], 0.0, v_opacities[i], v_conics[i], [0.0; 2], v_colors[i])).collect::<Vec<_>>());
            let mut v_means = vec![0u32; 3 * n];
            let mut v_sh0 = vec![0u32; 3 * n];
            let mut v_bands: Vec<_> = bands.iter().map(|b| vec![0u32; b.len()]).collect();
            {
            let mut bind = vec![(1, &mut means), (2, &mut splats), (3, &mut v_splats), (4, &mut v_means), (5, &mut v_sh0)];
            for (b, (data, v)) in bands.iter_mut().zip(&mut v_bands).enumerate() { bind.push((6 + 2 * b as u32, data)); bind.push((7 + 2 * b as u32, v)); }
            lab.run("sh_bwd.wgsl", "sh_bwd", &DEFINES[..degree as usize], bytemuck::bytes_of(&u), &mut bind, groups(n));
            }
            measure("v_sh0", &floats(&v_sh0), &grads.sh0, 3);
            measure("v_means", &floats(&v_means), &grads.means, 3);
            for (b, v) in v_bands.iter().enumerate() { measure("v_band", &floats(v), &band(&grads, b), BANDS[b].0); }
            if degree == 3 {
                project_bwd(&rows, &camera(), EPS2D, &p, &v_means2d, &v_conics, &v_opacities, SimdPath::best(), &mut grads);
                let (mut quats, mut scales, mut opacities) = (bits(&rows.quats), bits(&rows.scales), bits(&rows.opacities));
                let (mut vq, mut vs, mut vo) = (vec![0u32; 4 * n], vec![0u32; 3 * n], vec![0u32; n]);
                lab.run("project_bwd.wgsl", "project_bwd", &[], bytemuck::bytes_of(&u), &mut [(1, &mut means), (2, &mut quats), (3, &mut scales), (4, &mut opacities), (5, &mut splats), (6, &mut v_splats), (7, &mut v_means), (8, &mut vq), (9, &mut vs), (10, &mut vo)], groups(n));
                measure("v_means", &floats(&v_means), &grads.means, 3);
                measure("v_quats", &floats(&vq), &grads.quats, 4);
                measure("v_scales", &floats(&vs), &grads.scales, 3);
                measure("v_opac", &floats(&vo), &grads.opacities, 1);
            }
        }
    }
}
