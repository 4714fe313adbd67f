//! When a run is committed, and what a commit holds of it.
//!
//! Invariants: 1. commits happen between steps and change nothing of the run; 2. what is committed is all that later
//! steps depend on: a run that goes on from it ends with the same bytes; 3. a full drive ends no run at a commit that
//! only time asked for.

use super::report::MetricsLog;
use super::trainer::{TrainError, Trainer};
use crate::base::error::InputError;
use crate::checkpoint::run_state::{DatasetPrint, RunState};
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::dataset::model::Split;
use crate::page::commit::{CommitError, Commits};
use crate::page::format::checksum;
use std::time::{Duration, Instant};

/// The commits of a run.
#[derive(Debug)]
pub struct Checkpoint {
    commits: Commits,
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
        let every =
            (config.commit_every > 0.0).then(|| Duration::try_from_secs_f64(config.commit_every).ok()).flatten();
        Checkpoint { commits, every, last: Instant::now(), origin: None, done: 0, said_full: false }
    }

    /// What the run was started with; before the first commit.
    pub fn set_origin(&mut self, origin: Origin) {
        self.origin = Some(origin);
        self.last = Instant::now();
    }

    /// Whether the time from one commit to the next is over.
    pub fn is_due(&self) -> bool {
        self.every.is_some_and(|every| self.last.elapsed() >= every)
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
        trainer.scene.pager.flush()?;
        let state = trainer.run_state(origin, metrics.sync()?);
        let bytes = state.to_bytes().map_err(|e| CommitError::Contradiction(e.to_string()))?;
        let note = format!("step {}", state.step);
        trainer.scene.pager.commit(&mut self.commits, &bytes, note.as_bytes())?;
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
        }
    }

    /// Goes on where a run stopped; the pages are those of the same commit.
    pub fn restore_counts(&mut self, state: &RunState) {
        self.step = state.step;
        self.rows_skipped = state.rows_skipped;
        self.steps_skipped = state.steps_skipped;
        self.steps_skipped_in_a_row = state.steps_skipped_in_a_row;
        self.train_seconds = state.train_seconds;
    }
}

/// What training depends on of a dataset, as far as it is cheap to know: photos are not read.
pub fn dataset_print(dataset: &Dataset, first_rows: u64) -> DatasetPrint {
    let views = dataset.views.iter().map(|view| {
        let camera = &view.camera;
        let mut bytes = view.name.as_bytes().to_vec();
        bytes.push(u8::from(view.split == Split::Train));
        let floats = [camera.fx, camera.fy, camera.cx, camera.cy, camera.near_plane, camera.far_plane];
        for float in camera.viewmat.iter().flatten().chain(&floats) {
            bytes.extend(float.to_bits().to_le_bytes());
        }
        bytes.extend([camera.width, camera.height].iter().flat_map(|n| n.to_le_bytes()));
        checksum(&bytes) as u64
    });
    let (origin, scale) = (dataset.frame.origin.to_array(), dataset.frame.scale);
    DatasetPrint { views: views.collect(), first_rows, scene_scale: dataset.scene_scale, origin, scale }
}

/// Refuses a dataset that is not the one of the run, and says where it differs first.
///
/// # Errors
/// It differs.
pub fn check_dataset(dataset: &Dataset, there: &DatasetPrint, here: &DatasetPrint) -> Result<(), InputError> {
    let refuse = |problem: String| {
        let remedy = "bring the dataset back as it was, or start a new run with another --out";
        Err(InputError::new(
            &dataset.image_folder,
            format!("the dataset changed since the run began: {problem}"),
            remedy,
        ))
    };
    if there.views.len() != here.views.len() {
        return refuse(format!("it had {} views and has {}", there.views.len(), here.views.len()));
    }
    if let Some(view) = (0..here.views.len()).find(|&v| here.views[v] != there.views[v]) {
        return refuse(format!("view {} ({}) has another name, size or pose", view + 1, dataset.views[view].name));
    }
    if there.first_rows != here.first_rows {
        return refuse(format!("it gave {} first Gaussians and gives {}", there.first_rows, here.first_rows));
    }
    if there.scene_scale.to_bits() != here.scene_scale.to_bits() {
        return refuse(format!("its scale was {} and is {}", there.scene_scale, here.scene_scale));
    }
    if (there.origin, there.scale) != (here.origin, here.scale) {
        return refuse(format!(
            "its frame was {:?} x {} and is {:?} x {}",
            there.origin, there.scale, here.origin, here.scale
        ));
    }
    Ok(())
}
