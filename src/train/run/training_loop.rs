//! The loop over steps, with evaluation, saves, metrics, progress and commits between them. Also what a run does that lacks memory or
//! drive space between two steps: a scene in memory that has outgrown it starts paging to the drive of its checkpoint, and a run that
//! ends for lack of memory commits first, with an error that names the photo and the memory that suffices.
//!
//! Not here: views in batches (`step`), frames of a growing scene (`state::run_memory`).
//!
//! Invariants: 1. logging, evaluation, saves and commits change no bit of the result; 2. a step that lacks drive space
//! or frames is repeated once they are available, or the run ends with its last good step committed; no step is lost.

use super::live::LivePage;
use crate::base::error::{InputError, InputResult};
use crate::base::machine::host_bytes_peak;
use crate::base::units::format_bytes;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::densify::growth::GrowthDecision;
use crate::paging::error::PagingError;
use crate::render::Traffic;
use crate::report::run_files::saved_ply_name;
use crate::train::commits::checkpoint::{Checkpoint, warn_of_space};
use crate::train::commits::results::save;
use crate::train::error::TrainError;
use crate::train::inputs::signals::StopFlag;
use crate::train::log::progress::{RunProgress, ShownStep};
use crate::train::log::report::{MetricsLog, StepLine, TestMetrics, json_psnr};
use crate::train::memory::{HostBudget, PLAN_BYTES};
use crate::train::preflight::forecast::Forecast;
use crate::train::state::trainer::Trainer;
use crate::train::step::device_tier::DeviceTier;
use crate::train::step::train_step::StepOutcome;
use std::path::Path;

/// A run between its first and its last step: the trainer and its photos, outputs and controls.
pub struct TrainingLoop<'a> {
    pub trainer: &'a mut Trainer,
    pub dataset: &'a Dataset,
    pub targets: &'a TargetCache,
    pub out: &'a Path,
    /// Writer of metrics.jsonl.
    pub metrics: &'a mut MetricsLog,
    /// Progress bar or lines.
    pub progress: &'a mut RunProgress,
    /// Stop request (Ctrl-C).
    pub stop: &'a StopFlag,
    /// The run's checkpoint, if it has one.
    pub checkpoint: Option<&'a mut Checkpoint>,
    /// The page that shows the run while it trains, if the user asked for it.
    pub live: Option<LivePage>,
    /// What the run will take, to be named when a check of growth changes the count.
    pub forecast: Option<&'a Forecast>,
    /// A line of the log waits for space on the drive of the results.
    pub lacks_space: bool,
}

