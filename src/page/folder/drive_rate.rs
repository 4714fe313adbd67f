//! Measures a drive's throughput in about a second, to choose the default codec of pages. The result is cached in the
//! folder.
//!
//! The rate decides only a default, never a result. Invariants: 1. a cached rate is used only for the drive it was
//! measured on; an unreadable cache file means a new measurement; 2. a drive that cannot be measured stores pages raw.

use crate::base::error::InputResult;
use crate::page::engine::open::{DEPTH, IoEngine};
use crate::page::engine::page_engine::Direction;
use crate::page::engine::segment_files::{open_for_reading, with_safe_flags};
use crate::page::folder::measure::{Case, Scratch};
use crate::page::format::codec::Codec;
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::Path;
use std::time::Duration;

/// Name of the cache file.
pub const FILE_NAME: &str = "drive-rate.json";
/// A longer file is not a cache file of this program.
const FILE_BYTES_MAX: u64 = 4096;
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
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriveRate {
    /// Bytes per second of random reads.
    pub read: f64,
    /// Bytes per second of writes, fsync included.
    pub write: f64,
    /// Device number of the file system that was measured; 0 where the system gives none.
    device: u64,
}

impl DriveRate {
    /// The cached rates of `folder`, or else a new measurement (about a second), which is cached. Failing to write the
    /// cache is no error.
    ///
    /// # Errors
    /// Too little space, the folder cannot be written, the drive fails.
    pub fn of(folder: &Path) -> InputResult<DriveRate> {
        let device = device_of(folder);
        if let Some(rate) = remembered(folder).filter(|r| r.device == device) {
            return Ok(rate);
        }
        let rate = DriveRate { device, ..measure(folder)? };
        // Without the cache file the next run measures again.
        let _ = remember(folder, &rate);
        Ok(rate)
    }

    /// The cached rates of `folder`, or else a new measurement (about a second). Leaves no file behind.
    ///
    /// # Errors
    /// As [`DriveRate::of`].
    pub fn of_without_caching(folder: &Path) -> InputResult<DriveRate> {
        let device = device_of(folder);
        remembered(folder).filter(|r| r.device == device).map_or_else(|| measure(folder), Ok)
    }

    /// Bytes per second of an equal mix of reads and writes.
    pub fn both(&self) -> f64 {
        2.0 / (1.0 / self.read + 1.0 / self.write)
    }

    /// The codec that suits such a drive.
    pub fn codec(&self) -> Codec {
        codec_for(self.both())
    }
}

/// The codec for a drive that moves this many bytes per second, reads and writes mixed.
pub fn codec_for(bytes_per_second: f64) -> Codec {
    if bytes_per_second < CODEC_PAYS_BELOW { Codec::Zstd { level: 1 } } else { Codec::Raw }
}

/// Measures the drive of `folder`.
///
/// # Errors
/// As [`DriveRate::of`].
fn measure(folder: &Path) -> InputResult<DriveRate> {
    let failed = |e: std::io::Error| crate::base::error::InputError::io(folder, "measuring the drive", &e);
    let engine = IoEngine::Auto;
    let mut scratch = Scratch::new(folder, &[engine], MEASURED_BYTES, DEPTH)?;
    // Writes to fresh space, as an import and the first spills do.
    let write = scratch.fill(TIME).map_err(failed)?;
    let case = Case { engine, bytes: TRANSFER_BYTES, depth: DEPTH / 2 };
    let read = scratch.rate(case, Direction::Read, TIME, u64::MAX).map_err(failed)?;
    Ok(DriveRate { read, write, device: 0 })
}

fn remembered(folder: &Path) -> Option<DriveRate> {
    let file = open_for_reading(&folder.join(FILE_NAME)).ok()?;
    let mut text = String::new();
    file.take(FILE_BYTES_MAX).read_to_string(&mut text).ok()?;
    let rate: DriveRate = serde_json::from_str(&text).ok()?;
    let is_rate = |x: f64| x.is_finite() && x > 0.0;
    (is_rate(rate.read) && is_rate(rate.write)).then_some(rate)
}

fn remember(folder: &Path, rate: &DriveRate) -> std::io::Result<()> {
    let text = serde_json::to_string(rate)?;
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(true);
    let mut file: File = with_safe_flags(&mut options).open(folder.join(FILE_NAME))?;
    file.write_all(text.as_bytes())
}

fn device_of(folder: &Path) -> u64 {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        std::fs::metadata(folder).map_or(0, |m| m.dev())
    }
    #[cfg(not(unix))]
    {
        let _ = folder;
        0
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn rates_are_measured_once_and_remembered() {
        let folder = tempfile::tempdir().unwrap();
        let rate = DriveRate::of(folder.path()).unwrap();
        assert!(rate.read > 0.0 && rate.write > 0.0);
        let slow = DriveRate { read: 2e8, write: 1e8, ..rate };
        remember(folder.path(), &slow).unwrap();
        assert_eq!(DriveRate::of(folder.path()).unwrap(), slow);
        assert_eq!(slow.codec(), Codec::Zstd { level: 1 });
        // Another drive, or an invalid cache file: measured again.
        remember(folder.path(), &DriveRate { device: rate.device + 1, ..slow }).unwrap();
        assert_ne!(DriveRate::of(folder.path()).unwrap(), slow);
        for text in ["{\"read\": -1.0, \"write\": 1.0, \"device\": 0}", "\u{0}"] {
            std::fs::write(folder.path().join(FILE_NAME), text).unwrap();
            assert!(DriveRate::of(folder.path()).unwrap().read > 0.0);
        }
        remember(folder.path(), &slow).unwrap();
        assert_eq!(DriveRate::of_without_caching(folder.path()).unwrap(), slow);
        let other = tempfile::tempdir().unwrap();
        assert!(DriveRate::of_without_caching(other.path()).unwrap().read > 0.0);
        assert_eq!(std::fs::read_dir(other.path()).unwrap().count(), 0);
        let names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert_eq!(names, [FILE_NAME]);
    }

    #[test]
    fn fast_drives_store_raw() {
        assert_eq!(DriveRate { read: 3e9, write: 2e9, device: 0 }.codec(), Codec::Raw);
        assert_eq!(codec_for(0.45e9), Codec::Zstd { level: 1 });
    }
}
