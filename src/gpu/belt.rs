//! The ways to the device: uploads through reused staging memory, and a ring of buffers of uniforms that every submission refills.
//! Staging has two sets, so that one is filled while the device reads the other; more where the host
//! records a step while the device works on another.
//!
//! Invariants: (1) a chunk is written only while it is mapped, and unmapped before the commands that read it are
//! submitted; (2) a set is refilled only after its submission has finished; (3) a set takes at most a 64th of the budget or
//! one smallest chunk: when a set is full, the recorder submits what it has recorded; (4) a uniform lies within
//! one buffer, at an offset that can be bound as a uniform block and as storage.

use std::collections::VecDeque;
use std::sync::Arc;

use super::buffers::{BufferView, Pool};
use super::driver::Driver;
use super::error::{GpuError, GpuResult};
use super::submitter::{MapState, Mapping, SharedState, Ticket};
use rayon::prelude::*;
use wgpu::MAP_ALIGNMENT;

/// Bytes of one staging buffer, at most: in the range where copies run fastest.
const CHUNK_BYTES_MAX: u64 = 4 << 20;
/// Bytes of one staging buffer, at least.
const CHUNK_BYTES_MIN: u64 = 16 << 10;
/// A set takes at most this part of the budget.
const SET_SHARE: u64 = 64;
/// Most staging buffers in one set.
const SET_CHUNKS: usize = 8;

/// Staging that uploads of `bytes` bytes a step take without a budget: two sets.
pub fn staging_bytes(bytes: u64) -> u64 {
    2 * bytes.next_multiple_of(CHUNK_BYTES_MAX).clamp(CHUNK_BYTES_MAX, SET_CHUNKS as u64 * CHUNK_BYTES_MAX)
}

/// Sets of a host that records one step while the device works on another: three submissions of a step bring uploads.
const SETS_IN_FLIGHT: usize = 6;

/// Bytes that one thread copies at a time: longer copies between host and mapped memory run on all threads.
pub(super) const COPY_PART: usize = 256 << 10;

/// Copies `bytes` to the mapped buffer `raw` from `at` on.
fn fill(raw: &wgpu::Buffer, at: u64, bytes: &[u8]) -> GpuResult<()> {
    let copy = |at: u64, part: &[u8]| -> GpuResult<()> {
        let view = raw.get_mapped_range_mut(at..at + part.len() as u64);
        let mut view = view.map_err(|e| GpuError::validation("upload", e))?;
        view.copy_from_slice(part);
        Ok(())
    };
    match bytes.len() {
        0..=COPY_PART => copy(at, bytes),
        _ => bytes.par_chunks(COPY_PART).enumerate().try_for_each(|(i, part)| copy(at + (i * COPY_PART) as u64, part)),
    }
}

#[derive(Debug)]
struct Chunk {
    raw: wgpu::Buffer,
    state: SharedState,
    used: u64,
}

#[derive(Debug, Default)]
struct Set {
    chunks: Vec<Chunk>,
    ticket: Option<Ticket>,
}

/// The sets; the first one is being filled, and the next one is the longest submitted.
#[derive(Debug)]
pub(super) struct Belt {
    driver: Arc<Driver>,
    pool: Arc<Pool>,
    chunk_bytes: u64,
    /// Most staging buffers in one set.
    set_chunks: usize,
    sets: VecDeque<Set>,
    sets_most: usize,
}

impl Belt {
    /// Staging for a device whose pool may allocate `budget` bytes.
    pub(super) fn new(driver: Arc<Driver>, pool: Arc<Pool>, budget: u64) -> Belt {
        let share = (budget / SET_SHARE).clamp(CHUNK_BYTES_MIN, CHUNK_BYTES_MAX);
        let set_chunks = (budget / SET_SHARE / share).clamp(1, SET_CHUNKS as u64) as usize;
        let (chunk_bytes, sets) =
            (share / MAP_ALIGNMENT * MAP_ALIGNMENT, VecDeque::from([Set::default(), Set::default()]));
        Belt { driver, pool, chunk_bytes, set_chunks, sets_most: sets.len(), sets }
    }

    /// Lets the belt take more sets, as memory allows, instead of waiting for the device.
    pub(super) fn allow_steps_in_flight(&mut self) {
        self.sets_most = SETS_IN_FLIGHT;
    }

    /// Makes the first set ready: waits for its submission, or puts another set before it.
    fn ready(&mut self) -> GpuResult<()> {
        if self.sets.len() < self.sets_most && self.sets[0].is_busy() {
            let mut set = Set::default();
            match set.chunk_with_room(&self.pool, self.chunk_bytes, self.set_chunks) {
                Ok(_) => self.sets.push_front(set),
                Err(error) if error.is_out_of_memory() => {}
                Err(error) => return Err(error),
            }
        }
        self.sets[0].wait(&self.driver)
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
        self.ready()?;
        let mut done = 0;
        while done < bytes.len() {
            let Some(chunk) = self.sets[0].chunk_with_room(&self.pool, self.chunk_bytes, self.set_chunks)? else {
                break;
            };
            let room = usize::try_from(self.chunk_bytes - chunk.used).unwrap_or(0);
            let n = room.min(bytes.len() - done);
            let end = chunk.used + n as u64;
            let filled = self.driver.cross(n as u64, || fill(&chunk.raw, chunk.used, &bytes[done..done + n]));
            if let Err(error) = filled {
                // A lost device may refuse its memory before it reports the loss.
                self.driver.wait("upload", None)?;
                self.driver.faults.check()?;
                return Err(error);
            }
            encoder.copy_buffer_to_buffer(&chunk.raw, chunk.used, target, offset + done as u64, n as u64);
            chunk.used = end.next_multiple_of(MAP_ALIGNMENT).min(self.chunk_bytes);
            done += n;
        }
        Ok(done)
    }

