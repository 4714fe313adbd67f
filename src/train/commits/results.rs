//! The Gaussians of a trainer as a file of other programs, and the results of a run on a full drive: what finds no space is written again
//! once there is space.
//!
//! All results share one wait of `--disk-full-wait`. Meanwhile the run tries to commit its last step, so that no step is lost if
//! no space is freed, and says what can be saved on another drive. A run that was asked to stop does not wait.
//!
//! Not here: the formats (`crate::exchange`), commits and metrics between steps ([`super::checkpoint`]), what the results are (`run_folder`).
//!
//! Invariants: 1. waiting does not change the results; 2. a step that failed half-way is never saved.

use super::checkpoint::{Checkpoint, POLL};
use crate::base::error::{InputError, InputResult};
use crate::base::even_sample::EvenSample;
use crate::base::say::shell_word;
use crate::base::units::format_bytes;
use crate::base::whole_file::write_whole;
use crate::dataset::loader::Dataset;
use crate::exchange::clean::{SeeingPhotos, photos_required};
use crate::exchange::format::ExportFormat;
use crate::exchange::frames::ExportRows;
use crate::exchange::meta::SceneMeta;
use crate::exchange::sink::Written;
use crate::exchange::start_view::{StartView, settings_path};
use crate::page::folder::file_system::free_bytes;
use crate::report::run_files::PLY_FILE;
use crate::scene::rotation::Rotation;
use crate::train::error::TrainError;
use crate::train::inputs::signals::StopFlag;
use crate::train::log::report::MetricsLog;
use crate::train::state::trainer::Trainer;
use std::path::Path;
use std::time::{Duration, Instant};

/// Pages in the sample by which exports decide, and means in it by which exports estimate the depth of the scene:
/// enough for shares of a thousandth, and read in a second.
const SAMPLE_PAGES: usize = 512;
const SAMPLE_ROWS: usize = 8192;

/// What the results of a run are written with.
pub(crate) struct Results<'a> {
    /// The run after its last step.
    pub trainer: &'a mut Trainer,
    /// Writer of metrics.jsonl.
    pub metrics: &'a mut MetricsLog,
    /// The run's checkpoint, if it has one.
    pub checkpoint: Option<&'a mut Checkpoint>,
    pub out: &'a Path,
    pub stop: &'a StopFlag,
    /// What is left of `--disk-full-wait`.
    pub wait: Duration,
    /// The PLY of the last step is written.
    pub has_ply: bool,
}

impl Results<'_> {
    /// Writes a result with `write`, again and again while the drive is full.
    /// Errors: no space was freed in time, or an error other than a lack of space.
    pub fn write<T>(&mut self, mut write: impl FnMut(&mut Self) -> Result<T, TrainError>) -> Result<T, TrainError> {
        let mut paused = None;
        loop {
            match write(self) {
                Err(error) if error.is_out_of_space() && self.stop.exit_code().is_none() => {
                    let is_first = paused.is_none();
                    let began = *paused.get_or_insert_with(Instant::now);
                    if !self.has_last_step() {
                        // A failure changes nothing: the result is tried again anyway.
                        let _ = self.commit();
                    }
                    if is_first && !self.wait.is_zero() {
                        self.tell_pause(&error);
                    }
                    self.await_space(began);
                    if began.elapsed() >= self.wait {
                        self.wait = Duration::ZERO;
                        return Err(self.drive_full(&error));
                    }
                }
                done => {
                    if let (Some(began), Ok(_)) = (paused, &done) {
                        crate::tell!(
                            "there is space again after {:.0} s: the run goes on",
                            began.elapsed().as_secs_f64()
                        );
                        self.wait = self.wait.saturating_sub(began.elapsed());
                    }
                    return done;
                }
            }
        }
    }

    /// Commits the last step at once.
    /// Errors: as [`Checkpoint::commit`].
    pub fn commit(&mut self) -> Result<(), TrainError> {
        let Some(checkpoint) = self.checkpoint.as_deref_mut() else { return Ok(()) };
        checkpoint.commit(self.trainer, self.metrics)
    }

    fn has_last_step(&self) -> bool {
        let last = self.checkpoint.as_deref().and_then(|checkpoint| checkpoint.last_step);
        last == Some(self.trainer.steps_done())
    }

    fn free(&self) -> Option<u64> {
        free_bytes(self.out).ok().flatten()
    }

    fn tell_pause(&self, error: &TrainError) {
        let free = self.free().map_or(String::from("unknown"), format_bytes);
        crate::tell!(
            "paused: {error}\n  the drive of {} has {free} free. The results wait up to {:.0} s (--disk-full-wait) for space; \
             Ctrl-C ends the run without them{}",
            self.out.display(),
            self.wait.as_secs_f64(),
            self.elsewhere()
        );
    }

    /// Waits until there is more free space, a stop is requested, or the time is over. Also returns from time to time,
    /// since a quota, or a system that does not report its free space, shows no change.
    fn await_space(&self, began: Instant) {
        let then = self.free();
        // A result that is tried in vain costs time: an evaluation draws all held-out views.
        let (asked, is_over) = (Instant::now(), || began.elapsed() >= self.wait || self.stop.exit_code().is_some());
        while !is_over() {
            std::thread::sleep(POLL.min(self.wait / 20));
            let is_same = self.free().zip(then).is_some_and(|(now, then)| now <= then);
            if !is_same || asked.elapsed() >= 10 * POLL {
                return;
            }
        }
    }

    fn drive_full(&self, error: &TrainError) -> TrainError {
        let needed = match error {
            TrainError::Input(error) => format!("space for {}, and perhaps", error.file.display()),
            _ => "space for the last commit, and perhaps".to_string(),
        };
        TrainError::DriveFull {
            folder: self.out.display().to_string(),
            needed,
            last_step: self.checkpoint.as_deref().and_then(|checkpoint| checkpoint.last_step),
            elsewhere: self.elsewhere(),
        }
    }

    /// What can be saved on another drive now, as a line of a message.
    fn elsewhere(&self) -> String {
        let (out, step) = (shell_word(self.out), self.trainer.steps_done());
        match (self.has_ply, self.has_last_step()) {
            (true, _) => {
                format!("\n  {} is whole and can be copied to another drive", self.out.join(PLY_FILE).display())
            }
            (false, true) => format!(
                "\n  to save the Gaussians of step {step} on another drive, from the last commit, once this run has ended: \
                 gsscale-ckpt export {out} --out OTHER_DRIVE/point_cloud.ply"
            ),
            (false, false) => String::new(),
        }
    }
}

