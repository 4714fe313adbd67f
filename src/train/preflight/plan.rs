//! Plans the tiers before the first step: what each tier will hold, whether it fits, and the number of frames.
//!
//! A run begins with frames for whole views where the budget holds them, else with frames for views in batches.
//!
//! Not here: frames of a scene that has grown (`state::run_memory`).
//!
//! Invariant: a run that cannot fit is refused here, with numbers and alternatives: a budget that holds no batch of the largest view is
//! refused with the smallest one that suffices. Growth that may not fit is a warning.

use super::device_memory;
use crate::base::error::{InputError, InputResult};
use crate::base::units::{format_bytes, format_bytes_up};
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::densify::mcmc;
use crate::densify::strategy::StrategyName;
use crate::paging::plan::batches;
use crate::paging::simulation::replay::automatic_order;
use crate::scene::columns::row_width;
use crate::scene::page_meta::PageMeta;
use crate::scene::partition::first_fill;
use crate::schedule::order::Order;
use crate::schedule::visibility::{ViewPages, visible_pages};
use crate::train::error::TrainError;
use crate::train::memory::{
    BASE_BYTES, FRAMES_LEAST, HostBudget, INDEX_BYTES, MemoryEstimate, PLAN_BYTES, bytes_of_copies, frames_and_batch,
    frames_in_memory, largest_decode, list_bytes, obtainable_bytes, staging_bytes, with_staging,
};
use crate::train::start::tiers::{Tiers, budget_in_memory, first_staging_bytes};
use crate::train::state::trainer::{Probed, Trainer};
use crate::train::step::pages::WorkingSet;

/// Pages are numbered in 32 bits.
const PAGES_MOST: u64 = u32::MAX as u64;

/// Growth factor that scenes hardly ever reach; growth beyond it causes no warning.
const GROWTH_UNLIKELY: f64 = 20.0;

/// A view that is measured in batches has frames and a working set of 1/16 of the budget: the splats of the view may need
/// nearly all of the rest.
const PROBE_BATCH_SHARE: u64 = 16;
/// Bytes that a renderer holds for a row in view at least, beside intersections.
const SPLAT_BYTES: u64 = 150;
/// A view whose rows take more than this many quarters of the budget is measured in batches: program, photos and lists
/// of intersections need the rest.
const PROBE_WHOLE_OF_4: u64 = 3;

/// The training view that needs most pages, by page bounds. Held-out views do not count: evaluation visits their pages
/// in batches.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct LargestView {
    /// Its index in `dataset.views`; `None` if no view sees a page.
    pub view: Option<usize>,
    pub name: String,
    /// Pages that it needs.
    pub pages: u64,
    /// Mean number of pages over the training views.
    pub mean: f64,
}

/// The [`LargestView`] of a scene with these pages.
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

/// The training views that need more than one batch, and the most batches of one of them.
fn cut_views(dataset: &Dataset, index: &[PageMeta], frames: u64, pages_most: usize) -> (usize, usize) {
    let mut list = Vec::new();
    let pages = dataset.train_views().into_iter().map(|view| {
        visible_pages(index, &dataset.views[view].camera, &mut list);
        list.len()
    });
    batches::cut_views(pages, frames as usize, pages_most)
}

/// Pages, frames and drive space of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct TierPlan {
    /// Pages now, and their known upper bound.
    pub pages: [u64; 2],
    /// Bytes of a frame and of a slot on the drive.
    pub frame_bytes: u64,
    /// Bytes of a segment file of the spill directory; 0 for a run in memory.
    pub(super) segment_bytes: u64,
    /// Frames, possibly more than pages; `None` for a run in memory, which has one frame per page.
    pub frames: Option<u64>,
    /// The user set the number of frames.
    pub(super) frames_are_named: bool,
    /// The view that needs most pages.
    pub(crate) largest_view: LargestView,
    /// Training views that need several batches, and the most batches of one of them.
    pub(crate) cut_views: (usize, usize),
    /// Free bytes of the drive; `None` without a drive or if the system does not report them.
    pub free_bytes: Option<u64>,
}

