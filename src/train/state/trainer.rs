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
use super::held_out::HeldOut;
use crate::base::trace;
use crate::checkpoint::run_state::{LastTest, TrainerState};
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::densify::growth::GrowthCheck;
use crate::densify::strategy::{RowCount, Strategy};
use crate::optim::method::{Method, OptimizerPlace};
use crate::paging::pager::{Pager, PagerConfig};
use crate::photos::{PhotoParameters, first_parameters};
use crate::render::view_sizes::ViewSizes;
use crate::render::{RenderOptions, Renderer};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::events::{Event, EventKind, EventLog};
use crate::scene::image::Target;
use crate::schedule::order::{Order, ViewOrder};
use crate::train::error::TrainError;
use crate::train::log::report::{TestMetrics, TierTraffic};
use crate::train::memory::budget::HostBudget;
use crate::train::step::batch::HostRows;
use crate::train::step::comparison::Comparison;
use crate::train::step::dense::settle_all;
use crate::train::step::device_tier::DeviceTier;
use crate::train::step::pages::PagedScene;
use crate::train::step::soundness::{Idle, note_soundness};
use crate::train::step::train_step::{StepOutcome, train_step};
use crate::train::step::view::rehearse;
use crate::train::step::working_set::WorkingSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Views whose photos are prefetched.
const PREFETCH_VIEWS: u32 = 8;

/// The state of a run. A run in memory uses the same code with one frame per page.
pub struct Trainer {
    /// The pages, the optimizer and the event log.
    pub scene: PagedScene,
    pub renderer: Box<dyn Renderer>,
    /// The pages on the renderer's device, from the first step of a run that updates them there.
    pub(crate) device: Option<DeviceTier>,
    pub(crate) options: RunOptions,
    pub(crate) order: ViewOrder,
    pub(crate) train_views: Vec<usize>,
    /// Training views that the run decides its count by.
    pub(crate) held_out: HeldOut,
    /// What the run knows of its photos.
    pub(crate) photos: PhotoParameters,
    pub(crate) working: WorkingSet,
    /// Everything that a commit saves and a resume restores, besides the pages and what is known of photos.
    pub(crate) state: TrainerState,
    /// A step failed after it had changed rows, so the state must not be committed.
    pub(crate) is_torn: bool,
    /// Memory budget from which the number of frames follows; `None` without a budget.
    pub(crate) budget: Option<HostBudget>,
    /// The most pages of a batch of a step.
    pub(crate) pages_most: usize,
    /// The most rows in the pages of a view that was one batch, since the working set was allocated.
    pub(crate) whole_rows: u64,
    /// The most rows in the pages of a view since the renderer freed its rows, and the bytes that the rows of the coming view
    /// need in the renderer.
    pub(crate) rendered_rows: u64,
    pub(crate) row_bytes_due: u64,
    /// The largest share of the rows in its pages that a view has drawn so far.
    pub(crate) visible_share: f64,
    /// The steps since a row was last rewritten.
    pub(super) idle: Idle,
    /// The caller does nothing with the scene between the step that it takes and the next one, which may be recorded ahead.
    pub(crate) goes_ahead: bool,
    /// The error that kept a step from being recorded ahead.
    pub(super) ahead_failed: Option<TrainError>,
    /// Rows that each view listed last; 0 or missing for a view that this process has not drawn.
    pub(super) rows_of_views: Vec<u32>,
}

/// The strategy of a run whose views come in this order, from the strategy of its config.
fn strategy_in(order: &ViewOrder, strategy: &Arc<dyn Strategy>) -> Arc<dyn Strategy> {
    strategy.for_regions(order.regional_epoch()).unwrap_or_else(|| Arc::clone(strategy))
}

