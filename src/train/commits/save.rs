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
use crate::report::run_files::PLY_FILE;
use crate::scene::rotation::Rotation;
use crate::train::error::TrainError;
use crate::train::state::trainer::Trainer;
use std::path::{Path, PathBuf};

impl Trainer {
    /// Writes the rows at the current step as a PLY; returns what was written and in which coordinates.
    ///
    /// # Errors
    /// The folder cannot be written, pages could not be pinned, or a failed step left pages of two steps.
    pub fn save(&mut self, dataset: &Dataset, path: &Path) -> Result<Written, TrainError> {
        self.export(dataset, path, ExportFormat::Ply)
    }

    /// Like [`Trainer::save`], in another format.
    ///
    /// # Errors
    /// As [`Trainer::save`].
    pub(crate) fn export(
        &mut self,
        dataset: &Dataset,
        path: &Path,
        format: ExportFormat,
    ) -> Result<Written, TrainError> {
        if self.is_torn {
            let problem = "the last step failed half-way, so some Gaussians belong to the step before";
            let remedy = "resume the run from its last commit with gsscale-train --resume and the output folder";
            return Err(InputError::new(path, problem, remedy).into());
        }
        self.drain()?;
        let meta = self.scene_meta(dataset);
        let rows_at_most = self.scene.rows_bound();
        let mut sink = format.create(path, self.options.sh_degree, rows_at_most, &meta)?;
        self.scene.for_all_rows(self.state.step, &mut |rows| Ok::<(), TrainError>(sink.write(rows)?))?;
        Ok(sink.finish()?)
    }

    /// The metadata of a file of the rows at the current step.
    pub(crate) fn scene_meta(&self, dataset: &Dataset) -> SceneMeta {
        SceneMeta {
            step: Some(u64::from(self.state.step)),
            origin: dataset.frame.origin.to_array(),
            scale: dataset.frame.scale,
            scene_radius: f64::from(dataset.scene_scale) * dataset.frame.scale,
            frame: self.options.export_frame,
            upright: self.options.up.and_then(Rotation::upright),
            ..SceneMeta::default()
        }
    }

    /// Path of the final PLY in an output folder.
    pub fn ply_path(out: &Path) -> PathBuf {
        out.join(PLY_FILE)
    }
}
