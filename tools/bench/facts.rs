//! The facts of a scene that planning a sweep needs: number of pages, and pages of the largest view.

use gsscale::base::error::InputResult;
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::paging::simulation::auto::automatic_order;
use gsscale::scene::camera::Camera;
use gsscale::schedule::order::Order;
use gsscale::schedule::visibility::ViewPages;
use gsscale::train::error::TrainError;
use gsscale::train::inputs::prepare::prepare;
use gsscale::train::preflight::forecast::{Reach, reach};
use gsscale::train::step::pages::PagedScene;
use std::path::Path;

/// Memory limit for choosing an order of views, bytes.
const ORDER_BYTES: u64 = 256 << 20;
/// Frames per page of the largest view: Gaussians become larger in training and reach into more views
/// (sheffield_cross_395, 3,000 steps without densification: from 227 pages to 270, factor 1.19).
const SPARE: f64 = 1.25;
/// Growth of the number of pages over that of Gaussians: a split leaves two half-full pages (the same scene up to
/// 64,000 Gaussians: 776 pages, where full pages would be 720).
const SPLIT_GROWTH: f64 = 1.1;

/// A scene before training.
pub struct Facts {
    pub gaussians: u64,
    /// Pages at the start.
    pub pages: u64,
    /// Pages of the largest view, at the start.
    pub largest_view: u64,
    /// Expected pages at the end divided by pages at the start.
    growth: f64,
    views: ViewPages,
    cameras: Vec<Camera>,
}

impl Facts {
    /// Reads the scene and partitions its initial Gaussians into pages, in memory.
    ///
    /// # Errors
    /// The errors of a run.
    pub fn of(scene: &Path, config: &TrainConfig) -> Result<Facts, TrainError> {
        let prepared = prepare(scene, config)?;
        let (dataset, columns) = (&prepared.dataset, &prepared.columns);
        let options =
            RunOptions { sh_degree_start: prepared.sh_degree_start, ..RunOptions::new(config, dataset.scene_scale) };
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
        let scene = PagedScene::new(columns, pager, &options)?;
        let cameras: Vec<Camera> = dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect();
        let views = ViewPages::new(scene.pager.index(), &cameras);
        let gaussians = columns.rows() as u64;
        Ok(Facts {
            gaussians,
            growth: growth(gaussians, cameras.iter().map(|camera| camera.pixels() as u64).sum(), config),
            pages: scene.pager.index().len() as u64,
            largest_view: views.most() as u64,
            views,
            cameras,
        })
    }

    /// Expected pages at the end of training, the base of all shares.
    pub fn pages_at_end(&self) -> u64 {
        (self.pages as f64 * self.growth).ceil() as u64
    }

    /// Frames for a share of the pages, in percent; `None` if fewer than [`Facts::fewest_frames`].
    pub fn frames(&self, percent: f64) -> Option<u64> {
        let frames = (percent / 100.0 * self.pages_at_end() as f64).ceil() as u64;
        (frames >= self.fewest_frames()).then_some(frames)
    }

    /// Frames for the largest view, with a reserve.
    pub fn fewest_frames(&self) -> u64 {
        (self.largest_view as f64 * self.growth * SPARE).ceil() as u64 + 2
    }

    /// Share of the pages that these frames hold, in percent.
    pub fn percent(&self, frames: u64) -> f64 {
        100.0 * frames as f64 / self.pages_at_end() as f64
    }

    /// The order that `--view-order auto` chooses for this many frames.
    ///
    /// # Errors
    /// The largest view needs more frames.
    pub fn order(&self, frames: u64, seed: u64) -> InputResult<Order> {
        let (pages, frames) = (self.pages as usize, frames.max(self.largest_view) as usize);
        automatic_order(&self.views, &self.cameras, pages, frames, seed, ORDER_BYTES)
            .map_err(|e| gsscale::base::error::InputError::new("--share", e.to_string(), "give a larger share"))
    }
}

fn growth(gaussians: u64, pixels: u64, config: &TrainConfig) -> f64 {
    match reach(config, gaussians, pixels, 0, &[]) {
        (_, Reach::Constant) => 1.0,
        (last, _) => last as f64 / gaussians.max(1) as f64 * SPLIT_GROWTH,
    }
}
