//! [`GpuRenderer`]: steps on pages that are recorded without waiting, so that the host may record the next one while the device
//! computes.
//!
//! The host knows neither how many rows are listed nor how long the lists are. So a recorded step takes buffers whose sizes
//! its caller and earlier steps predict. Entries without a row fill the rest of the list of rows. The gate (`gate.wgsl`)
//! lets the update write only if every list fitted and the numbers are sound. Everything else is recorded as in other
//! steps, and has the same bits: entries without a row are never drawn, and the empty tail of a list changes no sum.
//!
//! Two submissions bring uploads (tables, photo), the third brings backward pass, gate and update. Buffers of a step are handed to the
//! next one as soon as they are recorded, because the device works in the order of the submissions; only the two read-backs of a step
//! in flight stay.
//!
//! Not here: which steps may be recorded (`train`).
//!
//! Invariants: 1. a step is submitted up to its picture only, or whole with gate and update; 2. a recorded step changes no row unless
//! its gate was open; 3. nothing here waits but [`PageRenderer::finish_step`](super::pages::PageRenderer::finish_step).

use super::gpu::GpuRenderer;
use super::gpu_frame::{Demand, FrameRoom, Pixels, splat_bytes};
use super::gpu_loss::value;
use super::gpu_pages::{DevicePages, PageBatch, PageTable, PagesView, WORKGROUP};
use super::gpu_rows::{DeviceColumns, RowSource, SplatRows};
use super::gpu_segments::Segment;
use super::gpu_view::{DemandState, InFlight, Lists, LossSums, Recorded, View, WholeLists, blend_of};
use super::pages::{RecordedUpdate, SlotPage, StepDone, StepJob};
use super::{RenderError, Renderer, RowBatches, none_if_out_of_memory};
use crate::gpu::{Buffer, Gpu, GpuResult, Readback, Recorder, groups_1d};
use crate::kernels::gate::{GateUniforms, StepVerdict};
use crate::kernels::page_words::PageResult;
use crate::kernels::splats::Grid;
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms_pages::GatherUniforms;
use bytemuck::Zeroable;

/// Bytes of a listed row: number of the page, number of the row.
const LISTED_BYTES: u64 = 8;

impl DevicePages {
    /// Records the list of the rows that the camera may draw, with room for `rows` rows. Returns it with the counts of the pages and
    /// their sum.
    fn list_within(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        (view, pages): (&PagesView, &[SlotPage]),
        rows: u32,
    ) -> GpuResult<(PageBatch, PageTable, Buffer)> {
        let (table, [counts, found]) = self.cull(gpu, recorder, view, pages)?;
        let listed = gpu.buffer("listed", LISTED_BYTES * u64::from(rows))?;
        let uniforms = GatherUniforms { row_count: rows, ..self.uniforms(view, pages.len()) };
        let uniform = recorder.uniform(&uniforms)?;
        let views = [uniform.clone(), counts.view(), table.on_device.view()];
        recorder.dispatch("gather", &self.stages.place, &views, groups_1d(1, 1))?;
        let views = [uniform.clone(), counts.view(), listed.view()];
        recorder.dispatch("gather", &self.stages.pad, &views, groups_1d(rows, WORKGROUP))?;
        let views = [uniform, table.on_device.view(), counts.view(), found.view(), listed.view()];
        let groups = groups_1d(pages.len() as u32 * WORKGROUP, WORKGROUP);
        recorder.dispatch("gather", &self.stages.list, &views, groups)?;
        Ok((PageBatch { first_listed: Vec::new(), rows, listed }, table, counts))
    }
}

impl GpuRenderer {
    /// Records rows, lists and picture of a step. False where memory is short.
    pub(super) fn record_rows(&mut self, job: &StepJob<'_>) -> Result<bool, RenderError> {
        let Some(mut room) = self.tiles.room_by_demand() else { return Ok(false) };
        room.capacity = room.capacity.min(job.isects_most);
        if !self.in_flight.is_empty() {
            self.gpu.allow_steps_in_flight();
        }
        self.begin_view(job.camera, job.options, RowBatches::One)?;
        let recorded = self.rows_and_picture(job, room);
        self.false_if_out_of_memory(recorded)
    }

    fn rows_and_picture(&mut self, job: &StepJob<'_>, room: FrameRoom) -> Result<(), RenderError> {
        let (of, _) = self.sequence.rows_in(job.rows_room as usize, job.options.sh_degree)?;
        self.sequence.picture()?;
        let held =
            self.pages.as_deref().ok_or(RenderError::OutOfOrder { call: "pages", needs: "prepare_page_storage" })?;
        let (gpu, blend, camera, count) = (&self.gpu, blend_of(&of), &of.camera, job.rows_room);
        let mut recorder = gpu.begin("forward");
        let mut view = held.begin_in(&mut recorder, camera, job.numbers)?;
        let (batch, table, counts) = held.list_within(gpu, &mut recorder, (&view, job.pages), count)?;
        let columns = DeviceColumns::new(gpu, count, of.options.sh_degree)?;
        let splats = gpu.buffer("splats", splat_bytes(count))?;
        held.source(&view, &batch, &table).geometry(gpu, &mut recorder, &columns, &(0..count as usize))?;
        let (into, eps2d) = (SplatRows::from(&splats), of.options.eps2d);
        self.rows.project_fwd(gpu, &mut recorder, camera, eps2d, &columns, into)?;
        let grid = Grid::new(camera.width, camera.height);
        let ranks = self.tiles.order(gpu, &mut recorder, &splats.view(), count, grid, TileRange::all(grid))?;
        self.rows.sh_fwd(gpu, &mut recorder, camera, of.options.sh_degree, &columns, into)?;
        let pixels = Pixels::new(gpu, blend.grid)?;
        let frame = self.tiles.frame_of(gpu, &mut recorder, &splats.view(), &ranks, (blend, room), &pixels)?;
        gpu.submit(recorder)?;
        let demand = DemandState::Known(Demand { isects: room.capacity, list_max: room.list_max });
        let lists = Lists::Whole(Box::new(WholeLists { ranks, frame, demand }));
        let segment = Segment { first: 0, rows: count, splats, v_splats: None };
        self.view = Some(View::new(of, vec![segment], Some(columns), pixels, lists));
        view.batches.push(batch);
        (self.pages_view, self.records) = (Some(view), Some(Recorded { table, counts, room }));
        Ok(())
    }

