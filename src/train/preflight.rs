//! Plans the tiers before the first step: what each tier will hold, whether it fits, and the number of frames.
//!
//! Invariant: a run that cannot fit is refused here, with numbers and alternatives. Growth that may not fit is a
//! warning.

use super::budget::{FRAMES_LEAST, HostBudget, frames_and_batch};
use super::error::TrainError;
use super::memory::{MemoryEstimate, obtainable_bytes, rows_at_most};
use super::places::drive_of;
use super::probe::{Probe, estimate};
use super::staging::{PLAN_BYTES, staging_bytes, with_staging};
use super::start::Start;
use super::tiers::{Tiers, budget_in_memory, first_staging_bytes};
use super::trainer::Trainer;
use super::working_set::WorkingSet;
use crate::base::error::{InputError, InputResult};
use crate::base::units::format_bytes;
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::page::folder::file_system::free_bytes;
use crate::paging::pager::PagerConfig;
use crate::paging::plan::batches::pages_per_batch;
use crate::paging::simulation::auto::automatic_order;
use crate::paging::simulation::replay::{ReplayOptions, replay};
use crate::scene::camera::Camera;
use crate::scene::page_meta::PageMeta;
use crate::scene::partition::first_fill;
use crate::schedule::order::Order;
use crate::schedule::visibility::{ViewPages, visible_pages};

/// Rated endurance of a common drive of 500 GB, bytes written.
const ENDURANCE_BYTES: f64 = 300e12;
/// Epochs that are simulated to estimate the bytes a run writes.
const PLAYED_EPOCHS: u32 = 3;
/// Pages are numbered in 32 bits.
const PAGES_MOST: u64 = u32::MAX as u64;
/// Growth factor that scenes hardly ever reach; growth beyond it causes no warning.
const GROWTH_UNLIKELY: f64 = 20.0;
/// Versions of a page on the drive: one per commit kept (two), and one being written.
const VERSIONS: u64 = 3;
/// Additional slots of writes in flight.
const SLOTS_IN_FLIGHT: u64 = 64;

/// Pages, frames and drive space of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct TierPlan {
    /// Pages now, and their known upper bound.
    pub pages: [u64; 2],
    /// Bytes of a frame and of a slot on the drive.
    pub frame_bytes: u64,
    /// Frames, possibly more than pages; `None` for a run in memory, which has one frame per page.
    pub frames: Option<u64>,
    /// The user set the number of frames.
    frames_are_named: bool,
    /// The view that needs most pages.
    pub(super) largest_view: LargestView,
    /// Training views that need several batches, and the most batches of one of them.
    cut_views: (usize, usize),
    /// Bytes that the run is expected to write to the drive, without commits.
    pub bytes_written: f64,
    /// Free bytes of the drive; `None` without a drive or if the system does not report them.
    pub free_bytes: Option<u64>,
}

