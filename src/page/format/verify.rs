//! Whether bytes from a slot are the version of the page that a reference names.
//!
//! Invariant: the payload is touched by decoding only after its checksum matched.

use crate::base::ids::PageId;
use crate::page::format::codec;
use crate::page::format::slot_header::{HEADER_BYTES, SlotHeader, SlotRef, StoredAs, checksum};
use crate::page::map::mutants::{Mutant, active};

/// Checks the bytes of a slot: they are version `slot` of `page` in `store`, and nothing in them changed. If they are
/// encoded, decodes them to `payload`, a buffer with header room; raw payloads stay where they are.
///
/// # Errors
/// What does not match, for people.
pub fn verify(
    store: u128,
    page: PageId,
    slot: &SlotRef,
    bytes: &[u8],
    payload: Option<&mut [u8]>,
) -> Result<(), String> {
    let too_short = || "the slot is shorter than the version".to_string();
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
        (_, None) => Err("there is no room to decode it".to_string()),
    }
}

/// The header is that of version `slot` of `page`.
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
        return Err(format!("page {} is there instead", header.page));
    }
    if header.slot.place != slot.place {
        let there = header.slot.place;
        return Err(format!("it was meant for segment {} offset {}", there.segment, there.offset));
    }
    if active(Mutant::SlotGenerationNotVerified) {
        return Ok(());
    }
    if header.slot.generation != slot.generation {
        return Err(format!("generation {} is there instead", header.slot.generation));
    }
    if header.slot != *slot {
        return Err("another version of the page is there instead".to_string());
    }
    Ok(())
}
