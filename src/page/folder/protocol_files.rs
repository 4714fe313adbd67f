//! The folder of a store as the commit protocol uses it: a few files by name, and syncs of folder entries.
//!
//! Invariants: 1. an entry is durable only after [`Folder::sync`]; 2. names are the protocol's own constants, so
//! nothing outside the folder is accessed; a symbolic link in place of a file is an error; 3. only the owner can access
//! new files.

use crate::page::engine::segment_files::{sync_folder, with_safe_flags};
use crate::page::map::map_file::DriveFile;
use redb::StorageBackend;
use std::fs::OpenOptions;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Files of one folder.
pub trait Folder: Send {
    /// Opens the file `name` for reading and writing; `None` if it does not exist.
    ///
    /// # Errors
    /// The file exists and cannot be opened.
    fn open(&self, name: &str) -> io::Result<Option<Arc<dyn StorageBackend>>>;

    /// Creates an empty file `name`, replacing an existing one.
    ///
    /// # Errors
    /// The folder cannot be written.
    fn create(&self, name: &str) -> io::Result<Arc<dyn StorageBackend>>;

    /// Renames the file `from` to `to`, replacing an existing one.
    ///
    /// # Errors
    /// The file does not exist, or the folder cannot be written.
    fn rename(&self, from: &str, to: &str) -> io::Result<()>;

    /// Removes the file `name`, if it exists.
    ///
    /// # Errors
    /// The folder cannot be written.
    fn remove(&self, name: &str) -> io::Result<()>;

    /// Makes the entries of the folder durable.
    ///
    /// # Errors
    /// The drive reported an error: entries changed since the last sync may be lost.
    fn sync(&self) -> io::Result<()>;
}

/// A folder on a drive.
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
        std::fs::rename(self.0.join(from), self.0.join(to))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        match std::fs::remove_file(self.0.join(name)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    fn sync(&self) -> io::Result<()> {
        sync_folder(&self.0)
    }
}