/// Chooses the number of frames and completes the two estimates of [`super::probe::estimate`] with it.
///
/// # Errors
/// The budget or the drive is too small.
pub fn plan_tiers(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    tiers: &Tiers,
    host_mem: Option<u64>,
    memory: &mut [MemoryEstimate; 2],
) -> InputResult<TierPlan> {
    let index = trainer.scene.pager.index().len() as u64;
    let rows_max = rows_at_most(config, trainer.scene.rows());
    let fill = first_fill(config.page_rows as usize, config.strategy.grows()) as u64;
    // Not all pages are full (giants have pages of their own); assume that new pages are as full as the present ones.
    let grown = (index as f64 * rows_max as f64 / trainer.scene.rows().max(1) as f64).ceil() as u64;
    let pages_max = grown.max(rows_max.div_ceil(fill));
    let frame_bytes = trainer.scene.pager.frame_bytes() as u64;
    let largest_view = largest_view(dataset, trainer.scene.pager.index());
    let mut plan = TierPlan {
        pages: [index, pages_max],
        frame_bytes,
        frames: None,
        frames_are_named: config.frames > 0,
        bytes_written: 0.0,
        free_bytes: tiers.free_bytes()?,
        largest_view,
        cut_views: (0, 1),
    };
    if trainer.scene.pager.frames_max() == usize::MAX {
        let asked = host_mem;
        let host_mem = raise_to_least(config, asked, memory[0].total());
        if trainer.scene.pager.slot_space().is_none() {
            // A resumed run has a drive already and can start paging.
            check_in_memory(memory, host_mem)?;
        }
        if let Some(budget) = host_mem {
            let first = budget_in_memory(config, budget, &memory[0]);
            trainer.set_budget(if host_mem == asked { first } else { first.raised_at_start() });
        }
        return Ok(plan);
    }
    let staging = staging_bytes(trainer.scene.pager.prefetch_bytes(), tiers.codec);
    memory.iter_mut().for_each(|m| m.staging = staging);
    let asked = host_mem;
    let (FirstFrames { frames, pages_most }, host_mem) = first_frames(config, &plan, asked, &memory[0])?;
    trainer.pages_most = pages_most;
    trainer.scene.pager.allow_frames(frames as usize);
    trainer.scene.pager.limit_frames(frames as usize);
    if let Some(budget) = host_mem.filter(|_| config.frames == 0) {
        let first = HostBudget::new(budget, &memory[0], config.host_mem.0 > 0);
        trainer.set_budget(if host_mem == asked { first } else { first.raised_at_start() });
    }
    plan.frames = Some(frames);
    plan.cut_views = cut_views(dataset, trainer.scene.pager.index(), frames, pages_most);
    for memory in &mut *memory {
        memory.frames = memory.frames.min(frames * frame_bytes);
        if pages_most < usize::MAX {
            let of_batch = (pages_most as u64).saturating_mul(page_working(config)).min(memory.working);
            memory.view -= memory.working - of_batch;
            memory.copies = memory.copies.min(pages_most as u64 * frame_bytes);
        }
    }
    if config.view_order.0.is_none() {
        trainer.set_view_order(auto_order(config, dataset, trainer, frames, &plan)?, dataset);
    }
    warn_of_growth(config, &plan, host_mem, memory);
    plan.bytes_written = bytes_written(config, dataset, trainer, frames.min(plan.pages[0].max(1)) as usize);
    check_drive(&plan, tiers, checkpoints_kept(config))?;
    Ok(plan)
}

/// Describes a scene that a dry run cannot plan because its pages exceed half of the budget; `None` if they fit. A dry
/// run writes no pages: it keeps the pages of the drive in memory, in at most half of the budget.
pub fn too_large_for_a_dry_run(config: &TrainConfig, start: &Start, host_mem: Option<u64>) -> Option<String> {
    let (spill_dir, budget) = (config.residence().spill_dir()?, host_mem?);
    let frame = PagerConfig::in_memory(config.page_rows as usize, config.sh_degree).frame_bytes() as u64;
    let pages = start.rows.div_ceil(first_fill(config.page_rows as usize, config.strategy.grows()) as u64);
    if pages.saturating_mul(frame) <= budget / 2 {
        return None;
    }
    let free = free_bytes(&drive_of(spill_dir)).ok().flatten();
    Some(format!(
        "scene   {} views to train on, {} held out\n\
         start   {} Gaussians\n\
         pages   about {pages} of up to {}, {} in all; the drive has {} free\n\
         memory  {} in all, fewer than {} pages at once\n\
         views   unknown: their needs follow from pages on the drive, and a dry run writes none.\n        \
         The run itself checks them before its first step.",
        start.dataset.train_views().len(),
        start.dataset.test_views().len(),
        start.rows,
        format_bytes(frame),
        format_bytes(pages.saturating_mul(frame)),
        free.map_or(String::from("unknown"), format_bytes),
        format_bytes(budget),
        (budget / frame).max(1),
    ))
}

