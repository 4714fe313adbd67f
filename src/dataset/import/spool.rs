//! A list of records, written once and read in order: in memory while short, then in a file.
//!
//! Invariants: 1. the content does not depend on where the records are; 2. a list takes no more memory than it is
//! allowed, plus one buffer; 3. its file is removed with the list and, where the system allows it, even if the process
//! is killed.

use crate::base::error::{InputError, InputResult};
use crate::scene::select::RankSearch;
use bytemuck::Pod;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

const BUFFER_BYTES: usize = 1 << 20;

/// Space for lists that exceed memory.
#[derive(Debug, Clone, Copy)]
pub struct SpoolSpace<'a> {
    pub folder: &'a Path,
    /// Bytes that one list may keep in memory.
    pub memory: usize,
}

#[derive(Debug)]
pub struct SpoolWriter<T> {
    folder: PathBuf,
    memory: usize,
    /// All records, or those not yet in the file.
    waiting: Vec<T>,
    file: Option<SpoolFile>,
    in_file: usize,
}

#[derive(Debug)]
pub struct Spool<T> {
    records: Vec<T>,
    file: Option<SpoolFile>,
    len: usize,
}

#[derive(Debug)]
struct SpoolFile {
    file: File,
    path: PathBuf,
}

impl SpoolFile {
    fn create(folder: &Path) -> InputResult<SpoolFile> {
        // Two imports into one folder use different names: a name contains the process id and is never reused.
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let path = folder.join(format!("import-{}-{number}.tmp", std::process::id()));
        let options = std::fs::OpenOptions::new().read(true).write(true).create_new(true).open(&path);
        let file = options.map_err(|e| InputError::io(&path, "making a file for points", &e))?;
        // Unlinked at once, so that a killed process leaves nothing behind.
        #[cfg(unix)]
        std::fs::remove_file(&path).map_err(|e| InputError::io(&path, "unlinking a file for points", &e))?;
        Ok(SpoolFile { file, path })
    }
}

impl Drop for SpoolFile {
    fn drop(&mut self) {
        if cfg!(not(unix)) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

impl<T: Pod> SpoolWriter<T> {
    pub fn new(space: SpoolSpace<'_>) -> SpoolWriter<T> {
        let folder = space.folder.to_path_buf();
        SpoolWriter { folder, memory: space.memory, waiting: Vec::new(), file: None, in_file: 0 }
    }

    /// Errors: the list outgrew memory, and the folder cannot be written.
    pub fn push(&mut self, record: T) -> InputResult<()> {
        if self.waiting.len() >= self.limit() {
            self.flush()?;
        }
        if self.waiting.len() == self.waiting.capacity() {
            // Doubles, but never beyond the limit: a vector's own growth could take up to twice the limit.
            let more = self.waiting.len().max(1024).min(self.limit() - self.waiting.len());
            self.waiting.reserve_exact(more);
        }
        self.waiting.push(record);
        Ok(())
    }

    /// Most records that wait in memory.
    fn limit(&self) -> usize {
        let bytes = if self.file.is_some() { self.memory.min(BUFFER_BYTES) } else { self.memory };
        (bytes / size_of::<T>()).max(1)
    }

    fn flush(&mut self) -> InputResult<()> {
        if self.file.is_none() {
            self.file = Some(SpoolFile::create(&self.folder)?);
        }
        let Some(file) = &mut self.file else { return Ok(()) };
        let written = file.file.write_all(bytemuck::cast_slice(&self.waiting));
        written.map_err(|e| InputError::io(&file.path, "writing points", &e))?;
        self.in_file += self.waiting.len();
        self.waiting.clear();
        self.waiting.shrink_to(self.limit());
        Ok(())
    }

    /// Number of records so far.
    #[allow(clippy::len_without_is_empty)] // nobody asks
    pub fn len(&self) -> usize {
        self.in_file + self.waiting.len()
    }

    /// Errors: the folder cannot be written.
    pub fn finish(mut self) -> InputResult<Spool<T>> {
        let len = self.len();
        if self.file.is_some() {
            self.flush()?;
            self.waiting = Vec::new();
        }
        Ok(Spool { records: self.waiting, file: self.file, len })
    }
}

impl<T: Pod> Spool<T> {
    pub fn len(&self) -> usize {
        self.len
    }

    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Calls `take` with every record in order.
    /// Errors: the file cannot be read, or `take` failed.
    pub fn for_each(&self, mut take: impl FnMut(&T) -> InputResult<()>) -> InputResult<()> {
        if self.file.is_none() {
            return self.records.iter().try_for_each(take);
        }
        let mut buffer = Vec::new();
        let step = (BUFFER_BYTES / size_of::<T>()).max(1);
        for first in (0..self.len).step_by(step) {
            self.read_into(first..self.len.min(first + step), &mut buffer)?;
            buffer.iter().try_for_each(&mut take)?;
        }
        Ok(())
    }

    /// Errors: the file cannot be read.
    pub fn range(&self, range: Range<usize>) -> InputResult<Vec<T>> {
        let mut records = Vec::new();
        self.read_into(range, &mut records).map(|()| records)
    }

    /// Errors: the file cannot be read.
    pub fn into_vec(self) -> InputResult<Vec<T>> {
        if self.file.is_some() { self.range(0..self.len) } else { Ok(self.records) }
    }

    /// Completes a search among the records' keys; records without a key do not count.
    /// Errors: the file cannot be read.
    pub fn search(&self, mut search: RankSearch, key: impl Fn(&T) -> Option<u64>) -> InputResult<RankSearch> {
        while !search.is_done() {
            self.for_each(|record| {
                key(record).into_iter().for_each(|key| search.count(key));
                Ok(())
            })?;
            search.next_pass();
        }
        Ok(search)
    }

    fn read_into(&self, range: Range<usize>, out: &mut Vec<T>) -> InputResult<()> {
        out.clear();
        let Some(file) = &self.file else {
            out.extend_from_slice(&self.records[range]);
            return Ok(());
        };
        out.resize(range.len(), T::zeroed());
        let mut reader = &file.file;
        let at = SeekFrom::Start((range.start * size_of::<T>()) as u64);
        let read = reader.seek(at).and_then(|_| reader.read_exact(bytemuck::cast_slice_mut(out)));
        read.map_err(|e| InputError::io(&file.path, "reading points", &e))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_round_trip_through_memory_and_files_and_no_file_stays() {
        let folder = tempfile::tempdir().unwrap();
        for (count, memory) in [(0u32, 100), (5, 100), (25, 100), (26, 100), (1_000_000, 4000), (300, 0)] {
            let mut writer = SpoolWriter::new(SpoolSpace { folder: folder.path(), memory });
            (0..count).for_each(|i| writer.push(i).unwrap());
            assert!(writer.waiting.capacity() * 4 <= memory.max(4));
            let spool = writer.finish().unwrap();
            let mut next = 0;
            spool
                .for_each(|&i| {
                    assert_eq!(i, next);
                    next += 1;
                    Ok(())
                })
                .unwrap();
            assert_eq!(next, count);
            let (a, b) = (count as usize / 3, count as usize / 2);
            assert_eq!(spool.range(a..b).unwrap(), (a as u32..b as u32).collect::<Vec<_>>());
            assert_eq!(spool.file.is_some(), count as usize * 4 > memory);
            assert_eq!(spool.into_vec().unwrap().len(), count as usize);
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        }
        let mut writer = SpoolWriter::new(SpoolSpace { folder: &folder.path().join("gone"), memory: 4 });
        writer.push(1u32).unwrap();
        assert!(writer.push(2).unwrap_err().to_string().contains("gone"));
    }
}
