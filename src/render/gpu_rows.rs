//! Records the stages on rows on a device: project_fwd, sh_fwd, sh_bwd, project_bwd. Owns the device columns.
//!
//! Not here: the choice of rows, the tile stages, the order of a step.
//!
//! Invariant: no binding exceeds the device's limit: longer columns are bound in windows of rows, and because rows are independent
//! the result has the same bits.

use super::gpu_frame::Pairs;
use crate::gpu::{Buffer, BufferView, Gpu, GpuResult, Pipeline, Recorder, groups_1d};
use crate::kernels::project_fwd::View;
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns, sh_n_width};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;

/// Bytes per row of `splats` and `v_splats`: see `shaders/shared/splat.wgsl`.
pub const SPLAT_BYTES: u64 = 48;
/// Bytes per row of the densification input from `sh_bwd`: gradient with respect to the projected mean, and radii; if
/// `weighs`, also weight, weight times error, and two unused words.
pub fn footprint_bytes(weighs: bool) -> u64 {
    if weighs { 32 } else { 16 }
}
/// The define of the shaders that weigh rows.
pub(super) const WEIGHS: [(&str, &str); 1] = [("WEIGHS", "")];
/// Windows begin at multiples of this many rows. Every column's offset is then a multiple of 256 bytes, the largest
/// alignment that a device may require.
pub const WINDOW_STEP: u64 = 64;
/// Invocations per workgroup.
const WORKGROUP: u32 = 256;
/// Rows that a thread of the host copies at least.
pub(super) const ROWS_OF_THREAD: usize = 4096;

/// Columns of rows on the device, or the gradients of the columns.
#[derive(Debug)]
pub struct DeviceColumns {
    pub rows: u32,
    /// `[rows][3]`.
    pub means: Buffer,
    /// `[rows][4]`.
    pub quats: Buffer,
    /// `[rows][3]`.
    pub scales: Buffer,
    /// `[rows]`.
    pub opacities: Buffer,
    /// `[rows][3]`; `None` where colours have no gradients.
    pub sh0: Option<Buffer>,
    /// `[rows][(degree + 1)^2 - 1][3]`: the bands in use above 0; `None` if there are none.
    pub sh_n: Option<Buffer>,
    /// The highest band.
    pub sh_degree: u8,
}

impl DeviceColumns {
    /// Allocates `rows` rows with the bands 1 to `sh_degree`, uninitialised.
    pub fn new(gpu: &Gpu, rows: u32, sh_degree: u8) -> GpuResult<Self> {
        let column = |label, width: usize| gpu.buffer(label, 4 * width as u64 * u64::from(rows));
        let (sh_degree, sh_n_width) = (sh_degree.min(3), sh_n_width(sh_degree.min(3)));
        let sh_n = if sh_n_width > 0 { Some(column("sh_n", sh_n_width)?) } else { None };
        Ok(DeviceColumns { sh0: Some(column("sh0", 3)?), sh_n, sh_degree, ..DeviceColumns::geometry(gpu, rows)? })
    }

    /// As [`DeviceColumns::new`], without colours.
    fn geometry(gpu: &Gpu, rows: u32) -> GpuResult<Self> {
        let column = |label, width: u64| gpu.buffer(label, 4 * width * u64::from(rows));
        Ok(DeviceColumns {
            rows,
            means: column("means", 3)?,
            quats: column("quats", 4)?,
            scales: column("scales", 3)?,
            opacities: column("opacities", 1)?,
            sh0: None,
            sh_n: None,
            sh_degree: 0,
        })
    }

    /// Bytes per row over all columns, with the bands 1 to `sh_degree`.
    pub fn row_bytes(sh_degree: u8) -> u64 {
        4 * (14 + sh_n_width(sh_degree.min(3))) as u64
    }

