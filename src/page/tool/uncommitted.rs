//! Stores without a commit: how to tell them from checkpoints, and their removal for the next run.
//!
//! A process that is killed before its first commit leaves a FORMAT file and perhaps segments. No run can resume from
//! them, so removing them loses nothing.
//!
//! Invariants: 1. a store that cannot be opened counts as a checkpoint and stays; 2. the store's lock is held from the
//! first check to the removal of the last file.

use crate::base::error::InputResult;
use crate::page::folder::protocol_files::MAP_NAME;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::folder::spill_dir::segments_in;
use crate::page::tool::reading::latest_generation;
use std::path::Path;

impl SpillDir {
    /// Whether the store certainly holds no commit: its map says so, or it has neither a map nor a segment (a process
    /// was killed while it created or removed the store).
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn holds_no_commit(&self) -> InputResult<bool> {
        if std::fs::symlink_metadata(self.folder().join(MAP_NAME)).is_err() {
            return Ok(segments_in(self.folder())?.is_empty());
        }
        Ok(latest_generation(self.folder(), self.format().store).is_ok_and(|latest| latest == 0))
    }
}

/// Removes the store in `folder` if it holds no commit, so that a run can create its own there. Returns whether it did.
/// Everything else stays unchanged: no store, a checkpoint, a store that cannot be opened or is in use.
///
/// # Errors
/// A file of the store cannot be removed.
pub fn remove_uncommitted(folder: &Path, allow_remote: bool) -> InputResult<bool> {
    // Creating a store in this folder will report why it cannot be used.
    let Ok(spill) = SpillDir::open(folder, allow_remote) else { return Ok(false) };
    if !spill.holds_no_commit()? {
        return Ok(false);
    }
    spill.remove()?;
    Ok(true)
}
