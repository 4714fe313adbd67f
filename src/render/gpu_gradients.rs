//! The way out on a device: gradients of splats to gradients of rows, and their copy to the host.
//!
//! Rows whose columns stayed on the device leave at once. Other rows are uploaded again and leave in chunks, as many rows at a
//! time as device memory holds.
//!
//! Not here: the stages (`gpu_rows`), the way in (`gpu_segments`).
//!
//! Invariant: gradients have the same bits for any cut of the rows into batches, segments and chunks.

use super::Gradients;
use super::gpu_rows::{DeviceColumns, ROWS_OF_THREAD, RowGradients, RowStages, SplatRows, footprint_bytes, put_bands};
use super::gpu_segments::{CHUNK_STEP, Segment, gradients_of, in_chunks};
use super::sequence::ViewOptions;
use crate::base::room;
use crate::gpu::{Buffer, Gpu, GpuResult, Readback, Recorder};
use crate::scene::columns::{Columns, sh_n_width};
use rayon::prelude::*;
use std::ops::Range;

/// Densification input of one row: gradient with respect to the projected mean (2), radii (2). In a view that weighs rows, a
/// second one follows: weight, weight times error, unused (2).
type Footprint = [f32; 4];

/// Host memory that is reused between views.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// The SH bands in use of rows that have more.
    pub bands: Vec<f32>,
    footprints: Vec<Footprint>,
}

impl Scratch {
    /// Host memory, bytes.
    pub fn bytes(&self) -> u64 {
        (4 * self.bands.capacity() + size_of::<Footprint>() * self.footprints.capacity()) as u64
    }
}

/// Device memory of a row of a chunk, bytes: its columns, their gradients and footprint with weights, and the read-back of
/// both.
pub(super) fn chunk_row_bytes(sh_degree: u8) -> u64 {
    3 * DeviceColumns::row_bytes(sh_degree) + 2 * footprint_bytes(true)
}

/// Checks that the smallest chunk has room, so that a pass out that has begun does not end for want of it.
pub(super) fn check_room(gpu: &Gpu, sh_degree: u8) -> GpuResult<()> {
    let columns = DeviceColumns::new(gpu, CHUNK_STEP as u32, sh_degree)?;
    RowGradients::new(gpu, columns.rows, sh_degree, true).map(|_| ())
}

/// The stages and options of a way out.
pub(super) struct RowsOut<'a> {
    pub gpu: &'a Gpu,
    pub stages: &'a RowStages,
    pub view: &'a ViewOptions,
    /// Whether rows are weighed.
    pub weighs: bool,
}

/// Pending readbacks of the gradients of rows.
struct Readbacks {
    sh0: Option<Readback>,
    sh_n: Option<Readback>,
    footprints: Readback,
    /// means, quats, scales, opacities.
    geometry: [Readback; 4],
}