    /// Each column that has entries, in the order of [`Column::ALL`], with its floats per row.
    pub fn columns(&self) -> impl Iterator<Item = (Column, &Buffer, usize)> {
        let narrow = [&self.means, &self.quats, &self.scales, &self.opacities].into_iter().chain(&self.sh0);
        let narrow = Column::ALL.into_iter().zip(narrow).map(|(column, buffer)| (column, buffer, column.width(0)));
        narrow.chain(self.sh_n.as_ref().map(|buffer| (Column::ShN, buffer, sh_n_width(self.sh_degree))))
    }

    /// Uploads means, quats, scales and opacities of the rows `part`, which are `self.rows` rows.
    pub fn upload_geometry(&self, recorder: &mut Recorder<'_>, rows: &Columns, part: &Range<usize>) -> GpuResult<()> {
        recorder.upload(&self.means.view(), &rows.means[3 * part.start..3 * part.end])?;
        recorder.upload(&self.quats.view(), &rows.quats[4 * part.start..4 * part.end])?;
        recorder.upload(&self.scales.view(), &rows.scales[3 * part.start..3 * part.end])?;
        recorder.upload(&self.opacities.view(), &rows.opacities[part.clone()])
    }

    /// Uploads the colours of the rows `part`, which are `self.rows` rows with at least the bands in use. `scratch` holds the bands
    /// in use, if the rows have more.
    pub fn upload_colors(
        &self,
        recorder: &mut Recorder<'_>,
        rows: &Columns,
        part: &Range<usize>,
        scratch: &mut Vec<f32>,
    ) -> GpuResult<()> {
        if let Some(sh0) = &self.sh0 {
            recorder.upload(&sh0.view(), &rows.sh0[3 * part.start..3 * part.end])?;
        }
        let Some(sh_n) = &self.sh_n else { return Ok(()) };
        let width = rows.sh_n.len() / rows.rows().max(1);
        let of_part = &rows.sh_n[width * part.start..width * part.end];
        if width == sh_n_width(self.sh_degree) {
            return recorder.upload(&sh_n.view(), of_part);
        }
        take_bands(of_part, width, sh_n_width(self.sh_degree), scratch);
        recorder.upload(&sh_n.view(), scratch)
    }

    /// Bytes per row of the widest binding of a stage on the columns.
    pub fn widest(&self) -> u64 {
        SPLAT_BYTES.max(4 * sh_n_width(self.sh_degree) as u64)
    }

    /// The part of each column inside `window`.
    pub(super) fn window(&self, window: Window) -> WindowViews {
        let view = |buffer: &Buffer, width: usize| window.of(buffer, 4 * width as u64);
        WindowViews {
            means: view(&self.means, 3),
            quats: view(&self.quats, 4),
            scales: view(&self.scales, 3),
            opacities: view(&self.opacities, 1),
            sh0: self.sh0.as_ref().map(|buffer| view(buffer, 3)),
            sh_n: self.sh_n.as_ref().map(|buffer| view(buffer, sh_n_width(self.sh_degree))),
        }
    }
}

/// Copies the first `width` of `row_width` floats of each row to `out`, on all threads.
pub fn take_bands(rows: &[f32], row_width: usize, width: usize, out: &mut Vec<f32>) {
    out.resize(rows.len() / row_width.max(1) * width, 0.0);
    let rows = rows.par_chunks_exact(row_width.max(1)).with_min_len(ROWS_OF_THREAD);
    out.par_chunks_exact_mut(width.max(1)).zip(rows).for_each(|(out, row)| out.copy_from_slice(&row[..width]));
}

/// Copies `bands`, `width` floats a row, to the first floats of rows of `row_width`, on all threads.
pub fn put_bands(bands: &[f32], width: usize, rows: &mut [f32], row_width: usize) {
    let rows = rows.par_chunks_exact_mut(row_width.max(1)).with_min_len(ROWS_OF_THREAD);
    rows.zip(bands.par_chunks_exact(width.max(1))).for_each(|(row, bands)| row[..width].copy_from_slice(bands));
}

/// Where the columns of the rows of a batch come from.
pub trait RowSource {
    fn rows(&self) -> usize;

    /// Records what fills means, quats, scales and opacities of `columns` with the rows `part` of the batch, and
    /// perhaps the colours.
    fn geometry(
        &mut self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        columns: &DeviceColumns,
        part: &Range<usize>,
    ) -> GpuResult<()>;

