//! Shared by the engines that use files: checks transfers against their segment, completes partial reads and writes,
//! and remembers a failed sync.
//!
//! Invariants: 1. no transfer reads or writes a byte outside its segment; 2. after a failed sync every later sync fails
//! too, because the system reports a lost write only once.

use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::{Direction, Transfer};
use crate::page::engine::segment_files::SegmentFiles;
use crate::page::engine::short_transfers::Resume;
use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// A symbolic link where a segment should be, on Linux.
const ELOOP: i32 = 40;

/// The segments of a folder, as an engine uses them.
#[derive(Debug)]
pub struct SegmentIo {
    files: SegmentFiles,
    /// The first failed sync.
    lost: Option<(io::ErrorKind, String)>,
}

impl SegmentIo {
    /// The segments of `folder`; `direct` bypasses the page cache where the file system allows it.
    ///
    /// # Errors
    /// The folder cannot be used.
    pub fn new(folder: &Path, direct: bool) -> io::Result<SegmentIo> {
        Ok(SegmentIo { files: SegmentFiles::new(folder, direct)?, lost: None })
    }

    /// The segments of `folder`, read-only.
    pub fn read_only(folder: &Path) -> SegmentIo {
        SegmentIo { files: SegmentFiles::read_only(folder), lost: None }
    }

    /// Whether transfers bypass the page cache.
    pub fn is_direct(&self) -> bool {
        self.files.is_direct()
    }

    /// As [`crate::page::engine::page_engine::PageEngine::create_segment`].
    ///
    /// # Errors
    /// No space, another size, or the folder cannot be written.
    pub fn create(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        self.files.create(segment, bytes)
    }

    /// As [`crate::page::engine::page_engine::PageEngine::check_segment`].
    ///
    /// # Errors
    /// The segment is missing or has another size.
    pub fn check(&self, segment: u32, bytes: u64) -> io::Result<()> {
        self.files.check(segment, bytes)
    }

    /// The file of `transfer`. A write makes it dirty until the next sync.
    ///
    /// # Errors
    /// `NotFound` if the segment does not exist, `UnexpectedEof` for a place beyond its end, `InvalidInput` for a
    /// length that is not a whole number of blocks within the buffer.
    pub fn file_of(&mut self, transfer: &Transfer) -> io::Result<Arc<File>> {
        let (offset, bytes) = (transfer.place.offset, transfer.bytes);
        let whole = offset.is_multiple_of(ALIGNMENT as u64) && bytes.is_multiple_of(ALIGNMENT);
        if !whole || bytes > transfer.buffer.len() {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                "a transfer must move whole blocks within its buffer",
            ));
        }
        let opened = match transfer.direction {
            Direction::Read => self.files.file(transfer.place.segment),
            Direction::Write => self.files.file_for_write(transfer.place.segment),
        };
        // Opening one file may sync and close another, whose error must be kept.
        let file = opened.inspect_err(|e| self.remember_lost_sync(e))?;
        if offset.checked_add(bytes as u64).is_none_or(|end| file.metadata().is_ok_and(|m| end > m.len())) {
            let problem = "the place lies beyond the end of the segment";
            return Err(io::Error::new(io::ErrorKind::UnexpectedEof, problem));
        }
        Ok(file)
    }

    /// Makes completed writes durable.
    ///
    /// # Errors
    /// The drive lost a write, now or before an earlier sync.
    pub fn sync(&mut self) -> io::Result<()> {
        if let Some((kind, what)) = &self.lost {
            return Err(io::Error::new(*kind, format!("an earlier sync failed: {what}")));
        }
        self.files.sync().inspect_err(|e| self.lost = Some((e.kind(), e.to_string())))
    }

    fn remember_lost_sync(&mut self, error: &io::Error) {
        use io::ErrorKind as K;
        // These errors never come from a sync; any other may.
        let harmless = matches!(error.kind(), K::NotFound | K::PermissionDenied) || error.raw_os_error() == Some(ELOOP);
        if !harmless && !too_many_files(error) {
            self.lost.get_or_insert((error.kind(), error.to_string()));
        }
    }
}

/// Whether opening failed because file descriptors ran out, which closing another file cures.
pub fn too_many_files(error: &io::Error) -> bool {
    cfg!(unix) && matches!(error.raw_os_error(), Some(23 | 24))
}

