//! One error type for everything that comes from outside: files, flags, folders.
//!
//! Invariant: an [`InputError`] always names the file (or flag), the place in it, and what the user can do.
//! Errors are made where the facts are known and passed upward unchanged; nobody logs one and returns it too.

use std::fmt;
use std::path::{Path, PathBuf};

/// Bad input: the file, the place in it, what is wrong, and the remedy.
#[derive(Debug, Clone)]
pub struct InputError {
    /// File, folder or flag that is at fault.
    pub file: PathBuf,
    /// Where in it: a byte offset, a line, a key, an image name; empty when the whole file is meant.
    pub place: String,
    /// What is wrong.
    pub problem: String,
    /// What the user can do about it.
    pub remedy: String,
    /// The kind of the system call's error that is behind it, if one is.
    pub kind: Option<std::io::ErrorKind>,
}

/// Result of everything that reads what a user gave.
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

    /// Whether it is only space on a drive that is missing.
    pub fn is_out_of_space(&self) -> bool {
        use std::io::ErrorKind as K;
        matches!(self.kind, Some(K::StorageFull | K::QuotaExceeded | K::FileTooLarge))
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
            K::NotFound => "check the path",
            K::PermissionDenied => "check the permissions of the file and its folder",
            K::StorageFull => "free space on that disk or choose another folder",
            K::ReadOnlyFilesystem => "choose a folder on a disk that can be written",
            K::NotADirectory | K::IsADirectory => "check whether a file or a folder is meant",
            K::UnexpectedEof => "the file is cut short: copy or write it again",
            _ => "check the disk and the path, then try again",
        };
        InputError { kind: Some(source.kind()), ..InputError::new(file, format!("{doing} failed: {source}"), remedy) }
    }
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
