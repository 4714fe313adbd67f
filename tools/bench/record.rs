//! The result of one run as a line of JSON (settings, quality and costs), its figures by name, and its times at one pace of the machine.
//!
//! The speed of a machine changes between runs. So a sweep trains the base for a few steps before and after each run; the time of this
//! short training is the pace of the machine at that run.
//!
//! Invariants: 1. the run's own process measured every figure except `wall_seconds`, the lifetime of that process, and
//! `pace`; 2. only paces of one training are compared; 3. times of computing change in proportion to the pace; what a run waited for the
//! drive, bytes, counts and quality stay as measured.

use gsscale::base::units::format_bytes;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};
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
    /// Under the exposures that neighbouring photos suggest, with `--appearance`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub predicted_psnr: Option<f64>,
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
    pub gaussians: u64,
    pub frames: u64,
    pub pages: u64,
    /// Largest resident size of the process, bytes.
    pub host_bytes_peak: u64,
    /// Peak device memory, bytes.
    pub device_bytes_peak: u64,
    /// Bytes of the files of the pages.
    pub drive_bytes_peak: u64,
    /// What the reference has more in held-out photos that show a border of cells, and in the bands along borders, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub border_loss: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub band_loss: Option<f64>,
    /// Gaussians that the cells have trained, with their margins.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trained_gaussians: Option<u64>,
    /// Digest of the PLY: equal digests mean equal bits.
    pub ply: String,
    /// The order of views that the run used, after `auto` was resolved.
    pub view_order: String,
    pub version: String,
    pub threads: u64,
    pub cpu: String,
}

impl RunRecord {
    /// The group in the list of the sweep.
    pub fn group(&self) -> &str {
        self.name.split('/').next().unwrap_or_default()
    }

    /// A figure that a city in cells, which is several runs, has not.
    fn of_one_run(&self, value: f64) -> Option<f64> {
        self.trained_gaussians.is_none().then_some(value)
    }
}

/// Converts `seconds` and `cpu_seconds` of all runs to the median of their paces, in place. Times stay as measured unless every run that
/// succeeded has a pace of the same training. Returns a sentence for readers that says which of the two the times are.
pub fn convert_to_one_pace(records: &mut [RunRecord]) -> &'static str {
    let paces: Vec<Option<&Pace>> = records.iter().filter(|r| r.problem.is_none()).map(|r| r.pace.as_ref()).collect();
    let first = paces.first().copied().flatten();
    let is_like = |pace: &Option<&Pace>| {
        pace.zip(first).is_some_and(|(own, first)| own.key == first.key && own.seconds.is_finite() && own.seconds > 0.0)
    };
    if paces.is_empty() || !paces.iter().all(is_like) {
        return "times as measured";
    }
    let (seconds, cpu_seconds) = (median(records, |pace| Some(pace.seconds)), median(records, |pace| pace.cpu_seconds));
    for record in records {
        let Some(pace) = &record.pace else { continue };
        if let Some(median) = seconds {
            // A slow processor does not slow the drive.
            let computing = (record.seconds - record.stall_seconds).max(0.0);
            record.seconds = record.stall_seconds + computing * median / pace.seconds;
        }
        if let (Some(median), Some(own), Some(measured)) = (cpu_seconds, pace.cpu_seconds, record.cpu_seconds) {
            record.cpu_seconds = Some(measured * median / own);
        }
    }
    "times converted to the median pace of the machine"
}

