//! Read-back of results: copies into staging memory that is mapped when the device has finished. Staging buffers come from the
//! pool and are charged to its budget.
//!
//! Invariants: (1) a read-back returns the bytes as of its place in the recording, or, on a device that counts its submissions
//! ([`super::submission_count`]), the loss of the device; (2) reading before the recorder was submitted is an error, never an endless wait.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::belt::COPY_PART;
use super::buffers::{Buffer, BufferView, Pool, Purpose};
use super::driver::Driver;
use super::error::{GpuError, GpuResult};
use super::submission_count::BEHIND;
use super::submitter::{MapState, Mapping, SharedState, Ticket};
use crate::base::trace;
use rayon::prelude::*;

/// The source of staging buffers, and the number of bytes read.
#[derive(Debug)]
pub(super) struct Staging {
    driver: Arc<Driver>,
    pool: Arc<Pool>,
    read: AtomicU64,
}

impl Staging {
    pub(super) fn new(driver: Arc<Driver>, pool: Arc<Pool>) -> Arc<Staging> {
        Arc::new(Staging { driver, pool, read: AtomicU64::new(0) })
    }

    /// Records the copy of `view` for `stage`, in a recording that `ticket` submits. `count` is the count of finished submissions, and what
    /// it must be by then.
    pub(super) fn record(
        self: &Arc<Self>,
        encoder: &mut wgpu::CommandEncoder,
        stage: &'static str,
        view: &BufferView,
        ticket: &Ticket,
        count: Option<(BufferView, u32)>,
    ) -> GpuResult<(Readback, Mapping)> {
        let size = view.size;
        let with_count = size + if count.is_some() { COUNT_BYTES } else { 0 };
        let mut to = self.pool.take("read-back staging", with_count, Purpose::ReadBack)?;
        // At the end of the memory, where no read-back of another length has left other bytes.
        let mapped = if count.is_some() { to.raw().size() } else { size };
        to.set_reusable(false); // until the host has read and unmapped it
        encoder.copy_buffer_to_buffer(&view.raw, view.offset, to.raw(), 0, size);
        let expected = count.map(|(count, expected)| {
            encoder.copy_buffer_to_buffer(&count.raw, count.offset, to.raw(), mapped - COUNT_BYTES, COUNT_BYTES);
            expected
        });
        self.read.fetch_add(size, Ordering::Relaxed);
        let state = SharedState::new(MapState::Recorded);
        let mapping = Mapping::new(to.raw(), wgpu::MapMode::Read, mapped, &state);
        let ticket = ticket.clone();
        Ok((Readback { buffer: to, size, mapped, expected, stage, state, ticket, staging: Arc::clone(self) }, mapping))
    }

    pub(super) fn bytes_read(&self) -> u64 {
        self.read.load(Ordering::Relaxed)
    }
}

/// Bytes of a count of submissions, the last ones of a read-back's memory.
const COUNT_BYTES: u64 = 4;

/// Copies mapped bytes to host memory of the same length.
fn empty(mapped: &[u8], out: &mut [u8]) {
    match out.len() {
        0..=COPY_PART => out.copy_from_slice(mapped),
        _ => {
            let parts = out.par_chunks_mut(COPY_PART).zip(mapped.par_chunks(COPY_PART));
            parts.for_each(|(out, mapped)| out.copy_from_slice(mapped));
        }
    }
}

/// A read-back in flight.
#[derive(Debug)]
#[must_use]
pub struct Readback {
    buffer: Buffer,
    /// Bytes of the results.
    size: u64,
    /// Bytes that are mapped.
    mapped: u64,
    /// The count of finished submissions that must be the last of them.
    expected: Option<u32>,
    stage: &'static str,
    state: SharedState,
    ticket: Ticket,
    staging: Arc<Staging>,
}

impl Readback {
    /// Waits, then returns the elements.
    /// Errors: the recorder was not submitted, the device was lost, or its work failed.
    pub fn to_vec<T: bytemuck::Pod>(self) -> GpuResult<Vec<T>> {
        let mut out = vec![T::zeroed(); usize::try_from(self.size).unwrap_or(0) / size_of::<T>().max(1)];
        self.copy_to(&mut out)?;
        Ok(out)
    }

    /// Waits, then copies all elements to the front of `out`.
    /// Errors: the recorder was not submitted, the device was lost, or its work failed.
    pub fn copy_to<T: bytemuck::Pod>(mut self, out: &mut [T]) -> GpuResult<()> {
        self.wait()?;
        let (out, size) = (bytemuck::cast_slice_mut::<T, u8>(out), self.size);
        let mapped = self.buffer.raw().get_mapped_range(..self.mapped);
        let view = mapped.map_err(|e| GpuError::validation(self.stage, e))?;
        if let Some(expected) = self.expected
            && !view.ends_with(&expected.to_le_bytes())
        {
            self.staging.driver.faults.lost(BEHIND.to_string());
            return self.staging.driver.faults.check();
        }
        let n = out.len().min(size as usize);
        let span = trace::span("read back").of("what", self.stage).with("bytes", size);
        self.staging.driver.cross(size, || empty(&view[..n], &mut out[..n]));
        drop(span);
        drop(view);
        self.buffer.raw().unmap();
        self.buffer.set_reusable(true);
        Ok(())
    }

    fn wait(&self) -> GpuResult<()> {
        if self.state.get() == MapState::Recorded {
            return Err(GpuError::validation(self.stage, "read before its commands were submitted"));
        }
        let driver = &self.staging.driver;
        driver.faults.set_stage(self.stage);
        // Waits for this read-back's own submission only: the device may work on later ones meanwhile.
        driver.wait_until(self.stage, &self.ticket, || self.state.get() != MapState::Pending)?;
        driver.faults.check()?;
        match self.state.get() {
            MapState::Mapped => Ok(()),
            _ => {
                // A lost device may fail the mapping before it reports the loss.
                driver.wait(self.stage, None)?;
                driver.faults.check()?;
                Err(GpuError::validation(self.stage, "the results could not be mapped"))
            }
        }
    }
}
