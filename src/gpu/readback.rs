//! Read-back of results: copies into staging memory that is mapped when the device has finished. Staging buffers are
//! reused, at most two per size class, so that one is read while the other is filled.
//!
//! Invariants: (1) a read-back returns the bytes as of its place in the recording; (2) reading before the recorder was
//! submitted is an error, never an endless wait.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use super::buffers::{BufferView, size_class};
use super::driver::Driver;
use super::error::{GpuError, GpuResult, lock};

const RECORDED: u8 = 0;
const MAPPING: u8 = 1;
const MAPPED: u8 = 2;
const FAILED: u8 = 3;

/// Free staging buffers by class, and the number of bytes read.
#[derive(Debug)]
pub(super) struct Staging {
    driver: Arc<Driver>,
    free: Mutex<BTreeMap<u64, Vec<wgpu::Buffer>>>,
    read: AtomicU64,
}

impl Staging {
    pub(super) fn new(driver: Arc<Driver>) -> Arc<Staging> {
        Arc::new(Staging { driver, free: Mutex::default(), read: AtomicU64::new(0) })
    }

    /// Records the copy of `view` for `stage`.
    pub(super) fn record(
        self: &Arc<Self>,
        encoder: &mut wgpu::CommandEncoder,
        stage: &'static str,
        view: &BufferView,
    ) -> GpuResult<(Readback, PendingMap)> {
        let (size, class) = (view.size, size_class(view.size));
        let reused = lock(&self.free).get_mut(&class).and_then(Vec::pop);
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let raw = reused.unwrap_or_else(|| self.driver.buffer("read-back staging", class, usage));
        self.driver.faults.check()?;
        encoder.copy_buffer_to_buffer(&view.raw, view.offset, &raw, 0, size);
        self.read.fetch_add(size, Ordering::Relaxed);
        let (state, submission) = (Arc::new(AtomicU8::new(RECORDED)), Arc::new(OnceLock::new()));
        let pending =
            PendingMap { raw: raw.clone(), size, state: Arc::clone(&state), submission: Arc::clone(&submission) };
        Ok((Readback { raw, stage, size, class, state, submission, staging: Arc::clone(self) }, pending))
    }

    pub(super) fn bytes_read(&self) -> u64 {
        self.read.load(Ordering::Relaxed)
    }

    /// Host memory of the free staging buffers, bytes.
    pub(super) fn bytes(&self) -> u64 {
        lock(&self.free).iter().map(|(class, free)| class * free.len() as u64).sum()
    }
}

/// A read-back in flight.
#[derive(Debug)]
#[must_use]
pub struct Readback {
    raw: wgpu::Buffer,
    stage: &'static str,
    size: u64,
    class: u64,
    state: Arc<AtomicU8>,
    submission: Arc<OnceLock<wgpu::SubmissionIndex>>,
    staging: Arc<Staging>,
}

/// The part of a read-back that its recorder keeps until submission.
#[derive(Debug)]
pub(super) struct PendingMap {
    raw: wgpu::Buffer,
    size: u64,
    state: Arc<AtomicU8>,
    submission: Arc<OnceLock<wgpu::SubmissionIndex>>,
}

impl PendingMap {
    /// Requests the mapping; called right after the submission.
    pub(super) fn start(self, submission: &wgpu::SubmissionIndex) {
        let _ = self.submission.set(submission.clone()); // starts once
        self.state.store(MAPPING, Ordering::Release);
        let state = Arc::clone(&self.state);
        self.raw.map_async(wgpu::MapMode::Read, ..self.size, move |result| {
            state.store(if result.is_ok() { MAPPED } else { FAILED }, Ordering::Release);
        });
    }
}

impl Readback {
    /// Size, bytes.
    pub fn size(&self) -> u64 {
        self.size
    }

    /// Waits, then returns the elements.
    ///
    /// # Errors
    /// The recorder was not submitted, the device was lost, or its work failed.
    pub fn to_vec<T: bytemuck::Pod>(self) -> GpuResult<Vec<T>> {
        let mut out = vec![T::zeroed(); usize::try_from(self.size).unwrap_or(0) / size_of::<T>().max(1)];
        self.copy_to(&mut out)?;
        Ok(out)
    }

    /// Waits, then fills `out` from its start with as many elements as there are.
    ///
    /// # Errors
    /// The recorder was not submitted, the device was lost, or its work failed.
    pub fn copy_to<T: bytemuck::Pod>(self, out: &mut [T]) -> GpuResult<()> {
        self.wait()?;
        let out = bytemuck::cast_slice_mut::<T, u8>(out);
        let view = self.raw.get_mapped_range(..self.size).map_err(|e| GpuError::validation(self.stage, e))?;
        let n = out.len().min(view.len());
        out[..n].copy_from_slice(&view[..n]);
        drop(view);
        self.raw.unmap();
        let mut free = lock(&self.staging.free);
        let class = free.entry(self.class).or_default();
        if class.len() < 2 {
            class.push(self.raw.clone());
        }
        Ok(())
    }

    fn wait(&self) -> GpuResult<()> {
        if self.state.load(Ordering::Acquire) == RECORDED {
            return Err(GpuError::validation(self.stage, "read before its commands were submitted"));
        }
        let driver = &self.staging.driver;
        driver.faults.set_stage(self.stage);
        while self.state.load(Ordering::Acquire) == MAPPING {
            // Waits for this read-back's own submission only: the device may work on later ones meanwhile.
            driver.wait(self.stage, self.submission.get().cloned())?;
        }
        driver.faults.check()?;
        match self.state.load(Ordering::Acquire) {
            MAPPED => Ok(()),
            _ => Err(GpuError::validation(self.stage, "the results could not be mapped")),
        }
    }
}
