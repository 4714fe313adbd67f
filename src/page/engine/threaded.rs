//! Engines whose worker threads make blocking calls: `pread` (positioned reads and writes, which work everywhere) and
//! `mmap` (reads through memory maps, positioned writes).
//!
//! `pread` uses direct I/O where the file system allows it. Whatever goes through the page cache is dropped from there
//! as far as the system allows: a frame holds the bytes that were read, and a changed page is written to another slot.
//! Invariants: those of [`PageEngine`].

use crate::page::engine::mmap::SegmentMaps;
use crate::page::engine::page_cache::{WriteBehind, drop_cached};
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use crate::page::engine::segment_files::SegmentFiles;
use crate::page::engine::short_transfers::move_bytes;
use crate::page::engine::transfer_pool::TransferPool;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Segments as files; worker threads make blocking calls.
pub struct ThreadedEngine {
    shared: Arc<Shared>,
    pool: TransferPool,
}

struct Shared {
    segments: Mutex<SegmentFiles>,
    /// Reads go through these maps, if any.
    maps: Option<SegmentMaps>,
    behind: Mutex<WriteBehind>,
    direct: bool,
}

impl ThreadedEngine {
    /// Positioned reads and writes on the segments of a folder, with `threads` threads, which is also the most requests
    /// in flight at the drive. `direct` bypasses the page cache where the file system allows it.
    ///
    /// # Errors
    /// The folder cannot be used, or no thread can be started.
    pub fn pread(folder: &Path, threads: usize, direct: bool) -> io::Result<ThreadedEngine> {
        ThreadedEngine::over(SegmentFiles::new(folder, direct)?, None, threads)
    }

    /// As [`ThreadedEngine::pread`] for a read-only store: writes fail.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn pread_read_only(folder: &Path, threads: usize) -> io::Result<ThreadedEngine> {
        ThreadedEngine::over(SegmentFiles::read_only(folder), None, threads)
    }

    /// Reads through memory maps of the segments of a folder, with `threads` threads that copy and write.
    ///
    /// # Errors
    /// The folder cannot be used, or no thread can be started.
    pub fn mmap(folder: &Path, threads: usize) -> io::Result<ThreadedEngine> {
        ThreadedEngine::over(SegmentFiles::new(folder, false)?, Some(SegmentMaps::default()), threads)
    }

    fn over(segments: SegmentFiles, maps: Option<SegmentMaps>, threads: usize) -> io::Result<ThreadedEngine> {
        let (direct, name) = (segments.is_direct(), if maps.is_some() { "mmap" } else { "pread" });
        let shared = Arc::new(Shared { segments: Mutex::new(segments), maps, behind: Mutex::default(), direct });
        let worker = Arc::clone(&shared);
        let pool = TransferPool::new(name, threads, move |transfer| worker.execute(transfer))?;
        Ok(ThreadedEngine { shared, pool })
    }

    /// Whether transfers bypass the page cache.
    pub fn is_direct(&self) -> bool {
        self.shared.direct
    }
}

impl Shared {
    fn execute(&self, transfer: &mut Transfer) -> io::Result<()> {
        let file = lock(&self.segments).file_of(transfer)?;
        match (&self.maps, transfer.direction) {
            (Some(maps), Direction::Read) => maps.copy_out(&file, transfer)?,
            _ => move_bytes(&file, transfer)?,
        }
        let (offset, bytes) = (transfer.place.offset, transfer.bytes as u64);
        match transfer.direction {
            _ if self.direct => {}
            Direction::Read => drop_cached(&file, offset, bytes),
            Direction::Write => lock(&self.behind).record_write(&file, offset, bytes),
        }
        Ok(())
    }
}

impl PageEngine for ThreadedEngine {
    fn name(&self) -> &'static str {
        if self.shared.maps.is_some() { "mmap" } else { "pread" }
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).create(segment, bytes)
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).check(segment, bytes)
    }

    fn submit(&mut self, transfer: Transfer) {
        if let Some(maps) = self.shared.maps.as_ref().filter(|_| transfer.direction == Direction::Read) {
            // The copy meets and reports an error of opening the file.
            let file = lock(&self.shared.segments).file_of(&transfer);
            file.into_iter().for_each(|file| maps.read_ahead(&file, &transfer));
        }
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
