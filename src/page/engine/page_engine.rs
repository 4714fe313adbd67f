//! The contract of an I/O engine.
//!
//! An engine moves bytes between buffers and places in numbered segments. It owns the buffer of every transfer in
//! flight and returns each one with the outcome, also on failure. It knows no page ids, checksums or generations: those
//! are in the bytes, and `page::format` checks them.
//!
//! Invariants of every implementation: 1. each submitted transfer yields exactly one [`Completion`] with its buffer;
//! 2. a completion without an error moved exactly [`Transfer::bytes`] bytes: the engine resumes short transfers; 3.
//! transfers complete in any order; the caller never has two transfers of one place in flight; 4. written bytes are
//! durable only after [`PageEngine::sync`] returned without error; after a failed write or sync, nothing unsynced may
//! be trusted.

use crate::page::engine::buffer::PageBuffer;
use std::io;

/// A place in a store: byte `offset` of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Place {
    /// Number of the segment, from 0.
    pub segment: u32,
    /// First byte; a multiple of [`crate::page::engine::buffer::ALIGNMENT`].
    pub offset: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the store into the buffer.
    Read,
    /// From the buffer into the store.
    Write,
}

/// One transfer between a buffer and a place.
#[derive(Debug)]
pub struct Transfer {
    /// An identifier chosen by the caller.
    pub token: u64,
    pub direction: Direction,
    pub place: Place,
    /// Number of bytes, from the start of the buffer; a multiple of [`crate::page::engine::buffer::ALIGNMENT`].
    pub bytes: usize,
    pub buffer: PageBuffer,
}

/// A finished transfer.
#[derive(Debug)]
pub struct Completion {
    pub transfer: Transfer,
    pub result: io::Result<()>,
}

/// Moves page bytes. Has one owner; engines use threads of their own or of the kernel.
pub trait PageEngine: Send {
    /// Name for messages: `uring`, `mmap`, `pread`, `memory`.
    fn name(&self) -> &'static str;

    /// Creates segment `segment` with `bytes` bytes of allocated space, so that writes into it cannot run out of space.
    /// An existing segment of that size stays unchanged.
    /// Errors: no space, or the folder cannot be written.
    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()>;

    /// Checks that segment `segment` exists with exactly `bytes` bytes. An engine that cannot lose segments always
    /// succeeds.
    /// Errors: the segment is missing, has another length, or is not a file of this store.
    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        let _ = (segment, bytes);
        Ok(())
    }

    /// Queues a transfer. It may start at once; errors come with its completion.
    fn submit(&mut self, transfer: Transfer);

    /// Moves finished transfers to `done`. With `wait`, blocks until at least one has finished, if any is in flight.
    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>);

    /// Submitted transfers whose completion has not been collected.
    fn in_flight(&self) -> usize;

    /// Makes the writes of completed transfers durable. No write may be in flight.
    /// Errors: the drive reported an error; unsynced writes are lost.
    fn sync(&mut self) -> io::Result<()>;
}
