//! The folder of a store as the commit protocol uses it: a few files by name, their bytes, and syncs of folder entries.
//!
//! Invariants: 1. an entry is durable only after [`Folder::sync`]; 2. names are the protocol's own constants, so
//! nothing outside the folder is accessed; a symbolic link in place of a file is an error; 3. only the owner can access
//! new files.

use crate::base::whole_file::{rename, sync_folder};
use crate::page::engine::segment_files::{allocate, with_safe_flags};
use redb::StorageBackend;
use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

pub const MAP_NAME: &str = "map.redb";
/// File of the page map while it is created.
pub const MAP_NEW_NAME: &str = "map.redb.new";
pub const WITNESS_NAME: &str = "witness";
/// File that reserves space for a last commit on a full drive.
pub const RESERVE_NAME: &str = "reserve";
/// The reserve while it is filled.
pub const RESERVE_NEW_NAME: &str = "reserve.new";

pub trait Folder: Send {
    /// Opens the file `name` for reading and writing; `None` if it does not exist.
    /// Errors: the file exists and cannot be opened.
    fn open(&self, name: &str) -> io::Result<Option<Arc<dyn StorageBackend>>>;

    /// Creates an empty file `name`, replacing an existing one.
    /// Errors: the folder cannot be written.
    fn create(&self, name: &str) -> io::Result<Arc<dyn StorageBackend>>;

    /// Renames the file `from` to `to`, replacing an existing one.
    /// Errors: the file does not exist, or the folder cannot be written.
    fn rename(&self, from: &str, to: &str) -> io::Result<()>;

    /// Removes the file `name`, if it exists.
    /// Errors: the folder cannot be written.
    fn remove(&self, name: &str) -> io::Result<()>;

    /// Makes the entries of the folder durable.
    /// Errors: the drive reported an error: entries changed since the last sync may be lost.
    fn sync(&self) -> io::Result<()>;
}

#[derive(Debug)]
pub struct DriveFolder(PathBuf);

impl DriveFolder {
    /// `path` is an existing folder.
    pub fn new(path: &Path) -> DriveFolder {
        DriveFolder(path.to_path_buf())
    }
}

impl Folder for DriveFolder {
    fn open(&self, name: &str) -> io::Result<Option<Arc<dyn StorageBackend>>> {
        match with_safe_flags(OpenOptions::new().read(true).write(true)).open(self.0.join(name)) {
            Ok(file) if file.metadata()?.is_file() => Ok(Some(Arc::new(DriveFile::new(file)))),
            Ok(_) => Err(io::Error::new(io::ErrorKind::InvalidInput, format!("{name} is not a file"))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn create(&self, name: &str) -> io::Result<Arc<dyn StorageBackend>> {
        self.remove(name)?;
        let file =
            with_safe_flags(OpenOptions::new().read(true).write(true).create_new(true)).open(self.0.join(name))?;
        Ok(Arc::new(DriveFile::new(file)))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        rename(&self.0.join(from), &self.0.join(to))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        std::fs::remove_file(self.0.join(name)).or_else(ignore_not_found)
    }

    fn sync(&self) -> io::Result<()> {
        sync_folder(&self.0)
    }
}

/// The error, unless the file did not exist.
pub(in crate::page) fn ignore_not_found(error: io::Error) -> io::Result<()> {
    if error.kind() == io::ErrorKind::NotFound { Ok(()) } else { Err(error) }
}

/// A file on a drive. Growing allocates space, so that a full drive is detected before anything is overwritten.
#[derive(Debug)]
pub struct DriveFile(File);

impl DriveFile {
    /// `file` must be open for reading and writing.
    pub fn new(file: File) -> DriveFile {
        DriveFile(file)
    }
}

impl StorageBackend for DriveFile {
    fn len(&self) -> io::Result<u64> {
        Ok(self.0.metadata()?.len())
    }

    #[cfg(unix)]
    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        std::os::unix::fs::FileExt::read_exact_at(&self.0, out, offset)
    }

    // Several threads may read: the place is part of each call.
    #[cfg(windows)]
    fn read(&self, mut offset: u64, mut out: &mut [u8]) -> io::Result<()> {
        while !out.is_empty() {
            let bytes = std::os::windows::fs::FileExt::seek_read(&self.0, out, offset)?;
            if bytes == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            (offset, out) = (offset + bytes as u64, &mut out[bytes..]);
        }
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        let now = self.0.metadata()?.len();
        if len <= now {
            return self.0.set_len(len);
        }
        allocate(&self.0, now, len).inspect_err(|_| {
            // Space that was allocated before the drive was full is freed, as far as possible.
            let _ = self.0.set_len(now);
        })
    }

    fn sync_data(&self) -> io::Result<()> {
        self.0.sync_data()
    }

    #[cfg(unix)]
    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        std::os::unix::fs::FileExt::write_all_at(&self.0, data, offset)
    }

    #[cfg(windows)]
    fn write(&self, mut offset: u64, mut data: &[u8]) -> io::Result<()> {
        while !data.is_empty() {
            let bytes = std::os::windows::fs::FileExt::seek_write(&self.0, data, offset)?;
            if bytes == 0 {
                return Err(io::ErrorKind::WriteZero.into());
            }
            (offset, data) = (offset + bytes as u64, &data[bytes..]);
        }
        Ok(())
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_grows_takes_its_space() {
        use std::os::unix::fs::MetadataExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map");
        let open = File::options().read(true).write(true).create_new(true).open(&path).unwrap();
        let file = DriveFile::new(open);
        for (len, taken) in [(1 << 20, 1 << 20), (3 << 20, 3 << 20), (1 << 20, 1 << 20)] {
            file.set_len(len).unwrap();
            let there = std::fs::metadata(&path).unwrap();
            assert!(there.len() == len && there.blocks() * 512 >= taken, "{} blocks", there.blocks());
        }
    }
}
