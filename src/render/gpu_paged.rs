//! [`GpuRenderer`] as a backend that holds pages: the order in which the stages on pages run within a view.
//!
//! A view of one batch keeps its columns on the device until the update; rows of other views are gathered again, by the same
//! compiled stage, so they have the same bits.
//!
//! Not here: the recording of the stages (`gpu_pages`), slots (`gpu_slots`), the update (`gpu_update`).

use super::gpu::GpuRenderer;
use super::gpu_back::submit_tiles_back;
use super::gpu_pages::DevicePages;
use super::gpu_recorded::{back_and_update, finish, rows_and_picture};
use super::gpu_update::update_batch;
use super::gpu_view::View;
use super::pages::{PageRenderer, PageRules, RecordedUpdate, SlotPage, StepDone, StepJob};
use super::{RenderError, Renderer, RowBatches};
use crate::kernels::uniforms::{PageResult, PageSurvey};
use crate::scene::optimizer_numbers::StepNumbers;

const NO_PAGES: RenderError = RenderError::OutOfOrder { call: "pages", needs: "prepare_page_storage" };

fn held(pages: &Option<Box<DevicePages>>) -> Result<&DevicePages, RenderError> {
    pages.as_deref().ok_or(NO_PAGES)
}

fn held_mut(pages: &mut Option<Box<DevicePages>>) -> Result<&mut DevicePages, RenderError> {
    pages.as_deref_mut().ok_or(NO_PAGES)
}

impl PageRenderer for GpuRenderer {
    fn prepare_page_storage(&mut self, rules: &PageRules) -> Result<(), RenderError> {
        self.drop_view();
        self.pages = None; // frees the slots
        self.stages.rows.update_rows(&self.stages.gpu)?;
        self.pages = Some(Box::new(DevicePages::new(&self.stages.gpu, rules)?));
        Ok(())
    }

    fn room(&mut self) -> u64 {
        self.drop_view();
        self.stages.gpu.room()
    }

    fn slot_bytes(&self) -> u64 {
        self.pages.as_ref().map_or(0, |pages| pages.slots.slot_bytes())
    }

    fn add_slots(&mut self, wanted: usize) -> Result<usize, RenderError> {
        Ok(held_mut(&mut self.pages)?.slots.add(&self.stages.gpu, wanted)?)
    }

    fn write_slots(&mut self, payloads: &[(SlotPage, &[u8])]) -> Result<(), RenderError> {
        Ok(held(&self.pages)?.slots.write(&self.stages.gpu, payloads)?)
    }

    fn read_slots(&mut self, payloads: &mut [(SlotPage, &mut [u8])]) -> Result<(), RenderError> {
        Ok(held(&self.pages)?.slots.read(&self.stages.gpu, payloads)?)
    }

    fn begin_reads(&mut self, slots: &[SlotPage]) -> Result<usize, RenderError> {
        Ok(held_mut(&mut self.pages)?.slots.begin_reads(&self.stages.gpu, slots)?)
    }

    fn finish_reads(&mut self, payloads: &mut [(SlotPage, &mut [u8])]) -> Result<(), RenderError> {
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
        let (before, gpu) = (self.pages_view.take(), &self.stages.gpu);
        let begun = held(&self.pages).and_then(|held| {
            let of_view = match before {
                Some(of_view) => of_view,
                None => {
                    let mut recorder = gpu.begin("gather");
                    let of_view = held.begin(&mut recorder, &view.camera, step)?;
                    gpu.submit(recorder)?;
                    of_view
                }
            };
            let listed = held.list(gpu, &of_view, pages)?;
            Ok((of_view, listed))
        });
        let (mut of_view, (batch, table)) = begun.inspect_err(|_| self.drop_view())?;
        let (view, place) = self.sequence.rows_in(batch.rows as usize, asked)?;
        let is_whole = self.sequence.batches() == Some(RowBatches::One);
        let mut source = held(&self.pages)?.source(&of_view, &batch, &table);
        let submitted = self.stages.submit_batch(&mut source, &view, place.start, is_whole);
        self.append(submitted)?;
        let rows = batch.rows as usize;
        of_view.batches.push(batch);
        self.pages_view = Some(of_view);
        Ok(rows)
    }

    fn pages_out(&mut self, batch: usize) -> Result<(), RenderError> {
        let rows = self.pages_view.as_ref().and_then(|view| view.batches.get(batch)).map_or(0, |batch| batch.rows);
        self.sequence.rows_out(batch, rows as usize)?;
        self.with_view("pages_out", |renderer, view| Ok(submit_tiles_back(&renderer.stages, view)?))
    }

