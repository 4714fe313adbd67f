//! What has to be known of a scene before its runs are planned: how many pages there are and how many a view needs.

use gsscale::base::error::InputResult;
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::dataset::loader::Dataset;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::scene::camera::Camera;
use gsscale::schedule::auto::automatic_order;
use gsscale::schedule::visibility::ViewPages;
use gsscale::train::pages::PagedScene;
use gsscale::train::run::prepare;
use gsscale::train::trainer::TrainError;
use std::path::Path;

/// Memory that choosing an order of views may take, bytes.
const ORDER_BYTES: u64 = 256 << 20;
/// Frames beyond those of the largest view: pages split and views grow while Gaussians do.
const SPARE_FIXED: f64 = 1.05;
const SPARE_GROWING: f64 = 1.5;

/// A scene at its start.
pub struct Facts {
    /// Gaussians.
    pub gaussians: u64,
    /// Pages.
    pub pages: u64,
    /// Pages of the view that needs most.
    pub largest_view: u64,
    views: ViewPages,
    cameras: Vec<Camera>,
}

impl Facts {
    /// Reads the scene and cuts its first Gaussians into pages, in memory.
    ///
    /// # Errors
    /// As a run.
    pub fn of(scene: &Path, config: &TrainConfig) -> Result<Facts, TrainError> {
        let prepared = prepare(scene, config)?;
        let (dataset, columns) = (&prepared.dataset, &prepared.columns);
        let options =
            RunOptions { sh_degree_start: prepared.sh_degree_start, ..RunOptions::new(config, dataset.scene_scale) };
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
        let scene = PagedScene::new(columns, pager, &options)?;
        let cameras = cameras(dataset);
        let views = ViewPages::new(scene.pager.index(), &cameras);
        Ok(Facts {
            gaussians: columns.rows() as u64,
            pages: scene.pager.index().len() as u64,
            largest_view: views.most() as u64,
            views,
            cameras,
        })
    }

    /// Frames for a share of the pages, in percent, or `None` where they do not hold the largest view with some to spare.
    pub fn frames(&self, percent: f64, config: &TrainConfig) -> Option<u64> {
        let frames = (percent / 100.0 * self.pages as f64).ceil() as u64;
        (frames >= self.fewest_frames(config)).then_some(frames)
    }

    /// Frames that hold the largest view with some to spare.
    pub fn fewest_frames(&self, config: &TrainConfig) -> u64 {
        let spare = if config.strategy == "none" { SPARE_FIXED } else { SPARE_GROWING };
        (self.largest_view as f64 * spare).ceil() as u64 + 2
    }

    /// The order that `--view-order auto` stands for with this many frames.
    ///
    /// # Errors
    /// The frames do not hold a view.
    pub fn order(&self, frames: u64, seed: u64) -> InputResult<String> {
        let (pages, frames) = (self.pages as usize, frames.max(self.largest_view) as usize);
        automatic_order(&self.views, &self.cameras, pages, frames, seed, ORDER_BYTES)
            .map(|order| order.to_string())
            .map_err(|e| gsscale::base::error::InputError::new("--share", e.to_string(), "give a larger share"))
    }
}

fn cameras(dataset: &Dataset) -> Vec<Camera> {
    dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect()
}
