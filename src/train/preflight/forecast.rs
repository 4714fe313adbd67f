//! What a run will take at the number of Gaussians that it will reach: memory, drives, bytes written, time; and the refusal of drives that
//! cannot hold its first pages, or a PLY of its first Gaussians. Drives that may not hold the growth are a warning.
//!
//! The dry run, `gsscale-plan` and the run itself make one forecast, here, from the same measurements: views rendered with
//! the first Gaussians, and a simulation of the pages of some epochs.
//!
//! Not here: how budgets become frames ([`super::plan`]), the words (`plan_text`), a drive that is full during a run
//! ([`crate::train::commits::checkpoint`]).
//!
//! Invariants: 1. the run does not depend on its [`Forecast`], though planning sets its frames, batches and view order; 2. bytes of memory depend on no clock, and
//! those of the drive only through the number of commits in the time of the run.

use super::device_memory;
use super::plan::{Probe, TierPlan, allow_largest_view, estimate, limit_memory, plan_tiers, rows_at_most};
use crate::base::error::{InputError, InputResult};
use crate::base::units::{counted, format_bytes};
use crate::checkpoint::interval::{CommitEvery, SHORTEST_SECONDS, bytes_per_hour};
use crate::config::file::TrainConfig;
use crate::config::limits;
use crate::config::values::Residence;
use crate::dataset::loader::Dataset;
use crate::densify::growth::{GrowthCheck, counted_pixels};
use crate::densify::strategy::StrategyName;
use crate::exchange::format::ExportFormat;
use crate::page::folder::file_system::{free_bytes, is_same_drive};
use crate::page::folder::measure::DriveRate;
use crate::page::folder::spill_dir::segments_in;
use crate::page::format::slot_header::transfer_bytes;
use crate::page::format::spill_format::SlotLayout;
use crate::paging::pager::PagerConfig;
use crate::paging::simulation::replay::{DriveModel, Replay, ReplayOptions, replay};
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageMeta;
use crate::scene::partition::first_fill;
use crate::scene::state::row_bytes;
use crate::schedule::visibility::ViewPages;
use crate::train::commits::checkpoint::reserve_bytes;
use crate::train::error::TrainError;
use crate::train::inputs::machine::drive_of;
use crate::train::log::report::Foreseen;
use crate::train::memory::{MemoryEstimate, PLAN_BYTES, list_bytes};
use crate::train::start::tiers::Tiers;
use crate::train::state::trainer::Trainer;
use crate::train::state::turns::keeps_first_count;
use crate::train::step::soundness::no_view_sees;
use std::path::Path;

/// Gaussians that a round of densification adds without a cap, if rounds are [`ROUND_STEPS`] apart. Neither the size of the photos nor the
/// first number of Gaussians changes it much, see "Gaussians without a cap" in `benches/RESULTS.md`.
const ADDED_BY_A_ROUND: f64 = 20_000.0;
/// Steps between the rounds of a run of 1,000 steps.
const ROUND_STEPS: f64 = 33.0;
/// Rounds that are further apart add more: their number grows with this power of the steps between them.
const ROUND_POWER: f64 = 0.4;
/// Most Gaussians that a round adds, as a share of the existing ones: the share that the first rounds of a scene with few
/// points add.
const ADDED_MOST: f64 = 0.6;
/// With twice the Gaussians a step takes 1.45 times as long (`gsscale-bench sweep pareto`): step time grows with this power of
/// their number.
pub const STEP_GROWTH: f64 = 0.54;
/// Seconds that a core takes for another Gaussian in view. Limits that power for scenes that begin with few and large
/// Gaussians: 150,000 of them at 790x594 take a step of 48 ms on two cores, 422,000 at 395x297 one of some 120 ms on one.
const ROW_SECONDS: f64 = 0.4e-6;
/// A step over the rendering of its view forward and backward: update, photo, and rows that are not in the processor's cache. Runs of four
/// scenes fit it, see "Forecasts" in `benches/RESULTS.md`.
pub(crate) const STEP_OVER_RENDERING: f64 = 1.35;
/// Bytes of a store's map and its other small files without pages, and bytes of the map for each version of a page, with a margin.
const MAP_BYTES: u64 = 2 << 20;
const MAP_PAGE_BYTES: u64 = 1024;
/// Bytes of a Gaussian in a PLY beside its harmonics: position, normal, opacity, scale, rotation.
const PLY_ROW_BYTES: u64 = 56;

/// Fewest photos that see a page, in the mean, for the forecast of a scene that grows. Measured: 10 (brighton) and 29 (seneca), whose
/// doublings were undone or never began; 46 to 131 on scenes that grew to the most that their pixels allow.
const PHOTOS_PER_PAGE_LEAST: f64 = 37.0;
/// Brighton's 10 are .67 of its photos.
const SHARE_OF_PHOTOS: f64 = 0.8;

/// Seconds from which a plan names shorter runs, and their steps.
const LONG_SECONDS: f64 = 1200.0;
const SHORTER_STEPS: [u32; 2] = [7000, 2000];

