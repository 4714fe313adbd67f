//! Drops bytes of files from the system's page cache.
//!
//! Engines that use the page cache would otherwise fill memory with second copies of pages that frames hold. This is
//! advice: nothing fails if the system ignores it, and the system reclaims what stays under memory pressure.

use std::collections::VecDeque;
use std::fs::File;
use std::sync::{Arc, Weak};

/// Written bytes that may wait before being dropped: enough to keep a drive busy.
const BEHIND_BYTES: u64 = 64 << 20;

/// Starts write-back of the dirty bytes of a range and drops its clean ones. A second call, later, therefore drops what
/// the first began to write. `bytes` 0 means to the end of the file.
pub fn drop_cached(file: &File, offset: u64, bytes: u64) {
    #[cfg(any(target_os = "linux", target_os = "android", target_os = "freebsd"))]
    // If refused, the cached copy only costs memory.
    let _ = rustix::fs::fadvise(file, offset, std::num::NonZeroU64::new(bytes), rustix::fs::Advice::DontNeed);
    #[cfg(not(any(target_os = "linux", target_os = "android", target_os = "freebsd")))]
    let _ = (file, offset, bytes);
}

/// Drops written bytes from the page cache some time after the write, when the drive has them.
#[derive(Debug, Default)]
pub struct WriteBehind {
    /// Weak, because a file may be synced and closed before its turn.
    ranges: VecDeque<(Weak<File>, u64, u64)>,
    bytes: u64,
}

impl WriteBehind {
    /// Records a completed write and starts its write-back.
    pub fn record_write(&mut self, file: &Arc<File>, offset: u64, bytes: u64) {
        drop_cached(file, offset, bytes);
        self.ranges.push_back((Arc::downgrade(file), offset, bytes));
        self.bytes += bytes;
        while self.bytes > BEHIND_BYTES {
            self.drop_oldest();
        }
    }

    /// Drops all recorded ranges; call after a sync.
    pub fn drop_all(&mut self) {
        while !self.ranges.is_empty() {
            self.drop_oldest();
        }
    }

    fn drop_oldest(&mut self) {
        if let Some((file, offset, bytes)) = self.ranges.pop_front() {
            if let Some(file) = file.upgrade() {
                drop_cached(&file, offset, bytes);
            }
            self.bytes -= bytes;
        }
    }
}
