//! Records the stages on rows on a device: project_fwd, sh_fwd, sh_bwd, project_bwd. Owns the device columns.
//!
//! Not here: the choice of rows, the tile stages, the order of a step.
//!
//! Invariants: 1. no binding exceeds the device's limit: longer columns are bound in windows of rows, and because rows
//! are independent the result has the same bits; 2. each SH band above 0 is a buffer of its own.

use crate::gpu::{Buffer, BufferView, Gpu, GpuResult, Pipeline, Recorder, groups_1d};
use crate::kernels::uniforms::RowsUniforms;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;

/// Bytes per row of `splats` and `v_splats`: see `shaders/shared/splat.wgsl`.
pub const SPLAT_BYTES: u64 = 48;
/// Bytes per row of the densification input from `project_bwd`: gradient with respect to the projected mean, and radii; if
/// `weighs`, also weight, weight times error, and two unused words.
pub fn footprint_bytes(weighs: bool) -> u64 {
    if weighs { 32 } else { 16 }
}
/// The define of the shaders that weigh rows.
pub(super) const WEIGHS: [(&str, &str); 1] = [("WEIGHS", "")];
/// Floats per row of the SH bands 1, 2 and 3.
pub const BAND_WIDTHS: [usize; 3] = [9, 15, 21];
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
    /// `[rows][3]`.
    pub sh0: Buffer,
    /// `[rows][2 l + 1][3]` for each band l in use, from l = 1.
    pub bands: Vec<Buffer>,
}

impl DeviceColumns {
    /// Allocates `rows` rows with the bands 1 to `sh_degree`, uninitialised.
    pub fn new(gpu: &Gpu, rows: u32, sh_degree: u8) -> GpuResult<Self> {
        let column = |label, width: usize| gpu.buffer(label, 4 * width as u64 * u64::from(rows));
        let band_labels = ["sh1", "sh2", "sh3"];
        Ok(DeviceColumns {
            rows,
            means: column("means", 3)?,
            quats: column("quats", 4)?,
            scales: column("scales", 3)?,
            opacities: column("opacities", 1)?,
            sh0: column("sh0", 3)?,
            bands: (0..usize::from(sh_degree.min(3)))
                .map(|band| column(band_labels[band], BAND_WIDTHS[band]))
                .collect::<GpuResult<_>>()?,
        })
    }

    /// Bytes per row over all columns, with the bands 1 to `sh_degree`.
    pub fn row_bytes(sh_degree: u8) -> u64 {
        4 * (14 + BAND_WIDTHS[..usize::from(sh_degree.min(3))].iter().sum::<usize>()) as u64
    }

    /// Each column with its floats per row; bands last.
    pub fn columns(&self) -> impl Iterator<Item = (&Buffer, usize)> {
        let narrow = [(&self.means, 3), (&self.quats, 4), (&self.scales, 3), (&self.opacities, 1), (&self.sh0, 3)];
        narrow.into_iter().chain(self.bands.iter().zip(BAND_WIDTHS))
    }

    /// Uploads means, quats, scales and opacities of the rows `part`, which are `self.rows` rows.
    pub fn upload_geometry(&self, recorder: &mut Recorder<'_>, rows: &Columns, part: &Range<usize>) -> GpuResult<()> {
        recorder.upload(&self.means.view(), &rows.means[3 * part.start..3 * part.end])?;
        recorder.upload(&self.quats.view(), &rows.quats[4 * part.start..4 * part.end])?;
        recorder.upload(&self.scales.view(), &rows.scales[3 * part.start..3 * part.end])?;
        recorder.upload(&self.opacities.view(), &rows.opacities[part.clone()])
    }

    /// Uploads the colours of the rows `part`, which are `self.rows` rows with at least the bands in use. `scratch` holds one
    /// band at a time.
    pub fn upload_colors(
        &self,
        recorder: &mut Recorder<'_>,
        rows: &Columns,
        part: &Range<usize>,
        scratch: &mut Vec<f32>,
    ) -> GpuResult<()> {
        recorder.upload(&self.sh0.view(), &rows.sh0[3 * part.start..3 * part.end])?;
        for (band, buffer) in self.bands.iter().enumerate() {
            band_from_sh_n(rows, part, band, scratch);
            recorder.upload(&buffer.view(), scratch)?;
        }
        Ok(())
    }

    /// The part of each column inside `window`.
    fn window(&self, window: Window) -> WindowViews {
        let view = |buffer: &Buffer, width: usize| window.of(buffer, 4 * width as u64);
        WindowViews {
            means: view(&self.means, 3),
            quats: view(&self.quats, 4),
            scales: view(&self.scales, 3),
            opacities: view(&self.opacities, 1),
            sh0: view(&self.sh0, 3),
            bands: self.bands.iter().zip(BAND_WIDTHS).map(|(buffer, width)| view(buffer, width)).collect(),
        }
    }
}

