//! The splats of a view on a device, in segments, and the row stages of the way in, in chunks.
//!
//! A segment is a buffer of splats: as many rows of a batch as one binding holds. A chunk is a part of a segment whose columns
//! lie on the device at one time: as many rows as device memory holds beside the splats. The columns of a chunk make room for
//! the next chunk; the splats stay.
//!
//! Not here: the stages (`gpu_rows`), the way out (`gpu_gradients`), ranges of tiles (`gpu_ranges`).
//!
//! Invariant: splats have the same bits for any cut of the rows into batches, segments and chunks.

use super::gpu_frame::splat_bytes;
use super::gpu_rows::{DeviceColumns, RowSource, RowStages, SPLAT_BYTES, SplatRows, WINDOW_STEP};
use super::sequence::ViewOptions;
use crate::gpu::{Buffer, Gpu, GpuError, GpuResult};
use std::ops::Range;

/// Rows of the smallest chunk, and the multiple at which a chunk begins.
pub(super) const CHUNK_STEP: usize = WINDOW_STEP as usize;

/// Splats of consecutive rows of one batch.
#[derive(Debug)]
pub(super) struct Segment {
    /// The number, in the view, of the first row.
    pub first: usize,
    pub rows: u32,
    /// `[rows]` records of `shaders/shared/splat.wgsl`.
    pub splats: Buffer,
    /// The gradients of the splats, in the backward pass.
    pub v_splats: Option<Buffer>,
}

/// Runs `stage` on consecutive parts of `rows`: on all rows if device memory allows, else on half as many, and so on.
/// Errors: as `stage`, on the smallest part.
pub(super) fn in_chunks(rows: usize, mut stage: impl FnMut(Range<usize>) -> GpuResult<()>) -> GpuResult<()> {
    let (mut first, mut chunk) = (0, rows);
    while first < rows {
        let part = first..rows.min(first + chunk);
        match stage(part.clone()) {
            Ok(()) => first = part.end,
            Err(error) if error.is_out_of_memory() && chunk > CHUNK_STEP => {
                chunk = (chunk / 2).next_multiple_of(CHUNK_STEP);
            }
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Submits gathering, projection and colours of the rows of a batch, which begins at row `first` of the view. Does not wait.
pub(super) fn submit_rows(
    gpu: &Gpu,
    stages: &RowStages,
    rows: &mut dyn RowSource,
    first: usize,
    view: &ViewOptions,
) -> GpuResult<Vec<Segment>> {
    let most = ((gpu.max_binding_bytes() / SPLAT_BYTES) as usize / CHUNK_STEP * CHUNK_STEP).max(CHUNK_STEP);
    let mut segments = Vec::new();
    for begin in (0..rows.rows()).step_by(most) {
        // Row numbers fit 32 bits: `Sequence::rows_in` has checked the count.
        let count = (rows.rows() - begin).min(most) as u32;
        let splats = gpu.buffer("splats", splat_bytes(count))?;
        in_chunks(count as usize, |part| {
            let rows_of_part = begin + part.start..begin + part.end;
            let splats = SplatRows::from_row(&splats, part.start as u64);
            submit_chunk(gpu, stages, rows, &rows_of_part, view, splats)
        })?;
        segments.push(Segment { first: first + begin, rows: count, splats, v_splats: None });
    }
    Ok(segments)
}

/// Submits the stages on the rows `part` of a batch.
fn submit_chunk(
    gpu: &Gpu,
    stages: &RowStages,
    rows: &mut dyn RowSource,
    part: &Range<usize>,
    ViewOptions { camera, options }: &ViewOptions,
    splats: SplatRows<'_>,
) -> GpuResult<()> {
    let columns = DeviceColumns::new(gpu, part.len() as u32, options.sh_degree)?;
    let mut recorder = gpu.begin("forward");
    rows.geometry(gpu, &mut recorder, &columns, part)?;
    stages.project_fwd(gpu, &mut recorder, camera, options.eps2d, &columns, splats, None)?;
    rows.colors(&mut recorder, &columns, part)?;
    stages.sh_fwd(gpu, &mut recorder, camera, &columns, splats)?;
    gpu.submit(recorder).map(|_| ())
}

pub(super) fn zero_gradients(gpu: &Gpu, segments: &mut [Segment]) -> GpuResult<()> {
    let mut recorder = gpu.begin("backward");
    for segment in segments {
        segment.v_splats = None;
        segment.v_splats = Some(recorder.buffer_zeroed("v_splats", splat_bytes(segment.rows))?);
    }
    gpu.submit(recorder).map(|_| ())
}

pub(super) fn gradients_of(segment: &Segment) -> GpuResult<&Buffer> {
    segment.v_splats.as_ref().ok_or_else(|| GpuError::Bindings {
        stage: "backward".into(),
        problem: "the splats have no gradients yet".into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_halve_until_they_fit_and_cover_every_row_once() {
        let full = || GpuError::DeviceFull { what: "test".into(), need: 1, in_use: 0 };
        for (rows, fits) in [(0, 64), (1, 64), (64, 64), (1000, 64), (1000, 300), (1000, 2000)] {
            let mut covered = Vec::new();
            let done = in_chunks(rows, |part| {
                assert!(part.start.is_multiple_of(CHUNK_STEP));
                if part.len() > fits {
                    return Err(full());
                }
                covered.extend(part);
                Ok(())
            });
            assert_eq!(done, Ok(()));
            assert!(covered.into_iter().eq(0..rows), "{rows} rows, {fits} fit");
        }
        assert_eq!(in_chunks(1000, |part| if part.len() > 63 { Err(full()) } else { Ok(()) }), Err(full()));
    }
}
