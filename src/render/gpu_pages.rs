//! Records the stages on pages on a device: gather and update. Owns the slots, the optimizer's tables and the bins of
//! growth scores and weights.
//!
//! A dispatch works on the pages of one slab, so a batch takes one dispatch for each slab in which it has pages. A workgroup gathers or
//! updates a chunk of the listed rows of one page.
//!
//! Not here: the stages on rows (`gpu_rows`), the order of a view (`gpu`), steps that are recorded without waiting (`gpu_recorded`).
//!
//! Invariants: 1. a dispatch binds windows of columns, so no binding is too large; floats are independent, so the result has the
//! same bits for any windows; 2. an update of a part of a batch is submitted at once, so the part is updated as a whole or not at all.

use super::gpu_rows::{
    DeviceColumns, OfDegree, RowGradients, RowSource, SplatRows, Window, footprint_bytes, of_degrees, windows,
};
use super::gpu_slots::Slots;
use super::pages::{PageRules, SlotPage};
use crate::gpu::{Buffer, BufferView, Gpu, GpuResult, Pipeline, Readback, Recorder, groups_1d};
use crate::kernels::deferred::DeferredTables;
use crate::kernels::uniforms::{DevicePage, GatherUniforms, PageSurvey, UpdateUniforms, of_columns};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, sh_n_width};
use crate::scene::optimizer_numbers::StepNumbers;
use bytemuck::Zeroable;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

/// Invocations per workgroup.
pub(super) const WORKGROUP: u32 = 256;
/// Bins of mean growth scores, and as many of mean weights: the upper halves of floats that are not negative.
const BINS: u64 = 1 << 15;
/// Rows of a workgroup that gathers or updates columns, as in `shaders/shared/page.wgsl`.
const CHUNK_ROWS: u32 = 64;

#[derive(Debug)]
pub(super) struct Stages {
    pub(super) cull: Arc<Pipeline>,
    pub(super) place: Arc<Pipeline>,
    gather_geometry: Arc<Pipeline>,
    gather_colors: Arc<Pipeline>,
    bounds: Arc<Pipeline>,
    survey: Arc<Pipeline>,
    clear: Arc<Pipeline>,
    step_geometry: Arc<Pipeline>,
    step_colors: OfDegree,
    finish: Arc<Pipeline>,
    pub(super) decide: Arc<Pipeline>,
}

/// The pages of a run on a device.
#[derive(Debug)]
pub struct DevicePages {
    pub slots: Slots,
    pub(super) stages: Stages,
    rules: PageRules,
    tables: Buffer,
    bins: Buffer,
    /// One word: 0 while steps may change rows.
    pub(super) gate: Buffer,
}

/// Buffers that the stages of one view share.
#[derive(Debug)]
pub struct PagesView {
    camera: Camera,
    step: StepNumbers,
    recent: Buffer,
    pub batches: Vec<PageBatch>,
    /// The update that has begun and that nobody has waited for.
    pub(super) updating: Option<PendingResults>,
}

/// What an update does to the pages of a batch ([`crate::kernels::uniforms::PageResult`]s), on its way to the host; `None` for a batch without pages.
pub(super) type PendingResults = Option<Readback>;

/// The listed rows of a batch: those that the camera may draw, page after page.
#[derive(Debug)]
pub struct PageBatch {
    /// Listed rows of each page; empty where only the device knows.
    pub listed: Vec<u32>,
    /// Listed rows, or those that the columns have room for.
    pub rows: u32,
    /// `[row of the pages]`: the numbers of the listed rows of each page, from the place of the page's first row on.
    pub found: Buffer,
}

/// Pages of a batch in their slots.
#[derive(Debug)]
pub struct PageTable {
    pub(super) pages: Vec<DevicePage>,
    /// Whether the numbers of listed rows are known.
    is_known: bool,
    pub(super) on_device: Buffer,
}

impl PageTable {
    /// The slabs in which the batch has pages.
    fn slabs(&self) -> BTreeSet<u32> {
        self.pages.iter().map(|page| page.slab).collect()
    }

