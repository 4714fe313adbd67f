//! The `FORMAT` file of a spill directory: the store's identity, the format version, the sizes of its slots.
//!
//! Written once. Invariants: 1. a checksum covers every bit, in the same place in all versions, so that damage is
//! distinct from a newer version; 2. impossible sizes are refused; 3. another version and an unknown incompatible
//! feature are refused by name; unknown compatible features are ignored.

use crate::page::format::slot_header::{FORMAT_VERSION, KNOWN_COMPATIBLE, KNOWN_FEATURES, checksum};
use crate::page::versions::slots::SlotLayout;

/// Length of the file.
pub const FORMAT_BYTES: usize = 256;
const CHECKSUM_AT: usize = FORMAT_BYTES - 16;
const MAGIC: [u8; 8] = *b"gsscdir\n";
const COMPATIBLE_AT: usize = 48;

/// What happens to the pages after the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Removed at a clean end, useless after any other.
    Scratch,
    /// The pages are the checkpoint.
    Checkpoint,
}

/// Content of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpillFormat {
    /// Identity of the store, also in every slot.
    pub store: u128,
    /// What happens to the pages after the run.
    pub purpose: Purpose,
    /// Sizes of slots and segments.
    pub layout: SlotLayout,
}

/// Version and features of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FormatFeatures {
    /// Version of the layout.
    pub version: u32,
    /// Feature bits that a reader must know.
    pub incompatible: u32,
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
        let mut bytes = [0; FORMAT_BYTES];
        bytes[..8].copy_from_slice(&MAGIC);
        bytes[8..12].copy_from_slice(&FORMAT_VERSION.to_le_bytes());
        bytes[12..16].copy_from_slice(&KNOWN_FEATURES.to_le_bytes());
        bytes[16..32].copy_from_slice(&self.store.to_le_bytes());
        bytes[32..40].copy_from_slice(&self.layout.slot_bytes.to_le_bytes());
        bytes[40..44].copy_from_slice(&self.layout.slots_per_segment.to_le_bytes());
        bytes[44] = u8::from(self.purpose == Purpose::Checkpoint);
        bytes[COMPATIBLE_AT..][..4].copy_from_slice(&KNOWN_COMPATIBLE.to_le_bytes());
        seal(&mut bytes);
        bytes
    }

    /// Decodes the file.
    ///
    /// # Errors
    /// The bytes are not a FORMAT file of this version.
    pub fn from_bytes(bytes: &[u8]) -> Result<SpillFormat, FormatError> {
        let bytes = whole(bytes)?;
        let FormatFeatures { version, incompatible, .. } = features_in(bytes);
        if version != FORMAT_VERSION {
            return Err(FormatError::Version { found: version, features: incompatible });
        }
        if incompatible & !KNOWN_FEATURES != 0 {
            return Err(FormatError::Features { features: incompatible });
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

/// Version and features in the bytes of a FORMAT file of any version.
///
/// # Errors
/// The bytes are not a FORMAT file, or damaged.
pub fn features_of(bytes: &[u8]) -> Result<FormatFeatures, FormatError> {
    Ok(features_in(whole(bytes)?))
}

fn features_in(bytes: &[u8; FORMAT_BYTES]) -> FormatFeatures {
    let word = |at: usize| u32::from_le_bytes(field(bytes, at));
    FormatFeatures { version: word(8), incompatible: word(12), compatible: word(COMPATIBLE_AT) }
}

/// The bytes, if their length, magic and checksum are right.
fn whole(bytes: &[u8]) -> Result<&[u8; FORMAT_BYTES], FormatError> {
    if !bytes.starts_with(&MAGIC) {
        return Err(FormatError::Foreign);
    }
    let bytes: &[u8; FORMAT_BYTES] = bytes.try_into().map_err(|_| FormatError::Damaged)?;
    let is_whole = bytes[CHECKSUM_AT..] == checksum(&bytes[..CHECKSUM_AT]).to_le_bytes();
    if is_whole { Ok(bytes) } else { Err(FormatError::Damaged) }
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

    fn with(at: usize, value: u8) -> [u8; FORMAT_BYTES] {
        let mut bytes = sample().to_bytes();
        bytes[at] = value;
        seal(&mut bytes);
        bytes
    }

    #[test]
    fn unknown_compatible_features_are_ignored() {
        let bytes = with(COMPATIBLE_AT + 1, 0x80);
        assert_eq!(SpillFormat::from_bytes(&bytes), Ok(sample()));
        let features = FormatFeatures { version: FORMAT_VERSION, incompatible: 0, compatible: 0x8000 };
        assert_eq!(features_of(&bytes), Ok(features));
        // Also for a store that this program cannot read.
        assert_eq!(features_of(&with(8, 9)).map(|f| f.version), Ok(9));
    }

    #[test]
    fn newer_versions_and_impossible_sizes_are_refused() {
        let changed = |at: usize, value: u8| SpillFormat::from_bytes(&with(at, value)).expect_err("read");
        assert_eq!(changed(8, 2), FormatError::Version { found: 2, features: 0 });
        assert_eq!(changed(8, 0), FormatError::Version { found: 0, features: 0 });
        assert_eq!(changed(12, 1), FormatError::Features { features: 1 });
        assert!(changed(8, 2).to_string().contains("newer") && changed(8, 0).to_string().contains("older"));
        assert!(changed(12, 5).to_string().contains("bits 0x5"));
        assert!(
            changed(8, 2).to_string().contains("version 2") && changed(8, 2).to_string().contains("knows version 1")
        );
        assert_eq!(changed(32, 1), FormatError::Sizes);
        assert_eq!(changed(39, 0x7f), FormatError::Sizes);
        assert_eq!(changed(44, 2), FormatError::Sizes);
    }
}
