//! Resumes a run that stopped, or that ended and kept its checkpoint, from its output folder; says what a resume would do; and restarts a run
//! in the same process after its device was lost, so that a reset or update of the driver, or a device that was unplugged for a moment, costs
//! the steps since the last commit only.
//!
//! Invariants: 1. a resumed run ends with the same bytes as an uninterrupted one; 2. a resume with changed numbers or
//! another dataset is refused with the differences. If the user accepts them, every page is evaluated once at the step
//! of the change by the old rules and continues by the new; 3. a refused resume changes nothing, and neither does a dry run, even while
//! another process trains the run; 4. the checkpoint is sufficient: the output folder only names it, and missing files there are written
//! again; 5. a checkpoint of another run is neither used nor removed (`ownership`); 6. errors other than a lost device end the run.

use super::begin::{begin, plan_and_train, run};
use super::changes::{Changes, kept_config};
use super::more_steps::{FinishedRun, text_of_rates, train_more_steps};
use super::out_folder::{self, check_restart, has_results, settings_of_mark};
use super::request::{Existing, RunOutcome, RunRequest};
use super::run_folder::{Begun, PastRun};
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::say::shell_word;
use crate::base::simd::SimdPath;
use crate::base::text::{lines_of, read_text};
use crate::base::units::{format_grouped, format_seconds};
use crate::checkpoint::run_state::{DatasetPrint, RunState};
use crate::config::file::{FILE_BYTES_MAX, Resolved, TrainConfig, TrainOverrides, read_resolved};
use crate::config::limits::{self, RunOptions};
use crate::config::values::{Chosen, checkpoint_folder};
use crate::page::folder::spill_dir::{SpillDir, segments_in};
use crate::page::map::commit::CommitError;
use crate::page::tool::reading::Access;
use crate::page::tool::uncommitted::{is_uncommitted, remove_uncommitted};
use crate::paging::pager::Pager;
use crate::render::Renderer;
use crate::report::live::Live;
use crate::report::run_files::{CONFIG_FILE, METRICS_FILE, PLY_FILE, saved_step};
use crate::report::run_report::write_run_report;
use crate::train::commits::checkpoint::restore;
use crate::train::error::TrainError;
use crate::train::inputs::machine::{self, absolute};
use crate::train::log::report::StepLine;
use crate::train::memory::host_budget;
use crate::train::run::model_of_run::read_summary;
use crate::train::start::first_scene::{Start, dataset_print};
use crate::train::start::tiers::Tiers;
use crate::train::state::trainer::Trainer;
use crate::train::step::pages::PagedScene;
use crate::train::stores::ownership::{Claim, Stored, last_state, open_own, read_own};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Remedies for an unusable config.toml, with a checkpoint and without.
const REMEDY_DAMAGED: &str = "move the file away: gsscale-train --resume restores it from the checkpoint; if the pages \
                              lie in a spill directory, name it with --spill-dir";
const REMEDY_LOST: &str = "repair it; there is no checkpoint in this folder to restore it from. If the pages lie in a spill directory, move the \
                           file away and name that with --spill-dir; else begin a new run with --init-ply";

/// The run to resume, and the settings given now.
#[derive(Debug, Clone)]
pub struct ResumeRequest {
    /// Its output folder.
    pub out: PathBuf,
    /// Flags.
    pub keys: TrainOverrides,
    /// Its scene, if it moved.
    pub scene: Option<PathBuf>,
    /// Accept changed numbers and another dataset.
    pub accept_changes: bool,
    /// Print only warnings and errors.
    pub quiet: bool,
    /// The page that shows the run while it trains.
    pub live: Option<Live>,
    /// As [`RunRequest::leg`].
    pub leg: Option<Duration>,
}

