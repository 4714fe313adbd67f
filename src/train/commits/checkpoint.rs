//! The commits of a run: when to commit, the state that a commit holds, and what happens on a full drive.
//!
//! A periodic commit runs beside training: a cut between two steps, its pages written during the following steps
//! ([`crate::paging`]), then the transaction. A commit that must complete first (before a stop, at the end, on a full
//! drive) is written at once.
//!
//! On a full drive, first two commits free the slots of old versions; the reserve is released to make room for them. If
//! that is not enough, training waits, with its state in memory, until the user frees space, and then continues. After
//! `--disk-full-wait` the run stops. A run in memory waits as well, because it would lose all steps since its last commit if
//! it ended; but its steps need no drive, so after the wait it goes on without commits where there is room for its results.
//!
//! Not here: the results after the last step (`super::results`).
//!
//! Invariants: 1. commits happen between steps and do not change the run; 2. a commit holds all state on which later
//! steps depend: a run resumed from it ends with the same bytes; 3. clocks decide only when to commit; 4. a run in
//! memory creates its checkpoint at its first commit, so a short run writes none; 5. waiting for space changes nothing, and the last
//! commit always stays intact.

use crate::base::trace;
use crate::base::units::format_bytes;
use crate::checkpoint::interval::{CommitCost, CommitEvery, CommitInterval, CommitReport};
use crate::checkpoint::run_state::{DatasetPrint, Origin, RunState};
use crate::page::engine::open::{DEPTH, IoEngine, open_engine};
use crate::page::folder::file_system::{free_bytes, is_same_drive};
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::format::codec::Codec;
use crate::page::map::commit::{CommitConfig, CommitError, Commits, MAP_NAME};
use crate::page::map::opening::Opened;
use crate::page::tool::uncommitted::remove_uncommitted;
use crate::page::versions::paged_store::PagedStore;
use crate::page::versions::slots::SlotLayout;
use crate::paging::pager::Pager;
use crate::paging::stats::SlotSpace;
use crate::photos;
use crate::scene::state::row_bytes;
use crate::train::error::TrainError;
use crate::train::inputs::machine::drive_of;
use crate::train::inputs::signals::StopFlag;
use crate::train::log::report::MetricsLog;
use crate::train::state::trainer::Trainer;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A commit beside training that is not written after this time is completed at once.
const BESIDE_SECONDS: f64 = 20.0;
/// Least time between a commit and an early commit for space.
const EARLY_SECONDS: f64 = 10.0;
/// Fewer than 1/10 of the slots free counts as few.
const FEW_FREE: u64 = 10;
/// An early commit must free at least 1/20 of the slots.
const WORTH_FREEING: u64 = 20;

/// Interval between checks of the drive.
pub(super) const POLL: Duration = Duration::from_secs(1);
/// The reserve is filled only if it takes less than 1/4 of the free bytes.
const RESERVE_SHARE: u64 = 4;
/// Bytes required on the drive of the results during a run: metrics take a few hundred bytes per line.
const OTHER_BYTES: u64 = 1 << 20;
/// The results take less than 160 % of the bytes of the rows: the PLY 106, a file for viewers 42, and the report.
const RESULTS_PERCENT: u64 = 160;

/// Least reserve for a last commit on a full drive, bytes: room for the map to grow.
const RESERVE_BYTES_LEAST: u64 = 2 << 20;
const RESERVE_BYTES_MOST: u64 = 256 << 20;

/// Bytes that a spill directory holds back for the moment when its drive is full.
pub(crate) fn reserve_bytes(segment_bytes: u64) -> u64 {
    segment_bytes.clamp(RESERVE_BYTES_LEAST, RESERVE_BYTES_MOST)
}