/// Chooses the number of frames and completes the estimates of [`estimate`] with it.
/// Errors: the budget or the drive is too small.
pub(super) fn plan_tiers(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    tiers: &Tiers,
    largest_view: LargestView,
    host_mem: Option<u64>,
    memory: &mut [MemoryEstimate; 3],
) -> InputResult<TierPlan> {
    let mut plan = TierPlan {
        pages: pages_now_and_most(config, trainer),
        frame_bytes: trainer.scene.pager.frame_bytes() as u64,
        segment_bytes: tiers.segment_bytes,
        frames: None,
        frames_are_named: config.frames > 0,
        free_bytes: tiers.free_bytes()?,
        largest_view,
        cut_views: (0, 1),
    };
    if trainer.scene.pager.frames_max() == usize::MAX {
        plan_in_memory(config, trainer, host_mem, memory)?;
        return Ok(plan);
    }
    let staging = staging_bytes(trainer.scene.pager.prefetch_bytes(), tiers.codec);
    memory.iter_mut().for_each(|m| m.staging = staging);
    let (frames, host_mem) = plan_frames(config, trainer, &plan, host_mem, memory)?;
    plan.frames = Some(frames);
    plan.cut_views = cut_views(dataset, trainer.scene.pager.index(), frames, trainer.memory.pages_most);
    if config.view_order.0.is_none() {
        trainer.set_view_order(auto_order(config, dataset, trainer, frames, plan.pages)?, dataset);
    }
    warn_of_growth(config, &plan, host_mem, memory);
    Ok(plan)
}

/// Pages now, and their known upper bound. Not all pages are full (giants have pages of their own); new pages are taken
/// to be as full as the present ones.
fn pages_now_and_most(config: &TrainConfig, trainer: &Trainer) -> [u64; 2] {
    let (pages, rows) = (trainer.scene.pager.index().len() as u64, trainer.scene.rows());
    let rows_max = rows_at_most(config, rows);
    let fill = first_fill(config.page_rows as usize, config.strategy.grows()) as u64;
    let grown = (pages as f64 * rows_max as f64 / rows.max(1) as f64).ceil() as u64;
    [pages, grown.max(rows_max.div_ceil(fill))]
}

/// The budget of a run that keeps all pages in memory.
fn plan_in_memory(
    config: &TrainConfig,
    trainer: &mut Trainer,
    asked: Option<u64>,
    memory: &[MemoryEstimate; 3],
) -> InputResult<()> {
    let host_mem = raise_to_minimum(config, asked, memory[0].total());
    if trainer.scene.pager.slot_space().is_none() {
        // A resumed run has a drive already and can start paging.
        check_in_memory(memory, host_mem)?;
    }
    if let Some(budget) = host_mem {
        let first = budget_in_memory(config, budget, &memory[0]);
        trainer.memory.budget = Some(HostBudget { is_raised: host_mem != asked, ..first });
    }
    Ok(())
}

/// The frames and the batches of a run with a drive, and the budget from which they follow; completes the estimates.
fn plan_frames(
    config: &TrainConfig,
    trainer: &mut Trainer,
    plan: &TierPlan,
    asked: Option<u64>,
    memory: &mut [MemoryEstimate; 3],
) -> InputResult<(u64, Option<u64>)> {
    let need = LargestNeed { frame_bytes: plan.frame_bytes, pages: plan.largest_view.pages };
    let (first, host_mem) = first_frames(config, &need, asked, &memory[0])?;
    trainer.memory.pages_most = first.pages_most;
    trainer.scene.pager.allow_frames(first.frames as usize);
    trainer.scene.pager.limit_frames(first.frames as usize);
    if let Some(budget) = host_mem.filter(|_| config.frames == 0) {
        let budget = HostBudget::new(budget, &memory[0], config.host_mem.0 > 0);
        trainer.memory.budget = Some(HostBudget { is_raised: host_mem != asked, ..budget });
    }
    memory.iter_mut().for_each(|memory| reduce_estimate(config, memory, first, plan.frame_bytes));
    Ok((first.frames, host_mem))
}

