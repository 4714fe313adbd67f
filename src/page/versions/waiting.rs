//! Prepares an accepted version for writing: encodes, pads and checksums it.
//!
//! The slot's header is written elsewhere: it gets its serial number when the write is submitted to the engine.
//!
//! Invariant: the payload stays unchanged; the encoded form goes to a staging buffer.

use crate::base::ids::PageId;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::codec::{self, Codec};
use crate::page::format::slot_header::{HEADER_BYTES, SlotRef, StoredAs, checksum};

/// A write waiting to be encoded and checksummed.
#[derive(Debug)]
pub(in crate::page) struct Waiting {
    pub token: u64,
    pub page: PageId,
    pub slot: SlotRef,
    pub label: Vec<u8>,
    pub payload: PageBuffer,
    /// Receives the encoded form.
    pub staging: Option<PageBuffer>,
}

impl Waiting {
    /// Encodes, zero-pads and checksums the payload; sets codec, stored length and checksum in the slot reference.
    pub fn seal(&mut self, codec: Codec) {
        let slot = &mut self.slot;
        if let Some(staging) = &mut self.staging {
            let payload = &self.payload.as_slice()[HEADER_BYTES..][..slot.payload_bytes as usize];
            // A payload that fails to encode for any reason is stored raw.
            if let Ok(Some((bytes, stored_as))) =
                codec::encode_as(codec, payload, &mut staging.as_mut_slice()[HEADER_BYTES..])
            {
                slot.stored_bytes = bytes as u32;
                slot.codec = stored_as;
            }
        }
        let buffer = match (slot.codec, &mut self.staging) {
            (StoredAs::Raw, _) | (_, None) => &mut self.payload,
            (_, Some(staging)) => staging,
        };
        let stored = &mut buffer.as_mut_slice()[HEADER_BYTES..slot.transfer_bytes()];
        stored[slot.stored_bytes as usize..].fill(0);
        slot.checksum = checksum(stored);
    }
}
