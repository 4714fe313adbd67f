//! The photos of a run between its steps: the parameters of [`crate::photos`] learn from a step here, and begin the next.
//!
//! Not here: what the parameters do to a picture (`step::comparison`).

use super::trainer::Trainer;
use crate::dataset::loader::Dataset;
use crate::photos;
use crate::photos::parameter::{PhotoOutcome, PhotoStep, steps_after_reset};
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use crate::train::step::train_step::StepOutcome;

impl Trainer {
    /// Gives what is known of photos its start values, which the files of the dataset state. Returns warnings for the user.
    pub(crate) fn start_photos(&mut self, dataset: &Dataset) -> Vec<String> {
        self.photos.iter_mut().flat_map(|parameter| parameter.start(dataset)).collect()
    }

    /// The camera of a view as steps see it.
    pub(crate) fn camera(&self, dataset: &Dataset, view: usize) -> Camera {
        photos::camera(&self.photos, dataset, view)
    }

    /// Prepares the parameters for the coming step on a view, or for its rehearsal.
    pub(super) fn begin_step_of_photo(&mut self, view: usize, camera: &Camera, is_left_out: bool, is_rehearsal: bool) {
        let (step, events) = (self.state.step, self.scene.events());
        let at = PhotoStep { view, step, camera, events, is_left_out, is_rehearsal };
        self.photos.iter_mut().for_each(|parameter| parameter.begin_step(&at));
    }

    /// Lets the parameters learn from the current step, which was taken or skipped.
    pub(super) fn end_step_of_photo(&mut self, view: usize, done: &StepOutcome, photo: &Target, dataset: &Dataset) {
        let StepOutcome { is_left_out, ref loss, .. } = *done;
        let (step, is_skipped, mse) = (self.state.step, done.skipped.is_some(), loss.mse);
        let ended_group = self.order.group_ended_by(step);
        let after_reset = steps_after_reset(self.scene.events(), step);
        let outcome =
            PhotoOutcome { view, step, is_skipped, is_left_out, ended_group, after_reset, mse, photo, dataset };
        let warnings = self.photos.iter_mut().flat_map(|parameter| parameter.end_step(&outcome));
        warnings.for_each(|warning| crate::tell!("warning: {warning}"));
    }
}
