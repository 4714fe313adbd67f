//! Folders of a run: the drive of its spill directory, and a folder for temporary files. For the checkpoint folder see
//! [`crate::config::values::Residence`].

use std::path::{Path, PathBuf};

/// The nearest existing folder above the spill directory, for unnamed temporary files on its drive. The spill directory
/// itself may not exist yet and must stay empty.
pub(crate) fn folder_beside(spill_dir: &Path) -> PathBuf {
    let above = spill_dir.ancestors().skip(1).find(|folder| folder.is_dir());
    above.map_or_else(|| PathBuf::from("."), Path::to_path_buf)
}

/// An existing folder on the drive of the spill directory: itself, or the nearest folder above it.
pub(crate) fn drive_of(spill_dir: &Path) -> PathBuf {
    if spill_dir.is_dir() { spill_dir.to_path_buf() } else { folder_beside(spill_dir) }
}

/// The absolute form of a path.
pub(crate) fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}
