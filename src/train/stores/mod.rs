//! The commands of gsscale-ckpt: list, inspect, verify, export, import, clone, salvage, rollback, prune.
//!
//! Each returns plain structs, which the tool prints as text or JSON.
//!
//! Invariants: 1. read-only commands write nothing ([`crate::page::tool::reading`]); 2. a command creates its store or
//! file whole or not at all; 3. values of rows come from the trainer's code.

mod change;
mod export;
mod import;
mod inspect;
pub mod ownership;
mod salvage;

pub use change::{ClonedStore, PruneRequest, Pruned, RolledBack, clone_store, prune, rollback};
pub use export::{ExportRequest, Exported, ListedPage, StoredStart, export};
pub use import::{ImportRequest, Imported, import};
pub use inspect::{
    GenerationLine, Inspected, Listed, PageInspected, StoreFault, ValueSpread, Verdict, inspect, inspect_page, list,
    verify,
};
pub use salvage::{LostPage, SalvageRequest, Salvaged, salvage};

use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::say::shell_word;
use crate::base::text::own_json;
use crate::checkpoint::run_state::RunState;
use crate::config::file::{TrainConfig, read_resolved};
use crate::config::limits::RunOptions;
use crate::page::folder::spill_dir::segments_in;
use crate::page::tool::reading::{Access, ReadError, StoreReader, WitnessRule};
use crate::report::run_files::{CONFIG_FILE, PLY_FILE, SUMMARY_FILE};
use crate::train::error::TrainError;
use crate::train::stores::ownership::check_owner;
use std::path::{Path, PathBuf};

impl From<ReadError> for TrainError {
    fn from(error: ReadError) -> TrainError {
        match error {
            ReadError::Input(error) => error.into(),
            ReadError::Commit(error) => error.into(),
        }
    }
}

/// The store that the user named.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StorePlace {
    /// The spill directory.
    pub folder: PathBuf,
    /// The output folder of its run, if the user named that.
    pub run: Option<PathBuf>,
    /// Identity of that run; unknown if the user named the store itself.
    pub id: RunId,
}

impl StorePlace {
    /// Opens the store, which must belong to the named run.
    /// Errors: the store cannot be opened, is in use (for access to pages), or holds the checkpoint of another run.
    fn open(&self, access: Access) -> Result<StoreReader, TrainError> {
        let store = StoreReader::open(&self.folder, access, WitnessRule::Obeyed)?;
        self.check_owner(&store)?;
        Ok(store)
    }

    /// Refuses the checkpoint of another run: the path in a run's config may lead to one by now.
    /// Errors: the store belongs to another run.
    fn check_owner(&self, store: &StoreReader) -> Result<(), TrainError> {
        let latest = store.generations().latest();
        if latest == 0 || !self.id.is_known() {
            return Ok(());
        }
        Ok(check_owner(&self.folder, &run_state_of(store, latest)?.origin.run, self.id)?)
    }
}

/// Finds the store of a run's output folder; `dir` may also be the spill directory itself.
/// Errors: there is no store.
pub fn find_store(dir: &Path) -> InputResult<StorePlace> {
    if !dir.is_dir() {
        let problem = if dir.exists() { "this is no folder" } else { "there is no such folder" };
        return Err(InputError::new(dir, problem, "name a run's output folder or its spill directory"));
    }
    // If FORMAT is lost, the segments identify a store.
    if dir.join("FORMAT").exists() || segments_in(dir).is_ok_and(|segments| !segments.is_empty()) {
        return Ok(StorePlace { folder: dir.to_path_buf(), run: None, id: RunId::UNKNOWN });
    }
    let file = dir.join(CONFIG_FILE);
    if !file.is_file() {
        let remedy = "name a run's output folder or its spill directory";
        return Err(InputError::new(dir, "it is neither a store nor a run's output folder", remedy));
    }
    let config = TrainConfig::read(&file)?;
    let folder = config.residence().checkpoint_folder(dir);
    if folder.is_dir() {
        let id = read_resolved(&file)?.run;
        return Ok(StorePlace { folder, run: Some(dir.to_path_buf()), id });
    }
    let (why, remedy) = match dir.join(PLY_FILE).is_file() {
        _ if config.residence().spill_dir().is_some() && (config.keep_checkpoint || !is_finished(dir)) => {
            ("its pages may have been moved", "name their folder instead: gsscale-ckpt ls FOLDER".to_string())
        }
        true => {
            let ply = shell_word(dir.join(PLY_FILE));
            let remedy = format!(
                "its result is {ply}; for other formats: gsscale-ckpt import {ply} --out STORE, then gsscale-ckpt export STORE --out FILE.spz"
            );
            ("it is removed when a run ends", remedy)
        }
        false => (
            "the run has not made a commit",
            format!("wait for one if it still trains; if it was stopped: gsscale-train --resume {}", shell_word(dir)),
        ),
    };
    Err(InputError::new(dir, format!("the checkpoint of this run, {}, is not there: {why}", folder.display()), remedy))
}

/// Whether the run in a folder has done all of its steps.
fn is_finished(out: &Path) -> bool {
    own_json(&out.join(SUMMARY_FILE)).is_some_and(|summary: serde_json::Value| summary["finished"] == true)
}

/// The run state of a generation.
/// Errors: the state cannot be read, or another version of the program wrote it.
pub fn run_state_of(store: &StoreReader, generation: u64) -> Result<RunState, TrainError> {
    let bytes = store.run_state(generation)?;
    let wrong = |problem: String| InputError::new(store.folder(), problem, "use the program that made it");
    Ok(RunState::from_bytes(&bytes).map_err(|e| wrong(e).at(format!("generation {generation}")))?)
}

fn options_of(store: &Path, state: &RunState) -> InputResult<(TrainConfig, RunOptions)> {
    let config = TrainConfig::parse(&state.origin.config)
        .map_err(|problem| InputError::new(store, problem, "use the program that made it").at("config of the run"))?;
    let options = RunOptions::new(&config, state.origin.dataset.scene_scale);
    let options = RunOptions { sh_degree_start: state.origin.sh_degree_start, ..options };
    Ok((config, options))
}
