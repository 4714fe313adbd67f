//! A run from command line to result: load, check, plan, print the plan, train.
//!
//! Not here: what happens in the output folder (`run_folder`).
//!
//! Invariant: bad input leaves no files. A run that is killed before it has a config.toml leaves its settings (`out_folder`).

use super::changes::with_absolute_paths;
use super::out_folder::{self, Beginning};
use super::request::{Existing, RunOutcome, RunRequest};
use super::run_folder::{Begun, train_into};
use crate::base::error::InputError;
use crate::base::identity::RunId;
use crate::base::say::shell_word;
use crate::base::units::format_grouped;
use crate::config::file::TrainConfig;
use crate::config::limits::RunOptions;
use crate::config::new_run;
use crate::config::values::{Up, checkpoint_folder};
use crate::dataset::loader::Dataset;
use crate::optim::method::OptimizerPlace;
use crate::page::folder::measure::DriveRate;
use crate::page::tool::uncommitted::{check_usable, remove_uncommitted};
use crate::photos::diagnosis::{Diagnosis, Remedies};
use crate::photos::exposure::read_values;
use crate::render::Renderer;
use crate::report::run_files::CONFIG_FILE;
use crate::train::error::TrainError;
use crate::train::inputs::machine::{self, OpenedDevice};
use crate::train::inputs::signals::StopFlag;
use crate::train::memory::host_budget;
use crate::train::preflight::forecast::{Forecast, check_drive_of_results, check_first_drive, first_pages, plan_run};
use crate::train::preflight::plan::rows_at_most;
use crate::train::preflight::plan_text;
use crate::train::start::first_scene::{Start, dataset_print, random_points_warning};
use crate::train::start::tiers::{self, Tiers};
use crate::train::state::trainer::Trainer;
use crate::train::state::turns::{keeps_first_count, too_few_to_decide};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Runs a request from beginning to end.
/// Errors: bad input (leaves no files), or a failure while training (the last good step is written).
pub fn run(request: &RunRequest) -> Result<RunOutcome, TrainError> {
    let config = &request.config;
    config.check()?;
    machine::set_up(config)?;
    // Before anything else is read, and without a change: dry runs refuse what runs refuse.
    out_folder::check_usable_out(&request.out, request.existing)?;
    out_folder::check_apart(&request.out, &request.scene)?;
    config.residence().spill_dir().map_or(Ok(()), check_usable)?;
    let mark = Beginning::mark(request)?;
    let host_mem = host_budget(config.host_mem.0);
    let start = Start::read(&request.scene, config, host_mem)?;
    out_folder::check_apart_from_photos(&request.out, &start.dataset)?;
    let (request, start, diagnosis) = adapt_to_photos(request.clone(), start, host_mem)?;
    let request = adapt_schedule(&request, &start);
    let (request, config) = (&request, &request.config);
    if let Some(known) = plan_text::too_large_for_a_dry_run(config, &start, host_mem).filter(|_| request.dry_run) {
        check_first_drive(config, start.rows)?;
        tell_plan(request, &known);
        return Ok(RunOutcome::of_nothing(request.out.clone()));
    }
    let FirstTrainer { dataset, trainer, tiers, begun } = first_trainer(request, start, host_mem)?;
    let is_locked = mark.as_ref().is_some_and(Beginning::holds_lock);
    plan_and_train(request, &dataset, tiers, trainer, Begun { diagnosis, is_locked, ..begun })
}

/// Prints a part of the plan, unless the run is quiet: to standard output where it is what was asked for.
fn tell_plan(request: &RunRequest, text: &str) {
    match (request.quiet, request.dry_run) {
        (true, _) => {}
        (false, true) => crate::say!("{text}"),
        (false, false) => crate::tell!("{text}"),
    }
}

/// The request, with a schedule that suits the number of training photos.
fn adapt_schedule(request: &RunRequest, start: &Start) -> RunRequest {
    let mut request = request.clone();
    let photos = start.dataset.train_views().len();
    if let Some(steps) = new_run::adapt_schedule(&mut request.config, photos) {
        let steps = format_grouped(steps.into());
        let text = format!("photos  {photos} to train on, few for so many steps: those after {steps} change little");
        tell_plan(&request, &text);
    }
    request
}

