//! The file below the page map: the storage backend that redb reads and writes.
//!
//! It adds two properties that redb lacks. First, opening changes nothing until the map is verified: redb's writes
//! while it repairs and marks the file are held back, and reach the drive in the same order only after the
//! verification; a refused file stays unchanged. Second, closing changes nothing: the last acknowledged commit is the
//! last write, so every opening takes the path of an opening after a crash, which is the tested path.
//!
//! Invariants: 1. held-back operations are carried out in order, syncs included; 2. once shut, the file is neither read
//! nor written; 3. a failed sync never counts as a lack of space.

use crate::page::mutants::{Mutant, active};
use redb::{BackendError, StorageBackend};
use std::io;
use std::ops::Bound;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// One held-back operation.
#[derive(Debug)]
enum Held {
    Write(u64, Vec<u8>),
    Length(u64),
    Sync,
}

/// Operations of an opening that is not verified yet.
#[derive(Debug)]
struct HeldBack {
    operations: Vec<Held>,
    len: u64,
}

#[derive(Debug)]
struct SharedMap {
    file: Arc<dyn StorageBackend>,
    held_back: Mutex<Option<HeldBack>>,
    shut: AtomicBool,
    failure: Mutex<Option<(io::ErrorKind, String)>>,
}

/// A handle on the file; clones are the same file.
#[derive(Debug, Clone)]
pub struct MapFile(Arc<SharedMap>);

impl MapFile {
    /// A file that passes everything through.
    pub fn new(file: Arc<dyn StorageBackend>) -> MapFile {
        let (held_back, failure) = (Mutex::new(None), Mutex::new(None));
        MapFile(Arc::new(SharedMap { file, held_back, shut: AtomicBool::new(false), failure }))
    }

    /// A file that holds writes back until [`MapFile::release_held`].
    /// Errors: the length of the file cannot be read.
    pub fn with_deferred_writes(file: Arc<dyn StorageBackend>) -> io::Result<MapFile> {
        let len = file.len()?;
        let map = MapFile::new(file);
        *map.held_back() = Some(HeldBack { operations: Vec::new(), len });
        Ok(map)
    }

    /// Carries out the held-back operations; from now on everything passes through.
    /// Errors: the first operation that failed; the file is then shut.
    pub fn release_held(&self) -> io::Result<()> {
        let operations = self.held_back().take().map(|held| held.operations).unwrap_or_default();
        for operation in operations {
            let done = match operation {
                Held::Write(offset, bytes) => self.0.file.write(offset, &bytes),
                Held::Length(len) => self.0.file.set_len(len),
                Held::Sync => sync(&*self.0.file),
            };
            if let Err(error) = done {
                self.shut();
                return Err(error);
            }
        }
        Ok(())
    }

    /// Ends all access and drops held-back operations.
    pub fn shut(&self) {
        self.0.shut.store(true, Ordering::Release);
        *self.held_back() = None;
    }

    /// The first error of the drive; redb reports some of them only as "an earlier error".
    pub fn failure(&self) -> Option<io::Error> {
        let failure = self.0.failure.lock().unwrap_or_else(PoisonError::into_inner);
        failure.as_ref().map(|(kind, text)| io::Error::new(*kind, text.clone()))
    }

    fn held_back(&self) -> MutexGuard<'_, Option<HeldBack>> {
        self.0.held_back.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn check_open(&self) -> io::Result<()> {
        if self.0.shut.load(Ordering::Acquire) { Err(io::Error::other("the map was closed")) } else { Ok(()) }
    }

    fn noted<T>(&self, result: io::Result<T>) -> io::Result<T> {
        if let Err(error) = &result {
            let mut failure = self.0.failure.lock().unwrap_or_else(PoisonError::into_inner);
            failure.get_or_insert_with(|| (error.kind(), error.to_string()));
        }
        result
    }
}

/// Makes the writes to a file durable.
/// Errors: some of them may be lost. The error is never one of space, after which the caller would go on: the system reports lost bytes once and
/// counts them as written from then on, so neither a second sync nor reading the file shows the loss.
pub(super) fn sync(file: &dyn StorageBackend) -> io::Result<()> {
    file.sync_data().map_err(io::Error::other)
}

/// Applies `operations` to `out`, which was read from `offset`.
fn overlay(operations: &[Held], offset: u64, out: &mut [u8]) {
    let end = offset + out.len() as u64;
    for operation in operations {
        match operation {
            Held::Write(at, bytes) => {
                let (from, to) = ((*at).max(offset), (at + bytes.len() as u64).min(end));
                if from < to {
                    let source = &bytes[(from - at) as usize..(to - at) as usize];
                    out[(from - offset) as usize..(to - offset) as usize].copy_from_slice(source);
                }
            }
            Held::Length(len) if *len < end => out[len.saturating_sub(offset) as usize..].fill(0),
            Held::Length(_) | Held::Sync => {}
        }
    }
}

impl StorageBackend for MapFile {
    fn len(&self) -> io::Result<u64> {
        self.check_open()?;
        match self.held_back().as_ref() {
            Some(held) => Ok(held.len),
            None => self.noted(self.0.file.len()),
        }
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.check_open()?;
        let held = self.held_back();
        let Some(held) = held.as_ref() else { return self.noted(self.0.file.read(offset, out)) };
        if offset.checked_add(out.len() as u64).is_none_or(|end| end > held.len) {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let stored = self.0.file.len()?.saturating_sub(offset).min(out.len() as u64) as usize;
        let (front, back) = out.split_at_mut(stored);
        if !front.is_empty() {
            self.0.file.read(offset, front)?;
        }
        back.fill(0);
        overlay(&held.operations, offset, out);
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.check_open()?;
        if let Some(held) = self.held_back().as_mut() {
            held.operations.push(Held::Length(len));
            held.len = len;
            return Ok(());
        }
        self.noted(self.0.file.set_len(len))
    }

    fn sync_data(&self) -> io::Result<()> {
        self.check_open()?;
        if let Some(held) = self.held_back().as_mut() {
            held.operations.push(Held::Sync);
            return Ok(());
        }
        if active(Mutant::MapNotDurable) {
            return Ok(());
        }
        self.noted(sync(&*self.0.file))
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.check_open()?;
        if let Some(held) = self.held_back().as_mut() {
            held.operations.push(Held::Write(offset, data.to_vec()));
            return Ok(());
        }
        self.noted(self.0.file.write(offset, data))
    }

    // The store's folder is locked as a whole, so the file needs no lock of its own.
    fn try_lock_range(&self, _start: Bound<u64>, _end: Bound<u64>) -> Result<bool, BackendError> {
        Err(BackendError::Unsupported)
    }
}
