//! A run on a full drive: frees its own space, waits for space, or stops.
//!
//! First it makes two commits, which free the slots of old versions; the reserve is released to make room for them. If
//! that is not enough, training waits, with its state in memory, until the user frees space, and then continues. After
//! `--disk-full-wait` the run stops. A run in memory waits as well, because it would lose all steps since its last commit if
//! it ended; but its steps need no drive, so after the wait it goes on without commits where there is room for its results.
//!
//! Not here: the results after the last step (`results_wait`).
//!
//! Invariants: 1. waiting does not change the run; 2. the last commit always stays intact.

use super::checkpoint::Checkpoint;
use crate::base::units::format_bytes;
use crate::page::folder::file_system::{free_bytes, is_same_drive};
use crate::page::map::commit::Commits;
use crate::scene::state::row_bytes;
use crate::train::error::TrainError;
use crate::train::inputs::places::drive_of;
use crate::train::inputs::signals::StopFlag;
use crate::train::log::report::MetricsLog;
use crate::train::state::trainer::Trainer;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Interval between checks of the drive.
pub(super) const POLL: Duration = Duration::from_secs(1);
/// The reserve is filled only if it takes less than 1/4 of the free bytes.
const RESERVE_SHARE: u64 = 4;
/// Bytes required on the drive of the results during a run: metrics take a few hundred bytes per line.
const OTHER_BYTES: u64 = 1 << 20;
/// The results take less than 160 % of the bytes of the rows: the PLY 106, a file for viewers 42, and the report.
const RESULTS_PERCENT: u64 = 160;

/// Least reserve for a last commit on a full drive, bytes: room for the map to grow.
const RESERVE_BYTES_LEAST: u64 = 2 << 20;
const RESERVE_BYTES_MOST: u64 = 256 << 20;

/// Bytes that a spill directory holds back for the moment when its drive is full.
pub(crate) fn reserve_bytes(segment_bytes: u64) -> u64 {
    segment_bytes.clamp(RESERVE_BYTES_LEAST, RESERVE_BYTES_MOST)
}

impl Checkpoint {
    /// Fills the reserve if the drive has much more free space.
    /// Errors: the folder cannot be written.
    pub fn fill_reserve(&mut self) -> Result<(), TrainError> {
        let Some(commits) = &mut self.commits else { return Ok(()) };
        let reserve = commits.config().reserve_bytes;
        let free = free_bytes(&self.folder).ok().flatten();
        if reserve > 0 && free.is_none_or(|free| free / RESERVE_SHARE > reserve) {
            commits.fill_reserve()?;
        }
        Ok(())
    }

    /// Frees space after `why`, or waits for space. Training can continue afterwards, unless a stop was requested.
    /// Errors: no space was freed in time, or an error other than a lack of space.
    pub fn make_space(
        &mut self,
        trainer: &mut Trainer,
        metrics: &mut MetricsLog,
        stop: &StopFlag,
        why: TrainError,
    ) -> Result<(), TrainError> {
        if !why.is_out_of_space() {
            return Err(why);
        }
        if self.is_optional {
            // All pages are in memory: abandon the commit in progress; the step needs no write.
            self.give_up(trainer);
            if self.goes_without {
                self.miss();
                return Ok(());
            }
        }
        let is_own = self.other_drive(&why).is_none();
        let now = (trainer.steps_done(), is_own, Instant::now());
        // A second failure at the same step: commits cannot free enough.
        let is_stuck = self.space_made.is_some_and(|(step, own, _)| (step, own) == (now.0, is_own));
        let mut lacks = why;
        if !is_stuck {
            self.space_made = Some(now);
        }
        // Commits and reserve free space only on the store's drive, and a first commit frees none.
        if !is_stuck && is_own && !self.is_only_of_results(&lacks) {
            match self.commit_with_reserve(trainer, metrics) {
                Ok(()) => return Ok(()),
                Err(error) if error.is_out_of_space() => lacks = error,
                Err(error) => return Err(error),
            }
        }
        let began = self.space_made.unwrap_or(now).2;
        self.wait_for_space(trainer, metrics, stop, lacks, began, is_stuck)
    }

