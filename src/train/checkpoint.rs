//! The commits of a run: when they are made, and what they hold of it.
//!
//! A commit that time asks for is made beside training: a cut between two steps, its pages written during the steps that
//! follow ([`crate::paging`]), then the transaction. One that must be there before anything else happens (a stop, the
//! end, a drive without space) is made at once.
//!
//! Invariants: 1. commits happen between steps and change nothing of the run; 2. what is committed is all that later
//! steps depend on: a run that goes on from it ends with the same bytes; 3. clocks decide when a commit is made, and
//! nothing else; 4. a run in memory makes its checkpoint when it first commits, so a short one writes none; a full drive
//! costs such a run its commits, and nothing else.

use super::error::TrainError;
use super::first_commit::FirstCommit;
use super::report::MetricsLog;
use super::trainer::Trainer;
use crate::checkpoint::interval::{CommitCost, CommitInterval, CommitReport};
use crate::checkpoint::run_state::{DatasetPrint, RunIdentity, RunState};
use crate::config::file::TrainConfig;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::map::commit::{CommitError, Commits};
use crate::paging::stats::SlotSpace;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A commit is made at once where its pages are not written after this time beside training.
const BESIDE_SECONDS: f64 = 20.0;
/// Least time from a commit to one before its time.
const EARLY_SECONDS: f64 = 10.0;
/// Fewer free slots than one in so many are few.
const FEW_FREE: u64 = 10;
/// A commit before its time must make at least one slot in so many free.
const WORTH_FREEING: u64 = 20;

/// The commits of a run.
#[derive(Debug)]
pub struct Checkpoint {
    /// `None` before the first commit of a run in memory.
    pub(super) commits: Option<Commits>,
    /// How that one makes them.
    first: Option<FirstCommit>,
    /// What it made them in.
    spill: Option<SpillDir>,
    /// The next commit is kept under this name.
    name: Option<String>,
    pub(super) folder: PathBuf,
    /// The run can go on without: all of it is in memory.
    pub(super) is_optional: bool,
    /// A commit found no space, and the user knows.
    said_full: bool,
    /// How long to wait for space.
    pub(super) full_wait: Duration,
    /// Step at which space was last made, and when; a second time at the same step it must come from elsewhere.
    pub(super) space_made: Option<(u32, bool, Instant)>,
    interval: CommitInterval,
    started: Instant,
    /// When the last commit was durable, and its cut.
    last: Instant,
    last_cut: Instant,
    beside: Option<Beside>,
    /// What does not change: see [`Checkpoint::set_origin`].
    origin: Option<Origin>,
    done: u64,
    /// Step of the last commit.
    last_step: Option<u32>,
}

/// A commit that is made beside training.
#[derive(Debug)]
struct Beside {
    run_state: Vec<u8>,
    step: u32,
    cut: Instant,
    waited: Duration,
    /// The pager's seconds for it, before it.
    pager_seconds: f64,
}

/// What a run was started with, as its run state has it.
#[derive(Debug, Clone, PartialEq)]
pub struct Origin {
    /// The config, every key, as TOML.
    pub config: String,
    /// Instruction path that was resolved.
    pub simd: String,
    /// Degree in use from the first step.
    pub sh_degree_start: u8,
    /// The dataset.
    pub dataset: DatasetPrint,
    /// The run that commits.
    pub run: RunIdentity,
}

impl Checkpoint {
    /// Commits to the store in `folder` as often as the config says, the first one after that time.
    pub fn new(commits: Commits, folder: &Path, config: &TrainConfig) -> Checkpoint {
        Checkpoint { commits: Some(commits), ..Checkpoint::without(folder, config) }
    }

    /// Of a run in memory: the first commit makes a checkpoint as `first` says.
    pub(super) fn later(first: FirstCommit, config: &TrainConfig) -> Checkpoint {
        let folder = first.folder().to_path_buf();
        Checkpoint { first: Some(first), is_optional: true, ..Checkpoint::without(&folder, config) }
    }

    fn without(folder: &Path, config: &TrainConfig) -> Checkpoint {
        let now = Instant::now();
        Checkpoint {
            commits: None,
            first: None,
            spill: None,
            name: None,
            folder: folder.to_path_buf(),
            is_optional: false,
            said_full: false,
            full_wait: Duration::try_from_secs_f64(config.disk_full_wait).unwrap_or_default(),
            space_made: None,
            interval: CommitInterval::new(config.commit_every),
            started: now,
            last: now,
            last_cut: now,
            beside: None,
            origin: None,
            done: 0,
            last_step: None,
        }
    }

    /// What the run was started with; before the first commit.
    pub fn set_origin(&mut self, origin: Origin) {
        self.origin = Some(origin);
        (self.started, self.last, self.last_cut) = (Instant::now(), Instant::now(), Instant::now());
    }

