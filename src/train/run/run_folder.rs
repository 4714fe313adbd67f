//! A run in its output folder: the files at its beginning, the loop, the files at its end.
//!
//! Not here: whether the folder may be used ([`super::out_folder`]), the plan ([`super::begin`]), what the loop writes on its way.
//!
//! Invariants: 1. a run that is stopped or fails after its first step still writes the PLY of its last good step; 2. the
//! error that ended a run is the one that is returned; 3. a resumed run keeps the identity and the first facts of its past; 4. a file for
//! viewers that cannot be written costs the run neither its evaluation nor its report, and leaves it to be resumed.

use super::changes::with_absolute_paths;
use super::live::LivePage;
use super::out_folder::{self, remove_mark, scene_name};
use super::request::{RunOutcome, RunRequest};
use super::training_loop::TrainingLoop;
use crate::base::count::Count;
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::ids::PageNo;
use crate::base::machine::host_bytes_peak;
use crate::base::whole_file::write_whole;
use crate::checkpoint::run_state::{DatasetPrint, Origin, RunIdentity};
use crate::config::file::{Resolved, TrainConfig, write_config};
use crate::config::limits;
use crate::config::values::{Chosen, LogFormat, Up};
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::exchange::format::ExportFormat;
use crate::exchange::meta::ExportFrame;
use crate::exchange::sink::Written;
use crate::paging::stats::PagerStats;
use crate::photos;
use crate::photos::diagnosis::Diagnosis;
use crate::report::page_map::PageTile;
use crate::report::run_files::{
    CONFIG_FILE, DIAGNOSIS_FILE, EVENTS_FOLDER, METRICS_FILE, PAGES_FILE, PICTURES_FOLDER, SUMMARY_FILE,
};
use crate::report::run_report::write_run_report;
use crate::train::commits::checkpoint::{Checkpoint, warn_of_space};
use crate::train::commits::results::{ExportChoice, Results, export, scene_meta};
use crate::train::error::TrainError;
use crate::train::inputs::machine::absolute;
use crate::train::inputs::signals::{DEADLINE_CODE, StopFlag};
use crate::train::log::progress::RunProgress;
use crate::train::log::report::{ExportFacts, MetricsLog, StepCosts, Summary, TestMetrics, write_summary};
use crate::train::preflight::forecast::Forecast;
use crate::train::start::tiers::{Tiers, commit_options};
use crate::train::state::eval::warn_of_held_out;
use crate::train::state::trainer::Trainer;
use crate::train::step::soundness::refuse_all_masked;
use std::cell::OnceCell;
use std::path::{Path, PathBuf};
use std::time::Duration;

pub(super) struct PastRun {
    /// The config to keep from now on.
    pub config: TrainConfig,
    pub metrics_bytes: u64,
    /// Steps done.
    pub step: u32,
    /// Numbers have changed, which is committed at once.
    pub has_changed: bool,
    /// Content of its config.toml; `None` if the file is missing and must be restored.
    pub file: Option<(TrainConfig, Resolved)>,
    /// Number of its first Gaussians.
    pub first_rows: u64,
    /// Second name that its result gets before the first step; `None` if it has one.
    pub keep_result_as: Option<PathBuf>,
}

/// Facts with which a run begins or resumes.
pub(super) struct Begun {
    pub print: DatasetPrint,
    /// SH degree of the first step.
    pub sh_degree_start: u8,
    pub past: Option<PastRun>,
    /// Budget, bytes.
    pub host_mem: Option<u64>,
    /// Bytes allocated by the graphics driver.
    pub driver: u64,
    pub run: RunId,
    /// What the photos of a new run said before training, if anything.
    pub diagnosis: Option<Diagnosis>,
    /// The caller holds the lock of the output folder.
    pub is_locked: bool,
}

