//! What a run will take at the number of Gaussians that it will reach: memory, drive, bytes written, time.
//!
//! The dry run, `gsscale-plan` and the run itself make one forecast, here, from the same measurements: views rendered with
//! the first Gaussians, and a simulation of the pages of some epochs.
//!
//! Not here: which budgets are refused ([`super::plan`]), and the words (`plan_text`).
//!
//! Invariants: 1. the run does not depend on its forecast; 2. bytes of memory and drive depend on no clock.

use super::drive_space::{StepWrites, VERSIONS};
use super::plan::TierPlan;
use crate::checkpoint::interval::{CommitEvery, SHORTEST_SECONDS, bytes_per_hour};
use crate::config::file::TrainConfig;
use crate::config::limits;
use crate::config::residence::Residence;
use crate::scene::camera::Camera;
use crate::scene::state::row_bytes;
use crate::train::memory::estimate::{MemoryEstimate, rows_at_most};

/// Gaussians that each round of densification adds without a cap, as a share of the pixels of a photo, whatever their first
/// number. Measured by `gsscale-train SCENE --steps 1000`, 19 rounds: sheffield_cross_395 .17 (41,321 to 421,851), seneca
/// .17 and brighton .11 with `--max-resolution 400` (59,927 to 433,958; 7,395 to 256,525).
const ADDED_BY_A_ROUND: f64 = 0.15;
/// Rounds after which a scene hardly grows: published counts after 145 rounds are two to six times the pixels of a photo.
const ROUNDS_OF_GROWTH: u32 = 28;
/// With twice the Gaussians a step takes 1.45 times as long (`gsscale-bench pareto`): step time grows with this power of
/// their number.
pub const STEP_GROWTH: f64 = 0.54;
/// Seconds that a core takes for another Gaussian in view. Limits that power for scenes that begin with few and large
/// Gaussians: 150,000 of them at 790x594 take a step of 48 ms on two cores, 422,000 at 395x297 one of some 120 ms on one.
const ROW_SECONDS: f64 = 0.4e-6;
/// A step over the rendering of its view forward and backward: update, photo, and rows that are not in the processor's cache.
const STEP_OVER_RENDERING: f64 = 1.35;
/// Bytes of a Gaussian in a PLY beside its harmonics: position, normal, opacity, scale, rotation.
const PLY_ROW_BYTES: u64 = 56;

/// How the number of Gaussians at the end is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reach {
    /// No densification.
    Constant,
    /// The cap, which a run usually reaches.
    Cap,
    /// A guess: there is no cap.
    Guess,
    /// The number at the start: the run would decide it, and has too few photos for that.
    Kept,
    /// A guess: the run decides the count as it trains ([`crate::densify::growth`]).
    Decided,
}

/// The number of Gaussians that a run of `rows` will reach after `steps_done` of its steps, and how that is known. `pixels`
/// is the mean size of its training photos.
pub fn reach(config: &TrainConfig, rows: u64, pixels: f64, steps_done: u32) -> (u64, Reach) {
    let last = config.refine_stop.min(config.steps);
    let first = config.refine_start.max(steps_done);
    let rounds = last.saturating_sub(first) / config.refine_every.max(1);
    match config.max_gaussians {
        _ if !config.strategy.grows() || rounds == 0 => (rows, Reach::Constant),
        0 => {
            let added = ADDED_BY_A_ROUND * f64::from(rounds.min(ROUNDS_OF_GROWTH)) * pixels;
            let reach = if limits::growth_rule(config).is_some() { Reach::Decided } else { Reach::Guess };
            (rows + added as u64, reach)
        }
        _ => (rows_at_most(config, rows), Reach::Cap),
    }
}

/// Mean pixels of the training photos.
pub fn mean_pixels<'a>(cameras: impl Iterator<Item = &'a Camera>) -> f64 {
    let (mut pixels, mut photos) = (0.0, 0.0);
    for camera in cameras {
        pixels += camera.pixels() as f64;
        photos += 1.0;
    }
    pixels / f64::max(photos, 1.0)
}