/// The request, with the remedies that the photos ask for, the start that follows from it, and what the photos say.
/// Errors: the scene cannot be read.
fn adapt_to_photos(
    mut request: RunRequest,
    start: Start,
    host_mem: Option<u64>,
) -> Result<(RunRequest, Start, Option<Diagnosis>), TrainError> {
    let before = request.config.clone();
    let (start, diagnosis, sweep_points) = with_useful_points(&request, start, host_mem)?;
    let asked = match &diagnosis {
        Some(diagnosis) => diagnosis.remedies(),
        None if start.is_of_random_points() => Remedies::of_unknown(),
        None => Remedies::default(),
    };
    new_run::adapt_to_photos(&mut request.config, &Remedies { sweep_points, ..asked });
    let start = match sweep_points || request.config.init_scale == before.init_scale {
        true => start,
        false => {
            // Not both in memory.
            drop(start);
            Start::read(&request.scene, &request.config, host_mem)?
        }
    };
    if diagnosis.is_some() || asked != Remedies::default() {
        tell_plan(&request, &plan_text::describe_photos(diagnosis.as_ref(), &before, &request.config));
    }
    Ok((request, start, diagnosis))
}

/// The start, the diagnosis of the photos, and whether the start is from swept points, because the scene has no useful ones.
/// Errors: the scene cannot be read.
fn with_useful_points(
    request: &RunRequest,
    start: Start,
    host_mem: Option<u64>,
) -> Result<(Start, Option<Diagnosis>, bool), TrainError> {
    let diagnosis = start.diagnose()?;
    let contradict = diagnosis.as_ref().is_some_and(Diagnosis::points_contradict);
    if request.config.sweep_points.is_on() && diagnosis.is_none() && !start.is_of_random_points() {
        let problem = "the run begins from Gaussians, which points would replace";
        let remedy = "leave out --sweep-points, or the file of Gaussians";
        return Err(InputError::new(&request.scene, problem, remedy).into());
    }
    let reason = match request.config.sweep_points.0 {
        Some(true) => "as --sweep-points asks",
        None if start.is_of_random_points() => "since the scene has none",
        None if contradict => "since those of the scene have not the colours that photos show there",
        _ => return Ok((start, diagnosis, false)),
    };
    tell_plan(request, &format!("points  first points are sought where photos agree, {reason}"));
    let (swept, is_swept) = start.with_swept_points(&request.scene, &request.config)?;
    let said = swept.diagnose()?;
    // Points at which photos agree have the colours of the photos. Others are no better than those of the scene.
    if is_swept && said.as_ref().is_some_and(Diagnosis::points_fit) {
        let count = format_grouped(swept.rows);
        tell_plan(request, &format!("        {count} Gaussians begin at such points (see --sweep-points)"));
        return Ok((swept, said, true));
    }
    tell_plan(request, "        too few are found");
    let start = if is_swept { Start::read(&request.scene, &request.config, host_mem)? } else { swept };
    Ok((start, diagnosis, false))
}

/// A trainer before its first step, with all that belongs to it. Its pages may lie in the tiers, so drop them after it.
pub(super) struct FirstTrainer {
    pub dataset: Dataset,
    pub trainer: Trainer,
    pub tiers: Tiers,
    pub begun: Begun,
}

/// Makes the first pages of a scene, and their trainer.
/// Errors: the drive or the device cannot be used, or the source of the Gaussians cannot be read again.
pub(super) fn first_trainer(
    request: &RunRequest,
    start: Start,
    host_mem: Option<u64>,
) -> Result<FirstTrainer, TrainError> {
    let config = &request.config;
    let (print, sh_degree_start) = (dataset_print(&start)?, start.sh_degree_start);
    let PagedStart { dataset, trainer, mut tiers, driver } =
        page_start(config, request.quiet, request.dry_run, start, host_mem)?;
    if !request.dry_run {
        tiers.commit_in(&request.out, config);
    }
    let (run, diagnosis, is_locked) = (RunId::draw(), None, false);
    let begun = Begun { print, sh_degree_start, past: None, host_mem, driver, run, diagnosis, is_locked };
    Ok(FirstTrainer { dataset, trainer, tiers, begun })
}