impl ResumeRequest {
    /// The request for the rest of the run.
    fn to_run(&self, scene: &Path, config: TrainConfig, existing: Existing) -> RunRequest {
        let (scene, out, live) = (scene.to_path_buf(), self.out.clone(), self.live.clone());
        RunRequest { scene, out, config, dry_run: false, existing, quiet: self.quiet, live, leg: self.leg }
    }
}

/// Resumes a run and trains to its end.
/// Errors: no run can be resumed, or it has changed (the folder stays unchanged then); else as [`super::begin::run`].
pub fn resume(request: &ResumeRequest) -> Result<RunOutcome, TrainError> {
    // Do not read or remove files of an active run, and write nothing into a folder that is none.
    let lock = if out_folder::may_be_run(&request.out) { out_folder::lock(&request.out)? } else { None };
    if let Some((config, scene)) = settings_of_mark(&request.out, &request.keys, request.scene.as_deref())? {
        drop(lock);
        crate::tell!("{} was cut off before its first step: it begins again", request.out.display());
        return run(&request.to_run(&scene, config, Existing::Overwrite));
    }
    let earlier = Earlier::find(request)?;
    let mut config = earlier.config_now(request)?;
    if let Some(outcome) = finished_outcome(request, &config, &earlier)? {
        return Ok(outcome);
    }
    // What lies in the place of a result is refused here, and not after the last step.
    config.export.formats().try_for_each(|format| out_folder::check_results(&request.out, format))?;
    let folder = config.residence().checkpoint_folder(&request.out);
    if let Some(finished) = result_to_continue(request, &earlier, &mut config, &folder)? {
        drop(lock);
        return train_more_steps(request.to_run(&earlier.scene, config, Existing::BeginAgain), finished);
    }
    let is_in_output = config.residence().spill_dir().is_none();
    let found = open_own(&folder, earlier.claim(request), is_in_output);
    // The resumed run takes the lock again.
    drop(lock);
    match found {
        Ok(Some(stored)) => resume_from(request, &earlier, config, earlier.adopted(stored)),
        Ok(None) => restart(request, &earlier, config, true),
        // A run in memory creates its checkpoint at its first commit.
        Err(_) if is_in_output && !SpillDir::exists_in(&folder) && !has_results(&request.out) => {
            restart(request, &earlier, config, false)
        }
        Err(error) => Err(error),
    }
}

/// Facts of a run before its checkpoint is opened.
struct Earlier {
    /// Path of config.toml, which may not exist.
    path: PathBuf,
    /// Its content; `None` if it is missing.
    file: Option<(TrainConfig, Resolved)>,
    /// Its config, from the file or from the checkpoint.
    config: TrainConfig,
    scene: PathBuf,
    /// Its identity; unknown if config.toml is missing and the user named the checkpoint.
    run: RunId,
}

