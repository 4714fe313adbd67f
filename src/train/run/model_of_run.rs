//! The Gaussians, the scene and the config that the name of a run, or of one of its files, stands for.

use crate::base::error::{InputError, InputResult};
use crate::base::say::shell_word;
use crate::base::text::own_json;
use crate::base::whole_file::folder_of;
use crate::config::file::{TrainConfig, read_resolved};
use crate::exchange::foreign::refuse_folder_of_sogs;
use crate::exchange::sog::is_tree;
use crate::page::folder::spill_dir::SpillDir;
use crate::report::run_files::{CONFIG_FILE, PLY_FILE, SUMMARY_FILE};
use crate::train::log::report::Summary;
use std::path::{Path, PathBuf};

/// What a run, or a file of Gaussians, stands for.
#[derive(Debug)]
pub struct ModelOfRun {
    /// The file of Gaussians; the folder of a store.
    pub file: PathBuf,
    pub scene: PathBuf,
    /// The config of the run, if the model lies in its folder or says its scene.
    pub config: Option<PathBuf>,
}

impl ModelOfRun {
    /// `model` is the output folder of a run, a file of Gaussians, or a store. Without `scene`, the run names it. Remedies name `program`.
    /// Errors: the model or the scene is not there, or no run names the scene.
    pub fn find(program: &str, model: &Path, scene: Option<PathBuf>) -> InputResult<ModelOfRun> {
        if !model.exists() {
            return Err(InputError::new(
                model,
                "does not exist",
                "name the output folder of a run, or a file of Gaussians",
            ));
        }
        let is_run = model.is_dir() && (model.join(CONFIG_FILE).is_file() || model.join(PLY_FILE).is_file());
        if is_run && !model.join(PLY_FILE).is_file() {
            return Err(without_result(model));
        }
        refuse_folder_of_sogs(model)?;
        let file = if is_run { model.join(PLY_FILE) } else { model.to_path_buf() };
        if let Some(scene) = scene {
            // A folder that another program wrote has no config.
            let config = is_run.then(|| model.join(CONFIG_FILE)).filter(|config| config.is_file());
            return Ok(ModelOfRun { file, scene, config });
        }
        let (scene, config) = scene_of(program, &file)?;
        Ok(ModelOfRun { file, scene, config: Some(config) })
    }
}

/// The Gaussians that the files of the run in this folder lack; 0 if its summary cannot be read.
pub fn gaussians_left_out(run: &Path) -> u64 {
    read_summary(run).map_or(0, |summary| summary.gaussians_left_out)
}

/// The summary of the finished run in this folder.
pub(super) fn read_summary(run: &Path) -> Option<Summary> {
    own_json(&run.join(SUMMARY_FILE))
}

/// The error for the folder of a run that has no result yet.
fn without_result(run: &Path) -> InputError {
    let resume = format!("gsscale-train --resume {}", shell_word(run));
    let folder = TrainConfig::read(&run.join(CONFIG_FILE)).map(|config| config.residence().checkpoint_folder(run));
    let remedy = match folder.ok().filter(|folder| SpillDir::exists_in(folder)) {
        None => format!("if it was stopped, go on with it: {resume}"),
        Some(folder) => {
            // Only a store inside of a run's folder says its scene.
            let scene = if folder.starts_with(run) { "" } else { " SCENE" };
            let folder = shell_word(folder);
            format!(
                "if it was stopped, look at its last commit (gsscale-view {folder}{scene}) or go on with it ({resume})"
            )
        }
    };
    InputError::new(run, format!("the run still trains or was stopped: there is no {PLY_FILE}"), remedy)
}

/// The scene and the config file of the run that wrote `file`: a PLY in the run's folder, or a folder of SOGs or a store there.
fn scene_of(program: &str, file: &Path) -> InputResult<(PathBuf, PathBuf)> {
    let whole = std::path::absolute(file).map_err(|e| InputError::io(file, "finding its folder", &e))?;
    let folder = if is_tree(&whole) { folder_of(folder_of(&whole)) } else { folder_of(&whole) };
    let config = folder.join(CONFIG_FILE);
    if !config.is_file() && file.is_dir() {
        let remedy = format!(
            "name the output folder of a run ({program} runs/NAME), or Gaussians and their scene ({program} FILE SCENE)"
        );
        return Err(InputError::new(file, "this folder holds no run", remedy));
    }
    if !config.is_file() {
        let problem = "a file outside of a run's folder does not say its scene";
        return Err(InputError::new(file, problem, format!("name the scene: {program} FILE SCENE")));
    }
    let scene = read_resolved(&config)?.scene;
    if scene.exists() {
        return Ok((scene, config));
    }
    let remedy = format!("if it was moved: {program} {} SCENE", shell_word(file));
    Err(InputError::new(&scene, "the scene of this run is missing", remedy))
}