/// First Gaussians in pages, and what draws them. The pages may lie in the tiers, so drop the tiers last.
pub(super) struct PagedStart {
    pub dataset: Dataset,
    pub trainer: Trainer,
    pub tiers: Tiers,
    /// Bytes allocated by the graphics driver.
    pub driver: u64,
}

/// Opens the tiers, the renderer and the first pages. A dry run keeps its pages in memory.
/// Errors: the drive or the device cannot be used, or the source of the Gaussians cannot be read again.
pub(super) fn page_start(
    config: &TrainConfig,
    quiet: bool,
    dry_run: bool,
    start: Start,
    host_mem: Option<u64>,
) -> Result<PagedStart, TrainError> {
    check_first_drive(config, start.rows)?;
    let (renderer, mut options, driver) = begin(quiet, config, &start)?;
    // A resumed run has them in its commit.
    if config.robust_pixels.0.is_none() {
        options.photos.landmarks = start.landmarks()?;
    }
    let [pages, _] = first_pages(config, rows_at_most(config, start.rows));
    let (pager, tiers) = tiers::open(config, pages as usize, host_mem.unwrap_or(u64::MAX), dry_run)?;
    tiers.notes.iter().for_each(|note| crate::tell!("warning: {note}"));
    let (dataset, scene) = start.into_pages(pager, &options, config, host_mem)?;
    let trainer = Trainer::of_scene(scene, &dataset, renderer, options);
    Ok(PagedStart { dataset, trainer, tiers, driver })
}

/// Common start of all runs after reading the scene: warnings, options, the renderer and its memory.
pub(crate) fn begin(
    quiet: bool,
    config: &TrainConfig,
    start: &Start,
) -> Result<(Box<dyn Renderer>, RunOptions, u64), TrainError> {
    for warning in &start.dataset.warnings {
        crate::tell!("warning: {warning}");
    }
    let mut options =
        RunOptions { sh_degree_start: start.sh_degree_start, ..RunOptions::new(config, start.dataset.scene_scale) };
    if !config.first_appearance.is_empty() {
        options.photos.first_appearance = Some(read_values(Path::new(&config.first_appearance))?);
    }
    if start.is_of_random_points() {
        crate::tell!("warning: {}", random_points_warning(config));
    }
    let views = start.dataset.train_views().len();
    if keeps_first_count(&options.strategy, views) {
        crate::tell!("warning: {}", too_few_to_decide(views));
    }
    if config.up == Up::Auto {
        options.up = start.up()?;
    }
    let OpenedDevice { mut renderer, word, driver } = machine::renderer(config, machine::DeviceUse::Training)?;
    // On from here, so that probing allocates what the steps need.
    renderer.weigh_rows(options.strategy.needs_weights())?;
    if options.optimizer_on == OptimizerPlace::Device && renderer.pages().is_none() {
        let problem = format!("the {} backend holds no pages", renderer.name());
        let remedy = "give a GPU with --device, or use --optimizer-on host";
        return Err(InputError::new("--optimizer-on device", problem, remedy).into());
    }
    if options.optimizer_on == OptimizerPlace::Device && !options.strategy.collects_on_device() {
        let problem = "a device that updates the pages collects gradients, not the errors of pixels";
        let remedy = "use --growth-score gradient, or --optimizer-on host";
        return Err(InputError::new("--optimizer-on device", problem, remedy).into());
    }
    if let Some(word) = word.filter(|_| !quiet) {
        crate::tell!("{word}");
    }
    Ok((renderer, options, driver))
}