impl Earlier {
    /// Reads config.toml or, if it is missing, the checkpoint in the output folder or in the given spill directory.
    pub fn find(request: &ResumeRequest) -> Result<Earlier, TrainError> {
        let path = request.out.join(CONFIG_FILE);
        if path.exists() {
            let is_saved = SpillDir::exists_in(&checkpoint_folder(&request.out));
            let remedy = if is_saved { REMEDY_DAMAGED } else { REMEDY_LOST };
            let facts = read_resolved(&path).map_err(|e| InputError { remedy: remedy.to_string(), ..e })?;
            let config = TrainConfig::read(&path)?;
            let scene = request.scene.clone().unwrap_or_else(|| facts.scene.clone());
            return Ok(Earlier { run: facts.run, file: Some((config.clone(), facts)), config, scene, path });
        }
        let named = request.keys.spill_dir.as_deref().filter(|folder| !folder.is_empty());
        let folder = named.map_or_else(|| checkpoint_folder(&request.out), PathBuf::from);
        if named.is_none() && !request.out.exists() {
            let remedy = "name the output folder of a run, such as runs/village";
            return Err(InputError::new(&request.out, "there is no such folder", remedy).into());
        }
        let nothing = || {
            let problem = format!("there is neither a config.toml nor a checkpoint in {}", folder.display());
            let remedy = "name the output folder of a run; if its pages lie in a spill directory, name it too: --spill-dir; a run \
                          that was stopped while it read its photos is started with its first command";
            InputError::new(&request.out, problem, remedy)
        };
        if !SpillDir::exists_in(&folder) {
            return Err(nothing().into());
        }
        let state = last_state(&folder, Access::Map)?;
        let then = TrainConfig::parse(&state.origin.config).map_err(CommitError::Contradiction)?;
        if Path::new(&state.origin.run.out) != absolute(&request.out) && has_results(&request.out) {
            let problem = format!(
                "it holds results, and the checkpoint in {} is that of {}",
                folder.display(),
                state.origin.run.out
            );
            let remedy = format!(
                "name that output folder; or resume into a new one: gsscale-train --resume NEW --spill-dir {}",
                shell_word(&folder)
            );
            return Err(InputError::new(&request.out, problem, remedy).into());
        }
        // The leg of a run that came from another machine has none.
        if request.leg.is_none() {
            crate::tell!("warning: {} is missing: its settings come from the checkpoint", path.display());
        }
        // The checkpoint may have moved, and a run that committed to its output folder has no spill directory.
        let config = TrainConfig { spill_dir: named.unwrap_or("").to_string(), ..then };
        let scene = request.scene.clone().unwrap_or_else(|| PathBuf::from(&state.origin.run.scene));
        Ok(Earlier { run: state.origin.run.id, file: None, config, scene, path })
    }

    /// Its config with the flags of the request. What the run has chosen for `auto` stays: it chose at its start, by all photos.
    /// Errors: they do not fit together.
    fn config_now(&self, request: &ResumeRequest) -> InputResult<TrainConfig> {
        let mut config = self.config.clone();
        request.keys.clone().apply(&mut config);
        let then = &self.config;
        config.view_order.0 = config.view_order.0.or(then.view_order.0);
        config.optimizer_on.0 = config.optimizer_on.0.or(then.optimizer_on.0);
        config.appearance.0 = config.appearance.0.or(then.appearance.0);
        config.robust_views.0 = config.robust_views.0.or(then.robust_views.0);
        config.robust_pixels.0 = config.robust_pixels.0.or(then.robust_pixels.0);
        config.refine_poses.0 = config.refine_poses.0.or(then.refine_poses.0);
        config.poor_points.0 = config.poor_points.0.or(then.poor_points.0);
        config.sweep_points.0 = config.sweep_points.0.or(then.sweep_points.0);
        // The folder may have been moved, with the Gaussians from which the run went on.
        let name = Path::new(&config.init_ply).file_name().and_then(|name| name.to_str());
        let moved = name.filter(|name| saved_step(name).is_some()).map(|name| request.out.join(name));
        if let Some(moved) = moved.filter(|moved| !Path::new(&config.init_ply).exists() && moved.is_file()) {
            config.init_ply = absolute(&moved).to_string_lossy().into_owned();
        }
        config.check()?;
        Ok(config)
    }

    /// `stored`, whose folder is removed at the end if the run made it.
    fn adopted(&self, mut stored: Stored) -> Stored {
        let is_own = |(config, facts): &(TrainConfig, Resolved)| {
            facts.made_spill_dir && config.residence().spill_dir().is_some_and(|dir| stored.is_in(dir))
        };
        if self.file.as_ref().is_some_and(is_own) {
            stored.adopt_folder();
        }
        stored
    }

    /// The claim that the run's checkpoint must satisfy.
    pub fn claim<'a>(&self, request: &'a ResumeRequest) -> Claim<'a> {
        let is_named = request.keys.spill_dir.as_ref().is_some_and(|folder| !folder.is_empty());
        Claim { run: self.run, out: &request.out, is_named }
    }
}