/// How the number of Gaussians at the end is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reach {
    /// No densification.
    Constant,
    /// The cap, which a run usually reaches.
    Cap,
    /// A guess: there is no cap.
    Guess,
    /// The number at the start: the run has too few photos to decide another one.
    Kept,
    /// The most that usual runs decide as they train ([`crate::densify::growth`]).
    Decided,
    /// As [`Reach::Decided`], where photos overlap little: what the first check allows.
    Sparse,
}

/// What the training photos say about the number of Gaussians before training.
#[derive(Debug, Clone, Copy)]
pub struct TrainingPhotos {
    /// Pixels of all of them, and the [`counted_pixels`].
    pub pixels: [u64; 2],
    pub count: usize,
    /// Mean number of photos that see a page, by the bounds of pages.
    pub per_page: f64,
}

impl TrainingPhotos {
    /// Whether so few photos see a page that few doublings pay. In a scene of few photos, it is enough if nearly all see the page.
    fn overlap_little(&self) -> bool {
        self.per_page < PHOTOS_PER_PAGE_LEAST.min(SHARE_OF_PHOTOS * self.count as f64)
    }
}

/// The number of Gaussians that a run with `rows` Gaussians after `steps_done` steps will reach, and how that is known. A guess is at most one
/// Gaussian for each of the `pixels` of the training photos: a Gaussian without a pixel of its own soon has no gradient that splits it.
/// Until the `checks` of a run have decided its count, the forecast is what the first check allows if few photos see each place
/// and the run is long enough to find that out, and otherwise a doubling at every check that is left.
pub fn reach(
    config: &TrainConfig,
    rows: u64,
    photos: TrainingPhotos,
    steps_done: u32,
    checks: &[GrowthCheck],
) -> (u64, Reach) {
    let last = config.refine_stop.min(config.steps);
    let first = config.refine_start.max(steps_done);
    // Rounds come at the multiples of `every` strictly between `first` and `last`.
    let every = config.refine_every.max(1);
    let rounds = first / every + 1..=last.saturating_sub(1) / every;
    if !config.strategy.grows() || rounds.is_empty() {
        return (rows, Reach::Constant);
    }
    if config.max_gaussians > 0 {
        return (rows_at_most(config, rows), Reach::Cap);
    }
    let pixels = photos.pixels;
    match (limits::growth_rule(config), checks.last()) {
        (None, _) => (guess(rows, rounds.count() as u32, every).min(pixels[0].max(rows)), Reach::Guess),
        (Some(_), Some(check)) if check.is_final() => (check.allowed.max(rows), Reach::Decided),
        (Some(rule), last) if photos.overlap_little() && rule.is_of_measured_length() => {
            let allowed = last.map_or_else(|| rule.after_first_check(rows, pixels[1]), |check| check.allowed);
            (allowed.max(rows), Reach::Sparse)
        }
        (Some(rule), last) => {
            (rule.reachable(rows, pixels[1], last, rounds.map(|round| round * every)), Reach::Decided)
        }
    }
}

/// The number of Gaussians that `rows` become in `rounds` rounds without a cap.
fn guess(rows: u64, rounds: u32, every: u32) -> u64 {
    let of_round = ADDED_BY_A_ROUND * (f64::from(every) / ROUND_STEPS).powf(ROUND_POWER);
    let mut now = rows as f64;
    for left in (1..=rounds).rev() {
        if ADDED_MOST * now >= of_round {
            return (now + f64::from(left) * of_round) as u64;
        }
        now += ADDED_MOST * now;
    }
    now as u64
}

#[derive(Debug, Clone)]
pub struct Forecast {
    /// Gaussians now and at the end.
    pub gaussians: [u64; 2],
    /// How the last number is known.
    pub reach: Reach,
    /// The forecast of the same run without growth, if the run will decide how far it grows.
    pub if_kept: Option<Box<Forecast>>,
    pub steps: u32,
    /// Memory now, at the cap on Gaussians, and at the number that will be reached.
    pub memory: [MemoryEstimate; 3],
    /// Pages, frames and drive at the start.
    pub tiers: TierPlan,
    /// Frames at the number of Gaussians that will be reached; `None` for a run that stays in memory.
    pub frames_at_end: Option<u64>,
    /// Memory limit of the run, bytes.
    pub host_mem: Option<u64>,
    /// Bytes of one version of all pages on the drive, at the end.
    pub drive_bytes: u64,
    /// Expected peak bytes on the drive, all files counted: the pages with their versions of the commits that are kept, or the checkpoint
    /// of a run in memory.
    pub drive_bytes_peak: u64,
    /// Bytes of the PLY, and of those of --save-every.
    pub ply_bytes: u64,
    /// Bytes that import and steps write to the drive; 0 for a run that stays in memory.
    pub bytes_written: f64,
    /// Bytes that periodic commits write.
    pub commit_bytes: f64,
    /// Seconds of all steps.
    pub seconds: f64,
    /// Steps and seconds of shorter runs of the same scene, where this one is long.
    pub shorter: Vec<(u32, f64)>,
    /// Seconds among them in which steps wait for the drive.
    pub drive_seconds: f64,
}