/// Allows the frames that the largest training view of `dataset` needs, so that views can be measured; [`plan_tiers`]
/// allows the rest afterwards. Where the budget may not hold them beside the rows of the view, the view is measured in batches.
/// Returns the index of that view. Runs in memory or with --frames are left unchanged.
pub fn allow_largest_view(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    host_mem: Option<u64>,
) -> Option<usize> {
    let LargestView { view, pages: needed, .. } = largest_view(dataset, trainer.scene.pager.index());
    if config.frames > 0 || trainer.scene.pager.frames_max() == usize::MAX {
        return view;
    }
    let frame_bytes = trainer.scene.pager.frame_bytes() as u64;
    // A default budget may rise once the memory of a view is known.
    let most = if config.host_mem.0 == 0 { host_mem.and(obtainable_bytes()).max(host_mem) } else { host_mem };
    let mut frames = needed;
    if let Some(budget) = most.filter(|budget| needed * (frame_bytes + page_working(config)) > *budget) {
        let (fewer, pages) = frames_and_batch(budget / 2, frame_bytes, page_working(config), true);
        if (fewer as u64) < needed {
            (frames, trainer.pages_most) = (fewer as u64, pages);
        }
    }
    trainer.scene.pager.allow_frames(frames as usize);
    view
}

/// Bytes of the working set for the rows of one full page.
fn page_working(config: &TrainConfig) -> u64 {
    u64::from(config.page_rows) * WorkingSet::row_bytes(config.sh_degree) as u64
}

/// Resolves `--view-order auto`. For a scene that grows, the current pages stand for the grown scene, with the number
/// of frames reduced in proportion.
fn auto_order(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &Trainer,
    frames: u64,
    plan: &TierPlan,
) -> InputResult<Order> {
    let [now, most] = plan.pages;
    let cameras = train_cameras(dataset);
    let views = ViewPages::new(trainer.scene.pager.index(), &cameras);
    let frames = if frames >= most { now } else { frames * now / most };
    // A run whose views fit now is planned as one whose views fit.
    let least = if plan.frames.is_some_and(|frames| frames as usize >= views.most()) { views.most() } else { 1 };
    let frames = (frames as usize).max(least);
    automatic_order(&views, &cameras, now as usize, frames, config.seed, PLAN_BYTES as u64)
        .map_err(|e| InputError::new("--view-order", e.to_string(), "name one: shuffle, groups:N or tour"))
}

fn train_cameras(dataset: &Dataset) -> Vec<Camera> {
    dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect()
}

/// Number of frames within `host_mem`, as [`plan_tiers`] chooses it. For planning without a run: `trainer` holds the pages
/// of the largest view.
///
/// # Errors
/// The budget does not hold that view, or the view cannot be rendered.
pub(super) fn frames_within(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    probe: &Probe,
    largest_view: LargestView,
    host_mem: u64,
) -> Result<u64, TrainError> {
    let [mut memory, _] = estimate(config, dataset, trainer, probe)?;
    memory.staging = first_staging_bytes(config, host_mem);
    let plan = TierPlan {
        pages: [probe.pages as u64, u64::MAX],
        frame_bytes: trainer.scene.pager.frame_bytes() as u64,
        frames: None,
        frames_are_named: false,
        bytes_written: 0.0,
        free_bytes: None,
        largest_view,
        cut_views: (0, 1),
    };
    Ok(frames_of_budget(config, &plan, Some(host_mem), &memory)?.frames)
}

