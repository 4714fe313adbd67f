//! Files that appear as a whole: the bytes go to a temporary file beside the target, which is synced and renamed.
//!
//! Not here: the files of a store, which has a protocol of its own (`page`).
//!
//! Invariants: 1. the target holds either its old bytes or all new ones, whenever the process or the machine stops;
//! 2. content and name are durable when a write returns, as far as the file system can do that; 3. a write that fails
//! leaves no temporary file; 4. one writer at a time has the temporary file of a target, as far as the file system has locks.

use super::error::{InputError, InputResult};
use std::fs::{File, TryLockError};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Bytes gathered before they are written.
const BUFFER_BYTES: usize = 1 << 20;
/// How long a writer waits for another one of the same file. Small files are written within milliseconds.
const WAIT: Duration = Duration::from_secs(5);
const BETWEEN_TRIES: Duration = Duration::from_millis(20);
/// How often a file is opened anew that another process has renamed or removed meanwhile.
const TRIES: u32 = 16;

/// A hidden file that one process holds at a time, as far as the file system has locks. Dropping it removes the file before the lock goes,
/// unless the file has got another name.
#[derive(Debug)]
pub(super) struct LockedFile {
    path: PathBuf,
    file: File,
    is_renamed: bool,
}

impl LockedFile {
    /// Opens or creates the file `path` beside `target`, which errors name.
    /// Errors: the file cannot be opened, or another process has it for longer than `wait`.
    pub(super) fn open(path: PathBuf, target: &Path, wait: Duration) -> InputResult<LockedFile> {
        let io = |e: io::Error| InputError::io(target, "creating the file", &e);
        let began = Instant::now();
        loop {
            if std::fs::symlink_metadata(&path).is_ok_and(|found| found.is_symlink()) {
                std::fs::remove_file(&path).map_err(io)?;
            }
            match open_locked(&path).map_err(io)? {
                Some(file) => return Ok(LockedFile { path, file, is_renamed: false }),
                None if began.elapsed() < wait => std::thread::sleep(BETWEEN_TRIES),
                None => {
                    let remedy = "wait for its end, or give another name";
                    return Err(InputError::new(target, "another process is writing this", remedy));
                }
            }
        }
    }
}

/// Opens or creates the file `path` and locks it for as long as it is open; `None` if another process has the lock. On file systems without
/// locks this only opens the file.
/// Errors: the file cannot be opened.
pub fn open_locked(path: &Path) -> io::Result<Option<File>> {
    let mut tries = 1;
    loop {
        let file = File::options().read(true).write(true).create(true).truncate(false).open(path)?;
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            return Ok(None);
        }
        // The process that had the lock may have renamed or removed the file meanwhile. Some network drives number a file anew each time it is
        // opened: then the lock alone counts.
        if is_same_file(path, &file) || tries == TRIES {
            return Ok(Some(file));
        }
        tries += 1;
    }
}

