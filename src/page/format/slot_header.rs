//! The header of a slot, and the reference by which the index names a version of a page.
//!
//! A slot holds [`HEADER_BYTES`] of header, then the stored payload, then zeros up to the next multiple of
//! [`ALIGNMENT`]. The header states the slot's content and its intended place, so that a read or write at a wrong place
//! is detected, and so that the index can be rebuilt from the slots alone. All numbers are little-endian.
//!
//! Invariants: 1. checksums cover every bit of the header and of the padded payload; 2. decoding untrusted bytes
//! neither panics nor allocates by lengths they state; 3. a [`SlotRef`] suffices to tell whether the bytes of a slot
//! are that version of that page.

use crate::base::ids::PageId;
use crate::base::names::names;
use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::Place;
use bytemuck::{Pod, Zeroable};
use xxhash_rust::xxh3::xxh3_128;

#[cfg(target_endian = "big")]
compile_error!("slots are little-endian; nothing was tested on big-endian machines");

/// Bytes before the payload of every slot, and of every frame in memory.
pub const HEADER_BYTES: usize = 4096;
pub const LABEL_BYTES_MAX: usize = 512;
/// Version of the slot layout. A store of a newer version is refused.
pub const FORMAT_VERSION: u32 = 1;
/// Features that a reader must know, one bit each: a store with any other bit is refused. None yet.
pub const KNOWN_FEATURES: u32 = 0;
/// Features that a reader may ignore, one bit each; unknown bits are ignored. None yet.
pub const KNOWN_COMPATIBLE: u32 = 0;

const MAGIC: [u8; 8] = *b"gsscpage";
const CHECKSUM_AT: usize = HEADER_BYTES - 16;
const LABEL_AT: usize = 112;

/// The stored form of a payload. Its number is on the drive, and the place in lists by codec.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StoredAs {
    /// The payload itself.
    Raw,
    /// Bytes shuffled by their position in four-byte words, then one zstd frame.
    ShuffledZstd,
    /// 64-byte lines whose words have empty lower halves, stored as their upper halves.
    Halves,
}

// By number.
names!(StoredAs { Raw = "raw", ShuffledZstd = "shuffled zstd", Halves = "halves" });

/// A [`SlotRef`] on the drive.
#[derive(Clone, Copy, Zeroable, Pod)]
#[repr(C, packed)]
struct SlotRefBytes {
    segment: u32,
    offset: u64,
    stored_bytes: u32,
    payload_bytes: u32,
    generation: u64,
    checksum: u128,
    codec: u8,
}

/// The front of a [`SlotHeader`] on the drive; the label follows at [`LABEL_AT`], the checksum at [`CHECKSUM_AT`].
#[derive(Clone, Copy, Zeroable, Pod)]
#[repr(C, packed)]
struct HeaderFront {
    magic: [u8; 8],
    version: u32,
    features: u32,
    store: u128,
    page: u64,
    serial: u64,
    label_bytes: u16,
    slot: SlotRefBytes,
}

const FRONT_BYTES: usize = size_of::<HeaderFront>();

/// Reference to one version of a page: its place and what its bytes must be. Kept by the index.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SlotRef {
    pub place: Place,
    /// Bytes of the payload as stored, without padding.
    pub stored_bytes: u32,
    /// Bytes of the decoded payload.
    pub payload_bytes: u32,
    /// First generation that may name this version.
    pub generation: u64,
    /// xxh3-128 of the stored, padded payload.
    pub checksum: u128,
    pub codec: StoredAs,
}

impl SlotRef {
    /// Length of the encoded form, bytes.
    pub const ENCODED_BYTES: usize = size_of::<SlotRefBytes>();

    /// Bytes read or written for this version: header, payload, padding.
    pub fn transfer_bytes(&self) -> usize {
        transfer_bytes(self.stored_bytes as usize)
    }

    /// Encodes the reference, for the index on the drive.
    pub fn to_bytes(&self) -> [u8; SlotRef::ENCODED_BYTES] {
        bytemuck::cast(self.to_packed())
    }