/// The forecast of a run on a drive of this rate, as its dry run makes it: nothing is written. `None` if a dry run cannot hold the scene.
/// Errors: those of a dry run.
pub fn forecast(scene: &Path, config: &TrainConfig, drive_rate: DriveRate) -> Result<Option<Forecast>, TrainError> {
    let (scene, config) = (scene.to_path_buf(), config.clone());
    let request = RunRequest {
        scene,
        out: PathBuf::new(),
        config,
        dry_run: true,
        existing: Existing::Refuse,
        quiet: true,
        live: None,
        leg: None,
    };
    let host_mem = host_budget(request.config.host_mem.0);
    let start = Start::read(&request.scene, &request.config, host_mem)?;
    let (request, start, _) = adapt_to_photos(request, start, host_mem)?;
    let request = adapt_schedule(&request, &start);
    if plan_text::too_large_for_a_dry_run(&request.config, &start, host_mem).is_some() {
        return Ok(None);
    }
    let FirstTrainer { dataset, mut trainer, tiers, begun } = first_trainer(&request, start, host_mem)?;
    plan_run(&request.config, &dataset, &tiers, &mut trainer, host_mem, begun.driver, drive_rate).map(Some)
}

/// Plans a run, prints the plan, and trains to the end.
pub(super) fn plan_and_train(
    request: &RunRequest,
    dataset: &Dataset,
    mut tiers: Tiers,
    mut trainer: Trainer,
    begun: Begun,
) -> Result<RunOutcome, TrainError> {
    let config = &request.config;
    trainer.start_photos(dataset).iter().for_each(|warning| crate::tell!("warning: {warning}"));
    let forecast = plan_run(config, dataset, &tiers, &mut trainer, begun.host_mem, begun.driver, DriveRate::COMMON)?;
    let plan = plan_text::describe(config, [&request.scene, &request.out], dataset, &trainer, &forecast, &tiers);
    tell_plan(request, &plan);
    let slots = trainer.scene.pager.slot_space().map_or(0, |slots| slots.total);
    let stored = slots * forecast.tiers.frame_bytes;
    check_drive_of_results(config, &request.out, &forecast, stored, begun.past.is_some())?;
    if request.dry_run {
        return Ok(RunOutcome::of_nothing(request.out.clone()));
    }
    let stop = StopFlag::listen().map_err(|e| InputError::io("signals", "listening for Ctrl-C", &e))?;
    let stop = stop.with_deadline(request.leg.and_then(|leg| Instant::now().checked_add(leg)));
    out_folder::make_folder(&request.out)?;
    // Take the lock before removing files; hold it to the end.
    let _lock = if begun.is_locked { None } else { out_folder::lock(&request.out)? };
    if begun.past.is_none() {
        if request.out.join(CONFIG_FILE).is_file() && request.existing == Existing::Overwrite {
            out_folder::write_mark(request)?;
        }
        out_folder::make(&request.out, request.existing)?;
    }
    if let Some(kept) = begun.past.as_ref().and_then(|past| past.keep_result_as.as_ref()) {
        out_folder::keep_result(&request.out, kept)?;
    }
    let outcome = train_into(request, dataset, trainer, &stop, &mut tiers, begun, &forecast);
    // After a leg the next leg resumes, so no hint is needed.
    if tiers.can_resume() && request.leg.is_none() {
        let more = outcome.as_ref().err().map_or(String::new(), TrainError::memory_flags);
        let elsewhere = spill_dir_flag(request);
        crate::tell!(
            "to go on from the last commit: gsscale-train --resume {}{elsewhere}{more}",
            shell_word(&request.out)
        );
    }
    tiers.close().iter().for_each(|word| crate::tell!("warning: {word}"));
    // A process that was killed during its first commit to the output folder left a store without a commit.
    let folder = checkpoint_folder(&request.out);
    if outcome.is_ok() && remove_uncommitted(&folder).is_ok_and(|is_removed| is_removed) {
        let _ = std::fs::remove_dir(folder);
    }
    outcome
}

/// ` --spill-dir FOLDER` if the config.toml could not be rewritten and so does not name the run's checkpoint.
fn spill_dir_flag(request: &RunRequest) -> String {
    let folder = |config: TrainConfig| with_absolute_paths(config).spill_dir;
    let (kept, now) = (TrainConfig::read(&request.out.join(CONFIG_FILE)).map(folder), folder(request.config.clone()));
    let is_known = now.is_empty() || kept.is_ok_and(|kept| kept == now);
    if is_known { String::new() } else { format!(" --spill-dir {}", shell_word(now)) }
}
