//! The loop over steps, with evaluation, saves, metrics, progress and commits between them.
//!
//! Invariants: 1. logging, evaluation, saves and commits change no bit of the result; 2. a step that lacks drive space
//! or frames is repeated once they are available, or the run ends with its last good step committed.

use crate::base::error::{InputError, InputResult};
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::render::Traffic;
use crate::report::run_files::saved_ply_name;
use crate::train::commits::checkpoint::Checkpoint;
use crate::train::error::TrainError;
use crate::train::inputs::signals::StopFlag;
use crate::train::log::progress::{Progress, Shown};
use crate::train::log::report::{MetricsLog, StepLine, TestMetrics, json_psnr};
use crate::train::memory::estimate::host_bytes_peak;
use crate::train::preflight::growth_costs::GrowthCosts;
use crate::train::run::live::LivePage;
use crate::train::state::trainer::Trainer;
use crate::train::step::device_tier::DeviceTier;
use crate::train::step::train_step::StepOutcome;
use std::path::Path;

/// Outputs and controls of a loop.
pub struct LoopOutputs<'a> {
    pub out: &'a Path,
    /// Writer of metrics.jsonl.
    pub metrics: &'a mut MetricsLog,
    /// Progress bar or lines.
    pub progress: &'a mut Progress,
    /// Stop request (Ctrl-C).
    pub stop: &'a StopFlag,
    /// The run's checkpoint, if it has one.
    pub checkpoint: Option<&'a mut Checkpoint>,
    /// The page that shows the run while it trains, if the user asked for it.
    pub live: Option<LivePage>,
    /// What the run takes by its count.
    pub costs: GrowthCosts,
}

impl Trainer {
    /// Runs until the last step or a stop request.
    ///
    /// # Errors
    /// As [`Trainer::step`], or an output cannot be written.
    pub fn run(
        &mut self,
        dataset: &Dataset,
        targets: &TargetCache,
        outputs: &mut LoopOutputs<'_>,
    ) -> Result<(), TrainError> {
        // A step in flight is always finished.
        while self.state.step < self.options.steps && (outputs.stop.exit_code().is_none() || self.is_ahead()) {
            if !self.log_due_events_with_space(dataset, targets, outputs)? {
                break;
            }
            if !self.is_ahead() {
                self.start_paging_if_outgrown(outputs)?;
            }
            self.goes_ahead = self.may_run_ahead(outputs);
            let before = self.renderer.traffic();
            let Some(outcome) = self.step_with_space(dataset, targets, outputs)? else { break };
            self.check_statistics(outputs)?;
            let (done, is_last) = (self.state.step, self.state.step == self.options.steps);
            let due = |every: u32| every > 0 && done.is_multiple_of(every);
            let psnr = json_psnr(-10.0 * outcome.loss.mse.log10());
            let mut test: Option<TestMetrics> = None;
            if due(self.options.eval_every) && !is_last {
                test = self.evaluate(dataset, targets, None, &|_| {})?;
                if let Some(t) = test {
                    let (psnr, ssim, views) = (t.psnr, t.ssim, t.views);
                    outputs
                        .progress
                        .say(&format!("step {done}: PSNR {psnr:.2} dB, SSIM {ssim:.4} on {views} held-out views"));
                }
            }
            if due(self.options.save_every) && !is_last {
                self.save_if_space(dataset, &outputs.out.join(saved_ply_name(done)))?;
                if let Some(checkpoint) = outputs.checkpoint.as_deref_mut() {
                    checkpoint.keep_next_as(format!("step-{done}"));
                }
            }
            if due(self.options.log_every) || is_last || due(self.options.eval_every) {
                let line = self.step_line(&outcome, psnr, before, outputs);
                let written = outputs.metrics.write(StepLine { test, ..line }).map_err(TrainError::from);
                written.or_else(|error| self.make_space(outputs, error))?;
            }
            outputs.progress.step(done, Shown { gaussians: self.scene.rows(), psnr });
            if let Some(live) = &mut outputs.live {
                self.show_live(dataset, live, psnr);
            }
            if let Some(checkpoint) = outputs.checkpoint.as_deref_mut().filter(|_| !self.is_ahead()) {
                let done = checkpoint.between_steps(self, outputs.metrics);
                done.or_else(|error| self.make_space(outputs, error))?;
            }
        }
        self.commit_last(outputs)?;
        outputs.progress.finish();
        Ok(())
    }

    /// Whether the loop neither reads nor changes the scene between the next step and the one after it.
    fn may_run_ahead(&self, outputs: &LoopOutputs<'_>) -> bool {
        let (done, options) = (self.state.step + 1, &self.options);
        let due = |every: u32| every > 0 && done.is_multiple_of(every);
        let is_wanted = due(options.eval_every) || due(options.save_every) || done >= options.steps;
        let is_due = outputs.checkpoint.as_deref().is_some_and(|checkpoint| checkpoint.is_due(self));
        let is_shown = outputs.live.as_ref().is_some_and(LivePage::is_due);
        !is_wanted && !is_due && !is_shown && outputs.stop.exit_code().is_none() && !self.is_outgrown()
    }

