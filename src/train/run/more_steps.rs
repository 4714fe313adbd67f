//! More steps for a finished run whose checkpoint is gone: the run goes on from its PLY.
//!
//! Kept: the Gaussians, the exposures of photos, the number of steps, and with it the schedule, the metrics and the identity of the run. Lost
//! with the checkpoint: Adam's moments, the statistics of densification, refined poses, and which photos were left out. Adam's first updates
//! without moments are up to three times as long as others, so quality dips for some hundred steps; the result is not that of a run planned with
//! more steps. `--keep-checkpoint` loses nothing ([`super::resume`]): the steps are those that the run would have done next. With and
//! without it, the rates stay at the values with which the schedule ended.
//!
//! Invariants: 1. the earlier result stays under the name of its step, and also as the result until the new one replaces it; 2. no file
//! gets a second name before every check has passed; changes that a resume from a checkpoint refuses are refused, as far as config.toml
//! tells them; 3. a run that is cut off before its first commit goes on from the same PLY at the next resume.

use super::begin::{FirstTrainer, first_trainer, plan_and_train};
use super::changes::{Changes, with_absolute_paths};
use super::request::{RunOutcome, RunRequest};
use super::run_folder::{Begun, PastRun};
use crate::base::error::InputError;
use crate::base::identity::RunId;
use crate::base::say::shell_word;
use crate::base::text::{lines_of, own_json};
use crate::base::units::format_grouped;
use crate::config::file::{Resolved, TrainConfig};
use crate::config::limits::schedule_steps;
use crate::photos::exposure::AppearanceMode;
use crate::photos::outlier::blocks::MASKED_SHARE;
use crate::photos::outlier::views::OUTLIER_VIEWS;
use crate::photos::{exposure, pose};
use crate::report::run_files::{CONFIG_FILE, METRICS_FILE, PLY_FILE, SUMMARY_FILE, saved_ply_name};
use crate::train::error::TrainError;
use crate::train::inputs::machine::{self, absolute};
use crate::train::log::report::Summary;
use crate::train::memory::host_budget;
use crate::train::start::first_scene::Start;
use std::path::{Path, PathBuf};

/// What more steps mean for the rates; `None` if the schedule is as long as the run. A run that goes on keeps its schedule, because
/// rates that rose again would undo what the last steps have settled.
pub(super) fn text_of_rates(config: &TrainConfig) -> Option<String> {
    let end = schedule_steps(config);
    (end < config.steps).then(|| {
        let [end, steps] = [end, config.steps].map(|steps| format_grouped(steps.into()));
        format!(
            "rates   they stay at their final values after step {end}, so the result is not that of a run that has {steps} steps \
             from its start"
        )
    })
}

/// A finished run that is to do more steps.
pub(super) struct FinishedRun {
    /// Content of its config.toml.
    pub file: (TrainConfig, Resolved),
    pub run: RunId,
    pub summary: Summary,
    /// What changed since, of the config; [`FinishedRun::start`] adds the dataset.
    pub changes: Changes,
    pub accepts_changes: bool,
}

impl FinishedRun {
    /// The start of its next steps, from its result. Changes no file.
    /// Errors: the scene or the result is not there, or too much has changed.
    pub fn start(&mut self, request: &RunRequest) -> Result<Start, TrainError> {
        let (scene, out) = (&request.scene, &request.out);
        if !scene.exists() {
            let remedy = format!("if it was moved: gsscale-train --resume {} SCENE --steps N", shell_word(out));
            return Err(InputError::new(scene, "the scene of this run is missing", remedy).into());
        }
        self.changes.check(&out.join(CONFIG_FILE), self.accepts_changes)?;
        let result = if self.is_kept_in(out) { self.kept_path(out) } else { out.join(PLY_FILE) };
        let init_ply = absolute(&result).to_string_lossy().into_owned();
        let config = TrainConfig { init_ply, ..request.config.clone() };
        let start = Start::read(scene, &config, host_budget(config.host_mem.0))?;
        self.changes.add_facts(&self.file.1, &start.dataset);
        self.changes.check(&start.dataset.image_folder, self.accepts_changes)?;
        Ok(start)
    }

    /// Where its result stays.
    fn kept_path(&self, out: &Path) -> PathBuf {
        out.join(saved_ply_name(self.summary.steps))
    }

