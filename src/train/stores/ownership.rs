//! Ownership of stores: which run a store belongs to, and who may delete what; and a checkpoint opened for writing, at its last commit.
//!
//! A run draws an identity when it begins ([`RunId`]) and writes it to its config.toml and into every commit. A path is
//! not an identity: another run can create a new spill directory under the same name.
//!
//! | who | may delete | only if |
//! | --- | --- | --- |
//! | a run that begins with `--spill-dir P` | the store in `P` | the store holds no commit ([`crate::page::tool::uncommitted`]) |
//! | a run in memory, at its first commit | the store in `OUT/checkpoint` | the store holds no commit |
//! | a run that ends, `--keep-checkpoint` absent | the store that it made or resumed from | this process holds the store's lock, and FORMAT has the store's identity |
//! | a run that is refused or fails before its first commit | the store that it made | as above |
//! | `--resume OUT` of a finished run | the checkpoint that a kill left in the run's own folder | the last commit has the identity of the run in `OUT`, and `--keep-checkpoint` is absent |
//! | `--overwrite` | the store in `OUT/checkpoint` | the store holds no commit, or its last commit has the identity of the run in `OUT` |
//! | any run | anything in `OUT` | it holds the lock of `OUT` |
//! | `--resume OUT` of a run that was cut off before its first commit | metrics and event files in `OUT` | there is neither a result nor a saved PLY nor a logged commit |
//! | `--overwrite` | results in `OUT`, by name; pictures in `renders/test` | there is a config.toml beside them |
//! | `gsscale-ckpt rollback`, `prune` with `OUT` | generations and names of the store that `OUT` leads to | the last commit has the identity of the run in `OUT` |
//! | `gsscale-ckpt clone`, `salvage`, `import` | their own unfinished store | the folder was made by this process |
//! | a sweep of `gsscale-bench` | its own unfinished runs and their pages | the folder has the sweep's mark in its name, or its record in it |
//!
//! In all cases, files inside a spill directory are deleted by the store's identity ([`SpillDir::remove`]); other files
//! stay, and so does a store that cannot be opened.

use super::run_state_of;
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::say::shell_word;
use crate::checkpoint::run_state::{RunIdentity, RunState};
use crate::page::engine::open::{DEPTH, IoEngine, open_engine};
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::map::commit::{CommitConfig, CommitError};
use crate::page::map::opening::Opened;
use crate::page::tool::reading::{Access, StoreReader, WitnessRule};
use crate::page::tool::uncommitted::{holds_no_commit, is_uncommitted, remove_uncommitted};
use crate::train::commits::checkpoint::{MAP_CACHE_BYTES, reserve_bytes};
use crate::train::error::TrainError;
use crate::train::inputs::machine::absolute;
use std::path::Path;

/// Refuses the checkpoint of another run.
/// Errors: `of_store` and `run` are both known and differ.
pub(super) fn check_owner(folder: &Path, of_store: &RunIdentity, run: RunId) -> InputResult<()> {
    if !of_store.id.is_known_to_differ(run) {
        return Ok(());
    }
    let (problem, remedy) = match of_store.out.as_str() {
        "" => (
            String::from("it holds the checkpoint of another run"),
            String::from("name the folder that holds the pages of this run with --spill-dir"),
        ),
        out => (
            format!("it holds the checkpoint of another run, that of {out}"),
            format!(
                "name the folder that holds the pages of this run with --spill-dir; the other run continues with \
                 gsscale-train --resume {}",
                shell_word(out)
            ),
        ),
    };
    Err(InputError::new(folder, problem, remedy))
}

/// The run that a checkpoint must belong to.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Claim<'a> {
    /// Its identity; unknown if its config.toml has none.
    pub run: RunId,
    /// Its output folder.
    pub out: &'a Path,
    /// The user named the folder of the checkpoint on this command line.
    pub is_named: bool,
}

impl Claim<'_> {
    /// Refuses the checkpoint of another run. A run without an identity owns a checkpoint that names its output folder
    /// or that the user named.
    fn check(&self, folder: &Path, of_store: &RunIdentity) -> InputResult<()> {
        let out = absolute(self.out);
        let is_here = Path::new(&of_store.out) == out;
        if !self.run.is_known() && of_store.id.is_known() && !self.is_named && !is_here {
            return check_owner(folder, of_store, RunId::draw());
        }
        if is_here && of_store.id.is_known_to_differ(self.run) {
            let problem = "it holds the checkpoint of an earlier run in the same output folder";
            let remedy = "name the folder that holds the pages of this run with --spill-dir; to resume the earlier run, \
                          name a new output folder and this folder with --spill-dir";
            return Err(InputError::new(folder, problem, remedy));
        }
        check_owner(folder, of_store, self.run)
    }
}

/// Opens the checkpoint in `folder`; `None` if it has no commit.
/// Errors: the checkpoint belongs to another run, cannot be opened, or is in use.
pub(crate) fn open_own(folder: &Path, claim: Claim<'_>, allow_remote: bool) -> Result<Option<Stored>, TrainError> {
    // Opening a map for writing changes its file, so check the owner by reading. An unreadable map is refused below.
    if let Ok(state) = last_state(folder, Access::Map) {
        claim.check(folder, &state.origin.run)?;
    }
    let Some(stored) = Stored::open(folder, allow_remote)? else { return Ok(None) };
    claim.check(folder, &stored.run_state.origin.run)?;
    Ok(Some(stored))
}