/// A run that did all of its steps, has no checkpoint any more, and is to do more steps, whose rate schedule becomes that of the run. A run
/// that was to keep its checkpoint on another drive is not continued: that drive may not be mounted.
/// Errors: its config.toml cannot be read.
fn result_to_continue(
    request: &ResumeRequest,
    earlier: &Earlier,
    config: &mut TrainConfig,
    folder: &Path,
) -> InputResult<Option<FinishedRun>> {
    let summary = read_summary(&request.out).filter(|s| s.finished && config.steps > s.steps);
    let has_store = SpillDir::exists_in(folder);
    if summary.is_some() && !has_store && segments_in(folder).is_ok_and(|segments| !segments.is_empty()) {
        let remedy = format!("recover its pages: gsscale-ckpt salvage {} --out TO", shell_word(folder));
        return Err(InputError::new(folder, "the checkpoint of this run has lost its file FORMAT", remedy));
    }
    // An attempt to go on that was killed before its first commit leaves a store without one.
    let is_gone = !has_store || is_uncommitted(folder).is_ok_and(|is_empty| is_empty);
    let own = earlier.config.residence();
    let own_folder = own.checkpoint_folder(&request.out);
    if summary.is_some() && !has_store && own_folder != folder && SpillDir::exists_in(&own_folder) {
        let problem = format!("there is no checkpoint here; that of this run is in {}", own_folder.display());
        return Err(InputError::new(folder, problem, "leave --spill-dir out, or move the pages: gsscale-ckpt clone"));
    }
    let is_kept = earlier.config.keep_checkpoint && own.spill_dir().is_some();
    let (Some(summary), Some(file)) = (summary.filter(|_| is_gone && !is_kept), &earlier.file) else {
        return Ok(None);
    };
    keep_rates(config, &request.keys, &earlier.config);
    let text = read_text(&earlier.path, FILE_BYTES_MAX, "give a TOML file of keys")?;
    let changes = Changes::of_config(&earlier.path, &text, &file.1.simd, config)?;
    let accepts_changes = request.accept_changes;
    Ok(Some(FinishedRun { file: file.clone(), run: earlier.run, summary, changes, accepts_changes }))
}

/// Restarts a run that was cut off before its first commit, from its config. `has_empty_store` as in [`check_restart`].
/// Errors: the run left results that would be replaced; else as [`run`].
fn restart(
    request: &ResumeRequest,
    earlier: &Earlier,
    config: TrainConfig,
    has_empty_store: bool,
) -> Result<RunOutcome, TrainError> {
    check_restart(&request.out, has_empty_store)?;
    crate::tell!("{} was cut off before its first commit: it begins again", request.out.display());
    run(&request.to_run(&earlier.scene, config, Existing::BeginAgain))
}

/// Checks that a run may go on from `state` with `config`, whose rate schedule becomes that of the run. Returns the accepted differences
/// and what the run resumes with. Changes no file.
/// Errors: the run has done more steps, its settings or its dataset changed, or its scene is not there.
fn goal(
    request: &ResumeRequest,
    earlier: &Earlier,
    config: &mut TrainConfig,
    state: &RunState,
) -> Result<(Changes, Start, DatasetPrint), TrainError> {
    let (file, scene) = (&earlier.path, &earlier.scene);
    if let Ok(then) = TrainConfig::parse(&state.origin.config) {
        keep_rates(config, &request.keys, &then);
    }
    if config.steps < state.trainer.step {
        let problem = format!("{} are fewer than the {} steps that the run has done", config.steps, state.trainer.step);
        let remedy = "give more, or roll the run back with gsscale-ckpt";
        return Err(InputError::new("--steps", problem, remedy).into());
    }
    let mut changes = Changes::of_config(file, &state.origin.config, &state.origin.simd, config)?;
    changes.check(file, request.accept_changes)?;
    if !scene.exists() {
        let remedy = format!("if it was moved: gsscale-train --resume {} SCENE", shell_word(&request.out));
        return Err(InputError::new(scene, "the scene of this run is missing", remedy).into());
    }
    let start = Start::look(scene, config, &request.out, host_budget(config.host_mem.0))?;
    let print = dataset_print(&start)?;
    changes.add_dataset(&start.dataset, &state.origin.dataset, &print);
    changes.numbers.extend(first_degree_change(&start, state, &print));
    changes.check(&start.dataset.image_folder, request.accept_changes)?;
    Ok((changes, start, print))
}

