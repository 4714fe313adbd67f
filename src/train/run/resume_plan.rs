//! The text that a dry run of `--resume` prints: what the resume would do.
//!
//! Not here: resuming ([`super::resume`]), which makes the same checks.
//!
//! Invariant: no file is changed, even while another process trains the run.

use super::beginning::settings_of_mark;
use super::more_steps::text_of_rates;
use super::out_folder::{self, check_restart};
use super::resume::{Earlier, ResumeRequest, goal, read_summary, result_to_continue, stored_folder};
use crate::base::units::{format_grouped, format_seconds};
use crate::checkpoint::run_state::RunState;
use crate::config::file::TrainConfig;
use crate::page::folder::spill_dir::SpillDir;
use crate::report::run_files::{METRICS_FILE, PLY_FILE};
use crate::train::error::TrainError;
use crate::train::inputs::machine;
use crate::train::log::report::StepLine;
use crate::train::stores::ownership::read_own;
use std::path::Path;

/// Says what a resume with this request would do.
/// Errors: those of the resume before its first step, but for memory and drives.
pub fn describe_resume(request: &ResumeRequest) -> Result<String, TrainError> {
    out_folder::refuse_in_use(&request.out)?;
    let out = request.out.display();
    if settings_of_mark(&request.out, &request.keys, request.scene.as_deref())?.is_some() {
        return Ok(format!("resume  {out} was cut off before its first step: it begins again"));
    }
    let earlier = Earlier::find(request)?;
    let mut config = earlier.config.clone();
    request.keys.clone().apply(&mut config);
    config.check()?;
    machine::set_up(&config)?;
    let folder = stored_folder(&request.out, &config);
    let state = match SpillDir::exists_in(&folder) {
        true => read_own(&folder, earlier.claim(request))?,
        false => None,
    };
    if let Some(summary) = read_summary(&request.out).filter(|s| s.finished && s.steps >= config.steps)
        && state.as_ref().is_none_or(|state| state.trainer.step >= config.steps)
    {
        let steps = format_grouped(summary.steps.into());
        return Ok(format!("resume  {out} is finished: all {steps} steps, with results; --steps N continues it"));
    }
    if let Some(summary) = result_to_continue(request, &earlier, &config, &folder) {
        let from = format!("{} Gaussians of {PLY_FILE}", format_grouped(summary.gaussians));
        return Ok(steps_to_do(&request.out, &from, summary.steps, &config));
    }
    match state {
        Some(state) => committed(request, &earlier, config, &state),
        None => {
            check_restart(&request.out)?;
            Ok(format!("resume  {out} was cut off before its first commit: it begins again"))
        }
    }
}

/// What a resume from a commit would do.
fn committed(
    request: &ResumeRequest,
    earlier: &Earlier,
    mut config: TrainConfig,
    state: &RunState,
) -> Result<String, TrainError> {
    let changes = goal(request, earlier, &mut config, state)?.changes;
    let from = format!("the last commit, {} Gaussians", format_grouped(state.rows));
    let mut text = steps_to_do(&request.out, &from, state.trainer.step, &config);
    for change in changes.free.iter().chain(&changes.numbers) {
        text.push_str(&format!("\nchange  {change}"));
    }
    Ok(text)
}

fn steps_to_do(out: &Path, from: &str, done: u32, config: &TrainConfig) -> String {
    let left = config.steps.saturating_sub(done);
    let [done, all, more] = [done, config.steps, left].map(|steps| format_grouped(steps.into()));
    let time = match seconds_of_a_step(out) {
        Some(seconds) => {
            format!(" and about {} at the pace of its last steps", format_seconds(seconds * f64::from(left)))
        }
        None => String::new(),
    };
    let rates = text_of_rates(config).map_or(String::new(), |rates| format!("\n{rates}"));
    format!(
        "resume  {} after {done} of {all} steps, from {from}\ntime    {more} steps to do{time}{rates}",
        out.display()
    )
}

/// Seconds of a step by the metrics of the second half of the run.
fn seconds_of_a_step(out: &Path) -> Option<f64> {
    let text = std::fs::read_to_string(out.join(METRICS_FILE)).ok()?;
    let lines: Vec<StepLine> = text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let last = lines.last().filter(|last| last.step > 0)?;
    let half = lines.iter().rfind(|line| line.step <= last.step / 2);
    let (steps, seconds) = half.map_or((0, 0.0), |line| (line.step, line.seconds));
    Some((last.seconds - seconds).max(0.0) / f64::from(last.step - steps))
}
