//! What the photos see of the prior: the blending weight of each page in each view. It decides which cells take a view, and what their
//! rings hold.
//!
//! Invariant: the weights are those of the prior's rows at the prior's photo sizes, whatever machine measures them, up to rounding.

use super::costs::PhotoBytes;
use super::plan::ground;
use super::prior::keys_of_prior;
use super::{City, NO_PRIOR, config_of};
use crate::base::count::Count;
use crate::base::error::{InputError, InputResult};
use crate::base::ids::{PageId, PageNo};
use crate::config::file::{TrainConfig, TrainOverrides};
use crate::config::limits::RunOptions;
use crate::config::values::Up;
use crate::dataset::loader::{View, target_size};
use crate::dataset::model::Split;
use crate::densify::growth::counted_pixels;
use crate::render::RenderOptions;
use crate::scene::page_meta::PageBounds;
use crate::scene::rotation::VIEWER_UP;
use crate::train::error::TrainError;
use crate::train::inputs::machine;
use crate::train::memory::host_budget;
use crate::train::start::first_scene::Start;
use crate::train::step::pages::WorkingSet;
use crate::train::step::view::{SceneNow, weigh_pages};
use crate::train::stores::StoredStart;
use std::path::Path;

/// The prior as the cut sees it.
pub(crate) struct Seen {
    /// Digest of its rows.
    pub digest: u64,
    /// The pages with rows, in the order of their ids.
    pub pages: Vec<SeenPage>,
    pub views: Vec<SeenView>,
    pub origin: [f64; 3],
    pub scale: f64,
    /// The direction of the dataset that is up.
    pub up: [f64; 3],
    pub axes: [[f64; 3]; 2],
    pub photo: PhotoBytes,
    /// [`counted_pixels`] of the whole scene's photos, over those of the prior's; 1 at least.
    pub detail: f64,
    pub sh_degree: u8,
}

pub(crate) struct SeenPage {
    pub id: PageId,
    pub rows: u64,
    /// The middle and the corners of its box on the ground.
    pub middle: [f64; 2],
    pub low: [f64; 2],
    pub high: [f64; 2],
}

pub(crate) struct SeenView {
    pub name: String,
    pub is_train: bool,
    /// Where the camera stands on the ground.
    pub at: [f64; 2],
    /// Places in the list of pages with their weights, which are not zero.
    pub weights: Vec<(usize, f64)>,
}