/// Resumes from a checkpoint.
fn resume_from(
    request: &ResumeRequest,
    earlier: &Earlier,
    mut config: TrainConfig,
    stored: Stored,
) -> Result<RunOutcome, TrainError> {
    machine::set_up(&config)?;
    let host_mem = host_budget(config.host_mem.0);
    let state = stored.run_state.clone();
    let (changes, start, print) = goal(request, earlier, &mut config, &state)?;
    let (renderer, options, driver) = begin(request.quiet, &config, &start)?;
    print_resume(request, &state, &config, &changes, &*renderer);
    let dataset = start.into_dataset();
    let (pager, tiers) = Tiers::resume(stored, &config, host_mem.unwrap_or(u64::MAX))?;
    tiers.notes.iter().for_each(|note| crate::tell!("warning: {note}"));
    let has_changed = !changes.numbers.is_empty();
    let pages = match has_changed {
        false => PagedScene::restore(pager, &options, &state)?,
        true => pages_with_new_rules(pager, &options, &state)?,
    };
    let mut trainer = Trainer::of_scene(pages, &dataset, renderer, options);
    restore(&mut trainer, &state, &print)?;
    let past = PastRun {
        config: kept_config(&earlier.path, &earlier.config, &config)?,
        metrics_bytes: state.metrics_bytes,
        step: state.trainer.step,
        has_changed,
        file: earlier.file.clone(),
        first_rows: state.origin.dataset.first_rows,
        keep_result_as: None,
    };
    // Its own, that of its checkpoint, or a new one.
    let run = [earlier.run, state.origin.run.id].into_iter().find(|id| id.is_known()).unwrap_or_else(RunId::draw);
    let sh_degree_start = state.origin.sh_degree_start;
    let begun =
        Begun { print, sh_degree_start, past: Some(past), host_mem, driver, run, diagnosis: None, is_locked: false };
    let request = request.to_run(&earlier.scene, config, Existing::BeginAgain);
    plan_and_train(&request, &dataset, tiers, trainer, begun)
}

/// Keeps what a run reads only when it begins, and its rate schedule if it is extended to more steps, unless a flag gives another.
fn keep_rates(config: &mut TrainConfig, keys: &TrainOverrides, then: &TrainConfig) {
    config.first_appearance.clone_from(&then.first_appearance);
    if keys.schedule_steps.is_none() && config.steps != then.steps {
        config.schedule_steps = limits::schedule_steps(then);
    }
}

fn print_resume(
    request: &ResumeRequest,
    state: &RunState,
    config: &TrainConfig,
    changes: &Changes,
    renderer: &dyn Renderer,
) {
    if renderer.device() != state.device {
        let (there, here) = (&state.device, renderer.device());
        crate::tell!("warning: the renderer was {there} and is {here}: its rounding differs");
    }
    changes
        .numbers
        .iter()
        .for_each(|line| crate::tell!("warning: accepted from step {} on: {line}", state.trainer.step));
    if !changes.numbers.is_empty() {
        crate::tell!("warning: every page is updated to that step by the old rules and rewritten once");
    }
    changes.warn_of_decided_count(&state.trainer.growth);
    if request.quiet {
        return;
    }
    let other = match changes.free.as_slice() {
        [] => String::new(),
        free => format!("; {}", free.join(", ")),
    };
    crate::tell!("resume  {} after {} of {} steps{other}", request.out.display(), state.trainer.step, config.steps);
    if let Some(rates) = text_of_rates(config).filter(|_| is_extended(config, state)) {
        crate::tell!("{rates}");
    }
}

