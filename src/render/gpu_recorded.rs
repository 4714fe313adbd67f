//! Steps on pages that are recorded without waiting, so that the host may record the next one while the device
//! computes.
//!
//! The host knows neither how many rows are listed nor how long the lists are. So a recorded step takes buffers whose sizes
//! its caller and earlier steps predict. Entries without a row fill the rest of the columns. The gate (`gate.wgsl`)
//! lets the update write only if every list fitted and the numbers are sound. Everything else is recorded as in other
//! steps, and has the same bits: entries without a row are never drawn, and the empty tail of a list changes no sum.
//!
//! The first two submissions hold uploads (tables, photo), the third holds backward pass, gate and update. The device
//! works in the order of the submissions, so the next step may use the buffers of a step as soon as that step is
//! recorded. A step in flight keeps its two read-backs only.
//!
//! Not here: which steps may be recorded (`train`).
//!
//! Invariants: 1. a step is submitted up to its picture only, or whole with gate and update; 2. a recorded step changes no row unless
//! its gate was open; 3. nothing here waits but [`PageRenderer::finish_step`](super::pages::PageRenderer::finish_step).

use super::RenderError;
use super::gpu_frame::{Demand, FrameRoom, Pairs, Pixels, splat_bytes};
use super::gpu_loss::value;
use super::gpu_pages::{DevicePages, PagesView};
use super::gpu_picture::ViewStages;
use super::gpu_rows::{DeviceColumns, RowSource, SplatRows};
use super::gpu_segments::Segment;
use super::gpu_tiles::TileStages;
use super::gpu_update::Update;
use super::gpu_view::{DemandState, InFlight, Lists, LossSums, Recorded, Unusable, View, WholeLists, blend_of};
use super::pages::{RecordedUpdate, StepDone, StepJob};
use super::sequence::ViewOptions;
use crate::gpu::{Buffer, GpuResult, Readback, Recorder, groups_1d};
use crate::kernels::gate::{GateUniforms, StepVerdict};
use crate::kernels::splats::Grid;
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms::PageResult;
use bytemuck::Zeroable;

/// Submits rows, lists and picture of a step.
pub(super) fn rows_and_picture(
    stages: &ViewStages,
    held: &DevicePages,
    of: ViewOptions,
    job: &StepJob<'_>,
    room: FrameRoom,
) -> GpuResult<(View, PagesView, Recorded)> {
    let ViewStages { gpu, rows, tiles, .. } = stages;
    let (blend, camera, count, sh_degree) = (blend_of(&of), &of.camera, job.rows_room, of.options.sh_degree);
    let mut recorder = gpu.begin("forward");
    let mut of_view = held.begin(&mut recorder, camera, job.numbers)?;
    let (batch, table, counts) = held.list_within(gpu, &mut recorder, (&of_view, job.pages), count)?;
    let columns = DeviceColumns::new(gpu, count, sh_degree)?;
    let splats = gpu.buffer("splats", splat_bytes(count))?;
    held.source(&of_view, &batch, &table).geometry(gpu, &mut recorder, &columns, &(0..count as usize))?;
    let into = SplatRows::from(&splats);
    let keys = Pairs::new(gpu, count)?;
    rows.project_fwd(gpu, &mut recorder, camera, of.options.eps2d, &columns, into, Some(&keys))?;
    let grid = Grid::new(camera.width, camera.height);
    let ranks = tiles.order(gpu, &mut recorder, &splats.view(), count, grid, TileRange::all(grid), Some(keys))?;
    rows.sh_fwd(gpu, &mut recorder, camera, &columns, into)?;
    let pixels = Pixels::new(gpu, blend.grid)?;
    let frame = tiles.frame_of(gpu, &mut recorder, &splats.view(), &ranks, (blend, room), &pixels)?;
    gpu.submit(recorder)?;
    let demand = DemandState::Known(Demand { isects: room.capacity, list_max: room.list_max });
    let lists = Lists::Whole(Box::new(WholeLists { ranks, frame, demand }));
    let segment = Segment { first: 0, rows: count, splats, v_splats: None };
    let view = View::new(of, vec![segment], Some(columns), pixels, lists);
    of_view.batches.push(batch);
    Ok((View { is_recorded: true, ..view }, of_view, Recorded { table, counts, room }))
}