/// What was measured before the first step.
#[derive(Debug, Clone, Copy)]
struct Measured {
    /// Gaussians.
    rows: u64,
    /// Gaussians at the end, and how that is known.
    reach: (u64, Reach),
    /// Steps done by earlier processes.
    steps_done: u32,
    /// Median seconds to render a view forward and backward.
    view_seconds: f64,
    /// Largest share of the Gaussians that a view draws.
    visible_share: f64,
    /// Largest share of the pages that the steps to do can change: a page that no view sees keeps one version.
    changed_share: f64,
    /// What steps do with the drive.
    drive: DriveUse,
    /// Frames with the Gaussians of the end; `None` for a run that stays in memory.
    frames_at_end: Option<u64>,
}

/// Chooses the frames of a run, refuses what cannot fit, and forecasts the rest. `driver`: bytes of the graphics driver.
/// Errors: a view cannot be rendered, or memory, device or drive are too small.
pub(crate) fn plan_run(
    config: &TrainConfig,
    dataset: &Dataset,
    tiers: &Tiers,
    trainer: &mut Trainer,
    host_mem: Option<u64>,
    driver: u64,
    drive_rate: DriveRate,
) -> Result<Forecast, TrainError> {
    trainer.renderer.set_list_bytes(host_mem.map(list_bytes));
    let largest = allow_largest_view(config, dataset, trainer, host_mem);
    if largest.view.is_none() {
        return Err(no_view_sees(dataset, trainer.scene.rows()).into());
    }
    let probe = Probe::of_run(dataset, trainer, largest.view, driver);
    let (rows, steps_done) = (trainer.scene.rows(), trainer.steps_done());
    let views = dataset.train_views();
    let pixels_of = |&view: &usize| dataset.views[view].camera.pixels() as u64;
    let pixels = [views.iter().map(pixels_of).sum(), views.iter().map(|view| counted_pixels(pixels_of(view))).sum()];
    let pages = trainer.scene.pager.index().len().max(1);
    let photos =
        TrainingPhotos { pixels, count: views.len(), per_page: views.len() as f64 * largest.mean / pages as f64 };
    let steps = config.steps.saturating_sub(steps_done) as usize;
    let changed_share = (views.len().min(steps) as f64 * largest.mean / pages as f64).min(1.0);
    let (last, known) = match keeps_first_count(&trainer.options.strategy, views.len()) {
        true => (rows, Reach::Kept),
        false => reach(config, rows, photos, steps_done, trainer.growth()),
    };
    let (mut memory, probed) = estimate(config, dataset, trainer, &probe, last)?;
    device_memory::check_device_memory(config, &memory)?;
    let plan = plan_tiers(config, dataset, trainer, tiers, largest, host_mem, &mut memory)?;
    let frames_at_end = limit_memory(config, &plan, host_mem, [rows, last], &mut memory);
    if let Some(free) = plan.free_bytes.filter(|_| plan.frames.is_some() && tiers.spills()) {
        check_drive(config, free, plan.pages, plan.frame_bytes, changed_share)?;
    }
    let growth = last as f64 / rows.max(1) as f64;
    let step_seconds = probed.seconds * STEP_OVER_RENDERING;
    let step_seconds = [step_seconds, step_seconds * growth.powf(STEP_GROWTH)];
    let drive = frames_at_end.map_or(DriveUse::default(), |then| {
        // A run in memory begins with a frame for each page.
        let now = plan.frames.unwrap_or(plan.pages[0]);
        drive_use(config, dataset, trainer, [now, then], growth, step_seconds, drive_rate)
    });
    let measured = Measured {
        rows,
        reach: (last, known),
        steps_done,
        view_seconds: probed.seconds,
        visible_share: probed.visible as f64 / rows.max(1) as f64,
        changed_share,
        drive,
        frames_at_end,
    };
    let mut forecast = Forecast::new(config, memory, plan.clone(), &measured, host_mem);
    if forecast.seconds > LONG_SECONDS && steps_done == 0 {
        let of_steps = |steps| {
            let config = TrainConfig { steps, ..config.clone() };
            (steps, Forecast::new(&config, memory, plan.clone(), &measured, host_mem).seconds)
        };
        forecast.shorter = SHORTER_STEPS.into_iter().filter(|steps| 2 * steps <= config.steps).map(of_steps).collect();
    }
    if !(matches!(known, Reach::Decided | Reach::Sparse) && last > rows && !trainer.state.growth.is_decided()) {
        return Ok(forecast);
    }
    let [first, most, _] = memory;
    let drive = DriveUse { of_step: [drive.of_step[0]; 2], ..drive };
    let kept = Measured { reach: (rows, known), drive, frames_at_end: plan.frames, ..measured };
    let if_kept = Forecast::new(config, [first, most, first], plan, &kept, host_mem);
    Ok(Forecast { if_kept: Some(Box::new(if_kept)), ..forecast })
}

