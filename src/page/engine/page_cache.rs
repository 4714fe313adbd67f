//! Asks the system to forget bytes of files that it keeps in its page cache.
//!
//! Engines that go through the page cache would otherwise fill memory with copies of pages that a frame holds already.
//! Only advice: nothing fails when it is not taken, and memory that stays is taken back by the system under pressure.

use std::collections::VecDeque;
use std::fs::File;
use std::sync::{Arc, Weak};

/// Written bytes that may wait for being forgotten: enough for a drive to be busy with.
const BEHIND_BYTES: u64 = 64 << 20;

/// Starts writing the changed bytes of the range to the drive and forgets those that are written. So a second call,
/// later, forgets what the first one began to write. `bytes` 0 means to the end of the file.
pub fn forget(file: &File, offset: u64, bytes: u64) {
    #[cfg(any(target_os = "linux", target_os = "android", target_os = "freebsd"))]
    // A refusal costs memory, no more.
    let _ = rustix::fs::fadvise(file, offset, std::num::NonZeroU64::new(bytes), rustix::fs::Advice::DontNeed);
    #[cfg(not(any(target_os = "linux", target_os = "android", target_os = "freebsd")))]
    let _ = (file, offset, bytes);
}

/// Forgets written bytes a while after they were written, when the drive has them.
#[derive(Debug, Default)]
pub struct WriteBehind {
    /// Held weakly: a file may be closed, synced, before its turn.
    ranges: VecDeque<(Weak<File>, u64, u64)>,
    bytes: u64,
}

impl WriteBehind {
    /// Takes note of a write that was just done and starts bringing it to the drive.
    pub fn wrote(&mut self, file: &Arc<File>, offset: u64, bytes: u64) {
        forget(file, offset, bytes);
        self.ranges.push_back((Arc::downgrade(file), offset, bytes));
        self.bytes += bytes;
        while self.bytes > BEHIND_BYTES {
            self.forget_oldest();
        }
    }

    /// Forgets everything noted; to be called after a sync.
    pub fn forget_all(&mut self) {
        while !self.ranges.is_empty() {
            self.forget_oldest();
        }
    }

    fn forget_oldest(&mut self) {
        if let Some((file, offset, bytes)) = self.ranges.pop_front() {
            if let Some(file) = file.upgrade() {
                forget(&file, offset, bytes);
            }
            self.bytes -= bytes;
        }
    }
}
