//! Memory for one version of one page, aligned for direct I/O.
//!
//! Invariants: 1. the first byte lies on a multiple of [`ALIGNMENT`], and stays there when the buffer is moved: the bytes
//! live on the heap; 2. the length is a multiple of [`ALIGNMENT`]; 3. a fresh buffer is zero, and its memory is taken from
//! the machine only as it is written to.

/// Alignment of memory, offsets and lengths that every drive accepts for direct I/O, bytes.
pub const ALIGNMENT: usize = 4096;

/// An aligned buffer of fixed length. Moved, never copied, between frames and transfers.
pub struct PageBuffer {
    /// Longer than the buffer by up to one alignment.
    bytes: Vec<u8>,
    start: usize,
    len: usize,
}

impl PageBuffer {
    /// A buffer of zeros of at least `bytes` bytes.
    pub fn zeroed(bytes: usize) -> PageBuffer {
        let len = bytes.next_multiple_of(ALIGNMENT);
        let bytes = vec![0; len + ALIGNMENT];
        let start = bytes.as_ptr().align_offset(ALIGNMENT);
        PageBuffer { bytes, start, len }
    }

    /// Bytes of the buffer.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it has no bytes.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// All bytes.
    pub fn as_slice(&self) -> &[u8] {
        &self.bytes[self.start..self.start + self.len]
    }

    /// All bytes.
    pub fn as_mut_slice(&mut self) -> &mut [u8] {
        &mut self.bytes[self.start..self.start + self.len]
    }
}

impl std::fmt::Debug for PageBuffer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PageBuffer({} bytes)", self.len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_are_aligned_wherever_they_go() {
        let buffers: Vec<PageBuffer> = [0, 1, 4096, 749_568].map(PageBuffer::zeroed).into();
        for (buffer, len) in buffers.iter().zip([0, 4096, 4096, 749_568]) {
            assert_eq!(buffer.len(), len);
            assert_eq!(buffer.as_slice().as_ptr().align_offset(ALIGNMENT), 0);
            assert!(buffer.as_slice().iter().all(|&b| b == 0));
        }
        let mut boxed = Box::new(buffers);
        boxed[3].as_mut_slice()[749_567] = 7;
        assert_eq!(boxed[3].as_slice().as_ptr().align_offset(ALIGNMENT), 0);
        assert_eq!(boxed[3].as_slice()[749_567], 7);
    }
}
