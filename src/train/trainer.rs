//! The loop over steps: views in order, events where they are due, metrics, evaluation and saves.
//! Longer than other files: all of it is the loop's own state and the order in which things happen to it; what is done at each
//! point lies elsewhere.
//!
//! Invariants: 1. the state after step s is a function of dataset, config and s alone, not of threads, budgets or
//! cadences of logging and evaluation; 2. a step whose loss is not finite changes nothing, and three in a row end
//! the run with what the last good step left.

use super::budget::HostBudget;
use super::dense::settle_all;
use super::error::TrainError;
use super::eval::{EvalRequest, evaluate};
use super::pages::PagedScene;
use super::report::{TestMetrics, TierTraffic};
use super::step::{StepOutcome, train_step};
use super::view::rehearse;
use super::working_set::WorkingSet;
use crate::checkpoint::run_state::LastTest;
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::exchange::ply::{self, PlyMeta};
use crate::optim::method::Method;
use crate::paging::pager::{Pager, PagerConfig};
use crate::render::{RenderOptions, Renderer};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::events::{Event, EventKind, EventLog};
use crate::scene::image::Target;
use crate::schedule::order::{Order, ViewOrder};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Steps in a row with a loss that is not finite after which a run ends.
const NON_FINITE_STEPS_MAX: u32 = 3;
/// Views whose photos are asked for ahead of their steps.
const PREFETCH_VIEWS: u32 = 8;

/// Steps from one look at the coming views to the next, and how many views are looked at.
const LOOK_AHEAD_EVERY: u32 = 8;
const LOOK_AHEAD_LEAST: u32 = 64;
const LOOK_AHEAD_MOST: u32 = 8192;

/// A run. In memory is the same code with as many frames as there are pages.
pub struct Trainer {
    /// The rows, in pages, with the optimizer and the events.
    pub scene: PagedScene,
    /// The renderer.
    pub renderer: Box<dyn Renderer>,
    pub(super) options: RunOptions,
    order: ViewOrder,
    train_views: Vec<usize>,
    pub(super) working: WorkingSet,
    pub(super) step: u32,
    pub(super) rows_skipped: u64,
    pub(super) steps_skipped: u32,
    pub(super) steps_skipped_in_a_row: u32,
    pub(super) train_seconds: f64,
    /// The last evaluation on the held-out views.
    pub(super) last_test: Option<LastTest>,
    /// A step failed after it had changed rows: there is nothing to commit.
    pub(super) is_torn: bool,
    /// What the frames share with all else, where their number follows from it.
    pub(super) budget: Option<HostBudget>,
    /// The most pages of a batch of a step.
    pub(super) pages_most: usize,
    /// The most rows of a view so far.
    pub(super) rows_of_view: usize,
}

fn view_order(order: Order, seed: u64, dataset: &Dataset) -> ViewOrder {
    let cameras: Vec<Camera> = dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect();
    ViewOrder::new(order, seed, &cameras)
}

impl Trainer {
    /// A trainer of first Gaussians `columns` on the training views of `dataset` (at least one), all pages in memory.
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

    /// A trainer whose pages are where `pager` (without pages yet) puts them.
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

    /// A trainer of pages that were made with the same options.
    pub fn of_scene(scene: PagedScene, dataset: &Dataset, renderer: Box<dyn Renderer>, options: RunOptions) -> Trainer {
        let train_views = dataset.train_views();
        Trainer {
            scene,
            order: view_order(options.view_order, options.seed, dataset),
            train_views,
            working: WorkingSet::default(),
            renderer,
            options,
            step: 0,
            rows_skipped: 0,
            steps_skipped: 0,
            steps_skipped_in_a_row: 0,
            train_seconds: 0.0,
            last_test: None,
            is_torn: false,
            budget: None,
            pages_most: usize::MAX,
            rows_of_view: 0,
        }
    }

