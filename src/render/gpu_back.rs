//! Loss and gradients of a view on a GPU: from the picture to the splats, and from there to the rows.
//!
//! Not here: the recording of the stages (`gpu_loss`, `gpu_tiles_bwd`, `gpu_gradients`), the picture (`gpu_picture`), the order of a
//! view (`gpu`).
//!
//! Invariant: nothing of a loss is read before its picture is known to be valid.

use super::gpu_frame::splat_bytes;
use super::gpu_gradients::{RowsOut, Scratch, check_room};
use super::gpu_loss::value;
use super::gpu_picture::ViewStages;
use super::gpu_ranges::Ranges;
use super::gpu_rows::RowGradients;
use super::gpu_tiles_bwd::{Fold, PictureGradientBuffers};
use super::gpu_view::{DemandState, Lists, LossSums, Unusable, View, WholeLists};
use super::{Gradients, LossValue, PictureGradient, RenderError};
use crate::gpu::{Buffer, Gpu, GpuResult, Recorder};
use crate::scene::columns::Columns;
use std::ops::Range;

/// Reads the gradient of the loss into `gradient`; zeros if no loss ran.
pub(super) fn read_gradient(stages: &mut ViewStages, view: &mut View, gradient: &mut PictureGradient) -> GpuResult<()> {
    gradient.reset(view.of.camera.pixels());
    if view.loss.is_none() {
        return Ok(());
    }
    stages.wait_for_valid_picture(view)?;
    if let Some(loss) = &view.loss {
        let mut recorder = stages.gpu.begin("picture gradient");
        let bytes = recorder.read_back("image_loss", &loss.v_rgb.view())?;
        stages.gpu.submit(recorder)?;
        bytes.copy_to(&mut gradient.v_rgb)?;
    }
    Ok(())
}

/// Records the backward pass from the picture to the splats, once the picture is valid. `of_host` replaces the gradient of the loss.
pub(super) fn record_picture_back(
    stages: &mut ViewStages,
    view: &mut View,
    of_host: Option<&PictureGradient>,
) -> Result<(), RenderError> {
    stages.wait_for_valid_picture(view)?;
    let (gpu, blend) = (&stages.gpu, view.blend());
    let mut recorder = gpu.begin("backward");
    let uploaded = of_host.map(|gradient| upload_gradient(gpu, &mut recorder, gradient)).transpose()?;
    let v_rgb = uploaded.as_ref().or(view.loss.as_ref().map(|loss| &loss.v_rgb));
    let v_rgb = v_rgb.ok_or(RenderError::OutOfOrder { call: "picture_back", needs: "loss or picture_gradient" })?;
    let (v_rgb, has_v_alpha) = (v_rgb.view(), of_host.is_some_and(|gradient| gradient.v_alpha.is_some()));
    // Without a loss no photo was compared.
    let no_errors = match (&view.loss, view.weighs) {
        (None, true) => Some(recorder.buffer_zeroed("squared errors", view.pixels.t_final.size())?),
        _ => None,
    };
    let errors = view.loss.as_ref().and_then(|loss| loss.errors.as_ref()).or(no_errors.as_ref()).map(Buffer::view);
    let gradient = PictureGradientBuffers { v_rgb: &v_rgb, has_v_alpha, errors: errors.as_ref() };
    (view.tiles_back, view.unusable) = (None, Unusable::Uncounted);
    let unusable = recorder.buffer_zeroed("unusable rows", 4)?;
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
                let (out, fold) = ((&out, &unusable), Fold::Whole);
                stages.tiles.back.backward(gpu, into, &splats, ranks, frame, pixels, *demand, gradient, out, fold)?;
                segment.v_splats = Some(v_splats);
            }
            view.tiles_back = Some(recorder.set_aside());
        }
        Lists::Ranges(planned) => {
            gpu.submit(recorder)?; // the uploads
            let ranges = Ranges { gpu, tiles: &stages.tiles, stages: &stages.ranges, blend, pixels: &view.pixels };
            ranges.back(&mut view.segments, planned, gradient, &unusable)?;
        }
    }
    view.unusable = Unusable::OnDevice(unusable);
    if view.columns.is_none() {
        // After the first batch of the pass out, the caller changes rows. So the pass must not run out of memory: check now.
        if let Some(tiles) = view.tiles_back.take() {
            gpu.submit(gpu.resume(tiles))?;
        }
        check_room(gpu, view.of.options.sh_degree)?;
    }
    Ok(())
}

