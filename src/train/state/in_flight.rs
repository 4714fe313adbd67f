//! Decides when a step is recorded while the step before it is in flight, for runs whose pages lie on a device.
//!
//! Not here: how a step is recorded and taken over (`step::device_flights`, which also lists where the pipeline drains).
//!
//! Invariants: 1. a step is recorded ahead only if nothing that the host decides lies between it and the step before; 2. between two
//! calls of the trainer no step is in flight, unless its caller has promised not to touch the scene ([`Trainer::goes_ahead`]).

use super::trainer::Trainer;
use crate::base::trace;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::densify::strategy::RowCount;
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use crate::train::error::TrainError;
use crate::train::step::comparison::Comparison;
use crate::train::step::device_flights::StepToRecord;
use crate::train::step::device_rows::DeviceRows;
use crate::train::step::device_tier::DeviceTier;
use crate::train::step::train_step::{StepOutcome, train_step};

impl Trainer {
    /// Whether the coming step is recorded on the device already. Nothing may read or change the scene then.
    pub fn is_ahead(&self) -> bool {
        self.device.as_ref().is_some_and(|tier| tier.in_flight() > 0)
    }

    /// Takes the current step on a device that holds the pages. Records the next step before it waits for the current one, if the next step
    /// may be recorded ahead.
    pub(super) fn step_on_device(
        &mut self,
        (dataset, targets): (&Dataset, &TargetCache),
        view: usize,
        (target, is_left_out): (&Target, bool),
    ) -> Result<StepOutcome, TrainError> {
        let (step, render) = (self.state.step, self.render_options());
        if let Some(error) = self.ahead_failed.take() {
            return Err(error);
        }
        if !self.is_ahead() && self.compares_without_correction() {
            self.record(dataset, (0, target))?;
        }
        if self.is_ahead() {
            self.record_next(dataset, targets)?;
            let tier = DeviceTier::of_run(&mut self.device, &self.scene, &mut *self.renderer, self.options.steps)?;
            let _span = trace::span("finish step").with("in_flight", tier.in_flight() as u64);
            if let Some(outcome) = tier.finish(&mut self.scene, &mut *self.renderer)? {
                return Ok(outcome);
            }
        }
        let next = self.coming_views(2).get(1).map(|&view| &dataset.views[view].camera);
        let (renderer, scene, working) = (&mut *self.renderer, &mut self.scene, &mut self.working);
        let tier = DeviceTier::of_run(&mut self.device, scene, renderer, self.options.steps)?;
        let mut rows = DeviceRows::new(tier, scene, renderer, (step, next))?;
        let (camera, collects) = (&dataset.views[view].camera, self.options.strategy.collects(step));
        let mut comparison = Comparison { target, loss: self.options.loss, photos: &mut self.photos, is_left_out };
        train_step(scene, working, &mut rows, (step, camera), (&render, &mut comparison), collects, self.pages_most)
    }

    /// Whether pictures are compared with photos without correction or masks, so that no step needs its picture on the host.
    fn compares_without_correction(&self) -> bool {
        !self.photos.iter().any(|parameter| parameter.needs_host())
    }

    /// Records the step `ahead` steps from now, whose photo is `target`. False if the step cannot be recorded now.
    fn record(&mut self, dataset: &Dataset, (ahead, target): (u32, &Target)) -> Result<bool, TrainError> {
        let views = self.coming_views(ahead + 2);
        let Some(&view) = views.get(ahead as usize) else { return Ok(false) };
        let (step, render) = (self.state.step + ahead, self.render_options());
        let camera_of = |view: usize| -> &Camera { &dataset.views[view].camera };
        let to_record = StepToRecord {
            step,
            camera: camera_of(view),
            next: views.get(ahead as usize + 1).map(|&view| (step + 1, camera_of(view))),
            render: &render,
            target,
            loss: &self.options.loss,
            collects: self.options.strategy.collects(step),
            rows_before: self.rows_of_views.get(view).copied().unwrap_or(0),
            share: self.visible_share,
            pages_most: self.pages_most,
        };
        let tier = DeviceTier::of_run(&mut self.device, &self.scene, &mut *self.renderer, self.options.steps)?;
        if !tier.may_record() {
            return Ok(false);
        }
        tier.record(&mut self.scene, &mut *self.renderer, &to_record)
    }

    /// Records the step behind the one in flight, if it may be recorded. An error of reading its pages is reported when the step is due.
    fn record_next(&mut self, dataset: &Dataset, targets: &TargetCache) -> Result<(), TrainError> {
        let may_record = self.device.as_ref().is_some_and(DeviceTier::may_record);
        if !may_record || !self.goes_ahead || !self.has_no_event_or_end_after(self.state.step) {
            return Ok(());
        }
        let Some(&view) = self.coming_views(2).get(1) else { return Ok(()) };
        let photo = trace::span("photo");
        let target = targets.get(view)?;
        drop(photo);
        match self.record(dataset, (1, &target)) {
            Err(error @ TrainError::Paging(_)) => self.ahead_failed = Some(error),
            other => drop(other?),
        }
        Ok(())
    }

    /// Whether no event follows 0-based `step`, and no outcome of the step can end the run.
    fn has_no_event_or_end_after(&self, step: u32) -> bool {
        let strategy = &self.options.strategy;
        let reads = strategy.reads_histogram(step) || strategy.growth_check(step).is_some();
        let is_steady = self.state.steps_skipped_in_a_row == 0 && self.idle.is_busy();
        if reads || !is_steady || self.options.sh_degree_at(step + 1) > self.scene.rules.sh_degree() {
            return false;
        }
        let count = RowCount::unlimited(self.scene.rows_bound());
        strategy.events_after(step, self.options.scene_scale, count, &self.scene.histogram).is_empty()
    }

    /// Notes how many rows a view listed.
    pub(super) fn note_rows_of(&mut self, view: usize, rows: usize) {
        if self.rows_of_views.len() <= view {
            self.rows_of_views.resize(view + 1, 0);
        }
        self.rows_of_views[view] = u32::try_from(rows).unwrap_or(u32::MAX);
    }
}