/// Costs of the steps since the pager had counted `before`.
fn costs_since(before: &PagerStats, trainer: &Trainer, tiers: &Tiers, metrics: &MetricsLog) -> StepCosts {
    let stats = trainer.scene.pager.stats();
    StepCosts {
        train_cpu_seconds: metrics.cpu_seconds(),
        train_bytes_read: stats.bytes_read - before.bytes_read,
        train_bytes_written: stats.bytes_written - before.bytes_written,
        train_stall_seconds: stats.stall_seconds - before.stall_seconds,
        device_bytes_peak: trainer.renderer.traffic().device_bytes_peak,
        drive_bytes_peak: tiers.drive_bytes(),
        forecast: None,
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
            // What changes were accepted of.
            let facts = Resolved {
                run: begun.run,
                scene: absolute(&request.scene),
                train_views: made_again.train_views,
                test_views: made_again.test_views,
                ..before.clone()
            };
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
            if let Some(diagnosis) = &begun.diagnosis {
                diagnosis.write_file(&request.out.join(DIAGNOSIS_FILE))?;
            }
            kept
        }
    };
    let fail = |e: toml::ser::Error| InputError::new(&path, e.to_string(), "report this as a bug");
    let config = toml::to_string(&config).map_err(fail)?;
    let [out, scene] = [&request.out, &request.scene].map(|path| absolute(path).to_string_lossy().into_owned());
    let run = RunIdentity { id: begun.run, out, scene };
    Ok(Origin { config, simd, sh_degree_start: begun.sh_degree_start, dataset: begun.print.clone(), run })
}

/// Trains to the end, and writes the results. `stop` asks for an early end.
/// Errors: a failure while training, after the last good step was written, or the folder cannot be written.
pub(super) fn train_into(
    request: &RunRequest,
    dataset: &Dataset,
    mut trainer: Trainer,
    stop: &StopFlag,
    tiers: &mut Tiers,
    begun: Begun,
    forecast: &Forecast,
) -> Result<RunOutcome, TrainError> {
    let (config, out) = (&request.config, &request.out);
    let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    refuse_all_masked(dataset, &targets)?;
    let origin = begin_files(request, dataset, &trainer, &begun, tiers.made_spill_dir())?;
    remove_mark(out);
    let mut metrics = open_metrics(config.log, out, begun.past.as_ref())?;
    let mut checkpoint = tiers.checkpoint.as_mut();
    if let Some(checkpoint) = &mut checkpoint {
        checkpoint.set_origin(origin);
        if begun.past.is_some_and(|p| p.has_changed) {
            let committed = checkpoint.commit(&mut trainer, &mut metrics);
            committed.or_else(|why| checkpoint.make_space(&mut trainer, &mut metrics, stop, why))?;
        }
    }
    warn_of_held_out(dataset, &targets);
    let live = request.live.clone().map(|live| {
        live.set_metrics(out.join(METRICS_FILE));
        LivePage::new(live, scene_name(&request.scene))
    });
    let mut progress = RunProgress::new(trainer.steps_done(), config.steps, request.quiet);
    let before = trainer.scene.pager.stats();
    metrics.start_clock(trainer.train_seconds());
    let looped = TrainingLoop {
        trainer: &mut trainer,
        dataset,
        targets: &targets,
        out,
        metrics: &mut metrics,
        lacks_space: false,
        progress: &mut progress,
        stop,
        checkpoint,
        live,
        forecast: Some(forecast),
    }
    .run();
    tiers.leaves_store = true;
    let step_costs = StepCosts { forecast: Some(forecast.facts()), ..costs_since(&before, &trainer, tiers, &metrics) };
    let mut results = Results {
        trainer: &mut trainer,
        metrics: &mut metrics,
        // A run that has diverged keeps the commit before its unsound steps.
        checkpoint: tiers.checkpoint.as_mut().filter(|_| !matches!(looped, Err(TrainError::NonFinite { .. }))),
        out,
        stop,
        // A run that has failed, perhaps after such a wait, ends.
        wait: looped.as_ref().map_or(Duration::ZERO, |()| commit_options(config).full_wait),
        has_ply: false,
    };
    let ply = Trainer::ply_path(out);
    let saved = save_result(dataset, &mut results, &ply);
    // Return the error that ended the run; a failure to write its last rows is an additional warning.
    let (looped, mut saved) = match (looped, saved) {
        (Err(error), Err(other)) => {
            crate::tell!("warning: {} cannot be written: {other}", ply.display());
            return Err(error);
        }
        (Ok(()), Err(error)) => {
            if let Err(other) = results.commit() {
                crate::tell!("warning: the last steps are not committed: {other}");
            }
            return Err(error);
        }
        (looped, saved) => (looped, saved?),
    };
    warn_of_ply(config, &saved.written, &ply);
    let summary = write_results(request, dataset, &targets, results, looped, &mut saved, step_costs)?;
    tiers.is_done = summary.finished;
    let is_late = summary.steps < config.steps;
    Ok(RunOutcome {
        summary: Some(summary),
        exit_code: stop.exit_code().unwrap_or(if is_late { DEADLINE_CODE } else { 0 }),
        out: out.clone(),
        keeps_checkpoint: config.keep_checkpoint,
    })
}