    /// A full drive costs the run its commits and nothing else: all of it is in memory.
    pub fn set_optional(&mut self, is_optional: bool) {
        self.is_optional = is_optional;
    }

    /// Where it is, or will be.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The next commit is kept under `name`, whatever is committed later.
    pub fn keep_next_as(&mut self, name: String) {
        self.name = Some(name);
    }

    /// Whether a commit after the last step is worth its writes: one of a run in memory that never committed would write
    /// everything for a checkpoint that is removed at once.
    pub fn wants_last(&self) -> bool {
        self.commits.is_some()
    }

    /// Gives up the folder that the first commit of a run in memory made, if it did; nothing is committed any more.
    pub fn into_folder(self) -> Option<SpillDir> {
        self.spill
    }

    /// Whether something was committed since the store was opened.
    pub fn has_commit(&self) -> bool {
        self.done > 0
    }

    /// Commits since the store was opened.
    pub(super) fn commits_done(&self) -> u64 {
        self.done
    }

    /// The folder that the first commit of a run in memory made.
    pub(super) fn spill(&self) -> Option<&SpillDir> {
        self.spill.as_ref()
    }

    /// Step of the last commit since the store was opened.
    pub fn last_step(&self) -> Option<u32> {
        self.last_step
    }

    /// What commits have cost so far.
    pub fn report(&self) -> CommitReport {
        self.interval.report(self.started.elapsed().as_secs_f64())
    }

    /// Between two steps: begins a commit if one is due, and ends one whose pages are written.
    ///
    /// # Errors
    /// As [`Checkpoint::commit`].
    pub fn between_steps(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        if !trainer.scene.pager.is_frozen() {
            // A failed write gave it up; the next step gets the error.
            self.beside = None;
        }
        let result = match &self.beside {
            // What is named after a step holds that step.
            _ if self.name.is_some() => self.commit(trainer, metrics),
            None if self.is_time() && self.first.is_some() => self.commit(trainer, metrics),
            None if self.is_time() && self.commits.is_some() => self.begin(trainer, metrics),
            None if self.may_be_early() && self.space_is_short(trainer) => self.commit(trainer, metrics),
            Some(beside) if trainer.scene.pager.is_frozen_written() || is_late(beside) => self.finish(trainer),
            _ => Ok(()),
        };
        self.excused(result)
    }

    /// Whether a commit may be made for the slots that it makes free. What only names keep stays taken, so that it is not
    /// asked at every step.
    fn may_be_early(&self) -> bool {
        !self.is_optional && self.last.elapsed().as_secs_f64() >= EARLY_SECONDS
    }

    fn is_time(&self) -> bool {
        self.interval.is_due(self.last.elapsed().as_secs_f64())
    }

    /// A run in memory goes on where only space is missing, and tries again after as long as from commit to commit.
    fn excused(&mut self, result: Result<(), TrainError>) -> Result<(), TrainError> {
        match result {
            Err(error) if self.is_optional && error.is_out_of_space() => {
                if !std::mem::replace(&mut self.said_full, true) {
                    eprintln!("warning: nothing can be committed: {error}");
                }
                // The next one would hold another step.
                if let Some(name) = self.name.take() {
                    eprintln!("warning: {name} is not kept");
                }
                self.last = Instant::now();
                Ok(())
            }
            done => done,
        }
    }

    /// Gives up the commit that `why`, a lack of space, stands in the way of; the run goes on without.
    pub(super) fn give_up(&mut self, trainer: &mut Trainer, why: TrainError) -> Result<(), TrainError> {
        self.beside = None;
        trainer.scene.pager.thaw();
        self.excused(Err(why))
    }

    /// The checkpoint of a run in memory, at its first commit. The run itself is none the worse without one.
    /// Where only space is missing it is tried again at the next commit.
    fn make_first(&mut self, trainer: &mut Trainer) -> Result<(), TrainError> {
        let Some(first) = &self.first else { return Ok(()) };
        match first.make(&mut trainer.scene.pager) {
            Ok((spill, commits)) => (self.spill, self.commits) = (Some(spill), Some(commits)),
            Err(error) if error.is_out_of_space() => return Err(error),
            Err(error) => eprintln!("warning: this run is not committed, so it cannot be resumed: {error}"),
        }
        self.first = None;
        Ok(())
    }