    /// The metrics of the last step, without an evaluation.
    fn step_line(&self, outcome: &StepOutcome, psnr: f64, before: Traffic, outputs: &LoopOutputs<'_>) -> StepLine {
        let traffic = self.renderer.traffic();
        StepLine {
            step: self.state.step,
            loss: if outcome.loss.loss.is_finite() { outcome.loss.loss } else { f64::MAX },
            psnr,
            gaussians: self.scene.rows(),
            seconds: self.state.train_seconds,
            train_cpu_seconds: outputs.metrics.cpu_seconds(),
            host_bytes_peak: host_bytes_peak().unwrap_or(0),
            bytes_uploaded: traffic.bytes_uploaded - before.bytes_uploaded,
            bytes_read_back: traffic.bytes_read_back - before.bytes_read_back,
            device_bytes_peak: traffic.device_bytes_peak,
            tiers: self.tier_traffic(),
            slots: self.device.as_ref().map(DeviceTier::traffic),
            commits: outputs.checkpoint.as_deref().map(Checkpoint::report),
            growth: self.growth().last().copied(),
            test: None,
        }
    }

    /// Logs the events of the last step; a check of growth that finds the drive full is repeated after waiting for space. False
    /// if a stop was requested meanwhile.
    fn log_due_events_with_space(
        &mut self,
        dataset: &Dataset,
        targets: &TargetCache,
        outputs: &mut LoopOutputs<'_>,
    ) -> Result<bool, TrainError> {
        let (checks, allowed) = (self.growth().len(), self.state.growth.allowed());
        loop {
            match self.log_due_events(dataset, targets) {
                Ok(()) => break,
                Err(error) if error.is_out_of_space() => self.make_space(outputs, error)?,
                Err(error) => return Err(self.commit_before_end(error, outputs)),
            }
            if outputs.stop.exit_code().is_some() {
                return Ok(false);
            }
        }
        if let Some(check) = self.growth().get(checks) {
            outputs.progress.say(&check.to_string());
            let costs = outputs.costs.text(check.allowed).filter(|_| check.allowed != allowed);
            costs.iter().for_each(|line| outputs.progress.say(line));
        }
        Ok(true)
    }

    /// Runs a step and repeats it after waiting for space if the drive is full. `None` if a stop was requested
    /// meanwhile.
    fn step_with_space(
        &mut self,
        dataset: &Dataset,
        targets: &TargetCache,
        outputs: &mut LoopOutputs<'_>,
    ) -> Result<Option<StepOutcome>, TrainError> {
        loop {
            match self.step(dataset, targets) {
                Ok(outcome) => return Ok(Some(outcome)),
                Err(error) if error.is_out_of_space() => self.make_space(outputs, error)?,
                Err(error) => return Err(self.commit_before_end(error, outputs)),
            }
            if outputs.stop.exit_code().is_some() {
                return Ok(None);
            }
        }
    }

    /// Fails if pages hold gradient statistics that the histogram lacks: densification would use wrong numbers.
    fn check_statistics(&self, outputs: &LoopOutputs<'_>) -> InputResult<()> {
        let rows = self.scene.histogram.uncounted();
        if rows == 0 {
            return Ok(());
        }
        let store = outputs.checkpoint.as_deref().map_or(outputs.out, Checkpoint::folder);
        let problem = format!("the pages hold statistics of {rows} rows that the run's histogram lacks");
        let remedy = "the last commit is intact: make a consistent store with gsscale-ckpt salvage, then continue with \
                      gsscale-train --resume and --spill-dir";
        Err(InputError::new(store, problem, remedy).at(format!("step {}", self.state.step)))
    }

    /// Frees or awaits drive space after `error`; without a checkpoint, returns the error.
    fn make_space(&mut self, outputs: &mut LoopOutputs<'_>, error: TrainError) -> Result<(), TrainError> {
        match outputs.checkpoint.as_deref_mut() {
            Some(checkpoint) => checkpoint.make_space(self, outputs.metrics, outputs.stop, error),
            None => Err(error),
        }
    }

    /// Commits after the last step. A lack of space is only a warning: a finished run has its results, and a stopped
    /// run keeps its previous commit.
    fn commit_last(&mut self, outputs: &mut LoopOutputs<'_>) -> Result<(), TrainError> {
        let Some(checkpoint) = outputs.checkpoint.as_deref_mut() else { return Ok(()) };
        match self.state.step < self.options.steps || checkpoint.needs_last_commit() {
            true => checkpoint.commit_or_warn(self, outputs.metrics),
            false => Ok(()),
        }
    }

    /// As [`Trainer::save`], but a full drive is only a warning, because the run does not need the file.
    fn save_if_space(&mut self, dataset: &Dataset, path: &Path) -> Result<(), TrainError> {
        match self.save(dataset, path) {
            Err(error) if error.is_out_of_space() => {
                crate::tell!("warning: {} is not written: {error}", path.display());
                Ok(())
            }
            done => done.map(|_| ()),
        }
    }
}
