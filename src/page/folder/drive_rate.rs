//! Measures a drive's throughput in about a second, for plans, and knows the codec that suits a drive.
//!
//! Not here: the full measurement of `gsscale-iotune` ([`super::measure`]).

use super::measure::{Case, Scratch};
use crate::base::error::{InputError, InputResult};
use crate::page::engine::open::{DEPTH, IoEngine};
use crate::page::engine::page_engine::Direction;
use crate::page::format::codec::Codec;
use std::path::Path;
use std::time::Duration;

/// Bytes per second below which compression pays. A core compresses 0.8 GB/s and decompresses 3.7 GB/s, and saves a
/// seventh of the bytes, so on faster drives compression only costs.
const CODEC_PAYS_BELOW: f64 = 0.5e9;
/// Size of the test file, bytes.
const MEASURED_BYTES: u64 = 128 << 20;
/// Bytes of one transfer: about a page.
const TRANSFER_BYTES: usize = 768 << 10;
/// Measuring time per direction.
const TIME: Duration = Duration::from_millis(450);

/// Rates of a drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveRate {
    /// Bytes per second of random reads.
    pub read: f64,
    /// Bytes per second of writes, fsync included.
    pub write: f64,
}

impl DriveRate {
    /// A common NVMe drive.
    pub const COMMON: DriveRate = DriveRate { read: 3e9, write: 2e9 };

    /// Measures the drive of `folder`. Leaves no file behind.
    ///
    /// # Errors
    /// Too little space, the folder cannot be written, the drive fails.
    pub fn measure(folder: &Path) -> InputResult<DriveRate> {
        let failed = |e: std::io::Error| InputError::io(folder, "measuring the drive", &e);
        let engine = IoEngine::Auto;
        let mut scratch = Scratch::new(folder, &[engine], MEASURED_BYTES, DEPTH)?;
        // Writes to fresh space, as an import and the first spills do.
        let write = scratch.fill(TIME).map_err(failed)?;
        let case = Case { engine, bytes: TRANSFER_BYTES, depth: DEPTH / 2 };
        let read = scratch.rate(case, Direction::Read, TIME, u64::MAX).map_err(failed)?;
        Ok(DriveRate { read, write })
    }
}

/// The codec for a drive that moves this many bytes per second, reads and writes mixed.
pub fn codec_for(bytes_per_second: f64) -> Codec {
    if bytes_per_second < CODEC_PAYS_BELOW { Codec::Zstd { level: 1 } } else { Codec::Raw }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn a_measurement_leaves_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let rate = DriveRate::measure(folder.path()).unwrap();
        assert!(rate.read > 0.0 && rate.write > 0.0);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn fast_drives_store_raw() {
        assert_eq!((codec_for(2.4e9), codec_for(0.45e9)), (Codec::Raw, Codec::Zstd { level: 1 }));
    }
}