    /// The pages of a dispatch, and the number of chunks of `size` rows of the largest page: the pages in the slab
    /// whose listed rows reach into `rows`, or all pages in the slab if only the device knows the listed rows.
    fn chunks(&self, slab: u32, rows: &Range<u32>, size: u32) -> PageChunks {
        let reaches = |page: &DevicePage| {
            !self.is_known || (page.first_listed < rows.end && page.first_listed + page.listed > rows.start)
        };
        let mut of_dispatch = PageChunks { turns: 0..0, chunks: 1 };
        let in_turn = self.pages.iter().map(|entry| &self.pages[entry.page_from_turn as usize]);
        for (turn, page) in (0..).zip(in_turn).filter(|(_, page)| page.slab == slab && reaches(page)) {
            let first = if of_dispatch.turns.is_empty() { turn } else { of_dispatch.turns.start };
            of_dispatch.turns = first..turn + 1;
            let rows = if self.is_known { page.listed } else { page.rows };
            of_dispatch.chunks = of_dispatch.chunks.max(rows.div_ceil(size));
        }
        of_dispatch
    }
}

/// The chunks of rows on which a dispatch works.
struct PageChunks {
    /// The turns of the pages.
    turns: Range<u32>,
    /// Chunks of each page.
    chunks: u32,
}

impl PageChunks {
    fn workgroups(&self) -> u32 {
        self.turns.len() as u32 * self.chunks
    }
}

impl DevicePages {
    /// Compiles the stages and uploads the tables of a run.
    pub fn new(gpu: &Gpu, rules: &PageRules) -> GpuResult<DevicePages> {
        let halves: &[(&str, &str)] = if rules.numbers.has_halves { &[("HALF_MOMENTS", "")] } else { &[] };
        let of = |shader: &str, entry: &str| gpu.pipeline(shader, entry, halves);
        let stages = Stages {
            cull: of("gather.wgsl", "cull")?,
            place: of("gather.wgsl", "place")?,
            gather_geometry: of("gather.wgsl", "gather_geometry")?,
            gather_colors: of("gather.wgsl", "gather_colors")?,
            bounds: of("gather.wgsl", "bounds")?,
            survey: of("gather.wgsl", "survey")?,
            clear: of("update.wgsl", "clear_statistics")?,
            step_geometry: of("update.wgsl", "step_geometry")?,
            step_colors: of_degrees(gpu, "update.wgsl", "step_colors", halves)?,
            finish: of("update.wgsl", "finish")?,
            decide: gpu.pipeline("gate.wgsl", "decide", &[])?,
        };
        let mut recorder = gpu.begin("pages");
        let tables = recorder.buffer_with("optimizer tables", DeferredTables::new(&rules.numbers).words())?;
        let bins = recorder.buffer_zeroed("bins", 4 * BINS * if rules.weighs { 2 } else { 1 })?;
        let gate = recorder.buffer_zeroed("gate", 4)?;
        gpu.submit(recorder)?;
        let slots = Slots::new(rules.largest, rules.numbers.has_halves);
        Ok(DevicePages { slots, stages, rules: rules.clone(), tables, bins, gate })
    }

    /// Begins a view at a step: records the upload of its tables.
    pub fn begin(&self, recorder: &mut Recorder<'_>, camera: &Camera, step: &StepNumbers) -> GpuResult<PagesView> {
        let recent = recorder.buffer_with("recent", step.recent.as_flattened())?;
        Ok(PagesView { camera: *camera, step: step.clone(), recent, batches: Vec::new(), updating: None })
    }

    pub(super) fn uniforms(&self, view: &PagesView, pages: usize) -> GatherUniforms {
        GatherUniforms::new(&view.camera, &self.rules.numbers, view.step.now, &self.rules.splits, pages as u32)
    }

    /// Uploads the table of pages in their slots, with the number of listed rows of each, where it is known.
    pub fn table(&self, recorder: &mut Recorder<'_>, pages: &[SlotPage], listed_rows: &[u32]) -> GpuResult<PageTable> {
        let (mut first_row, mut first_listed) = (0, 0);
        let mut entries = Vec::with_capacity(pages.len());
        for (i, page) in pages.iter().enumerate() {
            let (slab, offset) = self.slots.place(page.slot);
            let listed = listed_rows.get(i).copied().unwrap_or(0);
            let entry = DevicePage::new(page.layout, slab, (offset / 4) as u32, first_row);
            entries.push(DevicePage { first_listed, listed, ..entry });
            first_row += entry.rows;
            first_listed += listed;
        }
        let mut in_turn: Vec<u32> = (0..entries.len() as u32).collect();
        in_turn.sort_by_key(|page| entries[*page as usize].slab);
        entries.iter_mut().zip(in_turn).for_each(|(entry, page)| entry.page_from_turn = page);
        let on_device = recorder.buffer_with("page table", &entries)?;
        Ok(PageTable { pages: entries, is_known: !listed_rows.is_empty(), on_device })
    }

