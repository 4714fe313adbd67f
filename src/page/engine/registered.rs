//! Buffers registered with an io_uring ring: the kernel looks up and pins their memory once instead of for every
//! request.
//!
//! A long-lived buffer (a frame's) is registered on its first transfer, for as many bytes as the transfer moves,
//! because the kernel allocates all memory that it pins; a longer transfer registers it again. The buffer keeps its
//! index in the ring's table until it is dropped. Pinned memory counts against the limit on locked memory (`ulimit -l`)
//! of users who have one: after a few refusals no more buffers are registered until others are dropped, and
//! unregistered buffers use ordinary requests.
//!
//! Invariants: 1. an index belongs to one buffer of one ring until that buffer is dropped and its entry cleared; 2. the
//! entry of a dropped buffer is cleared when the ring is next used; the kernel then frees the memory (before Linux 6.4
//! about a second later).
//!
//! Safety: the kernel pins the memory itself, not the address: the entry of a dropped buffer names memory that belongs
//! to nobody else. Requests name addresses within the entry's buffer, which their flight owns.
#![allow(unsafe_code)] // the table takes addresses of buffers

use crate::page::engine::buffer::{PageBuffer, Registration};
use io_uring::Submitter;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};

/// Most entries of a table: the kernel's limit.
const ENTRIES: u16 = 1 << 14;

/// Longest buffer that the kernel registers, bytes.
const BYTES_MAX: usize = 1 << 30;
/// Refusals by the kernel before registration pauses.
const REFUSALS_MAX: u32 = 8;

/// The table of registered buffers of one ring.
#[derive(Debug, Default)]
pub struct RegisteredBuffers {
    /// Whether the kernel supports the table.
    is_supported: bool,
    /// Refusals since the kernel last accepted or released a buffer.
    refusals: u32,
    /// Indices handed out so far.
    used: u16,
    /// Handed-out indices that are free again.
    clear: Vec<u16>,
    /// Indices whose buffers were dropped, on any thread.
    ended: Arc<Mutex<Vec<u16>>>,
}

impl RegisteredBuffers {
    /// An empty table for a ring; registers nothing if the kernel has no such tables.
    pub fn of(ring: &Submitter<'_>) -> RegisteredBuffers {
        let is_supported = ring.register_buffers_sparse(ENTRIES.into()).is_ok();
        RegisteredBuffers { is_supported, ..RegisteredBuffers::default() }
    }

    /// Whether the kernel supports the table.
    pub fn is_supported(&self) -> bool {
        self.is_supported
    }

    /// Registered buffers, including dropped ones whose entry is not cleared yet.
    pub fn len(&self) -> usize {
        usize::from(self.used) - self.clear.len()
    }

    /// The index of a buffer whose first `bytes` bytes will move; `None` if they are not registered.
    pub fn number_of(&mut self, ring: &Submitter<'_>, buffer: &mut PageBuffer, bytes: usize) -> Option<u16> {
        self.clear_ended(ring);
        let own = buffer.registration.as_ref().filter(|r| Arc::ptr_eq(&r.ended, &self.ended));
        let own = own.map(|registration| (registration.number, registration.bytes));
        if let Some((number, _)) = own.filter(|&(_, held)| held >= bytes) {
            return Some(number);
        }
        let may_be = self.is_supported && self.refusals < REFUSALS_MAX;
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

    /// Clears the entries of dropped buffers, which frees their memory.
    pub fn clear_ended(&mut self, ring: &Submitter<'_>) {
        let mut ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner);
        // An entry that could not be cleared is tried again next time.
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

/// Sets an entry of the table; an entry without memory clears it.
fn set(ring: &Submitter<'_>, number: u16, entry: libc::iovec) -> io::Result<()> {
    // SAFETY: the kernel pins the memory until the entry is cleared, whatever happens to the address; see the head of
    // this file.
    unsafe { ring.register_buffers_update(number.into(), &[entry], None) }
}
