//! Correction, masks and loss: all that happens between the picture of a view and the gradient of its splats, in training steps and in
//! the rehearsal before the first step.
//!
//! Steps that a device records ahead compare without this file; runs with a parameter that [needs the
//! host](PhotoParameter::needs_host) have none.
//!
//! Invariants: 1. the rehearsal allocates what a step allocates, because both run this code; 2. without a correction the
//! picture stays where the renderer keeps it, and masks of blocks only read it; 3. the loss, its gradient and the errors that
//! rows are weighed by are those of the corrected picture; 4. nothing here changes the values of photos: the trainer ends the step
//! with what was found.

use crate::photos::parameter::PhotoParameter;
use crate::render::{LossOptions, LossValue, RenderError, Renderer};
use crate::scene::image::Target;

/// What the picture of a view is compared with.
pub struct Comparison<'a> {
    pub target: &'a Target,
    pub loss: LossOptions,
    /// What acts on the picture or learns from the step; each has begun the step.
    pub photos: &'a mut [Box<dyn PhotoParameter>],
    /// Only the loss is measured: the view is not trained on. A parameter that has seen the picture may set this too.
    pub is_left_out: bool,
}

impl<'a> Comparison<'a> {
    /// A view that is trained on, without correction.
    pub fn new(target: &'a Target, loss: LossOptions) -> Comparison<'a> {
        Comparison { target, loss, photos: &mut [], is_left_out: false }
    }

    /// Corrects the picture that `renderer` has drawn, compares it with the photo, and takes the loss back to the splats.
    /// Errors: photo and picture differ in size, or the renderer failed.
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
        self.is_left_out |= self.photos.iter().any(|parameter| parameter.leaves_out_now());
        if self.is_left_out {
            return Ok(());
        }
        if corrects || self.photos.iter().any(|parameter| parameter.adds_loss()) {
            let gradient = renderer.picture_gradient()?;
            self.photos.iter_mut().rev().for_each(|parameter| parameter.picture_back(self.target, gradient));
        }
        renderer.picture_back()
    }

    /// Waits for the loss of the step, and adds the terms of the parameters.
    /// Errors: no loss was computed, or the renderer failed.
    pub(super) fn loss_value(&self, renderer: &mut dyn Renderer) -> Result<LossValue, RenderError> {
        let value = renderer.loss_value()?;
        let added: f64 = self.photos.iter().map(|parameter| parameter.loss()).sum();
        Ok(LossValue { loss: value.loss + added, ..value })
    }
}

