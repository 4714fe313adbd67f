//! A run whose drive is full: space is made of what it holds back, or waited for, and else the run stops.
//!
//! First two commits: they make the slots of versions free that nothing needs any more. What they lack they get from the
//! reserve, which is given up for it. Where that is not enough training waits, with everything in memory as it is, until
//! somebody has freed space, and then goes on as though nothing had happened. After `--disk-full-wait` it stops.
//!
//! Invariants: 1. nothing of the run is changed or lost while it waits; 2. whatever happens, the last commit stands.

use super::checkpoint::Checkpoint;
use super::error::TrainError;
use super::report::MetricsLog;
use super::signals::StopFlag;
use super::trainer::Trainer;
use crate::base::units::format_bytes;
use crate::page::folder::file_system::free_bytes;
use crate::page::map::commit::Commits;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// From one look at the drive to the next.
const POLL: Duration = Duration::from_secs(1);
/// The reserve is filled only where it takes less than one in so many of the free bytes.
const RESERVE_SHARE: u64 = 4;
/// What is asked for on the drive of the results while a run goes on: metrics are a few hundred bytes a line.
const OTHER_BYTES: u64 = 1 << 20;

impl TrainError {
    /// Whether it is only space on a drive that is missing: the same may work later.
    pub fn is_out_of_space(&self) -> bool {
        match self {
            TrainError::Commit(error) => error.is_out_of_space(),
            TrainError::Paging(error) => error.is_out_of_space(),
            TrainError::Input(error) => error.is_out_of_space(),
            _ => false,
        }
    }
}

impl Checkpoint {
    /// Sets the reserve aside where the drive has much more than that.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn fill_reserve(&mut self) -> Result<(), TrainError> {
        let Some(commits) = &mut self.commits else { return Ok(()) };
        let reserve = commits.config().reserve_bytes;
        let free = free_bytes(&self.folder).ok().flatten();
        if reserve > 0 && free.is_none_or(|free| free / RESERVE_SHARE > reserve) {
            commits.fill_reserve()?;
        }
        Ok(())
    }

    /// Makes space after `why`, or waits for it. Training may go on after this, unless it was asked to stop meanwhile.
    ///
    /// # Errors
    /// Nobody freed any in time; or another error than for want of space.
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
            // All of the run is in memory: what was being committed is given up, and the step works without a write.
            return self.give_up(trainer, why);
        }
        let is_own = self.other_drive(&why).is_none();
        let now = (trainer.steps_done(), is_own, Instant::now());
        // Then the drive is too small for the scene, as far as commits can tell.
        let is_stuck = self.space_made.is_some_and(|(step, own, _)| (step, own) == (now.0, is_own));
        let mut lacks = why;
        if !is_stuck {
            self.space_made = Some(now);
        }
        // Neither commits nor the reserve make space on another drive than their own.
        if !is_stuck && is_own {
            match self.commit_with_reserve(trainer, metrics) {
                Ok(()) => return Ok(()),
                Err(error) if error.is_out_of_space() => lacks = error,
                Err(error) => return Err(error),
            }
        }
        let began = self.space_made.unwrap_or(now).2;
        self.wait_for_space(trainer, (metrics, stop), lacks, (began, is_stuck))
    }

    /// Commits twice, since one commit keeps what the one before it names; with the reserve's space if need be.
    fn commit_with_reserve(&mut self, trainer: &mut Trainer, metrics: &mut MetricsLog) -> Result<(), TrainError> {
        let mut result = self.commit(trainer, metrics);
        let is_full = result.as_ref().is_err_and(|e| e.is_out_of_space() && self.other_drive(e).is_none());
        let commits = self.commits.as_mut().filter(|_| is_full);
        if commits.map_or(Ok(false), Commits::give_up_reserve)? {
            eprintln!("warning: the drive of {} is full: the reserve is used up", self.folder.display());
            result = self.commit(trainer, metrics);
        }
        result?;
        self.commit(trainer, metrics)
    }

    fn wait_for_space(
        &mut self,
        trainer: &mut Trainer,
        (metrics, stop): (&mut MetricsLog, &StopFlag),
        lacks: TrainError,
        (began, is_told): (Instant, bool),
    ) -> Result<(), TrainError> {
        let other = self.other_drive(&lacks);
        let needed = match other {
            Some(_) => OTHER_BYTES,
            None => trainer.scene.pager.slot_space().map_or(0, |space| space.segment_bytes) + self.map_growth(),
        };
        let full = other.unwrap_or_else(|| self.folder.clone());
        let free = free_bytes(&full).ok().flatten();
        let free_then = free.map_or(String::from("unknown"), format_bytes);
        let until = self.full_wait.as_secs_f64();
        let (needed_text, folder) = (format_bytes(needed), full.display().to_string());
        if !is_told {
            eprintln!(
                "paused: {lacks}\n  {folder} needs {needed_text} more and has {free_then} free. Training waits up to {until:.0} s \
                 (--disk-full-wait) for space and then goes on; Ctrl-C stops it"
            );
        }
        while began.elapsed() < self.full_wait && stop.exit_code().is_none() {
            std::thread::sleep(POLL.min(self.full_wait / 20));
            let free_now = free_bytes(&full).ok().flatten();
            // Less than a segment does not help a scene that the drive is too small for.
            if free_now.zip(free).is_some_and(|(now, then)| now < needed && now <= then) {
                continue;
            }
            match self.commit(trainer, metrics) {
                Ok(()) => {
                    if !is_told {
                        eprintln!(
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
        match stop.exit_code() {
            Some(_) => Ok(()),
            None => Err(TrainError::DriveFull { folder, needed: needed_text, last_step: self.last_step() }),
        }
    }

    /// The folder of the file that found no space, where that is on another drive than the store.
    fn other_drive(&self, error: &TrainError) -> Option<PathBuf> {
        let TrainError::Input(error) = error else { return None };
        let folder = error.file.parent().filter(|folder| folder.is_dir())?;
        (!is_same_drive(folder, &self.folder)).then(|| folder.to_path_buf())
    }

    /// What the page map may grow by for one commit, bytes: it doubles at most.
    fn map_growth(&self) -> u64 {
        std::fs::metadata(self.folder.join(crate::page::map::commit::MAP_NAME)).map_or(0, |map| map.len())
    }
}

/// Whether two folders lie on one drive; so they do where the system does not tell.
fn is_same_drive(a: &Path, b: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let device = |folder: &Path| std::fs::metadata(folder).map(|m| m.dev()).ok();
        device(a).zip(device(b)).is_none_or(|(a, b)| a == b)
    }
    #[cfg(not(unix))]
    {
        let _ = (a, b);
        true
    }
}
