//! Device memory: buffers from a pool of size classes, charged to one budget. Staging and uniforms are charged to it as well.
//!
//! Invariants: (1) allocated bytes, in use or free in the pool, never exceed the budget; once the device refused a buffer that
//! is needed, the budget is what it had granted until then; (2) a buffer is reused only
//! within its class, which is at most a quarter larger than the requested size; (3) a dropped buffer returns to the
//! pool, and commands recorded later may use it; this is safe because commands run in the order recorded, and a buffer for
//! read-backs returns only after the host has unmapped it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use super::driver::Driver;
use super::error::{GpuError, GpuResult};
use super::faults::lock;

/// Smallest buffer, bytes; also the size of a view of an empty buffer.
const CLASS_MIN: u64 = 256;

/// Every buffer of the pool serves shaders and copies.
const USAGES: wgpu::BufferUsages =
    wgpu::BufferUsages::STORAGE.union(wgpu::BufferUsages::COPY_SRC).union(wgpu::BufferUsages::COPY_DST);

/// What a buffer of the pool serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Purpose {
    /// Shaders and copies.
    Work,
    /// Copies to the host, which maps the buffer.
    ReadBack,
}

impl Purpose {
    fn usages(self) -> wgpu::BufferUsages {
        match self {
            Purpose::Work => USAGES,
            Purpose::ReadBack => wgpu::BufferUsages::MAP_READ.union(wgpu::BufferUsages::COPY_DST),
        }
    }
}

/// A buffer on the device; returns to the pool when dropped.
#[derive(Debug)]
pub struct Buffer {
    raw: wgpu::Buffer,
    label: &'static str,
    size: u64,
    class: u64,
    purpose: Purpose,
    /// Whether the pool may hand the buffer out again.
    is_reusable: bool,
    pool: Arc<Pool>,
}

/// A range of a buffer, as shaders and copies use it. It keeps the memory alive, but not its charge to the budget: keep
/// the [`Buffer`] for as long as its contents matter.
#[derive(Debug, Clone)]
pub struct BufferView {
    pub(super) raw: wgpu::Buffer,
    pub(super) label: &'static str,
    pub(super) offset: u64,
    pub(super) size: u64,
}

impl BufferView {
    /// Bytes.
    pub fn size(&self) -> u64 {
        self.size
    }

    /// Whether the range is within its buffer.
    pub(super) fn is_inside(&self) -> bool {
        self.offset.checked_add(self.size).is_some_and(|end| end <= self.raw.size())
    }
}

impl Buffer {
    /// The driver's buffer.
    pub(super) fn raw(&self) -> &wgpu::Buffer {
        &self.raw
    }

    /// Lets the pool hand the buffer out again, or not, once it is dropped.
    pub(super) fn set_reusable(&mut self, is_reusable: bool) {
        self.is_reusable = is_reusable;
    }

    /// The requested size, bytes.
    pub fn size(&self) -> u64 {
        self.size
    }

    /// A view of the whole buffer: the requested size rounded up to a multiple of 4, or 256 if it is 0.
    pub fn view(&self) -> BufferView {
        let size = if self.size == 0 { CLASS_MIN } else { self.size.next_multiple_of(4) };
        BufferView { raw: self.raw.clone(), label: self.label, offset: 0, size }
    }

    /// A view of `size` bytes from `offset`. The offset must be a multiple of 4, and for a binding a multiple of
    /// [`super::Gpu::offset_alignment`]. A range beyond the buffer is an error of the command that uses it.
    pub fn slice(&self, offset: u64, size: u64) -> BufferView {
        BufferView { raw: self.raw.clone(), label: self.label, offset, size }
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let mut state = lock(&self.pool.state);
        state.usage.in_use -= self.class;
        let free = state.free.entry((self.class, self.purpose)).or_default();
        if self.is_reusable {
            free.push(self.raw.clone());
        } else {
            state.usage.allocated -= self.class;
        }
    }
}