/// The forecast of a run.
#[derive(Debug, Clone)]
pub struct Forecast {
    /// Gaussians now and at the end.
    pub gaussians: [u64; 2],
    /// How the last number is known.
    pub reach: Reach,
    /// Steps to do.
    pub steps: u32,
    /// Memory now, at the cap on Gaussians, and at the number that will be reached.
    pub memory: [MemoryEstimate; 3],
    /// Pages, frames and drive at the start.
    pub tiers: TierPlan,
    /// Memory limit of the run, bytes.
    pub host_mem: Option<u64>,
    /// Bytes of one version of all pages on the drive, at the end.
    pub drive_bytes: u64,
    /// Most bytes on the drive: with the pages of the commits that are kept, or the checkpoint of a run in memory.
    pub drive_bytes_most: u64,
    /// Bytes of the PLY.
    pub ply_bytes: u64,
    /// Bytes that import and steps write to the drive; 0 for a run in memory.
    pub bytes_written: f64,
    /// Most bytes that commits write.
    pub commit_bytes_most: f64,
    /// Seconds of a step with the Gaussians of now.
    pub step_seconds: f64,
    /// Seconds of all steps.
    pub seconds: f64,
}

/// What was measured before the first step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Measured {
    /// Gaussians.
    pub rows: u64,
    /// Gaussians at the end, and how that is known.
    pub reach: (u64, Reach),
    /// Steps done by earlier processes.
    pub steps_done: u32,
    /// Median seconds to render a view forward and backward.
    pub view_seconds: f64,
    /// Largest share of the Gaussians that a view draws.
    pub visible_share: f64,
    /// Bytes that steps write.
    pub writes: StepWrites,
}

impl Forecast {
    /// The forecast of a run with these pages and frames. `host_mem` limits the memory of the run.
    pub(crate) fn new(
        config: &TrainConfig,
        memory: [MemoryEstimate; 3],
        tiers: TierPlan,
        measured: &Measured,
        host_mem: Option<u64>,
    ) -> Forecast {
        let Measured { rows, reach: (last, reach), steps_done, view_seconds, visible_share, writes } = *measured;
        let growth = last as f64 / rows.max(1) as f64;
        let steps = config.steps.saturating_sub(steps_done);
        let step_seconds = view_seconds * STEP_OVER_RENDERING;
        let more = ROW_SECONDS * visible_share * (last - rows) as f64 / rayon::current_num_threads() as f64;
        let by_rows = step_seconds + more * (mean_over_steps(config, steps_done, 2.0, 1.0) - 1.0);
        let by_power = step_seconds * mean_over_steps(config, steps_done, growth, STEP_GROWTH);
        let seconds = f64::from(steps) * by_power.min(by_rows);
        let is_in_memory = config.residence() == Residence::Memory;
        let drive_bytes = (tiers.pages[0] as f64 * growth).ceil() as u64 * tiers.frame_bytes;
        let state_bytes = last * row_bytes(config.sh_degree) as u64;
        let versions = if is_in_memory { 2 } else { VERSIONS };
        let mut forecast = Forecast {
            gaussians: [rows, last],
            reach,
            steps,
            memory,
            tiers,
            host_mem,
            drive_bytes,
            drive_bytes_most: versions * if is_in_memory { state_bytes } else { drive_bytes },
            ply_bytes: last * (PLY_ROW_BYTES + 12 * (u64::from(config.sh_degree) + 1).pow(2)),
            bytes_written: 0.0,
            commit_bytes_most: commit_bytes(config, state_bytes, seconds),
            step_seconds,
            seconds,
        };
        if !is_in_memory {
            let ramp = mean_over_steps(config, steps_done, growth, 1.0);
            // From the writes of a step now to those with the Gaussians of the end, as their number grows.
            let share = if growth > 1.0 { (ramp - 1.0) / (growth - 1.0) } else { 0.0 };
            let of_step = writes.of_step[0] + share * (writes.of_step[1] - writes.of_step[0]);
            forecast.bytes_written = writes.import + of_step * f64::from(steps);
            if let Some(budget) = host_mem.filter(|_| config.frames == 0) {
                forecast.memory.iter_mut().for_each(|memory| memory.limit_frames(budget, tiers_least(&forecast.tiers)));
            }
        }
        forecast
    }

