//! The mark of a run that has begun and has no config.toml yet: its settings, so that a resume can begin it again.
//!
//! A run reads its scene and makes its first pages before config.toml can say what they are. A run that is killed meanwhile, or
//! while it replaces an earlier run, leaves this file.
//!
//! Invariants: 1. a run that is refused leaves no mark and no folder that it made; 2. a mark lies only in a folder that was new,
//! empty or a run's that is to be replaced, so everything beside it is a run's.

use super::changes::with_absolute_paths;
use super::out_folder::{is_empty, make_folder};
use super::request::RunRequest;
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole;
use crate::config::file::{TrainConfig, TrainOverrides};
use crate::report::run_files::{BEGUN_FILE, CONFIG_FILE};
use crate::train::inputs::machine::absolute;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A mark under way. Dropping it removes the mark and the folders that were made for it, if nothing else lies there.
pub(super) struct Beginning {
    out: PathBuf,
    /// Folders that did not exist, the innermost first.
    folders: Vec<PathBuf>,
    /// An earlier process made the mark: it stays if this one is refused.
    was_there: bool,
}

/// What a mark holds beside the settings, in the table of config.toml.
#[derive(Serialize, Deserialize)]
struct Mark {
    resolved: Facts,
}

#[derive(Serialize, Deserialize)]
struct Facts {
    scene: PathBuf,
}

impl Beginning {
    /// Marks the output folder of a request, if it is new, empty, or marked already.
    /// Errors: the folder cannot be written.
    pub fn mark(request: &RunRequest) -> InputResult<Option<Beginning>> {
        let out = request.out.clone();
        if request.dry_run || (out.exists() && !is_empty(&out) && !is_marked(&out)) {
            return Ok(None);
        }
        let is_new = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
        let folders = out.ancestors().take_while(is_new).map(Path::to_path_buf).collect();
        let beginning = Beginning { was_there: is_marked(&out), folders, out };
        make_folder(&beginning.out)?;
        write_mark(request)?;
        Ok(Some(beginning))
    }
}

impl Drop for Beginning {
    fn drop(&mut self) {
        // Folders that hold something stay. Where nothing can be removed, the mark costs the next run nothing.
        if !self.was_there {
            remove_mark(&self.out);
            self.folders.iter().take_while(|folder| std::fs::remove_dir(folder).is_ok()).for_each(drop);
        }
    }
}

/// Whether a run has begun in this folder that has no config.toml.
pub(super) fn is_marked(out: &Path) -> bool {
    out.join(BEGUN_FILE).is_file() && !out.join(CONFIG_FILE).exists()
}

/// Writes the mark into an existing folder.
/// Errors: the folder cannot be written.
pub(super) fn write_mark(request: &RunRequest) -> InputResult<()> {
    let path = request.out.join(BEGUN_FILE);
    let fail = |e: toml::ser::Error| InputError::new(&path, e.to_string(), "report this as a bug");
    let config = toml::to_string(&with_absolute_paths(request.config.clone())).map_err(fail)?;
    let facts = toml::to_string(&Mark { resolved: Facts { scene: absolute(&request.scene) } }).map_err(fail)?;
    write_whole(&path, format!("{config}\n{facts}").as_bytes())
}

/// Removes the mark of a run that has a config.toml now. One that stays is ignored.
pub(super) fn remove_mark(out: &Path) {
    let _ = std::fs::remove_file(out.join(BEGUN_FILE));
}

/// The settings and the scene of a run that has only a mark, with those that are given now; `None` without a mark.
/// Errors: the file is not such a mark, or the settings do not fit together.
pub(super) fn settings_of_mark(
    out: &Path,
    keys: &TrainOverrides,
    scene: Option<&Path>,
) -> InputResult<Option<(TrainConfig, PathBuf)>> {
    if !is_marked(out) {
        return Ok(None);
    }
    let path = out.join(BEGUN_FILE);
    let remedy = "remove the file, and start the run again with its first command";
    let refuse = |problem: String| InputError::new(&path, problem, remedy);
    let text = std::fs::read_to_string(&path).map_err(|e| InputError::io(&path, "reading the settings", &e))?;
    let mut config = TrainConfig::parse(&text).map_err(refuse)?;
    let Mark { resolved } = toml::from_str(&text).map_err(|e| refuse(e.to_string()))?;
    keys.clone().apply(&mut config);
    config.check()?;
    Ok(Some((config, scene.map_or(resolved.scene, Path::to_path_buf))))
}
