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
use crate::config::file::TrainConfig;
use crate::config::limits::{self, RunOptions};
use crate::config::new_run;
use crate::config::values::{Device, Residence, Up};
use crate::dataset::loader::Dataset;
use crate::optim::method::OptimizerPlace;
use crate::page::folder::measure::DriveRate;
use crate::page::tool::uncommitted::{check_usable, remove_uncommitted};
use crate::render::Renderer;
use crate::report::run_files::CONFIG_FILE;
use crate::scene::partition::first_fill;
use crate::train::error::TrainError;
use crate::train::inputs::machine;
use crate::train::inputs::machine::StopFlag;
use crate::train::memory::{host_budget, host_bytes_now};
use crate::train::preflight::forecast::{Forecast, check_drive_of_results, check_first_drive, plan_run};
use crate::train::preflight::plan::rows_at_most;
use crate::train::preflight::{device_memory, plan_text};
use crate::train::start::first_scene::{Start, dataset_print};
use crate::train::start::tiers::{self, Tiers};
use crate::train::state::trainer::Trainer;
use crate::train::state::turns::{keeps_first_count, too_few_to_decide};
use std::path::{Path, PathBuf};

/// Runs a request from beginning to end.
/// Errors: bad input (leaves no files), or a failure while training (the last good step is written).
pub fn run(request: &RunRequest) -> Result<RunOutcome, TrainError> {
    let config = &request.config;
    config.check()?;
    machine::set_up(config)?;
    check_folders(request)?;
    let _mark = Beginning::mark(request)?;
    let host_mem = host_budget(config.host_mem.0);
    let start = Start::read(&request.scene, config, host_mem)?;
    let request = &adapt_schedule(request, &start);
    let config = &request.config;
    if let Some(known) = plan_text::too_large_for_a_dry_run(config, &start, host_mem).filter(|_| request.dry_run) {
        check_first_drive(config, start.rows)?;
        if !request.quiet {
            crate::say!("{known}");
        }
        return Ok(RunOutcome::of_nothing(request.out.clone()));
    }
    let (dataset, trainer, tiers, begun) = first_trainer(request, start, host_mem)?;
    plan_and_train(request, &dataset, tiers, trainer, begun)
}

/// The request, with a schedule that suits the number of training photos.
fn adapt_schedule(request: &RunRequest, start: &Start) -> RunRequest {
    let mut request = request.clone();
    let photos = start.dataset.train_views().len();
    if let Some(steps) = new_run::adapt_schedule(&mut request.config, photos).filter(|_| !request.quiet) {
        crate::say!(
            "photos  {photos} to train on: the rates fall until step {steps}, and stay low (see --schedule-steps)"
        );
    }
    request
}

/// Refuses folders in which the run may not begin, before anything else is read. Changes nothing, so dry runs refuse what runs refuse.
fn check_folders(request: &RunRequest) -> Result<(), TrainError> {
    out_folder::check(&request.out, request.existing)?;
    match request.config.residence().spill_dir() {
        Some(spill_dir) => Ok(check_usable(spill_dir, false)?),
        None => Ok(()),
    }
}

/// Removes what a run that was cut off before its first commit left in the spill directory.
fn clear_spill_dir(config: &TrainConfig) -> Result<(), TrainError> {
    if let Some(spill_dir) = config.residence().spill_dir()
        && remove_uncommitted(spill_dir, false)?
    {
        crate::tell!("removing pages in {} of a run that was cut off before its first commit", spill_dir.display());
    }
    Ok(())
}