/// Writes what follows the PLY: the file for viewers, the evaluation, the last commit, the summary and the report. The run has ended its
/// loop with `looped`.
/// Errors: that of the loop, or a result cannot be written.
fn write_results(
    request: &RunRequest,
    dataset: &Dataset,
    targets: &TargetCache,
    mut results: Results<'_>,
    looped: Result<(), TrainError>,
    saved: &mut SavedPly,
    costs: StepCosts,
) -> Result<Summary, TrainError> {
    let (config, out) = (&request.config, &request.out);
    let ply = Trainer::ply_path(out);
    let exported = export_all(request, dataset, &mut results, &ply, saved);
    let mut facts = exported.as_ref().map_or(Vec::new(), Clone::clone).into_iter();
    // A stopped run writes its files at once, without evaluation; gsscale-eval can evaluate it later.
    let is_stopped = results.stop.exit_code().is_some() || results.trainer.steps_done() < config.steps;
    let tested = looped.and_then(|()| match is_stopped {
        false => evaluate_result(request, dataset, targets, &mut results),
        true => Ok(None),
    });
    if (config.keep_checkpoint || exported.is_err()) && tested.is_ok() {
        // Commit again, with the result of the evaluation. A run whose export failed is resumed from this commit.
        warn_of_space(results.write(Results::commit))?;
    }
    let trainer = &*results.trainer;
    let (rows_skipped, steps_skipped) = trainer.skipped();
    let summary = Summary {
        steps: trainer.steps_done(),
        gaussians: saved.written.rows + saved.written.skipped + saved.left_out,
        gaussians_left_out: saved.left_out,
        train_seconds: trainer.train_seconds(),
        host_bytes_peak: host_bytes_peak().unwrap_or(0),
        test: tested.as_ref().ok().copied().flatten(),
        scene: request.scene.clone(),
        version: env!("CARGO_PKG_VERSION").to_string(),
        ssim_variant: config.ssim_variant.to_string(),
        // A run without its evaluation or its export is not finished: a resume makes them.
        finished: tested.is_ok() && exported.is_ok() && !is_stopped,
        rows_skipped_non_finite: rows_skipped,
        steps_skipped_non_finite: steps_skipped,
        photos: trainer.photos.iter().flat_map(|parameter| parameter.figures(dataset)).collect(),
        costs,
        growth: trainer.growth().to_vec(),
        export: facts.next(),
        more_exports: facts.collect(),
        tiers: trainer.tier_traffic(),
        commits: results.checkpoint.as_deref().map(Checkpoint::report),
    };
    results.write(|results| {
        let trainer = &*results.trainer;
        // The summary says that all is written, so it comes last but for the report, which shows it and is made again by a resume.
        write_page_map(&out.join(PAGES_FILE), dataset, trainer)?;
        photos::write_files(&trainer.photos, out, dataset)?;
        write_summary(&out.join(SUMMARY_FILE), &summary)?;
        let shown = OnceCell::new();
        let count = |all| Count::new("pictures put into the report", all, request.quiet);
        write_run_report(out, &|done, all| shown.get_or_init(|| count(all as u32)).show(done as u32))?;
        Ok(())
    })?;
    tested?;
    exported?;
    Ok(summary)
}