    /// Records what fills the colours, if [`RowSource::geometry`] has not.
    fn colors(&mut self, recorder: &mut Recorder<'_>, columns: &DeviceColumns, part: &Range<usize>) -> GpuResult<()>;
}

pub(super) struct HostRows<'a> {
    pub rows: &'a Columns,
    /// Memory for the SH bands in use.
    pub bands: &'a mut Vec<f32>,
}

impl RowSource for HostRows<'_> {
    fn rows(&self) -> usize {
        self.rows.rows()
    }

    fn geometry(
        &mut self,
        _: &Gpu,
        recorder: &mut Recorder<'_>,
        columns: &DeviceColumns,
        part: &Range<usize>,
    ) -> GpuResult<()> {
        columns.upload_geometry(recorder, self.rows, part)
    }

    fn colors(&mut self, recorder: &mut Recorder<'_>, columns: &DeviceColumns, part: &Range<usize>) -> GpuResult<()> {
        columns.upload_colors(recorder, self.rows, part, self.bands)
    }
}

/// Splat records, or their gradients, of consecutive rows from a row of a buffer on.
#[derive(Debug, Clone, Copy)]
pub struct SplatRows<'a> {
    buffer: &'a Buffer,
    first: u64,
}

impl<'a> SplatRows<'a> {
    /// The records from row `first` on, a multiple of [`WINDOW_STEP`].
    pub fn from_row(buffer: &'a Buffer, first: u64) -> Self {
        SplatRows { buffer, first }
    }

    /// The records of the rows of `window`.
    pub(super) fn window(&self, window: Window) -> BufferView {
        Window { first: self.first + window.first, ..window }.of(self.buffer, SPLAT_BYTES)
    }
}

impl<'a> From<&'a Buffer> for SplatRows<'a> {
    fn from(buffer: &'a Buffer) -> Self {
        SplatRows::from_row(buffer, 0)
    }
}

/// A range of rows that one binding covers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Window {
    /// First row.
    pub first: u64,
    pub rows: u32,
}

impl Window {
    /// The window's part of a buffer of `row_bytes` bytes a row.
    pub fn of(self, buffer: &Buffer, row_bytes: u64) -> BufferView {
        buffer.slice(self.first * row_bytes, u64::from(self.rows) * row_bytes)
    }
}

/// The columns inside a window.
pub(super) struct WindowViews {
    pub means: BufferView,
    pub quats: BufferView,
    pub scales: BufferView,
    pub opacities: BufferView,
    pub sh0: Option<BufferView>,
    pub sh_n: Option<BufferView>,
}

/// Device memory of the gradients of rows.
#[derive(Debug)]
pub struct RowGradients {
    /// Gradients of the columns; those of colours only where the host updates.
    pub columns: DeviceColumns,
    /// Gradient of the projected mean, and radii ([`footprint_bytes`] a row).
    pub footprints: Buffer,
    /// Whether rows are weighed.
    pub weighs: bool,
}

impl RowGradients {
    /// Allocates the gradients of `rows` rows, with weights if `weighs`.
    pub fn new(gpu: &Gpu, rows: u32, sh_degree: u8, weighs: bool) -> GpuResult<Self> {
        let columns = DeviceColumns::new(gpu, rows, sh_degree)?;
        Ok(RowGradients { columns, ..RowGradients::for_update(gpu, rows, weighs)? })
    }

    /// Allocates what an update on the device reads, which makes the gradients of colours itself.
    pub fn for_update(gpu: &Gpu, rows: u32, weighs: bool) -> GpuResult<Self> {
        let columns = DeviceColumns::geometry(gpu, rows)?;
        let footprints = gpu.buffer("footprints", footprint_bytes(weighs) * u64::from(rows))?;
        Ok(RowGradients { columns, footprints, weighs })
    }
}