/// Copies one band (index 0 is l = 1) of the rows `part` from `sh_n` to `out`, `[rows][2 l + 1][3]`, on all threads.
pub fn band_from_sh_n(rows: &Columns, part: &Range<usize>, band: usize, out: &mut Vec<f32>) {
    let row_width = rows.sh_n.len() / rows.rows().max(1);
    let (first, width) = (BAND_WIDTHS[..band].iter().sum::<usize>(), BAND_WIDTHS[band]);
    out.resize(if row_width == 0 { 0 } else { width * part.len() }, 0.0);
    let rows = rows.sh_n[row_width * part.start..row_width * part.end].par_chunks_exact(row_width.max(1));
    let pairs = out.par_chunks_exact_mut(width).zip(rows).with_min_len(ROWS_OF_THREAD);
    pairs.for_each(|(out, row)| out.copy_from_slice(&row[first..first + width]));
}

/// Copies one band of the rows `part` from `values` back into `sh_n`, on all threads.
pub fn band_into_sh_n(values: &[f32], part: &Range<usize>, band: usize, rows: &mut Columns) {
    let row_width = rows.sh_n.len() / rows.rows().max(1);
    let (first, width) = (BAND_WIDTHS[..band].iter().sum::<usize>(), BAND_WIDTHS[band]);
    let rows = rows.sh_n[row_width * part.start..row_width * part.end].par_chunks_exact_mut(row_width.max(1));
    let pairs = rows.zip(values.par_chunks_exact(width)).with_min_len(ROWS_OF_THREAD);
    pairs.for_each(|(row, values)| row[first..first + width].copy_from_slice(values));
}

/// Where the columns of the rows of a batch come from.
pub trait RowSource {
    /// Rows of the batch.
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

/// Rows that the host gives.
pub(super) struct HostRows<'a> {
    /// The rows of the batch.
    pub rows: &'a Columns,
    /// Memory for one SH band.
    pub band: &'a mut Vec<f32>,
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
        columns.upload_colors(recorder, self.rows, part, self.band)
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

    fn window(&self, window: Window) -> BufferView {
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

struct WindowViews {
    means: BufferView,
    quats: BufferView,
    scales: BufferView,
    opacities: BufferView,
    sh0: BufferView,
    bands: Vec<BufferView>,
}

/// Splits `rows` rows into windows so that no binding of `row_bytes` per row exceeds the device's limit.
pub(super) fn windows(gpu: &Gpu, rows: u32, row_bytes: u64) -> impl Iterator<Item = Window> {
    let rows = u64::from(rows);
    let most = (gpu.max_binding_bytes() / row_bytes).min(gpu.window_rows());
    let step = (most / WINDOW_STEP * WINDOW_STEP).max(WINDOW_STEP);
    (0..rows.div_ceil(step)).map(move |i| Window { first: i * step, rows: (rows - i * step).min(step) as u32 })
}

/// The compiled stages on rows.
#[derive(Debug)]
pub struct RowStages {
    project_fwd: Arc<Pipeline>,
    project_bwd: Arc<Pipeline>,
    /// `None` before [`RowStages::weigh_rows`].
    project_bwd_weighing: Option<Arc<Pipeline>>,
    /// Indexed by SH degree.
    sh_fwd: [Arc<Pipeline>; 4],
    sh_bwd: [Arc<Pipeline>; 4],
}

impl RowStages {
    /// Compiles the stages.
    pub fn new(gpu: &Gpu) -> GpuResult<Self> {
        let defines = [("SH_DEGREE_1", ""), ("SH_DEGREE_2", ""), ("SH_DEGREE_3", "")];
        let sh = |shader: &str, entry: &str, degree: usize| gpu.pipeline(shader, entry, &defines[..degree]);
        let all = |shader: &str, entry: &str| -> GpuResult<[Arc<Pipeline>; 4]> {
            Ok([sh(shader, entry, 0)?, sh(shader, entry, 1)?, sh(shader, entry, 2)?, sh(shader, entry, 3)?])
        };
        Ok(RowStages {
            project_fwd: gpu.pipeline("project_fwd.wgsl", "project_fwd", &[])?,
            project_bwd: gpu.pipeline("project_bwd.wgsl", "project_bwd", &[])?,
            project_bwd_weighing: None,
            sh_fwd: all("sh_fwd.wgsl", "sh_fwd")?,
            sh_bwd: all("sh_bwd.wgsl", "sh_bwd")?,
        })
    }

    /// Compiles what [`RowStages::project_bwd`] needs to pass weights on.
    pub fn weigh_rows(&mut self, gpu: &Gpu) -> GpuResult<()> {
        self.project_bwd_weighing = Some(gpu.pipeline("project_bwd.wgsl", "project_bwd", &WEIGHS)?);
        Ok(())
    }

    /// Records the footprints of all rows into `splats`, with colours 0.
    pub fn project_fwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        eps2d: f32,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
    ) -> GpuResult<()> {
        for window in windows(gpu, rows.rows, SPLAT_BYTES) {
            let uniform = recorder.uniform(&RowsUniforms::new(camera, eps2d, window.rows))?;
            let w = rows.window(window);
            let views = [uniform, w.means, w.quats, w.scales, w.opacities, splats.window(window)];
            recorder.dispatch("project_fwd", &self.project_fwd, &views, groups_1d(window.rows, WORKGROUP))?;
        }
        Ok(())
    }

    /// Records the colours of the visible rows into `splats`, from the bands up to `sh_degree`.
    pub fn sh_fwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        sh_degree: u8,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
    ) -> GpuResult<()> {
        let degree = usize::from(sh_degree);
        for window in windows(gpu, rows.rows, widest_row(degree)) {
            let uniform = recorder.uniform(&RowsUniforms::new(camera, 0.0, window.rows))?;
            let w = rows.window(window);
            let mut views = vec![uniform, splats.window(window), w.sh0];
            // Band 0 does not depend on the view direction, so degree 0 needs no means.
            views.extend((degree > 0).then_some(w.means));
            views.extend(w.bands.into_iter().take(degree));
            recorder.dispatch("sh_fwd", &self.sh_fwd[degree], &views, groups_1d(window.rows, WORKGROUP))?;
        }
        Ok(())
    }

