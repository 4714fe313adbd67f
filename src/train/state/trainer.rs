//! The trainer: the state of a run and one step of it, with the order of views and the events between two steps. The loop
//! lies in [`crate::train::run::training_loop`].
//!
//! The events that follow a step are logged when the next step begins. So evaluations, saves and commits between two
//! steps, and the result of a run, show the scene before an opacity reset instead of right after it.
//!
//! Invariants: 1. the state after step s is a function of dataset, config and s alone; threads, budgets, logging and
//! evaluation do not change it; 2. a skipped step changes no row ([`crate::train::step::train_step::Skipped`]), and three of them in a row end
//! the run with the result of the last good step; 3. the events of a step are logged once.

use super::eval::{EvalRequest, evaluate};
use super::growth_checks::{Comparing, measure};
use super::run_memory::{MemoryState, RunMemory};
use super::turns::Turns;
use crate::base::trace;
use crate::checkpoint::run_state::{LastTest, TrainerState};
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::densify::growth::{GrowthCheck, GrowthState};
use crate::densify::strategy::{RowCount, Strategy};
use crate::optim::method::{Method, OptimizerPlace};
use crate::paging::pager::{Pager, PagerConfig};
use crate::photos::parameter::{PhotoOutcome, PhotoStep, steps_after_reset};
use crate::photos::{self, PhotoParameters, first_parameters};
use crate::render::view_sizes::ViewSizes;
use crate::render::{RenderOptions, Renderer};
use crate::report::run_files::PLY_FILE;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::events::{Event, EventKind, EventLog};
use crate::scene::image::Target;
use crate::schedule::order::{Order, ViewOrder};
use crate::train::error::TrainError;
use crate::train::log::report::{Summary, TestMetrics, TierTraffic};
use crate::train::step::batch::RowsInHost;
use crate::train::step::comparison::Comparison;
use crate::train::step::device_flights::StepToRecord;
use crate::train::step::device_tier::{DeviceRows, DeviceTier};
use crate::train::step::pages::{PagedScene, WorkingSet};
use crate::train::step::soundness::{MaskedPhotos, note_idle, note_soundness};
use crate::train::step::train_step::{StepOutcome, StepView, train_step};
use crate::train::step::view::{SceneNow, rehearse};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Steps between two updates of the pager's plan, and the least and most views that a plan covers.
const LOOK_AHEAD_EVERY: u32 = 8;
const LOOK_AHEAD_LEAST: u32 = 64;
const LOOK_AHEAD_MOST: u32 = 8192;

/// Memory for the plan of a run in memory whose device holds a part of the pages, bytes.
const DEVICE_PLAN_BYTES: usize = 4 << 20;

/// Views whose photos are prefetched.
const PREFETCH_VIEWS: u32 = 8;

/// The state of a run. A run in memory uses the same code with one frame per page.
pub struct Trainer {
    /// The pages, the optimizer and the event log.
    pub scene: PagedScene,
    pub renderer: Box<dyn Renderer>,
    /// The pages on the renderer's device, from the first step of a run that updates them there.
    pub(crate) device: Option<DeviceTier>,
    pub options: RunOptions,
    /// Which view each step trains on.
    turns: Turns,
    /// What the run knows of its photos.
    pub(crate) photos: PhotoParameters,
    pub(crate) working: WorkingSet,
    /// Everything that a commit saves and a resume restores, besides the pages and what is known of photos.
    pub(crate) state: TrainerState,
    /// A step failed after it had changed rows, so the state must not be committed.
    pub(crate) is_torn: bool,
    /// The memory budget, and what views have taken so far.
    pub(crate) memory: MemoryState,
    /// Photos of which no pixel counts.
    masked: MaskedPhotos,
    /// Steps recorded ahead.
    pub(crate) ahead: Ahead,
}

/// Steps of a run whose pages lie on a device that are recorded before the step before them has ended.
#[derive(Default)]
pub(crate) struct Ahead {
    /// The caller does nothing with the scene between the step that it takes and the next one.
    pub is_allowed: bool,
    /// The error that kept a step from being recorded ahead.
    failed: Option<TrainError>,
    /// The step that was recorded ahead last, 0-based, and its photo.
    photo: Option<(u32, Arc<Target>)>,
    /// Rows that each view listed last; 0 or missing for a view that this process has not drawn.
    rows_of_views: Vec<u32>,
}