    /// Records loss, backward pass, gate and update of a step whose picture is recorded. False where memory is short.
    pub(super) fn record_rest(&mut self, update: &RecordedUpdate<'_>) -> Result<bool, RenderError> {
        if self.records.is_none() {
            return Err(RenderError::OutOfOrder { call: "record_update", needs: "record_picture" });
        }
        let recorded = self.loss(update.target, update.loss).and_then(|()| self.picture_back());
        // A view that has given memory back takes other ways than the recorded one.
        let is_whole = |view: &View| view.columns.is_some() && view.tiles_back.is_some();
        if recorded.is_ok() && !self.view.as_ref().is_some_and(is_whole) {
            return self.false_if_out_of_memory(Ok(())).map(|_| false);
        }
        let in_flight = recorded.and_then(|()| self.back_and_update(update));
        let in_flight = in_flight.map(|step| self.in_flight.push_back(step));
        let done = self.false_if_out_of_memory(in_flight);
        self.drop_view();
        self.records = None;
        done
    }

    fn back_and_update(&mut self, update: &RecordedUpdate<'_>) -> Result<InFlight, RenderError> {
        let needs = || RenderError::OutOfOrder { call: "record_update", needs: "record_picture" };
        let mut view = self.view.take().ok_or_else(needs)?;
        let (tiles_back, columns) = (view.tiles_back.take().ok_or_else(needs)?, view.columns.take().ok_or_else(needs)?);
        let gpu = &self.gpu;
        let mut recorder = gpu.resume(tiles_back);
        let unusable = self.tiles.unusable(&mut recorder, &view.segments, view.blend())?;
        let held = self.pages.as_deref().ok_or_else(needs)?;
        let (records, of_view) =
            (self.records.as_ref().ok_or_else(needs)?, self.pages_view.as_ref().ok_or_else(needs)?);
        let verdict = self.decide(&mut recorder, (held, records), &view, &unusable, update)?;
        let (batch, segment) = (of_view.batches.first().ok_or_else(needs)?, view.segments.first().ok_or_else(needs)?);
        let source = held.source(of_view, batch, &records.table);
        let pages = records.table.pages.len();
        let results = recorder.buffer_zeroed("page results", (size_of::<PageResult>() * pages) as u64)?;
        let room = self.update_room(columns.rows, view.of.options.sh_degree)?;
        let (all, how) = (0..columns.rows as usize, (&results, update.collects));
        self.record_update_chunk(&mut recorder, &view, &source, (segment, 0, &all), &columns, &room, how)?;
        held.bounds(&mut recorder, &source, &results)?;
        let results = recorder.read_back("update", &results.view())?;
        gpu.submit(recorder)?;
        let plan = view.loss.ok_or_else(needs)?.plan;
        Ok(InFlight { verdict, results, pages, plan })
    }

    /// Records the gate of a step.
    fn decide(
        &self,
        recorder: &mut Recorder<'_>,
        (held, records): (&DevicePages, &Recorded),
        view: &View,
        unusable: &Buffer,
        update: &RecordedUpdate<'_>,
    ) -> Result<Readback, RenderError> {
        let needs = || RenderError::OutOfOrder { call: "record_update", needs: "loss" };
        let (Lists::Whole(lists), Some(loss)) = (&view.lists, &view.loss) else { return Err(needs()) };
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
        let views: Vec<_> = std::iter::once(uniform)
            .chain(of_step.map(Buffer::view))
            .chain([held.gate.view(), verdict.view()])
            .collect();
        recorder.dispatch("gate", &held.stages.decide, &views, groups_1d(1, 1))?;
        Ok(recorder.read_back("gate", &verdict.view())?)
    }

    /// Gives up the view of a step that could not be recorded; false where memory is short.
    fn false_if_out_of_memory(&mut self, recorded: Result<(), RenderError>) -> Result<bool, RenderError> {
        if recorded.is_err() {
            self.drop_view();
            self.records = None;
        }
        Ok(none_if_out_of_memory(recorded)?.is_some())
    }

    /// Waits for the first step in flight.
    pub(super) fn finish_first(&mut self) -> Result<StepDone, RenderError> {
        let needs = RenderError::OutOfOrder { call: "finish_step", needs: "record_update" };
        let InFlight { verdict, results, pages, plan } = self.in_flight.pop_front().ok_or(needs)?;
        let mut of_step = [StepVerdict::zeroed()];
        verdict.copy_to(&mut of_step)?;
        let [verdict] = of_step;
        let mut of_pages = vec![PageResult::zeroed(); pages];
        results.copy_to(&mut of_pages)?;
        if verdict.closed == 0 {
            self.tiles.note(Demand { isects: verdict.isects, list_max: verdict.list_max });
        }
        let loss = value(&plan, verdict.sums.map(f32::from_bits));
        let StepVerdict { closed, rows, unusable, .. } = verdict;
        Ok(StepDone { closed, rows, unusable, loss, pages: of_pages })
    }
}