/// Makes the first pages of a scene, and their trainer before its first step. The trainer's pages may lie in the tiers, so drop them after it.
/// Errors: the drive or the device cannot be used, or the source of the Gaussians cannot be read again.
pub(super) fn first_trainer(
    request: &RunRequest,
    start: Start,
    host_mem: Option<u64>,
) -> Result<(Dataset, Trainer, Tiers, Begun), TrainError> {
    let config = &request.config;
    if !request.dry_run {
        clear_spill_dir(config)?;
    }
    check_first_drive(config, start.rows)?;
    let (renderer, options, driver) = begin(request.quiet, config, &start)?;
    let fill = first_fill(config.page_rows as usize, options.strategy.grows());
    let pages = rows_at_most(config, start.rows).div_ceil(fill as u64);
    let (pager, mut tiers) = tiers::open(config, pages as usize, host_mem.unwrap_or(u64::MAX), request.dry_run)?;
    tiers.notes.iter().for_each(|note| crate::tell!("warning: {note}"));
    if !request.dry_run {
        tiers.commit_in(&request.out, config);
    }
    let (print, sh_degree_start) = (dataset_print(&start)?, start.sh_degree_start);
    let begun = Begun { print, sh_degree_start, past: None, host_mem, driver, run: RunId::draw() };
    let (dataset, scene) = start.into_pages(pager, &options, config, host_mem)?;
    let trainer = Trainer::of_scene(scene, &dataset, renderer, options);
    Ok((dataset, trainer, tiers, begun))
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
    let views = start.dataset.train_views().len();
    if keeps_first_count(&options.strategy, views) {
        crate::tell!("warning: {}", too_few_to_decide(views));
    }
    if config.up == Up::Auto {
        options.up = start.up()?;
    }
    let before = host_bytes_now().unwrap_or(0);
    let (mut renderer, word) = machine::renderer(config)?;
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
    // Without a search for a device, a difference is the noise of the allocator.
    let driver = match config.device {
        Device::Cpu => 0,
        Device::Gpu(_) => host_bytes_now().unwrap_or(0).saturating_sub(before),
    };
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
    };
    let host_mem = host_budget(request.config.host_mem.0);
    let start = Start::read(&request.scene, &request.config, host_mem)?;
    let request = adapt_schedule(&request, &start);
    if plan_text::too_large_for_a_dry_run(&request.config, &start, host_mem).is_some() {
        return Ok(None);
    }
    let (dataset, mut trainer, tiers, begun) = first_trainer(&request, start, host_mem)?;
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
    if !request.quiet {
        let of_device = device_memory::describe(config, forecast.memory_at_end());
        let of_tiers = plan_text::describe(&forecast, &tiers) + &of_device;
        let plan = describe(request, dataset, &trainer, &plan_text::growth(&forecast), &of_tiers);
        let plan = plan_text::folded(&plan);
        match request.dry_run {
            // What was asked for goes to standard output.
            true => crate::say!("{plan}"),
            false => crate::tell!("{plan}"),
        }
    }
    let slots = trainer.scene.pager.slot_space().map_or(0, |slots| slots.total);
    let stored = slots * forecast.tiers.frame_bytes;
    check_drive_of_results(config, &request.out, &forecast, stored, begun.past.is_some())?;
    if request.dry_run {
        return Ok(RunOutcome::of_nothing(request.out.clone()));
    }
    let stop = StopFlag::listen().map_err(|e| InputError::io("signals", "listening for Ctrl-C", &e))?;
    out_folder::make_folder(&request.out)?;
    // Take the lock before removing files; hold it to the end.
    let _lock = out_folder::lock(&request.out)?;
    if begun.past.is_none() {
        if request.out.join(CONFIG_FILE).is_file() && request.existing == Existing::Overwrite {
            out_folder::write_mark(request)?;
        }
        out_folder::make(&request.out, request.existing)?;
    }
    let outcome = train_into(request, dataset, trainer, &stop, &mut tiers, begun, &forecast);
    if tiers.can_resume() {
        let more = outcome.as_ref().err().map_or(String::new(), TrainError::memory_flags);
        let elsewhere = spill_dir_flag(request);
        crate::tell!(
            "to go on from the last commit: gsscale-train --resume {}{elsewhere}{more}",
            request.out.display()
        );
    }
    tiers.close().iter().for_each(|word| crate::tell!("warning: {word}"));
    outcome
}

/// ` --spill-dir FOLDER` if the config.toml could not be rewritten and so does not name the run's checkpoint.
fn spill_dir_flag(request: &RunRequest) -> String {
    let [kept, now] = [TrainConfig::read(&request.out.join(CONFIG_FILE)), Ok(request.config.clone())]
        .map(|config| config.map(|config| with_absolute_paths(config).spill_dir));
    match now {
        Ok(now) if !now.is_empty() && !kept.is_ok_and(|kept| kept == now) => format!(" --spill-dir {now}"),
        _ => String::new(),
    }
}

/// Text of the plan: dataset, start and tiers.
fn describe(request: &RunRequest, dataset: &Dataset, trainer: &Trainer, growth: &str, tiers: &str) -> String {
    let (config, rows) = (&request.config, trainer.scene.rows());
    let largest = dataset.views.iter().map(|v| &v.camera).max_by_key(|c| c.pixels());
    let size = largest.map_or(String::new(), |c| format!("{}x{} pixels", c.width, c.height));
    let results = match request.out.as_os_str().is_empty() {
        true => String::new(),
        false => format!(", results in {}", request.out.display()),
    };
    let commits = match config.residence() {
        Residence::Memory => "to checkpoint/ in the results (see --commit-every)",
        Residence::Frames => "nowhere: --frames without --spill-dir is for comparisons",
        Residence::SpillDir(_) => "to the spill directory (see --commit-every)",
    };
    let of_photos = trainer.photos.iter().filter_map(|parameter| parameter.plan_text());
    let photos: String = of_photos.map(|text| format!("photos  {text}\n")).collect();
    let text = format!(
        "scene   {}: {} views to train on, {} held out, at most {size}\n\
         {photos}\
         start   {} Gaussians, SH degree {}{growth}\n\
         run     {} steps on {} threads ({}), rendered by {}{results}\n\
         commit  {commits}\n\
         {tiers}",
        request.scene.display(),
        dataset.train_views().len(),
        dataset.test_views().len(),
        rows,
        config.sh_degree,
        config.steps,
        rayon::current_num_threads(),
        limits::simd_path(config).name(),
        trainer.renderer.device(),
    );
    text.trim_end().to_string()
}