/// Uploads the planes of a gradient, of alpha last.
fn upload_gradient(gpu: &Gpu, recorder: &mut Recorder<'_>, gradient: &PictureGradient) -> GpuResult<Buffer> {
    let alpha = gradient.v_alpha.as_deref().unwrap_or_default();
    let [of_rgb, of_alpha] = [&gradient.v_rgb[..], alpha].map(|planes| size_of_val(planes) as u64);
    gpu.check_binding("rasterize_bwd", "v_rgb", of_rgb + of_alpha)?;
    let planes = gpu.buffer("v_rgb", of_rgb + of_alpha)?;
    recorder.upload(&planes.slice(0, of_rgb), &gradient.v_rgb)?;
    recorder.upload(&planes.slice(of_rgb, of_alpha), alpha)?;
    Ok(planes)
}

/// Propagates the gradients of the splats of the batch at `place` to its rows.
pub(super) fn rows_out(
    stages: &ViewStages,
    view: &mut View,
    (rows, place): (&Columns, &Range<usize>),
    grads: &mut Gradients,
    scratch: &mut Scratch,
) -> GpuResult<()> {
    let (of, weighs) = (view.of, view.weighs);
    let out = RowsOut { gpu: &stages.gpu, stages: &stages.rows, view: &of, weighs };
    out.prepare(place.len(), rows.sh_degree, grads);
    if let Some(count) = view.columns.as_ref().map(|columns| columns.rows) {
        let room = RowGradients::new(&stages.gpu, count, of.options.sh_degree, weighs)?;
        let recorder = with_unusable(stages, view)?;
        if let (Some(columns), Some(segment)) = (&view.columns, view.segments.first()) {
            return out.whole(recorder, columns, &room, segment, grads, scratch);
        }
    }
    submit_tiles_back(stages, view)?;
    let of_batch = view.segments.iter().filter(|segment| place.contains(&segment.first));
    out.in_chunks(rows, place.start, of_batch, grads, scratch)
}

/// The tile stages of the backward pass, if they are not submitted yet, with the read-back of the number of rows with unusable gradients.
fn with_unusable<'g>(stages: &'g ViewStages, view: &mut View) -> GpuResult<Recorder<'g>> {
    let gpu = &stages.gpu;
    let mut recorder = view.tiles_back.take().map_or_else(|| gpu.begin("backward"), |tiles| gpu.resume(tiles));
    if let Unusable::OnDevice(unusable) = &view.unusable {
        match recorder.read_back("rasterize_bwd", &unusable.view()) {
            Ok(unusable) => view.unusable = Unusable::Pending(unusable),
            Err(error) => {
                // Submit the tile stages in any case: only the read-back lacked memory.
                gpu.submit(recorder)?;
                return Err(error);
            }
        }
    }
    Ok(recorder)
}

/// Submits the tile stages of the backward pass and the read-back of the number of rows with unusable gradients, if no batch did so before.
pub(super) fn submit_tiles_back(stages: &ViewStages, view: &mut View) -> GpuResult<()> {
    if view.tiles_back.is_some() || matches!(view.unusable, Unusable::OnDevice(_)) {
        let recorder = with_unusable(stages, view)?;
        stages.gpu.submit(recorder)?;
    }
    Ok(())
}

/// Waits for the number of rows with unusable gradients.
pub(super) fn read_unusable(view: &mut View) -> Result<u64, RenderError> {
    let unusable = match std::mem::replace(&mut view.unusable, Unusable::Uncounted) {
        Unusable::Pending(readback) => {
            let mut count = [0u32];
            readback.copy_to(&mut count)?;
            u64::from(count[0])
        }
        Unusable::Known(count) => count,
        // `rows_out` and `pages_out` begin to read it.
        Unusable::Uncounted | Unusable::OnDevice(_) => {
            return Err(RenderError::OutOfOrder { call: "unusable_splats", needs: "rows_out of a batch" });
        }
    };
    view.unusable = Unusable::Known(unusable);
    Ok(unusable)
}

/// Waits for the sums of the loss of a valid picture and returns the value of the loss.
pub(super) fn read_loss_value(stages: &mut ViewStages, view: &mut View) -> Result<LossValue, RenderError> {
    stages.wait_for_valid_picture(view)?;
    let no_loss = RenderError::OutOfOrder { call: "loss_value", needs: "loss" };
    let Some(loss) = &mut view.loss else { return Err(no_loss) };
    let sums = match std::mem::replace(&mut loss.sums, LossSums::Known([0.0; 4])) {
        // The wait above has renewed stale sums. Nobody reads the loss of a step that is recorded without waiting.
        LossSums::Stale | LossSums::OnDevice(_) => return Err(no_loss),
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
