//! The Gaussians of a trainer as a file of other programs.
//!
//! Not here: the formats (`crate::exchange`), when a run writes one ([`crate::train::run::training_loop`], `run_folder`).
//!
//! Invariant: a step that failed half-way is never saved.

use crate::base::error::InputError;
use crate::dataset::loader::Dataset;
use crate::exchange::format::ExportFormat;
use crate::exchange::meta::SceneMeta;
use crate::exchange::sink::Written;
use crate::scene::rotation::Rotation;
use crate::train::error::TrainError;
use crate::train::state::trainer::Trainer;
use std::path::Path;

/// Writes the rows at the current step as a PLY; returns what was written and in which coordinates.
/// Errors: the folder cannot be written, pages could not be pinned, or a failed step left pages of two steps.
pub fn save(trainer: &mut Trainer, dataset: &Dataset, path: &Path) -> Result<Written, TrainError> {
    export(trainer, dataset, path, ExportFormat::Ply)
}

/// Like [`save`], in another format.
/// Errors: as [`save`].
pub(crate) fn export(
    trainer: &mut Trainer,
    dataset: &Dataset,
    path: &Path,
    format: ExportFormat,
) -> Result<Written, TrainError> {
    if trainer.is_torn {
        let problem = "the last step failed half-way, so some Gaussians belong to the step before";
        let remedy = "resume the run from its last commit with gsscale-train --resume and the output folder";
        return Err(InputError::new(path, problem, remedy).into());
    }
    trainer.drain()?;
    let meta = scene_meta(trainer, dataset);
    let rows_at_most = trainer.scene.rows_bound();
    let mut sink = format.create(path, trainer.options.sh_degree, rows_at_most, &meta)?;
    trainer.scene.for_all_rows(trainer.steps_done(), &mut |rows| Ok::<(), TrainError>(sink.write(rows)?))?;
    Ok(sink.finish()?)
}

/// The metadata of a file of the rows at the current step.
pub(crate) fn scene_meta(trainer: &Trainer, dataset: &Dataset) -> SceneMeta {
    SceneMeta {
        step: Some(u64::from(trainer.steps_done())),
        origin: dataset.frame.origin.to_array(),
        scale: dataset.frame.scale,
        scene_radius: f64::from(dataset.scene_scale) * dataset.frame.scale,
        frame: trainer.options.export_frame,
        upright: trainer.options.up.and_then(Rotation::upright),
        ..SceneMeta::default()
    }
}