/// What the largest view needs.
#[derive(Debug, Clone, Copy)]
struct LargestNeed {
    pub frame_bytes: u64,
    pub pages: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct FirstFrames {
    pub frames: u64,
    /// The most pages of a batch of a view.
    pub pages_most: usize,
}

impl FirstFrames {
    /// Those within `left` bytes for views in batches; see [`frames_and_batch`].
    fn of_batches(config: &TrainConfig, left: u64, frame_bytes: u64, copies: bool) -> FirstFrames {
        let (frames, pages_most) = frames_and_batch(left, frame_bytes, page_working(config), copies);
        FirstFrames { frames: frames as u64, pages_most }
    }

    /// Enough for every view in one batch.
    fn of_whole_views(frames: u64) -> FirstFrames {
        FirstFrames { frames, pages_most: usize::MAX }
    }
}

/// Frames at the start, and the budget from which they follow.
fn first_frames(
    config: &TrainConfig,
    need: &LargestNeed,
    host_mem: Option<u64>,
    memory: &MemoryEstimate,
) -> InputResult<(FirstFrames, Option<u64>)> {
    if config.frames > 0 {
        if (config.frames as usize) < FRAMES_LEAST {
            let problem = format!("{} is too few: a step writes one page back while it reads another", config.frames);
            return Err(InputError::new("--frames", problem, format!("give at least {FRAMES_LEAST}")));
        }
        return Ok((FirstFrames::of_whole_views(u64::from(config.frames)), host_mem));
    }
    // By the estimate without growth: the cap may never be reached, and growth takes frames when it happens.
    if let Some(frames) = whole_views(need, host_mem, memory) {
        return Ok((frames, host_mem));
    }
    let host_mem = raise_to_minimum(config, host_mem, least_memory(need, memory, host_mem));
    Ok((frames_of_budget(config, need, host_mem, memory)?, host_mem))
}

/// Least budget with which the largest view has its frames.
fn least_memory(need: &LargestNeed, memory: &MemoryEstimate, host_mem: Option<u64>) -> u64 {
    let rest = memory.fixed() - memory.staging + view_spare(memory) + need.pages * need.frame_bytes;
    with_margin(with_staging(rest, memory.staging, host_mem.unwrap_or(u64::MAX)), memory)
}

/// The budget with a margin that makes it enough at the next start, too: the memory of the graphics driver differs from
/// start to start by up to 1/20, and that of a view by some tenths of a mebibyte, as threads share its tiles.
pub(super) fn with_margin(bytes: u64, memory: &MemoryEstimate) -> u64 {
    bytes + bytes / 50 + memory.base / 16
}

/// Bytes that lists of intersections may take in a budget of `bytes` beyond those measured in a budget of `budget`:
/// where a view needs longer lists, they fill their share of the budget. Lists get an eighth of this addition, too.
fn more_lists(bytes: u64, budget: u64) -> u64 {
    let more = list_bytes(bytes).saturating_sub(list_bytes(budget));
    more + more / 7
}

/// Margin for a view slightly larger than the rendered ones: its vectors grow by an eighth.
fn view_spare(memory: &MemoryEstimate) -> u64 {
    (memory.view - memory.view_pixels) / 8
}

/// Frames with which every view is one batch; `None` where the budget leaves too few.
fn whole_views(need: &LargestNeed, host_mem: Option<u64>, memory: &MemoryEstimate) -> Option<FirstFrames> {
    // Without a budget, the system reports no available memory: set no limit.
    let Some(budget) = host_mem else { return Some(FirstFrames::of_whole_views(PAGES_MOST)) };
    let frames = budget.saturating_sub(memory.fixed() + view_spare(memory)) / need.frame_bytes;
    (frames >= need.pages).then(|| FirstFrames::of_whole_views(frames.min(PAGES_MOST)))
}

/// Frames within the budget: for whole views, or for views in batches.
fn frames_of_budget(
    config: &TrainConfig,
    need: &LargestNeed,
    host_mem: Option<u64>,
    memory: &MemoryEstimate,
) -> InputResult<FirstFrames> {
    let (whole, budget) = (whole_views(need, host_mem, memory), host_mem.unwrap_or(u64::MAX));
    if let Some(whole) = whole {
        return Ok(whole);
    }
    let rendering = memory.view - memory.working;
    // Frames leave this margin for a larger view, but the smallest batch needs no margin: a run that has grown into its budget must resume in it.
    let spare = (rendering - memory.view_pixels.min(rendering)) / 8;
    let beside = memory.fixed() - memory.working - memory.copies;
    let of_a_page = 2 * need.frame_bytes + page_working(config) + memory.copies.min(need.frame_bytes);
    let Some(left) = budget.checked_sub(beside).filter(|left| *left >= of_a_page) else {
        let problem = format!(
            "{} is not enough: pixels and splats of one view, photos, staging and tables take {}, and the smallest batch of a view {}",
            format_bytes(budget),
            format_bytes(beside),
            format_bytes(of_a_page)
        );
        let floor = with_margin(with_staging(beside - memory.staging + of_a_page, memory.staging, budget), memory);
        let whole = least_memory(need, memory, host_mem);
        let remedy = format!(
            "give at least {} ({} keeps each view in one batch), or lower --image-cache, --prefetch-bytes, --page-rows, \
             --sh-degree or the size of the photos",
            format_bytes_up(floor + more_lists(floor, budget)),
            format_bytes_up(whole + more_lists(whole, budget))
        );
        return Err(InputError::new("--host-mem", problem, remedy));
    };
    let first = FirstFrames::of_batches(config, left.saturating_sub(spare), need.frame_bytes, memory.copies > 0);
    Ok(FirstFrames { frames: first.frames.min(PAGES_MOST), ..first })
}

/// Reduces the estimate of a grown scene to `budget` as the run will do: by fewer frames and, if these do not hold the largest view of
/// the grown scene (`need`), by views in batches. Returns the number of frames.
fn shrink_to_budget(config: &TrainConfig, need: &LargestNeed, budget: u64, memory: &mut MemoryEstimate) -> u64 {
    let first = whole_views(need, Some(budget), memory).unwrap_or_else(|| {
        let left = budget.saturating_sub(memory.fixed() - memory.working - memory.copies);
        FirstFrames::of_batches(config, left, need.frame_bytes, memory.copies > 0)
    });
    reduce_estimate(config, memory, first, need.frame_bytes);
    first.frames
}

/// Shrinks the memory of the grown scene to the budget `host_mem`, bytes. `memory` holds three estimates: with `rows` Gaussians, at the cap, and
/// with `last` Gaussians; the first stays. Returns the frames at the end; `None` for a run that stays in memory.
pub(super) fn limit_memory(
    config: &TrainConfig,
    tiers: &TierPlan,
    host_mem: Option<u64>,
    [rows, last]: [u64; 2],
    memory: &mut [MemoryEstimate; 3],
) -> Option<u64> {
    let mut frames_at_end = tiers.frames;
    let Some(mut budget) = host_mem.filter(|_| config.frames == 0) else { return frames_at_end };
    if tiers.frames.is_none() {
        // A default budget rises; beyond it, the run moves its pages to the drive.
        let most = if config.host_mem.0 == 0 { obtainable_bytes() } else { None };
        budget = most.unwrap_or(budget).max(budget);
        if memory[2].total() <= budget {
            return None;
        }
    }
    // The plan has chosen the frames of the start.
    for (memory, rows_then) in memory[1..].iter_mut().zip([rows_at_most(config, rows), last]) {
        let growth = rows_then as f64 / rows.max(1) as f64;
        let pages = (tiers.largest_view.pages as f64 * growth).ceil() as u64;
        // A run that outgrows its memory has pages in transfer from then on.
        if tiers.frames.is_none() && memory.total() > budget {
            memory.staging = first_staging_bytes(config, budget);
        }
        let frames = shrink_to_budget(config, &LargestNeed { frame_bytes: tiers.frame_bytes, pages }, budget, memory);
        frames_at_end = Some(match tiers.frames {
            None => frames,
            Some(now) if rows_then > rows => frames.min(now),
            Some(now) => now,
        });
    }
    frames_at_end
}

/// Reduces the estimate to these frames, and to batches of that many pages: rows of a view, and copies of a round.
fn reduce_estimate(config: &TrainConfig, memory: &mut MemoryEstimate, to: FirstFrames, frame_bytes: u64) {
    memory.frames = memory.frames.min(to.frames.saturating_mul(frame_bytes));
    let pages = to.pages_most as u64;
    let working = pages.saturating_mul(page_working(config)).min(memory.working);
    memory.view -= memory.working - working;
    memory.working = working;
    memory.copies = memory.copies.min(pages.saturating_mul(frame_bytes));
}

/// `host_mem`, raised to `least` with a warning if the user set no budget and the machine has the memory.
fn raise_to_minimum(config: &TrainConfig, host_mem: Option<u64>, least: u64) -> Option<u64> {
    let budget = host_mem.filter(|&budget| config.host_mem.0 == 0 && least > budget);
    let Some(short) = budget.filter(|_| obtainable_bytes().is_some_and(|most| least <= most)) else { return host_mem };
    crate::tell!(
        "warning: the run needs {} from its start, more than {}, the default share of the free memory: it takes more \
         as long as the machine has it; --host-mem sets a limit",
        format_bytes(least),
        format_bytes(short)
    );
    Some(least)
}

/// Bytes of the working set for the rows of one full page.
fn page_working(config: &TrainConfig) -> u64 {
    u64::from(config.page_rows) * WorkingSet::row_bytes(config.sh_degree) as u64
}

/// Allows the frames that the largest training view of `dataset` needs, so that views can be measured; [`plan_tiers`]
/// allows the rest afterwards. Where the budget may not hold them beside the rows of the view, the view is measured in batches.
/// Returns that view. Runs in memory or with --frames are left unchanged.
pub(super) fn allow_largest_view(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    host_mem: Option<u64>,
) -> LargestView {
    let largest = largest_view(dataset, trainer.scene.pager.index());
    let needed = largest.pages;
    if config.frames > 0 || trainer.scene.pager.frames_max() == usize::MAX {
        return largest;
    }
    let frame_bytes = trainer.scene.pager.frame_bytes() as u64;
    // A default budget may rise once the memory of a view is known.
    let most = if config.host_mem.0 == 0 { host_mem.and(obtainable_bytes()).max(host_mem) } else { host_mem };
    let mut frames = needed;
    let of_page = frame_bytes + page_working(config) + u64::from(config.page_rows) * SPLAT_BYTES;
    if let Some(budget) = most.filter(|budget| needed * of_page > budget / 4 * PROBE_WHOLE_OF_4) {
        let fewer = FirstFrames::of_batches(config, budget / PROBE_BATCH_SHARE, frame_bytes, true);
        if fewer.frames < needed {
            (frames, trainer.memory.pages_most) = (fewer.frames, fewer.pages_most);
        }
    }
    trainer.scene.pager.allow_frames(frames as usize);
    largest
}

/// Resolves `--view-order auto`. For a scene that grows, the current pages stand for the grown scene, with the number
/// of frames reduced in proportion.
fn auto_order(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &Trainer,
    frames: u64,
    [now, most]: [u64; 2],
) -> InputResult<Order> {
    let cameras = dataset.train_cameras();
    let views = ViewPages::new(trainer.scene.pager.index(), &cameras);
    // If every view fits into the frames now, plan with frames for every view.
    let least = if frames as usize >= views.most() { views.most() } else { 1 };
    let frames = if frames >= most { now } else { frames * now / most };
    let frames = (frames as usize).max(least);
    automatic_order(&views, &cameras, now as usize, frames, config.seed, PLAN_BYTES as u64)
        .map_err(|e| InputError::new("--view-order", e.to_string(), "name one: shuffle, groups:N or tour"))
}

/// Number of frames within `host_mem`, as [`plan_tiers`] chooses it. For planning without a run: `trainer` holds the
/// `view_pages` pages of the largest view.
/// Errors: the budget does not hold that view, or the view cannot be rendered.
pub(super) fn frames_within(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    probe: &Probe,
    view_pages: u64,
    host_mem: u64,
) -> Result<u64, TrainError> {
    let ([mut memory, ..], _) = estimate(config, dataset, trainer, probe, probe.rows)?;
    memory.staging = first_staging_bytes(config, host_mem);
    let need = LargestNeed { frame_bytes: trainer.scene.pager.frame_bytes() as u64, pages: view_pages };
    Ok(frames_of_budget(config, &need, Some(host_mem), &memory)?.frames)
}

/// Warns if views may outgrow the frames: the pages of the largest view grow in proportion to the Gaussians, while
/// the frames shrink.
fn warn_of_growth(config: &TrainConfig, plan: &TierPlan, host_mem: Option<u64>, memory: &[MemoryEstimate; 3]) {
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
        Some(budget) => {
            let need = LargestNeed { frame_bytes: plan.frame_bytes, pages: then };
            shrink_to_budget(config, &need, budget, &mut memory[1].clone()).min(frames)
        }
    };
    // With --frames the number of frames does not shrink as the rows of a view grow.
    let of_rows = if config.frames > 0 { 0 } else { memory[0].view - memory[0].view_pixels };
    // The growth at which the largest view needs all frames.
    let times = (frames * plan.frame_bytes + of_rows) as f64 / (needed * plan.frame_bytes + of_rows).max(1) as f64;
    let until = match config.max_gaussians {
        0 if times >= GROWTH_UNLIKELY => return,
        0 => "growth has no cap (--max-gaussians)".to_string(),
        _ if then <= left => return,
        cap => format!("with --max-gaussians {cap} the view may need {then} pages with {left} frames"),
    };
    let when = match times < 1.05 {
        true => "as soon as the scene grows".to_string(),
        false => format!("when the scene has grown about {times:.1} times"),
    };
    crate::tell!(
        "warning: the view {view} needs {needed} pages, there are {frames} frames, and {until}: {when}, steps on such views take several batches and read more; more --frames or --host-mem \
         avoid it"
    );
}