/// Splits `rows` rows into windows so that no binding of `row_bytes` per row exceeds the device's limit.
pub(super) fn windows(gpu: &Gpu, rows: u32, row_bytes: u64) -> impl Iterator<Item = Window> {
    let rows = u64::from(rows);
    let most = gpu.max_binding_bytes() / row_bytes;
    let step = (most / WINDOW_STEP * WINDOW_STEP).max(WINDOW_STEP);
    (0..rows.div_ceil(step)).map(move |i| Window { first: i * step, rows: (rows - i * step).min(step) as u32 })
}

/// The compiled stages on rows.
#[derive(Debug)]
pub struct RowStages {
    project_fwd: Arc<Pipeline>,
    /// With the keys of the depth sort.
    project_fwd_keys: Arc<Pipeline>,
    project_bwd: Arc<Pipeline>,
    sh_fwd: OfDegree,
    sh_bwd: ShBwd,
    /// `None` before [`RowStages::weigh_rows`].
    sh_bwd_weighing: Option<ShBwd>,
}

/// A stage for each SH degree.
pub(super) type OfDegree = [Arc<Pipeline>; 4];

/// The backward stage of colours, for gradients that the host updates with and for an update on the device.
#[derive(Debug)]
struct ShBwd {
    for_host: OfDegree,
    /// `None` before [`RowStages::update_rows`].
    for_update: Option<OfDegree>,
}

impl ShBwd {
    fn new(gpu: &Gpu, updates: bool, more: &[(&str, &str)]) -> GpuResult<ShBwd> {
        let of = |more: &[(&str, &str)]| of_degrees(gpu, "sh_bwd.wgsl", "sh_bwd", more);
        let for_update = updates.then(|| of(&[more, &[("UPDATES", "")]].concat())).transpose()?;
        Ok(ShBwd { for_host: of(more)?, for_update })
    }
}

/// Compiles a stage for each SH degree.
pub(super) fn of_degrees(gpu: &Gpu, shader: &str, entry: &str, more: &[(&str, &str)]) -> GpuResult<OfDegree> {
    let defines = [("SH_DEGREE_1", ""), ("SH_DEGREE_2", ""), ("SH_DEGREE_3", "")];
    let of = |degree: usize| gpu.pipeline(shader, entry, &[&defines[..degree], more].concat());
    Ok([of(0)?, of(1)?, of(2)?, of(3)?])
}

impl RowStages {
    /// Compiles the stages.
    pub fn new(gpu: &Gpu) -> GpuResult<Self> {
        Ok(RowStages {
            project_fwd: gpu.pipeline("project_fwd.wgsl", "project_fwd", &[])?,
            project_fwd_keys: gpu.pipeline("project_fwd.wgsl", "project_fwd", &[("KEYS", "")])?,
            project_bwd: gpu.pipeline("project_bwd.wgsl", "project_bwd", &[])?,
            sh_fwd: of_degrees(gpu, "sh_fwd.wgsl", "sh_fwd", &[])?,
            sh_bwd: ShBwd::new(gpu, false, &[])?,
            sh_bwd_weighing: None,
        })
    }

    /// Compiles what [`RowStages::sh_bwd`] needs to pass weights on.
    pub fn weigh_rows(&mut self, gpu: &Gpu) -> GpuResult<()> {
        self.sh_bwd_weighing = Some(ShBwd::new(gpu, self.sh_bwd.for_update.is_some(), &WEIGHS)?);
        Ok(())
    }

    /// Compiles what [`RowStages::sh_bwd`] needs for an update on the device.
    pub fn update_rows(&mut self, gpu: &Gpu) -> GpuResult<()> {
        self.sh_bwd = ShBwd::new(gpu, true, &[])?;
        if self.sh_bwd_weighing.is_some() {
            self.weigh_rows(gpu)?;
        }
        Ok(())
    }

