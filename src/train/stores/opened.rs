//! A checkpoint opened for writing, at its last commit.
//!
//! Not here: the pager and tiers of a run that resumes from it (`start::tiers`); reading without writing
//! ([`crate::page::tool::reading`]).

use crate::base::error::{InputError, InputResult};
use crate::checkpoint::run_state::RunState;
use crate::page::engine::open::{DEPTH, IoEngine, open_engine};
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::map::commit::{CommitConfig, CommitError};
use crate::page::map::opening::Opened;
use crate::page::tool::uncommitted::holds_no_commit;
use crate::train::commits::checkpoint::reserve_bytes;
use crate::train::commits::first_commit::MAP_CACHE_BYTES;
use crate::train::error::TrainError;
use std::path::Path;

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
            InputError::new(
                folder,
                e.to_string(),
                "resume with the program version that made it, or start the run again",
            )
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
