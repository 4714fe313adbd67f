//! Plain positioned reads and writes on worker threads: the engine that works everywhere.
//!
//! Uses direct I/O where the file system allows it, else the page cache, from which it drops what it can.
//! Invariants: those of [`PageEngine`].

use crate::page::engine::page_cache::{WriteBehind, drop_cached};
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use crate::page::engine::segment_io::{SegmentIo, move_bytes};
use crate::page::engine::transfer_pool::TransferPool;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Segments as files; worker threads make blocking calls.
pub struct PreadEngine {
    shared: Arc<Shared>,
    pool: TransferPool,
}

struct Shared {
    segments: Mutex<SegmentIo>,
    behind: Mutex<WriteBehind>,
    direct: bool,
}

impl PreadEngine {
    /// Opens a folder of segments with `threads` threads, which is also the most requests in flight at the drive.
    /// `direct` bypasses the page cache where the file system allows it.
    ///
    /// # Errors
    /// The folder cannot be used, or no thread can be started.
    pub fn open(folder: &Path, threads: usize, direct: bool) -> io::Result<PreadEngine> {
        PreadEngine::over(SegmentIo::new(folder, direct)?, threads)
    }

    /// As [`PreadEngine::open`] for a read-only store: writes fail.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn open_read_only(folder: &Path, threads: usize) -> io::Result<PreadEngine> {
        PreadEngine::over(SegmentIo::read_only(folder), threads)
    }

    fn over(segments: SegmentIo, threads: usize) -> io::Result<PreadEngine> {
        let direct = segments.is_direct();
        let shared = Arc::new(Shared { segments: Mutex::new(segments), behind: Mutex::default(), direct });
        let worker = Arc::clone(&shared);
        let pool = TransferPool::new("pread", threads, move |transfer| worker.carry_out(transfer))?;
        Ok(PreadEngine { shared, pool })
    }

    /// Whether transfers bypass the page cache.
    pub fn is_direct(&self) -> bool {
        self.shared.direct
    }
}

impl Shared {
    fn carry_out(&self, transfer: &mut Transfer) -> io::Result<()> {
        let file = lock(&self.segments).file_of(transfer)?;
        move_bytes(&file, transfer)?;
        if !self.direct {
            match transfer.direction {
                Direction::Read => drop_cached(&file, transfer.place.offset, transfer.bytes as u64),
                Direction::Write => {
                    lock(&self.behind).record_write(&file, transfer.place.offset, transfer.bytes as u64);
                }
            }
        }
        Ok(())
    }
}

impl PageEngine for PreadEngine {
    fn name(&self) -> &'static str {
        "pread"
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).create(segment, bytes)
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).check(segment, bytes)
    }

    fn submit(&mut self, transfer: Transfer) {
        self.pool.submit(transfer);
    }

    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        self.pool.complete(wait, done);
    }

    fn in_flight(&self) -> usize {
        self.pool.in_flight()
    }

    fn sync(&mut self) -> io::Result<()> {
        let result = lock(&self.shared.segments).sync();
        lock(&self.shared.behind).drop_all();
        result
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
