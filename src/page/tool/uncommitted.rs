//! Stores without a commit: how to tell them from checkpoints, and their removal for the next run.
//!
//! A process that is killed before its first commit leaves a FORMAT file and perhaps segments. No run can resume from
//! them, so removing them loses nothing.
//!
//! Invariants: 1. a store that cannot be opened counts as a checkpoint and stays; 2. the store's lock is held from the
//! first check to the removal of the last file.

use crate::base::error::InputResult;
use crate::page::folder::protocol_files::MAP_NAME;
use crate::page::folder::spill_dir::{SpillDir, check_new, of_another_run, segments_in};
use crate::page::format::spill_format::SlotLayout;
use crate::page::tool::reading::{format_at, latest_generation, refuse_if_in_use};
use std::path::Path;

/// Whether an open store certainly holds no commit: its map says so, or it has neither a map nor a segment (a process
/// was killed while it created or removed the store).
/// Errors: the folder cannot be read.
pub fn holds_no_commit(spill: &SpillDir) -> InputResult<bool> {
    no_commit_in(spill.folder(), spill.format().store)
}

fn no_commit_in(folder: &Path, store: u128) -> InputResult<bool> {
    if std::fs::symlink_metadata(folder.join(MAP_NAME)).is_err() {
        return Ok(segments_in(folder)?.is_empty());
    }
    Ok(latest_generation(folder, store).is_ok_and(|latest| latest == 0))
}

/// Whether the store in `folder` certainly holds no commit. Changes nothing.
/// Errors: there is no store, or the folder cannot be read.
pub fn is_uncommitted(folder: &Path) -> InputResult<bool> {
    no_commit_in(folder, format_at(folder)?.store)
}

/// Checks whether a new run may put its store into `folder`, and changes nothing: the refusals of [`SpillDir::create`] after
/// [`remove_uncommitted`].
/// Errors: the folder is not empty or cannot be used, or the store in it holds commits, cannot be opened, or is in use.
pub fn check_usable(folder: &Path) -> InputResult<()> {
    check_new(folder, false)?;
    if !SpillDir::exists_in(folder) {
        return Ok(());
    }
    let _lock = refuse_if_in_use(folder)?;
    match is_uncommitted(folder)? {
        true => Ok(()),
        false => Err(of_another_run(folder)),
    }
}

/// Creates a store with slots of this layout in `folder`, on a drive of this machine, in the place of a store that holds no commit.
/// Returns whether there was one.
/// Errors: as [`SpillDir::create`]; or the old store cannot be removed.
pub fn create_or_replace(folder: &Path, layout: SlotLayout) -> InputResult<(SpillDir, bool)> {
    if let Ok(spill) = SpillDir::open(folder, false)
        && holds_no_commit(&spill)?
    {
        return Ok((spill.replace(layout)?, true));
    }
    // This reports why a folder cannot be used.
    Ok((SpillDir::create(folder, layout, false)?, false))
}

/// Removes the store in `folder` if it holds no commit, so that a run can create its own there. Returns whether it did.
/// Everything else stays unchanged: no store, a checkpoint, a store that cannot be opened or is in use.
/// Errors: a file of the store cannot be removed.
pub fn remove_uncommitted(folder: &Path) -> InputResult<bool> {
    // Creating a store in this folder will report why it cannot be used.
    let Ok(spill) = SpillDir::open(folder, true) else { return Ok(false) };
    if !holds_no_commit(&spill)? {
        return Ok(false);
    }
    spill.remove()?;
    Ok(true)
}
