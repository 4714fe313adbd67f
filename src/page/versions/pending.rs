//! Reads and writes on their way, and their results; prepares an accepted version for writing: encodes, pads and
//! checksums it.
//!
//! The slot's header is written elsewhere: it gets its serial number when the write is submitted to the engine.
//!
//! Invariant: the payload stays unchanged; the encoded form goes to a staging buffer.

use crate::base::ids::PageId;
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::page_engine::Direction;
use crate::page::format::codec::{self, Codec};
use crate::page::format::slot_header::{HEADER_BYTES, SlotRef, checksum};
use crate::page::versions::page_error::{PageError, SlotName};

/// What a successful transfer did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PageMoved {
    /// The payload is in the buffer, behind its [`crate::page::format::slot_header::HEADER_BYTES`] of header room.
    Read {
        /// Bytes of the payload.
        payload_bytes: usize,
    },
    /// The version is in this slot; durable after the next [`crate::page::versions::paged_store::PagedStore::sync`].
    Written(SlotRef),
}

/// A finished read or write.
#[derive(Debug)]
pub struct PageDone {
    /// An identifier chosen by the caller.
    pub token: u64,
    pub page: PageId,
    /// The caller's buffer. After a write it holds the payload unchanged; after a failed read, garbage.
    pub buffer: PageBuffer,
    pub result: Result<PageMoved, PageError>,
}

/// Bytes moved, headers and padding included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PageTraffic {
    pub bytes_read: u64,
    pub bytes_written: u64,
    /// Payload bytes of the pages written.
    pub payload_bytes_written: u64,
    /// Reads that were repeated.
    pub reads_repeated: u64,
}

/// A transfer in flight.
#[derive(Debug)]
pub(in crate::page) struct Pending {
    pub token: u64,
    pub page: PageId,
    pub slot: SlotRef,
    pub direction: Direction,
    /// Whether this is the second and last attempt of a read.
    pub is_repeated: bool,
    /// The caller's buffer, while a staging buffer carries the encoded form.
    pub payload: Option<PageBuffer>,
}

impl Pending {
    pub fn name(&self) -> SlotName {
        SlotName { page: self.page, place: self.slot.place, generation: self.slot.generation }
    }

    pub fn end(self, buffer: PageBuffer, result: Result<PageMoved, PageError>) -> PageDone {
        PageDone { token: self.token, page: self.page, buffer, result }
    }
}

/// A write waiting to be encoded and checksummed.
#[derive(Debug)]
pub(in crate::page) struct Waiting {
    pub pending: Pending,
    pub label: Vec<u8>,
    /// The caller's buffer, or the staging buffer that receives the encoded form.
    pub buffer: PageBuffer,
}

impl Waiting {
    /// Encodes, zero-pads and checksums the payload; sets codec, stored length and checksum in the slot reference.
    pub fn seal(&mut self, codec: Codec) {
        let Pending { slot, payload, .. } = &mut self.pending;
        if let Some(caller) = payload {
            let bytes = &caller.as_slice()[HEADER_BYTES..][..slot.payload_bytes as usize];
            match codec::encode_as(codec, bytes, &mut self.buffer.as_mut_slice()[HEADER_BYTES..]) {
                Ok(Some((stored_bytes, stored_as))) => {
                    (slot.stored_bytes, slot.codec) = (stored_bytes as u32, stored_as);
                }
                // A payload that fails to encode for any reason is stored raw, from the caller's buffer.
                _ => std::mem::swap(caller, &mut self.buffer),
            }
        }
        let stored = &mut self.buffer.as_mut_slice()[HEADER_BYTES..slot.transfer_bytes()];
        stored[slot.stored_bytes as usize..].fill(0);
        slot.checksum = checksum(stored);
    }
}
