//! The figures of a run that a sweep can show, by name.
//!
//! Not here: means over seeds ([`super::front`]), tables and charts ([`super::sweep_page`]).

use super::record::RunRecord;
use crate::base::units::format_bytes;
use serde::de::Error;
use serde::{Deserialize, Deserializer};

/// A figure of a run.
#[derive(Debug, Clone, Copy)]
pub struct Figure {
    /// Its name in a list.
    pub name: &'static str,
    /// Its name for people, with the unit.
    pub title: &'static str,
    /// Decimals in a table; `None` for bytes.
    digits: Option<usize>,
    /// Its value; `None` if the run has none.
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

const FIGURES: [Figure; 15] = [
    figure("psnr", "PSNR, dB", Some(2), |r| r.psnr),
    figure("ssim", "SSIM", Some(4), |r| r.ssim),
    figure("cc-psnr", "PSNR after colour correction, dB", Some(2), |r| r.cc_psnr),
    figure("seconds", "seconds of training", Some(1), |r| Some(r.seconds)),
    figure("step-ms", "ms a step", Some(1), |r| Some(1e3 * r.seconds / f64::from(r.steps.max(1)))),
    figure("cpu-seconds", "CPU seconds", Some(1), |r| r.cpu_seconds),
    figure("stall-seconds", "seconds waiting for the drive", Some(1), |r| Some(r.stall_seconds)),
    figure("bytes-read", "read", None, |r| Some(r.bytes_read as f64)),
    figure("bytes-written", "written", None, |r| Some(r.bytes_written as f64)),
    figure("bytes-moved", "read and written", None, |r| Some(r.bytes_read.saturating_add(r.bytes_written) as f64)),
    figure("host-bytes-peak", "host peak", None, |r| Some(r.host_bytes_peak as f64)),
    figure("device-bytes-peak", "device peak", None, |r| Some(r.device_bytes_peak as f64)),
    figure("drive-bytes-peak", "drive peak", None, |r| Some(r.drive_bytes_peak as f64)),
    figure("gaussians", "Gaussians", Some(0), |r| Some(r.gaussians as f64)),
    figure("frames", "frames", Some(0), |r| Some(r.frames as f64)),
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
