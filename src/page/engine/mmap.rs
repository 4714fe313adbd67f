//! Reads through read-only memory maps with read-ahead advice; writes with plain positioned writes. Maps are never
//! writable: on a full drive a write to a map would kill the process, and I/O errors could not be reported.
//!
//! Coherence: writes go through the page cache (no direct I/O here), and a shared map shows the same cached pages, so a
//! read submitted after a write completed sees its bytes. Submitting a read starts its read-ahead (`WILLNEED`). A
//! worker then faults the pages in with `POPULATE_READ`, which reports an I/O error where touching the page would raise
//! SIGBUS, and copies them. (SIGBUS remains possible on systems without `POPULATE_READ`, and if the system drops a page
//! in between and cannot read it again; `--io uring` and `--io pread` have no such case.) Copied pages are dropped from
//! the page cache: the frame holds the bytes now, and a changed page is written to another slot.
//!
//! Invariants: those of [`PageEngine`]; besides, no reference to mapped bytes is ever made, only copies through raw
//! pointers, because a write changes the bytes under a map.
#![allow(unsafe_code)] // copying out of a map, and dropping its pages

use crate::page::engine::page_cache::{WriteBehind, drop_cached};
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
    /// Maps live as long as the engine: they cost address space, but neither memory nor file descriptors.
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
                drop_cached(&file, place.offset, bytes as u64);
            }
            Direction::Write => {
                move_bytes(&file, transfer)?;
                lock(&self.behind).record_write(&file, place.offset, bytes as u64);
            }
        }
        Ok(())
    }

    /// The map of a segment; made anew if missing or too short.
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

    /// Starts read-ahead for a transfer. Errors are ignored here: the copy meets and reports them.
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

/// Copies `out.len()` bytes of the map from `offset` on, and unmaps the pages.
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
            // EINVAL: a kernel before 5.14. The copy faults the pages in.
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
        // The page cache does not drop mapped pages, so they are unmapped first.
        // SAFETY: the range lies in the map. Dropping the pages of a shared read-only file map loses nothing; the next
        // access reads them from the file again.
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
        lock(&self.shared.behind).drop_all();
        result
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