#[derive(Debug)]
pub(super) struct Pool {
    driver: Arc<Driver>,
    state: Mutex<PoolState>,
    buffer_max: u64,
    /// Most bytes of the API's memory blocks; `None`: no limit.
    block_limit: Option<u64>,
}

#[derive(Debug, Default)]
struct PoolState {
    budget: u64,
    free: BTreeMap<(u64, Purpose), Vec<wgpu::Buffer>>,
    usage: PoolUse,
}

/// The pool's accounting: bytes of live buffers, of all buffers now and at most, and the number of buffers allocated.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PoolUse {
    pub(super) in_use: u64,
    pub(super) allocated: u64,
    /// Bytes of staging and uniforms that stay for good.
    pub(super) kept: u64,
    pub(super) peak: u64,
    pub(super) allocations: u64,
}

impl Pool {
    pub(super) fn new(driver: Arc<Driver>, budget: u64, block_limit: Option<u64>, buffer_max: u64) -> Arc<Pool> {
        let state = PoolState { budget, ..PoolState::default() };
        Arc::new(Pool { driver, state: Mutex::new(state), buffer_max, block_limit })
    }

    /// A buffer of `size` bytes with arbitrary contents.
    pub(super) fn take(self: &Arc<Self>, label: &'static str, size: u64, purpose: Purpose) -> GpuResult<Buffer> {
        self.take_as(label, size, purpose, true)
    }

    /// A buffer for shaders that the caller can do without: a refusal by the device leaves pool and budget as they are.
    pub(super) fn take_optional(self: &Arc<Self>, label: &'static str, size: u64) -> GpuResult<Option<Buffer>> {
        match self.take_as(label, size, Purpose::Work, false) {
            Err(error) if error.is_out_of_memory() => Ok(None),
            taken => taken.map(Some),
        }
    }

    fn take_as(
        self: &Arc<Self>,
        label: &'static str,
        size: u64,
        purpose: Purpose,
        is_needed: bool,
    ) -> GpuResult<Buffer> {
        let limit = self.buffer_max / 4 * 4;
        if size > limit {
            return Err(GpuError::BufferTooLarge { what: label.into(), need: size, limit });
        }
        let class = size_class(size).min(limit);
        let mut state = lock(&self.state);
        let reused = state.free.get_mut(&(class, purpose)).and_then(Vec::pop);
        let raw = match reused {
            Some(raw) => raw,
            None => {
                self.make_room(&mut state, label, class)?;
                let raw = self.allocate(&mut state, label, class, purpose.usages(), is_needed)?;
                state.usage.allocations += 1;
                raw
            }
        };
        state.usage.in_use += class;
        Ok(Buffer { raw, label, size, class, purpose, is_reusable: true, pool: Arc::clone(self) })
    }

    /// A buffer of `size` bytes that stays charged for as long as the pool lives.
    pub(super) fn keep(&self, label: &'static str, size: u64, usages: wgpu::BufferUsages) -> GpuResult<wgpu::Buffer> {
        let mut state = lock(&self.state);
        self.make_room(&mut state, label, size)?;
        let raw = self.allocate(&mut state, label, size, usages, true)?;
        state.usage.in_use += size;
        state.usage.kept += size;
        Ok(raw)
    }

