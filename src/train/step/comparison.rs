//! Correction, masks and loss: all that happens between the picture of a view and the gradient of its splats, in training steps and in
//! the rehearsal before the first step.
//!
//! A second loss term goes into `Comparison::loss_and_back`, beside the corrections of the picture ([`crate::photos`]).
//! Its inputs are a field of [`Comparison`], so that step and rehearsal pass them on unchanged.
//!
//! Invariants: 1. the rehearsal allocates what a step allocates, because both run this code; 2. without a correction the
//! picture stays where the renderer keeps it, and masks of blocks only read it; 3. the loss, its gradient and the errors that
//! rows are weighed by are those of the corrected picture; 4. nothing here changes the values of photos: the trainer ends the step
//! with what was found.

use crate::photos::parameter::PhotoParameter;
use crate::render::{LossOptions, RenderError, Renderer};
use crate::scene::image::Target;

/// What the picture of a view is compared with.
pub struct Comparison<'a> {
    /// The photo.
    pub target: &'a Target,
    /// The loss.
    pub loss: LossOptions,
    /// What acts on the picture or learns from the step; each has begun the step.
    pub photos: &'a mut [Box<dyn PhotoParameter>],
    /// Only the loss is measured: the view is not trained on.
    pub is_left_out: bool,
}

impl<'a> Comparison<'a> {
    /// A view that is trained on, without correction.
    pub fn new(target: &'a Target, loss: LossOptions) -> Comparison<'a> {
        Comparison { target, loss, photos: &mut [], is_left_out: false }
    }

    /// Corrects the picture that `renderer` has drawn, compares it with the photo, and takes the loss back to the splats.
    ///
    /// # Errors
    /// Photo and picture differ in size, or the renderer failed.
    pub(super) fn loss_and_back(&mut self, renderer: &mut dyn Renderer) -> Result<(), RenderError> {
        let corrects = self.photos.iter().any(|parameter| parameter.corrects());
        if corrects {
            let picture = renderer.picture_mut()?;
            // Otherwise the loss names the sizes that differ.
            if picture.len() == 3 * self.target.pixels() {
                self.photos.iter_mut().for_each(|parameter| parameter.correct(picture, self.target));
            }
        }
        let target = target_of(self.photos, renderer, self.target)?;
        renderer.loss(target, &self.loss)?;
        if self.is_left_out {
            return Ok(());
        }
        // A second loss term adds its gradient here, in `renderer.picture_gradient()`, before the corrections take the
        // gradient back.
        if corrects {
            let v_rgb = &mut renderer.picture_gradient()?.v_rgb;
            self.photos.iter_mut().rev().for_each(|parameter| parameter.picture_back(self.target, v_rgb));
        }
        renderer.picture_back()
    }
}

/// The photo that the picture is compared with. The picture is read back only if a parameter needs it.
fn target_of<'p>(
    photos: &'p mut [Box<dyn PhotoParameter>],
    renderer: &mut dyn Renderer,
    target: &'p Target,
) -> Result<&'p Target, RenderError> {
    let picture = match photos.iter().any(|parameter| parameter.needs_picture()) {
        true => Some(renderer.image()?.rgb.as_slice()),
        false => None,
    };
    // Otherwise the loss names the sizes that differ.
    let picture = picture.filter(|picture| picture.len() == 3 * target.pixels());
    Ok(photos.iter_mut().fold(target, |target, parameter| parameter.target(picture, target)))
}