/// The commits of a run.
#[derive(Debug)]
pub struct Checkpoint {
    /// `None` before the first commit of a run in memory.
    commits: Option<Commits>,
    /// Creates the store at the first commit of a run in memory.
    first: Option<FirstCommit>,
    /// The folder created by that first commit.
    pub(crate) spill: Option<SpillDir>,
    /// Name under which the next commit is kept; later commits do not replace it.
    pub(crate) name: Option<String>,
    /// Folder of the store, which may not exist yet.
    pub folder: PathBuf,
    /// The run can continue without commits: all pages are in memory.
    pub is_optional: bool,
    /// The run has waited for space in vain and goes on without commits, until one finds space.
    goes_without: bool,
    /// How long to wait for space.
    full_wait: Duration,
    /// Step at which space was last made, whether on the store's drive, and when. A second attempt at the same step
    /// waits for space instead.
    space_made: Option<(u32, bool, Instant)>,
    interval: CommitInterval,
    started: Instant,
    /// When the last commit became durable.
    last: Instant,
    last_cut: Instant,
    beside: Option<Beside>,
    /// How the run was started; see [`Checkpoint::set_origin`].
    origin: Option<Origin>,
    /// Commits since the store was opened.
    pub(crate) done: u64,
    /// Step of the last of them.
    pub last_step: Option<u32>,
}

/// When a run commits, and how long it waits for space.
#[derive(Debug, Clone, Copy)]
pub struct CommitOptions {
    pub every: CommitEvery,
    pub full_wait: Duration,
}

/// A commit in progress beside training.
#[derive(Debug)]
struct Beside {
    run_state: Vec<u8>,
    step: u32,
    cut: Instant,
    waited: Duration,
    /// The pager's commit seconds before this commit.
    pager_seconds: f64,
}

impl Checkpoint {
    /// Commits to the store in `folder` at this interval; the first commit follows one interval from now.
    pub fn new(commits: Commits, folder: &Path, options: CommitOptions) -> Checkpoint {
        Checkpoint { commits: Some(commits), ..Checkpoint::without(folder, options) }
    }

    /// Commits of a run in memory: the first commit creates the store with `first`.
    pub(crate) fn later(first: FirstCommit, options: CommitOptions) -> Checkpoint {
        let folder = first.folder.clone();
        Checkpoint { first: Some(first), is_optional: true, ..Checkpoint::without(&folder, options) }
    }

    fn without(folder: &Path, options: CommitOptions) -> Checkpoint {
        let now = Instant::now();
        Checkpoint {
            commits: None,
            first: None,
            spill: None,
            name: None,
            folder: folder.to_path_buf(),
            is_optional: false,
            goes_without: false,
            full_wait: options.full_wait,
            space_made: None,
            interval: CommitInterval::new(options.every),
            started: now,
            last: now,
            last_cut: now,
            beside: None,
            origin: None,
            done: 0,
            last_step: None,
        }
    }

    /// Sets how the run was started. Must precede the first commit.
    pub fn set_origin(&mut self, origin: Origin) {
        self.origin = Some(origin);
        (self.started, self.last, self.last_cut) = (Instant::now(), Instant::now(), Instant::now());
    }

    /// Whether to commit after the last step. A run in memory without commits should not: it would write all pages to a
    /// checkpoint that is removed at once.
    pub fn needs_last_commit(&self) -> bool {
        self.commits.is_some()
    }

    /// Costs of the commits so far.
    pub fn report(&self) -> CommitReport {
        self.interval.report(self.started.elapsed().as_secs_f64())
    }

    /// Called between two steps: begins a commit if one is due, and completes one whose pages are written.
    /// Errors: as [`Checkpoint::commit`].
    pub fn between_steps(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        if self.is_optional {
            self.interval.limit_bytes(trainer.scene.rows() * row_bytes(trainer.scene.rules.sh_degree) as u64);
        }
        if !trainer.scene.pager.is_frozen() {
            // A failed write abandoned it; the next step returns the error.
            self.beside = None;
        }
        match &self.beside {
            // A commit named after a step must hold that step.
            _ if self.name.is_some() => self.commit(trainer, metrics),
            None if self.is_time() && self.first.is_some() => self.commit(trainer, metrics),
            None if self.is_time() && self.commits.is_some() => self.begin(trainer, metrics),
            None if self.may_commit_early() && self.space_is_short(trainer) => self.commit(trainer, metrics),
            Some(beside)
                if trainer.scene.pager.is_frozen_written() || beside.cut.elapsed().as_secs_f64() >= BESIDE_SECONDS =>
            {
                self.finish(trainer)
            }
            _ => Ok(()),
        }
    }

