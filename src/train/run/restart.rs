//! Restarts a run in the same process after its device was lost: opens the device again and goes on from the last commit.
//!
//! So a reset or update of the driver, or a device that was unplugged for a moment, costs the steps since that commit only.
//!
//! Invariants: 1. a restarted run ends with the bytes of a resumed run ([`super::resume`]), which are those of an
//! uninterrupted run; 2. other errors end the run.

use super::request::RunOutcome;
use super::resume::{ResumeRequest, resume};
use crate::config::file::TrainConfig;
use crate::page::folder::spill_dir::SpillDir;
use crate::report::run_files::CONFIG_FILE;
use crate::train::error::TrainError;
use std::path::Path;

/// Whether the run in an output folder has a commit, or can begin again because all of it was in memory.
fn can_continue(out: &Path) -> bool {
    TrainConfig::read(&out.join(CONFIG_FILE)).is_ok_and(|config| {
        let residence = config.residence();
        residence.spill_dir().is_none() || SpillDir::exists_in(&residence.checkpoint_folder(out))
    })
}

/// Goes on with the run of `request` for as long as it ends with the loss of its device, at most `most` times. `ended` is how the run
/// has ended so far.
/// Errors: the error that ended the run last.
pub fn go_on(
    mut ended: Result<RunOutcome, TrainError>,
    request: &ResumeRequest,
    most: u32,
) -> Result<RunOutcome, TrainError> {
    for restart in 1..=most {
        match ended {
            Err(error) if error.is_device_lost() && can_continue(&request.out) => {
                crate::tell!(
                    "warning: {error}\n  the run goes on in this process (restart {restart} of at most {most})"
                );
                ended = resume(request);
            }
            ended => return ended,
        }
    }
    ended
}
