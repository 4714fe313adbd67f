//! What a run knows of its photos: their exposures and colours, where their cameras stand, which of them contradict the scene, and
//! which blocks of them do. Steps read it before they compare a picture, and add to it afterwards.
//!
//! Not here: the values themselves ([`crate::appearance`], [`crate::poses`], [`crate::outliers`]).
//!
//! Invariants: 1. a step that was skipped teaches nothing about exposures, colours, poses and blocks; 2. all that is known lies in
//! [`crate::checkpoint::run_state::TrainerState`], so a resumed run knows the same.

use super::trainer::Trainer;
use crate::appearance::AppearanceMode;
use crate::appearance::first_values::first_exposures;
use crate::appearance::model::CHANNEL_VALUES;
use crate::appearance::picture::Look;
use crate::appearance::state::AppearanceState;
use crate::dataset::exif;
use crate::dataset::loader::Dataset;
use crate::outliers::blocks::{BlockState, STEPS_AFTER_RESET, counts_masked_blocks, first_look_at_blocks};
use crate::poses::state::{PoseState, first_step, rate_at};
use crate::scene::camera::Camera;
use crate::scene::events::{Event, EventKind};
use crate::scene::image::Target;
use crate::train::log::report::OutlierView;
use crate::train::step::comparison::{BlocksBefore, Comparison};
use crate::train::step::soundness::warn_of_outliers;
use crate::train::step::train_step::StepOutcome;
use rayon::prelude::*;

/// Photos that a warning names.
const NAMED: usize = 3;

/// The warning that the EXIF data of photos cannot be read: each a view and the reason.
fn damaged_exif(dataset: &Dataset, damaged: &[(usize, &str)]) -> Option<String> {
    let (&(first, why), rest) = damaged.split_first()?;
    let name = |view: usize| dataset.views[view].name.as_str();
    let others = rest.iter().take(NAMED - 1).map(|&(view, _)| format!(", {}", name(view))).collect::<String>();
    let more = match rest.len().saturating_sub(NAMED - 1) {
        0 => String::new(),
        more => format!(", and {more} more"),
    };
    Some(format!("damaged EXIF data are ignored: {} ({why}){others}{more}", name(first)))
}

impl Trainer {
    /// The correction of a view as it is now; `None` if the run corrects nothing.
    pub(super) fn look(&self, view: usize, camera: &Camera) -> Option<(AppearanceMode, Look)> {
        let mode = self.options.appearance;
        let of_view = (view, self.camera_groups.get(view).copied()?);
        mode.is_on().then(|| (mode, self.state.appearance.look(mode, of_view, camera)))
    }

    /// Starts the exposures of training photos from their EXIF data, if the run trains exposures, has none yet, and more than
    /// half of the photos state one. A function of the files alone. Returns warnings for the user.
    pub(crate) fn begin_exposures(&mut self, dataset: &Dataset) -> Vec<String> {
        if !self.options.appearance.is_on() || !self.state.appearance.is_new() {
            return Vec::new();
        }
        let read = |&view: &usize| {
            let photo = &dataset.views[view].photo;
            photo.header.exif.map_or(Ok(None), |place| exif::brightness(&photo.image_path, place))
        };
        let read: Vec<Result<Option<f64>, String>> = self.train_views.par_iter().map(read).collect();
        let damaged = self.train_views.iter().zip(&read);
        let damaged = damaged.filter_map(|(&view, read)| Some((view, read.as_ref().err()?.as_str())));
        let mut warnings: Vec<String> = damaged_exif(dataset, &damaged.collect::<Vec<_>>()).into_iter().collect();
        let brightness: Vec<Option<f64>> = read.into_iter().map(Result::unwrap_or_default).collect();
        let known = brightness.iter().flatten().count();
        if let Some(exposures) = first_exposures(&brightness) {
            let exposures = self.train_views.iter().zip(exposures).filter_map(|(&view, first)| Some((view, first?)));
            self.state.appearance.begin_with(exposures);
            self.state.first_exposures = known as u32;
        } else if known > 0 {
            warnings.push(format!(
                "only {known} of {} training photos state their exposure in EXIF data: exposures are trained from zero, \
                 because a start from EXIF data takes more than half of the photos",
                brightness.len()
            ));
        }
        warnings
    }

    /// Stores what a step that was taken has found for the photo of its view.
    pub(super) fn learn_appearance(&mut self, view: usize, outcome: &StepOutcome) {
        let found = self.working.correction.found.take();
        if let (Some(found), None, Some(&group)) = (found, outcome.skipped, self.camera_groups.get(view)) {
            self.state.appearance.learn(self.options.appearance, (view, group), &found);
        }
    }