/// Whether a run that resumes from `state` is to do more steps than it was to do when it was started.
fn is_extended(config: &TrainConfig, state: &RunState) -> bool {
    TrainConfig::parse(&state.origin.config).is_ok_and(|then| config.steps > then.steps)
}

/// Handles a run that did all steps and wrote its results: trains nothing. Removes a checkpoint that a kill left
/// behind, unless it is to be kept, the user named another folder, it belongs to another run, or it cannot be opened. A
/// run that was rolled back since is not finished.
fn finished_outcome(
    request: &ResumeRequest,
    config: &TrainConfig,
    earlier: &Earlier,
) -> Result<Option<RunOutcome>, TrainError> {
    let summary = read_summary(&request.out).filter(|s| s.finished && s.steps >= config.steps);
    let Some(summary) = summary else { return Ok(None) };
    let folder = config.residence().checkpoint_folder(&request.out);
    // The command may name the folder in another form than the config, which holds absolute paths.
    let place = |folder: &Path| folder.canonicalize().unwrap_or_else(|_| absolute(folder));
    let is_its_place = place(&folder) == place(&earlier.config.residence().checkpoint_folder(&request.out));
    let stored = if SpillDir::exists_in(&folder) {
        open_own(&folder, earlier.claim(request), config.residence().spill_dir().is_none()).unwrap_or_else(|error| {
            crate::tell!("warning: {} is left alone: {error}", folder.display());
            None
        })
    } else {
        None
    };
    if stored.as_ref().is_some_and(|stored| stored.run_state.trainer.step < config.steps && stored.is_whole()) {
        return Ok(None);
    }
    // A process that was killed while it removed the store may have left the files that show one.
    if stored.is_none() && is_its_place && !config.keep_checkpoint && remove_uncommitted(&folder)? {
        let has_made_it = earlier.file.as_ref().is_some_and(|(_, facts)| facts.made_spill_dir);
        let _ = if has_made_it { std::fs::remove_dir(&folder) } else { Ok(()) };
    }
    let is_kept = config.keep_checkpoint && stored.is_some();
    let is_its_own = |stored: &Stored| earlier.run.is_known() && stored.run_state.origin.run.id == earlier.run;
    if let Some(stored) = stored.filter(|stored| is_its_place && !config.keep_checkpoint && is_its_own(stored)) {
        earlier.adopted(stored).remove()?;
        // An earlier process of the run may have created the folder in its results; it is empty now.
        let _ = std::fs::remove_dir(checkpoint_folder(&request.out));
    }
    write_run_report(&request.out, &|_, _| {})?;
    let then = &earlier.config;
    let exports = |config: &TrainConfig| (config.export, config.export_frame, config.export_clean, config.up);
    if exports(config) != exports(then) {
        crate::tell!(
            "warning: the files of a finished run are not written again, so --export, --export-frame, --export-clean and --up have no effect. \
             Other formats: gsscale-ckpt import {ply} --out STORE, then gsscale-ckpt export STORE --out FILE.spz",
            ply = shell_word(Trainer::ply_path(&request.out))
        );
    }
    if !request.quiet {
        let more = if is_kept { "" } else { " from its PLY" };
        let (out, steps) = (request.out.display(), summary.steps);
        crate::tell!("{out} is finished: all {steps} steps, with results; --steps N continues it{more}");
    }
    Ok(Some(RunOutcome {
        summary: Some(summary),
        exit_code: 0,
        out: request.out.clone(),
        keeps_checkpoint: config.keep_checkpoint,
    }))
}

