//! The error type for all outside input: files, flags, folders.
//!
//! Invariant: an [`InputError`] always names the file (or flag), the place in it, and the remedy. Errors are made where
//! the facts are known and passed upward unchanged; no function both logs and returns one.

use std::fmt;
use std::path::{Path, PathBuf};

/// An input error: the file, the place in it, the problem, and the remedy.
#[derive(Debug, Clone)]
pub struct InputError {
    /// The file, folder or flag at fault.
    pub file: PathBuf,
    /// Place in the file: a byte offset, a line, a key, an image name; empty for the whole file.
    pub place: String,
    pub problem: String,
    /// What the user can do about it.
    pub remedy: String,
    /// Kind of the underlying I/O error, if any.
    pub kind: Option<std::io::ErrorKind>,
}

/// Result of reading user input.
pub type InputResult<T> = Result<T, InputError>;

impl InputError {
    /// An error about `file` as a whole; add the place with [`InputError::at`].
    pub fn new(file: impl AsRef<Path>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        InputError {
            file: file.as_ref().to_path_buf(),
            place: String::new(),
            problem: problem.into(),
            remedy: remedy.into(),
            kind: None,
        }
    }

    /// Whether the error is only a lack of disk space.
    pub fn is_out_of_space(&self) -> bool {
        self.kind.is_some_and(is_out_of_space)
    }

    /// The same error with its place inside the file.
    #[must_use]
    pub fn at(mut self, place: impl Into<String>) -> Self {
        self.place = place.into();
        self
    }

    /// A failed system call on `file`; the remedy follows from its kind.
    pub fn io(file: impl AsRef<Path>, doing: &str, source: &std::io::Error) -> Self {
        use std::io::ErrorKind as K;
        let remedy = match source.kind() {
            _ if is_too_many_files(source) => REMEDY_TOO_MANY_FILES,
            K::NotFound => "check the path",
            K::PermissionDenied => "check the permissions of the file and its folder",
            K::StorageFull => "free space on that disk or choose another folder",
            K::ReadOnlyFilesystem => "choose a folder on a writable disk",
            K::NotADirectory | K::IsADirectory => "check whether a file or a folder is meant",
            K::UnexpectedEof => "the file is cut short: copy or write it again",
            _ => "check the disk and the path, then try again",
        };
        InputError { kind: Some(source.kind()), ..InputError::new(file, format!("{doing} failed: {source}"), remedy) }
    }
}

/// What helps when too many files are open.
pub const REMEDY_TOO_MANY_FILES: &str =
    "raise the limit on open files, for example with `ulimit -n 1024`; nothing is wrong with the drive";

/// Whether a file could not be opened because the process or the system has too many open; closing another file cures
/// that.
pub fn is_too_many_files(error: &std::io::Error) -> bool {
    cfg!(unix) && matches!(error.raw_os_error(), Some(23 | 24)) // ENFILE, EMFILE everywhere
}

/// Whether the system refused bytes for lack of space; then nothing was written. A limit on the length of files counts,
/// too.
pub fn is_out_of_space(kind: std::io::ErrorKind) -> bool {
    use std::io::ErrorKind as K;
    matches!(kind, K::StorageFull | K::QuotaExceeded | K::FileTooLarge)
}

impl fmt::Display for InputError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.file.display())?;
        if !self.place.is_empty() {
            write!(f, ": {}", self.place)?;
        }
        write!(f, ": {}", self.problem)?;
        if !self.remedy.is_empty() {
            write!(f, "\n  remedy: {}", self.remedy)?;
        }
        Ok(())
    }
}

impl std::error::Error for InputError {}
