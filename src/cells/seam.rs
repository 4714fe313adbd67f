//! What the borders of cells cost: the quality of held-out views in bands along borders in the picture, and how dense
//! Gaussians are on both sides of them, against another scene of the same photos if one is given.
//!
//! A border is projected at the median height of the Gaussians beside it, without regard to what stands before it.
//!
//! Not here: the figures of whole views (`gsscale-eval`).

use super::plan::{CityPlan, GroundRect};
use super::{City, check_range};
use crate::base::error::{InputError, InputResult};
use crate::config::file::{TrainConfig, read_resolved};
use crate::dataset::loader::Dataset;
use crate::render::metrics::{mean, psnr};
use crate::report::run_files::{CONFIG_FILE, PLY_FILE};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::Target;
use crate::train::error::TrainError;
use crate::train::inputs::machine;
use crate::train::log::report::json_psnr;
use crate::train::memory::host_budget;
use crate::train::run::eval_file::{Evaluator, Model};
use crate::train::step::pages::WorkingSet;
use crate::train::step::view::{SceneNow, draw};
use glam::DVec3;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Points along a border, and the strips beside it in which Gaussians are counted, as a share of its length.
const POINTS: usize = 256;
const STRIP: f64 = 0.1;
/// How often the part of a piece before the camera is halved.
const HALVINGS: u32 = 20;

/// The figures of a scene at the borders of a city.
#[derive(Debug, Clone, Serialize)]
pub struct SeamReport {
    /// Held-out views that show a border, and views that show none.
    pub views: [usize; 2],
    /// Mean PSNR of the first kind: whole, and in the bands; and of the second kind. `None` without views.
    pub crossing_psnr: Option<f64>,
    pub band_psnr: Option<f64>,
    pub other_psnr: Option<f64>,
    pub borders: Vec<BorderReport>,
}

/// The Gaussians beside a border.
#[derive(Debug, Clone, Serialize)]
pub struct BorderReport {
    pub cells: [usize; 2],
    /// Gaussians in the strips on both sides.
    pub gaussians: [u64; 2],
}

/// A part of the border of two cells, along one axis of the ground.
struct Border {
    cells: [usize; 2],
    /// The axis across it, and where it lies on that axis.
    across: usize,
    at: f64,
    /// Its extent on the other axis.
    from: f64,
    to: f64,
}

/// Measures the scene in the folder `model`, which a merge or a run has written, at the borders of a city, in bands of this width, pixels.
/// Errors: the plan, the model or its photos cannot be read.
pub fn seam(city: &Path, model: &Path, scene: Option<&Path>, band: f64) -> Result<SeamReport, TrainError> {
    check_range("--band", band, 0.0..=1e6)?;
    let city = City(city.to_path_buf());
    let plan = CityPlan::read(&city)?;
    // All photos, also where the model was polished on some.
    let config = TrainConfig { views_file: String::new(), ..TrainConfig::read(&model.join(CONFIG_FILE))? };
    machine::set_up(&config)?;
    let file = model.join(PLY_FILE);
    let Model::Ply(read) = Model::open(&file, host_budget(config.host_mem.0))? else {
        return Err(InputError::new(&file, "it is no PLY", "name the folder of a merge or a run").into());
    };
    let scene = match scene {
        Some(scene) => scene.to_path_buf(),
        None => scene_of_both(&city, model)?,
    };
    let mut evaluator = Evaluator::open(&scene, &config, None)?;
    let (columns, meta) = *read;
    let columns = evaluator.placed(&file, columns, &meta)?;
    let places = places_of(&plan, &evaluator.dataset, &columns);
    let (mut pages, run) = evaluator.pages(&columns)?;
    drop(columns);
    let Evaluator { dataset, targets, mut renderer, .. } = evaluator;
    let borders = borders_of(&plan, &places);
    let lines: Vec<Vec<DVec3>> = borders.iter().map(|border| line_of(border, &plan, &places, &dataset)).collect();
    let (mut crossing, mut banded, mut others) = (Vec::new(), Vec::new(), Vec::new());
    for view in dataset.test_views() {
        let (camera, target) = (&dataset.views[view].camera, targets.get(view)?);
        if !target.counts() {
            continue;
        }
        let image = {
            let working = &mut WorkingSet::default();
            let mut now = SceneNow { scene: &mut pages, step: 0, working, renderer: &mut *renderer };
            draw(&mut now, camera, &run.render)?;
            renderer.image()?
        };
        let mask = band_mask(camera, &lines, 0.5 * band, target.mask.as_deref());
        let banded_target = Target { mask: Some(mask), ..(*target).clone() };
        match banded_target.counts() {
            true => {
                crossing.push(json_psnr(psnr(image, &target)));
                banded.push(json_psnr(psnr(image, &banded_target)));
            }
            false => others.push(json_psnr(psnr(image, &target))),
        }
    }
    let borders = borders.iter().map(|border| beside(border, &places)).collect();
    let [crossing_psnr, band_psnr, other_psnr] =
        [&crossing, &banded, &others].map(|values| (!values.is_empty()).then(|| mean(values)));
    Ok(SeamReport { views: [crossing.len(), others.len()], crossing_psnr, band_psnr, other_psnr, borders })
}