/// Gaussians that take less memory than this in frames hardly leave any to the rest of a run when they lie on a drive, bytes.
const SPILL_PAYS: u64 = 32 << 20;

fn check_in_memory([start, most, _]: &[MemoryEstimate; 3], host_mem: Option<u64>) -> InputResult<()> {
    let Some(budget) = host_mem else { return Ok(()) };
    if start.total() > budget {
        let problem = format!(
            "{} is not enough: the scene needs about {} of memory ({} for Gaussians)",
            format_bytes(budget),
            format_bytes_up(start.total()),
            format_bytes(start.frames)
        );
        // Pages on a drive take memory for their transfer and for the plan.
        let spill = match start.frames > SPILL_PAYS {
            true => "name a folder on a fast drive with --spill-dir, ",
            false => "",
        };
        let remedy = format!(
            "{spill}give at least {}, or lower --image-cache, --sh-degree or the size of the photos",
            format_bytes_up(with_margin(start.total(), start))
        );
        return Err(InputError::new("--host-mem", problem, remedy));
    }
    if most.total() > budget {
        crate::tell!(
            "warning: the run may need {} but has {}: beyond that, its pages move between memory and its checkpoint; \
             name a folder on a fast drive with --spill-dir, or lower --max-gaussians, --image-cache, --sh-degree or \
             the size of the photos",
            format_bytes(most.total()),
            format_bytes(budget)
        );
    }
    Ok(())
}