/// Warns if views may outgrow the frames: the pages of the largest view grow in proportion to the Gaussians, while
/// the frames shrink.
fn warn_of_growth(config: &TrainConfig, plan: &TierPlan, host_mem: Option<u64>, memory: &[MemoryEstimate; 2]) {
    let ([now, most], Some(frames)) = (plan.pages, plan.frames) else { return };
    if !config.strategy.grows() {
        return;
    }
    let LargestView { pages: needed, name: view, .. } = &plan.largest_view;
    if *needed > frames {
        // The description of the pages says so.
        return;
    }
    let then = (*needed as f64 * most as f64 / now.max(1) as f64).ceil() as u64;
    let left = match host_mem.filter(|_| config.frames == 0) {
        None => frames,
        Some(budget) => budget.saturating_sub(memory[1].fixed()) / plan.frame_bytes,
    };
    let times = times_to_outgrow(plan, frames, memory[0].view - memory[0].view_pixels, config.frames > 0);
    let until = match config.max_gaussians {
        0 if times >= GROWTH_UNLIKELY => return,
        0 => "growth has no cap (--max-gaussians)".to_string(),
        _ if then <= left => return,
        cap => format!("with --max-gaussians {cap} the view may need {then} pages with {left} frames"),
    };
    eprintln!(
        "warning: the view {view} needs {needed} pages, there are {frames} frames, and {until}: when the scene has \
         grown about {times:.1} times, steps on such views take several batches and read more; more --frames or --host-mem \
         avoid it"
    );
}

/// Growth factor of the scene at which the largest view needs all frames.
fn times_to_outgrow(plan: &TierPlan, frames: u64, of_rows: u64, are_fixed: bool) -> f64 {
    // With --frames the number of frames does not shrink as the rows of a view grow.
    let of_rows = if are_fixed { 0 } else { of_rows };
    let needed = plan.largest_view.pages * plan.frame_bytes;
    (frames * plan.frame_bytes + of_rows) as f64 / (needed + of_rows).max(1) as f64
}

/// Bytes that the run will write to the drive, without commits: the import, and the steps by simulation of a few epochs
/// with the current pages.
fn bytes_written(config: &TrainConfig, dataset: &Dataset, trainer: &Trainer, frames: usize) -> f64 {
    let cameras = train_cameras(dataset);
    let index = trainer.scene.pager.index();
    let steps = config.steps.min(PLAYED_EPOCHS * cameras.len() as u32);
    let options =
        ReplayOptions { frames, policy: config.evict, reads_ahead: false, steps, plan_bytes: PLAN_BYTES as u64 };
    let page_bytes = vec![trainer.scene.pager.frame_bytes() as u32; index.len()];
    let played = replay(&ViewPages::new(index, &cameras), &page_bytes, trainer.view_order(), &options);
    let written: u64 = played.map_or(0, |p| p.steps.iter().map(|s| s.bytes_written).sum());
    let done = trainer.steps_done();
    let import = if done == 0 { page_bytes.iter().map(|&b| f64::from(b)).sum() } else { 0.0 };
    import + written as f64 * f64::from(config.steps - done) / f64::from(steps.max(1))
}

/// The training view that needs most pages, by page bounds. Held-out views do not count: evaluation visits their pages
/// in batches.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct LargestView {
    /// Its index in `dataset.views`; `None` if no view sees a page.
    pub view: Option<usize>,
    /// Its name.
    pub name: String,
    /// Pages that it needs.
    pub pages: u64,
    /// Mean number of pages over the training views.
    pub mean: f64,
}

pub(super) fn largest_view(dataset: &Dataset, index: &[PageMeta]) -> LargestView {
    let (mut largest, mut sum, mut list) = (LargestView::default(), 0, Vec::new());
    let views = dataset.train_views();
    for &view in &views {
        visible_pages(index, &dataset.views[view].camera, &mut list);
        let pages = list.len() as u64;
        sum += pages;
        if pages > largest.pages {
            largest = LargestView { view: Some(view), name: dataset.views[view].name.clone(), pages, mean: 0.0 };
        }
    }
    LargestView { mean: sum as f64 / views.len().max(1) as f64, ..largest }
}

