//! Lists the kept generations of a store.

use super::{StorePlace, run_state_of};
use crate::page::tool::reading::Access;
use crate::train::error::TrainError;
use serde::Serialize;

/// A kept generation.
#[derive(Debug, Clone, Serialize)]
pub struct GenerationLine {
    /// Its number.
    pub generation: u64,
    pub names: Vec<String>,
    /// Whether `--resume` continues from it.
    pub is_latest: bool,
    /// Steps done.
    pub step: u32,
    /// Held-out PSNR of the last evaluation before it, dB; `None` without one.
    pub psnr: Option<f64>,
    /// Gaussians in its pages. Pages that no view has needed since the last events have not applied them.
    pub gaussians: u64,
    /// Gaussians at most, once all pages have applied all events.
    pub gaussians_at_most: u64,
    pub pages: u64,
    /// Bytes on the drive that no other kept generation needs.
    pub bytes_alone: u64,
    /// Bytes on the drive.
    pub bytes: u64,
}

/// All kept generations of a store.
#[derive(Debug, Clone, Serialize)]
pub struct Listed {
    pub store: std::path::PathBuf,
    /// The process that writes to it, if any.
    pub used_by: Option<String>,
    /// Bytes of its segment files.
    pub segment_bytes: u64,
    /// Generations, ascending.
    pub generations: Vec<GenerationLine>,
}

/// Lists the kept generations.
/// Errors: the store cannot be opened, or another version of the program wrote a run state.
pub fn list(place: &StorePlace) -> Result<Listed, TrainError> {
    let store = place.open(Access::Map)?;
    let mut generations = Vec::new();
    for used in store.disk_use()? {
        let state = run_state_of(&store, used.generation)?;
        generations.push(GenerationLine {
            generation: used.generation,
            names: used.names,
            is_latest: used.generation == store.generations().latest(),
            step: state.trainer.step,
            psnr: state.trainer.test.map(|test| test.psnr),
            gaussians: state.rows,
            gaussians_at_most: state.rows_bound,
            pages: used.pages,
            bytes_alone: used.bytes_alone,
            bytes: used.bytes,
        });
    }
    let segment_bytes = store.segments()?.iter().map(|(_, bytes)| bytes).sum();
    let used_by = store.used_by().map(str::to_string);
    Ok(Listed { store: place.folder.clone(), used_by, segment_bytes, generations })
}
