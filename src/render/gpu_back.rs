//! Loss and gradients of a view on a GPU: from the picture to the splats, and from there to the rows.
//!
//! Not here: the recording of the stages (`gpu_loss`, `gpu_tiles_bwd`, `gpu_gradients`), the picture (`gpu_picture`), the order of a
//! view (`gpu`).
//!
//! Invariant: nothing of a loss is read before its picture is known to be valid.

use super::gpu::GpuRenderer;
use super::gpu_frame::splat_bytes;
use super::gpu_gradients::{RowGradients, RowsOut, check_room};
use super::gpu_loss::value;
use super::gpu_ranges::Ranges;
use super::gpu_tiles_bwd::{Fold, PictureGradientBuffers};
use super::gpu_view::{DemandState, Lists, Loss, LossSums, Unusable, View, WholeLists};
use super::{Gradients, LossValue, RenderError};
use crate::gpu::{Buffer, GpuResult, Recorder};
use crate::scene::columns::Columns;
use std::ops::Range;

impl GpuRenderer {
    /// Submits the loss of `rgb`: the picture of the view, which may still turn out invalid, or the corrected picture. Writes the
    /// gradient of `loss`, and returns its sums.
    pub(super) fn submit_loss(
        &self,
        mut recorder: Recorder<'_>,
        size: [u32; 2],
        rgb: &Buffer,
        loss: &Loss,
    ) -> GpuResult<LossSums> {
        let gpu = &self.gpu;
        let (rgb, photo, v_rgb) = (rgb.view(), loss.target.view(), loss.v_rgb.view());
        let sums = self.loss.run(gpu, &mut recorder, size, &loss.plan, &rgb, &photo, &v_rgb)?;
        if let Some(errors) = &loss.errors {
            self.loss.errors(&mut recorder, size, &loss.plan, [&rgb, &photo, &errors.view()])?;
        }
        let sums = match sums {
            Some(sums) if self.records.is_some() => LossSums::OnDevice(sums),
            Some(sums) => LossSums::Pending(recorder.read_back("image_loss", &sums.slice(0, 16))?),
            None => LossSums::Empty,
        };
        gpu.submit(recorder)?;
        Ok(sums)
    }

    /// Reads the gradient of the loss into `self.gradient`; zeros if no loss ran.
    pub(super) fn read_gradient(&mut self, view: &mut View) -> GpuResult<()> {
        self.gradient.reset(view.of.camera.pixels());
        if view.loss.is_none() {
            return Ok(());
        }
        self.wait_for_valid_picture(view)?;
        if let Some(loss) = &view.loss {
            let mut recorder = self.gpu.begin("picture gradient");
            let bytes = recorder.read_back("image_loss", &loss.v_rgb.view())?;
            self.gpu.submit(recorder)?;
            bytes.copy_to(&mut self.gradient.v_rgb)?;
        }
        Ok(())
    }

    /// Records the backward pass from the picture to the splats, once the picture is valid.
    pub(super) fn record_picture_back(&mut self, view: &mut View) -> Result<(), RenderError> {
        self.wait_for_valid_picture(view)?;
        let (gpu, blend) = (&self.gpu, view.blend());
        let mut recorder = gpu.begin("backward");
        let (mut uploaded, mut v_alpha) = (None, None);
        if self.gradient_on_host {
            uploaded = Some(recorder.buffer_with("v_rgb", &self.gradient.v_rgb)?);
            v_alpha = self.gradient.v_alpha.as_ref().map(|v| recorder.buffer_with("v_alpha", v)).transpose()?;
        }
        let v_rgb = uploaded.as_ref().or(view.loss.as_ref().map(|loss| &loss.v_rgb));
        let v_rgb = v_rgb.ok_or(RenderError::OutOfOrder { call: "picture_back", needs: "loss or picture_gradient" })?;
        let (v_rgb, v_alpha) = (v_rgb.view(), v_alpha.as_ref().map(Buffer::view));
        // Without a loss no photo was compared.
        let no_errors = match (&view.loss, self.weighs) {
            (None, true) => Some(recorder.buffer_zeroed("squared errors", view.pixels.t_final.size())?),
            _ => None,
        };
        let errors = view.loss.as_ref().and_then(|loss| loss.errors.as_ref()).or(no_errors.as_ref()).map(Buffer::view);
        let gradient = PictureGradientBuffers { v_rgb: &v_rgb, v_alpha: v_alpha.as_ref(), errors: errors.as_ref() };
        (view.tiles_back, view.unusable) = (None, Unusable::Uncounted);
        match &mut view.lists {
            Lists::Whole(lists) => {
                let (WholeLists { ranks, frame, .. }, DemandState::Known(demand)) = (&**lists, &lists.demand) else {
                    return Err(RenderError::OutOfOrder { call: "picture_back", needs: "picture" });
                };
                for segment in &mut view.segments {
                    segment.v_splats = None;
                    let v_splats = gpu.buffer("v_splats", splat_bytes(ranks.rows))?;
                    let (splats, out) = (segment.splats.view(), v_splats.view());
                    let (into, pixels) = (&mut recorder, &view.pixels);
                    self.tiles.backward(
                        gpu,
                        into,
                        &splats,
                        ranks,
                        frame,
                        pixels,
                        *demand,
                        gradient,
                        &out,
                        Fold::Whole,
                    )?;
                    segment.v_splats = Some(v_splats);
                }
                view.tiles_back = Some(recorder.set_aside());
            }
            Lists::Ranges(planned) => {
                gpu.submit(recorder)?; // the uploads
                let ranges = Ranges { gpu, tiles: &self.tiles, stages: &self.ranges, blend, pixels: &view.pixels };
                ranges.back(&mut view.segments, planned, gradient)?;
            }
        }
        if view.columns.is_none() {
            // The caller changes rows as soon as the first batch is out, so the pass out must not fail for want of memory.
            if let Some(tiles) = view.tiles_back.take() {
                gpu.submit(gpu.resume(tiles))?;
            }
            check_room(gpu, view.of.options.sh_degree)?;
        }
        Ok(())
    }

