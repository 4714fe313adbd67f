//! Stores in which nothing was ever committed: how they are told from checkpoints, and how the next run gets their folder.
//!
//! A process that is killed before its first commit leaves a FORMAT file and perhaps segments. No run can go on from
//! them, so nothing is lost when they are removed.
//!
//! Invariants: 1. a store that cannot be opened counts as a checkpoint and is left alone; 2. the lock of the store is held
//! from the first look to the last file that is removed.

use crate::base::error::InputResult;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::format::spill_format::Purpose;
use crate::page::map::commit::MAP_NAME;
use crate::page::tool::reading::{latest_generation, segments_in};
use std::path::Path;

impl SpillDir {
    /// Whether the store is known to hold no commit: its map says so, or it has neither a map nor a segment (a process was
    /// killed while it made the store, or while it removed the store).
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

/// Removes the store in `folder` if it holds no commit, so that a run can make its own there. Tells whether there was one.
/// Everything else stays as it is: no store, a checkpoint, a store that cannot be opened or is in use.
///
/// # Errors
/// A file of the store cannot be removed.
pub fn remove_uncommitted(folder: &Path, allow_remote: bool) -> InputResult<bool> {
    // Why a folder cannot be used is said where a store is made in it.
    let Ok(spill) = SpillDir::open(folder, allow_remote) else { return Ok(false) };
    if spill.format().purpose != Purpose::Checkpoint || !spill.holds_no_commit()? {
        return Ok(false);
    }
    spill.remove()?;
    Ok(true)
}