impl Drop for LockedFile {
    fn drop(&mut self) {
        if !self.is_renamed {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// A file under way. Dropping it removes the temporary file.
#[derive(Debug)]
pub struct PartFile {
    part: LockedFile,
    target: PathBuf,
}

impl PartFile {
    /// Begins to write the file `target`: creates `.NAME.part` beside it. The returned file is to be written and read, and given back to
    /// [`PartFile::finish`].
    /// Errors: the folder cannot be written, `target` names no file, or another process writes this file.
    pub fn create(target: &Path) -> InputResult<(PartFile, File)> {
        PartFile::create_within(target, WAIT)
    }

    fn create_within(target: &Path, wait: Duration) -> InputResult<(PartFile, File)> {
        let no_name = || InputError::new(target, "this path has no file name", "give a file name");
        let part = LockedFile::open(part_path(target).ok_or_else(no_name)?, target, wait)?;
        let file = part.file.set_len(0).and_then(|()| part.file.try_clone());
        let file = file.map_err(|e| InputError::io(target, "creating the file", &e))?;
        Ok((PartFile { part, target: target.to_path_buf() }, file))
    }

    /// Makes the bytes durable, and gives the file its name.
    /// Errors: the drive fails. The target is unchanged, unless only its name could not be made durable.
    pub fn finish(mut self, file: File) -> InputResult<()> {
        let target = &self.target;
        file.sync_all().map_err(|e| InputError::io(target, "flushing to the disk", &e))?;
        rename(&self.part.path, target).map_err(|e| InputError::io(target, "replacing the file", &e))?;
        self.part.is_renamed = true;
        match sync_folder(folder_of(target)) {
            Err(e) if !is_sync_unsupported(&e) => Err(InputError::io(target, "flushing the folder to the disk", &e)),
            _ => Ok(()),
        }
    }
}

#[cfg(unix)]
fn are_one(a: &std::fs::Metadata, b: &std::fs::Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    a.dev() == b.dev() && a.ino() == b.ino()
}

/// Whether the open `file` is the one that `path` names.
#[cfg(unix)]
pub fn is_same_file(path: &Path, file: &File) -> bool {
    matches!((std::fs::symlink_metadata(path), file.metadata()), (Ok(a), Ok(b)) if are_one(&a, &b))
}

/// Whether two paths name one file, also by links.
#[cfg(unix)]
pub fn are_one_file(a: &Path, b: &Path) -> bool {
    matches!((std::fs::metadata(a), std::fs::metadata(b)), (Ok(a), Ok(b)) if are_one(&a, &b))
}

#[cfg(windows)]
pub fn are_one_file(a: &Path, b: &Path) -> bool {
    same_file::is_same_file(a, b).unwrap_or(false)
}

#[cfg(windows)]
pub fn is_same_file(path: &Path, file: &File) -> bool {
    use same_file::Handle;
    let open = file.try_clone().and_then(Handle::from_file);
    matches!((Handle::from_path(path), open), (Ok(a), Ok(b)) if a == b)
}

/// Renames a file or a folder; a file of the new name is replaced. On Windows a program that looks at files as they appear, such as a virus
/// scanner, keeps others from renaming them meanwhile: then this tries again for a second.
pub fn rename(from: &Path, to: &Path) -> io::Result<()> {
    // "Access denied" and "used by another process".
    const HELD: [i32; 2] = [5, 32];
    let began = Instant::now();
    loop {
        match std::fs::rename(from, to) {
            Err(error)
                if cfg!(windows)
                    && error.raw_os_error().is_some_and(|code| HELD.contains(&code))
                    && began.elapsed() < Duration::from_secs(1) =>
            {
                std::thread::sleep(BETWEEN_TRIES);
            }
            done => return done,
        }
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
        let (part, mut file) = PartFile::create(&path).unwrap();
        file.write_all(b"third").unwrap();
        // As another process would: what is under way stays.
        let refused = PartFile::create_within(&path, Duration::ZERO).unwrap_err();
        assert!(refused.problem.contains("another process is writing"), "{refused}");
        part.finish(file).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"third");
        assert!(write_whole(Path::new("/"), b"").unwrap_err().problem.contains("no file name"));
    }

    /// Every writer succeeds, and every reader finds a whole file.
    #[test]
    fn writers_of_one_file_take_turns() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        let texts = [b'a', b'b', b'c'].map(|letter| vec![letter; 100_000]);
        let write = |text: &[u8]| {
            // Longer than any drive takes.
            let (part, mut file) = PartFile::create_within(&path, Duration::from_secs(3600)).unwrap();
            file.write_all(text).unwrap();
            part.finish(file).unwrap();
        };
        std::thread::scope(|scope| {
            for text in &texts {
                scope.spawn(|| (0..20).for_each(|_| write(text)));
            }
            scope.spawn(|| {
                for _ in 0..200 {
                    let found = std::fs::read(&path);
                    assert!(found.is_err() || texts.contains(found.as_ref().unwrap()), "a part of a file");
                }
            });
        });
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
    }
}
