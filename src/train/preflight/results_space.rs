//! Checks the free space of the drive that gets the results.
//!
//! Not here: the drive of the pages ([`super::drive_space`]).
//!
//! Invariant: a drive that cannot hold a PLY of the first Gaussians is refused. A drive that may not hold the grown scene gives a warning.

use super::forecast::{Forecast, ply_bytes};
use crate::base::error::{InputError, InputResult};
use crate::base::units::format_bytes;
use crate::config::file::TrainConfig;
use crate::config::residence::Residence;
use crate::page::folder::file_system::free_bytes;
use crate::train::inputs::places::drive_of;
use std::path::Path;

/// Refuses a drive that cannot hold a PLY of the first Gaussians. Warns if the drive may not hold the results of the end: the PLY and, for
/// a run in memory, its checkpoint. A drive that does not report its free space passes.
///
/// # Errors
/// The drive has too little free space.
pub(crate) fn check_drive_of_results(config: &TrainConfig, out: &Path, forecast: &Forecast) -> InputResult<()> {
    let Some(free) = free_bytes(&drive_of(out)).ok().flatten() else { return Ok(()) };
    let [now, last] = forecast.gaussians.map(|rows| ply_bytes(config, rows));
    if free < now {
        let problem = format!(
            "the drive has {} free, but the PLY of the first Gaussians alone takes {}",
            format_bytes(free),
            format_bytes(now)
        );
        return Err(InputError::new(out, problem, "free space on it, or choose another --out"));
    }
    let checkpoint = if config.residence() == Residence::Memory { forecast.drive_bytes_most } else { 0 };
    if free < last.saturating_add(checkpoint) {
        eprintln!(
            "warning: the results may take {} in {}, whose drive has {} free: free space, choose another --out, or lower \
             --max-gaussians",
            format_bytes(last.saturating_add(checkpoint)),
            out.display(),
            format_bytes(free)
        );
    }
    Ok(())
}
