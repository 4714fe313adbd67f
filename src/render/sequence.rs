//! Where a view stands among its stages, and which stage may follow: the same rules for every backend.
//!
//! Not here: what the stages compute.
//!
//! Invariants: 1. a stage that is called out of order, or with a batch, photo or gradient that does not fit the view, is
//! an error and changes nothing; 2. after [`Sequence::begin`] has failed, or after [`Sequence::give_up`], there is no view.

use super::{PictureGradient, RenderError, RenderOptions};
use crate::kernels::splats::Grid;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::image::Target;
use std::ops::Range;

/// A view that was begun.
#[derive(Debug, Clone, Copy)]
pub(super) struct ViewOptions {
    pub camera: Camera,
    pub options: RenderOptions,
}

/// What the view has reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Reached {
    /// Some of the batches are in.
    Rows,
    /// The picture is made.
    Picture,
    /// The gradient of the picture is there, from a loss or from the caller.
    Gradient,
    /// The gradients of the splats are there, and some batches are not out yet.
    Splats,
}

/// The view that is rendered now.
#[derive(Debug)]
struct Current {
    view: ViewOptions,
    reached: Reached,
    batches: usize,
    /// Where each batch that is in ends, in rows of the view.
    ends: Vec<usize>,
    /// Whether each batch is out, on the way back that is going on.
    is_out: Vec<bool>,
}

/// The stages of one view after another.
#[derive(Debug, Default)]
pub(super) struct Sequence {
    current: Option<Current>,
}

fn order<T>(call: &'static str, needs: &'static str) -> Result<T, RenderError> {
    Err(RenderError::OutOfOrder { call, needs })
}

impl Sequence {
    /// `begin_view` of a backend that takes at most `most` batches.
    pub fn begin(
        &mut self,
        camera: &Camera,
        options: &RenderOptions,
        batches: usize,
        most: usize,
    ) -> Result<(), RenderError> {
        self.current = None;
        let Camera { width, height, .. } = *camera;
        if width.max(height) > Grid::SIDE_MAX {
            return Err(RenderError::ImageTooLarge { width, height });
        }
        if batches == 0 || batches > most {
            return Err(RenderError::Batches { asked: batches, most });
        }
        let view = ViewOptions { camera: *camera, options: *options };
        let (ends, is_out) = (Vec::with_capacity(batches), Vec::with_capacity(batches));
        self.current = Some(Current { view, reached: Reached::Rows, batches, ends, is_out });
        Ok(())
    }

    /// There is no view any more.
    pub fn give_up(&mut self) {
        self.current = None;
    }

    /// `rows_in`: the view, and the batch's place among the view's rows.
    pub fn rows_in(&mut self, rows: &Columns) -> Result<(ViewOptions, Range<usize>), RenderError> {
        let Some(current) = &mut self.current else { return order("rows_in", "begin_view") };
        if current.reached != Reached::Rows || current.ends.len() == current.batches {
            return order("rows_in", "a view whose batches are not all in");
        }
        let asked = current.view.options.sh_degree;
        if asked > rows.sh_degree {
            return Err(RenderError::ShDegree { asked, stored: rows.sh_degree });
        }
        let first = current.ends.last().copied().unwrap_or(0);
        let end = first + rows.rows();
        if end >= u32::MAX as usize {
            return Err(RenderError::TooManyRows(end));
        }
        current.ends.push(end);
        Ok((current.view, first..end))
    }

    /// `picture`: the view.
    pub fn picture(&mut self) -> Result<ViewOptions, RenderError> {
        match &mut self.current {
            Some(current) if current.reached == Reached::Rows && current.ends.len() == current.batches => {
                current.reached = Reached::Picture;
                Ok(current.view)
            }
            _ => order("picture", "rows_in of every batch"),
        }
    }

    /// What `call` needs: a picture that is not on its way back.
    fn with_picture(&mut self, call: &'static str) -> Result<&mut Current, RenderError> {
        let Some(current) = &mut self.current else { return order(call, "picture") };
        match current.reached {
            Reached::Rows => order(call, "picture"),
            Reached::Picture | Reached::Gradient => Ok(current),
            Reached::Splats => order(call, "rows_out of every batch"),
        }
    }

    /// `image`: the view.
    pub fn image(&mut self) -> Result<ViewOptions, RenderError> {
        Ok(self.with_picture("image")?.view)
    }

    /// `loss`.
    pub fn loss(&mut self, target: &Target) -> Result<(), RenderError> {
        let current = self.with_picture("loss")?;
        let image = (current.view.camera.width, current.view.camera.height);
        if (target.width, target.height) != image {
            return Err(RenderError::TargetSize { target: (target.width, target.height), image });
        }
        current.reached = Reached::Gradient;
        Ok(())
    }

    /// `picture_gradient`: the view, and whether there was a gradient already.
    pub fn picture_gradient(&mut self) -> Result<(ViewOptions, bool), RenderError> {
        let current = self.with_picture("picture_gradient")?;
        let was_there = current.reached == Reached::Gradient;
        current.reached = Reached::Gradient;
        Ok((current.view, was_there))
    }

    /// `picture_back`: the view. `gradient` is what it starts from, where that is on the host.
    pub fn picture_back(&mut self, gradient: Option<&PictureGradient>) -> Result<ViewOptions, RenderError> {
        let current = match &mut self.current {
            Some(current) if current.reached == Reached::Gradient => current,
            _ => return order("picture_back", "loss or picture_gradient"),
        };
        let pixels = current.view.camera.pixels();
        if let Some(PictureGradient { v_rgb, v_alpha }) = gradient
            && (v_rgb.len() != 3 * pixels || v_alpha.as_ref().is_some_and(|v| v.len() != pixels))
        {
            return Err(RenderError::GradientSize { pixels });
        }
        current.reached = Reached::Splats;
        current.is_out.clear();
        current.is_out.resize(current.batches, false);
        Ok(current.view)
    }

    /// `rows_out`: the view, and the batch's place among the view's rows.
    pub fn rows_out(&mut self, batch: usize, rows: &Columns) -> Result<(ViewOptions, Range<usize>), RenderError> {
        let current = match &mut self.current {
            Some(current) if current.reached == Reached::Splats => current,
            _ => return order("rows_out", "picture_back"),
        };
        let Some(&end) = current.ends.get(batch) else {
            return Err(RenderError::BatchRows { batch, given: rows.rows() });
        };
        let first = if batch == 0 { 0 } else { current.ends[batch - 1] };
        if end - first != rows.rows() {
            return Err(RenderError::BatchRows { batch, given: rows.rows() });
        }
        if std::mem::replace(&mut current.is_out[batch], true) {
            return order("rows_out", "a batch that is not out yet");
        }
        if current.is_out.iter().all(|out| *out) {
            // The way back may be gone again, with another gradient.
            current.reached = Reached::Gradient;
        }
        Ok((current.view, first..end))
    }
}
