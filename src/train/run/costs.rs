//! Costs of the steps of a run (bytes, memory), without loading, the last evaluation and export.

use crate::train::log::report::StepCosts;
use crate::train::start::tiers::Tiers;
use crate::train::state::trainer::Trainer;

/// Counters at the start of a measurement.
pub(super) struct Meter {
    read: u64,
    written: u64,
    stall: f64,
}

impl Meter {
    /// Starts a measurement.
    pub fn start(trainer: &Trainer) -> Meter {
        let stats = trainer.scene.pager.stats();
        let (read, written, stall) = (stats.bytes_read, stats.bytes_written, stats.stall_seconds);
        Meter { read, written, stall }
    }

    /// Costs since the start, with the CPU seconds of the run.
    pub fn stop(&self, trainer: &Trainer, tiers: &Tiers, train_cpu_seconds: Option<f64>) -> StepCosts {
        let stats = trainer.scene.pager.stats();
        StepCosts {
            train_cpu_seconds,
            train_bytes_read: stats.bytes_read - self.read,
            train_bytes_written: stats.bytes_written - self.written,
            train_stall_seconds: stats.stall_seconds - self.stall,
            device_bytes_peak: trainer.renderer.traffic().device_bytes_peak,
            drive_bytes_peak: tiers.drive_bytes(),
            forecast: None,
        }
    }
}
