//! What happens between the picture of a view and the gradient of its splats: the one place for the training step and
//! the rehearsal.
//!
//! A correction of the picture (an exposure per photo) or a second loss term is added in `Comparison::loss_and_back`;
//! what it needs is a field of [`Comparison`], so that step and rehearsal pass it on unchanged.
//!
//! Invariants: 1. the rehearsal allocates what a step allocates, because both run this code; 2. without a correction the
//! picture stays where the renderer keeps it.

use crate::render::{LossOptions, RenderError, Renderer};
use crate::scene::image::Target;

/// What the picture of a view is compared with.
#[derive(Debug, Clone, Copy)]
pub struct Comparison<'a> {
    /// The photo.
    pub target: &'a Target,
    /// The loss.
    pub loss: LossOptions,
}

impl Comparison<'_> {
    /// Compares the picture that `renderer` has drawn with the photo, and takes the loss back to the splats.
    ///
    /// # Errors
    /// Photo and picture differ in size, or the renderer failed.
    pub(super) fn loss_and_back(&self, renderer: &mut dyn Renderer) -> Result<(), RenderError> {
        // A correction of the picture belongs here: change `renderer.picture_mut()`.
        renderer.loss(self.target, &self.loss)?;
        // A second loss term adds its gradient here, and the correction takes the gradient back, in
        // `renderer.picture_gradient()`: first the term, then the correction.
        renderer.picture_back()
    }
}