/// Carries out a whole transfer with blocking calls.
///
/// # Errors
/// The drive's I/O errors; `UnexpectedEof` if the file ends too early.
pub fn move_bytes(file: &File, transfer: &mut Transfer) -> io::Result<()> {
    move_parts(transfer, |direction, bytes, at| match direction {
        Direction::Read => read_at(file, bytes, at),
        Direction::Write => write_at(file, bytes, at),
    })
}

/// Calls `move_part` with the rest of a transfer, as (direction, bytes, their place in the file), until all bytes have
/// moved.
fn move_parts(
    transfer: &mut Transfer,
    mut move_part: impl FnMut(Direction, &mut [u8], u64) -> io::Result<usize>,
) -> io::Result<()> {
    let (direction, total, start) = (transfer.direction, transfer.bytes, transfer.place.offset);
    let mut resume = Resume::default();
    while resume.done < total {
        let at = start + resume.done as u64;
        let rest = &mut transfer.buffer.as_mut_slice()[resume.done..total];
        let outcome = move_part(direction, rest, at);
        resume.advance(direction, outcome, total)?;
        if resume.tries > 1 {
            std::thread::sleep(Duration::from_micros(50 * u64::from(resume.tries)));
        }
    }
    Ok(())
}

#[cfg(unix)]
fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<usize> {
    std::os::unix::fs::FileExt::read_at(file, bytes, offset)
}

#[cfg(unix)]
fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
    std::os::unix::fs::FileExt::write_at(file, bytes, offset)
}

#[cfg(windows)]
fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<usize> {
    std::os::windows::fs::FileExt::seek_read(file, bytes, offset)
}

#[cfg(windows)]
fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
    std::os::windows::fs::FileExt::seek_write(file, bytes, offset)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::page::engine::buffer::PageBuffer;
    use crate::page::engine::page_engine::Place;

    const BYTES: usize = 37 * ALIGNMENT;
    const OFFSET: usize = 3 * ALIGNMENT;

    /// Carries out a transfer against `drive`, which moves few bytes at a time and interrupts often. Returns the number
    /// of calls.
    fn move_in_parts(transfer: &mut Transfer, drive: &mut [u8], draws: &mut Stream) -> usize {
        let mut asked = 0;
        let moved = move_parts(transfer, |direction, bytes, at| {
            asked += 1;
            match asked % 4 {
                1 => return Err(io::Error::from(io::ErrorKind::Interrupted)),
                2 => return Err(io::Error::from(io::ErrorKind::WouldBlock)),
                _ => {}
            }
            // Sometimes less than a block: the rest of a partial block moves again, and progress comes before the limit
            // on tries.
            let count =
                (draws.below(4) as usize * ALIGNMENT + 1 + draws.below(ALIGNMENT as u64) as usize).min(bytes.len());
            let there = &mut drive[at as usize..][..count];
            match direction {
                Direction::Read => bytes[..count].copy_from_slice(there),
                Direction::Write => there.copy_from_slice(&bytes[..count]),
            }
            Ok(count)
        });
        moved.unwrap();
        asked
    }

    #[test]
    fn a_transfer_in_interrupted_parts_arrives_whole() {
        for seed in 0..50 {
            let mut draws = Stream::new(seed, Purpose::Test, 0, 0);
            let mut drive: Vec<u8> = (0..OFFSET + BYTES + ALIGNMENT).map(|_| draws.next_u64() as u8).collect();
            let before = drive.clone();
            let place = Place { segment: 0, offset: OFFSET as u64 };
            // The buffer is longer than the transfer.
            let buffer = PageBuffer::zeroed(BYTES + ALIGNMENT);
            let mut transfer = Transfer { token: 1, direction: Direction::Read, place, bytes: BYTES, buffer };
            let asked = move_in_parts(&mut transfer, &mut drive, &mut draws);
            assert!(asked > 30, "asked {asked} times: too easy");
            let (moved, rest) = transfer.buffer.as_slice().split_at(BYTES);
            assert!(drive == before && *moved == before[OFFSET..OFFSET + BYTES], "seed {seed}: other bytes were read");
            assert!(rest.iter().all(|&b| b == 0));
            transfer.buffer.as_mut_slice().iter_mut().for_each(|b| *b = !*b);
            transfer.direction = Direction::Write;
            move_in_parts(&mut transfer, &mut drive, &mut draws);
            let is_right =
                |(i, b): (usize, &u8)| *b == if (OFFSET..OFFSET + BYTES).contains(&i) { !before[i] } else { before[i] };
            assert!(drive.iter().enumerate().all(is_right), "seed {seed}: other bytes were written");
        }
    }
}
