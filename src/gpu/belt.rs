//! Uploads through reused staging memory: two sets, so that one is filled while the device reads the other.
//!
//! Invariants: (1) a chunk is written only while it is mapped, and unmapped before the commands that read it are
//! submitted; (2) a set is refilled only after its submission has finished; (3) a set holds at most [`SET_BYTES`]: when
//! a set is full, the recorder submits what it has recorded.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

use super::driver::Driver;
use super::error::{GpuError, GpuResult};

/// Bytes of one staging buffer: in the range where copies run fastest.
const CHUNK_BYTES: u64 = 4 << 20;
/// Most bytes staged in one set.
pub(super) const SET_BYTES: u64 = 32 << 20;

/// Alignment of mapped ranges.
const MAP_ALIGNMENT: u64 = wgpu::MAP_ALIGNMENT;

const PENDING: u8 = 0;
const MAPPED: u8 = 1;
const FAILED: u8 = 2;

#[derive(Debug)]
struct Chunk {
    raw: wgpu::Buffer,
    state: Arc<AtomicU8>,
    used: u64,
}

#[derive(Debug, Default)]
struct Set {
    chunks: Vec<Chunk>,
    submission: Option<wgpu::SubmissionIndex>,
}

/// Both sets; the first one is being filled.
#[derive(Debug)]
pub(super) struct Belt {
    driver: Arc<Driver>,
    sets: [Set; 2],
}

impl Belt {
    pub(super) fn new(driver: Arc<Driver>) -> Belt {
        Belt { driver, sets: Default::default() }
    }

    /// Host memory of the staging buffers, bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.sets.iter().map(|s| s.chunks.len() as u64 * CHUNK_BYTES).sum()
    }

    /// Stages as much of `bytes` as fits and records its copy to `target` at `offset`; returns the number of bytes
    /// staged. Fewer than all means that the set is full. `bytes.len()` is a multiple of 4.
    pub(super) fn write(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        target: &wgpu::Buffer,
        offset: u64,
        bytes: &[u8],
    ) -> GpuResult<usize> {
        self.sets[0].wait(&self.driver)?;
        let mut done = 0;
        while done < bytes.len() {
            let Some(chunk) = self.sets[0].chunk_with_room(&self.driver) else { break };
            self.driver.faults.check()?;
            let room = usize::try_from(CHUNK_BYTES - chunk.used).unwrap_or(0);
            let n = room.min(bytes.len() - done);
            let end = chunk.used + n as u64;
            let view = chunk.raw.get_mapped_range_mut(chunk.used..end);
            let mut view = view.map_err(|e| GpuError::validation("upload", e))?;
            view.copy_from_slice(&bytes[done..done + n]);
            drop(view);
            encoder.copy_buffer_to_buffer(&chunk.raw, chunk.used, target, offset + done as u64, n as u64);
            chunk.used = end.next_multiple_of(MAP_ALIGNMENT).min(CHUNK_BYTES);
            done += n;
        }
        Ok(done)
    }

    /// Unmaps the staged chunks before a submission, which makes them visible to the device.
    pub(super) fn finish(&mut self) {
        for chunk in self.sets[0].chunks.iter_mut().filter(|c| c.used > 0) {
            chunk.state.store(PENDING, Ordering::Release);
            chunk.raw.unmap();
        }
    }

    /// Swaps the sets after a submission: this one waits for the device, the other one is next.
    pub(super) fn submitted(&mut self, submission: &wgpu::SubmissionIndex) {
        let mut any = false;
        for chunk in self.sets[0].chunks.iter_mut().filter(|c| c.used > 0) {
            any = true;
            chunk.used = 0;
            let state = Arc::clone(&chunk.state);
            chunk.raw.map_async(wgpu::MapMode::Write, .., move |result| {
                state.store(if result.is_ok() { MAPPED } else { FAILED }, Ordering::Release);
            });
        }
        if any {
            self.sets[0].submission = Some(submission.clone());
            self.sets.swap(0, 1);
        }
    }
}

impl Set {
    /// Waits until the device has read the last content of this set.
    fn wait(&mut self, driver: &Driver) -> GpuResult<()> {
        let Some(submission) = self.submission.take() else { return Ok(()) };
        driver.wait("upload", Some(submission))?;
        if self.chunks.iter().any(|c| c.state.load(Ordering::Acquire) != MAPPED) {
            return Err(GpuError::validation("upload", "staging memory could not be mapped again"));
        }
        Ok(())
    }

    /// A chunk that is not full; `None` if the set is full.
    fn chunk_with_room(&mut self, driver: &Driver) -> Option<&mut Chunk> {
        let at = match self.chunks.iter().position(|c| c.used < CHUNK_BYTES) {
            Some(at) => at,
            None if self.chunks.len() as u64 * CHUNK_BYTES >= SET_BYTES => return None,
            None => {
                let usage = wgpu::BufferUsages::MAP_WRITE | wgpu::BufferUsages::COPY_SRC;
                let raw = driver.buffer("upload staging", CHUNK_BYTES, usage);
                self.chunks.push(Chunk { raw, state: Arc::new(AtomicU8::new(MAPPED)), used: 0 });
                self.chunks.len() - 1
            }
        };
        self.chunks.get_mut(at)
    }
}
