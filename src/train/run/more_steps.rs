//! More steps for a finished run whose checkpoint is gone: the run goes on from its PLY.
//!
//! Kept: the Gaussians, the number of steps, and with it the schedule, the metrics and the identity of the run. Lost with the
//! checkpoint: Adam's moments and the statistics of densification. Adam's first updates without moments are up to three
//! times as long as others, so quality dips for some hundred steps; the result is not that of a run planned with
//! more steps. `--keep-checkpoint` loses nothing ([`super::resume`]): the steps are those that the run would have done next. With and
//! without it, the rates stay at the values with which the schedule ended.
//!
//! Invariants: 1. the earlier result stays under the name of its step, and also as the result until the new one replaces it; 2. no file
//! is renamed before the scene was found; 3. a run that is cut off before its first commit goes on from the same PLY at the next resume.

use super::begin::{FirstTrainer, first_trainer, plan_and_train};
use super::changes::with_absolute_paths;
use super::request::{RunOutcome, RunRequest};
use super::run_folder::{Begun, PastRun};
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::units::format_grouped;
use crate::base::whole_file::sync_folder;
use crate::config::file::{Resolved, TrainConfig};
use crate::config::limits::schedule_steps;
use crate::report::run_files::{METRICS_FILE, PLY_FILE, saved_ply_name};
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

/// Trains the finished run in the output folder of `request` from the PLY of its `summary` to the steps of the config. `file` is the content of
/// its config.toml.
/// Errors: the scene or the PLY is not there (nothing is changed then); else as [`super::begin::run`].
pub(super) fn train_more_steps(
    mut request: RunRequest,
    file: Option<(TrainConfig, Resolved)>,
    run: RunId,
    summary: &Summary,
) -> Result<RunOutcome, TrainError> {
    let (scene, out) = (request.scene.clone(), request.out.clone());
    machine::set_up(&request.config)?;
    if !scene.exists() {
        let remedy =
            format!("if it was moved: gsscale-train --resume {} SCENE --steps N", crate::base::say::shell_word(&out));
        return Err(InputError::new(scene, "the scene of this run is missing", remedy).into());
    }
    let kept = keep_result(&out, summary.steps)?;
    crate::tell!(
        "warning: the checkpoint of {} is gone, so the run goes on from its Gaussians, kept as {}; Adam's moments are \
         lost, and quality dips for some hundred steps (--keep-checkpoint keeps them)",
        out.display(),
        kept.display()
    );
    if let Some(rates) = text_of_rates(&request.config) {
        crate::tell!("{rates}");
    }
    request.config.init_ply = absolute(&kept).to_string_lossy().into_owned();
    let host_mem = host_budget(request.config.host_mem.0);
    let start = Start::read(&scene, &request.config, host_mem)?;
    let past = PastRun {
        config: with_absolute_paths(request.config.clone()),
        metrics_bytes: metrics_until(&out, summary.steps),
        step: summary.steps,
        has_changed: false,
        file,
        first_rows: start.rows,
    };
    let FirstTrainer { dataset, mut trainer, tiers, begun } = first_trainer(&request, start, host_mem)?;
    trainer.begin_after(summary.steps, summary.train_seconds);
    plan_and_train(&request, &dataset, tiers, trainer, Begun { past: Some(past), run, ..begun })
}

/// Bytes of the run's metrics up to its result at `step`: an attempt that was cut off before its first commit left more.
fn metrics_until(out: &Path, step: u32) -> u64 {
    let metrics = std::fs::read_to_string(out.join(METRICS_FILE)).unwrap_or_default();
    let step_of = |line: &str| serde_json::from_str::<serde_json::Value>(line).ok()?["step"].as_u64();
    let is_past = |line: &&str| step_of(line).is_some_and(|at| at <= u64::from(step));
    metrics.split_inclusive('\n').take_while(is_past).map(|line| line.len() as u64).sum()
}

/// Gives the result of `step` in `out` a second name, that of its step; returns that path. The first name stays, where viewers look for
/// it, until the new result replaces it as a whole.
fn keep_result(out: &Path, step: u32) -> InputResult<PathBuf> {
    let (result, kept) = (out.join(PLY_FILE), out.join(saved_ply_name(step)));
    if is_same(&result, &kept) {
        // An earlier attempt was cut off before its first commit.
        return Ok(kept);
    }
    let doing = "keeping the result under the name of its step";
    let failed = |error: std::io::Error| InputError::io(&result, doing, &error);
    let beside = out.join(format!(".{}.part", saved_ply_name(step)));
    let _ = std::fs::remove_file(&beside);
    // A second name costs no space; some file systems have none.
    if std::fs::hard_link(&result, &beside).is_err()
        && let Err(error) = std::fs::copy(&result, &beside)
    {
        let _ = std::fs::remove_file(&beside);
        return Err(failed(error));
    }
    std::fs::rename(&beside, &kept).map_err(failed)?;
    // Where folders cannot be synced, the name is durable with the next sync of a file.
    let _ = sync_folder(out);
    Ok(kept)
}

/// Whether both paths name one file.
#[cfg(unix)]
fn is_same(a: &Path, b: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let of = |path: &Path| std::fs::metadata(path).ok().map(|about| (about.dev(), about.ino()));
    of(a).is_some() && of(a) == of(b)
}

#[cfg(not(unix))]
fn is_same(_a: &Path, _b: &Path) -> bool {
    false
}