fn check_in_memory([start, most]: &[MemoryEstimate; 2], host_mem: Option<u64>) -> InputResult<()> {
    let Some(budget) = host_mem else { return Ok(()) };
    if start.total() > budget {
        let problem = format!(
            "{} are too little: the scene needs about {} of memory ({} for Gaussians)",
            format_bytes(budget),
            format_bytes(start.total()),
            format_bytes(start.frames)
        );
        let remedy = "name a folder on a fast drive with --spill-dir, raise --host-mem, or lower --image-cache, \
                      --sh-degree or the size of the photos";
        return Err(InputError::new("--host-mem", problem, remedy));
    }
    if most.total() > budget {
        eprintln!(
            "warning: the run may need {} but has {}: beyond that, its pages move between memory and its checkpoint; \
             name a folder on a fast drive with --spill-dir, or lower --max-gaussians, --image-cache, --sh-degree or \
             the size of the photos",
            format_bytes(most.total()),
            format_bytes(budget)
        );
    }
    Ok(())
}

/// Frames at the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct FirstFrames {
    frames: u64,
    /// The most pages of a batch of a view.
    pages_most: usize,
}

impl FirstFrames {
    /// Enough for every view in one batch.
    fn of_whole_views(frames: u64) -> FirstFrames {
        FirstFrames { frames, pages_most: usize::MAX }
    }
}

/// Frames at the start, and the budget from which they follow.
fn first_frames(
    config: &TrainConfig,
    plan: &TierPlan,
    host_mem: Option<u64>,
    memory: &MemoryEstimate,
) -> InputResult<(FirstFrames, Option<u64>)> {
    if config.frames > 0 {
        check_frames(u64::from(config.frames))?;
        return Ok((FirstFrames::of_whole_views(u64::from(config.frames)), host_mem));
    }
    // By the estimate without growth: the cap may never be reached, and growth takes frames when it happens.
    if let Some(frames) = whole_views(plan, host_mem, memory) {
        return Ok((frames, host_mem));
    }
    let host_mem = raise_to_least(config, host_mem, least_memory(plan, memory, host_mem));
    Ok((frames_of_budget(config, plan, host_mem, memory)?, host_mem))
}

/// `host_mem`, raised to `least` with a warning if the user set no budget and the machine has the memory.
fn raise_to_least(config: &TrainConfig, host_mem: Option<u64>, least: u64) -> Option<u64> {
    let budget = host_mem.filter(|&budget| config.host_mem.0 == 0 && least > budget);
    let Some(short) = budget.filter(|_| obtainable_bytes().is_some_and(|most| least <= most)) else { return host_mem };
    eprintln!(
        "warning: the run needs {} from its start, more than {}, the default share of the free memory: it takes more \
         as long as the machine has it; --host-mem sets a limit",
        format_bytes(least),
        format_bytes(short)
    );
    Some(least)
}

/// Least budget with which the largest view has its frames.
fn least_memory(plan: &TierPlan, memory: &MemoryEstimate, host_mem: Option<u64>) -> u64 {
    let rest = memory.fixed() - memory.staging + view_spare(memory) + plan.largest_view.pages * plan.frame_bytes;
    let least = with_staging(rest, memory.staging, host_mem.unwrap_or(u64::MAX));
    least + least / 50
}

/// Margin for a view slightly larger than the rendered ones: its vectors grow by an eighth.
fn view_spare(memory: &MemoryEstimate) -> u64 {
    (memory.view - memory.view_pixels) / 8
}

/// Frames with which every view is one batch; `None` where the budget leaves too few.
fn whole_views(plan: &TierPlan, host_mem: Option<u64>, memory: &MemoryEstimate) -> Option<FirstFrames> {
    // Without a budget, the system reports no available memory: set no limit.
    let Some(budget) = host_mem else { return Some(FirstFrames::of_whole_views(PAGES_MOST)) };
    let frames = budget.saturating_sub(memory.fixed() + view_spare(memory)) / plan.frame_bytes;
    (frames >= plan.largest_view.pages).then(|| FirstFrames::of_whole_views(frames.min(PAGES_MOST)))
}

