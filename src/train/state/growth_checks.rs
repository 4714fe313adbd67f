//! The checks of a run that decides its count: how good the held-out training views are, and what they lose without their faintest
//! Gaussians.
//!
//! Not here: the decision ([`crate::densify::growth`]), the views (`held_out`), the loss of one of them (`leave_out`).
//!
//! Invariants: 1. a check changes no row; 2. a check that failed is still due.

use super::leave_out::{Compared, psnr_of_view, psnr_without_faint};
use super::trainer::Trainer;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::densify::growth::GrowthValues;
use crate::render::Renderer;
use crate::render::color_correct::ColorCorrect;
use crate::scene::camera::Camera;
use crate::train::error::TrainError;
use crate::train::step::view::Now;
use std::time::Instant;

impl Trainer {
    /// Decides how many Gaussians the run allows from the round after the last step on, if that is due.
    ///
    /// # Errors
    /// A photo cannot be decoded, pages could not be had, or the renderer failed. The decision is still due then.
    pub(super) fn check_growth(
        &mut self,
        step: u32,
        dataset: &Dataset,
        targets: &TargetCache,
    ) -> Result<(), TrainError> {
        let strategy = self.options.strategy.clone();
        let (Some(rule), Some(number)) = (strategy.growth(), strategy.growth_check(step)) else { return Ok(()) };
        // Without held-out views the count stays as it is.
        if self.held_out.positions().is_empty() || self.state.growth.checks.last().is_some_and(|last| last.step > step)
        {
            return Ok(());
        }
        let started = Instant::now();
        self.drain()?;
        // Without a view that counts the count stays as it is, too.
        if let Some(values) = self.growth_values(dataset, targets)? {
            let check = rule.check((number, step), self.scene.rows_bound(), values, &self.state.growth);
            self.state.growth.checks.push(check);
        }
        self.state.train_seconds += started.elapsed().as_secs_f64();
        Ok(())
    }

    /// What the check measures; `None` if all held-out views, or all that they are compared with, are masked as a whole.
    fn growth_values(&mut self, dataset: &Dataset, targets: &TargetCache) -> Result<Option<GrowthValues>, TrainError> {
        let positions = self.held_out.positions();
        // The view after a held-out one is trained on in its place, so twice as often as others.
        let trained: Vec<usize> = positions.iter().map(|&at| (at + 2) % self.train_views.len()).collect();
        let [held_out, trained] = [positions, &trained].map(|at| at.iter().map(|&at| self.train_views[at]).collect());
        let held_out = self.mean_psnr(held_out, psnr_without_faint, (dataset, targets))?;
        let trained = self.mean_psnr(trained, psnr_of_view, (dataset, targets))?;
        let (Some([psnr, lost]), Some([trained_psnr])) = (held_out, trained) else { return Ok(None) };
        Ok(Some(GrowthValues { psnr, trained_psnr, lost: psnr - lost }))
    }

    /// Means of values of these views; `None` if none of them counts.
    fn mean_psnr<const N: usize>(
        &mut self,
        views: Vec<usize>,
        of_view: impl Fn(Now<'_>, &mut dyn Renderer, &Compared<'_>) -> Result<[f64; N], TrainError>,
        (dataset, targets): (&Dataset, &TargetCache),
    ) -> Result<Option<[f64; N]>, TrainError> {
        // Those of views that were trained on may have moved.
        let cameras: Vec<Camera> = views.iter().map(|&view| self.camera(dataset, view)).collect();
        self.fit_widest(&cameras);
        let corrects = self.photos.iter().any(|parameter| parameter.corrects());
        let render = self.render_options();
        let mut values: Vec<[f64; N]> = Vec::with_capacity(views.len());
        for (i, &view) in views.iter().enumerate() {
            targets.prefetch(&views[i..views.len().min(i + 2)]);
            let target = targets.get(view)?;
            if !target.counts() {
                continue;
            }
            let compared = Compared {
                camera: &cameras[i],
                target: &target,
                render: &render,
                loss: &self.options.loss,
                pages_most: self.pages_most,
                // A photo that was never trained on has no exposure yet.
                correct: corrects.then_some(ColorCorrect::Affine),
            };
            let now = (&mut self.scene, self.state.step, &mut self.working);
            values.push(of_view(now, &mut *self.renderer, &compared)?);
        }
        let mean = |k: usize| values.iter().map(|of_view| of_view[k]).sum::<f64>() / values.len() as f64;
        Ok((!values.is_empty()).then(|| std::array::from_fn(mean)))
    }
}
