//! The bytes on the drive: slot headers, codecs, checksums, the FORMAT file, small structs. No I/O.

pub mod codec;
pub mod encoding;
pub mod slot_header;
pub mod spill_format;
pub mod verify;