/// The strategy of a run whose views come in this order, from the strategy of its config.
fn strategy_in(order: &ViewOrder, strategy: &Arc<dyn Strategy>) -> Arc<dyn Strategy> {
    strategy.for_regions(order.regional_epoch()).unwrap_or_else(|| Arc::clone(strategy))
}

/// The largest sizes of the views of [`Trainer::probe_views`].
#[derive(Debug, Clone, Copy, Default)]
pub struct Probed {
    pub pixels: usize,
    /// Rows in view.
    pub visible: usize,
    /// Sizes on a device; `None` without a device.
    pub device: Option<ViewSizes>,
    /// Median seconds of rendering a view forward and backward.
    pub seconds: f64,
}

impl Trainer {
    /// A trainer for the first Gaussians `columns` and the training views of `dataset` (at least one), with all pages
    /// in memory.
    /// Errors: as [`Trainer::with_pager`].
    pub fn new(
        columns: Columns,
        dataset: &Dataset,
        renderer: Box<dyn Renderer>,
        options: RunOptions,
    ) -> Result<Self, TrainError> {
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
        Trainer::with_pager(columns, pager, dataset, renderer, options)
    }

    /// A trainer whose pages are stored in `pager`, which must be empty.
    /// Errors: a page could not be stored.
    pub fn with_pager(
        columns: Columns,
        pager: Pager,
        dataset: &Dataset,
        renderer: Box<dyn Renderer>,
        options: RunOptions,
    ) -> Result<Self, TrainError> {
        let scene = PagedScene::new(&columns, pager, &options)?;
        Ok(Trainer::of_scene(scene, dataset, renderer, options))
    }

    /// A trainer for a scene that was created with the same options.
    pub fn of_scene(scene: PagedScene, dataset: &Dataset, renderer: Box<dyn Renderer>, options: RunOptions) -> Trainer {
        let order = ViewOrder::new(options.view_order, options.seed, &dataset.train_cameras());
        let options = RunOptions { strategy: strategy_in(&order, &options.strategy), ..options };
        Trainer {
            scene,
            turns: Turns::new(order, dataset.train_views(), &options.strategy, options.steps),
            photos: first_parameters(&options.photos, dataset),
            working: WorkingSet::default(),
            renderer,
            device: None,
            options,
            state: TrainerState::default(),
            is_torn: false,
            memory: MemoryState::default(),
            masked: MaskedPhotos::default(),
            ahead: Ahead::default(),
        }
    }

