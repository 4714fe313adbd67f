//! A run from command line to result: load, check, print the plan, train, evaluate, write.
//!
//! Invariants: 1. the output folder is created after the dataset was read, so bad input leaves no files; 2. a run that
//! is stopped or fails after its first step still writes the PLY of its last good step.

use super::appearance_file::write_appearance;
use super::changes::with_absolute_paths;
use super::checkpoint::Checkpoint;
use super::costs::Meter;
use super::device_memory;
use super::drive_space::{StepWrites, check_first_drive, step_writes};
use super::error::TrainError;
use super::facts::{Resolved, write_config};
use super::forecast::{Forecast, Measured, Reach, mean_pixels, reach};
use super::held_out::{keeps_first_count, too_few_to_decide};
use super::machine;
use super::memory::list_bytes;
use super::memory::{host_budget, host_bytes_now, host_bytes_peak, rows_at_most};
use super::out_folder::{self, Existing};
use super::page_map::write_page_map;
use super::places::absolute;
use super::plan_text;
use super::preflight;
use super::probe::{Probe, estimate};
use super::progress::{Count, Progress};
use super::report::StepCosts;
use super::report::{MetricsLog, Summary, TestMetrics, write_summary};
use super::signals::StopFlag;
use super::soundness::no_view_sees;
use super::start::Start;
use super::start::dataset_print;
use super::tiers::{self, Tiers};
use super::trainer::Trainer;
use super::training_loop::LoopOutputs;
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::checkpoint::run_state::{DatasetPrint, Origin, RunIdentity};
use crate::config::choice::{Chosen, Device, LogFormat};
use crate::config::file::TrainConfig;
use crate::config::limits::{self, RunOptions};
use crate::config::residence::Residence;
use crate::config::values::Up;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::exchange::ply::{ExportFrame, PlyWritten, write_transform};
use crate::optim::method::OptimizerPlace;
use crate::page::tool::uncommitted::remove_uncommitted;
use crate::render::Renderer;
use crate::report::run_files::{
    APPEARANCE_FILE, CONFIG_FILE, EVENTS_FOLDER, METRICS_FILE, PAGES_FILE, PICTURES_FOLDER, SUMMARY_FILE,
};
use crate::report::run_report::write_run_report;
use crate::scene::partition::first_fill;
use std::path::{Path, PathBuf};

/// The run to start.
#[derive(Debug, Clone)]
pub struct RunRequest {
    /// Scene folder (or transforms.json).
    pub scene: PathBuf,
    /// Output folder; may be empty for a dry run.
    pub out: PathBuf,
    /// Checked config.
    pub config: TrainConfig,
    /// Print the plan and stop.
    pub dry_run: bool,
    /// Treatment of an existing output folder.
    pub existing: Existing,
    /// Print only warnings and errors.
    pub quiet: bool,
}

/// How a run ended.
#[derive(Debug, Clone)]
pub struct RunOutcome {
    /// Content of summary.json; `None` for a dry run.
    pub summary: Option<Summary>,
    /// Exit code of the process: 0, or 130/143 after a stop request.
    pub exit_code: i32,
    /// The output folder.
    pub out: PathBuf,
}

/// The past of a resumed run.
pub(super) struct Past {
    /// The config to keep from now on.
    pub config: TrainConfig,
    /// Length of its metrics.
    pub metrics_bytes: u64,
    /// Steps done.
    pub step: u32,
    /// Numbers have changed, which is committed at once.
    pub has_changed: bool,
    /// Content of its config.toml; `None` if the file is missing and must be restored.
    pub file: Option<(TrainConfig, Resolved)>,
    /// Number of its first Gaussians.
    pub first_rows: u64,
}

/// Facts with which a run begins or resumes.
pub(super) struct Begun {
    /// Digest of the dataset.
    pub print: DatasetPrint,
    /// SH degree of the first step.
    pub sh_degree_start: u8,
    /// The past of a resumed run.
    pub past: Option<Past>,
    /// Budget, bytes.
    pub host_mem: Option<u64>,
    /// Bytes allocated by the graphics driver.
    pub driver: u64,
    /// Identity of the run.
    pub run: RunId,
}

