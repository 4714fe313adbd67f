//! Where files of a run lie: the drive of its spill directory, and a folder for what has no name. Where its checkpoint lies:
//! [`crate::config::residence`].

use std::path::{Path, PathBuf};

/// A folder on the drive of the spill directory, which may not be there yet and must stay empty: the nearest one above
/// it. What is written there has no name.
pub(super) fn folder_beside(spill_dir: &Path) -> PathBuf {
    let above = spill_dir.ancestors().skip(1).find(|folder| folder.is_dir());
    above.map_or_else(|| PathBuf::from("."), Path::to_path_buf)
}

/// The spill directory, or as long as it is not there the folder above it that is: what tells of its drive.
pub(super) fn drive_of(spill_dir: &Path) -> PathBuf {
    if spill_dir.is_dir() { spill_dir.to_path_buf() } else { folder_beside(spill_dir) }
}

/// A path that does not depend on where the program was started.
pub(super) fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}
