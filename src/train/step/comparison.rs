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
    /// Only the loss is measured: the view is not trained on. A look at the picture may decide so too.
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
        self.is_left_out |= self.photos.iter().any(|parameter| parameter.leaves_out_now());
        if self.is_left_out {
            return Ok(());
        }
        if corrects || self.photos.iter().any(|parameter| parameter.adds_loss()) {
            let v_rgb = &mut renderer.picture_gradient()?.v_rgb;
            self.photos.iter_mut().rev().for_each(|parameter| parameter.picture_back(self.target, v_rgb));
        }
        renderer.picture_back()
    }
}

/// The terms that parameters add to the loss.
pub(super) fn added_loss(photos: &[Box<dyn PhotoParameter>]) -> f64 {
    photos.iter().map(|parameter| parameter.loss()).sum()
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

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::page::format::encoding::EncodingError;
    use crate::photos::saved::{Encoded, ValuesError};
    use crate::render::RenderOptions;
    use crate::render::cpu::CpuRenderer;
    use crate::scene::camera::Camera;
    use crate::scene::columns::Columns;
    use std::cell::RefCell;
    use std::rc::Rc;

    /// Leaves a view out if its picture is black where the photo is white.
    #[derive(Default)]
    struct LeavesBlackOut {
        is_found: bool,
    }

    impl PhotoParameter for LeavesBlackOut {
        fn name(&self) -> &'static str {
            "black"
        }

        fn save(&self) -> Result<Encoded, EncodingError> {
            Encoded::of(&())
        }

        fn restore(&mut self, _: &Encoded) -> Result<(), ValuesError> {
            Ok(())
        }

        fn needs_picture(&self) -> bool {
            true
        }

        fn target<'a>(&'a mut self, picture: Option<&[f32]>, photo: &'a Target) -> &'a Target {
            self.is_found =
                picture.unwrap().iter().all(|value| *value == 0.0) && photo.rgb.iter().all(|byte| *byte == 255);
            photo
        }

        fn leaves_out_now(&self) -> bool {
            self.is_found
        }
    }

    /// Adds the sum of the picture to the loss.
    #[derive(Default)]
    struct AddsBrightness {
        sum: f64,
    }

    impl PhotoParameter for AddsBrightness {
        fn name(&self) -> &'static str {
            "brightness"
        }

        fn save(&self) -> Result<Encoded, EncodingError> {
            Encoded::of(&())
        }

        fn restore(&mut self, _: &Encoded) -> Result<(), ValuesError> {
            Ok(())
        }

        fn adds_loss(&self) -> bool {
            true
        }

        fn needs_picture(&self) -> bool {
            true
        }

        fn target<'a>(&'a mut self, picture: Option<&[f32]>, photo: &'a Target) -> &'a Target {
            self.sum = picture.unwrap().iter().map(|value| f64::from(*value)).sum();
            photo
        }

        fn loss(&self) -> f64 {
            self.sum
        }

        fn picture_back(&mut self, _: &Target, v_rgb: &mut [f32]) {
            v_rgb.iter_mut().for_each(|v| *v += 1.0);
        }
    }

    /// A renderer that has drawn nothing on this background.
    fn drawn(background: f32) -> CpuRenderer {
        let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let (width, height, near_plane, far_plane) = (16, 16, 0.01, 100.0);
        let camera = Camera { viewmat, fx: 20.0, fy: 20.0, cx: 8.0, cy: 8.0, width, height, near_plane, far_plane };
        let options = RenderOptions { sh_degree: 0, background: [background; 3], ..RenderOptions::default() };
        let mut renderer = CpuRenderer::new();
        renderer.draw(&Columns::zeros(0, 0), &camera, &options).unwrap();
        renderer
    }

    fn photo(byte: u8) -> Target {
        Target { width: 16, height: 16, rgb: vec![byte; 3 * 256], mask: None }
    }

    #[test]
    fn a_look_at_the_picture_leaves_the_view_out() {
        for (byte, is_left_out) in [(0, false), (255, true)] {
            let (photo, mut renderer) = (photo(byte), drawn(0.0));
            let mut photos: [Box<dyn PhotoParameter>; 1] = [Box::<LeavesBlackOut>::default()];
            let mut comparison = Comparison { photos: &mut photos, ..Comparison::new(&photo, LossOptions::default()) };
            comparison.loss_and_back(&mut renderer).unwrap();
            assert_eq!(comparison.is_left_out, is_left_out, "a photo of {byte}");
            // The loss of a view that is left out is known too.
            assert!((renderer.loss_value().unwrap().mse - f64::from(byte) / 255.0).abs() < 1e-6);
        }
    }

    /// Keeps the gradient that the kinds behind it have left.
    struct Listens(Rc<RefCell<Vec<f32>>>);

    impl PhotoParameter for Listens {
        fn name(&self) -> &'static str {
            "listens"
        }

        fn save(&self) -> Result<Encoded, EncodingError> {
            Encoded::of(&())
        }

        fn restore(&mut self, _: &Encoded) -> Result<(), ValuesError> {
            Ok(())
        }

        fn adds_loss(&self) -> bool {
            true
        }

        fn picture_back(&mut self, _: &Target, v_rgb: &mut [f32]) {
            *self.0.borrow_mut() = v_rgb.to_vec();
        }
    }

    #[test]
    fn a_term_of_the_loss_adds_its_gradient_and_its_value() {
        let heard = Rc::new(RefCell::new(Vec::new()));
        let mut photos: Vec<Box<dyn PhotoParameter>> =
            vec![Box::new(Listens(heard.clone())), Box::<AddsBrightness>::default()];
        let gradient = |photos: &mut [Box<dyn PhotoParameter>]| {
            let (photo, mut renderer) = (photo(51), drawn(0.25));
            let mut comparison = Comparison { photos, ..Comparison::new(&photo, LossOptions::default()) };
            comparison.loss_and_back(&mut renderer).unwrap();
            heard.take()
        };
        let (with, plain) = (gradient(&mut photos), gradient(&mut photos[..1]));
        assert_eq!(plain.len(), 3 * 256);
        assert!(plain.iter().zip(&with).all(|(plain, with)| plain + 1.0 == *with));
        assert_eq!((added_loss(&photos), added_loss(&photos[..1])), (3.0 * 256.0 * 0.25, 0.0));
        assert!(photos[1].needs_host(), "steps that a device records ahead would lack the term");
    }
}