/// The photo that the picture is compared with. The picture is read back only if a parameter needs it.
fn target_of<'p>(
    photos: &'p mut [Box<dyn PhotoParameter>],
    renderer: &mut dyn Renderer,
    target: &'p Target,
) -> Result<&'p Target, RenderError> {
    let picture = match photos.iter().any(|parameter| parameter.needs_picture()) {
        true => Some(renderer.image()?),
        false => None,
    };
    // Otherwise the loss names the sizes that differ.
    let picture = picture.filter(|picture| picture.rgb.len() == 3 * target.pixels());
    Ok(photos.iter_mut().fold(target, |target, parameter| parameter.target(picture, target)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::page::format::encoding::EncodingError;
    use crate::photos::parameter::{Encoded, PastViews, ValuesError};
    use crate::render::RenderOptions;
    use crate::render::cpu::CpuRenderer;
    use crate::scene::camera::Camera;
    use crate::scene::columns::Columns;
    use crate::scene::image::{Image, PictureGradient};
    use std::cell::RefCell;
    use std::rc::Rc;

    /// Adds the sum of the picture to the loss, and leaves the view out if the picture is black where the photo is white.
    #[derive(Default)]
    struct Probe {
        sum: f64,
        is_black_on_white: bool,
        /// The gradient as it came.
        v_rgb: Rc<RefCell<Vec<f32>>>,
    }

    impl PhotoParameter for Probe {
        fn name(&self) -> &'static str {
            "probe"
        }

        fn save(&self) -> Result<Encoded, EncodingError> {
            Encoded::of(&())
        }

        fn restore(&mut self, _: &Encoded, _: &PastViews) -> Result<(), ValuesError> {
            Ok(())
        }

        fn adds_loss(&self) -> bool {
            true
        }

        fn needs_picture(&self) -> bool {
            true
        }

        fn target<'a>(&'a mut self, picture: Option<&Image>, photo: &'a Target) -> &'a Target {
            self.sum = picture.unwrap().rgb.iter().map(|value| f64::from(*value)).sum();
            self.is_black_on_white = self.sum == 0.0 && photo.rgb.iter().all(|byte| *byte == 255);
            photo
        }

        fn leaves_out_now(&self) -> bool {
            self.is_black_on_white
        }

        fn loss(&self) -> f64 {
            self.sum
        }

        fn picture_back(&mut self, _: &Target, gradient: &mut PictureGradient) {
            *self.v_rgb.borrow_mut() = gradient.v_rgb.clone();
            gradient.v_rgb.iter_mut().for_each(|v| *v += 1.0);
        }
    }

    /// A renderer that has drawn nothing on this background.
    fn drawn(background: f32) -> CpuRenderer {
        let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let camera = Camera::pinhole(viewmat, [20.0, 20.0, 8.0, 8.0], [16, 16]);
        let options = RenderOptions { sh_degree: 0, background: [background; 3], ..RenderOptions::default() };
        let mut renderer = CpuRenderer::new();
        renderer.draw(&Columns::zeros(0, 0), &camera, &options).unwrap();
        renderer
    }

    fn photo(byte: u8) -> Target {
        Target::new([16, 16], vec![byte; 3 * 256])
    }

    #[test]
    fn a_look_at_the_picture_leaves_the_view_out() {
        for (byte, is_left_out) in [(0, false), (255, true)] {
            let (photo, mut renderer) = (photo(byte), drawn(0.0));
            let mut photos: [Box<dyn PhotoParameter>; 1] = [Box::<Probe>::default()];
            let mut comparison = Comparison { photos: &mut photos, ..Comparison::new(&photo, LossOptions::default()) };
            comparison.loss_and_back(&mut renderer).unwrap();
            assert_eq!(comparison.is_left_out, is_left_out, "a photo of {byte}");
            // The loss of a view that is left out is known too.
            assert!((comparison.loss_value(&mut renderer).unwrap().mse - f64::from(byte) / 255.0).abs() < 1e-6);
        }
    }

    #[test]
    fn a_term_of_the_loss_adds_its_gradient_and_its_value() {
        let probes = [Probe::default(), Probe::default()];
        let [first, second] = [&probes[0], &probes[1]].map(|probe| probe.v_rgb.clone());
        let mut photos = probes.map(|probe| Box::new(probe) as Box<dyn PhotoParameter>);
        assert!(photos[0].needs_host(0), "steps that a device records ahead would lack the term");
        let (photo, mut renderer) = (photo(51), drawn(0.25));
        let mut comparison = Comparison { photos: &mut photos, ..Comparison::new(&photo, LossOptions::default()) };
        comparison.loss_and_back(&mut renderer).unwrap();
        // The last kind comes first: it sees the gradient of the loss, the first kind that and the term of the last one.
        let (first, second) = (first.take(), second.take());
        assert_eq!(second.len(), 3 * 256);
        assert!(first.iter().zip(&second).all(|(first, second)| *first == second + 1.0));
        let (plain, all) = (renderer.loss_value().unwrap(), comparison.loss_value(&mut renderer).unwrap());
        assert_eq!(all.loss, plain.loss + 2.0 * 3.0 * 256.0 * 0.25);
        assert_eq!(all.mse, plain.mse, "the error of the picture has no terms");
    }
}