/// The upper median of a value above 0; `None` if a pace lacks it.
fn median(records: &[RunRecord], of: impl Fn(&Pace) -> Option<f64>) -> Option<f64> {
    let paces = records.iter().filter_map(|record| record.pace.as_ref());
    let mut values: Vec<f64> = paces.map(|pace| of(pace).filter(|v| *v > 0.0)).collect::<Option<_>>()?;
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[derive(Debug, Clone, Copy)]
pub struct Figure {
    pub name: &'static str,
    /// Its name for people, with the unit.
    pub title: &'static str,
    /// Decimals in a table; `None` for bytes.
    digits: Option<usize>,
    pub of: fn(&RunRecord) -> Option<f64>,
}

const fn figure(
    name: &'static str,
    title: &'static str,
    digits: Option<usize>,
    of: fn(&RunRecord) -> Option<f64>,
) -> Figure {
    Figure { name, title, digits, of }
}

const FIGURES: [Figure; 19] = [
    figure("psnr", "PSNR, dB", Some(2), |r| r.psnr),
    figure("ssim", "SSIM", Some(4), |r| r.ssim),
    figure("cc-psnr", "PSNR after colour correction, dB", Some(2), |r| r.cc_psnr),
    figure("predicted-psnr", "PSNR with predicted exposures, dB", Some(2), |r| r.predicted_psnr),
    figure("seconds", "seconds of training", Some(1), |r| Some(r.seconds)),
    figure("step-ms", "ms a step", Some(1), |r| r.of_one_run(1e3 * r.seconds / f64::from(r.steps.max(1)))),
    figure("cpu-seconds", "CPU seconds", Some(1), |r| r.cpu_seconds),
    figure("stall-seconds", "seconds waiting for the drive", Some(1), |r| r.of_one_run(r.stall_seconds)),
    figure("bytes-read", "read", None, |r| r.of_one_run(r.bytes_read as f64)),
    figure("bytes-written", "written", None, |r| r.of_one_run(r.bytes_written as f64)),
    figure("bytes-moved", "read and written", None, |r| {
        r.of_one_run(r.bytes_read.saturating_add(r.bytes_written) as f64)
    }),
    figure("host-bytes-peak", "host peak", None, |r| r.of_one_run(r.host_bytes_peak as f64)),
    figure("device-bytes-peak", "device peak", None, |r| r.of_one_run(r.device_bytes_peak as f64)),
    figure("drive-bytes-peak", "drive peak", None, |r| r.of_one_run(r.drive_bytes_peak as f64)),
    figure("gaussians", "Gaussians", Some(0), |r| Some(r.gaussians as f64)),
    figure("trained-gaussians", "Gaussians trained, with margins", Some(0), |r| {
        Some(r.trained_gaussians.unwrap_or(r.gaussians) as f64)
    }),
    figure("border-loss", "lost in photos with a border, dB", Some(2), |r| r.border_loss),
    figure("band-loss", "lost in bands along borders, dB", Some(2), |r| r.band_loss),
    figure("frames", "frames", Some(0), |r| r.of_one_run(r.frames as f64)),
];

impl<'de> Deserialize<'de> for Figure {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Figure, D::Error> {
        let name = String::deserialize(deserializer)?;
        let found = FIGURES.iter().find(|f| f.name == name).copied();
        let problem = || format!("{name} is no figure; the figures are {}", FIGURES.map(|f| f.name).join(", "));
        found.ok_or_else(|| D::Error::custom(problem()))
    }
}

impl Figure {
    /// A value of this figure as text, with its unit if that is bytes.
    pub fn write(&self, value: f64) -> String {
        match self.digits {
            Some(digits) => format!("{value:.digits$}"),
            None => format_bytes(value.max(0.0) as u64),
        }
    }

    /// A difference of this figure as text.
    pub fn write_difference(&self, value: f64) -> String {
        format!("{}{}", if value < 0.0 { "-" } else { "+" }, self.write(value.abs()))
    }

    /// Factor of values on the axis of a chart, and the name of the axis.
    pub fn axis(&self) -> (f64, String) {
        match self.digits {
            Some(_) => (1.0, self.title.to_string()),
            None => (1e-9, format!("{}, GB", self.title)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(seconds: f64, stall_seconds: f64, pace: f64) -> RunRecord {
        let pace = Pace { key: "base".into(), seconds: pace, cpu_seconds: Some(20.0 * pace) };
        RunRecord { seconds, stall_seconds, cpu_seconds: Some(2.0 * seconds), pace: Some(pace), ..RunRecord::default() }
    }

    #[test]
    fn times_are_those_at_the_median_pace() {
        let mut records = [run(80.0, 0.0, 3.0), run(160.0, 0.0, 6.0), run(70.0, 10.0, 2.0)];
        assert!(convert_to_one_pace(&mut records).contains("converted"));
        assert_eq!(records.each_ref().map(|record| record.seconds), [80.0, 80.0, 100.0]);
        assert_eq!(records.each_ref().map(|record| record.cpu_seconds), [160.0, 160.0, 210.0].map(Some));
        // A run that failed needs no pace.
        let failed = RunRecord { problem: Some("no memory".into()), ..RunRecord::default() };
        let mut records = [run(80.0, 0.0, 3.0), failed.clone(), run(160.0, 0.0, 6.0)];
        assert!(convert_to_one_pace(&mut records).contains("converted"));
        assert_eq!(records.each_ref().map(|record| record.seconds), [160.0, 0.0, 160.0]);
        assert_eq!(records[1], failed);
    }

    #[test]
    fn times_stay_where_paces_cannot_be_compared() {
        let without = RunRecord { pace: None, ..run(9.0, 1.0, 1.0) };
        let of_another = Pace { key: "other".into(), seconds: 2.0, cpu_seconds: None };
        let of_another = RunRecord { pace: Some(of_another), ..run(9.0, 1.0, 1.0) };
        for other in [without, of_another, run(9.0, 1.0, 0.0), run(9.0, 1.0, f64::NAN), run(9.0, 1.0, -1.0)] {
            let mut records = [run(9.0, 1.0, 2.0), other];
            assert_eq!(convert_to_one_pace(&mut records), "times as measured");
            assert_eq!(records.each_ref().map(|record| record.seconds), [9.0; 2]);
        }
        assert_eq!(convert_to_one_pace(&mut []), "times as measured");
    }
}
