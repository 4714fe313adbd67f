//! Costs of the steps of a run (CPU, bytes, memory), without loading, the last evaluation and export.

use super::report::StepCosts;
use super::tiers::Tiers;
use super::trainer::Trainer;
use crate::base::machine::process_cpu_seconds;

/// Counters at the start of a measurement.
pub(super) struct Meter {
    cpu: Option<f64>,
    read: u64,
    written: u64,
    stall: f64,
}

impl Meter {
    /// Starts a measurement.
    pub fn start(trainer: &Trainer) -> Meter {
        let stats = trainer.scene.pager.stats();
        let (read, written, stall) = (stats.bytes_read, stats.bytes_written, stats.stall_seconds);
        Meter { cpu: process_cpu_seconds(), read, written, stall }
    }

    /// Costs since the start.
    pub fn stop(&self, trainer: &Trainer, tiers: &Tiers) -> StepCosts {
        let stats = trainer.scene.pager.stats();
        StepCosts {
            train_cpu_seconds: process_cpu_seconds().zip(self.cpu).map(|(now, before)| now - before),
            train_bytes_read: stats.bytes_read - self.read,
            train_bytes_written: stats.bytes_written - self.written,
            train_stall_seconds: stats.stall_seconds - self.stall,
            device_bytes_peak: trainer.renderer.traffic().device_bytes_peak,
            drive_bytes_peak: tiers.drive_bytes(),
        }
    }
}
