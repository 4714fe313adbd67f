//! Going on with a run that stopped, or that ended and kept its checkpoint: from its output folder to the end.
//!
//! Invariants: 1. a run that goes on ends with the bytes that it would have had without the stop; 2. keys that change
//! numbers, and the dataset, are those of the run, or it is refused with the difference, unless the user accepts it: then
//! every page is brought to the step of the change as it was trained, once, and goes on from there by the new rules; 3. a
//! refused resume leaves everything as it was.

use super::changes::{Changes, kept_config};
use super::dataset_print::dataset_print;
use super::first_commit::checkpoint_folder;
use super::machine;
use super::memory::host_budget;
use super::pages::PagedScene;
use super::report::{Summary, read_resolved};
use super::run::{Begun, Past, RunOutcome, RunRequest, begin, see_through};
use super::start::Start;
use super::tiers::Stored;
use super::trainer::{TrainError, Trainer};
use crate::base::error::{InputError, InputResult};
use crate::base::simd::SimdPath;
use crate::checkpoint::run_state::{DatasetPrint, RunState, RunStateError};
use crate::config::file::{TrainConfig, TrainOverrides};
use crate::config::limits::{self, RunOptions};
use crate::densify::stats::GradHistogram;
use crate::page::commit::CommitError;
use crate::page::spill_dir::SpillDir;
use crate::paging::pager::Pager;
use crate::render::Renderer;
use crate::report::run_report::write_run_report;
use std::path::{Path, PathBuf};

/// Which run, and what it is given now.
#[derive(Debug, Clone)]
pub struct ResumeRequest {
    /// Its output folder.
    pub out: PathBuf,
    /// Flags.
    pub keys: TrainOverrides,
    /// Its scene, where that is not where it was.
    pub scene: Option<PathBuf>,
    /// Other numbers and another dataset are accepted.
    pub accept_changes: bool,
    /// Nothing but errors on the terminal.
    pub quiet: bool,
}

/// Goes on with a run, to its end.
///
/// # Errors
/// There is no run that could go on, or it is not the same any more (nothing is changed then); else as
/// [`super::run::run`].
pub fn resume(request: &ResumeRequest) -> Result<RunOutcome, TrainError> {
    let file = request.out.join("config.toml");
    let of_file = TrainConfig::read(&file)?;
    let scene = request.scene.clone().map_or_else(|| read_resolved(&file).map(|resolved| resolved.scene), Ok)?;
    let mut config = of_file.clone();
    request.keys.clone().apply(&mut config);
    config.check()?;
    let folder = stored_folder(&request.out, &config);
    let is_its_own = folder == stored_folder(&request.out, &of_file);
    if let Some(outcome) = already_done(request, &config, &folder, is_its_own)? {
        return Ok(outcome);
    }
    machine::set_up(&config)?;
    let host_mem = host_budget(&config);
    let stored = Stored::open(&folder, config.spill_dir.is_empty())?;
    let state = stored.run_state.clone();
    keep_schedule(&mut config, &request.keys, &state);
    check_steps(&config, &state)?;
    let mut changes = Changes::of_config(&file, &state, &config)?;
    changes.check(&file, request.accept_changes)?;
    if !scene.is_dir() {
        let remedy = format!("if it was moved: gsscale-train --resume {} SCENE", request.out.display());
        return Err(InputError::new(&scene, "the scene of this run is not there", remedy).into());
    }
    let start = Start::look(&scene, &config, &request.out, host_mem)?;
    let print = dataset_print(&start)?;
    changes.add_dataset(&start.dataset, &state.dataset, &print);
    changes.numbers.extend(start_change(&start, &state, &print));
    changes.check(&start.dataset.image_folder, request.accept_changes)?;
    let (renderer, options, driver) = begin(request.quiet, &config, &start)?;
    say(request, &state, &config, &changes, &*renderer);
    let dataset = start.into_dataset();
    let (pager, tiers) = stored.into_tiers(&config, host_mem.unwrap_or(u64::MAX))?;
    tiers.notes.iter().for_each(|note| eprintln!("warning: {note}"));
    let has_changed = !changes.numbers.is_empty();
    let pages = match has_changed {
        false => restore_pages(pager, &of_state(&options, &state), &state)?,
        true => changed_pages(pager, &options, &state)?,
    };
    let mut trainer = Trainer::of_scene(pages, &dataset, renderer, options);
    trainer.restore_counts(&state);
    let kept = kept_config(&file, &of_file, &config)?;
    let past = Past { config: kept, metrics_bytes: state.metrics_bytes, step: state.step, has_changed };
    let begun = Begun { print, sh_degree_start: state.sh_degree_start, past: Some(past), host_mem, driver };
    let (out, quiet) = (request.out.clone(), request.quiet);
    let request = RunRequest { scene, out, config, dry_run: false, overwrite: false, quiet };
    see_through(&request, &dataset, tiers, trainer, begun)
}

