//! Row batches on a device: the splats of a view that arrive in parts, and the parts of the splats that leave again.
//!
//! A batch is projected and coloured as soon as its rows arrive. Its splats stay on the device, its rows do not. Once the last
//! batch is in, the splats of all batches are copied into one buffer, in order. On the way back the splats and the gradients
//! of a batch are copied out of the buffers of the view, because a binding must start at a multiple of 256 bytes and a batch
//! starts at any row.
//!
//! Not here: the stages (`gpu_rows`), and the view (`gpu`).
//!
//! Invariant: splats have the same bits for any cut of the rows into batches.

use super::gpu_rows::{DeviceColumns, RowStages, SPLAT_BYTES};
use super::gpu_tiles::splat_bytes;
use super::sequence::ViewOptions;
use crate::gpu::{Buffer, Gpu, GpuResult, Recorder};
use crate::scene::columns::Columns;
use std::ops::Range;

/// The splats of one batch.
#[derive(Debug)]
pub(super) struct SplatBatch {
    rows: u32,
    splats: Buffer,
}

/// Uploads the columns of a batch that the stages read.
///
/// # Errors
/// The device failed, or has no memory for the columns.
pub(super) fn upload(
    gpu: &Gpu,
    recorder: &mut Recorder<'_>,
    rows: &Columns,
    sh_degree: u8,
    scratch: &mut Vec<f32>,
) -> GpuResult<DeviceColumns> {
    let columns = DeviceColumns::new(gpu, rows.rows() as u32, sh_degree)?;
    columns.upload_geometry(recorder, rows)?;
    columns.upload_colors(recorder, rows, scratch)?;
    Ok(columns)
}

/// Submits upload, projection and colours of one batch. The device memory of the rows is free once the device is done. Does
/// not wait.
///
/// # Errors
/// As [`upload`].
pub(super) fn submit_batch(
    gpu: &Gpu,
    stages: &RowStages,
    rows: &Columns,
    ViewOptions { camera, options }: &ViewOptions,
    scratch: &mut Vec<f32>,
) -> GpuResult<SplatBatch> {
    let count = rows.rows() as u32;
    let splats = gpu.buffer("splats", splat_bytes(count))?;
    let mut recorder = gpu.begin("forward");
    let columns = upload(gpu, &mut recorder, rows, options.sh_degree, scratch)?;
    stages.project_fwd(gpu, &mut recorder, camera, options.eps2d, &columns, &splats)?;
    stages.sh_fwd(gpu, &mut recorder, camera, options.sh_degree, &columns, &splats)?;
    gpu.submit(recorder)?;
    Ok(SplatBatch { rows: count, splats })
}

/// Records the copy of the splats of all batches into one buffer. Returns the buffer and its rows.
///
/// # Errors
/// The device has no memory for the buffer.
pub(super) fn concatenate(gpu: &Gpu, recorder: &mut Recorder<'_>, batches: &[SplatBatch]) -> GpuResult<(Buffer, u32)> {
    let rows = batches.iter().map(|batch| batch.rows).sum();
    let splats = gpu.buffer("splats", splat_bytes(rows))?;
    let mut first = 0;
    for batch in batches.iter().filter(|batch| batch.rows > 0) {
        let bytes = splat_bytes(batch.rows);
        recorder.copy(&batch.splats.slice(0, bytes), &splats.slice(first, bytes))?;
        first += bytes;
    }
    Ok((splats, rows))
}

/// Records the copy of the rows `place` of `all` into a buffer of their own.
///
/// # Errors
/// The device has no memory for the buffer.
pub(super) fn copy_rows(
    gpu: &Gpu,
    recorder: &mut Recorder<'_>,
    label: &'static str,
    all: &Buffer,
    place: &Range<usize>,
) -> GpuResult<Buffer> {
    let bytes = SPLAT_BYTES * place.len() as u64;
    let part = gpu.buffer(label, bytes)?;
    if bytes > 0 {
        recorder.copy(&all.slice(SPLAT_BYTES * place.start as u64, bytes), &part.slice(0, bytes))?;
    }
    Ok(part)
}