/// Frames within the budget: for whole views, or for views in batches.
fn frames_of_budget(
    config: &TrainConfig,
    plan: &TierPlan,
    host_mem: Option<u64>,
    memory: &MemoryEstimate,
) -> InputResult<FirstFrames> {
    let (whole, budget) = (whole_views(plan, host_mem, memory), host_mem.unwrap_or(u64::MAX));
    if let Some(whole) = whole {
        return Ok(whole);
    }
    let rendering = memory.view - memory.working;
    let beside = memory.fixed() - memory.working - memory.copies + (rendering - memory.view_pixels.min(rendering)) / 8;
    let of_a_page = 2 * plan.frame_bytes + page_working(config) + memory.copies.min(plan.frame_bytes);
    let Some(left) = budget.checked_sub(beside).filter(|left| *left >= of_a_page) else {
        let problem = format!(
            "{} are too little: pixels and splats of one view, photos, staging and tables take {}, and the smallest batch of a view {}",
            format_bytes(budget),
            format_bytes(beside),
            format_bytes(of_a_page)
        );
        let floor = with_staging(beside - memory.staging + of_a_page, memory.staging, budget);
        let remedy = format!(
            "give at least {} ({} keeps each view in one batch), or lower --image-cache, --prefetch-bytes, --page-rows, \
             --sh-degree or the size of the photos",
            format_bytes(floor + floor / 50),
            format_bytes(least_memory(plan, memory, host_mem))
        );
        return Err(InputError::new("--host-mem", problem, remedy));
    };
    let (frames, pages_most) = frames_and_batch(left, plan.frame_bytes, page_working(config), memory.copies > 0);
    Ok(FirstFrames { frames: (frames as u64).min(PAGES_MOST), pages_most })
}

/// The training views that need more than one batch, and the most batches of one of them.
fn cut_views(dataset: &Dataset, index: &[PageMeta], frames: u64, pages_most: usize) -> (usize, usize) {
    let (mut views, mut most, mut list) = (0, 1, Vec::new());
    for view in dataset.train_views() {
        visible_pages(index, &dataset.views[view].camera, &mut list);
        let per_batch = pages_per_batch(list.len(), frames as usize).min(pages_most);
        let batches = list.len().div_ceil(per_batch);
        views += usize::from(batches > 1);
        most = most.max(batches);
    }
    (views, most)
}

fn check_frames(frames: u64) -> InputResult<()> {
    if frames >= FRAMES_LEAST as u64 {
        return Ok(());
    }
    let problem = format!("{frames} is too few: a step writes one page back while it reads another");
    Err(InputError::new("--frames", problem, format!("give at least {FRAMES_LEAST}")))
}

/// Refuses a drive that cannot hold the `rows` first Gaussians, before the import. A drive that does not report its
/// free space passes.
///
/// # Errors
/// The drive has too little free space.
pub fn check_first_drive(config: &TrainConfig, rows: u64) -> InputResult<()> {
    let Some(spill_dir) = config.residence().spill_dir() else { return Ok(()) };
    let free = free_bytes(&drive_of(spill_dir)).ok().flatten();
    let frame_bytes = PagerConfig::in_memory(config.page_rows as usize, config.sh_degree).frame_bytes() as u64;
    let pages = rows.div_ceil(first_fill(config.page_rows as usize, config.strategy.grows()) as u64);
    free.map_or(Ok(()), |free| refuse_small_drive(free, pages, frame_bytes))
}

/// Bytes of `pages` pages on the drive, with slots of writes in flight.
fn drive_bytes(pages: u64, frame_bytes: u64) -> u64 {
    pages.saturating_add(SLOTS_IN_FLIGHT).saturating_mul(frame_bytes)
}

