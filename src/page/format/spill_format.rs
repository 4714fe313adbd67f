//! The `FORMAT` file of a spill directory: the store's identity, the format version, the sizes of its slots.
//!
//! Written once. Invariants: 1. a checksum covers every bit, in the same place in all versions, so that damage is
//! distinct from a newer version; 2. impossible sizes are refused; 3. another version and an unknown incompatible
//! feature are refused by name; unknown compatible features are ignored.

use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::Place;
use crate::page::format::slot_header::{FORMAT_VERSION, HEADER_BYTES, KNOWN_FEATURES, checksum, transfer_bytes};
use bytemuck::{Pod, Zeroable};

/// Length of the file.
pub const FORMAT_BYTES: usize = 256;
const CHECKSUM_AT: usize = FORMAT_BYTES - 16;
const MAGIC: [u8; 8] = *b"gsscdir\n";
/// The kind of all stores.
const KIND: u8 = 1;

/// Target size of a segment, bytes; segments of small scenes are smaller.
const SEGMENT_BYTES: u64 = 256 << 20;
/// Largest slot, bytes: the length of a payload is a 32-bit number.
const SLOT_BYTES_MAX: u64 = HEADER_BYTES as u64 + (1 << 32);
/// Target number of segments of a scene: each costs a file descriptor.
const SEGMENTS: u64 = 64;

/// The front of the file, zeros up to the checksum.
#[derive(Clone, Copy, Zeroable, Pod)]
#[repr(C, packed)]
struct Front {
    magic: [u8; 8],
    version: u32,
    incompatible: u32,
    store: u128,
    slot_bytes: u64,
    slots_per_segment: u32,
    /// 1: the pages are a checkpoint. No program writes another value.
    kind: u8,
    unused: [u8; 3],
    compatible: u32,
}

/// Sizes that are fixed for the life of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotLayout {
    /// Bytes of a slot; a multiple of [`ALIGNMENT`].
    pub slot_bytes: u64,
    /// Slots in a segment, at least 1.
    pub slots_per_segment: u32,
}

impl SlotLayout {
    /// Slots for payloads of at most `capacity_bytes`, in segments that suit a scene of about `pages` pages: about 256
    /// MiB, less for a smaller scene, more where a scene would need too many files.
    pub fn new(capacity_bytes: usize, pages: u64) -> SlotLayout {
        let slot_bytes = transfer_bytes(capacity_bytes) as u64;
        let usual = (SEGMENT_BYTES / slot_bytes).min(pages);
        let slots = usual.max(pages / SEGMENTS).clamp(1, u64::from(u32::MAX));
        SlotLayout { slot_bytes, slots_per_segment: slots as u32 }
    }

    pub fn segment_bytes(&self) -> u64 {
        self.slot_bytes * u64::from(self.slots_per_segment)
    }

    pub fn place(&self, slot: u64) -> Place {
        let per = u64::from(self.slots_per_segment);
        Place { segment: (slot / per) as u32, offset: slot % per * self.slot_bytes }
    }

    /// Number of the slot at `place`; `None` if no slot starts there.
    pub fn slot(&self, place: Place) -> Option<u64> {
        let begins = place.offset.is_multiple_of(self.slot_bytes) && place.offset < self.segment_bytes();
        begins.then(|| u64::from(place.segment) * u64::from(self.slots_per_segment) + place.offset / self.slot_bytes)
    }

    /// Whether a store can have these sizes: aligned, not empty, no larger than the longest payload, segments
    /// addressable.
    pub fn is_possible(&self) -> bool {
        self.slot_bytes > ALIGNMENT as u64
            && self.slot_bytes <= SLOT_BYTES_MAX
            && self.slot_bytes.is_multiple_of(ALIGNMENT as u64)
            && self.slots_per_segment > 0
            && self.slot_bytes.checked_mul(u64::from(self.slots_per_segment)).is_some_and(|b| b <= i64::MAX as u64)
    }
}

/// Content of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpillFormat {
    /// Identity of the store, also in every slot.
    pub store: u128,
    /// Sizes of slots and segments.
    pub layout: SlotLayout,
    /// Feature bits that a reader may ignore.
    pub compatible: u32,
}

/// Why bytes are not a FORMAT file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FormatError {
    /// Some other file.
    #[error("it is not the FORMAT file of a spill directory")]
    Foreign,
    /// Bits have changed or are missing.
    #[error("its checksum does not match: it is damaged or cut short")]
    Damaged,
    /// Written by a program of another version.
    #[error(
        "it has a{} format version {found} (features {features:#x});\n  \
         this program knows version {FORMAT_VERSION} (features {KNOWN_FEATURES:#x})",
        if *.found > FORMAT_VERSION { " newer" } else { "n older" }
    )]
    Version {
        /// Its version.
        found: u32,
        /// Its incompatible feature bits.
        features: u32,
    },
    /// This version, but with features that this program does not know.
    #[error(
        "it has features that this program does not know (bits {:#x})",
        .features & !KNOWN_FEATURES
    )]
    Features {
        /// Its incompatible feature bits.
        features: u32,
    },
    /// The checksum matches, but no program of this version writes such sizes.
    #[error("it has impossible sizes")]
    Sizes,
}

impl SpillFormat {
    /// Encodes the file.
    pub fn to_bytes(&self) -> [u8; FORMAT_BYTES] {
        let front = Front {
            magic: MAGIC,
            version: FORMAT_VERSION,
            incompatible: KNOWN_FEATURES,
            store: self.store,
            slot_bytes: self.layout.slot_bytes,
            slots_per_segment: self.layout.slots_per_segment,
            kind: KIND,
            unused: [0; 3],
            compatible: self.compatible,
        };
        let mut bytes = [0; FORMAT_BYTES];
        bytes[..size_of::<Front>()].copy_from_slice(bytemuck::bytes_of(&front));
        seal(&mut bytes);
        bytes
    }