/// Runs a request from beginning to end.
///
/// # Errors
/// Bad input (leaves no files), or a failure while training (the last good step is written).
pub fn run(request: &RunRequest) -> Result<RunOutcome, TrainError> {
    let config = &request.config;
    config.check()?;
    machine::set_up(config)?;
    if !request.dry_run {
        out_folder::check(&request.out, request.existing)?;
    }
    let host_mem = host_budget(config);
    let start = Start::read(&request.scene, config, host_mem)?;
    let sh_degree_start = start.sh_degree_start;
    if let Some(known) = plan_text::too_large_for_a_dry_run(config, &start, host_mem).filter(|_| request.dry_run) {
        if !request.quiet {
            crate::say!("{known}");
        }
        return Ok(RunOutcome { summary: None, exit_code: 0, out: request.out.clone() });
    }
    if let Some(spill_dir) = config.residence().spill_dir().filter(|_| !request.dry_run)
        && remove_uncommitted(spill_dir, false)?
    {
        eprintln!("removing pages in {} of a run that was cut off before its first commit", spill_dir.display());
    }
    let FirstTrainer { dataset, trainer, tiers, print, driver } = first_trainer(request, start, host_mem)?;
    let run = RunId::draw();
    let begun = Begun { print, sh_degree_start, past: None, host_mem, driver, run };
    plan_and_train(request, &dataset, tiers, trainer, begun)
}

/// A trainer before its first step, with all that belongs to it. The trainer's pages may lie in the tiers, so drop them
/// after it.
pub(super) struct FirstTrainer {
    /// Views and frame.
    pub dataset: Dataset,
    /// The trainer.
    pub trainer: Trainer,
    /// Where its pages live.
    pub tiers: Tiers,
    /// Digest of the dataset.
    pub print: DatasetPrint,
    /// Bytes allocated by the graphics driver.
    pub driver: u64,
}

/// Makes the first pages of a scene, and their trainer.
///
/// # Errors
/// The drive or the device cannot be used, or the source of the Gaussians cannot be read again.
pub(super) fn first_trainer(
    request: &RunRequest,
    start: Start,
    host_mem: Option<u64>,
) -> Result<FirstTrainer, TrainError> {
    let config = &request.config;
    check_first_drive(config, start.rows)?;
    let (renderer, options, driver) = begin(request.quiet, config, &start)?;
    let fill = first_fill(config.page_rows as usize, options.strategy.grows());
    let pages = rows_at_most(config, start.rows).div_ceil(fill as u64);
    // Drop the tiers after the trainer, whose pages may lie there.
    let (pager, mut tiers) = tiers::open(config, pages as usize, host_mem.unwrap_or(u64::MAX), request.dry_run)?;
    tiers.notes.iter().for_each(|note| eprintln!("warning: {note}"));
    if !request.dry_run {
        tiers.commit_in(&request.out, config);
    }
    let print = dataset_print(&start)?;
    let (dataset, scene) = start.into_pages(pager, &options, config, host_mem)?;
    let trainer = Trainer::of_scene(scene, &dataset, renderer, options);
    Ok(FirstTrainer { dataset, trainer, tiers, print, driver })
}