/// Submits backward pass, gate and update of a step with a loss.
pub(super) fn back_and_update(
    stages: &ViewStages,
    (held, of_view, records): (&DevicePages, &PagesView, &Recorded),
    mut view: View,
    update: &RecordedUpdate<'_>,
) -> Result<InFlight, RenderError> {
    let needs = || RenderError::OutOfOrder { call: "record_update", needs: "record_picture" };
    let (tiles_back, columns) = (view.tiles_back.take().ok_or_else(needs)?, view.columns.take().ok_or_else(needs)?);
    let mut recorder = stages.gpu.resume(tiles_back);
    let verdict = record_gate(&mut recorder, (held, records), &view, update)?;
    let (batch, segment) = (of_view.batches.first().ok_or_else(needs)?, view.segments.first().ok_or_else(needs)?);
    let source = held.source(of_view, batch, &records.table);
    let pages = records.table.pages.len();
    let results = recorder.buffer_zeroed("page results", (size_of::<PageResult>() * pages) as u64)?;
    let collects = update.collects;
    let update = Update { stages, of: view.of, weighs: view.weighs, source, results: &results, collects };
    let room = update.room(columns.rows)?;
    update.record(&mut recorder, (segment, 0, &(0..columns.rows as usize)), &columns, &room)?;
    held.bounds(&mut recorder, &source, &results)?;
    let results = recorder.read_back("update", &results.view())?;
    stages.gpu.submit(recorder)?;
    Ok(InFlight { verdict, results, plan: view.loss.ok_or_else(needs)?.plan })
}

fn record_gate(
    recorder: &mut Recorder<'_>,
    (held, records): (&DevicePages, &Recorded),
    view: &View,
    update: &RecordedUpdate<'_>,
) -> Result<Readback, RenderError> {
    let needs = RenderError::OutOfOrder { call: "record_update", needs: "loss" };
    let (Lists::Whole(lists), Some(loss), Unusable::OnDevice(unusable)) = (&view.lists, &view.loss, &view.unusable)
    else {
        return Err(needs);
    };
    let verdict = recorder.buffer_zeroed("verdict", size_of::<StepVerdict>() as u64)?;
    // Bound in place of the sums of a picture without pixels.
    let no_sums = recorder.buffer_zeroed("no sums", 16)?;
    let (sums, has_loss) = match &loss.sums {
        LossSums::OnDevice(sums) => (sums, 1),
        _ => (&no_sums, 0),
    };
    let uniform = recorder.uniform(&GateUniforms {
        rows_room: if update.closes { 0 } else { lists.ranks.rows },
        isects_room: records.room.capacity,
        list_room: records.room.list_max,
        rows_per_unusable: update.rows_per_unusable,
        rows_at: records.table.pages.len() as u32,
        isects_at: lists.ranks.rows,
        has_loss,
        pad: 0,
    })?;
    let of_step = [&records.counts, &lists.ranks.offsets, &lists.frame.longest, unusable, sums];
    let views: Vec<_> =
        std::iter::once(uniform).chain(of_step.map(Buffer::view)).chain([held.gate.view(), verdict.view()]).collect();
    recorder.dispatch("gate", &held.stages.decide, &views, groups_1d(1, 1))?;
    Ok(recorder.read_back("gate", &verdict.view())?)
}

/// Waits for a step in flight. If the step was taken, `tiles` notes its list sizes, to predict those of the next steps.
pub(super) fn finish(step: InFlight, tiles: &mut TileStages) -> GpuResult<StepDone> {
    let mut of_step = [StepVerdict::zeroed()];
    step.verdict.copy_to(&mut of_step)?;
    let [StepVerdict { closed, rows, isects, list_max, unusable, sums, .. }] = of_step;
    let pages = step.results.to_vec()?;
    if closed == 0 {
        tiles.note(Demand { isects, list_max });
    }
    Ok(StepDone { closed, rows, unusable, loss: value(&step.plan, sums.map(f32::from_bits)), pages })
}