/// Where the checkpoint of a run is.
fn stored_folder(out: &Path, config: &TrainConfig) -> PathBuf {
    match config.spill_dir.as_str() {
        "" => checkpoint_folder(out),
        folder => PathBuf::from(folder),
    }
}

/// More steps do not stretch the rates of a run.
fn keep_schedule(config: &mut TrainConfig, keys: &TrainOverrides, state: &RunState) {
    if let Ok(then) = TrainConfig::parse(&state.config)
        && keys.schedule_steps.is_none()
        && config.steps != then.steps
    {
        config.schedule_steps = limits::schedule_steps(&then);
    }
}

fn check_steps(config: &TrainConfig, state: &RunState) -> InputResult<()> {
    if config.steps >= state.step {
        return Ok(());
    }
    let problem = format!("{} are fewer than the {} steps that the run has done", config.steps, state.step);
    Err(InputError::new("--steps", problem, "give more, or roll the run back with gsscale-ckpt"))
}

/// Says that a run goes on, and what is other than it was.
fn say(request: &ResumeRequest, state: &RunState, config: &TrainConfig, changes: &Changes, renderer: &dyn Renderer) {
    if renderer.device() != state.device {
        let (there, here) = (&state.device, renderer.device());
        eprintln!("warning: the run was rendered by {there}, and is by {here} from here on: other roundings");
    }
    changes.numbers.iter().for_each(|line| eprintln!("warning: accepted from step {} on: {line}", state.step));
    if !changes.numbers.is_empty() {
        eprintln!("warning: every page is brought to that step as it was trained, and rewritten, once");
    }
    if request.quiet {
        return;
    }
    let other = match changes.free.as_slice() {
        [] => String::new(),
        free => format!("; {}", free.join(", ")),
    };
    eprintln!("resume  {} after {} of {} steps{other}", request.out.display(), state.step, config.steps);
}

/// A run that did all of its steps and wrote its results. If it was killed before its checkpoint was gone, what is left of
/// that is removed, and nothing is trained; where it is to be kept, it stays, and a folder that is not `is_its_own` too.
/// One that was rolled back since is not done.
fn already_done(
    request: &ResumeRequest,
    config: &TrainConfig,
    folder: &Path,
    is_its_own: bool,
) -> InputResult<Option<RunOutcome>> {
    let text = std::fs::read_to_string(request.out.join("summary.json")).unwrap_or_default();
    let summary: Option<Summary> = serde_json::from_str(&text).ok();
    let Some(summary) = summary.filter(|s| s.finished && s.steps >= config.steps) else { return Ok(None) };
    let stored = Stored::open(folder, config.spill_dir.is_empty()).ok();
    if stored.as_ref().is_some_and(|stored| stored.run_state.step < config.steps && stored.is_whole()) {
        return Ok(None);
    }
    drop(stored);
    // Without its FORMAT, or in use, it is left alone.
    let spill = SpillDir::open(folder, config.spill_dir.is_empty()).ok();
    let is_kept = config.keep_checkpoint && spill.is_some();
    if let Some(spill) = spill.filter(|_| is_its_own && !config.keep_checkpoint) {
        spill.remove()?;
    }
    write_run_report(&request.out)?;
    if !request.quiet {
        let more = if is_kept { "; --steps N goes on to more" } else { "" };
        eprintln!("{} is done: all {} steps, results are there{more}", request.out.display(), summary.steps);
    }
    Ok(Some(RunOutcome { summary: Some(summary), exit_code: 0 }))
}