    /// Renders views of the dataset, forward and backward, so that the memory of a view is allocated; changes no state.
    /// Returns the most pixels of a view.
    ///
    /// # Errors
    /// A view cannot be rendered.
    pub fn probe_views(&mut self, dataset: &Dataset, views: &[usize]) -> Result<usize, TrainError> {
        let render = self.render_options();
        let mut pixels = 0;
        for &view in views {
            let camera = &dataset.views[view].camera;
            let rgb = vec![0; 3 * camera.pixels()];
            let target = Target { width: camera.width, height: camera.height, rgb, mask: None };
            let how = (&render, &self.options.loss);
            let now = (&mut self.scene, self.step, &mut self.working);
            let rows = rehearse(now, &mut *self.renderer, (camera, &target), how, self.pages_most)?;
            self.rows_of_view = self.rows_of_view.max(rows);
            pixels = pixels.max(camera.pixels());
        }
        Ok(pixels)
    }

    /// Trains in this order of views from the first step on; for orders that are settled after the pages are known.
    pub fn set_view_order(&mut self, order: Order, dataset: &Dataset) {
        self.order = view_order(order, self.options.seed, dataset);
    }

    /// The order of views.
    pub fn view_order(&self) -> &ViewOrder {
        &self.order
    }

    /// Bytes held for one view: its rows with their gradients, and what the renderer has.
    pub fn view_bytes(&self) -> [u64; 2] {
        [self.working.bytes() as u64, self.renderer.host_bytes()]
    }

    /// Degrees in use now and at the last step.
    pub fn sh_degrees(&self) -> (u8, u8) {
        (self.scene.rules.sh_degree(), self.options.sh_degree_at(self.options.steps.saturating_sub(1)))
    }

    /// Steps done.
    pub fn steps_done(&self) -> u32 {
        self.step
    }

    /// Index into the dataset's views of the view that the next step trains on.
    pub fn next_view(&mut self) -> usize {
        self.train_views[self.order.view_at(self.step)]
    }

    /// Seconds spent in steps.
    pub fn train_seconds(&self) -> f64 {
        self.train_seconds
    }

    /// Gaussians whose update was skipped, and steps that were, because something was not finite.
    pub fn skipped(&self) -> (u64, u32) {
        (self.rows_skipped, self.steps_skipped)
    }

    /// What moved between the tiers since the run began, over all its lives.
    pub fn tier_traffic(&self) -> TierTraffic {
        TierTraffic::of(&self.scene.pager)
    }

    /// Options of a rendering now: with the bands that are in use.
    pub fn render_options(&self) -> RenderOptions {
        RenderOptions { sh_degree: self.scene.rules.sh_degree(), ..self.options.render }
    }

    /// The events so far.
    pub fn events(&self) -> &EventLog {
        self.scene.events()
    }

    /// Runs one step and the events that are due after it.
    ///
    /// # Errors
    /// A photo cannot be decoded, the renderer failed, or the loss was not finite too often.
    pub fn step(&mut self, dataset: &Dataset, targets: &TargetCache) -> Result<StepOutcome, TrainError> {
        let view = self.next_view();
        let mut ahead = Vec::new();
        self.order.upcoming(self.step, PREFETCH_VIEWS.min(self.options.steps - self.step), &mut ahead);
        for position in &mut ahead {
            *position = self.train_views[*position];
        }
        targets.prefetch(&ahead);
        self.fit_frames(&dataset.views[view].camera);
        self.look_ahead(dataset);
        let target = targets.get(view)?;
        let started = Instant::now();
        let render = self.render_options();
        let stepped = loop {
            let stepped = train_step(
                &mut self.scene,
                &mut self.working,
                &mut *self.renderer,
                (self.step, &dataset.views[view].camera, &target),
                (&render, &self.options.loss),
                self.options.strategy.collects(self.step),
                self.pages_most,
            );
            self.is_torn = matches!(stepped, Err(TrainError::Torn { .. }));
            // A step without its frames changed nothing that doing it again does not.
            match stepped {
                Err(TrainError::Paging(error)) if self.find_frames(&error) => {}
                stepped => break stepped,
            }
        };
        let outcome = stepped.map_err(|error| error.of_view(&dataset.views[view].name))?;
        self.rows_of_view = self.rows_of_view.max(outcome.rows);
        self.count(&outcome, &dataset.views[view].name)?;
        if self.options.optimizer == Method::Dense {
            // The step has changed rows: if this fails, what is there now belongs to no step.
            self.is_torn = true;
            settle_all(&mut self.scene, self.step + 1)?;
            self.is_torn = false;
        }
        self.log_events();
        self.step += 1;
        self.train_seconds += started.elapsed().as_secs_f64();
        Ok(outcome)
    }

