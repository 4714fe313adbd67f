//! A real folder some of whose files ask before they change, so that a test can refuse the change.

use gsscale::page::folder::protocol_files::{DriveFolder, Folder};
use redb::StorageBackend;
use std::io;
use std::path::Path;
use std::sync::Arc;

/// What a file is about to do, or has done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Change {
    SetLen,
    WriteAt(u64),
    Sync,
    Synced,
}

pub type Guard = Arc<dyn Fn(Change) -> io::Result<()> + Send + Sync>;

/// A file, shared by its clones.
#[derive(Clone)]
pub struct Guarded(pub Arc<dyn StorageBackend>, pub Guard);

impl std::fmt::Debug for Guarded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl StorageBackend for Guarded {
    fn len(&self) -> io::Result<u64> {
        self.0.len()
    }
    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.0.read(offset, out)
    }
    fn set_len(&self, len: u64) -> io::Result<()> {
        (self.1)(Change::SetLen)?;
        self.0.set_len(len)
    }
    fn sync_data(&self) -> io::Result<()> {
        (self.1)(Change::Sync)?;
        self.0.sync_data()?;
        (self.1)(Change::Synced)
    }
    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        (self.1)(Change::WriteAt(offset))?;
        self.0.write(offset, data)
    }
}

/// A folder that guards the files `names`.
pub struct GuardedFolder {
    folder: DriveFolder,
    names: &'static [&'static str],
    guard: Guard,
}

impl GuardedFolder {
    pub fn new(at: &Path, names: &'static [&'static str], guard: Guard) -> GuardedFolder {
        GuardedFolder { folder: DriveFolder::new(at), names, guard }
    }

    fn guarded(&self, name: &str, file: Arc<dyn StorageBackend>) -> Arc<dyn StorageBackend> {
        if self.names.contains(&name) { Arc::new(Guarded(file, Arc::clone(&self.guard))) } else { file }
    }
}

impl Folder for GuardedFolder {
    fn open(&self, name: &str) -> io::Result<Option<Arc<dyn StorageBackend>>> {
        Ok(self.folder.open(name)?.map(|file| self.guarded(name, file)))
    }
    fn create(&self, name: &str) -> io::Result<Arc<dyn StorageBackend>> {
        Ok(self.guarded(name, self.folder.create(name)?))
    }
    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        self.folder.rename(from, to)
    }
    fn remove(&self, name: &str) -> io::Result<()> {
        self.folder.remove(name)
    }
    fn sync(&self) -> io::Result<()> {
        self.folder.sync()
    }
}
