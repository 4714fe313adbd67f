//! One finished run as a line of JSON: what was set, what it reached, what it took.
//!
//! Invariant: every figure is what the run's own process measured, but for `wall_seconds`, which is how long that process
//! lived.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A run of a ladder or of a sweep.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RunRecord {
    /// Digest of all that the figures depend on: scene, settings, seed, program, machine and drive.
    pub key: String,
    /// The scene.
    pub scene: String,
    /// What was turned: `base`, a knob, or `together`.
    pub knob: String,
    /// The setting, for people: `groups:9`.
    pub label: String,
    /// Keys that differ from the base, as written in a config file.
    pub settings: BTreeMap<String, String>,
    /// Seed.
    pub seed: u64,
    /// Steps.
    pub steps: u32,
    /// Why there are no figures, for a run that failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
    /// PSNR of the held-out views, dB.
    pub psnr: Option<f64>,
    /// SSIM of the held-out views.
    pub ssim: Option<f64>,
    /// Seconds of the steps.
    pub seconds: f64,
    /// CPU seconds of the steps, all threads.
    pub cpu_seconds: Option<f64>,
    /// Seconds from the start of the process to its end.
    pub wall_seconds: f64,
    /// Seconds that steps waited for the drive.
    pub stall_seconds: f64,
    /// Bytes that the steps read from the drive.
    pub bytes_read: u64,
    /// Bytes that the steps wrote to the drive.
    pub bytes_written: u64,
    /// Gaussians at the end.
    pub gaussians: u64,
    /// Frames in use at the end.
    pub frames: u64,
    /// Pages of the scene at the end.
    pub pages: u64,
    /// Largest resident size of the process, bytes.
    pub host_bytes_peak: u64,
    /// Most bytes on the device.
    pub device_bytes_peak: u64,
    /// Bytes of the segment files.
    pub drive_bytes_peak: u64,
    /// Digest of the PLY: runs with the same one ended with the same bits.
    pub ply: String,
    /// Order of the views as it was resolved.
    pub view_order: String,
    /// Version of the program.
    pub version: String,
    /// Worker threads.
    pub threads: u64,
    /// Processor.
    pub cpu: String,
}

impl RunRecord {
    /// Bytes read and written.
    pub fn bytes_moved(&self) -> u64 {
        self.bytes_read.saturating_add(self.bytes_written)
    }
}
