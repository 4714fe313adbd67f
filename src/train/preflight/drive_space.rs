//! The drive of the pages: whether it holds them, how much a run writes to it, and how long a run waits for it.
//!
//! Not here: a drive that is full during a run ([`crate::train::commits::checkpoint`]).
//!
//! Invariant: a drive that cannot hold the first pages is refused; one that may not hold the growth is a warning.

use crate::base::error::{InputError, InputResult};
use crate::base::units::format_bytes;
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::page::folder::file_system::free_bytes;
use crate::page::folder::measure::DriveRate;
use crate::page::format::slot_header::transfer_bytes;
use crate::paging::pager::PagerConfig;
use crate::paging::simulation::replay::{DriveModel, Replay, ReplayOptions, replay};
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageMeta;
use crate::scene::partition::first_fill;
use crate::scene::state::row_bytes;
use crate::schedule::visibility::ViewPages;
use crate::train::inputs::places::drive_of;
use crate::train::memory::largest_view::train_cameras;
use crate::train::memory::staging::PLAN_BYTES;
use crate::train::state::trainer::Trainer;

/// Epochs that are simulated to estimate the traffic of a run.
const PLAYED_EPOCHS: u32 = 3;
/// Versions of a page on the drive: one per commit kept (two), and one being written.
pub(super) const VERSIONS: u64 = 3;
/// Additional slots of writes in flight.
const SLOTS_IN_FLIGHT: u64 = 64;

/// Refuses a drive that cannot hold the `rows` first Gaussians, before the import. A drive that does not report its
/// free space passes.
/// Errors: the drive has too little free space.
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
        "the drive has {} free, but the run may need {}: {pages} pages of {}, and room for pages that are being written",
        format_bytes(free),
        format_bytes(needed),
        format_bytes(frame_bytes)
    );
    let remedy = "free space on it, choose another drive, or lower --sh-degree";
    Err(InputError::new("--spill-dir", problem, remedy))
}

/// Number of named checkpoints from `--save-every`; each may hold a version of every page.
fn checkpoints_kept(config: &TrainConfig) -> u64 {
    u64::from(config.steps.saturating_sub(1).checked_div(config.save_every).unwrap_or(0))
}

/// Refuses a drive that cannot hold the `now` pages of a scene, and warns of one that may not hold the `most` pages of the
/// grown scene with its last commits.
pub(super) fn check_drive(config: &TrainConfig, free: u64, [now, most]: [u64; 2], frame_bytes: u64) -> InputResult<()> {
    let kept = checkpoints_kept(config);
    refuse_small_drive(free, now, frame_bytes)?;
    let with_past = drive_bytes(most, frame_bytes).saturating_mul(VERSIONS.saturating_add(kept));
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
pub(crate) struct DriveUse {
    /// Bytes that the import writes.
    pub import: f64,
    /// A step with the Gaussians of now, and with those of the end.
    pub of_step: [StepUse; 2],
}

/// What a step does with its drive, mean.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct StepUse {
    /// Bytes written.
    pub written: f64,
    /// Seconds that the step waits for the drive.
    pub waits: f64,
}

/// Scene, frames and times of a run whose traffic is simulated.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SimulatedRun {
    /// Frames, possibly more than pages, with the Gaussians of now and with those of the end.
    pub frames: [usize; 2],
    /// Gaussians at the end over those of now.
    pub growth: f64,
    /// Seconds of a step that waits for nothing, with the Gaussians of now and with those of the end.
    pub step_seconds: [f64; 2],
    pub drive: DriveRate,
}

/// What the steps of a run do with its drive. Simulates a few epochs with the current pages. At the end the frames hold a smaller share of
/// the pages, and a view that needs as large a share as now goes in batches where it needs more than the frames.
pub(crate) fn drive_use(config: &TrainConfig, dataset: &Dataset, trainer: &Trainer, run: &SimulatedRun) -> DriveUse {
    let cameras = train_cameras(dataset);
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
    // With more Gaussians a page stands for several: a drive that is slower by as much takes as long.
    let of_step = |frames: usize, growth: f64, step_seconds: f64| {
        let (_, written) = play(frames, false).totals();
        let (read_rate, write_rate) = (run.drive.read / growth, run.drive.write / growth);
        let played = play(frames, true);
        let steady = played.steady();
        let waits = played.stall(steady.clone(), &DriveModel { read_rate, write_rate, step_seconds }).seconds;
        StepUse {
            written: growth * written as f64 / f64::from(steps.max(1)),
            waits: waits / steady.len().max(1) as f64,
        }
    };
    // Pages of now in the frames of now, and as large a share of them as the same frames hold of the pages at the end.
    let growth = run.growth.max(1.0);
    let [frames, then] =
        [run.frames[0] as f64, run.frames[1] as f64 / growth].map(|n| (n as usize).clamp(1, index.len().max(1)));
    let import = if trainer.steps_done() == 0 { page_bytes.iter().map(|&b| f64::from(b)).sum() } else { 0.0 };
    let [step_seconds, step_seconds_then] = run.step_seconds;
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
