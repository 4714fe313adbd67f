//! What every engine that moves page bytes must do.
//!
//! A store moves bytes between buffers and places in numbered segments. It owns the buffer of every transfer in flight
//! and gives every one back with the outcome, also when it fails. It knows no page ids, checksums or generations: those
//! are in the bytes, and [`super`]'s format checks them.
//!
//! Invariants of every implementation: 1. each submitted transfer yields exactly one [`Completion`] with its buffer;
//! 2. a completion without an error moved exactly [`Transfer::bytes`] bytes: short transfers are resumed inside; 3. transfers
//! may finish in any order; two transfers of one place are never in flight together (the caller sees to it); 4. bytes
//! written are durable only after [`PageEngine::sync`] returned without error; after a failed write or sync nothing that
//! was not synced before may be trusted.

use crate::page::engine::buffer::PageBuffer;
use std::io;

/// A place in the store: byte `offset` of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Place {
    /// Number of the segment, from 0.
    pub segment: u32,
    /// First byte; a multiple of [`crate::page::engine::buffer::ALIGNMENT`].
    pub offset: u64,
}

/// Which way bytes go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the store into the buffer.
    Read,
    /// From the buffer into the store.
    Write,
}

/// One movement of bytes.
#[derive(Debug)]
pub struct Transfer {
    /// The caller's name for it.
    pub token: u64,
    /// Which way.
    pub direction: Direction,
    /// Where in the store.
    pub place: Place,
    /// How many bytes, from the start of the buffer; a multiple of [`crate::page::engine::buffer::ALIGNMENT`].
    pub bytes: usize,
    /// The memory.
    pub buffer: PageBuffer,
}

/// The end of a transfer.
#[derive(Debug)]
pub struct Completion {
    /// The transfer, with its buffer.
    pub transfer: Transfer,
    /// How it went.
    pub result: io::Result<()>,
}

/// Moves page bytes. One owner; engines use their own threads or the kernel's.
pub trait PageEngine: Send {
    /// For people: `uring`, `mmap`, `pread`, `memory`.
    fn name(&self) -> &'static str;

    /// Makes segment `segment` exist with `bytes` bytes of space that writes will not run out of; a segment that exists
    /// with that size is left as it is.
    ///
    /// # Errors
    /// No space, or the folder cannot be written.
    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()>;

    /// Whether segment `segment` is there with exactly `bytes` bytes, as it was made. A store that cannot have lost any says
    /// nothing.
    ///
    /// # Errors
    /// It is missing, has another length, or is not a file of this store.
    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        let _ = (segment, bytes);
        Ok(())
    }

    /// Queues a transfer. It may start at once; errors come with its completion.
    fn submit(&mut self, transfer: Transfer);

    /// Moves finished transfers to `done`. With `wait`, blocks until at least one is there, if any is in flight.
    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>);

    /// Transfers submitted whose completion was not taken yet.
    fn in_flight(&self) -> usize;

    /// Makes everything written by completed transfers durable. Call with no write in flight.
    ///
    /// # Errors
    /// The drive reported an error; what was not synced before is lost.
    fn sync(&mut self) -> io::Result<()>;
}
