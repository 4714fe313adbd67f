//! Checks the free space of the drive that gets the results.
//!
//! Not here: the drive of the pages ([`super::drive_space`]).
//!
//! Invariant: a drive that cannot hold a PLY of the first Gaussians is refused. A drive that may not hold the grown scene gives a warning.

use super::forecast::{Forecast, ply_bytes};
use crate::base::error::{InputError, InputResult};
use crate::base::units::format_bytes;
use crate::config::file::TrainConfig;
use crate::config::values::Residence;
use crate::exchange::format::ExportFormat;
use crate::page::folder::file_system::{free_bytes, is_same_drive};
use crate::train::inputs::places::drive_of;
use std::path::Path;

/// The most bytes of the file for viewers while it is written, in percent of those of the PLY. SPZ: 8, and up to 34 for its temporary
/// file. SOG: 12.
fn export_percent(format: ExportFormat) -> u64 {
    match format {
        ExportFormat::Ply => 0,
        ExportFormat::Spz => 42,
        ExportFormat::Sog => 12,
    }
}

/// Refuses a drive that cannot hold a PLY of the first Gaussians, unless the run is resumed. Warns if the drive may not hold the results of
/// the end: the PLY, the files for viewers and, where they lie on the same drive, the pages of the store or the checkpoint beyond the
/// `stored` bytes of now. A drive that does not report its free space passes.
/// Errors: the drive has too little free space.
pub(crate) fn check_drive_of_results(
    config: &TrainConfig,
    out: &Path,
    forecast: &Forecast,
    stored: u64,
    is_resumed: bool,
) -> InputResult<()> {
    let drive = drive_of(out);
    let Some(free) = free_bytes(&drive).ok().flatten() else { return Ok(()) };
    let [now, last] = forecast.gaussians.map(|rows| ply_bytes(config, rows));
    if free < now && !is_resumed {
        let problem = format!(
            "the drive has {} free, but the PLY of the first Gaussians alone takes {}",
            format_bytes(free),
            format_bytes(now)
        );
        return Err(InputError::new(out, problem, "free space on it, or choose another --out"));
    }
    let results = last + last / 100 * config.export.formats().map(export_percent).sum::<u64>();
    let (pages, beside) = match config.residence() {
        Residence::Memory => (forecast.drive_bytes_peak, " and the checkpoint"),
        Residence::SpillDir(folder) if is_same_drive(&drive, &drive_of(folder)) => {
            (forecast.drive_bytes_peak, " and the pages, which lie on the same drive,")
        }
        _ => (0, ""),
    };
    let needed = results.saturating_add(pages.saturating_sub(stored));
    if free < needed {
        crate::tell!(
            "warning: the results{beside} may take {} more in {}, whose drive has {} free: free space, choose another --out, or \
             lower --max-gaussians",
            format_bytes(needed),
            out.display(),
            format_bytes(free)
        );
    }
    Ok(())
}
