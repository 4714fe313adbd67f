//! The order of the stages of a view: tracks the progress of the view and checks each call. Shared by every backend.
//!
//! Not here: what the stages compute.
//!
//! Invariants: 1. a stage that is called out of order, or with a batch, photo or gradient that does not fit the view,
//! returns an error and changes nothing; 2. after a failed [`Sequence::begin`] or after [`Sequence::drop_view`] there
//! is no view.

use super::{PictureGradient, RenderError, RenderOptions, RowBatches};
use crate::kernels::splats::Grid;
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use std::ops::Range;

#[derive(Debug, Clone, Copy)]
pub(super) struct ViewOptions {
    pub camera: Camera,
    pub options: RenderOptions,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Progress {
    /// Batches of rows are being added.
    Rows,
    /// The picture exists.
    Picture,
    /// The gradient of the picture exists, from a loss or from the caller.
    PictureGradient,
    /// The gradients of the splats exist, and `rows_out` of at least one batch is still due.
    SplatGradients,
}

#[derive(Debug)]
struct Current {
    view: ViewOptions,
    progress: Progress,
    batches: RowBatches,
    /// End of each batch that `rows_in` has taken, in rows of the view.
    ends: Vec<usize>,
    /// Whether `rows_out` of each batch has run in the current backward pass.
    is_out: Vec<bool>,
}

/// The stage order of a renderer, one view at a time.
#[derive(Debug, Default)]
pub(super) struct Sequence {
    current: Option<Current>,
}

fn out_of_order<T>(call: &'static str, needs: &'static str) -> Result<T, RenderError> {
    Err(RenderError::OutOfOrder { call, needs })
}

impl Sequence {
    /// Checks `begin_view`.
    pub fn begin(&mut self, camera: &Camera, options: &RenderOptions, batches: RowBatches) -> Result<(), RenderError> {
        self.current = None;
        let Camera { width, height, .. } = *camera;
        if width.max(height) > Grid::SIDE_MAX {
            return Err(RenderError::ImageTooLarge { width, height });
        }
        let view = ViewOptions { camera: *camera, options: *options };
        self.current = Some(Current { view, progress: Progress::Rows, batches, ends: Vec::new(), is_out: Vec::new() });
        Ok(())
    }

    /// How the rows of the view come; `None` without a view.
    pub fn batches(&self) -> Option<RowBatches> {
        self.current.as_ref().map(|current| current.batches)
    }

    /// Camera and options of the view; `None` without a view.
    pub fn view(&self) -> Option<ViewOptions> {
        self.current.as_ref().map(|current| current.view)
    }

    pub fn drop_view(&mut self) {
        self.current = None;
    }

    /// Checks `rows_in` of a batch of `rows` rows that are stored with `sh_degree`. Returns the view and the range of the batch in the view's rows.
    pub fn rows_in(&mut self, rows: usize, sh_degree: u8) -> Result<(ViewOptions, Range<usize>), RenderError> {
        let Some(current) = &mut self.current else { return out_of_order("rows_in", "begin_view") };
        let is_full = current.batches == RowBatches::One && !current.ends.is_empty();
        if current.progress != Progress::Rows || is_full {
            return out_of_order("rows_in", "begin_view: all batches of this view were given already");
        }
        let asked = current.view.options.sh_degree;
        if asked > sh_degree {
            return Err(RenderError::ShDegree { asked, stored: sh_degree });
        }
        let first = current.ends.last().copied().unwrap_or(0);
        let end = first + rows;
        if end >= u32::MAX as usize {
            return Err(RenderError::TooManyRows(end));
        }
        current.ends.push(end);
        Ok((current.view, first..end))
    }

    /// Checks `picture`. Returns the view.
    pub fn picture(&mut self) -> Result<ViewOptions, RenderError> {
        match &mut self.current {
            Some(current) if current.progress == Progress::Rows && !current.ends.is_empty() => {
                current.progress = Progress::Picture;
                Ok(current.view)
            }
            _ => out_of_order("picture", "rows_in"),
        }
    }

    /// Checks that the view has a picture and that no backward pass is unfinished.
    fn with_picture(&mut self, call: &'static str) -> Result<&mut Current, RenderError> {
        let Some(current) = &mut self.current else { return out_of_order(call, "picture") };
        match current.progress {
            Progress::Rows => out_of_order(call, "picture"),
            Progress::Picture | Progress::PictureGradient => Ok(current),
            Progress::SplatGradients => out_of_order(call, "rows_out of every batch"),
        }
    }

    /// Checks `image`. Returns the view.
    pub fn image(&mut self) -> Result<ViewOptions, RenderError> {
        Ok(self.with_picture("image")?.view)
    }

    /// Checks `loss`.
    pub fn loss(&mut self, target: &Target) -> Result<(), RenderError> {
        let current = self.with_picture("loss")?;
        let image = (current.view.camera.width, current.view.camera.height);
        if (target.width, target.height) != image {
            return Err(RenderError::TargetSize { target: (target.width, target.height), image });
        }
        current.progress = Progress::PictureGradient;
        Ok(())
    }

    /// Checks `picture_gradient`. Returns the view, and whether the picture had a gradient already.
    pub fn picture_gradient(&mut self) -> Result<(ViewOptions, bool), RenderError> {
        let current = self.with_picture("picture_gradient")?;
        let had_gradient = current.progress == Progress::PictureGradient;
        current.progress = Progress::PictureGradient;
        Ok((current.view, had_gradient))
    }

    /// Checks `picture_back`. Returns the view. `gradient` is the gradient of the picture if the host holds it.
    pub fn picture_back(&mut self, gradient: Option<&PictureGradient>) -> Result<ViewOptions, RenderError> {
        let current = match &mut self.current {
            Some(current) if current.progress == Progress::PictureGradient => current,
            _ => return out_of_order("picture_back", "loss or picture_gradient"),
        };
        let pixels = current.view.camera.pixels();
        if gradient.is_some_and(|gradient| !gradient.fits(pixels)) {
            return Err(RenderError::GradientSize { pixels });
        }
        current.progress = Progress::SplatGradients;
        current.is_out.clear();
        current.is_out.resize(current.ends.len(), false);
        Ok(current.view)
    }

    /// Checks that a batch is out of the current backward pass.
    pub fn splat_gradients(&self, call: &'static str) -> Result<(), RenderError> {
        match &self.current {
            Some(current) if current.is_out.contains(&true) => Ok(()),
            _ => out_of_order(call, "rows_out of a batch"),
        }
    }

    /// Checks `rows_out`. Returns the view and the range of the batch in the view's rows.
    pub fn rows_out(&mut self, batch: usize, rows: usize) -> Result<(ViewOptions, Range<usize>), RenderError> {
        let current = match &mut self.current {
            Some(current) if current.progress == Progress::SplatGradients => current,
            _ => return out_of_order("rows_out", "picture_back"),
        };
        let Some(&end) = current.ends.get(batch) else {
            return Err(RenderError::BatchRows { batch, given: rows });
        };
        let first = if batch == 0 { 0 } else { current.ends[batch - 1] };
        if end - first != rows {
            return Err(RenderError::BatchRows { batch, given: rows });
        }
        if std::mem::replace(&mut current.is_out[batch], true) {
            return out_of_order("rows_out", "picture_back: this batch was processed already");
        }
        if current.is_out.iter().all(|out| *out) {
            // The backward pass may run again, with another gradient.
            current.progress = Progress::PictureGradient;
        }
        Ok((current.view, first..end))
    }
}