    /// Tells the pager which views come next, now and then: it plans by pages, which costs more than a step should.
    fn look_ahead(&mut self, dataset: &Dataset) {
        if self.is_in_memory() || !self.step.is_multiple_of(LOOK_AHEAD_EVERY) {
            return;
        }
        // Every page of the scene is needed within the next two epochs, if it ever is.
        let count = (2 * self.train_views.len() as u32).clamp(LOOK_AHEAD_LEAST, LOOK_AHEAD_MOST);
        let mut coming = Vec::new();
        self.order.upcoming(self.step, count.min(self.options.steps - self.step), &mut coming);
        let camera = |&position: &usize| &dataset.views[self.train_views[position]].camera;
        let cameras: Vec<&Camera> = coming.iter().map(camera).collect();
        self.scene.pager.look_ahead(self.step, &cameras);
    }

    fn count(&mut self, outcome: &StepOutcome, view: &str) -> Result<(), TrainError> {
        self.rows_skipped += outcome.rows_skipped;
        if !outcome.skipped {
            self.steps_skipped_in_a_row = 0;
            return Ok(());
        }
        self.steps_skipped += 1;
        self.steps_skipped_in_a_row += 1;
        if self.steps_skipped_in_a_row < NON_FINITE_STEPS_MAX {
            return Ok(());
        }
        Err(TrainError::NonFinite {
            step: self.step,
            view: view.to_string(),
            count: self.steps_skipped_in_a_row,
            remedy: "lower the learning rates; if the defaults were used, report this as a bug with the scene",
        })
    }

    /// Events fire after the update of their step, on values that contain it; here they are decided and logged.
    fn log_events(&mut self) {
        let (step, scale) = (self.step, self.options.scene_scale);
        let rows = self.scene.rows_bound();
        let kinds = self.options.strategy.events_after(step, scale, rows, &self.scene.histogram);
        kinds.into_iter().for_each(|kind| self.scene.log_event(Event { step, kind }));
        let degree = self.options.sh_degree_at(step + 1);
        if degree > self.scene.rules.sh_degree() {
            self.scene.log_event(Event { step, kind: EventKind::RaiseShDegree { degree } });
        }
    }

    /// Evaluates on the held-out views as of now.
    ///
    /// # Errors
    /// As [`evaluate`].
    pub fn evaluate(
        &mut self,
        dataset: &Dataset,
        targets: &TargetCache,
        pictures: Option<&Path>,
    ) -> Result<Option<TestMetrics>, TrainError> {
        let render = self.render_options();
        let views = dataset.test_views();
        let request = EvalRequest {
            views: &views,
            ssim: self.options.ssim_variant,
            pictures,
            lpips: None,
            color_correct: self.options.color_correct,
        };
        let now = (&mut self.scene, self.step, &mut self.working);
        let test = evaluate(now, &mut *self.renderer, (dataset, targets), &render, &request)?;
        let of = |t: TestMetrics| LastTest { step: self.step, views: t.views, psnr: t.psnr, ssim: t.ssim };
        self.last_test = test.map(of).or(self.last_test);
        Ok(test)
    }

    /// Writes the rows as of now as a PLY; returns what was written, in which coordinates.
    ///
    /// # Errors
    /// The folder cannot be written, or pages could not be had.
    pub fn save(&mut self, dataset: &Dataset, path: &Path) -> Result<ply::PlyWritten, TrainError> {
        let meta = PlyMeta {
            step: Some(u64::from(self.step)),
            origin: dataset.frame.origin.to_array(),
            scale: dataset.frame.scale,
            scene_radius: f64::from(dataset.scene_scale) * dataset.frame.scale,
            frame: self.options.export_frame,
            ..PlyMeta::default()
        };
        let rows_at_most = self.scene.rows_bound();
        let mut writer = ply::PlyWriter::create(path, self.options.sh_degree, rows_at_most, &meta)?;
        self.scene.for_all_rows(self.step, &mut |rows| Ok::<(), TrainError>(writer.write(rows)?))?;
        Ok(writer.finish()?)
    }

    /// The path of the final PLY in an output folder.
    pub fn ply_path(out: &Path) -> PathBuf {
        out.join("point_cloud.ply")
    }
}
