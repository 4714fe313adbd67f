//! What the steps of a run took: CPU, bytes and memory, loading, the last evaluation and export left out.

use super::tiers::Tiers;
use super::trainer::Trainer;
use crate::base::machine::process_cpu_seconds;
use serde::{Deserialize, Serialize};

/// Costs of the steps that this process did (a run that was resumed: since then).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct StepCosts {
    /// CPU seconds of all threads during the steps; absent where the system does not tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_cpu_seconds: Option<f64>,
    /// Bytes read from the drive by the steps.
    pub train_bytes_read: u64,
    /// Bytes written to it by the steps and their commits' pages.
    pub train_bytes_written: u64,
    /// Seconds that the steps waited for the drive.
    pub train_stall_seconds: f64,
    /// Most bytes allocated on the device; 0 on the CPU.
    pub device_bytes_peak: u64,
    /// Bytes of the segment files on the drive, which never shrink; 0 without a spill directory.
    pub drive_bytes_peak: u64,
}

/// Costs that are being counted.
pub(super) struct Meter {
    cpu: Option<f64>,
    read: u64,
    written: u64,
    stall: f64,
}

impl Meter {
    /// Counts from now on.
    pub fn start(trainer: &Trainer) -> Meter {
        let stats = trainer.scene.pager.stats();
        let (read, written, stall) = (stats.bytes_read, stats.bytes_written, stats.stall_seconds);
        Meter { cpu: process_cpu_seconds(), read, written, stall }
    }

    /// What was counted.
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
