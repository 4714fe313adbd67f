//! The update of the rows of pages on a device: their gradients, and the optimizer's step in their slots.
//!
//! Not here: the recording of the stages (`gpu_pages`, `gpu_gradients`).
//!
//! Invariant: an update is never repeated. Its memory is allocated before its first chunk, or was checked to fit
//! ([`super::gpu_gradients::check_room`]).

use super::RenderError;
use super::gpu_gradients::RowsOut;
use super::gpu_pages::{DevicePages, PageRows, PagesView, PendingResults, UpdateBuffers};
use super::gpu_picture::ViewStages;
use super::gpu_rows::{DeviceColumns, RowGradients, RowSource, SplatRows};
use super::gpu_segments::{Segment, gradients_of, in_chunks};
use super::gpu_view::View;
use super::pages::SlotPage;
use super::sequence::ViewOptions;
use crate::gpu::{Buffer, GpuResult, Recorder};
use crate::kernels::uniforms::PageResult;
use std::ops::Range;

/// Updates the pages of a batch in their slots and begins to read what that did to them. Does not wait.
pub(super) fn update_batch(
    stages: &ViewStages,
    (held, of_view): (&DevicePages, Option<&PagesView>),
    view: &mut View,
    (batch, pages): (usize, &[SlotPage]),
    collects: bool,
) -> Result<PendingResults, RenderError> {
    let needs = RenderError::OutOfOrder { call: "begin_update", needs: "pages_out" };
    let Some((of_view, of_batch)) = of_view.and_then(|view| Some((view, view.batches.get(batch)?))) else {
        return Err(needs);
    };
    if of_batch.listed.len() != pages.len() {
        return Err(RenderError::BatchRows { batch, given: pages.len() });
    }
    if pages.is_empty() {
        return Ok(None);
    }
    let mut recorder = stages.gpu.begin("update");
    let table = held.table(&mut recorder, pages, &of_batch.listed)?;
    let results = recorder.buffer_zeroed("page results", (size_of::<PageResult>() * pages.len()) as u64)?;
    stages.gpu.submit(recorder)?;
    let source = held.source(of_view, of_batch, &table);
    let first = of_view.batches[..batch].iter().map(|before| before.rows as usize).sum();
    let update = Update { stages, of: view.of, weighs: view.weighs, source, results: &results, collects };
    update.rows(view, first)?;
    Ok(Some(held.begin_results(&stages.gpu, &source, &results)?))
}

/// An update of listed rows.
pub(super) struct Update<'a> {
    pub stages: &'a ViewStages,
    pub of: ViewOptions,
    pub weighs: bool,
    pub source: PageRows<'a>,
    /// `[page of the batch]`: what the update did.
    pub results: &'a Buffer,
    /// Whether statistics are collected.
    pub collects: bool,
}

impl Update<'_> {
    /// Updates the rows of the batch, which begins at row `first` of the view: at once where the columns are still on the device,
    /// else in chunks.
    fn rows(&self, view: &mut View, first: usize) -> GpuResult<()> {
        let gpu = &self.stages.gpu;
        if let Some(columns) = view.columns.take() {
            let all = 0..columns.rows as usize;
            match (self.room(columns.rows), view.segments.first()) {
                (Ok(room), Some(segment)) => {
                    let mut recorder = gpu.begin("update");
                    self.record(&mut recorder, (segment, 0, &all), &columns, &room)?;
                    return gpu.submit(recorder).map(|_| ());
                }
                // The rows are gathered again, in chunks.
                (Err(error), _) if !error.is_out_of_memory() => return Err(error),
                _ => {}
            }
        }
        let mut source = self.source;
        let end = first + source.rows();
        for segment in view.segments.iter().filter(|segment| (first..end).contains(&segment.first)) {
            let begin = segment.first - first;
            in_chunks(segment.rows as usize, |part| {
                let columns = DeviceColumns::new(gpu, part.len() as u32, self.of.options.sh_degree)?;
                let room = self.room(columns.rows)?;
                let of_batch = begin + part.start..begin + part.end;
                let mut recorder = gpu.begin("gather");
                source.geometry(gpu, &mut recorder, &columns, &of_batch)?;
                gpu.submit(recorder)?;
                let mut recorder = gpu.begin("update");
                self.record(&mut recorder, (segment, part.start, &of_batch), &columns, &room)?;
                gpu.submit(recorder).map(|_| ())
            })?;
        }
        Ok(())
    }

    /// Memory of the gradients of `rows` rows.
    pub fn room(&self, rows: u32) -> GpuResult<RowGradients> {
        RowGradients::for_update(&self.stages.gpu, rows, self.weighs)
    }

    /// Records the gradients and the update of gathered rows, which begin at row `at` of the segment and are `part` of the batch.
    pub fn record(
        &self,
        recorder: &mut Recorder<'_>,
        (segment, at, part): (&Segment, usize, &Range<usize>),
        values: &DeviceColumns,
        grads: &RowGradients,
    ) -> GpuResult<()> {
        let Update { stages, of, weighs, source, results, collects } = self;
        let gpu = &stages.gpu;
        let out = RowsOut { gpu, stages: &stages.rows, view: of, weighs: *weighs };
        let splats = [&segment.splats, gradients_of(segment)?].map(|buffer| SplatRows::from_row(buffer, at as u64));
        out.record(recorder, values, splats, grads)?;
        let buffers = UpdateBuffers { values, grads, splats, results, collects: *collects };
        source.pages.update(gpu, recorder, source, part, &buffers)
    }
}