    /// Propagates the gradients of the splats of the batch at `place` to its rows.
    pub(super) fn rows_out_of(
        &mut self,
        view: &mut View,
        rows: &Columns,
        place: &Range<usize>,
        grads: &mut Gradients,
    ) -> Result<(), RenderError> {
        let (gpu, sh_degree) = (&self.gpu, view.of.options.sh_degree);
        let out = RowsOut { gpu, stages: &self.rows, view: &view.of, weighs: self.weighs };
        out.prepare(place.len(), rows.sh_degree, grads);
        if let (Some(columns), Some(segment)) = (&view.columns, view.segments.first()) {
            let room = RowGradients::new(gpu, columns.rows, sh_degree, self.weighs)?;
            let mut recorder = view.tiles_back.take().map_or_else(|| gpu.begin("backward"), |tiles| gpu.resume(tiles));
            match self.tiles.count_unusable(&mut recorder, &view.segments, view.blend()) {
                Ok(unusable) => view.unusable = Unusable::Pending(unusable),
                Err(error) => {
                    // The work that the recorder brings along goes on even if the count lacks memory.
                    gpu.submit(recorder)?;
                    return Err(error.into());
                }
            }
            return Ok(out.whole(recorder, columns, &room, segment, grads, &mut self.scratch)?);
        }
        if view.tiles_back.is_some() || matches!(view.unusable, Unusable::Uncounted) {
            let mut recorder = view.tiles_back.take().map_or_else(|| gpu.begin("backward"), |tiles| gpu.resume(tiles));
            let unusable = self.tiles.count_unusable(&mut recorder, &view.segments, view.blend());
            gpu.submit(recorder)?;
            view.unusable = Unusable::Pending(unusable?);
        }
        let of_batch = view.segments.iter().filter(|segment| place.contains(&segment.first));
        Ok(out.in_chunks(rows, place.start, of_batch, grads, &mut self.scratch)?)
    }

    /// Waits for the number of rows with unusable gradients.
    pub(super) fn read_unusable(view: &mut View) -> GpuResult<u64> {
        let unusable = match std::mem::replace(&mut view.unusable, Unusable::Uncounted) {
            Unusable::Pending(readback) => {
                let mut count = [0u32];
                readback.copy_to(&mut count)?;
                u64::from(count[0])
            }
            Unusable::Known(count) => count,
            Unusable::Uncounted => 0,
        };
        view.unusable = Unusable::Known(unusable);
        Ok(unusable)
    }

    /// Waits for the sums of the loss of a valid picture and returns the value of the loss.
    pub(super) fn read_loss_value(&mut self, view: &mut View) -> Result<LossValue, RenderError> {
        self.wait_for_valid_picture(view)?;
        let Some(loss) = &mut view.loss else {
            return Err(RenderError::OutOfOrder { call: "loss_value", needs: "loss" });
        };
        let sums = match std::mem::replace(&mut loss.sums, LossSums::Empty) {
            // The wait above has computed stale sums again, and a step that is recorded without waiting reads none.
            LossSums::Stale | LossSums::OnDevice(_) => {
                return Err(RenderError::OutOfOrder { call: "loss_value", needs: "loss" });
            }
            LossSums::Empty => [0.0; 4],
            LossSums::Pending(readback) => {
                let mut sums = [0.0f32; 4];
                readback.copy_to(&mut sums)?;
                sums
            }
            LossSums::Known(sums) => sums,
        };
        loss.sums = LossSums::Known(sums);
        Ok(value(&loss.plan, sums))
    }
}