/// Views to render, spread evenly over the dataset.
const PROBE_VIEWS: usize = 6;

/// Most bytes of a renderer for a row in view that are expected of any scene: splat, gradients and staging, and some twenty
/// intersections with tiles.
const RENDERER_ROW_BYTES_MOST: u64 = 2048;

/// Known upper bound of a run's rows: the current rows, or the cap if that is more. A round of `mcmc` adds at most a twentieth, so few
/// rounds may end below the cap.
pub(crate) fn rows_at_most(config: &TrainConfig, rows: u64) -> u64 {
    match config.strategy {
        StrategyName::None => rows,
        StrategyName::Default | StrategyName::LongAxis => rows.max(config.max_gaussians),
        StrategyName::Mcmc => {
            let rounds = (config.refine_stop.min(config.steps).saturating_sub(1) / config.refine_every.max(1))
                .saturating_sub(config.refine_start / config.refine_every.max(1));
            let reachable = rows as f64 * (1.0 + mcmc::GROWTH).powi(rounds.min(1 << 20) as i32);
            rows.max(config.max_gaussians.min(reachable.ceil() as u64))
        }
    }
}

/// Input of an estimate.
#[derive(Debug, Clone)]
pub(super) struct Probe {
    pub views: Vec<usize>,
    /// Gaussians of the scene.
    pub rows: u64,
    pub pages: usize,
    /// Bytes that the graphics driver allocated during the search for a device.
    pub driver: u64,
}