    /// Commits twice, because a commit keeps the slots of the previous one; releases the reserve if needed.
    fn commit_with_reserve(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        let mut result = self.commit(trainer, metrics);
        let is_full = result.as_ref().is_err_and(|e| e.is_out_of_space() && self.other_drive(e).is_none());
        let commits = self.commits.as_mut().filter(|_| is_full);
        if commits.map_or(Ok(false), Commits::give_up_reserve)? {
            crate::tell!("warning: the drive of {} is full: the reserve is used up", self.folder.display());
            result = self.commit(trainer, metrics);
        }
        result?;
        self.commit(trainer, metrics)
    }

    fn wait_for_space(
        &mut self,
        trainer: &mut Trainer,
        metrics: &mut MetricsLog,
        stop: &StopFlag,
        lacks: TrainError,
        began: Instant,
        is_told: bool,
    ) -> Result<(), TrainError> {
        let other = self.other_drive(&lacks);
        let is_of_results = self.is_only_of_results(&lacks);
        let needed = match other {
            Some(_) => OTHER_BYTES,
            None if is_of_results => OTHER_BYTES,
            None => {
                // The first commit of a run in memory stores all pages.
                let pager = &trainer.scene.pager;
                let all = (pager.index().len() * pager.frame_bytes()) as u64;
                pager.slot_space().map_or(all, |space| space.segment_bytes) + self.map_growth()
            }
        };
        // The folder of a first commit that failed is gone.
        let full = drive_of(other.as_deref().unwrap_or(&self.folder));
        let free = free_bytes(&full).ok().flatten();
        let free_then = free.map_or(String::from("unknown"), format_bytes);
        let until = self.full_wait.as_secs_f64();
        let (needed_text, folder) = (format_bytes(needed), full.display().to_string());
        if !is_told && stop.exit_code().is_none() {
            crate::tell!(
                "paused: {lacks}\n  {folder} needs {needed_text} more and has {free_then} free. Training waits up to \
                 {until:.0} s (--disk-full-wait) for space, then continues; Ctrl-C stops it"
            );
        }
        while began.elapsed() < self.full_wait && stop.exit_code().is_none() {
            std::thread::sleep(POLL.min(self.full_wait / 20));
            let free_now = free_bytes(&full).ok().flatten();
            // More free space below the size of a segment does not help.
            if free_now.zip(free).is_some_and(|(now, then)| now < needed && now <= then) {
                continue;
            }
            let done = match is_of_results {
                true => metrics.sync().map(drop).map_err(TrainError::from),
                false => self.commit(trainer, metrics),
            };
            match done {
                Ok(()) => {
                    if !is_told {
                        crate::tell!(
                            "there is space again after {:.0} s: training goes on",
                            began.elapsed().as_secs_f64()
                        );
                    }
                    self.fill_reserve()?;
                    return Ok(());
                }
                Err(error) if error.is_out_of_space() => {}
                Err(error) => return Err(error),
            }
        }
        let room = trainer.scene.rows() * row_bytes(trainer.scene.rules.sh_degree()) as u64 / 100 * RESULTS_PERCENT;
        let has_room = || free_bytes(&full).ok().flatten().is_none_or(|free| free >= room);
        match stop.exit_code() {
            Some(_) => Ok(()),
            None if self.is_optional && has_room() => {
                crate::tell!(
                    "warning: training goes on in memory without commits: if it ends now, the steps since {} are lost. There is \
                     room for the results, and commits begin again once there is room for them",
                    self.last_step()
                        .map_or("its beginning".to_string(), |step| format!("the commit after step {step}"))
                );
                self.goes_without = true;
                self.miss();
                Ok(())
            }
            None => Err(TrainError::DriveFull {
                folder,
                needed: needed_text,
                last_step: self.last_step(),
                elsewhere: String::new(),
            }),
        }
    }

    /// Whether a file of the results found no space and needs no commit: all pages of the run are in memory.
    fn is_only_of_results(&self, error: &TrainError) -> bool {
        let TrainError::Input(error) = error else { return false };
        self.is_optional && !error.file.starts_with(&self.folder)
    }

    /// The folder of the file that found no space, if it lies on another drive than the store.
    fn other_drive(&self, error: &TrainError) -> Option<PathBuf> {
        let TrainError::Input(error) = error else { return None };
        let folder = error.file.parent().filter(|folder| folder.is_dir())?;
        (!is_same_drive(folder, &self.folder)).then(|| folder.to_path_buf())
    }

    /// Most bytes by which one commit can grow the page map: at most it doubles.
    fn map_growth(&self) -> u64 {
        std::fs::metadata(self.folder.join(crate::page::map::commit::MAP_NAME)).map_or(0, |map| map.len())
    }
}
