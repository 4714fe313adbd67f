//! Reads through read-only memory maps that the system is advised about ahead of time; writes by plain positioned
//! writes. Never a writable map: a full drive would kill the process, and errors would have no place to go.
//!
//! Coherence: writes go through the page cache (no direct I/O here), and a shared map shows the very same cached
//! pages, so a read that is submitted after a write completed sees its bytes. Submitting a read starts its read-ahead
//! (`WILLNEED`); a worker then brings the pages in with `POPULATE_READ`, which reports a drive's error where touching
//! the page would raise SIGBUS, and copies. (Systems without it, and pages that the system drops and cannot read again
//! in between, leave that signal possible: `--io uring` and `pread` have no such case.) What was copied is forgotten
//! by the page cache: the frame holds it now, and evicted pages come back at another place if they changed.
//!
//! Invariants: those of [`PageEngine`]; besides, no reference to mapped bytes is ever made, only copies through raw
//! pointers, since the bytes change under a map when a write is done.
#![allow(unsafe_code)] // copying out of a map, and dropping its pages

use crate::page::engine::page_cache::{WriteBehind, forget};
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Place, Transfer};
use crate::page::engine::segment_io::{SegmentIo, move_bytes};
use crate::page::engine::transfer_pool::TransferPool;
use memmap2::{MmapOptions, MmapRaw};
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Segments as read-only maps, and as files for writing.
pub struct MmapEngine {
    shared: Arc<Shared>,
    pool: TransferPool,
}

struct Shared {
    segments: Mutex<SegmentIo>,
    /// Maps stay for the life of the store: they cost addresses, not memory, and no open file.
    maps: Mutex<BTreeMap<u32, Arc<MmapRaw>>>,
    behind: Mutex<WriteBehind>,
}

impl MmapEngine {
    /// Opens a folder of segments with `threads` threads that copy and write.
    ///
    /// # Errors
    /// The folder cannot be used, or no thread can be started.
    pub fn open(folder: &Path, threads: usize) -> io::Result<MmapEngine> {
        let segments = Mutex::new(SegmentIo::new(folder, false)?);
        let shared = Arc::new(Shared { segments, maps: Mutex::default(), behind: Mutex::default() });
        let worker = Arc::clone(&shared);
        let pool = TransferPool::new("mmap", threads, move |transfer| worker.carry_out(transfer))?;
        Ok(MmapEngine { shared, pool })
    }
}

impl Shared {
    fn carry_out(&self, transfer: &mut Transfer) -> io::Result<()> {
        let file = lock(&self.segments).file_of(transfer)?;
        let (place, bytes) = (transfer.place, transfer.bytes);
        match transfer.direction {
            Direction::Read => {
                let map = self.map_of(place.segment, &file)?;
                copy_out(&map, place.offset, &mut transfer.buffer.as_mut_slice()[..bytes])?;
                forget(&file, place.offset, bytes as u64);
            }
            Direction::Write => {
                move_bytes(&file, transfer)?;
                lock(&self.behind).wrote(&file, place.offset, bytes as u64);
            }
        }
        Ok(())
    }

    /// The map of a segment, made if there is none or if it is too short.
    fn map_of(&self, segment: u32, file: &File) -> io::Result<Arc<MmapRaw>> {
        let mut maps = lock(&self.maps);
        let bytes = file.metadata()?.len();
        if let Some(map) = maps.get(&segment)
            && map.len() as u64 >= bytes
        {
            return Ok(Arc::clone(map));
        }
        let map = Arc::new(MmapOptions::new().map_raw_read_only(file)?);
        maps.insert(segment, Arc::clone(&map));
        Ok(map)
    }

    /// Starts reading the bytes of a transfer. Failures are met again, and told, when they are copied.
    fn read_ahead(&self, transfer: &Transfer) {
        #[cfg(unix)]
        {
            let Place { segment, offset } = transfer.place;
            let Ok(file) = lock(&self.segments).file_of(transfer) else { return };
            let Ok(map) = self.map_of(segment, &file) else { return };
            if let Ok(start) = usize::try_from(offset) {
                let _ = map.advise_range(memmap2::Advice::WillNeed, start, transfer.bytes);
            }
        }
        #[cfg(not(unix))]
        let _ = transfer;
    }
}

/// Copies `out.len()` bytes of the map from `offset` on, and leaves the pages unmapped.
fn copy_out(map: &MmapRaw, offset: u64, out: &mut [u8]) -> io::Result<()> {
    let beyond = || io::Error::new(io::ErrorKind::UnexpectedEof, "the place lies beyond the end of the map");
    let start = usize::try_from(offset).map_err(|_| beyond())?;
    if start.checked_add(out.len()).is_none_or(|end| end > map.len()) {
        return Err(beyond());
    }
    if out.is_empty() {
        return Ok(());
    }
    #[cfg(target_os = "linux")]
    if let Err(error) = map.advise_range(memmap2::Advice::PopulateRead, start, out.len()) {
        match error.raw_os_error() {
            // EINVAL: a kernel before 5.14. The copy brings the pages in.
            Some(22) => {}
            // EFAULT: the page could not be read.
            Some(14) => return Err(io::Error::from_raw_os_error(5)),
            _ => return Err(error),
        }
    }
    // SAFETY: start + out.len() <= map.len() was checked, the map is readable for its whole life, and `out` is a
    // buffer on the heap that cannot overlap a map. The file under the range is not written meanwhile: two transfers
    // of one place are never in flight together.
    unsafe { std::ptr::copy_nonoverlapping(map.as_ptr().add(start), out.as_mut_ptr(), out.len()) };
    #[cfg(unix)]
    {
        // Mapped pages are not forgotten by the page cache.
        // SAFETY: the range lies in the map. Dropping the pages of a shared read-only map of a file loses nothing;
        // they are read again from the file when they are touched again.
        let _ = unsafe { map.unchecked_advise_range(memmap2::UncheckedAdvice::DontNeed, start, out.len()) };
    }
    Ok(())
}

impl PageEngine for MmapEngine {
    fn name(&self) -> &'static str {
        "mmap"
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).create(segment, bytes)
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).check(segment, bytes)
    }

    fn submit(&mut self, transfer: Transfer) {
        if transfer.direction == Direction::Read {
            self.shared.read_ahead(&transfer);
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
        lock(&self.shared.behind).forget_all();
        result
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
