//! Memory of uniforms: a ring of buffers that every submission refills.
//!
//! Invariant: a uniform lies within one buffer, at an offset that can be bound as a uniform block and as storage.

use std::sync::Arc;

use super::buffers::{BufferView, Pool};
use super::driver::Driver;
use super::error::GpuResult;

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