/// The run state of the checkpoint in `folder`, without a change; `None` if it has no commit.
/// Errors: as [`open_own`], but a checkpoint in use is no error.
pub(crate) fn read_own(folder: &Path, claim: Claim<'_>) -> Result<Option<RunState>, TrainError> {
    if is_uncommitted(folder)? {
        return Ok(None);
    }
    let state = last_state(folder, Access::Map)?;
    claim.check(folder, &state.origin.run)?;
    Ok(Some(state))
}

/// Reads the run state of the last commit without writing.
/// Errors: the store has no commit or cannot be opened.
pub(crate) fn last_state(folder: &Path, access: Access) -> Result<RunState, TrainError> {
    let store = StoreReader::open(folder, access, WitnessRule::Obeyed)?;
    run_state_of(&store, store.find(None)?)
}

/// Removes the checkpoint that `run` left in its output folder, for a run that starts over there.
/// Errors: the checkpoint belongs to another run, cannot be opened, or is in use; it stays, and the new run must not
/// begin.
pub(crate) fn remove_checkpoint_in(folder: &Path, run: RunId) -> Result<(), TrainError> {
    check_removable(folder, run)?;
    if SpillDir::exists_in(folder) && !remove_uncommitted(folder)? {
        SpillDir::open(folder, true)?.remove()?;
    }
    // Succeeds only if the folder is empty.
    let _ = std::fs::remove_dir(folder);
    Ok(())
}

/// Checks whether [`remove_checkpoint_in`] may remove the checkpoint.
/// Errors: as [`remove_checkpoint_in`].
pub(crate) fn check_removable(folder: &Path, run: RunId) -> Result<(), TrainError> {
    if !SpillDir::exists_in(folder) || holds_no_commit(&SpillDir::open(folder, true)?)? {
        return Ok(());
    }
    let by_hand = format!("if you do not need it, remove it (rm -r {}), or choose another --out", shell_word(folder));
    let refuse = |problem: String| InputError::new(folder, problem, by_hand.clone());
    let state = last_state(folder, Access::Pages)
        .map_err(|e| refuse(format!("the checkpoint in it cannot be opened, so it is not removed: {e}")))?;
    if state.origin.run.id.is_known() && state.origin.run.id == run {
        return Ok(());
    }
    let whose =
        if state.origin.run.out.is_empty() { String::new() } else { format!(", that of {}", state.origin.run.out) };
    Err(refuse(format!("it holds the checkpoint of another run{whose}, so it is not removed")).into())
}

/// Settings of commits to the store in `spill`.
pub(crate) fn commit_config(spill: &SpillDir) -> CommitConfig {
    let reserve_bytes = reserve_bytes(spill.format().layout.segment_bytes());
    CommitConfig { store: spill.format().store, cache_bytes: MAP_CACHE_BYTES, reserve_bytes }
}

/// An opened checkpoint.
pub struct Stored {
    pub(crate) spill: SpillDir,
    pub(crate) opened: Opened,
    /// State of the run without its pages.
    pub run_state: RunState,
}

impl Stored {
    /// Opens the checkpoint in `folder` at its last commit; `None` for a store without commits. An empty folder is an
    /// error, since it may be the mount point of an unmounted drive. `allow_remote` allows network file systems.
    /// Errors: there is no store, or it is damaged or in use.
    pub fn open(folder: &Path, allow_remote: bool) -> Result<Option<Stored>, TrainError> {
        if !SpillDir::exists_in(folder) {
            let problem = "the checkpoint of this run is not there: it is removed when a run ends without \
                           --keep-checkpoint, and made by the first commit";
            let remedy = "if its drive is not mounted, mount it; if its pages were moved, name their folder with --spill-dir; \
                          if it is lost, start a new run with another --out and --init-ply with the PLY of this one";
            return Err(InputError::new(folder, problem, remedy).into());
        }
        let spill = SpillDir::open(folder, allow_remote)?;
        if holds_no_commit(&spill)? {
            return Ok(None);
        }
        let opened = match Opened::open(Box::new(DriveFolder::new(folder)), commit_config(&spill)) {
            Err(error @ CommitError::NoStore) => {
                let remedy = "gsscale-ckpt salvage rebuilds the map from the pages, in another folder";
                return Err(InputError::new(folder, error.to_string(), remedy).into());
            }
            opened => opened?,
        };
        let run_state = RunState::from_bytes(&opened.run_state).map_err(|e| {
            InputError::new(folder, e, "resume with the program version that made it, or start the run again")
        })?;
        Ok(Some(Stored { spill, opened, run_state }))
    }

    /// Whether the checkpoint lies in `folder`.
    pub fn is_in(&self, folder: &Path) -> bool {
        let [here, there] = [self.spill.folder(), folder].map(|path| path.canonicalize().ok());
        here.is_some() && here == there
    }

    /// Removes the folder with the checkpoint at the end: an earlier process of the run made it.
    pub fn adopt_folder(&mut self) {
        self.spill.adopt_folder();
    }

    /// Removes the checkpoint. Returns the names of files that stay because they do not belong to the store.
    /// Errors: a file cannot be removed.
    pub fn remove(self) -> InputResult<Vec<String>> {
        drop(self.opened);
        self.spill.remove()
    }

    /// Whether all segments with kept pages exist. A kill during removal leaves a map without segments.
    pub fn is_whole(&self) -> bool {
        let engine = open_engine(IoEngine::Pread, self.spill.folder(), DEPTH);
        let layout = self.spill.format().layout;
        engine.is_ok_and(|engine| self.opened.check_segments(&*engine.store, layout).is_ok())
    }
}