    fn to_packed(self) -> SlotRefBytes {
        SlotRefBytes {
            segment: self.place.segment,
            offset: self.place.offset,
            stored_bytes: self.stored_bytes,
            payload_bytes: self.payload_bytes,
            generation: self.generation,
            checksum: self.checksum,
            codec: self.codec as u8,
        }
    }

    /// Decodes [`SlotRef::to_bytes`]; `None` for bytes that it never produces.
    pub fn from_bytes(bytes: &[u8; SlotRef::ENCODED_BYTES]) -> Option<SlotRef> {
        SlotRef::from_packed(bytemuck::cast(*bytes))
    }

    fn from_packed(packed: SlotRefBytes) -> Option<SlotRef> {
        let slot = SlotRef {
            place: Place { segment: packed.segment, offset: packed.offset },
            stored_bytes: packed.stored_bytes,
            payload_bytes: packed.payload_bytes,
            generation: packed.generation,
            checksum: packed.checksum,
            codec: *StoredAs::ALL.get(usize::from(packed.codec))?,
        };
        let lengths_agree = match slot.codec {
            StoredAs::Raw => slot.stored_bytes == slot.payload_bytes,
            _ => slot.stored_bytes < slot.payload_bytes,
        };
        (slot.place.offset.is_multiple_of(ALIGNMENT as u64) && lengths_agree).then_some(slot)
    }
}

/// Bytes read or written for a payload of `stored_bytes`: header, payload, padding.
pub fn transfer_bytes(stored_bytes: usize) -> usize {
    HEADER_BYTES + stored_bytes.next_multiple_of(ALIGNMENT)
}