impl Forecast {
    /// The forecast of a run with these pages and frames. `host_mem` limits the memory of the run.
    fn new(
        config: &TrainConfig,
        memory: [MemoryEstimate; 3],
        tiers: TierPlan,
        measured: &Measured,
        host_mem: Option<u64>,
    ) -> Forecast {
        let Measured {
            rows, reach: (last, reach), steps_done, view_seconds, visible_share, drive, frames_at_end, ..
        } = *measured;
        let growth = last as f64 / rows.max(1) as f64;
        let steps = config.steps.saturating_sub(steps_done);
        let step_seconds = view_seconds * STEP_OVER_RENDERING;
        let more = ROW_SECONDS * visible_share * (last - rows) as f64 / rayon::current_num_threads() as f64;
        let growing = GrowingSteps::new(config, steps_done, growth);
        let by_rows = step_seconds + more * (growing.mean(2.0, 1.0) - 1.0);
        let by_power = step_seconds * growing.mean(growth, STEP_GROWTH);
        let waits_and_writes = drive.mean_of_steps(&growing, growth);
        let drive_seconds = f64::from(steps) * waits_and_writes.waits;
        let seconds = f64::from(steps) * by_power.min(by_rows) + drive_seconds;
        let is_in_memory = config.residence() == Residence::Memory && frames_at_end.is_none();
        let pages_then = (tiers.pages[0] as f64 * growth).ceil() as u64;
        let drive_bytes = pages_then * tiers.frame_bytes;
        let state_bytes = last * row_bytes(config.sh_degree) as u64;
        let (commits, commit_bytes) = commits(config, state_bytes, seconds);
        // The first commit of a run in memory chooses the segments.
        let segment_bytes = match tiers.segment_bytes {
            0 => SlotLayout::new(tiers.frame_bytes as usize, pages_then).segment_bytes(),
            bytes => bytes,
        };
        let [of_first, of_last] = versions(is_in_memory, commits);
        let kept = named_checkpoints(config);
        let of_all = of_first * tiers.pages[0] + (of_last + kept) * pages_then;
        let slots = slots_of(pages_then, of_all, measured.changed_share);
        // A run that makes a second commit fills one more segment: evicted versions wait there until the next commit frees them, and
        // the scene gains pages after its first commit.
        let is_short = first_commit_seconds(config).is_none_or(|first| seconds < 2.0 * first);
        let extra_segment = if is_short { 0 } else { segment_bytes };
        let beside = extra_segment + if is_in_memory { 0 } else { reserve_bytes(segment_bytes) };
        let drive_bytes_peak = beside + store_bytes_peak(slots, tiers.frame_bytes, segment_bytes);
        let bytes_of_steps = drive.import + waits_and_writes.written * f64::from(steps);
        Forecast {
            gaussians: [rows, last],
            reach,
            if_kept: None,
            steps,
            memory,
            frames_at_end,
            tiers,
            host_mem,
            drive_bytes,
            drive_bytes_peak,
            ply_bytes: (1 + kept) * ply_bytes(config, last),
            bytes_written: if is_in_memory { 0.0 } else { bytes_of_steps },
            commit_bytes: commit_bytes + (kept * state_bytes) as f64,
            seconds,
            shorter: Vec::new(),
            drive_seconds,
        }
    }

    /// Whether every page has a frame at the end.
    pub(super) fn holds_all_pages(&self) -> bool {
        self.frames_at_end.is_some_and(|frames| frames.saturating_mul(self.tiers.frame_bytes) >= self.drive_bytes)
    }

    /// What the run takes with `gaussians`, as a line; `None` unless the run decides its count and so has foreseen both ends. Rows make up
    /// memory and drive, so both are interpolated in their number.
    pub(crate) fn costs_text(&self, gaussians: u64) -> Option<String> {
        let ends = [self.if_kept.as_deref()?, self];
        let costs = |of: fn(&Forecast) -> u64| interpolated(ends.map(|end| [end.gaussians[1], of(end)]), gaussians);
        let (memory, drive) = (costs(|end| end.memory_at_end().total())?, costs(|end| end.drive_bytes_peak)?);
        let [memory, drive] = [memory, drive].map(format_bytes);
        Some(format!("  which takes about {memory} of memory and {drive} of the drive"))
    }

    /// The figures that the summary keeps.
    pub(crate) fn facts(&self) -> Foreseen {
        Foreseen {
            gaussians: self.gaussians[1],
            train_seconds: self.seconds,
            host_bytes_peak: self.memory_at_end().total(),
            drive_bytes_peak: self.drive_bytes_peak,
            bytes_written: self.bytes_written,
        }
    }

    /// Memory at the number of Gaussians that will be reached.
    pub fn memory_at_end(&self) -> &MemoryEstimate {
        &self.memory[2]
    }
}

impl DriveUse {
    /// The mean over the steps to do: a step is between a present step and one with the final Gaussians, by its number of Gaussians.
    fn mean_of_steps(&self, growing: &GrowingSteps, growth: f64) -> StepUse {
        let ramp = growing.mean(growth, 1.0);
        let share = if growth > 1.0 { (ramp - 1.0) / (growth - 1.0) } else { 0.0 };
        let [now, at_end] = self.of_step;
        let mean = |now: f64, at_end: f64| now + share * (at_end - now);
        StepUse { written: mean(now.written, at_end.written), waits: mean(now.waits, at_end.waits) }
    }
}

/// The value at `x`, also beyond the two points `[x, y]`, of the line through them; `None` if the second does not come after the first.
fn interpolated([[x0, y0], [x1, y1]]: [[u64; 2]; 2], x: u64) -> Option<u64> {
    let share = (x as f64 - x0 as f64) / x1.checked_sub(x0).filter(|wide| *wide > 0)? as f64;
    Some((y0 as f64 + share * (y1 as f64 - y0 as f64)) as u64)
}