    /// Hands the staged chunks over to the submission of `ticket`: the device may read them, and `mappings` brings them back when it has.
    /// The other set is next.
    pub(super) fn submit_staged(&mut self, ticket: &Ticket, mappings: &mut Vec<Mapping>) {
        let mut any = false;
        for chunk in self.sets[0].chunks.iter_mut().filter(|c| c.used > 0) {
            any = true;
            chunk.used = 0;
            chunk.raw.unmap();
            mappings.push(Mapping::new(&chunk.raw, wgpu::MapMode::Write, self.chunk_bytes, &chunk.state));
        }
        if any {
            self.sets[0].ticket = Some(ticket.clone());
            self.sets.rotate_left(1);
        }
    }
}

impl Set {
    /// Whether the device has not read the last content of this set, as far as is known.
    fn is_busy(&self) -> bool {
        self.ticket.is_some() && self.chunks.iter().any(|c| c.state.get() == MapState::Pending)
    }

    /// Waits until the device has read the last content of this set.
    fn wait(&mut self, driver: &Driver) -> GpuResult<()> {
        let Some(ticket) = self.ticket.take() else { return Ok(()) };
        driver.wait_until("upload", &ticket, || self.chunks.iter().all(|c| c.state.get() != MapState::Pending))?;
        if self.chunks.iter().any(|c| c.state.get() != MapState::Mapped) {
            driver.wait("upload", None)?; // a lost device may fail the mapping before it reports the loss
            return Err(GpuError::validation("upload", "staging memory could not be mapped again"));
        }
        Ok(())
    }

    /// A chunk that is not full; `None` if the set is full.
    fn chunk_with_room(&mut self, pool: &Pool, chunk_bytes: u64, most: usize) -> GpuResult<Option<&mut Chunk>> {
        let at = match self.chunks.iter().position(|c| c.used < chunk_bytes) {
            Some(at) => at,
            None if self.chunks.len() >= most => return Ok(None),
            None => {
                let usage = wgpu::BufferUsages::MAP_WRITE | wgpu::BufferUsages::COPY_SRC;
                match pool.keep("upload staging", chunk_bytes, usage) {
                    Ok(raw) => self.chunks.push(Chunk { raw, state: SharedState::new(MapState::Mapped), used: 0 }),
                    // A smaller set is submitted more often.
                    Err(error) if error.is_out_of_memory() && !self.chunks.is_empty() => return Ok(None),
                    Err(error) => return Err(error),
                }
                self.chunks.len() - 1
            }
        };
        Ok(self.chunks.get_mut(at))
    }
}

/// Bytes of one buffer of the ring.
pub(super) const UNIFORM_CHUNK: u64 = 64 << 10;

/// Buffers of uniforms, refilled by every submission.
#[derive(Debug)]
pub(super) struct UniformRing {
    driver: Arc<Driver>,
    pool: Arc<Pool>,
    chunks: Vec<wgpu::Buffer>,
    alignment: u64,
}

impl UniformRing {
    pub(super) fn new(driver: Arc<Driver>, pool: Arc<Pool>, alignment: u64) -> UniformRing {
        UniformRing { driver, pool, chunks: Vec::new(), alignment: alignment.max(16) }
    }

    /// The buffer at `index`; allocated on first use.
    pub(super) fn chunk(&mut self, index: usize) -> GpuResult<wgpu::Buffer> {
        while self.chunks.len() <= index {
            let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
            self.chunks.push(self.pool.keep("uniforms", UNIFORM_CHUNK, usage)?);
        }
        Ok(self.chunks[index].clone())
    }

    /// Appends a uniform to `packed`, the contents of the buffers at the next submission; returns its place.
    pub(super) fn pack(&mut self, packed: &mut Vec<Vec<u8>>, bytes: &[u8]) -> GpuResult<BufferView> {
        let size = bytes.len() as u64;
        let offset_in = |chunk: &Vec<u8>| (chunk.len() as u64).next_multiple_of(self.alignment);
        if packed.last().is_none_or(|chunk| offset_in(chunk) + size > UNIFORM_CHUNK) {
            packed.push(Vec::new());
        }
        let index = packed.len() - 1;
        let offset = offset_in(&packed[index]);
        let raw = self.chunk(index)?;
        let chunk = &mut packed[index];
        chunk.resize(usize::try_from(offset).unwrap_or(chunk.len()), 0);
        chunk.extend_from_slice(bytes);
        chunk.resize(chunk.len().next_multiple_of(4), 0); // writes are multiples of 4 bytes
        Ok(BufferView { raw, label: "uniforms", offset, size })
    }

    /// The packed uniforms and their buffers, which are written right before the next submission.
    pub(super) fn take(&mut self, packed: &mut Vec<Vec<u8>>) -> Vec<(wgpu::Buffer, Vec<u8>)> {
        let written: Vec<_> = self.chunks.iter().cloned().zip(packed.drain(..)).collect();
        for (_, bytes) in &written {
            self.driver.cross(bytes.len() as u64, || {});
        }
        written
    }
}