/// The checksum (xxh3-128) of a stored, padded payload; also used for everything else in a store.
pub fn checksum(bytes: &[u8]) -> u128 {
    xxh3_128(bytes)
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SlotHeader {
    pub store: u128,
    pub page: PageId,
    /// Serial number of the write within the store: of two versions of a page the later one has the higher number.
    /// Exception: a process that ended before its first commit; the next process uses the same numbers again.
    pub serial: u64,
    /// Place, lengths, generation and checksum.
    pub slot: SlotRef,
    /// Opaque to this layer, at most [`LABEL_BYTES_MAX`] bytes: what the layer above needs to rebuild its index entry.
    pub label: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    /// Never written, or overwritten by something else.
    #[error("there is no slot header here")]
    NoHeader,
    /// Bits changed since the write.
    #[error("the checksum of the slot header does not match")]
    Checksum,
    /// Written by a newer program.
    #[error("the slot has format version {found} (features {features:#x}); this program knows {FORMAT_VERSION}")]
    Version {
        found: u32,
        /// Feature bits of the slot.
        features: u32,
    },
    /// The checksum matches, but this program never writes such a header.
    #[error("the slot header has an impossible {0}")]
    Field(&'static str),
}

impl SlotHeader {
    /// Writes the header over the first [`HEADER_BYTES`] of `bytes`. A label longer than [`LABEL_BYTES_MAX`] is cut;
    /// the writer checks the length first.
    pub fn encode(&self, bytes: &mut [u8; HEADER_BYTES]) {
        bytes.fill(0);
        let label = &self.label[..self.label.len().min(LABEL_BYTES_MAX)];
        let front = HeaderFront {
            magic: MAGIC,
            version: FORMAT_VERSION,
            features: KNOWN_FEATURES,
            store: self.store,
            page: self.page.to_bits(),
            serial: self.serial,
            label_bytes: label.len() as u16,
            slot: self.slot.to_packed(),
        };
        bytes[..FRONT_BYTES].copy_from_slice(bytemuck::bytes_of(&front));
        bytes[LABEL_AT..][..label.len()].copy_from_slice(label);
        let sum = checksum(&bytes[..CHECKSUM_AT]);
        bytes[CHECKSUM_AT..].copy_from_slice(&sum.to_le_bytes());
    }

    /// Decodes a header.
    /// Errors: the bytes are not a header of this program's format.
    pub fn decode(bytes: &[u8; HEADER_BYTES]) -> Result<SlotHeader, HeaderError> {
        let front: HeaderFront = bytemuck::pod_read_unaligned(&bytes[..FRONT_BYTES]);
        if front.magic != MAGIC {
            return Err(HeaderError::NoHeader);
        }
        // The checksum comes first: a flipped bit in the version is damage, not a newer program. Every version keeps
        // the checksum in this place.
        if bytes[CHECKSUM_AT..] != checksum(&bytes[..CHECKSUM_AT]).to_le_bytes() {
            return Err(HeaderError::Checksum);
        }
        let (found, features) = (front.version, front.features);
        if found != FORMAT_VERSION || features & !KNOWN_FEATURES != 0 {
            return Err(HeaderError::Version { found, features });
        }
        let page = PageId::from_bits(front.page).ok_or(HeaderError::Field("page id"))?;
        let slot = SlotRef::from_packed(front.slot).ok_or(HeaderError::Field("place, length or codec"))?;
        let label = bytes[LABEL_AT..][..LABEL_BYTES_MAX].get(..usize::from(front.label_bytes));
        let label = label.ok_or(HeaderError::Field("label length"))?.to_vec();
        Ok(SlotHeader { store: front.store, page, serial: front.serial, slot, label })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> SlotHeader {
        let place = Place { segment: 3, offset: 8192 };
        let slot = SlotRef {
            place,
            stored_bytes: 700,
            payload_bytes: 1000,
            generation: 9,
            checksum: u128::MAX / 3,
            codec: StoredAs::ShuffledZstd,
        };
        SlotHeader { store: 77, page: PageId::initial(5), serial: 12, slot, label: vec![0xab; LABEL_BYTES_MAX] }
    }

    /// The bytes of layout version 1. A change of layout must raise the version.
    #[test]
    fn the_layout_of_version_1_is_fixed() {
        let mut bytes = [0; HEADER_BYTES];
        header().encode(&mut bytes);
        assert_eq!(&bytes[..16], b"gsscpage\x01\0\0\0\0\0\0\0");
        assert_eq!((bytes[16], bytes[36], bytes[40], &bytes[48..50]), (77, 5, 12, [0, 2].as_slice()));
        assert_eq!((bytes[50], u16::from_le_bytes([bytes[54], bytes[55]])), (3, 8192));
        assert_eq!((bytes[LABEL_AT], bytes[LABEL_AT + 511], bytes[LABEL_AT + 512]), (0xab, 0xab, 0));
    }

    #[test]
    fn newer_versions_are_refused_by_name() {
        let mut bytes = [0; HEADER_BYTES];
        for (at, value, message) in [(8, 2, "format version 2 (features 0x0)"), (12, 4, "(features 0x4)")] {
            header().encode(&mut bytes);
            bytes[at] = value;
            let sum = checksum(&bytes[..CHECKSUM_AT]);
            bytes[CHECKSUM_AT..].copy_from_slice(&sum.to_le_bytes());
            let error = SlotHeader::decode(&bytes).expect_err("a newer slot was read");
            assert!(error.to_string().contains(message) && error.to_string().contains("knows 1"), "{error}");
        }
    }

    #[test]
    fn references_round_trip_and_impossible_ones_are_refused() {
        let slot = header().slot;
        assert_eq!(SlotRef::from_bytes(&slot.to_bytes()), Some(slot));
        let raw = SlotRef { codec: StoredAs::Raw, stored_bytes: 1000, ..slot };
        assert_eq!(SlotRef::from_bytes(&raw.to_bytes()), Some(raw));
        for wrong in [
            SlotRef { stored_bytes: 1000, ..slot },
            SlotRef { codec: StoredAs::Raw, ..slot },
            SlotRef { place: Place { segment: 0, offset: 4097 }, ..slot },
        ] {
            assert_eq!(SlotRef::from_bytes(&wrong.to_bytes()), None);
        }
        let mut bytes = slot.to_bytes();
        bytes[SlotRef::ENCODED_BYTES - 1] = 3;
        assert_eq!((SlotRef::from_bytes(&bytes), bytes.len()), (None, 45));
    }
}