/// Bytes of the files of a store with that many slots in use: whole segments and the map.
fn store_bytes_peak(slots: u64, slot_bytes: u64, segment_bytes: u64) -> u64 {
    (slots * slot_bytes).next_multiple_of(segment_bytes.max(1)) + MAP_BYTES + slots * MAP_PAGE_BYTES
}

/// Most versions of the first pages, and of the final pages, on the drive of a run with `commits` commits before its end.
/// Versions are kept for the last two commits, and for a commit that is being written or, with a spill directory, for the steps
/// since the last commit. The import to a spill directory counts as a commit, and so does the end of a run that has committed.
fn versions(is_in_memory: bool, commits: u64) -> [u64; 2] {
    match (is_in_memory, commits) {
        (true, 0) => [0, 1],
        (false, 0 | 1) => [1, commits + 1],
        _ => [0, VERSIONS.min(commits.saturating_add(1))],
    }
}

/// Slots for `pages` pages: one version of each, and the other versions (up to `of_all` in total) only of the share of pages that change.
fn slots_of(pages: u64, of_all: u64, changed_share: f64) -> u64 {
    pages + (changed_share * of_all.saturating_sub(pages) as f64).ceil() as u64
}

fn ply_bytes(config: &TrainConfig, rows: u64) -> u64 {
    rows * (PLY_ROW_BYTES + 12 * (u64::from(config.sh_degree) + 1).pow(2))
}

/// The numbers of steps to do before, during and after the growth of the scene.
struct GrowingSteps {
    before: f64,
    /// Steps in which it grows, evenly.
    growing: f64,
    after: f64,
}

impl GrowingSteps {
    /// Those of a scene that becomes so many times as large. A round of the long-axis strategy doubles the scene as long as there is room,
    /// so that growth to a cap ends early; a run that decides its count grows with its checks.
    fn new(config: &TrainConfig, done: u32, growth: f64) -> GrowingSteps {
        let end = config.refine_stop.min(config.steps);
        let [first, last] = match limits::growth_rule(config) {
            Some(rule) => rule.check_steps().map(|step| step.min(end)),
            None if config.strategy == StrategyName::LongAxis => {
                let rounds = growth.max(1.0).log2().ceil() as u32;
                [config.refine_start, end.min(config.refine_start + config.refine_every * rounds)]
            }
            None => [config.refine_start, end],
        };
        let last = last.max(done) - done;
        let first = (first.max(done) - done).min(last);
        let after = config.steps.saturating_sub(done).saturating_sub(last);
        GrowingSteps { before: first.into(), growing: (last - first).into(), after: after.into() }
    }

    /// Mean over the steps of (Gaussians / Gaussians now) to a power, if their number becomes `growth` times as large.
    fn mean(&self, growth: f64, power: f64) -> f64 {
        let GrowingSteps { before, growing, after } = *self;
        // The mean of x^power for x from 1 to growth.
        let ramp = match growth - 1.0 {
            more if more.abs() < 1e-9 => 1.0,
            more => (growth.powf(power + 1.0) - 1.0) / ((power + 1.0) * more),
        };
        (before + growing * ramp + after * growth.powf(power)) / (before + growing + after).max(1.0)
    }
}

/// Seconds of training before the first commit of a run; `None` if it makes none.
fn first_commit_seconds(config: &TrainConfig) -> Option<f64> {
    let every = match config.commit_every {
        CommitEvery::Seconds(every) => every,
        CommitEvery::Auto => SHORTEST_SECONDS,
    };
    (every > 0.0 && config.residence() != Residence::Frames).then_some(every)
}

/// Periodic commits of a run of about `seconds`, and the bytes that they write where each writes all pages.
fn commits(config: &TrainConfig, state_bytes: u64, seconds: f64) -> (u64, f64) {
    let Some(every) = first_commit_seconds(config) else { return (0, 0.0) };
    let limit = match (config.residence(), config.commit_every) {
        (_, CommitEvery::Seconds(_)) => f64::INFINITY,
        (Residence::Memory, CommitEvery::Auto) => bytes_per_hour(Some(state_bytes)),
        (_, CommitEvery::Auto) => bytes_per_hour(None),
    };
    // Each commit writes every page at most. The limit of an hour does not hold back the first commit.
    let state = state_bytes as f64;
    let commits = (seconds / every).min((limit * seconds / 3600.0 / state.max(1.0)).max(1.0));
    (commits as u64, state * commits.ceil())
}

/// Epochs that are simulated to estimate the traffic of a run.
const PLAYED_EPOCHS: u32 = 3;
/// Versions of a page on the drive: one per commit kept (two), and one being written.
const VERSIONS: u64 = 3;
/// Additional slots of writes in flight.
const SLOTS_IN_FLIGHT: u64 = 64;

/// Pages of `rows` first Gaussians, and the bytes of the frame of one.
pub(crate) fn first_pages(config: &TrainConfig, rows: u64) -> [u64; 2] {
    let frame_bytes = PagerConfig::in_memory(config.page_rows as usize, config.sh_degree).frame_bytes() as u64;
    [rows.div_ceil(first_fill(config.page_rows as usize, config.strategy.grows()) as u64), frame_bytes]
}