struct SavedPly {
    written: Written,
    /// Gaussians that too few photos see.
    left_out: u64,
    choice: ExportChoice,
}

/// Writes the Gaussians at the current step as a PLY, its transform to the dataset's coordinates, and the settings of viewers.
fn save_result(dataset: &Dataset, results: &mut Results<'_>, ply: &Path) -> Result<SavedPly, TrainError> {
    let saved = results.write(|results| {
        let mut choice = ExportChoice::of_rows(results.trainer, dataset, ply)?;
        let (written, left_out) = export(results.trainer, dataset, ply, ExportFormat::Ply, &mut choice)?;
        Ok(SavedPly { written, left_out, choice })
    })?;
    results.has_ply = true;
    results.write(|results| {
        let meta = scene_meta(results.trainer, dataset);
        ExportFormat::Ply.write_transform(ply, &meta, saved.written.frame)?;
        Ok(saved.choice.write_settings(results.trainer, dataset, ply)?)
    })?;
    Ok(saved)
}

/// Writes the Gaussians of the PLY also in the other formats that were asked for.
fn export_all(
    request: &RunRequest,
    dataset: &Dataset,
    results: &mut Results<'_>,
    ply: &Path,
    saved: &mut SavedPly,
) -> Result<Vec<ExportFacts>, TrainError> {
    let formats = request.config.export.formats().filter_map(|format| Some((format, format.beside(ply)?)));
    let exported = formats.map(|(format, file)| {
        results.write(|results| export_beside(request, dataset, results.trainer, format, &file, saved))
    });
    let exported: Result<_, _> = exported.collect();
    let is_asked = |format: ExportFormat| request.config.export.formats().any(|asked| asked == format);
    let others = ExportFormat::ALL.into_iter().filter(|format| !is_asked(*format)).filter_map(|f| f.beside(ply));
    for old in others.filter(|old| old.exists()) {
        crate::tell!(
            "warning: {} shows an earlier step; give --export with its format to write it again",
            old.display()
        );
    }
    if exported.is_err() {
        crate::tell!(
            "warning: the file for viewers could not be written; evaluation and report follow, then the reason"
        );
    }
    exported
}

/// Writes the Gaussians of the PLY also in another format, with their transform.
fn export_beside(
    request: &RunRequest,
    dataset: &Dataset,
    trainer: &mut Trainer,
    format: ExportFormat,
    other: &Path,
    saved: &mut SavedPly,
) -> Result<ExportFacts, TrainError> {
    let (exported, _) = export(trainer, dataset, other, format, &mut saved.choice)?;
    format.write_transform(other, &scene_meta(trainer, dataset), exported.frame)?;
    exported.warnings.iter().for_each(|warning| crate::tell!("warning: {warning}"));
    let left_out = saved.written.rows.saturating_sub(exported.rows);
    if left_out > 0 {
        crate::tell!(
            "warning: {} cannot hold {left_out} Gaussians: they lie outside the range of its format",
            other.display()
        );
    }
    if let (Some(levels), false) = (exported.levels, request.quiet) {
        crate::tell!("{}: {levels}", other.display());
    }
    Ok(ExportFacts {
        file: other.strip_prefix(&request.out).unwrap_or(other).to_path_buf(),
        bytes: exported.bytes,
        gaussians: exported.rows,
        left_out,
        levels: exported.levels.map(|levels| levels.rows),
        always_shown: exported.levels.map_or(0, |levels| levels.always_shown),
    })
}

