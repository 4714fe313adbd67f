//! The facts of a scene that planning a sweep needs: number of pages, and pages of the largest view.

use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::densify::growth::counted_pixels;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::scene::camera::Camera;
use gsscale::schedule::visibility::ViewPages;
use gsscale::train::error::TrainError;
use gsscale::train::preflight::forecast::{Reach, TrainingPhotos, reach};
use gsscale::train::start::first_scene::prepare;
use gsscale::train::step::pages::PagedScene;
use std::path::Path;

/// Frames per page of the largest view: Gaussians become larger in training and reach into more views
/// (sheffield_cross_395, 3,000 steps without densification: from 227 pages to 270, factor 1.19).
const SPARE: f64 = 1.25;
/// Growth of the number of pages over that of Gaussians: a split leaves two half-full pages (the same scene up to
/// 64,000 Gaussians: 776 pages, where full pages would be 720).
const SPLIT_GROWTH: f64 = 1.1;

/// A scene before training, with the pages that a config gives it.
pub struct Facts {
    /// Pages at the start.
    pages: u64,
    /// Pages of the largest view, at the start.
    largest_view: u64,
    /// Expected pages at the end divided by pages at the start.
    growth: f64,
}

impl Facts {
    /// Reads the scene and partitions its initial Gaussians into pages, in memory. Errors: the errors of a run.
    pub fn of(scene: &Path, config: &TrainConfig) -> Result<Facts, TrainError> {
        let prepared = prepare(scene, config)?;
        let (dataset, columns) = (&prepared.dataset, &prepared.columns);
        let options =
            RunOptions { sh_degree_start: prepared.sh_degree_start, ..RunOptions::new(config, dataset.scene_scale) };
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
        let scene = PagedScene::new(columns, pager, &options)?;
        let cameras = dataset.train_cameras();
        let views = ViewPages::new(scene.pager.index(), &cameras);
        let pixels_of = |camera: &Camera| camera.pixels() as u64;
        let pixels =
            [cameras.iter().map(pixels_of).sum(), cameras.iter().map(|camera| counted_pixels(pixels_of(camera))).sum()];
        let gaussians = columns.rows() as u64;
        let per_page = views.total() as f64 / scene.pager.index().len().max(1) as f64;
        let photos = TrainingPhotos { pixels, count: cameras.len(), per_page };
        let growth = match reach(config, gaussians, photos, 0, &[]) {
            (_, Reach::Constant) => 1.0,
            (last, _) => last as f64 / gaussians.max(1) as f64 * SPLIT_GROWTH,
        };
        Ok(Facts { growth, pages: scene.pager.index().len() as u64, largest_view: views.most() as u64 })
    }

    /// Frames for a share of the pages, in percent, raised to the need of the largest view.
    /// Errors: a message: these are all pages, so nothing would leave memory.
    pub fn frames(&self, percent: f64) -> Result<u32, String> {
        let pages_at_end = (self.pages as f64 * self.growth).ceil();
        let fewest = (self.largest_view as f64 * self.growth * SPARE).ceil() + 2.0;
        let frames = (percent / 100.0 * pages_at_end).ceil().max(fewest);
        match frames < pages_at_end {
            true => Ok(frames as u32),
            false => {
                let (largest, pages) = (self.largest_view, self.pages);
                Err(format!("the largest view needs {largest} of {pages} pages: nothing would leave memory"))
            }
        }
    }
}
