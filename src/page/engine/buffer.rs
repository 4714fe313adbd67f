//! Memory for one version of one page, aligned for direct I/O.
//!
//! Invariants: 1. the first byte is aligned to [`ALIGNMENT`]; moving the `PageBuffer` does not move its bytes; 2. the
//! length is a multiple of [`ALIGNMENT`]; 3. a fresh buffer is zero; 4. a mapped buffer takes physical memory only as
//! it is written, never uses huge pages, and returns all its memory when dropped; a buffer registered with a ring
//! returns it when that ring is next used.

use memmap2::MmapMut;
#[cfg(target_os = "linux")]
use std::sync::{Arc, Mutex, PoisonError};

/// Alignment of memory, offsets and lengths that every drive accepts for direct I/O, bytes.
pub const ALIGNMENT: usize = 4096;

/// Buffers smaller than this, in bytes, come from the heap. A frame is larger: from the heap it would take [`ALIGNMENT`] bytes more
/// than a budget counts, a sixth of a frame of 64 rows.
const MAPPED_LEAST: usize = 2 * ALIGNMENT;

/// An aligned buffer of fixed length. Moved, never copied, between frames and transfers.
pub struct PageBuffer {
    memory: Memory,
    start: usize,
    len: usize,
    /// Its entry in the buffer table of the ring that transfers it.
    #[cfg(target_os = "linux")]
    pub(in crate::page) registration: Option<Registration>,
}

/// A buffer's entry in the buffer table of one ring; given up on drop.
#[cfg(target_os = "linux")]
#[derive(Debug)]
pub(in crate::page) struct Registration {
    pub number: u16,
    /// Bytes that the kernel has pinned, from the start of the buffer.
    pub bytes: usize,
    /// Indices of the table whose buffers were dropped, on any thread.
    pub ended: Arc<Mutex<Vec<u16>>>,
}

#[cfg(target_os = "linux")]
impl Drop for Registration {
    fn drop(&mut self) {
        self.ended.lock().unwrap_or_else(PoisonError::into_inner).push(self.number);
    }
}

enum Memory {
    /// Longer than the buffer by [`ALIGNMENT`], so that an aligned start exists.
    Heap(Vec<u8>),
    /// Starts on a page of the system, which is a multiple of [`ALIGNMENT`].
    Mapped(MmapMut),
}

impl PageBuffer {
    /// A zeroed buffer of at least `bytes` bytes on the heap.
    pub fn zeroed(bytes: usize) -> PageBuffer {
        let len = bytes.next_multiple_of(ALIGNMENT);
        let bytes = vec![0; len + ALIGNMENT];
        let start = bytes.as_ptr().align_offset(ALIGNMENT);
        PageBuffer::of(Memory::Heap(bytes), start, len)
    }

    /// As [`PageBuffer::zeroed`], for long-lived buffers: an anonymous memory map of its own if the buffer is large
    /// enough and the system grants another map, else the heap.
    pub fn mapped(bytes: usize) -> PageBuffer {
        let len = bytes.next_multiple_of(ALIGNMENT);
        let map = (len >= MAPPED_LEAST).then(|| MmapMut::map_anon(len).ok()).flatten();
        #[cfg(target_os = "linux")]
        if let Some(map) = &map {
            // Kernels without huge pages refuse this call and do not need it. Huge pages made steps no faster.
            let _ = map.advise(memmap2::Advice::NoHugePage);
        }
        match map.filter(|map| map.as_ptr().align_offset(ALIGNMENT) == 0) {
            Some(map) => PageBuffer::of(Memory::Mapped(map), 0, len),
            None => PageBuffer::zeroed(bytes),
        }
    }

    fn of(memory: Memory, start: usize, len: usize) -> PageBuffer {
        PageBuffer {
            memory,
            start,
            len,
            #[cfg(target_os = "linux")]
            registration: None,
        }
    }

    /// Whether the buffer is a memory map of its own.
    pub fn is_mapped(&self) -> bool {
        matches!(self.memory, Memory::Mapped(_))
    }

    #[allow(clippy::len_without_is_empty)] // nobody asks
    pub fn len(&self) -> usize {
        self.len
    }

    pub fn as_slice(&self) -> &[u8] {
        match &self.memory {
            Memory::Heap(bytes) => &bytes[self.start..self.start + self.len],
            Memory::Mapped(map) => &map[..self.len],
        }
    }

    pub fn as_mut_slice(&mut self) -> &mut [u8] {
        match &mut self.memory {
            Memory::Heap(bytes) => &mut bytes[self.start..self.start + self.len],
            Memory::Mapped(map) => &mut map[..self.len],
        }
    }
}

impl std::fmt::Debug for PageBuffer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PageBuffer({} bytes)", self.len)
    }
}