impl Probe {
    /// The probe of a run: `largest` (the view that needs most pages), the largest photo, and a few views spread over the dataset. The
    /// largest comes first, so that buffers get their final size at once instead of growing with spare capacity.
    pub fn of_run(dataset: &Dataset, trainer: &Trainer, largest: Option<usize>, driver: u64) -> Probe {
        let every = dataset.views.len().div_ceil(PROBE_VIEWS).max(1);
        let spread = (0..dataset.views.len()).step_by(every).filter(|view| largest != Some(*view));
        let views = largest.into_iter().chain(spread).collect();
        let views = with_largest_photo(dataset, views);
        Probe { views, rows: trainer.scene.rows(), pages: trainer.scene.pager.index().len(), driver }
    }
}

/// `views` with the view of the largest photo second, if that photo is larger than the first view's. Rendering it measures the memory of
/// its picture, and shows whether the device can bind it.
pub(super) fn with_largest_photo(dataset: &Dataset, mut views: Vec<usize>) -> Vec<usize> {
    let pixels = |view: usize| dataset.views[view].camera.pixels();
    let largest = (0..dataset.views.len()).max_by_key(|view| pixels(*view));
    if let Some(view) = largest.filter(|view| views.first().is_some_and(|first| pixels(*view) > pixels(*first))) {
        views.retain(|other| *other != view);
        views.insert(1, view);
    }
    views
}