/// Draws the prior from every camera, and weighs its pages.
/// Errors: there is no finished prior, or the scene or the prior cannot be read.
pub(crate) fn see(scene: &Path, city: &City, keys: &TrainOverrides, quiet: bool) -> Result<Seen, TrainError> {
    if !city.prior_store().is_dir() {
        return Err(InputError::new(city.prior_store(), "the city has no finished prior", NO_PRIOR).into());
    }
    let (config, whole) = prior_config(city, keys)?;
    machine::set_up(&config)?;
    let host_mem = host_budget(config.host_mem.0);
    // The points decide the frame, as they did for the prior.
    let start = Start::look(scene, &config, &city.0, host_mem)?;
    let up = match whole.up {
        Up::Along(up) => up,
        Up::Auto | Up::Keep => start.up()?.unwrap_or(VIEWER_UP),
    };
    let dataset = start.into_dataset();
    let mut store = StoredStart::open(&city.prior_store(), host_mem.unwrap_or(1 << 30), 2)?;
    let frame = (dataset.frame.origin.to_array(), dataset.frame.scale);
    let print = &store.state().origin.dataset;
    if (print.origin, print.scale) != frame {
        let problem = "the poses or points of the scene have changed since the prior was trained";
        return Err(InputError::new(scene, problem, "restore them, or begin another city").into());
    }
    let (digest, axes) = (store.digest()?, ground_axes(up));
    let ids = store.pages();
    let index = store.scene().pager.index();
    let ids: Vec<(PageNo, PageId)> = ids.into_iter().filter(|(no, _)| index[no.index()].rows > 0).collect();
    let pages =
        ids.iter().map(|&(no, id)| seen_page(id, &index[no.index()].bounds, index[no.index()].rows, &axes)).collect();
    let mut place = vec![usize::MAX; index.len()];
    ids.iter().enumerate().for_each(|(at, (no, _))| place[no.index()] = at);
    let sh_degree = store.sh_degree();
    let render = RenderOptions { sh_degree, ..RunOptions::new(&config, dataset.scene_scale).render };
    let mut renderer = machine::renderer(&config, machine::DeviceUse::Pictures)?.renderer;
    let (mut views, mut working) = (Vec::new(), WorkingSet::default());
    let mut photo = PhotoBytes { file: 0.0, decoded: 0.0 };
    let (mut counted, mut counted_of_prior) = (0, 0);
    let share = 1.0 / dataset.views.len() as f64;
    let shown = Count::new("views weighed", dataset.views.len() as u32, quiet);
    let step = store.state().trainer.step;
    for View { name, split, camera, photo: source } in &dataset.views {
        let file = std::fs::metadata(&source.image_path).map_or(0, |of| of.len());
        photo.file += file as f64 * share;
        let pixels = |(width, height): (u32, u32)| u64::from(width) * u64::from(height);
        let limit = Some(whole.max_resolution).filter(|&most| most > 0);
        let of_cell = target_size((source.header.width, source.header.height), whole.data_factor, limit);
        let [of_cell, of_prior] = [of_cell, source.target].map(pixels);
        photo.decoded += source.target_bytes() as f64 * of_cell as f64 / of_prior as f64 * share;
        counted += counted_pixels(of_cell);
        counted_of_prior += counted_pixels(of_prior);
        let mut now = SceneNow { scene: store.scene(), step, working: &mut working, renderer: &mut *renderer };
        let weights = weigh_pages(&mut now, camera, &render)?.into_iter().filter(|(_, weight)| *weight > 0.0);
        let weights = weights.map(|(page, weight)| (place[page.index()], weight)).collect();
        let (name, is_train, at) = (name.clone(), *split == Split::Train, ground(&axes, camera.centre()));
        views.push(SeenView { name, is_train, at, weights });
        shown.show(views.len() as u32);
    }
    let detail = (counted as f64 / counted_of_prior as f64).max(1.0);
    Ok(Seen { digest, pages, views, origin: frame.0, scale: frame.1, up, axes, photo, detail, sh_degree })
}

/// The configs of the prior's run and of the whole scene, with the keys of this machine.
fn prior_config(city: &City, machine: &TrainOverrides) -> InputResult<(TrainConfig, TrainConfig)> {
    let mut keys = city.given_keys()?;
    let whole = config_of(&city.keys(), keys.clone(), machine)?;
    keys.extend(keys_of_prior(&whole));
    Ok((config_of(&city.keys(), keys, machine)?, whole))
}

fn seen_page(id: PageId, bounds: &PageBounds, rows: u32, axes: &[[f64; 3]; 2]) -> SeenPage {
    let middle = ground(axes, bounds.centre());
    let half =
        axes.map(|axis| (0..3).map(|i| 0.5 * axis[i].abs() * f64::from(bounds.hi[i] - bounds.lo[i])).sum::<f64>());
    let [low, high] = [-1.0, 1.0].map(|side| [0, 1].map(|i| middle[i] + side * half[i]));
    SeenPage { id, rows: rows.into(), middle, low, high }
}

/// Two directions at right angles to `up` and to each other: those of the dataset's axes that are nearest to the ground, laid onto it.
fn ground_axes(up: [f64; 3]) -> [[f64; 3]; 2] {
    let up = glam::DVec3::from_array(up).normalize_or(glam::DVec3::Z);
    let along = if up.x.abs() < 0.9 { glam::DVec3::X } else { glam::DVec3::Y };
    let first = (along - up * along.dot(up)).normalize_or(glam::DVec3::Y);
    [first.to_array(), up.cross(first).to_array()]
}
