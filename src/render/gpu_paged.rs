//! [`GpuRenderer`] as a backend that holds pages: the order in which the stages on pages run within a view.
//!
//! A view of one batch keeps its columns on the device until the update; rows of other views are gathered again, by the same
//! compiled stage, so they have the same bits.
//!
//! Not here: the recording of the stages (`gpu_pages`), slots (`gpu_slots`).
//!
//! Invariant: an update is never repeated. Its memory is allocated before its first chunk, or was checked to fit
//! ([`super::gpu_gradients::check_room`]).

use super::gpu::{GpuRenderer, submit_batch};
use super::gpu_gradients::{RowGradients, RowsOut};
use super::gpu_pages::{DevicePages, PageRows, PendingResults, UpdateBuffers};
use super::gpu_rows::{DeviceColumns, RowSource, SplatRows};
use super::gpu_segments::{Segment, gradients_of, in_chunks};
use super::gpu_view::{Unusable, View};
use super::pages::{DeviceSlot, PageRenderer, PageRules, RecordedUpdate, SlotPage, StepDone, StepJob};
use super::{RenderError, RowBatches};
use crate::gpu::{Buffer, GpuResult, Recorder};
use crate::kernels::page_words::{PageResult, PageSurvey};
use crate::scene::optimizer_numbers::StepNumbers;

fn held_mut(pages: &mut Option<Box<DevicePages>>) -> Result<&mut DevicePages, RenderError> {
    pages.as_deref_mut().ok_or(RenderError::OutOfOrder { call: "pages", needs: "prepare_page_storage" })
}

impl GpuRenderer {
    fn held(&self) -> Result<&DevicePages, RenderError> {
        self.pages.as_deref().ok_or(RenderError::OutOfOrder { call: "pages", needs: "prepare_page_storage" })
    }

    /// Updates the rows of the segments of a batch: at once where the columns are still on the device, else in chunks.
    fn update_rows(
        &self,
        view: &mut View,
        mut source: PageRows<'_>,
        first: usize,
        (results, collects): (&Buffer, bool),
    ) -> GpuResult<()> {
        let sh_degree = view.of.options.sh_degree;
        if let Some(columns) = view.columns.take() {
            let all = 0..columns.rows as usize;
            match (self.update_room(columns.rows, sh_degree), view.segments.first()) {
                (Ok(room), Some(segment)) => {
                    return self.update_chunk(view, &source, (segment, 0, &all), &columns, &room, (results, collects));
                }
                // The rows are gathered again, in chunks.
                (Err(error), _) if !error.is_out_of_memory() => return Err(error),
                _ => {}
            }
        }
        let end = first + source.rows();
        for segment in view.segments.iter().filter(|segment| (first..end).contains(&segment.first)) {
            let begin = segment.first - first;
            in_chunks(segment.rows as usize, |part| {
                let columns = DeviceColumns::new(&self.gpu, part.len() as u32, sh_degree)?;
                let room = self.update_room(columns.rows, sh_degree)?;
                let of_batch = begin + part.start..begin + part.end;
                let mut recorder = self.gpu.begin("gather");
                source.geometry(&self.gpu, &mut recorder, &columns, &of_batch)?;
                self.gpu.submit(recorder)?;
                let place = (segment, part.start, &of_batch);
                self.update_chunk(view, &source, place, &columns, &room, (results, collects))
            })?;
        }
        Ok(())
    }

    /// Memory of the update of `rows` rows: gradients, and the largest of each row.
    pub(super) fn update_room(&self, rows: u32, sh_degree: u8) -> GpuResult<(RowGradients, Buffer)> {
        let grads = RowGradients::new(&self.gpu, rows, sh_degree, self.weighs)?;
        Ok((grads, self.gpu.buffer("largest gradients", 4 * u64::from(rows))?))
    }

    /// Submits the gradients and the update of gathered rows, which begin at row `at` of the segment and are `part` of the
    /// batch.
    fn update_chunk(
        &self,
        view: &View,
        source: &PageRows<'_>,
        place: (&Segment, usize, &std::ops::Range<usize>),
        values: &DeviceColumns,
        room: &(RowGradients, Buffer),
        how: (&Buffer, bool),
    ) -> GpuResult<()> {
        let mut recorder = self.gpu.begin("update");
        self.record_update_chunk(&mut recorder, view, source, place, values, room, how)?;
        self.gpu.submit(recorder).map(|_| ())
    }