    /// Whether an earlier attempt has kept the result, and was cut off before its first commit. Its own result may have replaced the
    /// first name already.
    fn is_kept_in(&self, out: &Path) -> bool {
        let kept = self.kept_path(out);
        kept.is_file() && Path::new(&self.file.0.init_ply).file_name() == kept.file_name()
    }
}

/// Trains the finished run in the output folder of `request` from its result to the steps of the config.
/// Errors: as [`FinishedRun::start`]; else as [`super::begin::run`].
pub(super) fn train_more_steps(mut request: RunRequest, mut finished: FinishedRun) -> Result<RunOutcome, TrainError> {
    let out = request.out.clone();
    machine::set_up(&request.config)?;
    if has_masked(&out) {
        request.config.robust_pixels.0.get_or_insert(true);
    }
    let start = finished.start(&request)?;
    let first_rows = start.rows;
    let host_mem = host_budget(request.config.host_mem.0);
    let mut first = request.clone();
    // The first commit will hold the exposures, so the config does not name their file.
    if first.config.appearance.0.is_some_and(AppearanceMode::is_on) && out.join(exposure::FILE).is_file() {
        first.config.first_appearance = out.join(exposure::FILE).to_string_lossy().into_owned();
    }
    let FirstTrainer { dataset, mut trainer, tiers, begun } = first_trainer(&first, start, host_mem)?;
    let kept = finished.kept_path(&out);
    let keep_result_as = (!finished.is_kept_in(&out)).then(|| kept.clone());
    let FinishedRun { file, run, summary, changes, .. } = finished;
    for line in &changes.numbers {
        crate::tell!("warning: accepted from step {} on: {line}", summary.steps);
    }
    let has_vignetting = first.config.appearance.0 == Some(AppearanceMode::Full) && out.join(exposure::FILE).is_file();
    let lost = [
        (out.join(pose::FILE).exists(), "the refined poses"),
        (has_left_out(&out), "which photos were left out"),
        (has_vignetting, "the vignetting of the cameras"),
    ];
    let lost: String = lost.iter().filter(|(is_lost, _)| *is_lost).map(|(_, what)| format!(", {what}")).collect();
    crate::tell!(
        "warning: the checkpoint of {} is gone, so the run goes on from its Gaussians, kept as {}; lost: Adam's moments{lost}; \
         quality dips for some hundred steps (--keep-checkpoint keeps all)",
        out.display(),
        kept.display(),
    );
    if let Some(rates) = text_of_rates(&request.config) {
        crate::tell!("{rates}");
    }
    request.config.init_ply = absolute(&kept).to_string_lossy().into_owned();
    let past = PastRun {
        config: with_absolute_paths(request.config.clone()),
        metrics_bytes: metrics_until(&out, summary.steps),
        step: summary.steps,
        has_changed: false,
        file: Some(file),
        first_rows,
        keep_result_as,
    };
    trainer.begin_after(&summary);
    changes.warn_of_decided_count(&trainer.state.growth);
    plan_and_train(&request, &dataset, tiers, trainer, Begun { past: Some(past), run, ..begun })
}

/// Whether the finished run masked parts of photos. Further steps keep that decision: they begin after the step at which a run decides, when
/// nothing has been measured.
fn has_masked(out: &Path) -> bool {
    figure(out, MASKED_SHARE).is_number()
}

/// Whether the finished run has left photos out.
fn has_left_out(out: &Path) -> bool {
    let is_left_out = |view: &serde_json::Value| view["is_left_out"] == true;
    figure(out, OUTLIER_VIEWS).as_array().is_some_and(|views| views.iter().any(is_left_out))
}

/// A figure of the summary; null if there is none.
fn figure(out: &Path, name: &str) -> serde_json::Value {
    own_json(&out.join(SUMMARY_FILE))
        .map_or(serde_json::Value::Null, |summary: serde_json::Value| summary[name].clone())
}

/// Bytes of the run's metrics up to its result at `step`: an attempt that was cut off before its first commit left more.
fn metrics_until(out: &Path, step: u32) -> u64 {
    let step_of = |line: &[u8]| serde_json::from_slice::<serde_json::Value>(line).ok()?["step"].as_u64();
    let is_past = |line: &Vec<u8>| step_of(line).is_some_and(|at| at <= u64::from(step));
    lines_of(&out.join(METRICS_FILE)).take_while(is_past).map(|line| line.len() as u64).sum()
}