    fn begin_update(&mut self, batch: usize, pages: &[SlotPage], collects: bool) -> Result<(), RenderError> {
        let needs = RenderError::OutOfOrder { call: "begin_update", needs: "pages_out" };
        let mut view = self.view.take().ok_or(needs)?;
        let begun = held(&self.pages).and_then(|held| {
            let of_view = self.pages_view.as_ref();
            update_batch(&self.stages, (held, of_view), &mut view, (batch, pages), collects)
        });
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
        let results = pending.ok_or(needs)?.map_or(Ok(Vec::new()), |read| read.to_vec());
        Ok(results.inspect_err(|_| self.drop_view())?)
    }

    fn survey(&mut self, pages: &[SlotPage]) -> Result<Vec<PageSurvey>, RenderError> {
        Ok(held(&self.pages)?.survey(&self.stages.gpu, pages)?)
    }

    fn clear_statistics(&mut self, pages: &[SlotPage]) -> Result<(), RenderError> {
        Ok(held(&self.pages)?.clear_statistics(&self.stages.gpu, pages)?)
    }

    fn take_bins(&mut self) -> Result<Vec<u32>, RenderError> {
        Ok(held(&self.pages)?.take_bins(&self.stages.gpu)?)
    }

    fn record_picture(&mut self, job: &StepJob<'_>) -> Result<bool, RenderError> {
        if job.pages.is_empty() || job.rows_room == 0 {
            return Ok(false);
        }
        let asked = job.options.sh_degree;
        if let Some(page) = job.pages.iter().find(|page| page.layout.sh_degree != asked) {
            return Err(RenderError::ShDegree { asked, stored: page.layout.sh_degree });
        }
        let Some(mut room) = self.stages.tiles.room_by_demand() else { return Ok(false) };
        room.capacity = room.capacity.min(job.isects_most);
        if !self.in_flight.is_empty() {
            self.stages.gpu.allow_steps_in_flight();
        }
        self.begin_view(job.camera, job.options, RowBatches::One)?;
        let of = self.sequence.rows_in(job.rows_room as usize, asked).and_then(|_| self.sequence.picture());
        let recorded = of.and_then(|of| Ok(rows_and_picture(&self.stages, held(&self.pages)?, of, job, room)?));
        let recorded = recorded.map(|(view, of_view, records)| {
            self.view = Some(View { weighs: self.weighs, ..view });
            (self.pages_view, self.records) = (Some(of_view), Some(records));
        });
        self.false_if_out_of_memory(recorded)
    }

    fn record_update(&mut self, update: &RecordedUpdate<'_>) -> Result<bool, RenderError> {
        let needs = || RenderError::OutOfOrder { call: "record_update", needs: "record_picture" };
        if self.records.is_none() {
            return Err(needs());
        }
        let recorded = self.loss(update.target, update.loss).and_then(|()| self.picture_back());
        // A view that has freed memory cannot take the recorded path.
        let is_whole = |view: &View| view.columns.is_some() && view.tiles_back.is_some();
        if recorded.is_ok() && !self.view.as_ref().is_some_and(is_whole) {
            self.drop_view();
            return Ok(false);
        }
        let in_flight = recorded.and_then(|()| match (&self.records, &self.pages_view, self.view.take()) {
            (Some(records), Some(of_view), Some(view)) => {
                back_and_update(&self.stages, (held(&self.pages)?, of_view, records), view, update)
            }
            _ => Err(needs()),
        });
        let in_flight = in_flight.map(|step| self.in_flight.push_back(step));
        let done = self.false_if_out_of_memory(in_flight);
        self.drop_view();
        done
    }

    fn finish_step(&mut self) -> Result<StepDone, RenderError> {
        let needs = RenderError::OutOfOrder { call: "finish_step", needs: "record_update" };
        let step = self.in_flight.pop_front().ok_or(needs)?;
        Ok(finish(step, &mut self.stages.tiles)?)
    }

    fn open_gate(&mut self) -> Result<(), RenderError> {
        if !self.in_flight.is_empty() {
            return Err(RenderError::OutOfOrder { call: "open_gate", needs: "finish_step of every step in flight" });
        }
        let mut recorder = self.stages.gpu.begin("gate");
        recorder.clear(&held(&self.pages)?.gate.view())?;
        self.stages.gpu.submit(recorder)?;
        Ok(())
    }
}