fn view_order(order: Order, seed: u64, dataset: &Dataset) -> ViewOrder {
    let cameras: Vec<Camera> = dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect();
    ViewOrder::new(order, seed, &cameras)
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
    ///
    /// # Errors
    /// As [`Trainer::with_pager`].
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
    ///
    /// # Errors
    /// A page could not be stored.
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
        let train_views = dataset.train_views();
        let order = view_order(options.view_order, options.seed, dataset);
        let options = RunOptions { strategy: strategy_in(&order, &options.strategy), ..options };
        Trainer {
            scene,
            order,
            held_out: HeldOut::new(&options.strategy, train_views.len()),
            train_views,
            photos: first_parameters(&options.photos, dataset),
            working: WorkingSet::default(),
            renderer,
            device: None,
            options,
            state: TrainerState::default(),
            is_torn: false,
            budget: None,
            pages_most: usize::MAX,
            whole_rows: 0,
            rendered_rows: 0,
            row_bytes_due: 0,
            visible_share: 0.0,
            idle: Idle::default(),
            goes_ahead: false,
            ahead_failed: None,
            rows_of_views: Vec::new(),
        }
    }

    /// Counts the steps from `step` on: an earlier run has done them, in `train_seconds` seconds. Call this before the first
    /// step.
    pub(crate) fn begin_after(&mut self, step: u32, train_seconds: f64) {
        (self.state.step, self.state.train_seconds) = (step, train_seconds);
    }

    /// Renders views forward and backward so that the memory of a view is allocated; the scene stays unchanged. Returns
    /// the pixels of the largest view, the most rows that a view draws, and how long a view takes.
    ///
    /// # Errors
    /// A view cannot be rendered.
    pub fn probe_views(&mut self, dataset: &Dataset, views: &[usize]) -> Result<Probed, TrainError> {
        self.drain()?;
        let render = self.render_options();
        let (mut probed, mut seconds) = (Probed::default(), Vec::new());
        for &view in views {
            let camera = &self.camera(dataset, view);
            let rgb = vec![0; 3 * camera.pixels()];
            let target = Target { width: camera.width, height: camera.height, rgb, mask: None };
            self.begin_step_of_photo(view, camera, false, true);
            let mut comparison = Comparison { photos: &mut self.photos, ..Comparison::new(&target, self.options.loss) };
            let now = (&mut self.scene, self.state.step, &mut self.working);
            let began = Instant::now();
            let rows = rehearse(now, &mut *self.renderer, camera, (&render, &mut comparison), self.pages_most)?;
            seconds.push(began.elapsed().as_secs_f64());
            let index = self.scene.pager.index();
            let pages = self.scene.pager.pages_of_view(camera);
            let is_whole = self.scene.pager.pages_per_batch(pages.len()).min(self.pages_most) >= pages.len();
            self.note_view(rows, pages.iter().map(|page| index[page.index()].rows as usize).sum(), is_whole);
            (probed.pixels, probed.visible) = (probed.pixels.max(camera.pixels()), probed.visible.max(rows));
            let sizes = self.renderer.device_sizes();
            probed.device = sizes.map(|sizes| probed.device.map_or(sizes, |most| most.max(sizes)));
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
        self.order = view_order(order, self.options.seed, dataset);
        self.options.view_order = order;
        // The rules of the pages hold the strategy of the config.
        self.options.strategy = strategy_in(&self.order, &self.scene.rules.strategy);
        self.held_out = HeldOut::new(&self.options.strategy, self.train_views.len());
    }

    pub fn view_order(&self) -> &ViewOrder {
        &self.order
    }

    /// Bytes of one view: rows of the working set; renderer and picture. What is held, and what the coming view needs on top.
    pub fn view_bytes(&self) -> [u64; 2] {
        let due = self.row_bytes_due.saturating_sub(self.renderer.host_bytes_of_rows());
        let photos: u64 = self.photos.iter().map(|parameter| parameter.buffer_bytes()).sum();
        [self.working.bytes() as u64, self.renderer.host_bytes() + due + photos]
    }

    pub fn options(&self) -> &RunOptions {
        &self.options
    }

    /// SH degree now and at the last step.
    pub fn sh_degrees(&self) -> (u8, u8) {
        (self.scene.rules.sh_degree(), self.options.sh_degree_at(self.options.steps.saturating_sub(1)))
    }

    pub fn steps_done(&self) -> u32 {
        self.state.step
    }

    /// Index in `dataset.views` of the next step's view.
    pub fn next_view(&mut self) -> usize {
        let position = self.order.view_at(self.state.step);
        self.view_in_turn(self.state.step, position)
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
        RenderOptions { sh_degree: self.scene.rules.sh_degree(), ..self.options.render }
    }

    pub fn events(&self) -> &EventLog {
        self.scene.events()
    }

    /// Logs the events that follow the last step, and runs one step.
    ///
    /// # Errors
    /// A photo cannot be decoded, pages could not be pinned, the renderer failed, the run diverged, or nothing counts in it
    /// (`soundness`).
    pub fn step(&mut self, dataset: &Dataset, targets: &TargetCache) -> Result<StepOutcome, TrainError> {
        trace::set_step(self.state.step);
        let _span = trace::span("step");
        self.log_due_events(dataset, targets)?;
        let view = self.next_view();
        targets.prefetch(&self.coming_views(PREFETCH_VIEWS));
        if !self.is_ahead() {
            self.fit_frames(&self.camera(dataset, view));
        }
        self.prepare_device()?;
        self.look_ahead(dataset);
        let photo = trace::span("photo");
        let target = targets.get(view)?;
        drop(photo);
        let started = Instant::now();
        let render = self.render_options();
        let is_left_out = self.photos.iter().any(|parameter| parameter.leaves_out(view));
        let stepped = loop {
            let stepped = self.attempt((dataset, targets), view, &render, (&target, is_left_out));
            self.is_torn = matches!(stepped, Err(TrainError::Torn { .. }));
            // A step that lacked frames can be repeated: it only applied pending events.
            match stepped {
                Err(TrainError::Paging(error)) if self.add_missing_frames(&error) => {}
                stepped => break stepped,
            }
        };
        let outcome = stepped.map_err(|error| error.with_view_name(&dataset.views[view].name))?;
        self.note_view(outcome.rows, outcome.rows_pinned, outcome.batches == 1);
        self.note_rows_of(view, outcome.rows);
        note_soundness(&mut self.state, &outcome, &dataset.views[view].name, &self.options.init_ply)?;
        self.idle.note(&outcome, (self.state.step, self.scene.rows()), &target, dataset)?;
        if self.options.optimizer == Method::Dense {
            // The step has changed rows; an error here leaves a state between two steps.
            self.is_torn = true;
            settle_all(&mut self.scene, self.state.step + 1)?;
            self.is_torn = false;
        }
        self.end_step_of_photo(view, &outcome, &target, dataset);
        self.state.step += 1;
        self.state.train_seconds += started.elapsed().as_secs_f64();
        Ok(outcome)
    }

    /// Attempts a step on a view.
    fn attempt(
        &mut self,
        inputs: (&Dataset, &TargetCache),
        view: usize,
        render: &RenderOptions,
        (target, is_left_out): (&Target, bool),
    ) -> Result<StepOutcome, TrainError> {
        let (step, camera) = (self.state.step, &self.camera(inputs.0, view));
        self.begin_step_of_photo(view, camera, is_left_out, false);
        if self.options.optimizer_on == OptimizerPlace::Device {
            return self.step_on_device(inputs, view, (target, is_left_out));
        }
        let mut comparison = Comparison { target, loss: self.options.loss, photos: &mut self.photos, is_left_out };
        let collects = self.options.strategy.collects(step);
        let mut rows = HostRows::new(&mut *self.renderer);
        let (scene, working) = (&mut self.scene, &mut self.working);
        let how = (render, &mut comparison);
        train_step(scene, working, &mut rows, (step, camera), how, collects, self.pages_most)
    }

    /// Gives the pages of a run that updates on a device their slots, so that the first plan knows them.
    fn prepare_device(&mut self) -> Result<(), TrainError> {
        if self.options.optimizer_on == OptimizerPlace::Device {
            DeviceTier::of_run(&mut self.device, &self.scene, &mut *self.renderer, self.options.steps)?;
        }
        Ok(())
    }

    /// Copies back the pages that are newer on a device than in memory, so that the pages and their histogram are those
    /// of the last step. Nothing for a run that updates in host memory.
    ///
    /// # Errors
    /// The device failed: the run can go on from its last commit only.
    pub fn drain(&mut self) -> Result<(), TrainError> {
        let _span = trace::span("drain all");
        match &mut self.device {
            Some(tier) => tier.drain(&mut self.scene, &mut *self.renderer),
            None => Ok(()),
        }
    }

    /// Stores how many of the rows in the pages of a view were drawn, and whether the view was one batch.
    fn note_view(&mut self, visible: usize, in_pages: usize, is_whole: bool) {
        self.whole_rows = self.whole_rows.max(if is_whole { in_pages as u64 } else { 0 });
        self.rendered_rows = self.rendered_rows.max(in_pages as u64);
        self.visible_share = self.visible_share.max(visible as f64 / in_pages.max(1) as f64);
    }

    /// Decides and logs the events of the last step, unless that is done. They act on values after that step's update.
    ///
    /// # Errors
    /// As [`Trainer::check_growth`].
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
        let count = RowCount { rows: self.scene.rows_bound(), allowed: self.allowed() };
        let kinds = self.options.strategy.events_after(step, scale, count, &self.scene.histogram);
        kinds.into_iter().for_each(|kind| self.scene.log_event(Event { step, kind }));
        let degree = self.options.sh_degree_at(step + 1);
        if degree > self.scene.rules.sh_degree() {
            self.scene.log_event(Event { step, kind: EventKind::RaiseShDegree { degree } });
        }
        Ok(())
    }

    /// Rows that the run allows now.
    fn allowed(&mut self) -> u64 {
        if self.options.strategy.growth().is_none() {
            return u64::MAX;
        }
        if self.state.growth.first == 0 {
            self.state.growth.first = self.scene.rows_bound();
        }
        self.state.growth.allowed()
    }

    /// The checks by which the run decides its count so far.
    pub fn growth(&self) -> &[GrowthCheck] {
        &self.state.growth.checks
    }

    /// Evaluates the held-out views at the current step. `progress` is called with the number of views done.
    ///
    /// # Errors
    /// As [`evaluate`].
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
        let views = dataset.test_views();
        self.fit_widest(views.iter().map(|&view| &dataset.views[view].camera));
        let request = EvalRequest {
            views: &views,
            ssim: self.options.ssim_variant,
            pictures,
            lpips: None,
            color_correct: self.options.color_correct,
            appearance: self.options.photos.appearance,
            progress,
        };
        let now = (&mut self.scene, self.state.step, &mut self.working);
        let test = evaluate(now, &mut *self.renderer, (dataset, targets), &render, &request)?;
        let of = |t: TestMetrics| LastTest { step: self.state.step, views: t.views, psnr: t.psnr, ssim: t.ssim };
        self.state.test = test.map(of).or(self.state.test);
        Ok(test)
    }
}