    /// Asks the driver for a buffer and counts it. After a refusal of a needed buffer all free buffers go back to the device, once it
    /// has finished with them; a second refusal lowers the budget below what would have been allocated.
    fn allocate(
        &self,
        state: &mut PoolState,
        label: &'static str,
        size: u64,
        usages: wgpu::BufferUsages,
        is_needed: bool,
    ) -> GpuResult<wgpu::Buffer> {
        let ask = || {
            self.driver.faults.set_stage(label);
            let raw = self.driver.buffer(label, size, usages);
            self.driver.faults.check().map(|()| raw)
        };
        let mut asked = ask();
        if is_needed && matches!(asked, Err(GpuError::OutOfMemory { .. })) {
            state.usage.allocated = state.usage.in_use;
            state.free.clear();
            self.driver.wait(label, None)?;
            asked = ask();
        }
        let raw = asked.map_err(|error| match error {
            GpuError::OutOfMemory { .. } => {
                if is_needed {
                    state.budget = state.budget.min(state.usage.allocated + size - 1);
                }
                GpuError::DeviceFull { what: label.into(), need: size, in_use: state.usage.in_use }
            }
            other => other,
        })?;
        if let Some(error) = self.over_block_limit(state, label, size)? {
            return Err(error); // drops the buffer
        }
        state.usage.allocated += size;
        state.usage.peak = state.usage.peak.max(state.usage.allocated);
        Ok(raw)
    }

    /// The error for a buffer with which the API's memory blocks exceed the limit even after all free buffers are gone.
    fn over_block_limit(&self, state: &mut PoolState, label: &str, size: u64) -> GpuResult<Option<GpuError>> {
        let Some(limit) = self.block_limit else { return Ok(None) };
        let reserved =
            || self.driver.device.generate_allocator_report().map_or(0, |report| report.total_reserved_bytes);
        if reserved() <= limit {
            return Ok(None);
        }
        state.usage.allocated = state.usage.in_use;
        state.free.clear();
        self.driver.wait(label, None)?; // the API frees what the device has finished with
        Ok((reserved() > limit).then(|| GpuError::OutOfBudget {
            what: label.into(),
            need: size,
            in_use: state.usage.in_use,
            budget: limit,
        }))
    }

    /// Returns free buffers to the device, largest first, until `class` bytes fit the budget.
    fn make_room(&self, state: &mut PoolState, label: &str, class: u64) -> GpuResult<()> {
        if state.usage.in_use.saturating_add(class) > state.budget {
            return Err(GpuError::OutOfBudget {
                what: label.into(),
                need: class,
                in_use: state.usage.in_use,
                budget: state.budget,
            });
        }
        while state.usage.allocated + class > state.budget {
            let Some(mut largest) = state.free.last_entry() else { break };
            let (size, _) = *largest.key();
            if largest.get_mut().pop().is_some() {
                state.usage.allocated -= size;
            }
            if largest.get().is_empty() {
                largest.remove();
            }
        }
        Ok(())
    }

    /// Bytes that buffers can still take.
    pub(super) fn room(&self) -> u64 {
        let state = lock(&self.state);
        state.budget.saturating_sub(state.usage.in_use)
    }

    /// Bytes of the free buffers for read-backs.
    pub(super) fn read_back_bytes(&self) -> u64 {
        let state = lock(&self.state);
        let free = state.free.iter().filter(|((_, purpose), _)| *purpose == Purpose::ReadBack);
        free.map(|((class, _), free)| class * free.len() as u64).sum()
    }

    pub(super) fn usage(&self) -> PoolUse {
        lock(&self.state).usage
    }
}

/// The size class for a size, at least 256: four classes per power of two.
pub(super) fn size_class(size: u64) -> u64 {
    if size <= CLASS_MIN {
        return CLASS_MIN;
    }
    // The step between classes is a quarter of the largest power of two below the size.
    let step = 1u64 << ((size - 1).ilog2().saturating_sub(2));
    size.next_multiple_of(step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_hold_their_sizes_and_waste_at_most_a_quarter() {
        for size in (1..5000).chain([1 << 20, (1 << 20) + 1, 123_456_789, (1 << 31) - 1]) {
            let class = size_class(size);
            assert!(class >= size && class.is_multiple_of(4), "{size} -> {class}");
            assert!(class <= CLASS_MIN || class * 4 <= size * 5 + 4, "{size} -> {class}");
            assert_eq!(size_class(class), class, "a class is its own class");
        }
    }
}