    /// Memory at the number of Gaussians that will be reached.
    pub fn memory_at_end(&self) -> &MemoryEstimate {
        &self.memory[2]
    }
}

/// The least bytes of frames: two.
fn tiers_least(tiers: &TierPlan) -> u64 {
    2 * tiers.frame_bytes
}

/// Mean over the steps to do of (Gaussians / Gaussians now) to a power, if their number grows evenly between the first round
/// and the last.
fn mean_over_steps(config: &TrainConfig, done: u32, growth: f64, power: f64) -> f64 {
    let steps = f64::from(config.steps.saturating_sub(done).max(1));
    let last = f64::from(config.refine_stop.min(config.steps).max(done) - done);
    let first = f64::from(config.refine_start.max(done) - done).min(last);
    // The mean of x^power for x from 1 to growth.
    let ramp = match growth - 1.0 {
        more if more.abs() < 1e-9 => 1.0,
        more => (growth.powf(power + 1.0) - 1.0) / ((power + 1.0) * more),
    };
    (first + (last - first) * ramp + (steps - last).max(0.0) * growth.powf(power)) / steps
}

/// Most bytes that the commits of a run of `seconds` write.
fn commit_bytes(config: &TrainConfig, state_bytes: u64, seconds: f64) -> f64 {
    let (every, limit) = match (config.residence(), config.commit_every) {
        (Residence::Frames, _) => return 0.0,
        (_, CommitEvery::Seconds(every)) => (every, f64::INFINITY),
        (Residence::Memory, CommitEvery::Auto) => (SHORTEST_SECONDS, bytes_per_hour(Some(state_bytes))),
        (Residence::SpillDir(_), CommitEvery::Auto) => (SHORTEST_SECONDS, bytes_per_hour(None)),
    };
    if every <= 0.0 {
        return 0.0;
    }
    // Each commit writes every page at most.
    (state_bytes as f64 * (seconds / every).floor()).min(limit * seconds / 3600.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::units::GIB;

    fn config() -> TrainConfig {
        TrainConfig { steps: 3000, refine_start: 500, refine_every: 100, refine_stop: 2500, ..TrainConfig::default() }
    }

    #[test]
    fn a_scene_reaches_its_cap_or_a_guess() {
        let capped = TrainConfig { max_gaussians: 5000, ..config() };
        assert_eq!(reach(&capped, 1000, 1e4, 0), (5000, Reach::Cap));
        assert_eq!(reach(&capped, 7000, 1e4, 0), (7000, Reach::Cap));
        // After the last round nothing grows.
        assert_eq!(reach(&capped, 1000, 1e4, 2450), (1000, Reach::Constant));
        // Twenty rounds.
        assert_eq!(reach(&config(), 1000, 1e4, 0), (31_000, Reach::Guess));
        assert_eq!(reach(&config(), 1000, 1e4, 1500), (16_000, Reach::Guess));
    }

    #[test]
    fn means_over_steps_follow_the_growth() {
        let of = |growth, power| mean_over_steps(&config(), 0, growth, power);
        assert_eq!(of(1.0, 0.5), 1.0);
        // 500 steps at 1, 2,000 from 1 to 3, 500 at 3; roundings.
        assert!((of(3.0, 1.0) - (500.0 + 2000.0 * 2.0 + 500.0 * 3.0) / 3000.0).abs() < 1e-12);
        assert!((mean_over_steps(&config(), 2600, 3.0, 1.0) - 3.0).abs() < 1e-12);
    }

    #[test]
    fn commits_are_bounded_by_the_size_of_the_result() {
        let hour = 3600.0;
        assert!(commit_bytes(&config(), GIB, hour) <= 24.0 * GIB as f64);
        let every = TrainConfig { commit_every: CommitEvery::Seconds(600.0), ..config() };
        assert_eq!(commit_bytes(&every, GIB, hour), 6.0 * GIB as f64);
        let never = TrainConfig { commit_every: CommitEvery::Seconds(0.0), ..config() };
        assert_eq!(commit_bytes(&never, GIB, hour), 0.0);
    }
}
