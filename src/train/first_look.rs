//! The pages of a run's first Gaussians without the run: what planning looks at, and how long a step on them takes.
//!
//! Invariants: 1. nothing is stored; 2. of the Gaussians no more is in memory at once than an import takes, and then the
//! pages of one view; 3. pages and bounds are those that the run begins with.

use super::memory::{Probe, host_budget};
use super::pages::{PageRules, PagedScene};
use super::preflight;
use super::start::Start;
use super::step::{WorkingSet, train_step};
use super::trainer::{TrainError, Trainer};
use crate::base::ids::PageNo;
use crate::config::file::TrainConfig;
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::paging::pager::{Pager, PagerConfig};
use crate::render::RenderOptions;
use crate::render::cpu::CpuRenderer;
use crate::scene::image::Target;
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;
use std::path::Path;
use std::time::{Duration, Instant};

/// Steps are timed until this much time has passed, but the first is not counted ...
const TIMED: Duration = Duration::from_secs(1);
/// ... and no more than so many are.
const TIMED_STEPS: u32 = 8;

/// What a run would begin with.
pub struct FirstLook {
    /// Views and frame.
    pub dataset: Dataset,
    /// The pages.
    pub index: Vec<PageMeta>,
    /// Bytes of each on disk with all bands in use, without header and padding.
    pub page_bytes: Vec<u32>,
    /// Gaussians.
    pub gaussians: u64,
    /// Frames that the memory asked about leaves for pages, about as a run on the CPU gets them.
    pub frames: Option<u64>,
    /// Seconds of a step with all bands on this machine's CPU, where that was asked for and there is anything to see.
    pub step_seconds: Option<f64>,
}

/// What else to look for, which costs rendering a view each.
#[derive(Debug, Clone, Copy, Default)]
pub struct LookFor {
    /// For how many frames so many bytes of memory are good.
    pub frames_within: Option<u64>,
    /// How long a step takes.
    pub step_seconds: bool,
}

/// Looks at what a run of `scene` would begin with. `folder` is for what does not fit in memory; what is written there has
/// no name.
///
/// # Errors
/// As [`Start::look`]; the memory asked about does not hold a view, or one cannot be rendered.
pub fn first_look(
    scene: &Path,
    config: &TrainConfig,
    folder: &Path,
    look_for: LookFor,
) -> Result<FirstLook, TrainError> {
    let host_mem = host_budget(config);
    let mut start = Start::look(scene, config, folder, host_mem)?;
    let options =
        RunOptions { sh_degree_start: start.sh_degree_start, ..RunOptions::new(config, start.dataset.scene_scale) };
    let rules = PageRules::new(&options);
    let mut index = Vec::new();
    start.for_each_page(&options, folder, host_mem, &mut |id, state| {
        index.push(rules.meta(id, &state));
        Ok(())
    })?;
    let mut world = World { config, start, index, folder };
    let frames = look_for.frames_within.map(|bytes| world.frames_within(&options, bytes)).transpose()?;
    let step_seconds = if look_for.step_seconds { world.step_seconds(host_mem)? } else { None };
    let World { start, index, .. } = world;
    let bytes = |page: &PageMeta| PageLayout { rows: page.rows as usize, sh_degree: config.sh_degree }.bytes() as u32;
    Ok(FirstLook {
        dataset: start.into_dataset(),
        page_bytes: index.iter().map(bytes).collect(),
        gaussians: index.iter().map(|page| u64::from(page.rows)).sum(),
        index,
        frames,
        step_seconds,
    })
}

/// What a run begins with.
struct World<'a> {
    config: &'a TrainConfig,
    start: Start,
    index: Vec<PageMeta>,
    folder: &'a Path,
}

impl World<'_> {
    /// Frames that `host_mem` leaves beside what the largest view takes, which is rendered for it.
    fn frames_within(&mut self, options: &RunOptions, host_mem: u64) -> Result<u64, TrainError> {
        let largest = preflight::largest_view(&self.start.dataset, &self.index);
        let Some(view) = largest.view else { return Ok(0) };
        let scene = self.pages_of(view, options, Some(host_mem))?;
        let dataset = &self.start.dataset;
        let mut trainer = Trainer::of_scene(scene, dataset, Box::new(CpuRenderer::new()), options.clone());
        let rows = self.index.iter().map(|page| u64::from(page.rows)).sum();
        let probe = Probe { views: vec![view], rows, pages: self.index.len(), driver: 0 };
        preflight::frames_within(self.config, dataset, &mut trainer, &probe, largest, host_mem)
    }

    /// The pages that a view needs, in memory.
    fn pages_of(&mut self, view: usize, options: &RunOptions, host_mem: Option<u64>) -> Result<PagedScene, TrainError> {
        let mut pages = Vec::new();
        visible_pages(&self.index, &self.start.dataset.views[view].camera, &mut pages);
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
        let mut scene = PagedScene::empty(pager, options);
        let mut number = 0;
        self.start.for_each_page(options, self.folder, host_mem, &mut |id, state| {
            if pages.binary_search(&PageNo(number)).is_ok() {
                scene.insert_first_page(id, &state)?;
            }
            number += 1;
            Ok(())
        })?;
        Ok(scene)
    }

    /// Seconds of a step on the view that needs as many pages as half of the views do at most, with all bands and a black
    /// photo. The shortest of a few: what else the machine does only makes them longer.
    fn step_seconds(&mut self, host_mem: Option<u64>) -> Result<Option<f64>, TrainError> {
        let dataset = &self.start.dataset;
        let mut list = Vec::new();
        let mut views: Vec<(usize, usize)> = Vec::new();
        for view in dataset.train_views() {
            visible_pages(&self.index, &dataset.views[view].camera, &mut list);
            views.push((list.len(), view));
        }
        views.sort_unstable();
        let Some(&(1.., view)) = views.get(views.len() / 2) else { return Ok(None) };
        let (camera, scale) = (dataset.views[view].camera, dataset.scene_scale);
        let options = RunOptions { sh_degree_start: self.config.sh_degree, ..RunOptions::new(self.config, scale) };
        let mut scene = self.pages_of(view, &options, host_mem)?;
        let render = RenderOptions { sh_degree: scene.rules.sh_degree(), ..options.render };
        let (mut working, mut renderer) = (WorkingSet::default(), CpuRenderer::new());
        let rgb = vec![0; 3 * camera.pixels()];
        let target = Target { width: camera.width, height: camera.height, rgb, mask: None };
        let (mut shortest, began) = (f64::INFINITY, Instant::now());
        for step in 0..=TIMED_STEPS {
            let (what, how) = ((step, &camera, &target), (&render, &options.loss));
            let started = Instant::now();
            train_step(&mut scene, &mut working, &mut renderer, what, how, false)?;
            // The first takes memory from the system.
            if step > 0 {
                shortest = shortest.min(started.elapsed().as_secs_f64());
                if began.elapsed() > TIMED {
                    break;
                }
            }
        }
        Ok(Some(shortest))
    }
}