impl RowsOut<'_> {
    /// Prepares `grads` for a batch of `rows` rows of the stored degree `sh_degree`.
    pub fn prepare(&self, rows: usize, sh_degree: u8, grads: &mut Gradients) {
        grads.columns.sh_degree = sh_degree;
        grads.columns.resize(rows);
        if self.view.options.sh_degree < sh_degree {
            grads.columns.sh_n.fill(0.0); // the unused bands stay zero
        }
        room::resize(&mut grads.radii, rows, [0; 2]);
        room::resize(&mut grads.means2d, rows, [0.0; 2]);
        room::resize(&mut grads.weights, if self.weighs { rows } else { 0 }, [0.0; 2]);
    }

    /// Submits the stages on rows whose columns are on the device, behind the work of `recorder`, and copies the gradients to
    /// `grads`, which is prepared.
    pub fn whole(
        &self,
        recorder: Recorder<'_>,
        columns: &DeviceColumns,
        room: &RowGradients,
        segment: &Segment,
        grads: &mut Gradients,
        scratch: &mut Scratch,
    ) -> GpuResult<()> {
        let splats = [SplatRows::from(&segment.splats), SplatRows::from(gradients_of(segment)?)];
        let readbacks = self.submit(recorder, columns, splats, room)?;
        self.read(readbacks, &(0..columns.rows as usize), grads, scratch)
    }

    /// Uploads the rows of a batch again, which begins at row `first` of the view, runs the stages on them in chunks, and copies
    /// the gradients to `grads`, which is prepared. `segments` are those of the batch.
    pub fn in_chunks<'s>(
        &self,
        rows: &Columns,
        first: usize,
        segments: impl Iterator<Item = &'s Segment>,
        grads: &mut Gradients,
        scratch: &mut Scratch,
    ) -> GpuResult<()> {
        for segment in segments {
            let begin = segment.first - first;
            in_chunks(segment.rows as usize, |part| self.chunk(rows, segment, begin, part, grads, scratch))?;
        }
        Ok(())
    }

    /// The rows `part` of a segment, which begins at row `begin` of the batch.
    fn chunk(
        &self,
        rows: &Columns,
        segment: &Segment,
        begin: usize,
        part: Range<usize>,
        grads: &mut Gradients,
        scratch: &mut Scratch,
    ) -> GpuResult<()> {
        let sh_degree = self.view.options.sh_degree;
        let columns = DeviceColumns::new(self.gpu, part.len() as u32, sh_degree)?;
        let room = RowGradients::new(self.gpu, columns.rows, sh_degree, self.weighs)?;
        let of_batch = begin + part.start..begin + part.end;
        let mut recorder = self.gpu.begin("backward");
        columns.upload_geometry(&mut recorder, rows, &of_batch)?;
        columns.upload_colors(&mut recorder, rows, &of_batch, &mut scratch.bands)?;
        let splats =
            [&segment.splats, gradients_of(segment)?].map(|buffer| SplatRows::from_row(buffer, part.start as u64));
        let readbacks = self.submit(recorder, &columns, splats, &room)?;
        self.read(readbacks, &of_batch, grads, scratch)
    }

    /// Records the gradients of rows whose columns are on the device, for an update there.
    pub fn record(
        &self,
        recorder: &mut Recorder<'_>,
        columns: &DeviceColumns,
        [splats, v_splats]: [SplatRows<'_>; 2],
        room: &RowGradients,
    ) -> GpuResult<()> {
        let (gpu, stages, ViewOptions { camera, options }) = (self.gpu, self.stages, self.view);
        stages.sh_bwd(gpu, recorder, camera, columns, splats, v_splats, room)?;
        stages.project_bwd(gpu, recorder, camera, options.eps2d, columns, splats, v_splats, room)
    }

    /// Submits the stages on rows and the readbacks of the gradients. Does not wait. The work that `recorder` brings along is
    /// submitted even if the readbacks lack memory.
    fn submit(
        &self,
        mut recorder: Recorder<'_>,
        columns: &DeviceColumns,
        [splats, v_splats]: [SplatRows<'_>; 2],
        room: &RowGradients,
    ) -> GpuResult<Readbacks> {
        let (gpu, ViewOptions { camera, options }) = (self.gpu, self.view);
        let grads = &room.columns;
        let colors = self.stages.sh_bwd(gpu, &mut recorder, camera, columns, splats, v_splats, room).and_then(|()| {
            let mut read = |buffer: &Buffer| recorder.read_back("sh_bwd", &buffer.view());
            let sh0 = grads.sh0.as_ref().map(&mut read).transpose()?;
            Ok((sh0, grads.sh_n.as_ref().map(&mut read).transpose()?, read(&room.footprints)?))
        });
        gpu.submit(recorder)?;
        let (sh0, sh_n, footprints) = colors?;
        // The host copies the gradients of colours, four fifths of a row, while the device runs `project_bwd`.
        let mut recorder = gpu.begin("backward");
        self.stages.project_bwd(gpu, &mut recorder, camera, options.eps2d, columns, splats, v_splats, room)?;
        let mut read = |buffer: &Buffer| recorder.read_back("project_bwd", &buffer.view());
        let geometry = [read(&grads.means)?, read(&grads.quats)?, read(&grads.scales)?, read(&grads.opacities)?];
        gpu.submit(recorder)?;
        Ok(Readbacks { sh0, sh_n, footprints, geometry })
    }

    /// Waits for the gradients and copies them to the rows `part` of `grads`.
    fn read(
        &self,
        readbacks: Readbacks,
        part: &Range<usize>,
        grads: &mut Gradients,
        Scratch { bands, footprints }: &mut Scratch,
    ) -> GpuResult<()> {
        let out = &mut grads.columns;
        if let Some(bytes) = readbacks.sh0 {
            bytes.copy_to(&mut out.sh0[3 * part.start..3 * part.end])?;
        }
        if let Some(bytes) = readbacks.sh_n {
            let (width, row_width) = (sh_n_width(self.view.options.sh_degree), sh_n_width(out.sh_degree));
            let of_part = &mut out.sh_n[row_width * part.start..row_width * part.end];
            if width == row_width {
                bytes.copy_to(of_part)?;
            } else {
                room::resize(bands, width * part.len(), 0.0);
                bytes.copy_to(bands)?;
                put_bands(bands, width, of_part, row_width);
            }
        }
        let geometry = [(&mut out.means, 3), (&mut out.quats, 4), (&mut out.scales, 3), (&mut out.opacities, 1)];
        for ((to, width), bytes) in geometry.into_iter().zip(readbacks.geometry) {
            bytes.copy_to(&mut to[width * part.start..width * part.end])?;
        }
        let of_row = if self.weighs { 2 } else { 1 };
        room::resize(footprints, of_row * part.len(), [0.0; 4]);
        readbacks.footprints.copy_to(footprints)?;
        let rows = grads.means2d[part.clone()].par_iter_mut().zip(&mut grads.radii[part.clone()]);
        let rows = rows.zip(footprints.par_chunks_exact(of_row)).with_min_len(ROWS_OF_THREAD);
        rows.for_each(|((mean2d, radii), of)| {
            let f = of[0];
            (*mean2d, *radii) = ([f[0], f[1]], [f[2] as u32, f[3] as u32]);
        });
        if self.weighs {
            let weights = grads.weights[part.clone()].par_iter_mut().zip(footprints.par_chunks_exact(2));
            weights.with_min_len(ROWS_OF_THREAD).for_each(|(weights, of)| *weights = [of[1][0], of[1][1]]);
        }
        Ok(())
    }
}