    /// The camera of a view as steps see it: its pose in the dataset, refined where the run refines poses.
    pub(crate) fn camera(&self, dataset: &Dataset, view: usize) -> Camera {
        self.state.poses.motion(view, self.options.scene_scale).applied_to(&dataset.views[view].camera)
    }

    /// Whether the coming step refines the pose of its view.
    pub(super) fn refines_pose(&self, comparison: &Comparison<'_>) -> bool {
        let is_begun = self.state.step >= first_step(self.options.steps, self.train_views.len());
        self.options.refine_poses && is_begun && !comparison.is_left_out
    }

    /// Moves the camera of a view by what a step that was taken has found.
    pub(super) fn learn_pose(&mut self, view: usize, outcome: &StepOutcome) {
        if let (Some(sum), None) = (self.working.motion.take(), outcome.skipped) {
            let rate = rate_at(self.state.step, self.options.steps, self.train_views.len());
            self.state.poses.learn(view, &sum.gradient(), self.options.scene_scale, rate);
        }
    }

    /// The blocks of a photo whose `states` the last look left, where blocks are masked at this step.
    pub(super) fn blocks_before<'a>(&self, states: &'a [BlockState]) -> Option<BlocksBefore<'a>> {
        let step = self.state.step;
        let is_begun = !states.is_empty() || step >= first_look_at_blocks(self.options.steps);
        let is_reset = |event: &&Event| matches!(event.kind, EventKind::ResetOpacity { .. });
        let reset = self.events().events().iter().rev().find(is_reset);
        let are_kept = reset.is_some_and(|reset| step - reset.step <= STEPS_AFTER_RESET);
        let all_count = counts_masked_blocks(step, self.options.steps, self.train_views.len());
        (self.options.robust_pixels && is_begun).then_some(BlocksBefore { states, are_kept, all_count })
    }

    /// Stores what a step that was taken has found of the blocks of its photo.
    pub(super) fn learn_blocks(&mut self, view: usize, outcome: &StepOutcome) {
        if let (Some(found), None) = (self.working.correction.found_blocks.take(), outcome.skipped) {
            self.state.blocks.learn(view, found);
        }
    }

    /// Notes the error of the view of the last step, and after an epoch names the views that have become outliers.
    pub(super) fn judge_views(&mut self, view: usize, outcome: &StepOutcome, target: &Target, dataset: &Dataset) {
        self.state.outliers.measure(view, outcome.loss.mse, target);
        let (step, views) = (self.state.step, self.train_views.len() as u32);
        if step.is_multiple_of(views) {
            let found = self.state.outliers.end_epoch(step / views - 1);
            warn_of_outliers(&found, step, self.options.robust_views, dataset);
        }
    }

    /// The views whose photo contradicts the scene, by name.
    pub fn outlier_views(&self, dataset: &Dataset) -> Vec<OutlierView> {
        let of_view = |view: usize| OutlierView {
            name: dataset.views[view].name.clone(),
            unexplained: self.state.outliers.unexplained(view),
            is_left_out: self.options.robust_views,
        };
        self.state.outliers.named().map(of_view).collect()
    }

    /// The values of photos and cameras; empty if the run corrects nothing.
    pub fn appearance(&self) -> &AppearanceState {
        &self.state.appearance
    }

    /// Photos whose exposure started from EXIF data.
    pub fn first_exposures(&self) -> u32 {
        self.state.first_exposures
    }

    /// The motions of cameras; empty if the run refines no poses.
    pub fn poses(&self) -> &PoseState {
        &self.state.poses
    }

    /// The cameras whose vignetting the run trains, each with its values by channel.
    pub fn cameras_of<'a>(&self, dataset: &'a Dataset) -> Vec<(&'a Camera, [[f64; CHANNEL_VALUES]; 3])> {
        let trained = self.state.appearance.cameras.iter().enumerate().filter(|(_, camera)| camera.sightings > 0);
        let first = |group| self.camera_groups.iter().position(|of| *of == group);
        trained.filter_map(|(group, values)| Some((&dataset.views[first(group)?].camera, values.falloff))).collect()
    }

    /// Share of the blocks of the photos looked at that are masked; `None` without `--robust-pixels`.
    pub fn masked_share(&self) -> Option<f64> {
        self.state.blocks.masked_share()
    }
}