/// Refuses a drive that cannot hold the `rows` first Gaussians, before the import. What a run left in the folder that was cut off before
/// its first commit counts as free. A drive that does not report its free space passes.
/// Errors: the drive has too little free space.
pub fn check_first_drive(config: &TrainConfig, rows: u64) -> InputResult<()> {
    let Some(spill_dir) = config.residence().spill_dir() else { return Ok(()) };
    let Some(free) = free_bytes(&drive_of(spill_dir)).ok().flatten() else { return Ok(()) };
    let uncommitted = segments_in(spill_dir).unwrap_or_default().into_iter().map(|(_, bytes)| bytes);
    let free = uncommitted.fold(free, u64::saturating_add);
    let [pages, frame_bytes] = first_pages(config, rows);
    refuse_small_drive(free, pages, frame_bytes)
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
        "the drive has {} free, but the run may need {}: {} of {}, and room for pages that are being written",
        format_bytes(free),
        format_bytes(needed),
        counted(pages, "page"),
        format_bytes(frame_bytes)
    );
    let remedy = "free space on it, choose another drive, or lower --sh-degree";
    Err(InputError::new("--spill-dir", problem, remedy))
}

/// The named checkpoints of --save-every, each with a PLY beside it. A checkpoint may hold a version of every page.
fn named_checkpoints(config: &TrainConfig) -> u64 {
    u64::from(config.steps.saturating_sub(1).checked_div(config.save_every).unwrap_or(0))
}

/// Refuses a drive that cannot hold the `now` pages of a scene, and warns of one that may not hold the `most` pages of the
/// grown scene with its last commits.
fn check_drive(
    config: &TrainConfig,
    free: u64,
    [now, most]: [u64; 2],
    frame_bytes: u64,
    changed_share: f64,
) -> InputResult<()> {
    let kept = named_checkpoints(config);
    refuse_small_drive(free, now, frame_bytes)?;
    let of_all = most.saturating_mul(VERSIONS.saturating_add(kept));
    let with_past = drive_bytes(slots_of(most, of_all, changed_share), frame_bytes);
    if free < with_past {
        let (named, fewer) = match kept {
            0 => (String::new(), ""),
            kept => (format!(" and {kept} named checkpoints"), ", keep fewer checkpoints with --save-every"),
        };
        crate::tell!(
            "warning: the scene with its last two commits{named} may take {} on the drive, which has {} free: lower \
             --max-gaussians{fewer}, or commit less often with --commit-every",
            format_bytes(with_past),
            format_bytes(free)
        );
    }
    Ok(())
}

/// What a run does with its drive, without commits.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct DriveUse {
    /// Bytes that the import writes.
    import: f64,
    /// A step with the Gaussians of now, and with those of the end.
    of_step: [StepUse; 2],
}

/// What a step does with its drive, mean.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct StepUse {
    /// Bytes written.
    written: f64,
    /// Seconds that the step waits for the drive.
    waits: f64,
}

/// What the steps of a run do with its drive. Simulates a few epochs with the current pages. At the end the frames hold a smaller share of
/// the pages, and a view that needs as large a share as now goes in batches where it needs more than the frames. `frames` (possibly more than
/// pages) and `step_seconds` (of a step that waits for nothing) are those with the Gaussians of now and those of the end, which are `growth`
/// times as many.
fn drive_use(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &Trainer,
    frames: [u64; 2],
    growth: f64,
    step_seconds: [f64; 2],
    drive: DriveRate,
) -> DriveUse {
    let cameras = dataset.train_cameras();
    let index = trainer.scene.pager.index();
    let steps = config.steps.min(PLAYED_EPOCHS * cameras.len() as u32);
    let sh_degree = config.sh_degree;
    let bands = share_of_bands(trainer, config);
    let payload = |page: &PageMeta| bands * PageLayout { rows: page.rows as usize, sh_degree }.bytes() as f64;
    let page_bytes: Vec<u32> = index.iter().map(|page| transfer_bytes(payload(page) as usize) as u32).collect();
    let views = ViewPages::new(index, &cameras);
    let play = |frames: usize, reads_ahead: bool| -> Replay {
        let options = ReplayOptions { frames, policy: config.evict, reads_ahead, steps, plan_bytes: PLAN_BYTES as u64 };
        replay(&views, &page_bytes, trainer.view_order(), &options).unwrap_or_default()
    };
    // At the end, a present page stands for `growth` pages, so the simulated drive is slower by that factor.
    let of_step = |frames: usize, growth: f64, step_seconds: f64| {
        let (_, written) = play(frames, false).totals();
        let (read_rate, write_rate) = (drive.read / growth, drive.write / growth);
        let played = play(frames, true);
        let steady = played.steady();
        let waits = played.stall(steady.clone(), &DriveModel { read_rate, write_rate, step_seconds }).seconds;
        StepUse {
            written: growth * written as f64 / f64::from(steps.max(1)),
            waits: waits / steady.len().max(1) as f64,
        }
    };
    // Present frames, and the frames that hold the same share of the present pages as the final frames will hold of the final pages.
    let growth = growth.max(1.0);
    let [frames, then] =
        [frames[0] as f64, frames[1] as f64 / growth].map(|n| (n as usize).clamp(1, index.len().max(1)));
    let import = if trainer.steps_done() == 0 { page_bytes.iter().map(|&b| f64::from(b)).sum() } else { 0.0 };
    let [step_seconds, step_seconds_then] = step_seconds;
    let now = of_step(frames, 1.0, step_seconds);
    let at_end = match then < frames || growth > 1.0 {
        true => of_step(then.min(frames), growth, step_seconds_then),
        false => now,
    };
    DriveUse { import, of_step: [now, at_end] }
}

