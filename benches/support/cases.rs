//! The scenes for measuring whole steps: photo scenes with known times of other programs, and a generated terrain.
//! Measures nothing itself.

use super::{checked, terrain};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::config::file::TrainConfig;
use gsscale::dataset::photo::decode;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::{RenderOptions, Renderer};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;
use gsscale::scene::image::Target;
use gsscale::scene::init::gaussians_from_points;
use gsscale::scene::neighbours::nearest_dist2;
use std::path::PathBuf;

/// CPU seconds of other programs for a step with the same input, measured on two vCPUs of an AMD EPYC (Zen 5), SH
/// degree 3, no densification.
#[derive(Debug, Clone, Copy)]
pub struct Peer {
    /// OpenSplat 1.1.5, CPU build.
    pub opensplat: f64,
    /// Brush 1.0.0 on lavapipe.
    pub brush: f64,
    /// Target: OpenSplat's time divided by that of the CPU renderer.
    pub target: Option<f64>,
}

/// A real scene with known times of other programs.
#[derive(Debug, Clone, Copy)]
pub struct PhotoCase {
    /// Name in reports.
    pub name: &'static str,
    folder: &'static str,
    data_factor: f64,
    count: Option<usize>,
    peer: Peer,
}

const fn photos(
    name: &'static str,
    (folder, data_factor, count): (&'static str, f64, Option<usize>),
    (opensplat, brush, target): (f64, f64, Option<f64>),
) -> PhotoCase {
    PhotoCase { name, folder, data_factor, count, peer: Peer { opensplat, brush, target } }
}

/// The inputs of the other programs.
pub const PHOTO_CASES: [PhotoCase; 4] = [
    photos("brighton_480x269_10k", ("brighton", 2.5, Some(10_000)), (0.098, 0.68, Some(3.0))),
    photos("brighton_480x269_50k", ("brighton", 2.5, Some(50_000)), (0.130, 1.00, None)),
    photos("brighton_480x269_200k", ("brighton", 2.5, Some(200_000)), (0.380, 2.26, Some(5.0))),
    photos("sheffield_cross_395", ("sheffield_cross_395", 1.0, None), (0.302, 1.13, Some(5.0))),
];

pub struct Case {
    /// Name in reports.
    pub name: String,
    /// Rows at the start.
    pub columns: Columns,
    /// Cameras and photos.
    pub views: Vec<(Camera, Target)>,
    /// Unit of the rates for means.
    pub scene_scale: f32,
    /// Times of other programs.
    pub peer: Option<Peer>,
}

/// A real scene with at most `views` photos and the case's number of points; `None` if the scene is missing.
pub fn photo_case(case: &PhotoCase, views: usize) -> Option<Case> {
    let data = std::env::var_os("GSSCALE_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let scene = data.join(case.folder);
    if !scene.is_dir() {
        return None;
    }
    let config = TrainConfig { data_factor: case.data_factor, sh_every: 0, ..TrainConfig::default() };
    let prepared = gsscale::train::start::first_scene::prepare(&scene, &config);
    let Ok(prepared) = prepared else { panic!("{}: {:?}", scene.display(), prepared.err()) };
    let dataset = prepared.dataset;
    let columns = match case.count {
        None => prepared.columns,
        Some(count) => {
            let (points, colors) = resampled(&dataset.points, &dataset.colors, count);
            let mut options = gsscale::config::limits::init_options(&config);
            options.scene_scale = dataset.scene_scale;
            gaussians_from_points(&points, &colors, &options)
        }
    };
    let train = dataset.train_views();
    let views = train.iter().step_by(train.len().div_ceil(views)).map(|&v| {
        let view = &dataset.views[v];
        let target = decode(&view.photo);
        let Ok(target) = target else { panic!("{}: {:?}", view.name, target.err()) };
        (view.camera, target)
    });
    let name = case.name.to_string();
    Some(Case { name, columns, views: views.collect(), scene_scale: dataset.scene_scale, peer: Some(case.peer) })
}

/// Changes the number of points to `count`. More points: repeats the points, displaced by random draws of half the
/// distance to the neighbours. Fewer points: the first `count` in the order of hashed indices.
fn resampled(points: &[[f32; 3]], colors: &[[u8; 3]], count: usize) -> (Vec<[f32; 3]>, Vec<[u8; 3]>) {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by_cached_key(|&i| gsscale::base::rng::hash64(&[1, i as u64]));
    let dist2 = nearest_dist2(points);
    let mut out = (Vec::with_capacity(count), Vec::with_capacity(count));
    for i in 0..count {
        let from = order[i % order.len()];
        let mut point = points[from];
        if i >= order.len() {
            let mut draws = Stream::new(1, Purpose::Test, i as u64, 0);
            let near = 0.5 * f64::from(dist2[from][0]).sqrt();
            point.iter_mut().for_each(|x| *x += (near * draws.normal()) as f32);
        }
        out.0.push(point);
        out.1.push(colors[from]);
    }
    out
}

/// Perturbed rows of a terrain, and pictures of the original terrain from cameras around the first.
pub fn terrain_case(n: usize, width: u32, height: u32, views: usize) -> Case {
    let (mut columns, camera) = terrain(n, width, height);
    let mut renderer = CpuRenderer::new();
    let views = (0..views).map(|i| {
        let mut camera = camera;
        let turn = i as f32 * 2.4;
        camera.viewmat[0][3] = 0.4 * turn.cos();
        camera.viewmat[2][3] += 0.4 * turn.sin();
        checked(renderer.draw(&columns, &camera, &RenderOptions::default()));
        (camera, Target::new([width, height], checked(renderer.image()).to_rgb8()))
    });
    let views = views.collect();
    let mut draws = Stream::new(2, Purpose::Test, n as u64, 0);
    columns.sh0.iter_mut().for_each(|x| *x += 0.3 * draws.normal() as f32);
    Case { name: String::new(), columns, views, scene_scale: 2.0, peer: None }
}
