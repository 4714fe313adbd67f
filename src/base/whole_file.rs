//! Files that appear as a whole: the bytes go to a temporary file beside the target, which is synced and renamed.
//!
//! Not here: the files of a store, which has a protocol of its own (`page`).
//!
//! Invariants: 1. the target holds either its old bytes or all new ones, whenever the process or the machine stops;
//! 2. content and name are durable when a write returns, as far as the file system can do that; 3. a write that fails
//! leaves no temporary file.

use super::error::{InputError, InputResult};
use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

/// Bytes gathered before they are written.
const BUFFER_BYTES: usize = 1 << 20;

/// A file under way. Dropping it removes the temporary file.
#[derive(Debug)]
pub struct PartFile {
    path: PathBuf,
    target: PathBuf,
}

impl PartFile {
    /// Begins to write the file `target`: creates `.NAME.part` beside it, to be given back to [`PartFile::finish`].
    /// Errors: the folder cannot be written, or `target` names no file.
    pub fn create(target: &Path) -> InputResult<(PartFile, File)> {
        let no_name = || InputError::new(target, "this path has no file name", "give a file name");
        let part = PartFile { path: part_path(target).ok_or_else(no_name)?, target: target.to_path_buf() };
        let file = File::create(&part.path).map_err(|e| InputError::io(target, "creating the file", &e))?;
        Ok((part, file))
    }

    /// The temporary file again, to be written and read: for bytes that are never to get the name.
    /// Errors: the file cannot be opened.
    pub fn reopen(&self) -> InputResult<File> {
        let opened = File::options().read(true).write(true).open(&self.path);
        opened.map_err(|e| InputError::io(&self.target, "opening the temporary file", &e))
    }

    /// Makes the bytes durable, and gives the file its name.
    /// Errors: the drive fails. The target is unchanged, unless only its name could not be made durable.
    pub fn finish(self, file: File) -> InputResult<()> {
        let target = &self.target;
        file.sync_all().map_err(|e| InputError::io(target, "flushing to the disk", &e))?;
        drop(file);
        std::fs::rename(&self.path, target).map_err(|e| InputError::io(target, "replacing the file", &e))?;
        match sync_folder(folder_of(target)) {
            Err(e) if !is_sync_unsupported(&e) => Err(InputError::io(target, "flushing the folder to the disk", &e)),
            _ => Ok(()),
        }
    }
}

impl Drop for PartFile {
    fn drop(&mut self) {
        // After the rename the file no longer exists, and this call fails as expected.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// The temporary file `.NAME.part` of a target, which a process that is killed leaves; `None` if the target names no file.
pub fn part_path(target: &Path) -> Option<PathBuf> {
    hidden_beside(target, ".part")
}

/// `.NAME` and an ending, beside a target; `None` if the target has no name.
pub(super) fn hidden_beside(target: &Path, ending: &str) -> Option<PathBuf> {
    let mut name = std::ffi::OsString::from(".");
    name.push(target.file_name()?);
    name.push(ending);
    Some(target.with_file_name(name))
}

/// Writes a file of these bytes. Errors: the folder cannot be written.
pub fn write_whole(path: &Path, bytes: &[u8]) -> InputResult<()> {
    write_whole_with(path, |out| out.write_all(bytes))
}

/// Writes a file of the bytes that `fill` writes. Errors: the folder cannot be written, or `fill` failed.
pub fn write_whole_with(path: &Path, fill: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> InputResult<()> {
    let (part, file) = PartFile::create(path)?;
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, file);
    let written = fill(&mut out).and_then(|()| out.into_inner().map_err(io::IntoInnerError::into_error));
    part.finish(written.map_err(|e| InputError::io(path, "writing", &e))?)
}

/// Refuses to replace a file that a flag did not write: a slip in a command must not cost a photo or a model. `is_ours` says whether the
/// flag writes such a file. An empty file may be replaced.
/// Errors: there is another file.
pub fn check_replaceable(flag: &str, path: &Path, is_ours: impl FnOnce(&Path) -> bool) -> InputResult<()> {
    let is_lost = std::fs::metadata(path).is_ok_and(|found| found.is_file() && found.len() > 0) && !is_ours(path);
    if !is_lost {
        return Ok(());
    }
    let problem = format!("{flag} would replace this file, but {flag} writes no such file");
    Err(InputError::new(path, problem, format!("name another file with {flag}, or move this one away")))
}

pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Makes the entries of a folder durable. Errors: the drive reported an error, or its file system cannot do this.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

/// Whether the error says that folders cannot be synced here, not that the drive failed.
fn is_sync_unsupported(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported | ErrorKind::PermissionDenied)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_as_a_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write_whole(&path, b"old").unwrap();
        let cut = write_whole_with(&path, |out| out.write_all(b"half").and(Err(ErrorKind::StorageFull.into())));
        assert!(cut.unwrap_err().is_out_of_space());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        write_whole(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
        assert!(write_whole(Path::new("/"), b"").unwrap_err().problem.contains("no file name"));
    }
}