/// Common start of all runs after reading the scene: warnings, options, the renderer and its memory.
pub(super) fn begin(
    quiet: bool,
    config: &TrainConfig,
    start: &Start,
) -> Result<(Box<dyn Renderer>, RunOptions, u64), TrainError> {
    for warning in &start.dataset.warnings {
        eprintln!("warning: {warning}");
    }
    if keeps_first_count(config, &start.dataset) {
        eprintln!("warning: {}", too_few_to_decide(&start.dataset));
    }
    let mut options =
        RunOptions { sh_degree_start: start.sh_degree_start, ..RunOptions::new(config, start.dataset.scene_scale) };
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
    if options.optimizer_on == OptimizerPlace::Device && options.strategy.needs_weights() {
        let problem = "a device that updates the pages collects gradients, not the blending weights of Gaussians";
        let remedy = "use --growth-score gradient with --recycle 0, or --optimizer-on host";
        return Err(InputError::new("--optimizer-on device", problem, remedy).into());
    }
    // Without a search for a device, a difference is the noise of the allocator.
    let driver = match config.device {
        Device::Cpu => 0,
        Device::Gpu(_) => host_bytes_now().unwrap_or(0).saturating_sub(before),
    };
    if let Some(word) = word.filter(|_| !quiet) {
        eprintln!("{word}");
    }
    Ok((renderer, options, driver))
}

/// The forecast of a run, as its dry run makes it: nothing is written. `None` if a dry run cannot hold the scene.
///
/// # Errors
/// Those of a dry run.
pub fn forecast(scene: &Path, config: &TrainConfig) -> Result<Option<Forecast>, TrainError> {
    let (scene, config) = (scene.to_path_buf(), config.clone());
    let request =
        RunRequest { scene, out: PathBuf::new(), config, dry_run: true, existing: Existing::Refuse, quiet: true };
    let host_mem = host_budget(&request.config);
    let start = Start::read(&request.scene, &request.config, host_mem)?;
    if plan_text::too_large_for_a_dry_run(&request.config, &start, host_mem).is_some() {
        return Ok(None);
    }
    let FirstTrainer { dataset, mut trainer, tiers, driver, .. } = first_trainer(&request, start, host_mem)?;
    plan(&request.config, &dataset, &tiers, &mut trainer, (host_mem, driver)).map(Some)
}