/// Estimates the memory of a run with all pages in memory: without growth, grown to its cap, and with `last` Gaussians. The trainer renders
/// the views of the probe and keeps the allocations for its steps; allocating twice would fragment the heap and exceed
/// the estimate. Also returns what rendering measured.
/// Errors: a view cannot be rendered.
pub(super) fn estimate(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    probe: &Probe,
    last_rows: u64,
) -> Result<([MemoryEstimate; 3], Probed), TrainError> {
    let rows = probe.rows;
    let probed = trainer
        .probe_views(dataset, &probe.views)
        .map_err(|error| device_memory::refusal(error, config, dataset, &trainer.scene, &probe.views))?;
    let (pixels, visible) = (probed.pixels as u64, probed.visible);
    let [working, rendering] = trainer.run_memory().view_bytes();
    // Image, coverage, gradient, and per-tile copies of them.
    let of_pixels = (pixels * 4 * (3 + 1 + 3 + 6)).min(rendering);
    // The part of the rows grows with the number of Gaussians and with the SH degree; the part of the pixels is
    // constant.
    let (first, last) = trainer.sh_degrees();
    let wider = row_width(last) as f64 / row_width(first) as f64;
    // A view that was probed in batches had the working set of one of them.
    let working = (working as f64 * wider).max((visible * WorkingSet::row_bytes(last)) as f64);
    let of_rows = working + (rendering - of_pixels) as f64;
    let decoders = rayon::current_num_threads();
    // A photo that a step waits for is decoded even if it exceeds the cache.
    let keep_all = TargetCache::bytes_to_keep_all(&dataset.views, decoders);
    let targets = config.image_cache.0.min(keep_all).max(largest_decode(dataset).0);
    let pages = probe.pages as f64;
    let is_growing = config.strategy.grows();
    let copies = if is_growing { bytes_of_copies(probe.pages, trainer.scene.pager.frame_bytes()) } else { 0 };
    let base = BASE_BYTES + trainer.scene.rules.adam.bytes() as u64 + probe.driver;
    let base = base + trainer.photos.iter().map(|parameter| parameter.value_bytes(dataset)).sum::<u64>();
    let memory = [rows, rows_at_most(config, rows), last_rows].map(|rows_then| {
        let growth = rows_then as f64 / rows.max(1) as f64;
        // Rows of a small scene take more bytes each than rows of a large one, so the grown estimate has an upper limit for each row.
        let most = |bytes: f64, row_bytes: u64| bytes.max((bytes * growth).min((rows_then * row_bytes) as f64));
        let page_rows = config.page_rows as usize;
        let fills_up = growth * first_fill(page_rows, true) as f64 > page_rows as f64;
        MemoryEstimate {
            frames: frames_in_memory(rows_then, last, fills_up),
            staging: 0,
            view: of_pixels + most(of_rows, WorkingSet::row_bytes(last) as u64 + RENDERER_ROW_BYTES_MOST) as u64,
            view_pixels: of_pixels,
            working: most(working, WorkingSet::row_bytes(last) as u64) as u64,
            targets,
            index: (pages * growth) as u64 * INDEX_BYTES,
            copies,
            base: base + config.export.formats().map(|format| format.memory_bytes(rows_then)).max().unwrap_or(0),
            device: probed.device.map(|view| view.grown(growth)),
        }
    });
    Ok((memory, probed))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::units::MIB;

    /// A scene whose widest view takes 80 MiB of splats, in a run whose other parts take 100 MiB.
    fn estimate() -> MemoryEstimate {
        MemoryEstimate {
            frames: 4096 * MIB,
            staging: 10 * MIB,
            view: 200 * MIB,
            view_pixels: 20 * MIB,
            working: 100 * MIB,
            targets: 20 * MIB,
            index: 10 * MIB,
            copies: 0,
            base: 40 * MIB,
            device: None,
        }
    }

    #[test]
    fn a_budget_without_the_margin_gives_the_smallest_batch_and_one_below_it_is_refused() {
        let config = TrainConfig { page_rows: 256, sh_degree: 3, ..TrainConfig::default() };
        let need = LargestNeed { frame_bytes: MIB, pages: 2000 };
        let of_a_page = 2 * need.frame_bytes + page_working(&config);
        // All but the working set, which batches make smaller.
        let least = 180 * MIB + of_a_page;
        let frames = |bytes: u64| frames_of_budget(&config, &need, Some(bytes), &estimate());
        assert_eq!(frames(least).unwrap(), FirstFrames { frames: 2, pages_most: 1 });
        let refusal = frames(least - 1).err().unwrap().to_string();
        assert!(refusal.contains("is not enough") && refusal.contains("give at least"), "{refusal}");
        // An eighth of the splats stays free before frames take more.
        assert_eq!(frames(least + 9 * MIB).unwrap(), frames(least).unwrap());
        assert!(frames(least + 40 * MIB).unwrap().frames > 20);
    }
}