    /// Whether [`Checkpoint::between_steps`] may have something to do now.
    pub fn is_due(&self, trainer: &Trainer) -> bool {
        if self.commits.is_none() && self.first.is_none() {
            return false;
        }
        let is_begun = self.name.is_some() || self.beside.is_some();
        is_begun || self.is_time() || (self.may_commit_early() && self.space_is_short(trainer))
    }

    /// Whether an early commit for free slots is allowed. The time limit prevents a commit at every step, since slots
    /// kept by names stay taken.
    fn may_commit_early(&self) -> bool {
        !self.is_optional && self.last.elapsed().as_secs_f64() >= EARLY_SECONDS
    }

    fn is_time(&self) -> bool {
        self.interval.is_due(self.last.elapsed().as_secs_f64())
    }

    /// Leaves out a commit for which there is no space; the next attempt follows one interval later.
    fn miss(&mut self) {
        // The next commit would hold another step, so drop the name.
        if let Some(name) = self.name.take() {
            crate::tell!("warning: {name} is not kept: there is no space for a commit");
        }
        self.last = Instant::now();
    }

    /// Creates the checkpoint of a run in memory at its first commit. On failure the run continues without commits;
    /// after a lack of space the next commit tries again.
    fn make_first(&mut self, trainer: &mut Trainer) -> Result<(), TrainError> {
        let Some(first) = &self.first else { return Ok(()) };
        match first.make(&mut trainer.scene.pager) {
            Ok((spill, commits)) => (self.spill, self.commits) = (Some(spill), Some(commits)),
            Err(error) if error.is_out_of_space() => return Err(error),
            Err(error) => crate::tell!("warning: this run is not committed, so it cannot be resumed: {error}"),
        }
        self.first = None;
        Ok(())
    }

    fn begin(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        let Some(origin) = &self.origin else { return Ok(()) };
        let cut = Instant::now();
        trainer.drain()?;
        let pager_seconds = trainer.scene.pager.commit_seconds();
        let state = run_state(trainer, origin, metrics.sync()?)?;
        let run_state = bytes_of(&state)?;
        trainer.scene.pager.freeze()?;
        self.beside = Some(Beside { run_state, step: state.trainer.step, cut, waited: cut.elapsed(), pager_seconds });
        // Without pages to write, complete the commit now.
        if trainer.scene.pager.is_frozen_written() { self.finish(trainer) } else { Ok(()) }
    }

    fn finish(&mut self, trainer: &mut Trainer) -> Result<(), TrainError> {
        let Some(beside) = self.beside.take() else { return Ok(()) };
        let began = Instant::now();
        let pager = &mut trainer.scene.pager;
        pager.finish_frozen()?;
        let note = format!("step {}", beside.step);
        let Some(commits) = &mut self.commits else { return Ok(()) };
        let Some((_, bytes)) = pager.commit_frozen(commits, &beside.run_state, note.as_bytes())? else {
            return Ok(());
        };
        let beside_steps = pager.commit_seconds() - beside.pager_seconds;
        let waited = (beside.waited + began.elapsed()).as_secs_f64() + beside_steps;
        self.acknowledged(beside.step, beside.cut, waited, bytes);
        Ok(())
    }

    /// Completes the commit in progress after a step that failed half-way, so that the run loses no more than that step.
    /// The step changed no page of the cut before the page was written.
    /// Errors: a page of the cut cannot be written; earlier commits are intact.
    pub(crate) fn finish_cut(&mut self, trainer: &mut Trainer) -> Result<(), TrainError> {
        if trainer.scene.pager.is_frozen() { self.finish(trainer) } else { Ok(()) }
    }

    /// Commits the current state at once and abandons a commit in progress.
    /// Errors: the commit failed; earlier commits are intact.
    pub fn commit(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        if self.origin.is_none() {
            return Ok(());
        }
        let _span = trace::span("commit");
        let cut = Instant::now();
        trainer.drain()?;
        self.beside = None;
        self.make_first(trainer)?;
        let name = self.name.clone();
        let Some(origin) = &self.origin else { return Ok(()) };
        let Some(commits) = &mut self.commits else {
            self.name = None;
            return Ok(());
        };
        let written = trainer.scene.pager.stats().bytes_written;
        trainer.scene.pager.flush()?;
        let state = run_state(trainer, origin, metrics.sync()?)?;
        let note = format!("step {}", state.trainer.step);
        trainer.scene.pager.commit(commits, &bytes_of(&state)?, note.as_bytes(), name.as_deref())?;
        self.name = None;
        let bytes = trainer.scene.pager.stats().bytes_written - written;
        self.acknowledged(state.trainer.step, cut, cut.elapsed().as_secs_f64(), bytes);
        Ok(())
    }

