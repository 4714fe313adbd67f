//! Read-only memory maps of segments. Maps are never writable: on a full drive a write to a map would kill the process,
//! and I/O errors could not be reported.
//!
//! Coherence: writes go through the page cache (no direct I/O here), and a shared map shows the same cached pages, so a
//! read submitted after a write completed sees its bytes. Submitting a read starts its read-ahead (`WILLNEED`). A
//! worker then faults the pages in with `POPULATE_READ`, which reports an I/O error where touching the page would raise
//! SIGBUS, and copies them. A file that another program has made shorter is an error, because its length is looked at before
//! each copy. (SIGBUS remains possible on systems without `POPULATE_READ`, if the system drops a page in between and cannot
//! read it again, and if a file is made shorter during a copy; `--io uring` and `--io pread` have no such case.)
//!
//! Invariant: no reference to mapped bytes is ever made, only copies through raw pointers, because a write changes the
//! bytes under a map.
#![allow(unsafe_code)] // copying out of a map, and dropping its pages

use crate::page::engine::page_engine::Transfer;
use memmap2::{MmapOptions, MmapRaw};
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};

/// The maps of an engine. They live as long as it: they cost address space, but neither memory nor file descriptors.
#[derive(Debug, Default)]
pub struct SegmentMaps(Mutex<BTreeMap<u32, Arc<MmapRaw>>>);

impl SegmentMaps {
    /// The map of a segment; made anew if missing or too short.
    fn of(&self, segment: u32, file: &File) -> io::Result<Arc<MmapRaw>> {
        let mut maps = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let bytes = file.metadata()?.len();
        if let Some(map) = maps.get(&segment).filter(|map| map.len() as u64 >= bytes) {
            return Ok(Arc::clone(map));
        }
        let map = Arc::new(MmapOptions::new().map_raw_read_only(file)?);
        maps.insert(segment, Arc::clone(&map));
        Ok(map)
    }

    /// Starts read-ahead for a transfer. Errors are ignored here: the copy meets and reports them.
    pub fn read_ahead(&self, file: &File, transfer: &Transfer) {
        #[cfg(unix)]
        if let (Ok(map), Ok(start)) = (self.of(transfer.place.segment, file), usize::try_from(transfer.place.offset)) {
            let _ = map.advise_range(memmap2::Advice::WillNeed, start, transfer.bytes);
        }
        #[cfg(not(unix))]
        let _ = (file, transfer);
    }

    /// Copies the bytes of a transfer out of the map of its file, and unmaps their pages.
    /// Errors: the bytes lie beyond the end of the file, or cannot be read.
    pub fn copy_out(&self, file: &File, transfer: &mut Transfer) -> io::Result<()> {
        let map = self.of(transfer.place.segment, file)?;
        let out = &mut transfer.buffer.as_mut_slice()[..transfer.bytes];
        let beyond = || io::Error::new(io::ErrorKind::UnexpectedEof, "the place lies beyond the end of the file");
        let start = usize::try_from(transfer.place.offset).map_err(|_| beyond())?;
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
                // EFAULT: the file ends before the page, or the page could not be read.
                Some(14) if (start + out.len()) as u64 > file.metadata()?.len() => return Err(beyond()),
                Some(14) => return Err(io::Error::from_raw_os_error(5)),
                _ => return Err(error),
            }
        }
        // A map stays as long as it was, but touching it behind the end of its file ends the process.
        if (start + out.len()) as u64 > file.metadata()?.len() {
            return Err(beyond());
        }
        // SAFETY: start + out.len() <= map.len() was checked, the map is readable for its whole life, and `out` is a
        // page buffer, which cannot overlap the map of a file. The file under the range is not written meanwhile: two
        // transfers of one place are never in flight together.
        unsafe { std::ptr::copy_nonoverlapping(map.as_ptr().add(start), out.as_mut_ptr(), out.len()) };
        #[cfg(unix)]
        {
            // The page cache does not drop mapped pages, so they are unmapped first.
            // SAFETY: the range lies in the map. Dropping the pages of a shared read-only file map loses nothing; the
            // next access reads them from the file again.
            let _ = unsafe { map.unchecked_advise_range(memmap2::UncheckedAdvice::DontNeed, start, out.len()) };
        }
        Ok(())
    }
}