/// The pages of a run that resumes with changed rules, updated to its last step by the old rules.
fn pages_with_new_rules(pager: Pager, options: &RunOptions, state: &RunState) -> Result<PagedScene, TrainError> {
    let then = TrainConfig::parse(&state.origin.config).map_err(CommitError::Contradiction)?;
    let then = config_before(&then, &state.origin.simd, SimdPath::is_supported)
        .ok_or_else(|| CommitError::Contradiction("no instruction path of this machine is known".to_string()))?;
    let old = RunOptions::new(&then, state.origin.dataset.scene_scale);
    let mut pages = PagedScene::restore(pager, &old, state)?;
    if pages.change_rules(options, state.trainer.step)? {
        crate::tell!("warning: the statistics of the rows differed from the run's histogram, which is counted anew");
    }
    Ok(pages)
}

/// The config by which the pages were trained, on an instruction path with the same bits if this machine has one, else
/// on the path of the config or the best available: another path changes only the rounding.
fn config_before(then: &TrainConfig, simd: &str, is_supported: impl Fn(SimdPath) -> bool) -> Option<TrainConfig> {
    let on = |simd: Option<SimdPath>| TrainConfig { simd: Chosen(simd), ..then.clone() };
    let path = SimdPath::from_name(simd);
    let class = path.map(SimdPath::bits_class);
    let of_class = SimdPath::ALL.into_iter().filter(|path| Some(path.bits_class()) == class);
    let of_class = of_class.map(|path| on(Some(path)));
    let mut all = std::iter::once(on(path)).chain(of_class).chain([on(then.simd.0), on(None)]);
    all.find(|c| is_supported(limits::simd_path(c)))
}

/// The difference if the run would start with another SH degree now: a sign of changed input. For the same points or
/// Gaussians only the config can differ, and its keys are compared elsewhere.
fn first_degree_change(start: &Start, state: &RunState, here: &DatasetPrint) -> Option<String> {
    if state.origin.dataset.points == here.points {
        return None;
    }
    let (there, here) = (state.origin.sh_degree_start, start.sh_degree_start);
    (there != here).then(|| format!("the SH degree of the first Gaussians was {there} and is {here}"))
}

/// Whether the run in an output folder has a commit, or can begin again because all of it was in memory.
fn can_continue(out: &Path) -> bool {
    TrainConfig::read(&out.join(CONFIG_FILE)).is_ok_and(|config| {
        let residence = config.residence();
        residence.spill_dir().is_none() || SpillDir::exists_in(&residence.checkpoint_folder(out))
    })
}

/// Goes on with the run of `request` for as long as it ends with the loss of its device, at most `most` times. `ended` is how the run
/// has ended so far.
/// Errors: the error that ended the run last.
pub fn go_on(
    mut ended: Result<RunOutcome, TrainError>,
    request: &ResumeRequest,
    most: u32,
) -> Result<RunOutcome, TrainError> {
    for restart in 1..=most {
        match ended {
            Err(error) if error.is_device_lost() && can_continue(&request.out) => {
                crate::tell!(
                    "warning: {error}\n  the run goes on in this process (restart {restart} of at most {most})"
                );
                ended = resume(request);
            }
            ended => return ended,
        }
    }
    ended
}

