//! Upright results: a turned scene looks the same to turned cameras.

use gsscale::base::rng::{Purpose, Stream};
use gsscale::exchange::meta::SceneMeta;
use gsscale::exchange::ply::{PlyContent, read_ply, write_gaussians};
use gsscale::kernels::sh_fwd::sh_basis;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{RenderOptions, Renderer, RowBatches};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::rotation::{Rotation, sh_basis64};

#[test]
fn the_two_bases_are_one() {
    let mut draws = Stream::new(5, Purpose::Test, 0, 0);
    for _ in 0..1000 {
        let v: [f64; 3] = std::array::from_fn(|_| draws.normal());
        let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let unit = v.map(|x| (x / length) as f32);
        let (of_renderer, of_export) = (sh_basis(3, unit), sh_basis64(unit.map(f64::from)));
        for (a, b) in of_renderer.into_iter().zip(of_export) {
            // Six roundings of products below 3.
            assert!((f64::from(a) - b).abs() < 6.0 * 2.4e-7, "{unit:?}: {a} {b}");
        }
    }
}

/// Gaussians in front of a camera at the origin that looks along z.
fn scene() -> Columns {
    let mut columns = Columns::zeros(300, 3);
    let mut draws = Stream::new(6, Purpose::Test, 0, 0);
    for row in 0..columns.rows() {
        let position = [draws.range(-1.0, 1.0), draws.range(-0.7, 0.7), draws.range(2.0, 4.0)];
        columns.row_mut(Column::Means, row).copy_from_slice(&position.map(|x| x as f32));
        columns.row_mut(Column::Scales, row).fill_with(|| draws.range(-4.0, -1.5) as f32);
        columns.row_mut(Column::Quats, row).fill_with(|| draws.normal() as f32);
        columns.row_mut(Column::Opacities, row)[0] = draws.range(-2.0, 3.0) as f32;
        for column in [Column::Sh0, Column::ShN] {
            columns.row_mut(column, row).fill_with(|| 0.4 * draws.normal() as f32);
        }
    }
    columns
}

fn picture(rows: &Columns, viewmat: [[f32; 4]; 3]) -> Vec<f32> {
    let camera = Camera::pinhole(viewmat, [90.0, 90.0, 48.0, 32.0], [96, 64]);
    let mut renderer = CpuRenderer::new();
    renderer.begin_view(&camera, &RenderOptions::default(), RowBatches::One).unwrap();
    renderer.rows_in(rows).unwrap();
    renderer.picture().unwrap();
    renderer.image().unwrap().rgb.clone()
}

#[test]
fn a_turned_scene_looks_the_same_to_a_turned_camera() {
    let folder = tempfile::tempdir().unwrap();
    let columns = scene();
    let straight = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.05], [0.0, 0.0, 1.0, 0.3]];
    let want = picture(&columns, straight);
    let mean =
        |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / a.len() as f64;
    for up in [[0.0, 0.0, 1.0], [0.36, -0.48, 0.8], [0.0, 1.0, 0.0]] {
        let path = folder.path().join("a.ply");
        let upright = Rotation::upright(up);
        write_gaussians(&path, &columns, &SceneMeta { upright, ..SceneMeta::default() }).unwrap();
        let PlyContent::Gaussians { columns: turned, .. } = read_ply(&path).unwrap() else { panic!("Gaussians") };
        // p_cam = W p = (W R^T) (R p): each row of W is a vector of the dataset.
        let viewmat = straight.map(|[x, y, z, t]: [f32; 4]| {
            let [x, y, z] = upright.unwrap().apply([x, y, z].map(f64::from)).map(|x| x as f32);
            [x, y, z, t]
        });
        let got = picture(&turned, viewmat);
        // Rounding moves values by 1e-6. A splat whose radius or whose alpha then crosses a threshold (1/255) changes a few
        // pixels by that much, so the mean is compared, and the largest difference is some such crossings.
        let most = got.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(mean(&got, &want) < 2e-5 && most < 4.0 / 255.0, "{up:?}: mean {}, most {most}", mean(&got, &want));
        // The same picture without turning the harmonics differs by far more.
        let mut unturned = turned.clone();
        unturned.sh_n.clone_from(&columns.sh_n);
        assert!(mean(&picture(&unturned, viewmat), &want) > 1e-2);
    }
}