/// The scene of a city, of which `model` must be, too.
/// Errors: it is of another one.
fn scene_of_both(city: &City, model: &Path) -> InputResult<PathBuf> {
    let (scene, of_model) = (city.scene()?, read_resolved(&model.join(CONFIG_FILE))?.scene);
    let whole = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    if whole(&scene) == whole(&of_model) {
        return Ok(scene);
    }
    let problem = format!("it is of {}, the city of {}", of_model.display(), scene.display());
    Err(InputError::new(
        model,
        problem,
        "name a run of the city's photos; if both are the same, name the scene with --scene",
    ))
}

/// Each row's place on the ground and its height, in the plan's frame.
fn places_of(plan: &CityPlan, dataset: &Dataset, columns: &Columns) -> Vec<([f64; 2], f64)> {
    let (origin, up) = (DVec3::from_array(plan.origin), DVec3::from_array(plan.up).normalize_or_zero());
    let place = |mean: &[f32; 3]| {
        let world = DVec3::from_array(mean.map(f64::from)) * dataset.frame.scale + dataset.frame.origin;
        let local = (world - origin) / plan.scale;
        (plan.ground(local.as_vec3().to_array()), local.dot(up))
    };
    columns.means.as_chunks::<3>().0.iter().map(place).collect()
}

/// The borders of neighbouring leaves of different cells, within the box of the rows without a hundredth on each side.
fn borders_of(plan: &CityPlan, places: &[([f64; 2], f64)]) -> Vec<Border> {
    let limits: [(f64, f64); 2] = [0, 1].map(|axis| {
        let mut along: Vec<f64> = places.iter().map(|(at, _)| at[axis]).collect();
        along.sort_unstable_by(f64::total_cmp);
        let cut = along.len() / 100;
        along.get(cut).copied().zip(along.iter().rev().nth(cut).copied()).unwrap_or((0.0, 0.0))
    });
    let mut borders = Vec::new();
    let pairs = plan.leaves.iter().flat_map(|a| plan.leaves.iter().map(move |b| (a, b)));
    for (a, b) in pairs.filter(|(a, b)| a.cell != b.cell) {
        borders.extend((0..2).filter_map(|across| border(a, b, across, limits[1 - across])));
    }
    borders
}

/// The border of two leaves if `b` begins where `a` ends on the axis `across`.
fn border(a: &GroundRect, b: &GroundRect, across: usize, (low, high): (f64, f64)) -> Option<Border> {
    let other = 1 - across;
    let (from, to) = (a.low[other].max(b.low[other]).max(low), a.high[other].min(b.high[other]).min(high));
    let meet = a.high[across] == b.low[across] && from < to;
    meet.then(|| Border { cells: [a.cell, b.cell], across, at: a.high[across], from, to })
}

impl Border {
    /// How far a place lies beyond it, and whether it lies beside it.
    fn beside(&self, at: [f64; 2], within: f64) -> Option<f64> {
        let (away, along) = (at[self.across] - self.at, at[1 - self.across]);
        (away.abs() < within && along >= self.from && along < self.to).then_some(away)
    }
}

fn beside(border: &Border, places: &[([f64; 2], f64)]) -> BorderReport {
    let mut gaussians = [0; 2];
    let strip = STRIP * (border.to - border.from);
    let sides = places.iter().filter_map(|(at, _)| border.beside(*at, strip));
    sides.for_each(|away| gaussians[usize::from(away >= 0.0)] += 1);
    BorderReport { cells: border.cells, gaussians }
}