    fn acknowledged(&mut self, step: u32, cut: Instant, waited: f64, bytes: u64) {
        self.done += 1;
        self.last_step = Some(step);
        if std::mem::take(&mut self.goes_without) {
            crate::tell!("there is space again: step {step} is committed");
        }
        let until_durable = cut.elapsed().as_secs_f64();
        let at_risk = self.last_cut.elapsed().as_secs_f64();
        self.interval.add(CommitCost { waited, until_durable, bytes, at_risk });
        (self.last, self.last_cut) = (Instant::now(), cut);
    }

    /// Whether an early commit is needed to free slots.
    fn space_is_short(&self, trainer: &Trainer) -> bool {
        let Some(space) = trainer.scene.pager.slot_space().filter(should_commit_for_slots) else { return false };
        let left = free_bytes(&self.folder).ok().flatten();
        left.is_some_and(|left| left < space.segment_bytes)
    }

    /// Fills the reserve if the drive has much more free space.
    /// Errors: the folder cannot be written.
    pub fn fill_reserve(&mut self) -> Result<(), TrainError> {
        let Some(commits) = &mut self.commits else { return Ok(()) };
        let reserve = commits.config().reserve_bytes;
        let free = free_bytes(&self.folder).ok().flatten();
        if reserve > 0 && free.is_none_or(|free| free / RESERVE_SHARE > reserve) {
            commits.fill_reserve()?;
        }
        Ok(())
    }

    /// Frees space after `why`, or waits for space. Training can continue afterwards, unless a stop was requested.
    /// Errors: no space was freed in time, or an error other than a lack of space.
    pub fn make_space(
        &mut self,
        trainer: &mut Trainer,
        metrics: &mut MetricsLog,
        stop: &StopFlag,
        why: TrainError,
    ) -> Result<(), TrainError> {
        if !why.is_out_of_space() {
            return Err(why);
        }
        if self.is_optional {
            // All pages are in memory: abandon the commit in progress; the step needs no write.
            self.beside = None;
            trainer.scene.pager.abort_cut();
            if self.goes_without {
                self.miss();
                return Ok(());
            }
        }
        let is_own = self.other_drive(&why).is_none();
        let now = (trainer.steps_done(), is_own, Instant::now());
        // A second failure at the same step: commits cannot free enough.
        let is_stuck = self.space_made.is_some_and(|(step, own, _)| (step, own) == (now.0, is_own));
        let mut lacks = why;
        if !is_stuck {
            self.space_made = Some(now);
        }
        // Commits and reserve free space only on the store's drive, and a first commit frees none.
        if !is_stuck && is_own && !self.is_only_of_results(&lacks) {
            match self.commit_with_reserve(trainer, metrics) {
                Ok(()) => return Ok(()),
                Err(error) if error.is_out_of_space() => lacks = error,
                Err(error) => return Err(error),
            }
        }
        let began = self.space_made.unwrap_or(now).2;
        self.wait_for_space(trainer, metrics, stop, lacks, began, is_stuck)
    }

    /// Commits twice, because a commit keeps the slots of the previous one; releases the reserve if needed.
    fn commit_with_reserve(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        let mut result = self.commit(trainer, metrics);
        let is_full = result.as_ref().is_err_and(|e| e.is_out_of_space() && self.other_drive(e).is_none());
        let commits = self.commits.as_mut().filter(|_| is_full);
        if commits.map_or(Ok(false), Commits::give_up_reserve)? {
            crate::tell!("warning: the drive of {} is full: the reserve is used up", self.folder.display());
            result = self.commit(trainer, metrics);
        }
        result?;
        self.commit(trainer, metrics)
    }