    /// Records the footprints of all rows into `splats`, with colours 0, and the keys of their sort by depth into `keys`.
    pub fn project_fwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        eps2d: f32,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
        keys: Option<&Pairs>,
    ) -> GpuResult<()> {
        let stage = if keys.is_some() { &self.project_fwd_keys } else { &self.project_fwd };
        for window in windows(gpu, rows.rows, SPLAT_BYTES) {
            let (row_count, first_row) = (window.rows, window.first as u32);
            let uniform = recorder.uniform(&View { row_count, first_row, ..View::new(camera, eps2d) })?;
            let w = rows.window(window);
            let mut views = vec![uniform, w.means, w.quats, w.scales, w.opacities, splats.window(window)];
            views.extend(keys.into_iter().flat_map(|of| [&of.keys, &of.values].map(|words| window.of(words, 4))));
            recorder.dispatch("project_fwd", stage, &views, groups_1d(window.rows, WORKGROUP))?;
        }
        Ok(())
    }

    /// Records the colours of the visible rows into `splats`.
    pub fn sh_fwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
    ) -> GpuResult<()> {
        for window in windows(gpu, rows.rows, rows.widest()) {
            let uniform = recorder.uniform(&View { row_count: window.rows, ..View::new(camera, 0.0) })?;
            let w = rows.window(window);
            let mut views = vec![uniform, splats.window(window)];
            views.extend(w.sh0);
            // Band 0 does not depend on the view direction, so degree 0 needs no means.
            views.extend(w.sh_n.into_iter().flat_map(|sh_n| [w.means.clone(), sh_n]));
            recorder.dispatch(
                "sh_fwd",
                &self.sh_fwd[usize::from(rows.sh_degree)],
                &views,
                groups_1d(window.rows, WORKGROUP),
            )?;
        }
        Ok(())
    }

    /// Records the gradients of sh0 and of the bands in use, if `into` has room for them, and the colour's part of the gradients of means;
    /// what densification reads of the rows; and the largest gradient of each row. Weights need [`RowStages::weigh_rows`], and gradients
    /// without room for colours [`RowStages::update_rows`].
    pub fn sh_bwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
        v_splats: SplatRows<'_>,
        into: &RowGradients,
    ) -> GpuResult<()> {
        let stages = self.sh_bwd_weighing.as_ref().filter(|_| into.weighs).unwrap_or(&self.sh_bwd);
        let for_update = stages.for_update.as_ref().filter(|_| into.columns.sh0.is_none());
        let stages = for_update.unwrap_or(&stages.for_host);
        for window in windows(gpu, rows.rows, rows.widest()) {
            let uniform = recorder.uniform(&View { row_count: window.rows, ..View::new(camera, 0.0) })?;
            let (w, v) = (rows.window(window), into.columns.window(window));
            let footprints = window.of(&into.footprints, footprint_bytes(into.weighs));
            let mut views = vec![uniform, splats.window(window), v_splats.window(window), footprints, v.means];
            views.extend(w.sh_n.into_iter().flat_map(|sh_n| [w.means.clone(), sh_n]));
            views.extend(v.sh0.into_iter().chain(v.sh_n));
            recorder.dispatch(
                "sh_bwd",
                &stages[usize::from(rows.sh_degree)],
                &views,
                groups_1d(window.rows, WORKGROUP),
            )?;
        }
        Ok(())
    }

    /// Records the gradients of quats, scales and opacities, after [`RowStages::sh_bwd`]: adds the projection's part to the gradients
    /// of means, and raises the largest gradients.
    pub fn project_bwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        eps2d: f32,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
        v_splats: SplatRows<'_>,
        into: &RowGradients,
    ) -> GpuResult<()> {
        for window in windows(gpu, rows.rows, SPLAT_BYTES) {
            let uniform = recorder.uniform(&View { row_count: window.rows, ..View::new(camera, eps2d) })?;
            let (w, v) = (rows.window(window), into.columns.window(window));
            let (splats, v_splats) = (splats.window(window), v_splats.window(window));
            let rows = [uniform, w.means, w.quats, w.scales, w.opacities, splats, v_splats];
            let views: Vec<_> = rows.into_iter().chain([v.means, v.quats, v.scales, v.opacities]).collect();
            recorder.dispatch("project_bwd", &self.project_bwd, &views, groups_1d(window.rows, WORKGROUP))?;
        }
        Ok(())
    }
}