    fn begin(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        let Some(origin) = &self.origin else { return Ok(()) };
        let cut = Instant::now();
        let pager_seconds = trainer.scene.pager.commit_seconds();
        let state = trainer.run_state(origin, metrics.sync()?);
        let run_state = bytes_of(&state)?;
        trainer.scene.pager.freeze()?;
        self.beside = Some(Beside { run_state, step: state.step, cut, waited: cut.elapsed(), pager_seconds });
        // In memory, or with nothing to write, there is nothing to wait for.
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

    /// Commits the run as it is now, at once. A commit beside training that has not ended is given up for it.
    ///
    /// # Errors
    /// Nothing was committed; what was committed before still is.
    pub fn commit(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        if self.origin.is_none() {
            return Ok(());
        }
        let cut = Instant::now();
        self.beside = None;
        self.make_first(trainer)?;
        let name = self.name.clone();
        let Some(origin) = &self.origin else { return Ok(()) };
        let Some(commits) = &mut self.commits else { return Ok(()) };
        let written = trainer.scene.pager.stats().bytes_written;
        trainer.scene.pager.flush()?;
        let state = trainer.run_state(origin, metrics.sync()?);
        let note = format!("step {}", state.step);
        trainer.scene.pager.commit(commits, &bytes_of(&state)?, note.as_bytes(), name.as_deref())?;
        self.name = None;
        let bytes = trainer.scene.pager.stats().bytes_written - written;
        self.acknowledged(state.step, cut, cut.elapsed().as_secs_f64(), bytes);
        Ok(())
    }

    /// As [`Checkpoint::commit`]; where only space is missing, says so.
    ///
    /// # Errors
    /// As [`Checkpoint::commit`], but for space.
    pub fn commit_or_warn(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        match self.commit(trainer, metrics) {
            Err(error) if error.is_out_of_space() => {
                eprintln!("warning: the last steps are not committed: {error}");
                Ok(())
            }
            done => done,
        }
    }

    fn acknowledged(&mut self, step: u32, cut: Instant, waited: f64, bytes: u64) {
        self.done += 1;
        self.last_step = Some(step);
        let until_durable = cut.elapsed().as_secs_f64();
        let at_risk = self.last_cut.elapsed().as_secs_f64();
        self.interval.add(CommitCost { waited, until_durable, bytes, at_risk });
        (self.last, self.last_cut) = (Instant::now(), cut);
    }

    /// Whether a commit is needed for its space alone.
    fn space_is_short(&self, trainer: &Trainer) -> bool {
        let Some(space) = trainer.scene.pager.slot_space().filter(is_worth_a_commit) else { return false };
        let left = crate::page::folder::file_system::free_bytes(&self.folder).ok().flatten();
        left.is_some_and(|left| left < space.segment_bytes)
    }
}

/// Whether few slots are free, and a commit would make some free.
fn is_worth_a_commit(space: &SlotSpace) -> bool {
    let SlotSpace { total, free, retired, .. } = *space;
    free * FEW_FREE < total && retired * WORTH_FREEING >= total
}

fn is_late(beside: &Beside) -> bool {
    beside.cut.elapsed().as_secs_f64() >= BESIDE_SECONDS
}

fn bytes_of(state: &RunState) -> Result<Vec<u8>, CommitError> {
    state.to_bytes().map_err(|e| CommitError::Contradiction(e.to_string()))
}

impl Trainer {
    /// The run between two steps, beside its pages.
    pub fn run_state(&self, origin: &Origin, metrics_bytes: u64) -> RunState {
        let Origin { config, simd, sh_degree_start, dataset, run } = origin.clone();
        RunState {
            step: self.step,
            config,
            simd,
            device: self.renderer.device(),
            sh_degree_start,
            dataset,
            events: self.events().events().to_vec(),
            histogram: self.scene.histogram.filled(),
            rows: self.scene.rows(),
            rows_bound: self.scene.rows_bound(),
            rows_skipped: self.rows_skipped,
            steps_skipped: self.steps_skipped,
            steps_skipped_in_a_row: self.steps_skipped_in_a_row,
            train_seconds: self.train_seconds,
            metrics_bytes,
            test: self.last_test,
            traffic: self.scene.pager.stats(),
            run,
        }
    }

    /// Goes on where a run stopped; the pages are those of the same commit.
    pub fn restore_counts(&mut self, state: &RunState) {
        self.step = state.step;
        self.rows_skipped = state.rows_skipped;
        self.steps_skipped = state.steps_skipped;
        self.steps_skipped_in_a_row = state.steps_skipped_in_a_row;
        self.train_seconds = state.train_seconds;
        self.last_test = state.test;
        self.scene.pager.restore_stats(state.traffic);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_commit_before_its_time_must_be_needed_and_of_use() {
        let space = |total, free, retired| SlotSpace { total, free, retired, segment_bytes: 1 };
        assert!(is_worth_a_commit(&space(100, 9, 5)) && is_worth_a_commit(&space(100, 0, 100)));
        assert!(!is_worth_a_commit(&space(100, 10, 50)), "there are slots");
        assert!(!is_worth_a_commit(&space(100, 0, 4)), "it would make hardly any free");
        assert!(!is_worth_a_commit(&space(0, 0, 0)), "there are none yet");
    }
}