/// Points of a border in the frame of the dataset, at the median height of the rows beside them.
fn line_of(border: &Border, plan: &CityPlan, places: &[([f64; 2], f64)], dataset: &Dataset) -> Vec<DVec3> {
    let step = (border.to - border.from) / POINTS as f64;
    let mut heights: Vec<Vec<f64>> = vec![Vec::new(); POINTS];
    let near = (border.to - border.from) * STRIP;
    for (at, height) in places {
        if border.beside(*at, near).is_some() {
            let point = ((at[1 - border.across] - border.from) / step) as usize;
            heights[point.min(POINTS - 1)].push(*height);
        }
    }
    let [first, second] = plan.axes.map(DVec3::from_array);
    let up = DVec3::from_array(plan.up).normalize_or_zero();
    let mut line = Vec::new();
    for (point, heights) in heights.iter_mut().enumerate().filter(|(_, heights)| !heights.is_empty()) {
        heights.sort_unstable_by(f64::total_cmp);
        let mut at = [0.0; 2];
        (at[border.across], at[1 - border.across]) = (border.at, border.from + (point as f64 + 0.5) * step);
        let local = first * at[0] + second * at[1] + up * heights[heights.len() / 2];
        let world = local * plan.scale + DVec3::from_array(plan.origin);
        line.push((world - dataset.frame.origin) / dataset.frame.scale);
    }
    line
}

/// The pixels of a view within `reach` of a border, without those that are masked already.
fn band_mask(camera: &Camera, lines: &[Vec<DVec3>], reach: f64, masked: Option<&[u8]>) -> Vec<u8> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut mask = vec![0u8; width * height];
    for line in lines {
        for pair in line.windows(2) {
            if let Some([from, to]) = piece_of(camera, pair[0], pair[1]) {
                mark(&mut mask, [width, height], reach, from, to);
            }
        }
    }
    masked.into_iter().flatten().zip(&mut mask).for_each(|(of_photo, of_band)| *of_band = (*of_band).min(*of_photo));
    mask
}

/// Where the piece of a line between two positions of the local frame is in the picture, without the part behind the camera.
fn piece_of(camera: &Camera, from: DVec3, to: DVec3) -> Option<[[f64; 2]; 2]> {
    let pixel = |at: DVec3| camera.project(at.to_array()).map(|(pixel, _)| pixel);
    // Halves the way from an end that is seen to one that is not.
    let last_seen = |mut seen: DVec3, mut unseen: DVec3| {
        for _ in 0..HALVINGS {
            let middle = 0.5 * (seen + unseen);
            *(if pixel(middle).is_some() { &mut seen } else { &mut unseen }) = middle;
        }
        pixel(seen)
    };
    match (pixel(from), pixel(to)) {
        (Some(a), Some(b)) => Some([a, b]),
        (Some(a), None) => last_seen(from, to).map(|b| [a, b]),
        (None, Some(b)) => last_seen(to, from).map(|a| [a, b]),
        (None, None) => None,
    }
}

/// Marks the pixels within `reach` of a piece of a line.
fn mark(mask: &mut [u8], [width, height]: [usize; 2], reach: f64, from: [f64; 2], to: [f64; 2]) {
    let range = |axis: usize, side: usize| {
        let (low, high) = (from[axis].min(to[axis]) - reach, from[axis].max(to[axis]) + reach);
        (low.max(0.0) as usize)..(high.max(0.0) as usize + 1).min(side)
    };
    let along = [to[0] - from[0], to[1] - from[1]];
    let length = (along[0] * along[0] + along[1] * along[1]).max(1e-12);
    for y in range(1, height) {
        for x in range(0, width) {
            let off = [x as f64 + 0.5 - from[0], y as f64 + 0.5 - from[1]];
            let share = ((off[0] * along[0] + off[1] * along[1]) / length).clamp(0.0, 1.0);
            let away = [off[0] - share * along[0], off[1] - share * along[1]];
            if away[0] * away[0] + away[1] * away[1] <= reach * reach {
                mask[y * width + x] = 255;
            }
        }
    }
}