/// Says what a resume with this request would do.
/// Errors: those of the resume before its first step, but for memory and drives.
pub fn describe_resume(request: &ResumeRequest) -> Result<String, TrainError> {
    out_folder::refuse_in_use(&request.out)?;
    let out = request.out.display();
    if settings_of_mark(&request.out, &request.keys, request.scene.as_deref())?.is_some() {
        return Ok(format!("resume  {out} was cut off before its first step: it begins again"));
    }
    let earlier = Earlier::find(request)?;
    let mut config = earlier.config_now(request)?;
    machine::set_up(&config)?;
    let folder = config.residence().checkpoint_folder(&request.out);
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
    if let Some(mut finished) = result_to_continue(request, &earlier, &mut config, &folder)? {
        finished.start(&request.to_run(&earlier.scene, config.clone(), Existing::BeginAgain))?;
        let FinishedRun { summary, changes, .. } = finished;
        let from = format!(
            "{} Gaussians of {PLY_FILE}",
            format_grouped(summary.gaussians.saturating_sub(summary.gaussians_left_out))
        );
        return Ok(with_changes(steps_to_do(&request.out, &from, summary.steps, &config, true, ""), &changes));
    }
    match state {
        Some(state) => committed(request, &earlier, config, &state),
        None => {
            check_restart(&request.out, SpillDir::exists_in(&folder))?;
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
    let (changes, ..) = goal(request, earlier, &mut config, state)?;
    let from = format!("the last commit, {} Gaussians", format_grouped(state.rows));
    let is_extended = is_extended(&config, state);
    let growth = &state.trainer.growth;
    let grows = if growth.first > 0 && !growth.is_decided() { ", more if the scene grows" } else { "" };
    Ok(with_changes(steps_to_do(&request.out, &from, state.trainer.step, &config, is_extended, grows), &changes))
}

fn with_changes(text: String, changes: &Changes) -> String {
    changes.free.iter().chain(&changes.numbers).fold(text, |text, change| format!("{text}\nchange  {change}"))
}

/// `grows` says what growth may add to the time.
fn steps_to_do(out: &Path, from: &str, done: u32, config: &TrainConfig, is_extended: bool, grows: &str) -> String {
    let left = config.steps.saturating_sub(done);
    let [done, all, more] = [done, config.steps, left].map(|steps| format_grouped(steps.into()));
    let time = seconds_of_a_step(out).map_or(String::new(), |seconds| {
        format!(" and about {} at the pace of its last steps{grows}", format_seconds(seconds * f64::from(left)))
    });
    let rates = text_of_rates(config).filter(|_| is_extended);
    let rates = rates.map_or(String::new(), |rates| format!("\n{rates}"));
    format!(
        "resume  {} after {done} of {all} steps, from {from}\ntime    {more} steps to do{time}{rates}",
        out.display()
    )
}

/// Seconds of a step by the metrics of the second half of the run.
fn seconds_of_a_step(out: &Path) -> Option<f64> {
    let lines = lines_of(&out.join(METRICS_FILE));
    let lines: Vec<StepLine> = lines.filter_map(|line| serde_json::from_slice(&line).ok()).collect();
    let last = lines.last().filter(|last| last.step > 0)?;
    let half = lines.iter().rfind(|line| line.step <= last.step / 2);
    let (steps, seconds) = half.map_or((0, 0.0), |line| (line.step, line.seconds));
    Some((last.seconds - seconds).max(0.0) / f64::from(last.step - steps))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_go_on_by_their_own_config_on_a_machine_without_its_path() {
        let then =
            TrainConfig { means_lr: 0.5, seed: 9, simd: Chosen(Some(SimdPath::Avx512)), ..TrainConfig::default() };
        let here = |paths: &[SimdPath]| config_before(&then, "avx512", |path| paths.contains(&path));
        let with = |simd: Option<SimdPath>| Some(TrainConfig { simd: Chosen(simd), ..then.clone() });
        assert_eq!(here(&SimdPath::ALL), with(Some(SimdPath::Avx512)));
        assert_eq!(
            here(&[SimdPath::Avx2, SimdPath::Baseline]),
            with(Some(SimdPath::Avx2)),
            "the same bits on another path"
        );
        // What `auto` stands for depends on the machine: it is asked for after the path itself, the two of its class,
        // and that of the config.
        let asked = std::cell::Cell::new(0);
        let last = |_| asked.replace(asked.get() + 1) == 4;
        assert_eq!(config_before(&then, "avx512", last), with(None));
        let baseline = TrainConfig { simd: Chosen(Some(SimdPath::Baseline)), ..then.clone() };
        let found = config_before(&baseline, "avx512", |path| path == SimdPath::Baseline);
        assert_eq!(found, Some(baseline), "that of the config comes next");
        // Never by another config.
        assert_eq!(here(&[]), None);
    }
}
