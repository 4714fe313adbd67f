//! The pages of a run's first Gaussians without the run: what planning looks at.
//!
//! Invariants: 1. nothing is stored; 2. of the Gaussians no more is in memory at once than an import takes, and then the
//! pages of one view; 3. pages and bounds are those that the run begins with.

use super::memory::{Probe, host_budget};
use super::pages::{PageRules, PagedScene};
use super::preflight;
use super::start::Start;
use super::trainer::{TrainError, Trainer};
use crate::base::ids::PageNo;
use crate::config::file::TrainConfig;
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::paging::pager::{Pager, PagerConfig};
use crate::render::cpu::CpuRenderer;
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;
use std::path::Path;

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
}

/// Looks at what a run of `scene` would begin with, and, where `for_memory` names bytes, for how many frames they are good.
/// `folder` is for what does not fit in memory; what is written there has no name.
///
/// # Errors
/// As [`Start::look`]; `for_memory` does not hold a view, or one cannot be rendered.
pub fn first_look(
    scene: &Path,
    config: &TrainConfig,
    folder: &Path,
    for_memory: Option<u64>,
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
    let frames =
        for_memory.map(|bytes| frames_within(config, &mut start, (&options, &index), folder, bytes)).transpose()?;
    let bytes = |page: &PageMeta| PageLayout { rows: page.rows as usize, sh_degree: config.sh_degree }.bytes() as u32;
    Ok(FirstLook {
        dataset: start.into_dataset(),
        page_bytes: index.iter().map(bytes).collect(),
        gaussians: index.iter().map(|page| u64::from(page.rows)).sum(),
        index,
        frames,
    })
}

/// Frames that `host_mem` leaves beside what the largest view takes, which is rendered for it.
fn frames_within(
    config: &TrainConfig,
    start: &mut Start,
    (options, index): (&RunOptions, &[PageMeta]),
    folder: &Path,
    host_mem: u64,
) -> Result<u64, TrainError> {
    let largest = preflight::largest_view(&start.dataset, index);
    let Some(view) = largest.view else { return Ok(0) };
    let mut pages = Vec::new();
    visible_pages(index, &start.dataset.views[view].camera, &mut pages);
    let mut scene =
        PagedScene::empty(Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree)), options);
    let mut number = 0;
    start.for_each_page(options, folder, Some(host_mem), &mut |id, state| {
        if pages.binary_search(&PageNo(number)).is_ok() {
            scene.insert_first_page(id, &state)?;
        }
        number += 1;
        Ok(())
    })?;
    let mut trainer = Trainer::of_scene(scene, &start.dataset, Box::new(CpuRenderer::new()), options.clone());
    let rows = index.iter().map(|page| u64::from(page.rows)).sum();
    let probe = Probe { views: vec![view], rows, pages: index.len(), driver: 0 };
    preflight::frames_within(config, &start.dataset, &mut trainer, &probe, largest, host_mem)
}
