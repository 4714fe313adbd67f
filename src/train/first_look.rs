//! The pages of a run's first Gaussians without the run: what planning looks at, and how long a step on them takes.
//!
//! Invariants: 1. nothing is stored; 2. of the Gaussians no more is in memory at once than an import takes, and then the
//! pages of one view: the largest, if that is asked about, and one to time that is small enough; 3. pages and bounds are those that the run begins with.

use super::error::TrainError;
use super::machine;
use super::memory::host_budget;
use super::pages::{PageRules, PagedScene};
use super::preflight;
use super::probe::Probe;
use super::start::Start;
use super::step::train_step;
use super::trainer::Trainer;
use super::working_set::WorkingSet;
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

/// Steps are timed until this much time has passed ...
const TIMED: Duration = Duration::from_secs(1);
/// ... and no more than so many are.
const TIMED_STEPS: u32 = 8;
/// Pages of the view that is timed take at most this share of the memory.
const TIMED_SHARE: u64 = 4;

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
    /// How long a step takes here, where that was asked for and a view that sees anything fits into memory.
    pub step: Option<StepTime>,
}

/// How long a step takes.
#[derive(Debug, Clone, PartialEq)]
pub struct StepTime {
    /// With the bands of the last step, on a view that needs as many pages as half of those that see anything do at most.
    pub seconds: f64,
    /// What rendered it.
    pub device: String,
}

/// What else to look for: reads the Gaussians once more and renders a view, each.
#[derive(Debug, Clone, Copy, Default)]
pub struct LookFor {
    /// For how many frames so many bytes of memory are good.
    pub frames_within: Option<u64>,
    /// How long a step takes.
    pub step: bool,
}

/// Looks at what a run of `scene` would begin with. `folder` is for what does not fit in memory; what is written there has
/// no name.
///
/// # Errors
/// As [`Start::look`]; the memory asked about does not hold a view, one cannot be rendered, or there is no such device.
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
    let step = if look_for.step { world.step_time(options, host_mem)? } else { None };
    let World { start, index, .. } = world;
    let bytes = |page: &PageMeta| PageLayout { rows: page.rows as usize, sh_degree: config.sh_degree }.bytes() as u32;
    Ok(FirstLook {
        dataset: start.into_dataset(),
        page_bytes: index.iter().map(bytes).collect(),
        gaussians: index.iter().map(|page| u64::from(page.rows)).sum(),
        index,
        frames,
        step,
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

    /// Times steps with a black photo: their median. Those of a run are up to a third longer, since their rows were not in a
    /// cache a step before.
    fn step_time(&mut self, options: RunOptions, host_mem: Option<u64>) -> Result<Option<StepTime>, TrainError> {
        let options = RunOptions { sh_degree_start: options.sh_degree_at(options.steps.saturating_sub(1)), ..options };
        let frame_bytes = PagerConfig::in_memory(options.page_rows, options.sh_degree).frame_bytes() as u64;
        let pages_most = host_mem.map_or(u64::MAX, |bytes| bytes / TIMED_SHARE / frame_bytes);
        let Some(view) = self.middling_view(pages_most) else { return Ok(None) };
        let mut scene = self.pages_of(view, &options, host_mem)?;
        let camera = self.start.dataset.views[view].camera;
        let render = RenderOptions { sh_degree: scene.rules.sh_degree(), ..options.render };
        let (mut renderer, _) = machine::renderer(self.config)?;
        let mut working = WorkingSet::default();
        let rgb = vec![0; 3 * camera.pixels()];
        let target = Target { width: camera.width, height: camera.height, rgb, mask: None };
        let mut step = |number| {
            let (what, how) = ((number, &camera, &target), (&render, &options.loss));
            let began = Instant::now();
            train_step(&mut scene, &mut working, &mut *renderer, what, how, false, usize::MAX)?;
            Ok::<_, TrainError>(began.elapsed().as_secs_f64())
        };
        // The first takes memory from the system.
        step(0)?;
        let (mut seconds, began) = (Vec::new(), Instant::now());
        for number in 1..=TIMED_STEPS {
            seconds.push(step(number)?);
            if began.elapsed() > TIMED {
                break;
            }
        }
        seconds.sort_unstable_by(f64::total_cmp);
        Ok(Some(StepTime { seconds: seconds[seconds.len() / 2], device: renderer.device() }))
    }

    /// Of the training views that see anything, the one in the middle by pages, or else the largest with no more than so many.
    fn middling_view(&self, pages_most: u64) -> Option<usize> {
        let dataset = &self.start.dataset;
        let mut pages = Vec::new();
        let mut views = Vec::new();
        for view in dataset.train_views() {
            visible_pages(&self.index, &dataset.views[view].camera, &mut pages);
            if !pages.is_empty() {
                views.push((pages.len() as u64, view));
            }
        }
        views.sort_unstable();
        let middle = views.len().div_ceil(2);
        views[..middle].iter().rev().find(|(pages, _)| *pages <= pages_most).map(|&(_, view)| view)
    }
}