/// Bytes of a Gaussian on the drive over those with all colour bands, mean over the steps to do: pages hold the bands that the run has
/// reached.
fn share_of_bands(trainer: &Trainer, config: &TrainConfig) -> f64 {
    let steps = trainer.steps_done()..config.steps;
    let bytes = |step: u32| row_bytes(trainer.options.sh_degree_at(step)) as f64;
    let sum: f64 = steps.clone().map(bytes).sum();
    if steps.is_empty() { 1.0 } else { sum / (steps.len() as f64 * row_bytes(config.sh_degree) as f64) }
}

/// The most bytes of the file for viewers while it is written, in percent of those of the PLY. SPZ: 8, and up to 34 for its temporary
/// file. SOG: 12.
fn export_percent(format: ExportFormat) -> u64 {
    match format {
        ExportFormat::Ply => 0,
        ExportFormat::Spz => 42,
        ExportFormat::Sog => 12,
    }
}

/// Refuses a drive that cannot hold a PLY of the first Gaussians, unless the run is resumed. Warns if the drive may not hold the results of
/// the end: the PLY, the files for viewers and, where they lie on the same drive, the pages of the store or the checkpoint beyond the
/// `stored` bytes of now. A drive that does not report its free space passes.
/// Errors: the drive has too little free space.
pub(crate) fn check_drive_of_results(
    config: &TrainConfig,
    out: &Path,
    forecast: &Forecast,
    stored: u64,
    is_resumed: bool,
) -> InputResult<()> {
    let drive = drive_of(out);
    let Some(free) = free_bytes(&drive).ok().flatten() else { return Ok(()) };
    let [now, last] = forecast.gaussians.map(|rows| ply_bytes(config, rows));
    if free < now && !is_resumed {
        let problem = format!(
            "the drive has {} free, but the PLY of the first Gaussians alone takes {}",
            format_bytes(free),
            format_bytes(now)
        );
        return Err(InputError::new(out, problem, "free space on it, or choose another --out"));
    }
    let results = last + last / 100 * config.export.formats().map(export_percent).sum::<u64>();
    let (pages, beside) = match config.residence() {
        Residence::Memory => (forecast.drive_bytes_peak, " and the checkpoint"),
        Residence::SpillDir(folder) if is_same_drive(&drive, &drive_of(folder)) => {
            (forecast.drive_bytes_peak, " and the pages, which lie on the same drive,")
        }
        _ => (0, ""),
    };
    let needed = results.saturating_add(pages.saturating_sub(stored));
    if free < needed {
        crate::tell!(
            "warning: the results{beside} may take {} more in {}, whose drive has {} free: free space, choose another --out, or \
             lower --max-gaussians",
            format_bytes(needed),
            out.display(),
            format_bytes(free)
        );
    }
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::units::GIB;
    use crate::densify::growth::GrowthDecision;

    /// Pixels of photos that limit no guess.
    const PIXELS: u64 = 1 << 40;

    fn config() -> TrainConfig {
        TrainConfig {
            steps: 3000,
            refine_start: 500,
            refine_every: 100,
            refine_stop: 2500,
            strategy: StrategyName::Default,
            ..TrainConfig::default()
        }
    }

    fn well_seen(pixels: u64) -> TrainingPhotos {
        TrainingPhotos { pixels: [pixels; 2], count: 100, per_page: PHOTOS_PER_PAGE_LEAST }
    }

    #[test]
    fn a_scene_reaches_its_cap_or_a_guess() {
        let capped = TrainConfig { max_gaussians: 5000, ..config() };
        assert_eq!(reach(&capped, 1000, well_seen(PIXELS), 0, &[]), (5000, Reach::Cap));
        assert_eq!(reach(&capped, 7000, well_seen(PIXELS), 0, &[]), (7000, Reach::Cap));
        // Nineteen rounds that add a twentieth each.
        let relocates = TrainConfig { strategy: StrategyName::Mcmc, ..capped.clone() };
        assert_eq!(reach(&relocates, 1000, well_seen(PIXELS), 0, &[]), (2527, Reach::Cap));
        assert_eq!(reach(&relocates, 4000, well_seen(PIXELS), 0, &[]), (5000, Reach::Cap));
        // After the last round nothing grows.
        assert_eq!(reach(&capped, 1000, well_seen(PIXELS), 2450, &[]), (1000, Reach::Constant));
        // Small photos cannot hold what rounds would add; a scene with more Gaussians than that keeps its number.
        let long = TrainConfig { steps: 1_000_000, refine_stop: 15_000, ..config() };
        assert_eq!(reach(&long, 400, well_seen(14 * 96 * 64), 0, &[]), (14 * 96 * 64, Reach::Guess));
        assert_eq!(reach(&long, 400, well_seen(100), 0, &[]), (400, Reach::Guess));
    }

    #[test]
    fn a_run_that_decides_its_count_forecasts_the_most_until_it_has_decided() {
        let decides = TrainConfig { strategy: StrategyName::LongAxis, ..config() };
        assert_eq!(
            reach(&decides, 41_321, well_seen(9_600_000), 0, &[]),
            (400_000, Reach::Decided),
            "one for 24 pixels"
        );
        assert_eq!(
            reach(&decides, 41_321, well_seen(9600), 0, &[]),
            (41_321, Reach::Decided),
            "no fewer than at first"
        );
        let hardly_seen = TrainingPhotos { pixels: [9_600_000; 2], count: 100, per_page: PHOTOS_PER_PAGE_LEAST - 1.0 };
        assert_eq!(reach(&decides, 41_321, hardly_seen, 0, &[]), (82_642, Reach::Sparse));
        // The checks of a short run hold no scene back.
        let short = TrainConfig { steps: 500, refine_start: 83, refine_every: 16, refine_stop: 400, ..decides.clone() };
        assert_eq!(reach(&short, 41_321, hardly_seen, 0, &[]), (400_000, Reach::Decided));
        let check = GrowthCheck {
            step: 1001,
            gaussians: 41_000,
            psnr: 20.0,
            trained_psnr: 20.0,
            ssim: 0.5,
            trained_ssim: 0.5,
            decision: GrowthDecision::Doubles,
            allowed: 165_284,
        };
        // The checks that are left may double until one has decided.
        assert_eq!(reach(&decides, 60_000, well_seen(9_600_000), 1001, &[check]), (400_000, Reach::Decided));
        let decided = GrowthCheck { decision: GrowthDecision::Ends, ..check };
        assert_eq!(reach(&decides, 60_000, well_seen(9_600_000), 1001, &[decided]), (165_284, Reach::Decided));
        assert_eq!(reach(&decides, 60_000, hardly_seen, 1001, &[check]), (165_284, Reach::Sparse));
        assert_eq!(reach(&TrainConfig { max_gaussians: 9, ..decides }, 5, well_seen(PIXELS), 0, &[]), (9, Reach::Cap));
    }

    #[test]
    fn each_round_adds_as_much_as_the_others() {
        // Nineteen rounds: after 600, 700, ... 2400 steps; nine of them after 1,500.
        let added = |done: u32| reach(&config(), 100_000, well_seen(PIXELS), done, &[]).0 - 100_000;
        assert!((added(0) as f64 / 19.0 - added(1500) as f64 / 9.0).abs() < 1.0);
    }

    #[test]
    fn each_commit_that_is_kept_holds_a_version_of_its_own() {
        assert_eq!([0, 1, 2, 9].map(|commits| versions(true, commits)), [[0, 1], [0, 2], [0, 3], [0, 3]]);
        assert_eq!([0, 1, 2, 9].map(|commits| versions(false, commits)), [[1, 1], [1, 2], [0, 3], [0, 3]]);
        // Pages that no view sees have one.
        assert_eq!([0.0, 0.1, 1.0].map(|share| slots_of(100, 300, share)), [100, 120, 300]);
    }

    #[test]
    fn means_over_steps_follow_the_growth() {
        let of = |growth, power| GrowingSteps::new(&config(), 0, growth).mean(growth, power);
        assert_eq!(of(1.0, 0.5), 1.0);
        // 500 steps at 1, 2,000 from 1 to 3, 500 at 3; roundings.
        assert!((of(3.0, 1.0) - (500.0 + 2000.0 * 2.0 + 500.0 * 3.0) / 3000.0).abs() < 1e-12);
        let of_later = GrowingSteps::new(&config(), 2600, 3.0);
        assert!((of_later.mean(3.0, 1.0) - 3.0).abs() < 1e-12);
        // Two rounds of doublings make room for a cap of three times the scene; checks decide between 800 and 2,200 steps.
        let steps_of = |config: &TrainConfig| {
            let GrowingSteps { before, growing, after } = GrowingSteps::new(config, 0, 3.0);
            [before, growing, after]
        };
        let decides = TrainConfig { strategy: StrategyName::LongAxis, ..config() };
        assert_eq!(steps_of(&TrainConfig { max_gaussians: 9, ..decides.clone() }), [500.0, 200.0, 2300.0]);
        assert_eq!(steps_of(&decides), [800.0, 1400.0, 800.0]);
    }

    #[test]
    fn commits_are_bounded_by_the_size_of_the_result() {
        let hour = 3600.0;
        assert!(commits(&config(), GIB, hour).1 <= 24.0 * GIB as f64);
        let every = TrainConfig { commit_every: CommitEvery::Seconds(600.0), ..config() };
        assert_eq!(commits(&every, GIB, hour), (6, 6.0 * GIB as f64));
        let never = TrainConfig { commit_every: CommitEvery::Seconds(0.0), ..config() };
        assert_eq!(commits(&never, GIB, hour), (0, 0.0));
    }

    #[test]
    fn costs_grow_with_the_rows() {
        let at = |gaussians| interpolated([[1000, 100], [8000, 800]], gaussians);
        assert_eq!([1000, 4000, 16_000].map(at), [100, 400, 1600].map(Some), "also beyond what was foreseen");
        assert_eq!(interpolated([[1000, 1], [1000, 2]], 1000), None);
    }
}
