//! Verifies that the bytes of a slot are the version that a reference names.
//!
//! Invariant: a payload is decoded only after its checksum matched.

use crate::base::ids::PageId;
use crate::page::format::codec;
use crate::page::format::slot_header::{HEADER_BYTES, SlotHeader, SlotRef, StoredAs, checksum};
use crate::page::mutants::{Mutant, active};

/// Verifies that the bytes of a slot are version `slot` of `page` in `store`, unchanged. Decodes an encoded payload to
/// `payload`, a buffer with header room; a raw payload stays where it is.
/// Errors: the mismatch, as text for users.
pub fn verify(
    store: u128,
    page: PageId,
    slot: &SlotRef,
    bytes: &[u8],
    payload: Option<&mut [u8]>,
) -> Result<(), String> {
    let too_short = || "the slot is shorter than the version it should hold".to_string();
    let (header, stored) = bytes.split_first_chunk::<HEADER_BYTES>().ok_or_else(too_short)?;
    let header = SlotHeader::decode(header).map_err(|e| e.to_string())?;
    if !active(Mutant::SlotIdentityNotVerified) {
        verify_identity(store, page, slot, &header)?;
    }
    let stored = stored.get(..slot.transfer_bytes() - HEADER_BYTES).ok_or_else(too_short)?;
    let trusts_header = active(Mutant::SlotIdentityNotVerified) || active(Mutant::SlotGenerationNotVerified);
    let expected = if trusts_header { header.slot.checksum } else { slot.checksum };
    if checksum(stored) != expected && !active(Mutant::PayloadNotVerified) {
        return Err("the checksum of the payload does not match".to_string());
    }
    match (slot.codec, payload) {
        (StoredAs::Raw, _) => Ok(()),
        (codec, Some(payload)) => {
            let stored = &stored[..slot.stored_bytes as usize];
            let payload = payload.get_mut(HEADER_BYTES..).and_then(|p| p.get_mut(..slot.payload_bytes as usize));
            codec::decode(stored, codec, payload.ok_or_else(too_short)?).map_err(|e| e.to_string())
        }
        (_, None) => Err("there is no buffer to decode it into".to_string()),
    }
}

/// Verifies that the header is that of version `slot` of `page`.
pub(in crate::page) fn verify_identity(
    store: u128,
    page: PageId,
    slot: &SlotRef,
    header: &SlotHeader,
) -> Result<(), String> {
    if header.store != store {
        return Err("it belongs to another store".to_string());
    }
    if header.page != page {
        return Err(format!("it holds page {} instead", header.page));
    }
    if header.slot.place != slot.place {
        let there = header.slot.place;
        return Err(format!("its header names another place: segment {} offset {}", there.segment, there.offset));
    }
    if active(Mutant::SlotGenerationNotVerified) {
        return Ok(());
    }
    if header.slot.generation != slot.generation {
        return Err(format!("it holds generation {} instead", header.slot.generation));
    }
    if header.slot != *slot {
        return Err("it holds another version of the page".to_string());
    }
    Ok(())
}