    /// Records the same.
    pub(super) fn record_update_chunk(
        &self,
        recorder: &mut Recorder<'_>,
        view: &View,
        source: &PageRows<'_>,
        (segment, at, part): (&Segment, usize, &std::ops::Range<usize>),
        values: &DeviceColumns,
        (grads, largest): &(RowGradients, Buffer),
        (results, collects): (&Buffer, bool),
    ) -> GpuResult<()> {
        let out = RowsOut { gpu: &self.gpu, stages: &self.rows, view: &view.of, weighs: self.weighs };
        let splats = [&segment.splats, gradients_of(segment)?].map(|buffer| SplatRows::from_row(buffer, at as u64));
        out.record(recorder, values, splats, grads)?;
        let RowGradients { columns: grads, footprints } = grads;
        let buffers = UpdateBuffers { values, grads, footprints, largest, results, collects, weighs: self.weighs };
        source.pages().update(&self.gpu, recorder, source, part, &buffers)
    }

    /// First row, in the view, of a batch of pages.
    fn first_of_batch(&self, batch: usize) -> Option<usize> {
        let batches = &self.pages_view.as_ref()?.batches;
        (batch < batches.len()).then(|| batches[..batch].iter().map(|before| before.rows as usize).sum())
    }

    fn update_batch(
        &self,
        view: &mut View,
        batch: usize,
        pages: &[SlotPage],
        collects: bool,
    ) -> Result<PendingResults, RenderError> {
        let needs = RenderError::OutOfOrder { call: "begin_update", needs: "pages_out" };
        let (held, first) = (self.held()?, self.first_of_batch(batch));
        let (Some(of_view), Some(first)) = (&self.pages_view, first) else { return Err(needs) };
        let of_batch = &of_view.batches[batch];
        if of_batch.first_listed().len() != pages.len() {
            return Err(RenderError::BatchRows { batch, given: pages.len() });
        }
        if pages.is_empty() {
            return Ok(PendingResults::default());
        }
        let mut recorder = self.gpu.begin("update");
        let table = held.table(&mut recorder, pages, of_batch.first_listed())?;
        let results = recorder.buffer_zeroed("page results", (size_of::<PageResult>() * pages.len()) as u64)?;
        self.gpu.submit(recorder)?;
        let source = held.source(of_view, of_batch, &table);
        self.update_rows(view, source, first, (&results, collects))?;
        Ok(held.begin_results(&self.gpu, &source, &results)?)
    }
}

impl PageRenderer for GpuRenderer {
    fn prepare_page_storage(&mut self, rules: &PageRules) -> Result<(), RenderError> {
        self.drop_view();
        self.pages = None; // frees the slots
        self.pages = Some(Box::new(DevicePages::new(&self.gpu, rules)?));
        Ok(())
    }

    fn room(&mut self) -> u64 {
        self.drop_view();
        self.gpu.room()
    }

    fn slot_bytes(&self) -> u64 {
        self.pages.as_ref().map_or(0, |pages| pages.slots.slot_bytes())
    }

    fn add_slots(&mut self, wanted: usize) -> Result<usize, RenderError> {
        Ok(held_mut(&mut self.pages)?.slots.add(&self.gpu, wanted)?)
    }

    fn write_slots(&mut self, payloads: &[(DeviceSlot, &[u8])]) -> Result<(), RenderError> {
        Ok(self.held()?.slots.write(&self.gpu, payloads)?)
    }

    fn read_slots(&mut self, payloads: &mut [(DeviceSlot, &mut [u8])]) -> Result<(), RenderError> {
        Ok(self.held()?.slots.read(&self.gpu, payloads)?)
    }

    fn begin_reads(&mut self, slots: &[(DeviceSlot, usize)]) -> Result<usize, RenderError> {
        Ok(held_mut(&mut self.pages)?.slots.begin_reads(&self.gpu, slots)?)
    }

    fn finish_reads(&mut self, payloads: &mut [(DeviceSlot, &mut [u8])]) -> Result<(), RenderError> {
        Ok(held_mut(&mut self.pages)?.slots.finish_reads(payloads)?)
    }