/// Chooses the frames of a run, refuses what cannot fit, and forecasts the rest. `driver`: bytes of the graphics driver.
fn plan(
    config: &TrainConfig,
    dataset: &Dataset,
    tiers: &Tiers,
    trainer: &mut Trainer,
    (host_mem, driver): (Option<u64>, u64),
) -> Result<Forecast, TrainError> {
    trainer.renderer.set_list_bytes(host_mem.map(list_bytes));
    let largest = preflight::allow_largest_view(config, dataset, trainer, host_mem);
    if largest.is_none() {
        return Err(no_view_sees(dataset, trainer.scene.rows()).into());
    }
    let probe = Probe::of_run(dataset, trainer, largest, driver);
    let (rows, steps_done) = (trainer.scene.rows(), trainer.steps_done());
    let pixels = mean_pixels(dataset.train_views().iter().map(|&view| &dataset.views[view].camera));
    let (last, known) = match keeps_first_count(config, dataset) {
        true => (rows, Reach::Kept),
        false => reach(config, rows, pixels, steps_done),
    };
    let (mut memory, times) = estimate(config, dataset, trainer, &probe, last)?;
    device_memory::check(config, &memory)?;
    let plan = preflight::plan_tiers(config, dataset, trainer, tiers, host_mem, &mut memory)?;
    let growth = last as f64 / rows.max(1) as f64;
    let writes = match plan.frames {
        Some(frames) => step_writes(config, dataset, trainer, frames.min(plan.pages[0].max(1)) as usize, growth),
        None => StepWrites::default(),
    };
    let measured = Measured {
        rows,
        reach: (last, known),
        steps_done,
        view_seconds: times.seconds,
        visible_share: times.visible_share,
        writes,
    };
    Ok(Forecast::new(config, memory, plan, &measured, host_mem))
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
    let forecast = plan(config, dataset, &tiers, &mut trainer, (begun.host_mem, begun.driver))?;
    if !request.quiet {
        let of_device = device_memory::describe(config, forecast.memory_at_end());
        let of_tiers = plan_text::describe(&forecast, &tiers) + &of_device;
        let plan = describe(request, dataset, &trainer, &plan_text::growth(&forecast), &of_tiers);
        match request.dry_run {
            // What was asked for goes to standard output.
            true => crate::say!("{plan}"),
            false => eprintln!("{plan}"),
        }
    }
    if request.dry_run {
        return Ok(RunOutcome { summary: None, exit_code: 0, out: request.out.clone() });
    }
    let stop = StopFlag::listen().map_err(|e| InputError::io("signals", "listening for Ctrl-C", &e))?;
    out_folder::make_folder(&request.out)?;
    // Take the lock before removing files; hold it to the end.
    let _lock = out_folder::lock(&request.out)?;
    if begun.past.is_none() {
        out_folder::make(&request.out, request.existing)?;
    }
    let outcome = train_into(request, dataset, trainer, (&stop, &mut tiers), begun);
    if tiers.can_resume() {
        let more = outcome.as_ref().err().map_or(String::new(), TrainError::memory_flags);
        let elsewhere = spill_dir_flag(request);
        eprintln!("to go on from the last commit: gsscale-train --resume {}{elsewhere}{more}", request.out.display());
    }
    tiers.close().iter().for_each(|word| eprintln!("warning: {word}"));
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

/// The config to keep: with choices resolved and absolute paths.
fn resolved_config(config: &TrainConfig, trainer: &Trainer) -> TrainConfig {
    let view_order = Chosen(Some(trainer.view_order().order()));
    let up = trainer.options.up.map_or(Up::Keep, Up::Along);
    let optimizer_on = Chosen(Some(trainer.options.optimizer_on));
    with_absolute_paths(TrainConfig { view_order, up, optimizer_on, ..config.clone() })
}

/// Writes config.toml (on resume only if it changed); returns the origin for all commits.
fn begin_files(
    request: &RunRequest,
    dataset: &Dataset,
    trainer: &Trainer,
    begun: &Begun,
    made_spill_dir: bool,
) -> InputResult<Origin> {
    let simd = limits::simd_path(&request.config).name().to_string();
    let path = request.out.join(CONFIG_FILE);
    let config = match &begun.past {
        Some(past) => {
            // It belongs to the Gaussians before the change.
            out_folder::remove_evaluation(&request.out)?;
            let made_again = Resolved { gaussians: past.first_rows, ..resolved(request, dataset, trainer, begun.run) };
            let before = past.file.as_ref().map_or(&made_again, |(_, facts)| facts);
            let facts = Resolved { run: begun.run, scene: absolute(&request.scene), ..before.clone() };
            let kept = (past.config.clone(), facts);
            if past.file.as_ref() != Some(&kept) {
                write_config(&path, &kept.0, &kept.1)?;
            }
            kept.0
        }
        None => {
            let kept = resolved_config(&request.config, trainer);
            let facts = resolved(request, dataset, trainer, begun.run);
            write_config(&path, &kept, &Resolved { made_spill_dir, ..facts })?;
            kept
        }
    };
    let fail = |e: toml::ser::Error| InputError::new(&path, e.to_string(), "report this as a bug");
    let config = toml::to_string(&config).map_err(fail)?;
    let [out, scene] = [&request.out, &request.scene].map(|path| absolute(path).to_string_lossy().into_owned());
    let run = RunIdentity { id: begun.run, out, scene };
    Ok(Origin { config, simd, sh_degree_start: begun.sh_degree_start, dataset: begun.print.clone(), run })
}

fn train_into(
    request: &RunRequest,
    dataset: &Dataset,
    mut trainer: Trainer,
    (stop, tiers): (&StopFlag, &mut Tiers),
    begun: Begun,
) -> Result<RunOutcome, TrainError> {
    let (config, out) = (&request.config, &request.out);
    let origin = begin_files(request, dataset, &trainer, &begun, tiers.made_spill_dir())?;
    let mut metrics = open_metrics(config.log, out, begun.past.as_ref())?;
    let keeps = tiers.keeps_checkpoint();
    let mut checkpoint = tiers.checkpoint.as_mut();
    if let Some(checkpoint) = &mut checkpoint {
        checkpoint.set_origin(origin);
        if begun.past.is_some_and(|p| p.has_changed) {
            let committed = checkpoint.commit(&mut trainer, &mut metrics);
            committed.or_else(|why| checkpoint.make_space(&mut trainer, &mut metrics, stop, why))?;
        }
    }
    let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    let mut progress = Progress::new(config.steps, request.quiet).after(trainer.steps_done());
    let meter = Meter::start(&trainer);
    metrics.start_clock(trainer.train_seconds());
    let mut outputs = LoopOutputs { out, metrics: &mut metrics, progress: &mut progress, stop, checkpoint };
    let looped = trainer.run(dataset, &targets, &mut outputs);
    let costs = meter.stop(&trainer, &*tiers, metrics.cpu_seconds());
    let ply = Trainer::ply_path(out);
    let saved = trainer.save(dataset, &ply);
    // Return the error that ended the run; a failure to write its last rows is an additional warning.
    let (looped, written) = match (looped, saved) {
        (Err(error), Err(other)) => {
            eprintln!("warning: {} cannot be written: {other}", ply.display());
            return Err(error);
        }
        (looped, saved) => (looped, saved?),
    };
    warn_of_ply(config, &written, &ply);
    write_transform(&ply, &trainer.ply_meta(dataset), written.frame)?;
    // A stopped run writes its files at once, without evaluation; gsscale-eval can evaluate it later.
    let asked = stop.exit_code();
    let tested = looped.and_then(|()| match asked {
        None => evaluate_result(request, dataset, &targets, &mut trainer, &mut metrics),
        Some(_) => Ok(None),
    });
    if let (true, Ok(_), Some(checkpoint)) = (keeps, &tested, tiers.checkpoint.as_mut()) {
        // Commit again, with the result of the evaluation.
        checkpoint.commit_or_warn(&mut trainer, &mut metrics)?;
    }
    let summary = Summary {
        gaussians: written.rows + written.skipped,
        test: tested.as_ref().ok().copied().flatten(),
        // A run without its evaluation is not finished: a resume evaluates it.
        finished: trainer.steps_done() == config.steps && tested.is_ok() && asked.is_none(),
        outlier_views: trainer.outlier_views(dataset),
        costs,
        commits: tiers.checkpoint.as_ref().map(Checkpoint::report),
        ..summary_of(request, &trainer)
    };
    write_summary(&out.join(SUMMARY_FILE), &summary)?;
    write_page_map(&out.join(PAGES_FILE), dataset, &trainer)?;
    write_appearance(&out.join(APPEARANCE_FILE), dataset, &trainer)?;
    write_report(request)?;
    tested?;
    tiers.is_done = summary.finished;
    Ok(RunOutcome { summary: Some(summary), exit_code: stop.exit_code().unwrap_or(0), out: out.clone() })
}

/// Evaluates the result, with pictures, and logs the evaluation.
fn evaluate_result(
    request: &RunRequest,
    dataset: &Dataset,
    targets: &TargetCache,
    trainer: &mut Trainer,
    metrics: &mut MetricsLog,
) -> Result<Option<TestMetrics>, TrainError> {
    let shown = Count::new("held-out views compared", dataset.test_views().len() as u32, request.quiet);
    let pictures = request.out.join(PICTURES_FOLDER);
    // A run that was killed after the commit of its last evaluation has the line already.
    let is_logged = trainer.state.test.is_some_and(|test| test.step == trainer.state.step);
    let test = trainer.evaluate(dataset, targets, Some(&pictures), &|done| shown.show(done))?;
    if let Some(test) = test.filter(|_| !is_logged) {
        metrics.write_evaluation(trainer.steps_done(), test, &pictures)?;
    }
    Ok(test)
}

fn write_report(request: &RunRequest) -> InputResult<()> {
    let shown = std::cell::OnceCell::new();
    let show = |done: usize, all: usize| {
        let count = || Count::new("pictures put into the report", all as u32, request.quiet);
        shown.get_or_init(count).show(done as u32);
    };
    write_run_report(&request.out, &show)?;
    Ok(())
}

/// The log of metrics of a new run, or of a run that resumes after `past`.
fn open_metrics(log: LogFormat, out: &Path, past: Option<&Past>) -> InputResult<MetricsLog> {
    let metrics = MetricsLog::open(&out.join(METRICS_FILE), past.map(|past| past.metrics_bytes))?;
    match log {
        LogFormat::Json => Ok(metrics),
        LogFormat::Tensorboard => metrics.with_events(&out.join(EVENTS_FOLDER), past.map(|past| past.step + 1)),
    }
}

/// Warns if the final PLY differs from the request.
fn warn_of_ply(config: &TrainConfig, written: &PlyWritten, ply: &Path) {
    if written.frame == ExportFrame::Local && config.export_frame == ExportFrame::Dataset {
        eprintln!(
            "warning: dataset coordinates exceed the precision of f32, so {} holds local positions; \
             its comments give origin and scale",
            ply.display()
        );
    }
    if written.skipped > 0 {
        eprintln!("warning: {} Gaussians are not finite and are not in {}", written.skipped, ply.display());
    }
}

/// The part of the summary that the trainer knows: not finished, not evaluated.
fn summary_of(request: &RunRequest, trainer: &Trainer) -> Summary {
    let (rows_skipped, steps_skipped) = trainer.skipped();
    Summary {
        steps: trainer.steps_done(),
        gaussians: trainer.scene.rows(),
        train_seconds: trainer.train_seconds(),
        host_bytes_peak: host_bytes_peak().unwrap_or(0),
        test: None,
        scene: request.scene.clone(),
        version: env!("CARGO_PKG_VERSION").to_string(),
        ssim_variant: request.config.ssim_variant.to_string(),
        finished: false,
        rows_skipped_non_finite: rows_skipped,
        steps_skipped_non_finite: steps_skipped,
        outlier_views: Vec::new(),
        costs: StepCosts::default(),
        growth: trainer.growth().to_vec(),
        tiers: trainer.tier_traffic(),
        commits: None,
    }
}

fn resolved(request: &RunRequest, dataset: &Dataset, trainer: &Trainer, run: RunId) -> Resolved {
    Resolved {
        version: env!("CARGO_PKG_VERSION").to_string(),
        run,
        scene: absolute(&request.scene),
        simd: limits::simd_path(&request.config).name().to_string(),
        threads: rayon::current_num_threads(),
        device: trainer.renderer.device(),
        train_views: dataset.train_views().len(),
        test_views: dataset.test_views().len(),
        gaussians: trainer.scene.rows(),
        origin: dataset.frame.origin.to_array(),
        scale: dataset.frame.scale,
        scene_scale: f64::from(dataset.scene_scale) * dataset.frame.scale,
        made_spill_dir: false,
    }
}

/// Text of the plan: dataset, start and tiers.
fn describe(request: &RunRequest, dataset: &Dataset, trainer: &Trainer, growth: &str, tiers: &str) -> String {
    let (config, rows) = (&request.config, trainer.scene.rows());
    let largest = dataset.views.iter().map(|v| &v.camera).max_by_key(|c| c.pixels());
    let size = largest.map_or(String::new(), |c| format!("{}x{}", c.width, c.height));
    let results = match request.out.as_os_str().is_empty() {
        true => String::new(),
        false => format!(", results in {}", request.out.display()),
    };
    let commits = match config.residence() {
        Residence::Memory => "to checkpoint/ in the results (see --commit-every)",
        Residence::Frames => "nowhere: --frames without --spill-dir is for comparisons",
        Residence::SpillDir(_) => "to the spill directory (see --commit-every)",
    };
    let text = format!(
        "scene   {}: {} views to train on, {} held out, at most {size}\n\
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