    /// The scene as it is now, to be drawn.
    pub(crate) fn now(&mut self) -> SceneNow<'_> {
        let Trainer { scene, working, renderer, state, .. } = self;
        SceneNow { scene, step: state.step, working, renderer: &mut **renderer }
    }

    pub(crate) fn run_memory(&mut self) -> RunMemory<'_> {
        let sh_degree_last = self.sh_degrees().1;
        let Trainer { scene, working, renderer, photos, memory, state, .. } = self;
        RunMemory { memory, scene, renderer: &mut **renderer, working, photos, step: state.step, sh_degree_last }
    }

    /// Gives what is known of photos its start values, which the files of the dataset state. Returns warnings for the user.
    pub(crate) fn start_photos(&mut self, dataset: &Dataset) -> Vec<String> {
        self.photos.iter_mut().flat_map(|parameter| parameter.start(dataset)).collect()
    }

    /// Path of the final PLY in an output folder.
    pub fn ply_path(out: &Path) -> PathBuf {
        out.join(PLY_FILE)
    }

    /// Counts the steps from `step` on: an earlier run has done them, in `train_seconds` seconds. Call this before the first
    /// step.
    pub(crate) fn begin_after(&mut self, summary: &Summary) {
        (self.state.step, self.state.train_seconds) = (summary.steps, summary.train_seconds);
        // What the run has decided stays decided.
        let first = summary.growth.iter().map(|check| check.allowed).min().unwrap_or(0);
        self.state.growth = GrowthState { first, checks: summary.growth.clone() };
    }

    /// Renders views forward and backward so that the memory of a view is allocated; the scene stays unchanged. Returns
    /// the pixels of the largest view, the most rows that a view draws, and how long a view takes.
    /// Errors: a view cannot be rendered.
    pub fn probe_views(&mut self, dataset: &Dataset, views: &[usize]) -> Result<Probed, TrainError> {
        self.drain()?;
        let render = self.render_options();
        let (mut probed, mut seconds) = (Probed::default(), Vec::new());
        for &view in views {
            let camera = &photos::camera(&self.photos, dataset, view);
            let target = Target::new([camera.width, camera.height], vec![0; 3 * camera.pixels()]);
            self.begin_step_of_photo(view, camera, false, true);
            let mut comparison = Comparison { photos: &mut self.photos, ..Comparison::new(&target, self.options.loss) };
            let (scene, working, renderer) = (&mut self.scene, &mut self.working, &mut *self.renderer);
            let mut now = SceneNow { scene, step: self.state.step, working, renderer };
            let (pages_most, began) = (self.memory.pages_most, Instant::now());
            let rows = rehearse(&mut now, camera, &render, &mut comparison, pages_most)?;
            seconds.push(began.elapsed().as_secs_f64());
            let pager = &self.scene.pager;
            let pages = pager.pages_of_view(camera);
            let is_whole = pager.pages_per_batch(pages.len()).min(pages_most) >= pages.len();
            self.memory.note_view(rows, pager.rows_of(&pages) as usize, is_whole);
            (probed.pixels, probed.visible) = (probed.pixels.max(camera.pixels()), probed.visible.max(rows));
            let sizes = self.renderer.device_sizes();
            probed.device = sizes.map(|sizes| probed.device.map_or(sizes, |most| most.widest(sizes)));
        }
        // The first view allocates memory, and is the largest.
        let rest = if seconds.len() > 1 { &mut seconds[1..] } else { &mut seconds[..] };
        rest.sort_unstable_by(f64::total_cmp);
        probed.seconds = rest.get(rest.len() / 2).copied().unwrap_or(0.0);
        Ok(probed)
    }

    /// Sets the view order before the first step, for orders that depend on the pages. Rounds and held-out views follow from the order,
    /// so the trainer then equals one that was created with it.
    pub fn set_view_order(&mut self, order: Order, dataset: &Dataset) {
        let options = &mut self.options;
        options.view_order = order;
        let order = ViewOrder::new(order, options.seed, &dataset.train_cameras());
        // The rules of the pages hold the strategy of the config.
        options.strategy = strategy_in(&order, &self.scene.rules.strategy);
        self.turns = Turns::new(order, dataset.train_views(), &options.strategy, options.steps);
    }

    pub fn view_order(&self) -> &ViewOrder {
        &self.turns.order
    }

    /// SH degree now and at the last step.
    pub fn sh_degrees(&self) -> (u8, u8) {
        (self.scene.rules.sh_degree, self.options.sh_degree_at(self.options.steps.saturating_sub(1)))
    }

    pub fn steps_done(&self) -> u32 {
        self.state.step
    }

    /// Seconds spent in steps.
    pub fn train_seconds(&self) -> f64 {
        self.state.train_seconds
    }

    /// Row updates and steps skipped because a value was not finite.
    pub fn skipped(&self) -> (u64, u32) {
        (self.state.rows_skipped, self.state.steps_skipped)
    }

    /// Traffic between the tiers since the run began, including the time before a resume.
    pub fn tier_traffic(&self) -> TierTraffic {
        TierTraffic::of(&self.scene.pager)
    }

    /// Render options with the current SH degree.
    pub fn render_options(&self) -> RenderOptions {
        RenderOptions { sh_degree: self.scene.rules.sh_degree, ..self.options.render }
    }

    pub fn events(&self) -> &EventLog {
        self.scene.events()
    }

    /// Logs the events that follow the last step, and runs one step.
    /// Errors: a photo cannot be decoded, pages could not be pinned, the renderer failed, the run diverged, or nothing counts in it
    /// (`soundness`).
    pub fn step(&mut self, dataset: &Dataset, targets: &TargetCache) -> Result<StepOutcome, TrainError> {
        trace::set_step(self.state.step);
        let _span = trace::span("step");
        self.log_due_events(dataset, targets)?;
        let view = self.turns.view_at(self.state.step, &self.photos);
        targets.prefetch(&self.turns.coming(self.state.step, PREFETCH_VIEWS, &self.photos));
        if !self.is_ahead() {
            let camera = photos::camera(&self.photos, dataset, view);
            self.run_memory().fit_frames(&camera);
        }
        if self.options.optimizer_on == OptimizerPlace::Device {
            // The pages get their slots, so that the first plan knows them.
            DeviceTier::of_run(&mut self.device, &self.scene, &mut *self.renderer, self.options.steps)?;
        }
        self.look_ahead(dataset);
        let photo = trace::span("photo");
        let target = match self.ahead.photo.take() {
            // The step is in flight: its photo may have become unreadable since it was recorded.
            Some((step, target)) if step == self.state.step => target,
            _ => targets.get(view).map_err(TrainError::Photo)?,
        };
        drop(photo);
        let started = Instant::now();
        let is_left_out = self.photos.iter().any(|parameter| parameter.leaves_out(view));
        let stepped = loop {
            let stepped = self.attempt(dataset, targets, view, &target, is_left_out);
            self.is_torn = matches!(stepped, Err(TrainError::Torn { .. }));
            // A step that lacked frames can be repeated: it only applied pending events.
            match stepped {
                Err(TrainError::Paging(error)) if self.run_memory().add_missing_frames(&error) => {}
                stepped => break stepped,
            }
        };
        let outcome = stepped.map_err(|error| error.with_view_name(&dataset.views[view].name))?;
        let outcome = StepOutcome { is_masked: !target.counts(), ..outcome };
        self.memory.note_view(outcome.rows, outcome.rows_pinned, outcome.batches == 1);
        self.ahead.note_rows_of(view, outcome.rows);
        let sound = note_soundness(&mut self.state, &outcome, &dataset.views[view].name, &self.options.init_ply);
        // A step that was taken counts even if it ends the run, since its rows have already moved to the next step.
        if sound.is_err() && outcome.skipped.is_some() {
            return sound.map(|()| outcome);
        }
        note_idle(&mut self.state, &outcome, self.scene.rows(), dataset, &self.options.init_ply)?;
        let is_last = self.state.step + 1 == self.options.steps;
        self.masked.note(&outcome, view, is_last, (dataset, targets), self.turns.held_out_views());
        if self.options.optimizer == Method::Dense {
            // The step has changed rows; an error here leaves a state between two steps.
            self.is_torn = true;
            self.scene.settle_all(self.state.step + 1).map_err(TrainError::torn)?;
            self.is_torn = false;
        }
        self.end_step_of_photo(view, &outcome, &target, dataset);
        self.state.step += 1;
        self.state.train_seconds += started.elapsed().as_secs_f64();
        sound.map(|()| outcome)
    }

    fn attempt(
        &mut self,
        dataset: &Dataset,
        targets: &TargetCache,
        view: usize,
        target: &Target,
        is_left_out: bool,
    ) -> Result<StepOutcome, TrainError> {
        let (step, camera) = (self.state.step, &photos::camera(&self.photos, dataset, view));
        self.begin_step_of_photo(view, camera, is_left_out, false);
        if self.options.optimizer_on == OptimizerPlace::Device {
            return self.step_on_device(dataset, targets, view, target, is_left_out);
        }
        let render = self.render_options();
        let mut comparison = Comparison { target, loss: self.options.loss, photos: &mut self.photos, is_left_out };
        let collects = self.options.strategy.collects(step);
        let mut rows = RowsInHost::new(&mut *self.renderer);
        let (scene, working) = (&mut self.scene, &mut self.working);
        let view = StepView { step, camera, render: &render, collects, pages_most: self.memory.pages_most };
        train_step(scene, working, &mut rows, &view, &mut comparison)
    }

    /// Whether the coming step is recorded on the device already. Nothing may read or change the scene then.
    pub fn is_ahead(&self) -> bool {
        self.device.as_ref().is_some_and(|tier| tier.flights.in_flight() > 0)
    }

    /// Takes the current step on a device that holds the pages. Records the next step before it waits for the current one, if the next step
    /// may be recorded ahead.
    fn step_on_device(
        &mut self,
        dataset: &Dataset,
        targets: &TargetCache,
        view: usize,
        target: &Target,
        is_left_out: bool,
    ) -> Result<StepOutcome, TrainError> {
        let (step, render) = (self.state.step, self.render_options());
        if let Some(error) = self.ahead.failed.take() {
            return Err(error);
        }
        // Without corrections and masks no step needs its picture on the host.
        if !self.is_ahead() && !self.needs_host(step) {
            self.record(dataset, 0, target)?;
        }
        if self.is_ahead() {
            self.record_next(dataset, targets)?;
            let tier = DeviceTier::of_run(&mut self.device, &self.scene, &mut *self.renderer, self.options.steps)?;
            let _span = trace::span("finish step").with("in_flight", tier.flights.in_flight() as u64);
            if let Some(outcome) = tier.flights.finish(&mut tier.cache, &mut self.scene, &mut *self.renderer)? {
                return Ok(outcome);
            }
        }
        let next = self.turns.coming(self.state.step, 2, &self.photos).get(1).map(|&view| &dataset.views[view].camera);
        let (renderer, scene, working) = (&mut *self.renderer, &mut self.scene, &mut self.working);
        let tier = DeviceTier::of_run(&mut self.device, scene, renderer, self.options.steps)?;
        let mut rows = DeviceRows::new(tier, scene, renderer, (step, next))?;
        let (camera, collects) = (&dataset.views[view].camera, self.options.strategy.collects(step));
        let mut comparison = Comparison { target, loss: self.options.loss, photos: &mut self.photos, is_left_out };
        let view = StepView { step, camera, render: &render, collects, pages_most: self.memory.pages_most };
        train_step(scene, working, &mut rows, &view, &mut comparison)
    }

    /// Records the step `ahead` steps from now, whose photo is `target`. False if the step cannot be recorded now.
    fn record(&mut self, dataset: &Dataset, ahead: u32, target: &Target) -> Result<bool, TrainError> {
        let views = self.turns.coming(self.state.step, ahead + 2, &self.photos);
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
            rows_before: self.ahead.rows_of_views.get(view).copied().unwrap_or(0),
            share: self.memory.visible_share,
            pages_most: self.memory.pages_most,
        };
        let tier = DeviceTier::of_run(&mut self.device, &self.scene, &mut *self.renderer, self.options.steps)?;
        if !tier.flights.may_record() {
            return Ok(false);
        }
        tier.flights.record(&mut tier.cache, &mut self.scene, &mut *self.renderer, &to_record)
    }

    /// Records the step behind the one in flight, if it may be recorded. An error of reading its pages is reported when the step is due.
    fn record_next(&mut self, dataset: &Dataset, targets: &TargetCache) -> Result<(), TrainError> {
        let may_record = self.device.as_ref().is_some_and(|tier| tier.flights.may_record());
        let step = self.state.step;
        if !may_record || !self.ahead.is_allowed || self.needs_host(step + 1) || !self.has_no_event_or_end_after(step) {
            return Ok(());
        }
        let Some(&view) = self.turns.coming(self.state.step, 2, &self.photos).get(1) else { return Ok(()) };
        let photo = trace::span("photo");
        // The step itself reports a photo that cannot be read, with nothing in flight.
        let Ok(target) = targets.get(view) else { return Ok(()) };
        drop(photo);
        match self.record(dataset, 1, &target) {
            Err(error @ TrainError::Paging(_)) => self.ahead.failed = Some(error),
            recorded => self.ahead.photo = recorded?.then_some((step + 1, target)),
        }
        Ok(())
    }

    fn needs_host(&self, step: u32) -> bool {
        self.photos.iter().any(|parameter| parameter.needs_host(step))
    }

    /// Whether no event follows 0-based `step`, and no outcome of the step can end the run.
    fn has_no_event_or_end_after(&self, step: u32) -> bool {
        let strategy = &self.options.strategy;
        let reads = strategy.reads_histogram(step) || strategy.is_growth_checked(step);
        let is_steady = self.state.steps_skipped_in_a_row == 0 && self.state.idle.steps == 0;
        if reads || !is_steady || self.options.sh_degree_at(step + 1) > self.scene.rules.sh_degree {
            return false;
        }
        let count = RowCount::unlimited(self.scene.rows_bound());
        strategy.events_after(step, self.options.scene_scale, count, &self.scene.histogram).is_empty()
    }

    /// Copies back the pages that are newer on a device than in memory, so that the pages and their histogram are those
    /// of the last step. Nothing for a run that updates in host memory.
    /// Errors: the device failed: the run can go on from its last commit only.
    pub fn drain(&mut self) -> Result<(), TrainError> {
        let _span = trace::span("drain all");
        match &mut self.device {
            Some(tier) => tier.drain(&mut self.scene, &mut *self.renderer),
            None => Ok(()),
        }
    }

    /// Decides and logs the events of the last step, unless that is done. They act on values after that step's update.
    /// Errors: as [`Trainer::check_growth`].
    pub(crate) fn log_due_events(&mut self, dataset: &Dataset, targets: &TargetCache) -> Result<(), TrainError> {
        let Some(step) = self.state.step.checked_sub(1) else { return Ok(()) };
        // A failed attempt of the coming step has logged them already.
        if self.events().events().last().is_some_and(|last| last.step >= step) {
            return Ok(());
        }
        let _span = trace::span("decide events");
        if let Some(tier) = self.device.as_ref().filter(|_| self.options.strategy.reads_histogram(step)) {
            tier.take_bins(&mut self.scene, &mut *self.renderer)?;
        }
        self.check_growth(step, dataset, targets)?;
        let scale = self.options.scene_scale;
        let count = RowCount { rows: self.scene.rows_bound(), allowed: self.allowed(dataset) };
        let kinds = self.options.strategy.events_after(step, scale, count, &self.scene.histogram);
        kinds.into_iter().for_each(|kind| self.scene.log_event(Event { step, kind }));
        let degree = self.options.sh_degree_at(step + 1);
        if degree > self.scene.rules.sh_degree {
            self.scene.log_event(Event { step, kind: EventKind::RaiseShDegree { degree } });
        }
        Ok(())
    }

    /// Rows that the run allows now.
    fn allowed(&mut self, dataset: &Dataset) -> u64 {
        let Some(rule) = self.options.strategy.growth() else { return u64::MAX };
        if self.state.growth.first == 0 {
            let rows = self.scene.rows_bound();
            // Without held-out views the count stays as it is.
            let decides = !self.turns.held_out.positions.is_empty();
            self.state.growth.first = if decides { rule.first(rows, self.turns.pixels(dataset)) } else { rows };
        }
        self.state.growth.allowed()
    }

    /// Whether the pixels of the photos allow no stage of growth beyond the Gaussians that the last check allowed.
    pub fn photos_allow_no_more(&self, dataset: &Dataset) -> bool {
        let rule = self.options.strategy.growth();
        rule.is_some_and(|rule| !rule.has_room(self.state.growth.allowed(), self.turns.pixels(dataset)))
    }

    /// The checks by which the run decides its count so far.
    pub fn growth(&self) -> &[GrowthCheck] {
        &self.state.growth.checks
    }

    /// Evaluates the held-out views at the current step. `progress` is called with the number of views done.
    /// Errors: as [`evaluate`].
    pub fn evaluate(
        &mut self,
        dataset: &Dataset,
        targets: &TargetCache,
        pictures: Option<&Path>,
        progress: &dyn Fn(u32),
    ) -> Result<Option<TestMetrics>, TrainError> {
        let _span = trace::span("evaluate");
        self.drain()?;
        let render = self.render_options();
        let request = EvalRequest::of_held_out(dataset, &self.options, &self.photos, pictures, progress);
        self.run_memory().fit_frames_to_widest(request.views.iter().map(|&view| &dataset.views[view].camera));
        let test = evaluate(&mut self.now(), dataset, targets, &render, &request)?;
        let of = |t: TestMetrics| LastTest { step: self.state.step, views: t.views, psnr: t.psnr, ssim: t.ssim };
        self.state.test = test.map(of).or(self.state.test);
        Ok(test)
    }

    /// Updates the pager's plan every [`LOOK_AHEAD_EVERY`] steps; doing it at every step would cost too much.
    fn look_ahead(&mut self, dataset: &Dataset) {
        let pages = self.scene.pager.index().len();
        let is_on_device_in_part = self.device.as_ref().is_some_and(|tier| tier.cache.slots() < pages);
        let has_plan = !self.scene.is_in_memory() || is_on_device_in_part;
        self.expect_edits();
        // The step in flight has begun already.
        let first = usize::from(self.is_ahead());
        // Views are judged between epochs.
        let is_due = self.state.step.is_multiple_of(LOOK_AHEAD_EVERY)
            || self.state.step.is_multiple_of(self.turns.views.len() as u32);
        if !has_plan || !is_due {
            return;
        }
        if self.scene.is_in_memory() {
            self.scene.pager.plan_for_tier_above(DEVICE_PLAN_BYTES);
        }
        // Two epochs contain a use of every page that any view needs.
        let count = (2 * self.turns.views.len() as u32).clamp(LOOK_AHEAD_LEAST, LOOK_AHEAD_MOST);
        let coming = self.turns.coming(self.state.step, count, &self.photos);
        let cameras: Vec<Camera> =
            coming.iter().skip(first).map(|&view| photos::camera(&self.photos, dataset, view)).collect();
        let cameras: Vec<&Camera> = cameras.iter().collect();
        self.scene.pager.look_ahead(self.state.step + first as u32, &cameras);
    }

    /// Tells the device which coming step is the next after which events edit every page: an opacity reset, or a raise of the SH degree.
    fn expect_edits(&mut self) {
        let options = &self.options;
        let raises = |step: u32| options.sh_degree_at(step + 1) > options.sh_degree_at(step);
        if let Some(tier) = &mut self.device {
            let edits_all = |step| options.strategy.edits_all_after(step) || raises(step);
            tier.cache.expect_edits(self.state.step, options.steps, edits_all);
        }
    }

    /// Prepares the parameters for the coming step on a view, or for its rehearsal.
    fn begin_step_of_photo(&mut self, view: usize, camera: &Camera, is_left_out: bool, is_rehearsal: bool) {
        let (step, events) = (self.state.step, self.scene.events());
        let at = PhotoStep { view, step, camera, events, is_left_out, is_rehearsal };
        self.photos.iter_mut().for_each(|parameter| parameter.begin_step(&at));
    }

    /// Lets the parameters learn from the current step, which was taken or skipped.
    fn end_step_of_photo(&mut self, view: usize, done: &StepOutcome, photo: &Target, dataset: &Dataset) {
        let StepOutcome { is_left_out, ref loss, .. } = *done;
        let (step, is_skipped, mse) = (self.state.step, done.skipped.is_some(), loss.mse);
        let ended_group = self.turns.order.group_ended_by(step);
        let after_reset = steps_after_reset(self.scene.events(), step);
        let outcome =
            PhotoOutcome { view, step, is_skipped, is_left_out, ended_group, after_reset, mse, photo, dataset };
        let warnings = self.photos.iter_mut().flat_map(|parameter| parameter.end_step(&outcome));
        warnings.for_each(|warning| crate::tell!("warning: {warning}"));
    }

    /// Decides how many Gaussians the run allows from the round after the last step on, if that is due.
    /// Errors: a photo cannot be decoded, pages could not be had, or the renderer failed. The decision is still due then.
    fn check_growth(&mut self, step: u32, dataset: &Dataset, targets: &TargetCache) -> Result<(), TrainError> {
        let strategy = self.options.strategy.clone();
        let Some(rule) = strategy.growth().filter(|_| strategy.is_growth_checked(step)) else { return Ok(()) };
        let positions = &self.turns.held_out.positions;
        let is_done = self.state.growth.checks.last().is_some_and(|last| last.step > step);
        // Without held-out views the count stays as it is.
        if positions.is_empty() || is_done || self.state.growth.is_decided() {
            return Ok(());
        }
        let started = Instant::now();
        // The trained views are the second ones after the held-out views: the first ones train twice as often as others. Poses may be refined.
        let views = &self.turns.views;
        let [held_out, trained] = [0, 2].map(|after| {
            let view = |&at: &usize| views[(at + after) % views.len()];
            let camera = |view: usize| (view, photos::camera(&self.photos, dataset, view));
            positions.iter().map(view).map(camera).collect::<Vec<_>>()
        });
        self.drain()?;
        self.run_memory().fit_frames_to_widest(held_out.iter().chain(&trained).map(|(_, camera)| camera));
        let compared = Comparing {
            targets,
            render: &self.render_options(),
            pages_most: self.memory.pages_most,
            // A photo that was never trained on has no exposure yet. All checks of a run use one measure, also after exposures were dropped.
            fits_exposures: self.options.photos.appearance.is_on(),
        };
        let measured = [&held_out, &trained].map(|views| measure(&mut self.now(), &compared, views));
        let [held_out, trained] = measured;
        match (held_out?, trained?) {
            (Some(held_out), Some(trained)) => {
                let counts = [self.scene.rows_bound(), self.turns.pixels(dataset)];
                let check = rule.check(step, counts, [held_out, trained], &self.state.growth);
                self.state.growth.checks.push(check);
            }
            // Without a view that counts the count stays as it is.
            _ => self.masked.tell_undecided(),
        }
        self.state.train_seconds += started.elapsed().as_secs_f64();
        Ok(())
    }
}

impl Ahead {
    fn note_rows_of(&mut self, view: usize, rows: usize) {
        if self.rows_of_views.len() <= view {
            self.rows_of_views.resize(view + 1, 0);
        }
        self.rows_of_views[view] = u32::try_from(rows).unwrap_or(u32::MAX);
    }
}