    fn wait_for_space(
        &mut self,
        trainer: &mut Trainer,
        metrics: &mut MetricsLog,
        stop: &StopFlag,
        lacks: TrainError,
        began: Instant,
        is_told: bool,
    ) -> Result<(), TrainError> {
        let other = self.other_drive(&lacks);
        let is_of_results = self.is_only_of_results(&lacks);
        let needed = match other.is_some() || is_of_results {
            true => OTHER_BYTES,
            false => {
                // The first commit of a run in memory stores all pages.
                let pager = &trainer.scene.pager;
                let all = (pager.index().len() * pager.frame_bytes()) as u64;
                // A commit doubles the page map at most.
                let map_bytes = std::fs::metadata(self.folder.join(MAP_NAME)).map_or(0, |map| map.len());
                pager.slot_space().map_or(all, |space| space.segment_bytes) + map_bytes
            }
        };
        // The folder of a first commit that failed is gone.
        let full = drive_of(other.as_deref().unwrap_or(&self.folder));
        let free = free_bytes(&full).ok().flatten();
        let free_then = free.map_or(String::from("unknown"), format_bytes);
        let until = self.full_wait.as_secs_f64();
        let (needed_text, folder) = (format_bytes(needed), full.display().to_string());
        if !is_told && stop.exit_code().is_none() {
            crate::tell!(
                "paused: {lacks}\n  {folder} needs {needed_text} more and has {free_then} free. Training waits up to \
                 {until:.0} s (--disk-full-wait) for space, then continues; Ctrl-C stops it"
            );
        }
        while began.elapsed() < self.full_wait && stop.exit_code().is_none() {
            std::thread::sleep(POLL.min(self.full_wait / 20));
            let free_now = free_bytes(&full).ok().flatten();
            // More free space below the size of a segment does not help.
            if free_now.zip(free).is_some_and(|(now, then)| now < needed && now <= then) {
                continue;
            }
            let done = match is_of_results {
                true => metrics.sync().map(drop).map_err(TrainError::from),
                false => self.commit(trainer, metrics),
            };
            match done {
                Ok(()) => {
                    if !is_told {
                        crate::tell!(
                            "there is space again after {:.0} s: training goes on",
                            began.elapsed().as_secs_f64()
                        );
                    }
                    self.fill_reserve()?;
                    return Ok(());
                }
                Err(error) if error.is_out_of_space() => {}
                Err(error) => return Err(error),
            }
        }
        let room = trainer.scene.rows() * row_bytes(trainer.scene.rules.sh_degree) as u64 / 100 * RESULTS_PERCENT;
        let has_room = || free_bytes(&full).ok().flatten().is_none_or(|free| free >= room);
        match stop.exit_code() {
            Some(_) => Ok(()),
            None if self.is_optional && has_room() => {
                crate::tell!(
                    "warning: training goes on in memory without commits: if it ends now, the steps since {} are lost. There is \
                     room for the results, and commits begin again once there is room for them",
                    self.last_step.map_or("its beginning".to_string(), |step| format!("the commit after step {step}"))
                );
                self.goes_without = true;
                self.miss();
                Ok(())
            }
            None => Err(TrainError::DriveFull {
                folder,
                needed: needed_text,
                last_step: self.last_step,
                elsewhere: String::new(),
            }),
        }
    }

    /// Whether a file of the results found no space and needs no commit: all pages of the run are in memory.
    fn is_only_of_results(&self, error: &TrainError) -> bool {
        let TrainError::Input(error) = error else { return false };
        self.is_optional && !error.file.starts_with(&self.folder)
    }

    /// The folder of the file that found no space, if it lies on another drive than the store.
    fn other_drive(&self, error: &TrainError) -> Option<PathBuf> {
        let TrainError::Input(error) = error else { return None };
        let folder = error.file.parent().filter(|folder| folder.is_dir())?;
        (!is_same_drive(folder, &self.folder)).then(|| folder.to_path_buf())
    }
}

/// The result of a commit after the last step, for which a lack of space is only a warning.
/// Errors: that of the commit, except for space.
pub(crate) fn warn_of_space(committed: Result<(), TrainError>) -> Result<(), TrainError> {
    match committed {
        Err(error) if error.is_out_of_space() => {
            crate::tell!("warning: the last steps are not committed: {error}");
            Ok(())
        }
        committed => committed,
    }
}

