//! The result of one run as a line of JSON: settings, quality and costs.
//!
//! Invariant: the run's own process measured every figure except `wall_seconds`, the lifetime of that process, and
//! `pace`, which two other runs measured.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The pace of the machine at a run: means of a short training before and one after the run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Pace {
    /// Digest of the short training and of everything that its time depends on.
    pub key: String,
    /// Seconds of its steps, without waiting for the drive.
    pub seconds: f64,
    /// CPU seconds of its steps, where the system counts them.
    pub cpu_seconds: Option<f64>,
}

/// A run of a sweep.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RunRecord {
    /// Digest of everything that the figures depend on: scene, settings, seed, program, machine and drive.
    pub key: String,
    pub scene: String,
    /// Group and name in the list of the sweep, such as `order/groups:9`.
    pub name: String,
    /// Runs of one class and seed must end with the same bits; empty = this is not known. Of the list, not of the run.
    #[serde(skip)]
    pub bits: String,
    /// Config keys that differ from the base, with their values.
    pub settings: BTreeMap<String, String>,
    pub seed: u64,
    pub steps: u32,
    /// Message of a failed run, which has no figures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
    /// PSNR of the held-out views, dB.
    pub psnr: Option<f64>,
    /// SSIM of the held-out views.
    pub ssim: Option<f64>,
    /// Colour-corrected PSNR of the held-out views, dB, if the run measured it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cc_psnr: Option<f64>,
    /// Training views whose photo contradicts the scene, by name.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub outlier_views: Vec<String>,
    /// Training views whose photo is wrong on purpose, by name.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub wrong_views: Vec<String>,
    /// Seconds of the training steps.
    pub seconds: f64,
    /// CPU seconds of the training steps, all threads.
    pub cpu_seconds: Option<f64>,
    /// Seconds from the start of the process to its end.
    pub wall_seconds: f64,
    /// The pace of the machine, if it was measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pace: Option<Pace>,
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
    /// Peak device memory, bytes.
    pub device_bytes_peak: u64,
    /// Bytes of the files of the pages.
    pub drive_bytes_peak: u64,
    /// Digest of the PLY: equal digests mean equal bits.
    pub ply: String,
    /// The order of views that the run used, after `auto` was resolved.
    pub view_order: String,
    /// Version of the program.
    pub version: String,
    pub threads: u64,
    pub cpu: String,
}

impl RunRecord {
    /// The group in the list of the sweep.
    pub fn group(&self) -> &str {
        self.name.split('/').next().unwrap_or_default()
    }
}
