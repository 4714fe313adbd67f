//! Buffers that the kernel's ring knows beforehand: their memory is looked up and held once, not for every request.
//!
//! A buffer that stays (a frame's) is registered when it first moves mostly full, keeps its number in the ring's table as
//! long as it lives, and is taken out of the table after its end. What the kernel holds counts against the limit on locked
//! memory (`ulimit -l`) of whoever is bound by it: the first refusal is the last attempt, and buffers without a number move
//! by requests that name their memory.
//!
//! Invariants: 1. a number belongs to one buffer of one ring until that buffer has ended and its entry was cleared; 2. the
//! kernel holds memory of a buffer that has ended no longer than until the ring is used next.
//!
//! Safety: the kernel takes hold of the memory itself, not of the address: an entry whose buffer has ended names memory that
//! nobody else has. Requests name addresses within the entry's buffer, which their flight owns.
#![allow(unsafe_code)] // the table takes addresses of buffers

use super::buffer::PageBuffer;
use io_uring::Submitter;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};

/// Most entries of a table: the kernel's own limit.
const ENTRIES: u16 = 1 << 14;

/// Numbers whose buffers have ended, on whatever thread.
type Ended = Arc<Mutex<Vec<u16>>>;

/// A buffer's place in the table of one ring; given up when it is dropped.
#[derive(Debug)]
pub struct Registration {
    number: u16,
    ended: Ended,
}

impl Drop for Registration {
    fn drop(&mut self) {
        self.ended.lock().unwrap_or_else(PoisonError::into_inner).push(self.number);
    }
}

/// The table of one ring.
#[derive(Debug, Default)]
pub struct RegisteredBuffers {
    /// Whether the kernel gave a table, and has taken every buffer so far.
    is_open: bool,
    /// Entries that were used so far.
    used: u16,
    /// Of these, entries that are clear.
    clear: Vec<u16>,
    ended: Ended,
}

impl RegisteredBuffers {
    /// An empty table for a ring; one that takes nothing where the kernel knows no such tables.
    pub fn of(ring: &Submitter<'_>) -> RegisteredBuffers {
        let is_open = ring.register_buffers_sparse(ENTRIES.into()).is_ok();
        RegisteredBuffers { is_open, ..RegisteredBuffers::default() }
    }

    /// Buffers that are registered, those that have just ended included.
    pub fn len(&self) -> usize {
        usize::from(self.used) - self.clear.len()
    }

    /// The number of a buffer of which `bytes` bytes will move; `None` for one that is not registered.
    pub fn number_of(&mut self, ring: &Submitter<'_>, buffer: &mut PageBuffer, bytes: usize) -> Option<u16> {
        self.clear_ended(ring);
        let own = buffer.registration.as_ref().filter(|r| Arc::ptr_eq(&r.ended, &self.ended));
        if let Some(registration) = own {
            return Some(registration.number);
        }
        // The kernel would take all of a buffer's memory from the machine, also what pages with few rows never touch.
        if !self.is_open || !buffer.is_mapped() || 2 * bytes < buffer.len() {
            return None;
        }
        let number = self.clear.pop().or_else(|| (self.used < ENTRIES).then_some(self.used))?;
        self.used = self.used.max(number + 1);
        let memory = buffer.as_mut_slice();
        let entry = libc::iovec { iov_base: memory.as_mut_ptr().cast(), iov_len: memory.len() };
        if set(ring, number, entry).is_err() {
            self.is_open = false;
            self.clear.push(number);
            return None;
        }
        buffer.registration = Some(Registration { number, ended: Arc::clone(&self.ended) });
        Some(number)
    }

    /// Lets go of the memory of buffers that have ended.
    pub fn clear_ended(&mut self, ring: &Submitter<'_>) {
        let mut ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner);
        for number in ended.drain(..) {
            let nothing = libc::iovec { iov_base: std::ptr::null_mut(), iov_len: 0 };
            if set(ring, number, nothing).is_ok() {
                self.clear.push(number);
            }
        }
    }
}

/// Puts an entry into the table; one without memory clears it.
fn set(ring: &Submitter<'_>, number: u16, entry: libc::iovec) -> io::Result<()> {
    // SAFETY: the kernel holds the memory until the entry is cleared, whatever becomes of the address; see the head of this
    // file.
    unsafe { ring.register_buffers_update(number.into(), &[entry], None) }
}