fn refuse_small_drive(free: u64, pages: u64, frame_bytes: u64) -> InputResult<()> {
    let needed = drive_bytes(pages, frame_bytes);
    if free >= needed {
        return Ok(());
    }
    let problem = format!(
        "the drive has {} free for pages, but may have to hold {pages} of {}, {} with writes in flight",
        format_bytes(free),
        format_bytes(frame_bytes),
        format_bytes(needed)
    );
    let remedy = "free space on it, choose another drive, or lower --sh-degree";
    Err(InputError::new("--spill-dir", problem, remedy))
}

/// Number of named checkpoints from `--save-every`; each may hold a version of every page.
fn checkpoints_kept(config: &TrainConfig) -> u64 {
    u64::from(config.steps.saturating_sub(1).checked_div(config.save_every).unwrap_or(0))
}

fn check_drive(plan: &TierPlan, tiers: &Tiers, kept: u64) -> InputResult<()> {
    let Some(free) = plan.free_bytes.filter(|_| tiers.spills()) else { return Ok(()) };
    let [now, most] = plan.pages;
    refuse_small_drive(free, now, plan.frame_bytes)?;
    let with_past = drive_bytes(most, plan.frame_bytes).saturating_mul(VERSIONS.saturating_add(kept));
    if free < with_past {
        let (named, fewer) = match kept {
            0 => (String::new(), ""),
            kept => (format!(" and {kept} named checkpoints"), ", keep fewer checkpoints with --save-every"),
        };
        eprintln!(
            "warning: the scene with its last two commits{named} may take {} on the drive, which has {} free: lower \
             --max-gaussians{fewer}, or commit less often with --commit-every",
            format_bytes(with_past),
            format_bytes(free)
        );
    }
    Ok(())
}

/// The description of the tiers that a run prints at its start.
pub fn describe(plan: &TierPlan, memory: &MemoryEstimate, tiers: &Tiers) -> String {
    let part = |name: &str, bytes: u64| format!("    {name:<44} {:>10}\n", format_bytes(bytes));
    let LargestView { pages: largest, mean, .. } = &plan.largest_view;
    let mut text = format!(
        "pages   {} of up to {}; a view needs {mean:.0} on average, {largest} at most\n",
        plan.pages[0],
        format_bytes(plan.frame_bytes)
    );
    if let (views @ 1.., most) = plan.cut_views {
        text.push_str(&format!(
            "        {views} views are larger than the frames: steps on them take up to {most} batches\n"
        ));
    }
    let frames = match plan.frames {
        None => String::from("Gaussians with their optimizer state"),
        Some(frames) if !plan.frames_are_named && frames >= plan.pages[1] => {
            String::from("frames of pages, one for every page")
        }
        Some(frames) => format!("{frames} frames of pages"),
    };
    text.push_str(&format!("memory  about {} at the peak\n", format_bytes(memory.total())));
    text.push_str(&part(&frames, memory.frames));
    text.push_str(&part("one view: rows, gradients, images", memory.view));
    text.push_str(&part("decoded photos (--image-cache)", memory.targets));
    if memory.staging > 0 {
        text.push_str(&part("encoded pages in transfer, and the plan", memory.staging));
    }
    text.push_str(&part("index of the pages", memory.index));
    text.push_str(&part("program and tables", memory.base + memory.copies));
    if tiers.spills() {
        text.push_str(&format!(
            "drive   {} of pages by {} ({}), {} free\n        \
             about {} to write without commits, {:.2} % of the rated life of a common drive\n",
            format_bytes(plan.pages[0] * plan.frame_bytes),
            tiers.engine,
            tiers.codec,
            plan.free_bytes.map_or(String::from("unknown"), format_bytes),
            format_bytes(plan.bytes_written as u64),
            100.0 * plan.bytes_written / ENDURANCE_BYTES
        ));
    }
    text
}
