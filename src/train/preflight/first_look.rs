//! The pages of a run's first Gaussians, for planning without a run, and the time of a step on them.
//!
//! Invariants: 1. no page is stored; 2. memory holds at most the Gaussians of an import, then the pages of one view:
//! the largest view for the frames of a budget, a small enough view for timing; 3. pages and bounds equal those at the
//! start of a run.

use super::forecast::STEP_OVER_RENDERING;
use super::plan::{self, Probe, largest_view, with_largest_photo};
use crate::base::ids::PageNo;
use crate::config::file::TrainConfig;
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::paging::pager::{Pager, PagerConfig};
use crate::render::cpu::CpuRenderer;
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;
use crate::train::error::TrainError;
use crate::train::inputs::machine;
use crate::train::memory::host_budget;
use crate::train::start::first_scene::Start;
use crate::train::state::trainer::Trainer;
use crate::train::step::pages::{PagedScene, SceneRules};
use std::path::Path;

/// Views that are rendered for the time of a step.
const TIMED_STEPS: usize = 5;
/// Pages of the timed view take at most 1/4 of the memory.
const TIMED_SHARE: u64 = 4;

/// The scene with which a run would begin.
pub struct FirstLook {
    /// Views and frame.
    pub dataset: Dataset,
    pub index: Vec<PageMeta>,
    /// Bytes of each page on disk at the full SH degree, without header and padding.
    pub page_bytes: Vec<u32>,
    pub gaussians: u64,
    /// Approximate frames of a CPU run within the requested memory.
    pub frames: Option<u64>,
    /// Time of a step on this machine, if requested and if a view that sees pages fits in memory.
    pub step: Option<StepTime>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct StepTime {
    /// Seconds at the SH degree of the last step, on the view of median page count among those that see pages.
    pub seconds: f64,
    /// Name of the renderer.
    pub device: String,
}

/// Optional results; each reads the Gaussians again and renders a view.
#[derive(Debug, Clone, Copy, Default)]
pub struct LookFor {
    /// Compute the frames within this budget, bytes.
    pub frames_within: Option<u64>,
    /// Time a step.
    pub step: bool,
}

/// Reads the scene with which a run of `scene` would begin. `folder` holds unnamed temporary files for data that
/// exceeds memory.
/// Errors: as [`Start::look`]; the budget does not hold a view, a view cannot be rendered, or the device does not exist.
pub fn first_look(
    scene: &Path,
    config: &TrainConfig,
    folder: &Path,
    look_for: LookFor,
) -> Result<FirstLook, TrainError> {
    let host_mem = host_budget(config.host_mem.0);
    let mut start = Start::look(scene, config, folder, host_mem)?;
    let options =
        RunOptions { sh_degree_start: start.sh_degree_start, ..RunOptions::new(config, start.dataset.scene_scale) };
    let rules = SceneRules::new(&options);
    let mut index = Vec::new();
    start.for_each_page(&options, folder, host_mem, &mut |id, state| {
        index.push(rules.meta(id, &state));
        Ok(())
    })?;
    let mut pages = FirstPages { config, start, index, folder };
    let frames = look_for.frames_within.map(|bytes| pages.frames_within(&options, bytes)).transpose()?;
    let step = if look_for.step { pages.step_time(options, host_mem)? } else { None };
    let FirstPages { start, index, .. } = pages;
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

/// The start of a run, with its pages' index.
struct FirstPages<'a> {
    config: &'a TrainConfig,
    start: Start,
    index: Vec<PageMeta>,
    folder: &'a Path,
}

impl FirstPages<'_> {
    /// Frames within `host_mem`; renders the largest view to measure its memory.
    fn frames_within(&mut self, options: &RunOptions, host_mem: u64) -> Result<u64, TrainError> {
        let largest = largest_view(&self.start.dataset, &self.index);
        let Some(view) = largest.view else { return Ok(0) };
        let scene = self.pages_of(view, options, Some(host_mem))?;
        let dataset = &self.start.dataset;
        let mut trainer = Trainer::of_scene(scene, dataset, Box::new(CpuRenderer::new()), options.clone());
        let rows = self.index.iter().map(|page| u64::from(page.rows)).sum();
        let probe = Probe {
            views: with_largest_photo(&self.start.dataset, vec![view]),
            rows,
            pages: self.index.len(),
            driver: 0,
        };
        plan::frames_within(self.config, dataset, &mut trainer, &probe, largest.pages, host_mem)
    }

    /// Loads the pages of a view into memory.
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

    /// Time of a step, from the same measurement as a run's forecast.
    fn step_time(&mut self, options: RunOptions, host_mem: Option<u64>) -> Result<Option<StepTime>, TrainError> {
        let options = RunOptions { sh_degree_start: options.sh_degree_at(options.steps.saturating_sub(1)), ..options };
        let frame_bytes = PagerConfig::in_memory(options.page_rows, options.sh_degree).frame_bytes() as u64;
        let pages_most = host_mem.map_or(u64::MAX, |bytes| bytes / TIMED_SHARE / frame_bytes);
        let Some(view) = self.median_view(pages_most) else { return Ok(None) };
        let scene = self.pages_of(view, &options, host_mem)?;
        let renderer = machine::renderer(self.config, machine::DeviceUse::Pictures)?.renderer;
        let mut trainer = Trainer::of_scene(scene, &self.start.dataset, renderer, options);
        let probed = trainer.probe_views(&self.start.dataset, &[view; TIMED_STEPS])?;
        Ok(Some(StepTime { seconds: probed.seconds * STEP_OVER_RENDERING, device: trainer.renderer.device() }))
    }

    /// The training view of median page count among those that see pages, or the largest with at most `pages_most`
    /// pages.
    fn median_view(&self, pages_most: u64) -> Option<usize> {
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