    /// Records the cull of the pages. Returns their table, their counts with a word for the sum, and the rows that were found.
    pub(super) fn cull(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        view: &PagesView,
        pages: &[SlotPage],
    ) -> GpuResult<(PageTable, [Buffer; 2])> {
        let table = self.table(recorder, pages, &[])?;
        let rows: u64 = table.pages.iter().map(|page| u64::from(page.rows)).sum();
        let counts = gpu.buffer("counts", 4 * (pages.len() as u64 + 1))?;
        let found = gpu.buffer("found", 4 * rows)?;
        let uniforms = self.uniforms(view, pages.len());
        let groups = groups_1d(pages.len() as u32 * WORKGROUP, WORKGROUP);
        for slab in table.slabs() {
            let uniform = recorder.uniform(&GatherUniforms { slab, ..uniforms })?;
            let [slab, tables, recent] = [self.slots.slab(slab)?, self.tables.view(), view.recent.view()];
            let views = [uniform, table.on_device.view(), slab, tables, recent, counts.view(), found.view()];
            recorder.dispatch("gather", &self.stages.cull, &views, groups)?;
        }
        Ok((table, [counts, found]))
    }

    /// Lists the rows of the pages that the camera may draw. Waits for their numbers.
    pub fn list(&self, gpu: &Gpu, view: &PagesView, pages: &[SlotPage]) -> GpuResult<(PageBatch, PageTable)> {
        let mut recorder = gpu.begin("gather");
        let (table, [counts, found]) = self.cull(gpu, &mut recorder, view, pages)?;
        let read = recorder.read_back("gather", &counts.slice(0, 4 * pages.len() as u64))?;
        gpu.submit(recorder)?;
        drop(table);
        let listed = read.to_vec::<u32>()?;
        let mut recorder = gpu.begin("gather");
        let table = self.table(&mut recorder, pages, &listed)?;
        gpu.submit(recorder)?;
        Ok((PageBatch { rows: listed.iter().sum(), listed, found }, table))
    }

    /// Records the list of the rows that the camera may draw, for columns with room for `rows` rows. Returns the batch,
    /// its table, and the counts of the pages with their sum.
    pub(super) fn list_within(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        (view, pages): (&PagesView, &[SlotPage]),
        rows: u32,
    ) -> GpuResult<(PageBatch, PageTable, Buffer)> {
        let (table, [counts, found]) = self.cull(gpu, recorder, view, pages)?;
        let views = [recorder.uniform(&self.uniforms(view, pages.len()))?, counts.view(), table.on_device.view()];
        recorder.dispatch("gather", &self.stages.place, &views, groups_1d(1, 1))?;
        Ok((PageBatch { listed: Vec::new(), rows, found }, table, counts))
    }

    /// The listed rows of a batch as a source of columns.
    pub fn source<'a>(&'a self, view: &'a PagesView, batch: &'a PageBatch, table: &'a PageTable) -> PageRows<'a> {
        PageRows { pages: self, view, batch, table }
    }

    /// Records the update of the listed rows `part` of a batch.
    pub fn update(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        source: &PageRows<'_>,
        part: &Range<usize>,
        buffers: &UpdateBuffers<'_>,
    ) -> GpuResult<()> {
        let PageRows { view, batch, table, .. } = *source;
        let UpdateBuffers { values, grads, splats: [splats, v_splats], results, collects } = *buffers;
        let uniforms = UpdateUniforms::new(&view.camera, &view.step, collects, grads.weighs);
        let (stages, gate) = (&self.stages, self.gate.view());
        for window in windows(gpu, values.rows, values.widest()) {
            let bound = bound_rows(part, window);
            let (splats, v_splats) = (splats.window(window), v_splats.window(window));
            for slab in table.slabs() {
                let of_dispatch = table.chunks(slab, &bound, CHUNK_ROWS);
                if of_dispatch.turns.is_empty() {
                    continue;
                }
                let uniforms = UpdateUniforms {
                    slab,
                    row_count: window.rows,
                    first_bound: bound.start,
                    first_turn: of_dispatch.turns.start,
                    end_turn: of_dispatch.turns.end,
                    chunks: of_dispatch.chunks,
                    ..uniforms
                };
                let finishing = table.chunks(slab, &bound, WORKGROUP);
                let groups = groups_1d(of_dispatch.workgroups(), 1);
                let [pages, found, slab] = [table.on_device.view(), batch.found.view(), self.slots.slab(slab)?];
                let of_slab =
                    [pages.clone(), slab.clone(), self.tables.view(), found.clone(), v_splats.clone(), gate.clone()];
                let (w, g) = (values.window(window), grads.columns.window(window));
                let pairs = [
                    (Column::Means, [&w.means, &g.means, &w.quats, &g.quats]),
                    (Column::Scales, [&w.scales, &g.scales, &w.opacities, &g.opacities]),
                ];
                for (column, own) in pairs {
                    let uniform = recorder.uniform(&UpdateUniforms { column: column as u32, ..uniforms })?;
                    let own = own.map(BufferView::clone);
                    let views: Vec<BufferView> = [uniform].into_iter().chain(of_slab.clone()).chain(own).collect();
                    recorder.dispatch("update", &stages.step_geometry, &views, groups)?;
                }
                let uniform = recorder.uniform(&uniforms)?;
                let mut views: Vec<BufferView> = [uniform].into_iter().chain(of_slab).collect();
                views.extend([splats.clone()].into_iter().chain(w.sh0));
                views.extend(w.sh_n.into_iter().flat_map(|sh_n| [w.means.clone(), sh_n]));
                let step_colors = &stages.step_colors[usize::from(values.sh_degree)];
                recorder.dispatch("update", step_colors, &views, groups)?;
                let footprints = window.of(&grads.footprints, footprint_bytes(grads.weighs));
                let uniform = recorder.uniform(&UpdateUniforms { chunks: finishing.chunks, ..uniforms })?;
                let of_rows = [pages, slab, found, v_splats.clone(), gate.clone()];
                let own = [footprints, results.view(), self.bins.view()];
                let views: Vec<BufferView> = [uniform].into_iter().chain(of_rows).chain(own).collect();
                recorder.dispatch("update", &stages.finish, &views, groups_1d(finishing.workgroups(), 1))?;
            }
        }
        Ok(())
    }