    /// Decodes the file.
    /// Errors: the bytes are not a FORMAT file of this version.
    pub fn from_bytes(bytes: &[u8]) -> Result<SpillFormat, FormatError> {
        let front = front_of(bytes)?;
        let (found, features) = (front.version, front.incompatible);
        if found != FORMAT_VERSION {
            return Err(FormatError::Version { found, features });
        }
        if features & !KNOWN_FEATURES != 0 {
            return Err(FormatError::Features { features });
        }
        let layout = SlotLayout { slot_bytes: front.slot_bytes, slots_per_segment: front.slots_per_segment };
        if front.kind != KIND || !layout.is_possible() {
            return Err(FormatError::Sizes);
        }
        Ok(SpillFormat { store: front.store, layout, compatible: front.compatible })
    }
}

/// The front of the file, if its length, magic and checksum are right.
fn front_of(bytes: &[u8]) -> Result<Front, FormatError> {
    if !bytes.starts_with(&MAGIC) {
        return Err(FormatError::Foreign);
    }
    let is_whole = bytes.len() == FORMAT_BYTES && bytes[CHECKSUM_AT..] == checksum(&bytes[..CHECKSUM_AT]).to_le_bytes();
    if is_whole { Ok(bytemuck::pod_read_unaligned(&bytes[..size_of::<Front>()])) } else { Err(FormatError::Damaged) }
}

fn seal(bytes: &mut [u8; FORMAT_BYTES]) {
    let sum = checksum(&bytes[..CHECKSUM_AT]);
    bytes[CHECKSUM_AT..].copy_from_slice(&sum.to_le_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_fit_the_scene() {
        let capacity = 745_472;
        let small = SlotLayout::new(capacity, 10);
        assert_eq!((small.slots_per_segment, small.slot_bytes), (10, 4096 + 745_472));
        let usual = SlotLayout::new(capacity, 20_000);
        assert!(usual.segment_bytes() <= 256 << 20 && usual.segment_bytes() > 255 << 20);
        let huge = SlotLayout::new(capacity, 1_000_000);
        assert!(1_000_000_u64.div_ceil(u64::from(huge.slots_per_segment)) <= SEGMENTS + 1);
        assert_eq!(SlotLayout::new(1, 0).slots_per_segment, 1);
        for layout in [small, usual, huge] {
            assert!(layout.is_possible());
            for slot in [0, 1, 349, 350, 999_999] {
                assert_eq!(layout.slot(layout.place(slot)), Some(slot));
            }
        }
        assert_eq!(usual.slot(Place { segment: 0, offset: 4096 }), None);
        assert_eq!(usual.slot(Place { segment: 0, offset: usual.segment_bytes() }), None);
        let largest = SlotLayout { slot_bytes: SLOT_BYTES_MAX, slots_per_segment: 1 };
        assert!(largest.is_possible() && largest.slot_bytes == transfer_bytes(u32::MAX as usize) as u64);
        let wrong = [(0, 1), (4096, 1), (8193, 1), (8192, 0), (1 << 62, 4), (1 << 62, 1), (SLOT_BYTES_MAX + 4096, 1)];
        assert!(wrong.iter().all(|&(slot_bytes, n)| !SlotLayout { slot_bytes, slots_per_segment: n }.is_possible()));
    }

    fn sample() -> SpillFormat {
        SpillFormat { store: 1 << 100, layout: SlotLayout::new(745_472, 1000), compatible: 0 }
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_found() {
        let bytes = sample().to_bytes();
        assert_eq!(SpillFormat::from_bytes(&bytes), Ok(sample()));
        for bit in 0..FORMAT_BYTES * 8 {
            let mut flipped = bytes;
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(matches!(SpillFormat::from_bytes(&flipped), Err(FormatError::Foreign | FormatError::Damaged)));
        }
        assert!((0..FORMAT_BYTES).all(|cut| SpillFormat::from_bytes(&bytes[..cut]).is_err()));
        assert!(SpillFormat::from_bytes(&[bytes.as_slice(), &[0]].concat()).is_err());
    }

    fn with(at: usize, value: u8) -> [u8; FORMAT_BYTES] {
        let mut bytes = sample().to_bytes();
        bytes[at] = value;
        seal(&mut bytes);
        bytes
    }

    #[test]
    fn newer_versions_and_impossible_sizes_are_refused() {
        let changed = |at: usize, value: u8| SpillFormat::from_bytes(&with(at, value)).expect_err("read");
        assert_eq!(changed(8, 2), FormatError::Version { found: 2, features: KNOWN_FEATURES });
        assert_eq!(changed(8, 0), FormatError::Version { found: 0, features: KNOWN_FEATURES });
        assert_eq!(changed(15, 0x80), FormatError::Features { features: 1 << 31 | KNOWN_FEATURES });
        assert!(changed(8, 2).to_string().contains("newer") && changed(8, 0).to_string().contains("older"));
        assert!(changed(15, 5).to_string().contains("bits 0x5000000"));
        assert_eq!(changed(32, 1), FormatError::Sizes);
        assert_eq!(changed(39, 0x7f), FormatError::Sizes);
        assert_eq!([changed(44, 0), changed(44, 2)], [FormatError::Sizes, FormatError::Sizes]);
    }
}
