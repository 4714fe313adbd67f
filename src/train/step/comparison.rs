//! Correction, masks and loss: all that happens between the picture of a view and the gradient of its splats, in training steps and in
//! the rehearsal before the first step.
//!
//! A second loss term goes into `Comparison::loss_and_back`, beside the correction of the picture ([`crate::appearance`]).
//! Its inputs are a field of [`Comparison`], so that step and rehearsal pass them on unchanged.
//!
//! Invariants: 1. the rehearsal allocates what a step allocates, because both run this code; 2. without a correction the
//! picture stays where the renderer keeps it, and masks of blocks only read it; 3. the loss, its gradient and the errors that
//! rows are weighed by are those of the corrected picture; 4. nothing here changes the values of a correction or the state of
//! blocks: the trainer reads `found` and `found_blocks` after the step and stores them only if the step is taken.

use crate::appearance::AppearanceMode;
use crate::appearance::fit::Pair;
use crate::appearance::picture::Look;
use crate::appearance::state::{Found, find};
use crate::outliers::blocks::{self, BlockState};
use crate::render::{LossOptions, RenderError, Renderer};
use crate::scene::image::Target;

/// What the picture of a view is compared with.
#[derive(Debug, Clone, Copy)]
pub struct Comparison<'a> {
    /// The photo.
    pub target: &'a Target,
    /// The loss.
    pub loss: LossOptions,
    /// The correction of the picture, and which of its values are trained; `None` without correction.
    pub look: Option<(AppearanceMode, Look)>,
    /// The state of the blocks of the photo; `None` without masks of blocks.
    pub blocks: Option<BlocksBefore<'a>>,
    /// Only the loss is measured: the view is not trained on.
    pub is_left_out: bool,
}

/// The blocks of a photo before a step.
#[derive(Debug, Clone, Copy, Default)]
pub struct BlocksBefore<'a> {
    /// The blocks after the last look at them; empty before the first.
    pub states: &'a [BlockState],
    /// The masks stay as they are, because the picture is unusable for a judgement (for example after an opacity reset).
    pub are_kept: bool,
    /// All blocks count in this step, masked or not.
    pub all_count: bool,
}

/// Buffers and results of a correction and of masks of blocks.
#[derive(Debug, Clone, Default)]
pub struct Correction {
    /// The picture as it was drawn, `[3][height][width]`.
    drawn: Vec<f32>,
    /// The values that fit the photo best under the last picture.
    pub found: Option<Found>,
    /// The blocks of the photo after a look at the last picture; `None` without one.
    pub found_blocks: Option<Vec<BlockState>>,
    /// The photo without its masked blocks.
    masked: Target,
}

impl Correction {
    /// Bytes held.
    pub fn bytes(&self) -> u64 {
        4 * self.drawn.capacity() as u64 + self.masked.bytes()
    }
}

impl<'a> Comparison<'a> {
    /// A view that is trained on, without correction.
    pub fn new(target: &'a Target, loss: LossOptions) -> Comparison<'a> {
        Comparison { target, loss, look: None, blocks: None, is_left_out: false }
    }

    /// Corrects the picture that `renderer` has drawn, compares it with the photo, and takes the loss back to the splats.
    ///
    /// # Errors
    /// Photo and picture differ in size, or the renderer failed.
    pub(super) fn loss_and_back(
        &self,
        renderer: &mut dyn Renderer,
        correction: &mut Correction,
    ) -> Result<(), RenderError> {
        correction.found = None;
        if let Some((mode, look)) = &self.look {
            let picture = renderer.picture_mut()?;
            // Otherwise the loss names the sizes that differ.
            if picture.len() == 3 * self.target.pixels() {
                correction.drawn.clear();
                correction.drawn.extend_from_slice(picture);
                if !self.is_left_out {
                    correction.found = find(&Pair { drawn: &correction.drawn, photo: self.target }, look, *mode);
                }
                look.correct(picture, self.target.width as usize, Some(self.target));
            }
        }
        let target = self.without_masked_blocks(renderer, correction)?;
        renderer.loss(target, &self.loss)?;
        if self.is_left_out {
            return Ok(());
        }
        // A second loss term adds its gradient here, in `renderer.picture_gradient()`, before the correction takes the
        // gradient back.
        if let Some((_, look)) = &self.look {
            look.back(&correction.drawn, self.target, &mut renderer.picture_gradient()?.v_rgb);
        }
        renderer.picture_back()
    }

    /// The photo to compare with: without the blocks that are masked after a look at the picture.
    fn without_masked_blocks<'c>(
        &'c self,
        renderer: &mut dyn Renderer,
        correction: &'c mut Correction,
    ) -> Result<&'c Target, RenderError> {
        correction.found_blocks = None;
        let Some(BlocksBefore { states, are_kept, all_count }) = self.blocks else { return Ok(self.target) };
        if !are_kept {
            let picture = &renderer.image()?.rgb;
            // Otherwise the loss names the sizes that differ.
            if picture.len() == 3 * self.target.pixels() {
                correction.found_blocks = blocks::look(states, picture, self.target);
            }
        }
        if all_count {
            return Ok(self.target);
        }
        let states = correction.found_blocks.as_deref().unwrap_or(states);
        blocks::mask(states, self.target, &mut correction.masked);
        Ok(&correction.masked)
    }
}