/// Whether few slots are free and a commit would free enough.
fn should_commit_for_slots(space: &SlotSpace) -> bool {
    let SlotSpace { total, free, retired, .. } = *space;
    free * FEW_FREE < total && retired * WORTH_FREEING >= total
}

/// The error of a state that cannot be encoded.
fn invalid(why: impl std::fmt::Display) -> CommitError {
    CommitError::Contradiction(why.to_string())
}

fn bytes_of(state: &RunState) -> Result<Vec<u8>, CommitError> {
    state.to_bytes().map_err(invalid)
}

/// The run state between two steps, without the pages.
/// Errors: a value cannot be encoded; none of a valid state.
fn run_state(trainer: &Trainer, origin: &Origin, metrics_bytes: u64) -> Result<RunState, CommitError> {
    let scene = &trainer.scene;
    Ok(RunState {
        origin: origin.clone(),
        device: trainer.renderer.device(),
        trainer: trainer.state.clone(),
        photos: photos::save(&trainer.photos).map_err(invalid)?,
        events: scene.events().events().to_vec(),
        histogram: scene.histogram.filled(),
        rows: scene.rows(),
        rows_bound: scene.rows_bound(),
        metrics_bytes,
        traffic: scene.pager.stats(),
    })
}

/// Restores the trainer's own state and the traffic counters from a run state; the pages must come from the same
/// commit. The values of photos follow these to their places in the `dataset` of now; photos that are new begin as at a start.
/// Errors: no run can have written the values of photos; those of a decoded state are checked.
pub fn restore(trainer: &mut Trainer, state: &RunState, dataset: &DatasetPrint) -> Result<(), CommitError> {
    let past = dataset.past_views(&state.origin.dataset);
    photos::restore(&mut trainer.photos, &state.photos, &past).map_err(invalid)?;
    trainer.state = state.trainer.clone();
    trainer.scene.pager.restore_stats(state.traffic);
    Ok(())
}

/// Memory for the cache of the page map, bytes.
pub(crate) const MAP_CACHE_BYTES: usize = 8 << 20;

/// Settings of the checkpoint to create.
#[derive(Debug, Clone)]
pub(crate) struct FirstCommit {
    /// `checkpoint/` in the output folder of the run.
    pub folder: PathBuf,
    pub io: IoEngine,
    pub codec: Codec,
    /// Bytes of a full page.
    pub capacity_bytes: usize,
}

impl FirstCommit {
    /// Creates the store and attaches it to the pager.
    pub fn make(&self, pager: &mut Pager) -> Result<(SpillDir, Commits), TrainError> {
        let layout = SlotLayout::new(self.capacity_bytes, pager.index().len() as u64);
        // An earlier process killed during its first commit leaves a store without commits.
        remove_uncommitted(&self.folder)?;
        // Allow a network file system: the user chose it for the results.
        let spill = SpillDir::create(&self.folder, layout, true)?;
        match self.make_in(&spill, layout) {
            Ok((commits, store)) => {
                pager.attach(store);
                Ok((spill, commits))
            }
            Err(error) => {
                spill.remove()?;
                Err(error)
            }
        }
    }

    fn make_in(&self, spill: &SpillDir, layout: SlotLayout) -> Result<(Commits, PagedStore), TrainError> {
        let engine = open_engine(self.io, &self.folder, DEPTH)?.store;
        let config = CommitConfig { store: spill.format().store, cache_bytes: MAP_CACHE_BYTES, reserve_bytes: 0 };
        let opened = Opened::create(Box::new(DriveFolder::new(&self.folder)), config)?;
        let store = opened.paged_store(engine, layout, self.codec)?;
        Ok((opened.commits, store))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_commit_before_its_time_must_be_needed_and_of_use() {
        let space = |total, free, retired| SlotSpace { total, free, retired, segment_bytes: 1 };
        assert!(should_commit_for_slots(&space(100, 9, 5)) && should_commit_for_slots(&space(100, 0, 100)));
        assert!(!should_commit_for_slots(&space(100, 10, 50)), "there are slots");
        assert!(!should_commit_for_slots(&space(100, 0, 4)), "it would make hardly any free");
        assert!(!should_commit_for_slots(&space(0, 0, 0)), "there are none yet");
    }
}
