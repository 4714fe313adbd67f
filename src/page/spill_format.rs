//! The `FORMAT` file of a spill directory: whose it is, which program may read it, the sizes of its slots.
//!
//! Written once. Invariants: 1. every bit is under a checksum, whose place is the same in all versions, so that damage
//! is told from a newer version; 2. sizes that no store can have are refused.

use super::format::{FORMAT_VERSION, KNOWN_FEATURES, checksum};
use super::slots::SlotLayout;

/// Length of the file.
pub const FORMAT_BYTES: usize = 256;
const CHECKSUM_AT: usize = FORMAT_BYTES - 16;
const MAGIC: [u8; 8] = *b"gsscdir\n";

/// What becomes of the pages after the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Nothing: removed at a clean end, of no use after any other.
    Scratch,
    /// They are the checkpoint.
    Checkpoint,
}

/// What the file says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpillFormat {
    /// Identity of the store, in every slot as well.
    pub store: u128,
    /// What becomes of it.
    pub purpose: Purpose,
    /// Sizes of slots and segments.
    pub layout: SlotLayout,
}

/// Why bytes are not such a file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FormatError {
    /// Something else.
    #[error("it is not the FORMAT file of a spill directory")]
    Foreign,
    /// Bits changed or are missing.
    #[error("its checksum does not match: it is damaged or cut short")]
    Damaged,
    /// Written by a newer program.
    #[error(
        "it has format version {found} (features {features:#x}); this program knows version {FORMAT_VERSION} (features {KNOWN_FEATURES:#x})"
    )]
    Version {
        /// Its version.
        found: u32,
        /// Its feature bits.
        features: u32,
    },
    /// The checksum matches, but no program of this version writes it.
    #[error("it has impossible sizes")]
    Sizes,
}

impl SpillFormat {
    /// As the bytes of the file.
    pub fn to_bytes(&self) -> [u8; FORMAT_BYTES] {
        let mut bytes = [0; FORMAT_BYTES];
        bytes[..8].copy_from_slice(&MAGIC);
        bytes[8..12].copy_from_slice(&FORMAT_VERSION.to_le_bytes());
        bytes[12..16].copy_from_slice(&KNOWN_FEATURES.to_le_bytes());
        bytes[16..32].copy_from_slice(&self.store.to_le_bytes());
        bytes[32..40].copy_from_slice(&self.layout.slot_bytes.to_le_bytes());
        bytes[40..44].copy_from_slice(&self.layout.slots_per_segment.to_le_bytes());
        bytes[44] = u8::from(self.purpose == Purpose::Checkpoint);
        seal(&mut bytes);
        bytes
    }

    /// From the bytes of the file.
    ///
    /// # Errors
    /// They are not such a file of this version.
    pub fn from_bytes(bytes: &[u8]) -> Result<SpillFormat, FormatError> {
        if !bytes.starts_with(&MAGIC) {
            return Err(FormatError::Foreign);
        }
        let bytes: &[u8; FORMAT_BYTES] = bytes.try_into().map_err(|_| FormatError::Damaged)?;
        if bytes[CHECKSUM_AT..] != checksum(&bytes[..CHECKSUM_AT]).to_le_bytes() {
            return Err(FormatError::Damaged);
        }
        let (found, features) = (u32::from_le_bytes(field(bytes, 8)), u32::from_le_bytes(field(bytes, 12)));
        if found != FORMAT_VERSION || features & !KNOWN_FEATURES != 0 {
            return Err(FormatError::Version { found, features });
        }
        let layout = SlotLayout {
            slot_bytes: u64::from_le_bytes(field(bytes, 32)),
            slots_per_segment: u32::from_le_bytes(field(bytes, 40)),
        };
        let purpose = match bytes[44] {
            0 => Purpose::Scratch,
            1 => Purpose::Checkpoint,
            _ => return Err(FormatError::Sizes),
        };
        if !layout.is_possible() {
            return Err(FormatError::Sizes);
        }
        Ok(SpillFormat { store: u128::from_le_bytes(field(bytes, 16)), purpose, layout })
    }
}

fn seal(bytes: &mut [u8; FORMAT_BYTES]) {
    let sum = checksum(&bytes[..CHECKSUM_AT]);
    bytes[CHECKSUM_AT..].copy_from_slice(&sum.to_le_bytes());
}

fn field<const N: usize>(bytes: &[u8; FORMAT_BYTES], at: usize) -> [u8; N] {
    let mut field = [0; N];
    field.copy_from_slice(&bytes[at..at + N]);
    field
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test
mod tests {
    use super::*;

    fn sample() -> SpillFormat {
        SpillFormat { store: 1 << 100, purpose: Purpose::Checkpoint, layout: SlotLayout::new(745_472, 1000) }
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

    #[test]
    fn newer_versions_and_impossible_sizes_are_refused() {
        let changed = |at: usize, value: u8| {
            let mut bytes = sample().to_bytes();
            bytes[at] = value;
            seal(&mut bytes);
            SpillFormat::from_bytes(&bytes).expect_err("read")
        };
        assert_eq!(changed(8, 2), FormatError::Version { found: 2, features: 0 });
        assert_eq!(changed(12, 1), FormatError::Version { found: 1, features: 1 });
        assert!(
            changed(8, 2).to_string().contains("version 2") && changed(8, 2).to_string().contains("knows version 1")
        );
        assert_eq!(changed(32, 1), FormatError::Sizes);
        assert_eq!(changed(39, 0x7f), FormatError::Sizes);
        assert_eq!(changed(44, 2), FormatError::Sizes);
    }
}
