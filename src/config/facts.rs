//! The config.toml of a run: every setting, and facts resolved at its start (`[resolved]`).
//!
//! Invariant: the file is a valid `--config`. Resume and evaluation read its facts.

use super::file::{FILE_BYTES_MAX, TrainConfig};
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::text::read_text;
use crate::base::whole_file::write_whole;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Facts of a run that follow from its config, scene and machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Resolved {
    pub version: String,
    /// Identity of the run; its commits hold it too. Unknown if somebody removed the line.
    #[serde(default)]
    pub run: RunId,
    pub scene: PathBuf,
    pub simd: String,
    pub threads: usize,
    /// The renderer: "cpu", or the name of the GPU with its driver.
    pub device: String,
    pub train_views: usize,
    pub test_views: usize,
    /// Gaussians at the start.
    pub gaussians: u64,
    /// Origin removed from the dataset's coordinates.
    pub origin: [f64; 3],
    /// Scale removed from the dataset's coordinates.
    pub scale: f64,
    /// Scene scale, dataset units.
    pub scene_scale: f64,
    /// The run made the folder of its spill directory, and so removes it at its end; not if the line is missing.
    #[serde(default)]
    pub made_spill_dir: bool,
}

/// Writes config.toml: every key, then the facts. Errors: the folder cannot be written.
pub fn write_config(path: &Path, config: &TrainConfig, resolved: &Resolved) -> InputResult<()> {
    let fail = |e: toml::ser::Error| InputError::new(path, format!("writing failed: {e}"), "report this as a bug");
    let mut text = toml::to_string(config).map_err(fail)?;
    text.push_str("\n[resolved]\n");
    text.push_str(&toml::to_string(resolved).map_err(fail)?);
    write_whole(path, text.as_bytes())
}

/// Reads the facts back from a run's config.toml. Errors: the file has no `[resolved]` table of a run.
pub fn read_resolved(path: &Path) -> InputResult<Resolved> {
    let text = read_text(path, FILE_BYTES_MAX, "name the output folder of a run")?;
    let refuse = |problem: String| InputError::new(path, problem, "name the output folder of a run");
    let mut table: toml::Table = text.parse().map_err(|e: toml::de::Error| refuse(e.to_string()))?;
    let resolved = table.remove("resolved").ok_or_else(|| refuse("it has no table [resolved]".to_string()))?;
    Resolved::deserialize(resolved).map_err(|e| refuse(e.to_string()))
}