impl TrainingLoop<'_> {
    /// Runs until the last step or a stop request.
    /// Errors: as [`Trainer::step`], or an output cannot be written.
    pub fn run(&mut self) -> Result<(), TrainError> {
        let (steps, eval_every, save_every, log_every) = {
            let options = &self.trainer.options;
            (options.steps, options.eval_every, options.save_every, options.log_every)
        };
        let first = self.trainer.steps_done();
        // After a step at least: a run of legs that are too short would never end.
        let is_stopped = |done: u32| self.stop.exit_code().is_some() || (done > first && self.stop.is_late());
        // A step in flight is always finished.
        while self.trainer.steps_done() < steps && (!is_stopped(self.trainer.steps_done()) || self.trainer.is_ahead()) {
            if !self.log_due_events()? {
                break;
            }
            if !self.trainer.is_ahead() {
                self.start_paging_if_outgrown()?;
            }
            self.trainer.ahead.is_allowed = self.may_run_ahead();
            let before = self.trainer.renderer.traffic();
            let Some(outcome) = self.with_space(Trainer::step)? else { break };
            self.check_statistics()?;
            let done = self.trainer.steps_done();
            let (due, is_last) = (|every: u32| every > 0 && done.is_multiple_of(every), done == steps);
            let psnr = (!outcome.is_masked).then(|| json_psnr(-10.0 * outcome.loss.mse.log10()));
            let mut test: Option<TestMetrics> = None;
            if due(eval_every) && !is_last {
                test = self.trainer.evaluate(self.dataset, self.targets, None, &|_| {})?;
                if let Some(TestMetrics { psnr, ssim, views, .. }) = test {
                    let text = format!("step {done}: PSNR {psnr:.2} dB, SSIM {ssim:.4} on {views} held-out views");
                    self.progress.say(&text);
                }
            }
            if due(save_every) && !is_last {
                self.save_if_space(&self.out.join(saved_ply_name(done)))?;
                if let Some(checkpoint) = self.checkpoint.as_deref_mut() {
                    checkpoint.name = Some(format!("step-{done}"));
                }
            }
            if due(log_every) || is_last || due(eval_every) {
                let line = StepLine { test, ..self.step_line(&outcome, psnr, before) };
                match self.metrics.write(line).map_err(TrainError::from) {
                    // A step in flight allows no commit: the line waits in the log.
                    Err(error) if error.is_out_of_space() && self.trainer.is_ahead() => self.lacks_space = true,
                    written => written.or_else(|error| self.make_space(error))?,
                }
            }
            if self.lacks_space && !self.trainer.is_ahead() {
                self.lacks_space = false;
                let written = self.metrics.sync().map(drop).map_err(TrainError::from);
                written.or_else(|error| self.make_space(error))?;
            }
            self.progress.step(done, ShownStep { gaussians: self.trainer.scene.rows(), psnr });
            if let Some(live) = &mut self.live {
                live.show(self.trainer, self.dataset, self.targets, psnr);
            }
            if let Some(checkpoint) = self.checkpoint.as_deref_mut().filter(|_| !self.trainer.is_ahead()) {
                let done = checkpoint.between_steps(self.trainer, self.metrics);
                done.or_else(|error| self.make_space(error))?;
            }
        }
        self.commit_last()?;
        self.progress.finish();
        Ok(())
    }

    /// Whether the loop neither reads nor changes the scene between the next step and the one after it.
    fn may_run_ahead(&mut self) -> bool {
        let (done, options) = (self.trainer.steps_done() + 1, &self.trainer.options);
        let due = |every: u32| every > 0 && done.is_multiple_of(every);
        let is_wanted = due(options.eval_every) || due(options.save_every) || done >= options.steps;
        let is_due = self.checkpoint.as_deref().is_some_and(|checkpoint| checkpoint.is_due(self.trainer));
        let is_shown = self.live.as_ref().is_some_and(LivePage::is_due);
        !is_wanted
            && !is_due
            && !is_shown
            && !self.lacks_space
            && self.stop.exit_code().is_none()
            && !self.stop.is_late()
            && !self.trainer.run_memory().is_outgrown()
    }

    /// The metrics of the last step, without an evaluation.
    fn step_line(&self, outcome: &StepOutcome, psnr: Option<f64>, before: Traffic) -> StepLine {
        let trainer = &*self.trainer;
        let traffic = trainer.renderer.traffic();
        let terms =
            trainer.photos.iter().filter(|kind| kind.adds_loss()).map(|kind| (kind.name().to_string(), kind.loss()));
        StepLine {
            step: trainer.steps_done(),
            loss: if outcome.loss.loss.is_finite() { outcome.loss.loss } else { f64::MAX },
            loss_terms: terms.filter(|(_, value)| value.is_finite()).collect(),
            psnr,
            gaussians: trainer.scene.rows(),
            seconds: trainer.train_seconds(),
            train_cpu_seconds: self.metrics.cpu_seconds(),
            host_bytes_peak: host_bytes_peak().unwrap_or(0),
            bytes_uploaded: traffic.bytes_uploaded - before.bytes_uploaded,
            bytes_read_back: traffic.bytes_read_back - before.bytes_read_back,
            device_bytes_peak: traffic.device_bytes_peak,
            tiers: trainer.tier_traffic(),
            slots: trainer.device.as_ref().map(DeviceTier::traffic),
            commits: self.checkpoint.as_deref().map(Checkpoint::report),
            growth: trainer.growth().last().copied(),
            test: None,
        }
    }

    /// Logs the events of the last step; a check of growth that finds the drive full is repeated after waiting for space. False
    /// if a stop was requested meanwhile.
    fn log_due_events(&mut self) -> Result<bool, TrainError> {
        let (checks, allowed) = (self.trainer.growth().len(), self.trainer.state.growth.allowed());
        if self.with_space(Trainer::log_due_events)?.is_none() {
            return Ok(false);
        }
        if let Some(check) = self.trainer.growth().get(checks) {
            self.progress.say(&check.to_string());
            let forecast = self.forecast.filter(|_| check.allowed != allowed);
            let costs = forecast.and_then(|forecast| forecast.costs_text(check.allowed));
            costs.iter().for_each(|line| self.progress.say(line));
            if check.decision == GrowthDecision::Ends && self.trainer.photos_allow_no_more(self.dataset) {
                self.progress.say("  which is as many as --quality allows for photos of so many pixels");
            }
        }
        Ok(true)
    }

    /// Does `work`, and repeats it after waiting for space while the drive is full. `None` if a stop was requested meanwhile.
    fn with_space<T>(
        &mut self,
        work: fn(&mut Trainer, &Dataset, &TargetCache) -> Result<T, TrainError>,
    ) -> Result<Option<T>, TrainError> {
        loop {
            match work(self.trainer, self.dataset, self.targets) {
                Ok(done) => return Ok(Some(done)),
                Err(error) if error.is_out_of_space() => self.make_space(error)?,
                Err(error) => return Err(self.commit_before_end(error)),
            }
            if self.stop.exit_code().is_some() {
                return Ok(None);
            }
        }
    }

    /// Fails if pages hold gradient statistics that the histogram lacks: densification would use wrong numbers.
    fn check_statistics(&self) -> InputResult<()> {
        let rows = self.trainer.scene.histogram.uncounted();
        if rows == 0 {
            return Ok(());
        }
        let store = self.checkpoint.as_deref().map_or(self.out, |checkpoint| &checkpoint.folder);
        let problem = format!("the pages hold statistics of {rows} rows that the run's histogram lacks");
        let remedy = "the last commit is intact: make a consistent store with gsscale-ckpt salvage, then continue with \
                      gsscale-train --resume and --spill-dir";
        Err(InputError::new(store, problem, remedy).at(format!("step {}", self.trainer.steps_done())))
    }

    /// Frees or awaits drive space after `error`; without a checkpoint, returns the error.
    fn make_space(&mut self, error: TrainError) -> Result<(), TrainError> {
        match self.checkpoint.as_deref_mut() {
            Some(checkpoint) => checkpoint.make_space(self.trainer, self.metrics, self.stop, error),
            None => Err(error),
        }
    }

    /// Commits after the last step. A lack of space is only a warning: a finished run has its results, and a stopped
    /// run keeps its previous commit.
    fn commit_last(&mut self) -> Result<(), TrainError> {
        let Some(checkpoint) = self.checkpoint.as_deref_mut() else { return Ok(()) };
        match self.trainer.steps_done() < self.trainer.options.steps || checkpoint.needs_last_commit() {
            true => warn_of_space(checkpoint.commit(self.trainer, self.metrics)),
            false => Ok(()),
        }
    }

    /// As [`save`], but a full drive is only a warning, because the run does not need the file.
    fn save_if_space(&mut self, path: &Path) -> Result<(), TrainError> {
        match save(self.trainer, self.dataset, path) {
            Err(error) if error.is_out_of_space() => {
                crate::tell!("warning: {} is not written: {error}", path.display());
                Ok(())
            }
            done => done.map(|_| ()),
        }
    }

    /// Starts paging in a run in memory whose pages no longer fit, between steps: commits all pages, so that they can
    /// be evicted and read again. If paging left too few frames for a view and the user set no budget, all pages stay
    /// in memory while the machine has it.
    /// Errors: the commit failed for a reason other than space.
    fn start_paging_if_outgrown(&mut self) -> Result<(), TrainError> {
        let trainer = &mut *self.trainer;
        if !trainer.run_memory().is_outgrown() {
            return Ok(());
        }
        let Some(budget) = trainer.memory.budget else { return Ok(()) };
        let view = trainer.run_memory().view_memory();
        let needed = trainer.scene.pager.stats().pinned_max;
        let frames = budget.frames(&trainer.scene, view, needed);
        let is_tight = budget.frames_at_most(&trainer.scene, view) < needed;
        if is_tight && trainer.run_memory().raise_for_all_pages(budget) {
            return Ok(());
        }
        let step = trainer.steps_done();
        let outgrown = format!("from step {step} on the scene does not fit into {}", format_bytes(budget.bytes));
        // Warn once: without the budget, later steps do not try again.
        trainer.memory.budget = None;
        let Some(checkpoint) = self.checkpoint.as_deref_mut() else {
            crate::tell!("warning: {outgrown} (--host-mem), and no drive is set for its pages (--spill-dir)");
            return Ok(());
        };
        let commits = Some(checkpoint.done);
        if budget.failed_after == commits {
            trainer.memory.budget = Some(budget);
            return Ok(());
        }
        match checkpoint.commit(trainer, self.metrics) {
            Ok(()) if checkpoint.done > 0 => {}
            Ok(()) => {
                crate::tell!(
                    "warning: {outgrown} (--host-mem), and without commits its pages cannot be moved to a drive"
                );
                return Ok(());
            }
            Err(error) if error.is_out_of_space() => {
                crate::tell!("warning: {outgrown} (--host-mem), and its pages cannot be moved to a drive: {error}");
                // Try again after the next successful commit.
                trainer.memory.budget = Some(HostBudget { failed_after: commits, ..budget });
                return Ok(());
            }
            Err(error) => return Err(error),
        }
        checkpoint.is_optional = false;
        crate::tell!(
            "warning: {outgrown} (--host-mem): its pages move between memory and {}; a new run with --spill-dir can \
             choose a view order that moves fewer pages",
            checkpoint.folder.display()
        );
        trainer.memory.budget = Some(budget);
        trainer.scene.pager.begin_paging(frames, budget.prefetch_bytes, PLAN_BYTES);
        Ok(())
    }

    /// Commits what a run can be resumed from, before it ends with `error`: the last good step of a run that lacked frames or a photo or
    /// whose renderer failed, or the cut in progress of a step that failed half-way. Adds the least memory to an error about
    /// frames.
    fn commit_before_end(&mut self, error: TrainError) -> TrainError {
        let is_last_step_good = matches!(
            error,
            TrainError::Render(_) | TrainError::Photo(_) | TrainError::Paging(PagingError::WorkingSet { .. })
        );
        if let Some(checkpoint) = self.checkpoint.as_deref_mut() {
            let done = match self.trainer.is_torn {
                true => checkpoint.finish_cut(self.trainer),
                false if is_last_step_good => checkpoint.commit(self.trainer, self.metrics),
                false => Ok(()),
            };
            if let Err(second) = done {
                crate::tell!("warning: the run could not be committed: {second}");
            }
        }
        let TrainError::Paging(source @ PagingError::WorkingSet { pages, .. }) = error else { return error };
        let view = self.trainer.run_memory().view_memory();
        let scene = &self.trainer.scene;
        let least = self.trainer.memory.budget.map(|budget| budget.least_for(scene, view, pages));
        TrainError::Outgrown { source, least }
    }
}
