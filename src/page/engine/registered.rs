//! Buffers that the kernel's ring knows beforehand: their memory is looked up and held once, not for every request.
//!
//! A buffer that stays (a frame's) is registered when it first moves, as far as bytes of it move, since the kernel takes all
//! that it holds from the machine; it is registered again when more of it moves. It keeps its number in the ring's table as
//! long as it lives, and is taken out of the table after its end. What the kernel holds counts against the limit on locked
//! memory (`ulimit -l`) of whoever is bound by it: after a few refusals no more buffers are offered until others have ended,
//! and those without a number move by requests that name their memory.
//!
//! Invariants: 1. a number belongs to one buffer of one ring until that buffer has ended and its entry was cleared; 2. the
//! kernel is told of a buffer that has ended when the ring is used next. It lets go of the memory then (Linux before 6.4:
//! about a second later).
//!
//! Safety: the kernel takes hold of the memory itself, not of the address: an entry whose buffer has ended names memory that
//! nobody else has. Requests name addresses within the entry's buffer, which their flight owns.
#![allow(unsafe_code)] // the table takes addresses of buffers

use crate::page::engine::buffer::PageBuffer;
use io_uring::Submitter;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};

/// Most entries of a table: the kernel's own limit.
const ENTRIES: u16 = 1 << 14;

/// Longest buffer that the kernel registers, bytes.
const BYTES_MAX: usize = 1 << 30;
/// Buffers that the kernel may refuse before no more are offered.
const REFUSALS_MAX: u32 = 8;

/// Numbers whose buffers have ended, on whatever thread.
type Ended = Arc<Mutex<Vec<u16>>>;

/// A buffer's place in the table of one ring; given up when it is dropped.
#[derive(Debug)]
pub struct Registration {
    number: u16,
    /// Bytes that the kernel holds, from the start.
    bytes: usize,
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
    /// Whether the kernel gave a table.
    is_there: bool,
    /// Buffers that it refused since it last took or let go of one.
    refusals: u32,
    /// Entries that were used so far.
    used: u16,
    /// Of these, entries that are clear.
    clear: Vec<u16>,
    ended: Ended,
}

impl RegisteredBuffers {
    /// An empty table for a ring; one that takes nothing where the kernel knows no such tables.
    pub fn of(ring: &Submitter<'_>) -> RegisteredBuffers {
        let is_there = ring.register_buffers_sparse(ENTRIES.into()).is_ok();
        RegisteredBuffers { is_there, ..RegisteredBuffers::default() }
    }

    /// Whether the kernel gave a table.
    pub fn is_there(&self) -> bool {
        self.is_there
    }

    /// Buffers that are registered, those that have just ended included.
    pub fn len(&self) -> usize {
        usize::from(self.used) - self.clear.len()
    }

    /// The number of a buffer whose first `bytes` bytes will move; `None` where these are not registered.
    pub fn number_of(&mut self, ring: &Submitter<'_>, buffer: &mut PageBuffer, bytes: usize) -> Option<u16> {
        self.clear_ended(ring);
        let own = buffer.registration.as_ref().filter(|r| Arc::ptr_eq(&r.ended, &self.ended));
        let own = own.map(|registration| (registration.number, registration.bytes));
        if let Some((number, _)) = own.filter(|&(_, held)| held >= bytes) {
            return Some(number);
        }
        let may_be = self.is_there && self.refusals < REFUSALS_MAX;
        if !may_be || !buffer.is_mapped() || bytes > BYTES_MAX.min(buffer.len()) {
            return None;
        }
        let unused = || (self.used < ENTRIES).then_some(self.used);
        let number = own.map(|(number, _)| number).or_else(|| self.clear.pop()).or_else(unused)?;
        self.used = self.used.max(number + 1);
        let entry = libc::iovec { iov_base: buffer.as_mut_slice().as_mut_ptr().cast(), iov_len: bytes };
        if set(ring, number, entry).is_err() {
            self.refusals += 1;
            if own.is_none() {
                self.clear.push(number);
            }
            return None;
        }
        self.refusals = 0;
        match &mut buffer.registration {
            Some(registration) if own.is_some() => registration.bytes = bytes,
            other => *other = Some(Registration { number, bytes, ended: Arc::clone(&self.ended) }),
        }
        Some(number)
    }

    /// Lets go of the memory of buffers that have ended.
    pub fn clear_ended(&mut self, ring: &Submitter<'_>) {
        let mut ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner);
        // What could not be cleared is tried again the next time.
        ended.retain(|&number| {
            let nothing = libc::iovec { iov_base: std::ptr::null_mut(), iov_len: 0 };
            let is_clear = set(ring, number, nothing).is_ok();
            if is_clear {
                self.clear.push(number);
                self.refusals = 0;
            }
            !is_clear
        });
    }
}

/// Puts an entry into the table; one without memory clears it.
fn set(ring: &Submitter<'_>, number: u16, entry: libc::iovec) -> io::Result<()> {
    // SAFETY: the kernel holds the memory until the entry is cleared, whatever becomes of the address; see the head of this
    // file.
    unsafe { ring.register_buffers_update(number.into(), &[entry], None) }
}