    fn pages_in(&mut self, pages: &[SlotPage], step: &StepNumbers) -> Result<usize, RenderError> {
        let Some(view) = self.sequence.view() else {
            return Err(RenderError::OutOfOrder { call: "pages_in", needs: "begin_view" });
        };
        let asked = view.options.sh_degree;
        if let Some(page) = pages.iter().find(|page| page.layout.sh_degree != asked) {
            return Err(RenderError::ShDegree { asked, stored: page.layout.sh_degree });
        }
        let begun = match self.pages_view.take() {
            Some(of_view) => Ok(of_view),
            None => self.held().and_then(|held| Ok(held.begin(&self.gpu, &view.camera, step)?)),
        };
        let mut of_view = begun.inspect_err(|_| self.drop_view())?;
        let listed = self.held().and_then(|held| Ok(held.list(&self.gpu, &of_view, pages)?));
        let (batch, table) = listed.inspect_err(|_| self.drop_view())?;
        let (view, place) = self.sequence.rows_in(batch.rows as usize, asked)?;
        let is_whole = self.sequence.batches() == Some(RowBatches::One);
        let mut source = self.held()?.source(&of_view, &batch, &table);
        let stages = (&self.gpu, &self.rows, &self.tiles);
        let submitted = submit_batch(stages, &mut source, &view, place.start, is_whole);
        self.append(submitted)?;
        let rows = batch.rows as usize;
        of_view.batches.push(batch);
        self.pages_view = Some(of_view);
        Ok(rows)
    }

    fn pages_out(&mut self, batch: usize) -> Result<(), RenderError> {
        let rows = self.pages_view.as_ref().and_then(|view| view.batches.get(batch)).map_or(0, |batch| batch.rows);
        self.sequence.rows_out(batch, rows as usize)?;
        self.with_view("pages_out", |renderer, view| {
            if view.tiles_back.is_none() && !matches!(view.unusable, Unusable::Uncounted) {
                return Ok(());
            }
            let gpu = &renderer.gpu;
            let mut recorder = view.tiles_back.take().map_or_else(|| gpu.begin("backward"), |tiles| gpu.resume(tiles));
            let unusable = renderer.tiles.count_unusable(&mut recorder, &view.segments, view.blend());
            gpu.submit(recorder)?;
            view.unusable = Unusable::Pending(unusable?);
            Ok(())
        })
    }

    fn begin_update(&mut self, batch: usize, pages: &[SlotPage], collects: bool) -> Result<(), RenderError> {
        let needs = RenderError::OutOfOrder { call: "begin_update", needs: "pages_out" };
        let mut view = self.view.take().ok_or(needs)?;
        let begun = self.update_batch(&mut view, batch, pages, collects);
        let pending = begun.inspect_err(|_| self.drop_view())?;
        self.view = Some(view);
        if let Some(of_view) = &mut self.pages_view {
            of_view.updating = Some(pending);
        }
        Ok(())
    }

    fn finish_update(&mut self) -> Result<Vec<PageResult>, RenderError> {
        let pending = self.pages_view.as_mut().and_then(|of_view| of_view.updating.take());
        let needs = RenderError::OutOfOrder { call: "finish_update", needs: "begin_update" };
        let results = pending.ok_or(needs)?.wait();
        Ok(results.inspect_err(|_| self.drop_view())?)
    }

    fn survey(&mut self, pages: &[SlotPage]) -> Result<Vec<PageSurvey>, RenderError> {
        Ok(self.held()?.survey(&self.gpu, pages)?)
    }

    fn clear_statistics(&mut self, pages: &[SlotPage]) -> Result<(), RenderError> {
        Ok(self.held()?.clear_statistics(&self.gpu, pages)?)
    }

    fn take_bins(&mut self) -> Result<Vec<u32>, RenderError> {
        Ok(self.held()?.take_bins(&self.gpu)?)
    }

    fn record_picture(&mut self, job: &StepJob<'_>) -> Result<bool, RenderError> {
        if job.pages.is_empty() || job.rows_room == 0 {
            return Ok(false);
        }
        let asked = job.options.sh_degree;
        match job.pages.iter().find(|page| page.layout.sh_degree != asked) {
            Some(page) => Err(RenderError::ShDegree { asked, stored: page.layout.sh_degree }),
            None => self.record_rows(job),
        }
    }

    fn record_update(&mut self, update: &RecordedUpdate<'_>) -> Result<bool, RenderError> {
        self.record_rest(update)
    }

    fn finish_step(&mut self) -> Result<StepDone, RenderError> {
        self.finish_first()
    }

    fn open_gate(&mut self) -> Result<(), RenderError> {
        if !self.in_flight.is_empty() {
            return Err(RenderError::OutOfOrder { call: "open_gate", needs: "finish_step of every step in flight" });
        }
        let mut recorder = self.gpu.begin("gate");
        recorder.clear(&self.held()?.gate.view())?;
        self.gpu.submit(recorder)?;
        Ok(())
    }
}