/// Evaluates the result, with pictures, and logs the evaluation.
fn evaluate_result(
    request: &RunRequest,
    dataset: &Dataset,
    targets: &TargetCache,
    results: &mut Results<'_>,
) -> Result<Option<TestMetrics>, TrainError> {
    let pictures = request.out.join(PICTURES_FOLDER);
    // A run that was killed after the commit of its last evaluation has the line already.
    let state = &results.trainer.state;
    let mut is_logged = state.test.is_some_and(|test| test.step == state.step);
    results.write(|Results { trainer, metrics, .. }| {
        let shown = Count::new("held-out views compared", dataset.test_views().len() as u32, request.quiet);
        let test = trainer.evaluate(dataset, targets, Some(&pictures), &|done| shown.show(done))?;
        match test.filter(|_| !std::mem::replace(&mut is_logged, true)) {
            Some(test) => metrics.write_evaluation(trainer.steps_done(), test, &pictures)?,
            // What found no space before waits in the log.
            None => drop(metrics.sync()?),
        }
        Ok(test)
    })
}

/// The log of metrics of a new run, or of a run that resumes after `past`.
fn open_metrics(log: LogFormat, out: &Path, past: Option<&PastRun>) -> InputResult<MetricsLog> {
    let metrics = MetricsLog::open(&out.join(METRICS_FILE), past.map(|past| past.metrics_bytes))?;
    match log {
        LogFormat::Json => Ok(metrics),
        LogFormat::Tensorboard => metrics.with_events(&out.join(EVENTS_FOLDER), past.map(|past| past.step + 1)),
    }
}

/// Warns if the final PLY differs from the request.
fn warn_of_ply(config: &TrainConfig, written: &Written, ply: &Path) {
    if written.frame == ExportFrame::Local && config.export_frame == ExportFrame::Dataset {
        crate::tell!(
            "warning: dataset coordinates exceed the precision of f32, so {} holds local positions; \
             its comments give origin and scale",
            ply.display()
        );
    }
    if written.skipped > 0 {
        crate::tell!("warning: {} Gaussians are not finite and are not in {}", written.skipped, ply.display());
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

/// Writes the page map of a run as it is now.
/// Errors: the folder cannot be written.
pub fn write_page_map(path: &Path, dataset: &Dataset, trainer: &Trainer) -> InputResult<()> {
    let text = serde_json::to_vec(&page_tiles(dataset, trainer))
        .map_err(|e| InputError::new(path, format!("writing failed: {e}"), "report this as a bug"))?;
    write_whole(path, &text)
}

/// One tile per page that has rows, with the number of training views that see it by its bounds.
fn page_tiles(dataset: &Dataset, trainer: &Trainer) -> Vec<PageTile> {
    let pager = &trainer.scene.pager;
    let index = pager.index();
    let mut views = vec![0u32; index.len()];
    for view in dataset.train_views() {
        for page in pager.pages_of_view(&dataset.views[view].camera) {
            views[page.index()] += 1;
        }
    }
    let is_finite = |&page: &usize| index[page].bounds.lo.iter().chain(&index[page].bounds.hi).all(|x| x.is_finite());
    let seen: Vec<usize> = (0..index.len()).filter(is_finite).collect();
    // The view from above is along the axis in which page centres differ least.
    let centre = |i: usize, axis: usize| f64::from(index[i].bounds.lo[axis]) + f64::from(index[i].bounds.hi[axis]);
    let spread = |axis: usize| {
        let mean = seen.iter().map(|&i| centre(i, axis)).sum::<f64>() / seen.len() as f64;
        seen.iter().map(|&i| (centre(i, axis) - mean).abs()).sum::<f64>()
    };
    let down = (0..3).min_by(|&a, &b| spread(a).total_cmp(&spread(b))).unwrap_or(2);
    let [x, y] = [(down + 1) % 3, (down + 2) % 3];
    let tile = |&i: &usize| PageTile {
        lo: [index[i].bounds.lo[x], index[i].bounds.lo[y]],
        hi: [index[i].bounds.hi[x], index[i].bounds.hi[y]],
        rows: index[i].rows,
        views: views[i],
        resident: pager.is_in_memory(PageNo(i as u32)),
    };
    seen.iter().map(tile).collect()
}
