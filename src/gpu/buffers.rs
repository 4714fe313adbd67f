//! Device memory: buffers from a pool of size classes, charged to one budget.
//!
//! Invariants: (1) allocated bytes, in use or free in the pool, never exceed the budget; (2) a buffer is reused only
//! within its class, which is at most a quarter larger than the requested size; (3) a dropped buffer returns to the
//! pool, and commands recorded later may use it; this is safe because commands run in the order recorded.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use super::driver::Driver;
use super::error::{GpuError, GpuResult, lock};

/// Smallest buffer, bytes; also the size of a view of an empty buffer.
const CLASS_MIN: u64 = 256;

/// Every buffer of the pool serves shaders and copies.
const USAGES: wgpu::BufferUsages =
    wgpu::BufferUsages::STORAGE.union(wgpu::BufferUsages::COPY_SRC).union(wgpu::BufferUsages::COPY_DST);

/// A buffer on the device; returns to the pool when dropped.
#[derive(Debug)]
pub struct Buffer {
    raw: wgpu::Buffer,
    label: &'static str,
    size: u64,
    class: u64,
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
        state.free.entry(self.class).or_default().push(self.raw.clone());
    }
}

/// The pool with its accounting.
#[derive(Debug)]
pub(super) struct Pool {
    driver: Arc<Driver>,
    state: Mutex<PoolState>,
    budget: u64,
    buffer_max: u64,
}

#[derive(Debug, Default)]
struct PoolState {
    free: BTreeMap<u64, Vec<wgpu::Buffer>>,
    usage: PoolUse,
}

/// The pool's accounting: bytes of live buffers, of all buffers now and at most, and the number of buffers allocated.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PoolUse {
    pub(super) in_use: u64,
    allocated: u64,
    pub(super) peak: u64,
    pub(super) allocations: u64,
}

impl Pool {
    pub(super) fn new(driver: Arc<Driver>, budget: u64, buffer_max: u64) -> Arc<Pool> {
        Arc::new(Pool { driver, state: Mutex::default(), budget, buffer_max })
    }

    /// A buffer of `size` bytes with arbitrary contents.
    pub(super) fn take(self: &Arc<Self>, label: &'static str, size: u64) -> GpuResult<Buffer> {
        let limit = self.buffer_max / 4 * 4;
        if size > limit {
            return Err(GpuError::BufferTooLarge { what: label.into(), need: size, limit });
        }
        let class = size_class(size).min(limit);
        let mut state = lock(&self.state);
        let reused = state.free.get_mut(&class).and_then(Vec::pop);
        let raw = match reused {
            Some(raw) => raw,
            None => {
                self.make_room(&mut state, label, class)?;
                self.driver.faults.set_stage(label);
                let raw = self.driver.buffer(label, class, USAGES);
                self.driver.faults.check()?;
                state.usage.allocated += class;
                state.usage.allocations += 1;
                state.usage.peak = state.usage.peak.max(state.usage.allocated);
                raw
            }
        };
        state.usage.in_use += class;
        Ok(Buffer { raw, label, size, class, pool: Arc::clone(self) })
    }

    /// Returns free buffers to the device, largest first, until `class` bytes fit the budget.
    fn make_room(&self, state: &mut PoolState, label: &str, class: u64) -> GpuResult<()> {
        if state.usage.in_use.saturating_add(class) > self.budget {
            return Err(GpuError::OutOfBudget {
                what: label.into(),
                need: class,
                in_use: state.usage.in_use,
                budget: self.budget,
            });
        }
        while state.usage.allocated + class > self.budget {
            let Some(mut largest) = state.free.last_entry() else { break };
            let size = *largest.key();
            if largest.get_mut().pop().is_some() {
                state.usage.allocated -= size;
            }
            if largest.get().is_empty() {
                largest.remove();
            }
        }
        Ok(())
    }

    /// Returns all free buffers to the device.
    pub(super) fn trim(&self) {
        let mut state = lock(&self.state);
        state.usage.allocated = state.usage.in_use;
        state.free.clear();
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