    /// Records the gradients of sh0, of the bands up to `sh_degree`, and the colour's part of the gradients of means.
    pub fn sh_bwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        sh_degree: u8,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
        v_splats: SplatRows<'_>,
        grads: &DeviceColumns,
    ) -> GpuResult<()> {
        let degree = usize::from(sh_degree);
        for window in windows(gpu, rows.rows, widest_row(degree)) {
            let uniform = recorder.uniform(&RowsUniforms::new(camera, 0.0, window.rows))?;
            let (w, v) = (rows.window(window), grads.window(window));
            let splats = [splats.window(window), v_splats.window(window)];
            let mut views = vec![uniform];
            views.extend(splats.into_iter().chain([v.means, v.sh0]));
            views.extend((degree > 0).then_some(w.means));
            views.extend(w.bands.into_iter().zip(v.bands).take(degree).flat_map(|(band, v_band)| [band, v_band]));
            recorder.dispatch("sh_bwd", &self.sh_bwd[degree], &views, groups_1d(window.rows, WORKGROUP))?;
        }
        Ok(())
    }

    /// Records the gradients of quats, scales and opacities, adds the projection's part to the gradients of means, and
    /// records `footprints` ([`footprint_bytes`] per row), with weights if `weighs`, which needs
    /// [`RowStages::weigh_rows`].
    pub fn project_bwd(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        camera: &Camera,
        eps2d: f32,
        rows: &DeviceColumns,
        splats: SplatRows<'_>,
        v_splats: SplatRows<'_>,
        grads: &DeviceColumns,
        footprints: &Buffer,
        weighs: bool,
    ) -> GpuResult<()> {
        let pipeline = self.project_bwd_weighing.as_ref().filter(|_| weighs).unwrap_or(&self.project_bwd);
        for window in windows(gpu, rows.rows, SPLAT_BYTES) {
            let uniform = recorder.uniform(&RowsUniforms::new(camera, eps2d, window.rows))?;
            let (w, v) = (rows.window(window), grads.window(window));
            let views = [
                uniform,
                w.means,
                w.quats,
                w.scales,
                w.opacities,
                splats.window(window),
                v_splats.window(window),
                v.means,
                v.quats,
                v.scales,
                v.opacities,
                window.of(footprints, footprint_bytes(weighs)),
            ];
            recorder.dispatch("project_bwd", pipeline, &views, groups_1d(window.rows, WORKGROUP))?;
        }
        Ok(())
    }
}

/// Bytes per row of the widest binding of the colour stages.
fn widest_row(degree: usize) -> u64 {
    BAND_WIDTHS[..degree].iter().map(|w| 4 * *w as u64).fold(SPLAT_BYTES, u64::max)
}