/// Writes all rows at the current step as a PLY; returns what was written and in which coordinates.
/// Errors: the folder cannot be written, pages could not be pinned, or a failed step left pages of two steps.
pub fn save(trainer: &mut Trainer, dataset: &Dataset, path: &Path) -> Result<Written, TrainError> {
    Ok(export(trainer, dataset, path, ExportFormat::Ply, &mut ExportChoice::default())?.0)
}

/// Like [`save`], in any format and without the rows that `choice` leaves out; returns also how many these are. A choice that
/// would leave out all leaves out none from then on, with a warning.
/// Errors: as [`save`].
pub(crate) fn export(
    trainer: &mut Trainer,
    dataset: &Dataset,
    path: &Path,
    format: ExportFormat,
    choice: &mut ExportChoice,
) -> Result<(Written, u64), TrainError> {
    settle(trainer, path)?;
    let meta = scene_meta(trainer, dataset);
    let rows_at_most = trainer.scene.rows_bound();
    let mut sink = format.create(path, trainer.options.sh_degree, rows_at_most, &meta)?;
    let (mut given, mut left_out) = (0, 0);
    trainer.scene.for_all_rows(trainer.steps_done(), &mut |rows| {
        given += rows.rows() as u64;
        let Some((photos, required)) = &choice.required else { return Ok::<(), TrainError>(sink.write(rows)?) };
        let (counts, mut kept) = (photos.of_rows(rows), rows.clone());
        left_out += kept.retain_rows(|_, row| counts[row] >= *required);
        Ok(sink.write(&kept)?)
    })?;
    if given == left_out && left_out > 0 {
        crate::tell!(
            "warning: {}: fewer than two photos see each of the {given} Gaussians, so all are kept",
            path.display()
        );
        drop(sink);
        choice.required = None;
        return export(trainer, dataset, path, format, choice);
    }
    Ok((sink.finish()?, left_out))
}

/// Makes the rows ready to be read.
/// Errors: a failed step left pages of two steps, so no file `path` can be written; or the device failed.
fn settle(trainer: &mut Trainer, path: &Path) -> Result<(), TrainError> {
    if trainer.is_torn {
        let problem = "the last step failed half-way, so some Gaussians belong to the step before";
        let remedy = "resume the run from its last commit with gsscale-train --resume and the output folder";
        return Err(InputError::new(path, problem, remedy).into());
    }
    trainer.drain()
}

/// Which Gaussians the result files contain, and the camera with which viewers start. The default: all Gaussians, no camera.
#[derive(Default)]
pub(crate) struct ExportChoice {
    /// The photos, and how many of them must see a Gaussian.
    required: Option<(SeeingPhotos, u8)>,
    start: Option<StartView>,
}

impl ExportChoice {
    /// Decides by the rows of at most [`SAMPLE_PAGES`] pages.
    /// Errors: as [`settle`], or pages could not be pinned.
    pub fn of_rows(trainer: &mut Trainer, dataset: &Dataset, path: &Path) -> Result<ExportChoice, TrainError> {
        settle(trainer, path)?;
        let (pages, now) = (trainer.scene.some_pages(SAMPLE_PAGES), trainer.steps_done());
        let mut sample = EvenSample::new(SAMPLE_ROWS);
        trainer.scene.for_rows_of(&pages, now, &mut |rows| {
            let means = rows.means.as_chunks::<3>().0.iter();
            means.filter(|mean| mean.iter().all(|x| x.is_finite())).for_each(|mean| sample.add(mean.map(f64::from)));
            Ok::<(), TrainError>(())
        })?;
        let cameras = dataset.train_cameras();
        let start = StartView::choose(&cameras, &sample.kept);
        let photos = SeeingPhotos::new(&cameras, &sample.kept);
        let mut counts = Vec::new();
        if trainer.options.export_clean != Some(false) {
            trainer.scene.for_rows_of(&pages, now, &mut |rows| {
                counts.extend(photos.of_rows(rows));
                Ok::<(), TrainError>(())
            })?;
        }
        let required = photos_required(trainer.options.export_clean, &counts);
        Ok(ExportChoice { required: (required > 0).then_some((photos, required)), start })
    }

    /// Writes the settings of viewers beside the PLY, if a photo sees any Gaussian.
    /// Errors: the folder cannot be written.
    pub fn write_settings(&self, trainer: &Trainer, dataset: &Dataset, ply: &Path) -> InputResult<()> {
        let Some(start) = &self.start else { return Ok(()) };
        let settings =
            start.settings(&ExportRows::new(&scene_meta(trainer, dataset)), trainer.options.render.background);
        write_whole(&settings_path(ply), format!("{settings:#}\n").as_bytes())
    }
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