    /// Finds the bounds of the pages of a batch and begins to read what the update did: a [`crate::kernels::uniforms::PageResult`] for each. Does not wait.
    pub fn begin_results(&self, gpu: &Gpu, source: &PageRows<'_>, results: &Buffer) -> GpuResult<Readback> {
        let mut recorder = gpu.begin("update");
        self.bounds(&mut recorder, source, results)?;
        let read = recorder.read_back("update", &results.view())?;
        gpu.submit(recorder)?;
        Ok(read)
    }

    /// Records the bounds of the pages of a batch.
    pub(super) fn bounds(&self, recorder: &mut Recorder<'_>, source: &PageRows<'_>, results: &Buffer) -> GpuResult<()> {
        let PageRows { view, table, .. } = *source;
        let uniforms = self.uniforms(view, table.pages.len());
        let groups = groups_1d(table.pages.len() as u32 * WORKGROUP, WORKGROUP);
        for slab in table.slabs() {
            let uniform = recorder.uniform(&GatherUniforms { slab, ..uniforms })?;
            let [slab, tables, recent] = [self.slots.slab(slab)?, self.tables.view(), view.recent.view()];
            let views = [uniform, table.on_device.view(), slab, tables, recent, results.view()];
            recorder.dispatch("update", &self.stages.bounds, &views, groups)?;
        }
        Ok(())
    }

    /// What decides whether a round edits rows of these pages. Waits.
    pub fn survey(&self, gpu: &Gpu, pages: &[SlotPage]) -> GpuResult<Vec<PageSurvey>> {
        let mut recorder = gpu.begin("survey");
        let table = self.table(&mut recorder, pages, &[])?;
        let surveys = recorder.buffer_zeroed("surveys", (size_of::<PageSurvey>() * pages.len()) as u64)?;
        let rates = of_columns(&self.rules.numbers.base_rates);
        let uniforms = GatherUniforms { page_count: pages.len() as u32, rates, ..GatherUniforms::zeroed() };
        let groups = groups_1d(pages.len() as u32 * WORKGROUP, WORKGROUP);
        for slab in table.slabs() {
            let uniform = recorder.uniform(&GatherUniforms { slab, ..uniforms })?;
            // The stage reads no sums of the present step, so the tables are bound in their place.
            let [slab, tables] = [self.slots.slab(slab)?, self.tables.view()];
            let views = [uniform, table.on_device.view(), slab, tables.clone(), tables, surveys.view()];
            recorder.dispatch("gather", &self.stages.survey, &views, groups)?;
        }
        let read = recorder.read_back("survey", &surveys.view())?;
        gpu.submit(recorder)?;
        read.to_vec()
    }