fn restore_pages(pager: Pager, options: &RunOptions, state: &RunState) -> Result<PagedScene, TrainError> {
    let broken = |e: RunStateError| CommitError::Contradiction(e.to_string());
    let histogram = GradHistogram::from_filled(&state.histogram);
    let histogram = histogram.ok_or_else(|| CommitError::Contradiction("statistics without bins".to_string()))?;
    let events = state.event_log().map_err(broken)?;
    Ok(PagedScene::restore(pager, options, events, histogram, [state.rows, state.rows_bound]))
}

/// The pages of a run that goes on by other rules: brought to its last step by those that it had.
fn changed_pages(pager: Pager, options: &RunOptions, state: &RunState) -> Result<PagedScene, TrainError> {
    let then = TrainConfig::parse(&state.config).map_err(CommitError::Contradiction)?;
    let then = rules_then(&then, &state.simd, SimdPath::is_supported)
        .ok_or_else(|| CommitError::Contradiction("no instruction path of this machine is known".to_string()))?;
    let old = of_state(&RunOptions::new(&then, state.dataset.scene_scale), state);
    let mut pages = restore_pages(pager, &old, state)?;
    if pages.change_rules(options, state.step)? {
        eprintln!("warning: the statistics of the rows were not those that the run had counted, and are counted anew");
    }
    Ok(pages)
}

/// The config that the pages were trained by, on the path that the bits were made on if this machine has it, else on that
/// of the config or on the best that there is: a path changes roundings, other rates the scene.
fn rules_then(then: &TrainConfig, simd: &str, is_supported: impl Fn(SimdPath) -> bool) -> Option<TrainConfig> {
    let on = |simd: &str| TrainConfig { simd: simd.to_string(), ..then.clone() };
    [on(simd), on(&then.simd), on("auto")].into_iter().find(|c| is_supported(limits::simd_path(c)))
}

/// The options by which pages come back: with the band that was in use from their first step, from which the events of
/// the run raised it. Which band the run would begin with now may be another, by keys that were accepted.
fn of_state(options: &RunOptions, state: &RunState) -> RunOptions {
    RunOptions { sh_degree_start: state.sh_degree_start, ..options.clone() }
}

/// A start that would be another one now: of no use to a run that is past it, but a sign that something changed. Of the
/// same points or Gaussians it is another by the config alone, whose keys are compared one by one, and once.
fn start_change(start: &Start, state: &RunState, here: &DatasetPrint) -> Option<String> {
    if state.dataset.points == here.points {
        return None;
    }
    let (there, here) = (state.sh_degree_start, start.sh_degree_start);
    (there != here).then(|| format!("the first Gaussians had {there} bands in use and have {here}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_go_on_by_their_own_config_on_a_machine_without_its_path() {
        let then = TrainConfig { means_lr: 0.5, seed: 9, simd: "avx512".into(), ..TrainConfig::default() };
        let here = |paths: &[SimdPath]| rules_then(&then, "avx512", |path| paths.contains(&path));
        let with = |simd: &str| Some(TrainConfig { simd: simd.into(), ..then.clone() });
        assert_eq!(here(&SimdPath::ALL), with("avx512"));
        // What `auto` stands for depends on the machine: it is the third that is asked for.
        let asked = std::cell::Cell::new(0);
        let third = |_| asked.replace(asked.get() + 1) == 2;
        assert_eq!(rules_then(&then, "avx512", third), with("auto"));
        let baseline = TrainConfig { simd: "baseline".into(), ..then.clone() };
        let found = rules_then(&baseline, "avx512", |path| path == SimdPath::Baseline);
        assert_eq!(found, Some(baseline), "that of the config comes second");
        // Never by another config.
        assert_eq!(here(&[]), None);
    }
}
