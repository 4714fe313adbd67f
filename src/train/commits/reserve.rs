//! Bytes that a spill directory holds back for the last commit on a full drive.

/// Least reserve for a last commit on a full drive, bytes: room for the map to grow.
const RESERVE_BYTES_LEAST: u64 = 2 << 20;
const RESERVE_BYTES_MOST: u64 = 256 << 20;

/// Bytes that a spill directory holds back for the moment when its drive is full.
pub(crate) fn reserve_bytes(segment_bytes: u64) -> u64 {
    segment_bytes.clamp(RESERVE_BYTES_LEAST, RESERVE_BYTES_MOST)
}
