//! The opened wgpu device with its queue and error reports: what the other files of this room share.
//!
//! Invariant: calls return before the driver reports their errors; the caller asks [`Faults::check`] afterwards.

use std::sync::Arc;

use super::bus::EmulatedBus;
use super::error::{GpuError, GpuResult};
use super::faults::Faults;
use super::submitter::{Submitter, Ticket};
use crate::base::trace;
use std::time::Instant;

/// An opened wgpu device.
#[derive(Debug)]
pub(super) struct Driver {
    pub(super) device: wgpu::Device,
    pub(super) faults: Arc<Faults>,
    /// Submits to the queue: on a thread where a bus is emulated.
    pub(super) submitter: Submitter,
    /// Nanoseconds of a tick of the device's clock.
    pub(super) timestamp_period: f32,
    /// How long copies between host and device take; `None`: as long as they take.
    bus: Option<EmulatedBus>,
}

impl Driver {
    /// Opens the device of `adapter`, called `name` in errors. Buffers lie in memory blocks of `block_bytes`, or larger ones of
    /// their own; `None` leaves the sizes to the API.
    pub(super) fn open(
        adapter: &wgpu::Adapter,
        name: &str,
        required_features: wgpu::Features,
        required_limits: wgpu::Limits,
        block_bytes: Option<u64>,
        bus: Option<EmulatedBus>,
    ) -> GpuResult<Driver> {
        let memory_hints = block_bytes.map_or(wgpu::MemoryHints::Performance, |bytes| wgpu::MemoryHints::Manual {
            suballocated_device_memory_block_size: bytes..bytes,
        });
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("gsscale"),
            required_features,
            required_limits,
            memory_hints,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| GpuError::Open { device: name.into(), message: e.to_string() })?;
        let faults = Arc::new(Faults::default());
        let reports = Arc::clone(&faults);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| reports.report(&error)));
        let losses = Arc::clone(&faults);
        device.set_device_lost_callback(move |_, message| losses.lost(message));
        let submitter = Submitter::new(&device, &queue, &faults, bus.is_some())?;
        Ok(Driver { device, faults, submitter, timestamp_period: queue.get_timestamp_period(), bus })
    }

    /// A new buffer; one with `MAP_WRITE` is mapped.
    pub(super) fn buffer(&self, label: &str, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        let mapped_at_creation = usage.contains(wgpu::BufferUsages::MAP_WRITE);
        self.device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation })
    }

    pub(super) fn encoder(&self, label: &str) -> wgpu::CommandEncoder {
        self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some(label) })
    }

    /// Copies between host and device: runs `copy` of `bytes` bytes, which takes at least as long as on the emulated bus.
    pub(super) fn cross<T>(&self, bytes: u64, copy: impl FnOnce() -> T) -> T {
        let began = Instant::now();
        let done = copy();
        if let Some(bus) = &self.bus {
            bus.cross(began, bytes);
        }
        done
    }

    /// The error that was reported, if any. A lost device may refuse what it is given before it reports the loss; the loss is the error then.
    pub(super) fn check(&self) -> GpuResult<()> {
        if self.faults.is_reported() {
            // Without work the device reports its loss. An error of the wait itself says less than those.
            self.submitter.drain();
            let _ = self.faults.poll(&self.device, wgpu::PollType::Wait { submission_index: None, timeout: None });
        }
        self.faults.check()
    }

    /// Waits until `is_done`, which the device reports once it has finished the submission of `ticket`.
    ///
    /// A submission that is under way on the thread that submits holds up a poll. So the device is polled only if the report has not come
    /// with the submission.
    pub(super) fn wait_until(&self, stage: &str, ticket: &Ticket, is_done: impl Fn() -> bool) -> GpuResult<()> {
        let span = trace::span("wait").of("for", stage);
        let is_submitted = ticket.index().is_some();
        drop(span);
        if !is_submitted {
            self.faults.check()?;
            return Err(GpuError::validation(stage, "its commands were not submitted"));
        }
        while !is_done() {
            self.wait(stage, Some(ticket))?;
        }
        Ok(())
    }

    /// Waits until the device has finished `submission`, or all; errors that no report explains name `stage`.
    pub(super) fn wait(&self, stage: &str, submission: Option<&Ticket>) -> GpuResult<()> {
        let _span = trace::span("wait").of("for", stage);
        let submission_index = match submission {
            Some(ticket) => ticket.index(),
            None => {
                self.submitter.drain();
                None
            }
        };
        let waited = self.faults.poll(&self.device, wgpu::PollType::Wait { submission_index, timeout: None });
        self.faults.check()?;
        waited.map_err(|e| GpuError::validation(stage, e))
    }
}
