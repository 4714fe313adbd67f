//! When a run is committed, and what a commit holds of it.
//!
//! Invariants: 1. commits happen between steps and change nothing of the run; 2. what is committed is all that later
//! steps depend on: a run that goes on from it ends with the same bytes; 3. a full drive ends no run at a commit that
//! only time asked for; 4. a run in memory makes its checkpoint when it first commits, so a short one writes none.

use super::first_commit::FirstCommit;
use super::report::MetricsLog;
use super::trainer::{TrainError, Trainer};
use crate::checkpoint::run_state::{DatasetPrint, RunState, TrafficSoFar};
use crate::config::file::TrainConfig;
use crate::page::commit::{CommitError, Commits};
use crate::page::spill_dir::SpillDir;
use crate::paging::stats::PagerStats;
use std::time::{Duration, Instant};

/// The commits of a run.
#[derive(Debug)]
pub struct Checkpoint {
    /// `None` before the first commit of a run in memory.
    commits: Option<Commits>,
    /// How that one makes them.
    first: Option<FirstCommit>,
    /// What it made them in.
    spill: Option<SpillDir>,
    /// The next commit is kept under this name.
    name: Option<String>,
    every: Option<Duration>,
    last: Instant,
    /// What does not change: see [`Checkpoint::set_origin`].
    origin: Option<Origin>,
    done: u64,
    /// A commit found no space, and the user knows.
    said_full: bool,
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
}

impl Checkpoint {
    /// Commits as often as the config says, the first one after that time.
    pub fn new(commits: Commits, config: &TrainConfig) -> Checkpoint {
        Checkpoint { commits: Some(commits), ..Checkpoint::without(config) }
    }

    /// Of a run in memory: the first commit makes a checkpoint as `first` says.
    pub(super) fn later(first: FirstCommit, config: &TrainConfig) -> Checkpoint {
        Checkpoint { first: Some(first), ..Checkpoint::without(config) }
    }

    fn without(config: &TrainConfig) -> Checkpoint {
        let every =
            (config.commit_every > 0.0).then(|| Duration::try_from_secs_f64(config.commit_every).ok()).flatten();
        Checkpoint {
            commits: None,
            first: None,
            spill: None,
            name: None,
            every,
            last: Instant::now(),
            origin: None,
            done: 0,
            said_full: false,
        }
    }

    /// What the run was started with; before the first commit.
    pub fn set_origin(&mut self, origin: Origin) {
        self.origin = Some(origin);
        self.last = Instant::now();
    }

    /// Whether the time from one commit to the next is over, or a name waits for one.
    pub fn is_due(&self) -> bool {
        self.name.is_some() || self.every.is_some_and(|every| self.last.elapsed() >= every)
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

    /// Commits the run as it is now.
    ///
    /// # Errors
    /// Nothing was committed; what was committed before still is.
    pub fn commit(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        let Some(origin) = &self.origin else { return Ok(()) };
        if let Some(first) = self.first.take() {
            match first.make(&mut trainer.scene.pager) {
                Ok((spill, commits)) => (self.spill, self.commits) = (Some(spill), Some(commits)),
                // The run itself is none the worse for it.
                Err(error) => eprintln!("warning: this run is not committed, so it cannot be resumed: {error}"),
            }
        }
        let name = self.name.take();
        let Some(commits) = &mut self.commits else { return Ok(()) };
        trainer.scene.pager.flush()?;
        let state = trainer.run_state(origin, metrics.sync()?);
        let bytes = state.to_bytes().map_err(|e| CommitError::Contradiction(e.to_string()))?;
        let note = format!("step {}", state.step);
        trainer.scene.pager.commit(commits, &bytes, note.as_bytes(), name.as_deref())?;
        self.done += 1;
        self.last = Instant::now();
        Ok(())
    }

    /// As [`Checkpoint::commit`]; where only space is missing, says so and lets the run go on.
    ///
    /// # Errors
    /// As [`Checkpoint::commit`], but for space.
    pub fn commit_if_space(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        let is_space = |error: &TrainError| match error {
            TrainError::Commit(error) => error.is_out_of_space(),
            TrainError::Paging(error) => error.is_out_of_space(),
            _ => false,
        };
        match self.commit(trainer, metrics) {
            Err(error) if is_space(&error) => {
                if !std::mem::replace(&mut self.said_full, true) {
                    eprintln!("warning: nothing can be committed: {error}");
                }
                self.last = Instant::now();
                Ok(())
            }
            done => done,
        }
    }
}

impl Trainer {
    /// The run between two steps, beside its pages.
    pub fn run_state(&self, origin: &Origin, metrics_bytes: u64) -> RunState {
        let Origin { config, simd, sh_degree_start, dataset } = origin.clone();
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
            traffic: traffic_of(&self.scene.pager.stats()),
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
        self.scene.pager.count_on(stats_of(&state.traffic));
    }
}

fn traffic_of(stats: &PagerStats) -> TrafficSoFar {
    TrafficSoFar {
        bytes_read: stats.bytes_read,
        bytes_written: stats.bytes_written,
        pages_read: stats.pages_read,
        pages_written: stats.pages_written,
        pages_needed: stats.pages_needed,
        hits: stats.hits,
        misses: stats.misses,
        late_misses: stats.late_misses,
        evictions: stats.evictions,
        stall_seconds: stats.stall_seconds,
        pinned_max: stats.pinned_max as u64,
    }
}

fn stats_of(traffic: &TrafficSoFar) -> PagerStats {
    PagerStats {
        bytes_read: traffic.bytes_read,
        bytes_written: traffic.bytes_written,
        pages_read: traffic.pages_read,
        pages_written: traffic.pages_written,
        pages_needed: traffic.pages_needed,
        hits: traffic.hits,
        misses: traffic.misses,
        late_misses: traffic.late_misses,
        evictions: traffic.evictions,
        stall_seconds: traffic.stall_seconds,
        pinned_max: traffic.pinned_max as usize,
        ..PagerStats::default()
    }
}