    /// Clears the statistics of all rows of these pages. Does not wait.
    pub fn clear_statistics(&self, gpu: &Gpu, pages: &[SlotPage]) -> GpuResult<()> {
        let mut recorder = gpu.begin("clear statistics");
        let table = self.table(&mut recorder, pages, &[])?;
        let groups = groups_1d(pages.len() as u32 * WORKGROUP, WORKGROUP);
        for slab in table.slabs() {
            let uniform = UpdateUniforms { slab, row_count: pages.len() as u32, ..UpdateUniforms::zeroed() };
            let views = [recorder.uniform(&uniform)?, table.on_device.view(), self.slots.slab(slab)?];
            recorder.dispatch("update", &self.stages.clear, &views, groups)?;
        }
        gpu.submit(recorder).map(|_| ())
    }

    /// Takes the bins and clears them. Waits.
    pub fn take_bins(&self, gpu: &Gpu) -> GpuResult<Vec<u32>> {
        let mut recorder = gpu.begin("update");
        let read = recorder.read_back("update", &self.bins.view())?;
        recorder.clear(&self.bins.view())?;
        gpu.submit(recorder)?;
        read.to_vec()
    }
}

/// The listed rows, numbered in the batch, that `window` binds; `window` counts from the begin of `part`.
fn bound_rows(part: &Range<usize>, window: Window) -> Range<u32> {
    let first = part.start as u32 + window.first as u32;
    first..first + window.rows
}

/// Buffers of the update of a part of a batch.
pub struct UpdateBuffers<'a> {
    /// Values of the rows, from [`PageRows`].
    pub values: &'a DeviceColumns,
    /// Their gradients; rows are weighed only if the run's rules allow it.
    pub grads: &'a RowGradients,
    /// Their splats, and the gradients of these, whose last words hold the largest gradient of each row.
    pub splats: [SplatRows<'a>; 2],
    /// `[page of the batch]`: what the update did.
    pub results: &'a Buffer,
    /// Whether statistics are collected.
    pub collects: bool,
}

/// The listed rows of a batch, as a source of columns.
#[derive(Clone, Copy)]
pub struct PageRows<'a> {
    pub(super) pages: &'a DevicePages,
    view: &'a PagesView,
    batch: &'a PageBatch,
    table: &'a PageTable,
}

impl RowSource for PageRows<'_> {
    fn rows(&self) -> usize {
        self.batch.rows as usize
    }

    /// Gathers all columns.
    fn geometry(
        &mut self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        columns: &DeviceColumns,
        part: &Range<usize>,
    ) -> GpuResult<()> {
        let PageRows { pages, view, batch, table } = *self;
        let sh_n_width = sh_n_width(columns.sh_degree) as u32;
        let uniforms = pages.uniforms(view, table.pages.len());
        for window in windows(gpu, columns.rows, columns.widest()) {
            let bound = bound_rows(part, window);
            // Where only the device knows how many rows there are, the first dispatch fills the room behind them.
            let mut filled = if batch.listed.is_empty() { window.rows.div_ceil(CHUNK_ROWS) } else { 0 };
            for slab in table.slabs() {
                let of_dispatch = table.chunks(slab, &bound, CHUNK_ROWS);
                if of_dispatch.turns.is_empty() {
                    continue;
                }
                let uniforms = GatherUniforms {
                    slab,
                    row_count: window.rows,
                    sh_n_width,
                    first_bound: bound.start,
                    first_turn: of_dispatch.turns.start,
                    end_turn: of_dispatch.turns.end,
                    chunks: of_dispatch.chunks,
                    ..uniforms
                };
                let groups = groups_1d(of_dispatch.workgroups() + std::mem::take(&mut filled), 1);
                let [slab, tables, recent] = [pages.slots.slab(slab)?, pages.tables.view(), view.recent.view()];
                let buffers = [table.on_device.view(), slab, tables, recent, batch.found.view()];
                let w = columns.window(window);
                // Bound in place of bands that no invocation has.
                let no_bands = gpu.buffer("no bands", 4)?;
                let sh_n = w.sh_n.unwrap_or_else(|| no_bands.view());
                let geometry = vec![w.means, w.quats, w.scales, w.opacities];
                let colors = w.sh0.into_iter().chain([sh_n]).collect();
                let stages = &pages.stages;
                for (stage, out) in [(&stages.gather_geometry, geometry), (&stages.gather_colors, colors)] {
                    let uniform = recorder.uniform(&uniforms)?;
                    let views: Vec<BufferView> = [uniform].into_iter().chain(buffers.clone()).chain(out).collect();
                    recorder.dispatch("gather", stage, &views, groups)?;
                }
            }
        }
        Ok(())
    }

    /// The colours come with the geometry.
    fn colors(&mut self, _: &mut Recorder<'_>, _: &DeviceColumns, _: &Range<usize>) -> GpuResult<()> {
        Ok(())
    }
}
