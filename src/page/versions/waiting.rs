//! A version of a page between its acceptance and its first byte on the drive: made into what will be stored.
//!
//! Not here: the slot's header, which takes its number when the write is handed to the engine.
//!
//! Invariant: the payload stays as it is; what is encoded goes to a buffer of its own.

use crate::base::ids::PageId;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::codec::{self, Codec};
use crate::page::format::slot_header::{HEADER_BYTES, SlotRef, StoredAs, checksum};

/// A write that waits to be encoded and checksummed.
#[derive(Debug)]
pub(in crate::page) struct Waiting {
    pub token: u64,
    pub page: PageId,
    pub slot: SlotRef,
    pub label: Vec<u8>,
    pub payload: PageBuffer,
    /// For the encoded form.
    pub staging: Option<PageBuffer>,
}

impl Waiting {
    /// Encodes, pads with zeros and checksums what will be stored; sets codec, stored bytes and checksum of the slot.
    pub fn seal(&mut self, codec: Codec) {
        let slot = &mut self.slot;
        if let Some(staging) = &mut self.staging {
            let payload = &self.payload.as_slice()[HEADER_BYTES..][..slot.payload_bytes as usize];
            // What cannot be encoded for whatever reason is stored raw.
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
