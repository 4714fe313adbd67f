//! Machine-readable output of a run: metrics.jsonl line by line, and summary.json at the end.
//!
//! Invariants: 1. every number written is finite, because JSON has neither infinity nor NaN (see [`json_psnr`]); 2.
//! whole files appear by rename, so a reader never sees a partial file.

use crate::base::error::{InputError, InputResult};
use crate::base::machine::process_cpu_seconds;
use crate::base::whole_file::write_whole;
use crate::checkpoint::interval::CommitReport;
use crate::dataset::photo_header::read_header;
use crate::densify::growth::GrowthCheck;
use crate::exchange::sink::LEVELS_MAX;
use crate::exchange::tensorboard::EventFile;
use crate::paging::pager::Pager;
use crate::paging::stats::PagerStats;
use crate::photos::exposure::AppearanceMode;
use crate::render::color_correct::ColorCorrect;
use crate::report::run_report::listed_pictures;
use crate::train::step::device_slots::SlotTraffic;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Most pictures for TensorBoard, which keeps ten of a tag and all tags.
const PICTURES_MAX: usize = 12;

pub const PSNR_PERFECT: f64 = 100.0;

/// The counters of the pager, with frames and pages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct TierTraffic {
    #[serde(flatten)]
    pub stats: PagerStats,
    pub frames: u64,
    pub pages: u64,
}

impl TierTraffic {
    pub fn of(pager: &Pager) -> TierTraffic {
        TierTraffic { stats: pager.stats(), frames: pager.frames() as u64, pages: pager.index().len() as u64 }
    }
}

/// One logged step.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct StepLine {
    /// Steps done.
    pub step: u32,
    /// Loss of the step's view; the largest f64 when it was not finite and the step was skipped.
    pub loss: f64,
    /// What kinds of parameters of photos add to the loss, by their names; values that are not finite are left out.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub loss_terms: BTreeMap<String, f64>,
    /// PSNR of the step's view, unclamped, dB; `None` if no pixel of its photo counts.
    pub psnr: Option<f64>,
    /// Gaussians after the step.
    pub gaussians: u64,
    /// Seconds of training so far.
    pub seconds: f64,
    /// CPU seconds of training so far, all threads, over all processes of the run; absent if the system does not report
    /// them.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub train_cpu_seconds: Option<f64>,
    /// Largest resident size so far, bytes.
    pub host_bytes_peak: u64,
    /// Bytes that this step sent to the device; 0 on the CPU.
    pub bytes_uploaded: u64,
    /// Bytes that this step brought back from the device.
    pub bytes_read_back: u64,
    /// Most device memory allocated so far, bytes.
    pub device_bytes_peak: u64,
    /// Traffic between the tiers since the start.
    #[serde(flatten)]
    pub tiers: TierTraffic,
    /// What this process has copied between frames and slots, if pages are on the device.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub slots: Option<SlotTraffic>,
    /// Costs of the commits so far, if any.
    #[serde(flatten, skip_serializing_if = "Option::is_none", default)]
    pub commits: Option<CommitReport>,
    /// The last check by which the run decides its count, if it does.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub growth: Option<GrowthCheck>,
    /// Evaluation on the held-out views, if one was due.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub test: Option<TestMetrics>,
}

/// Means over the held-out views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TestMetrics {
    /// Views in the means: those with an unmasked pixel.
    pub views: u32,
    /// Mean PSNR, dB.
    pub psnr: f64,
    pub ssim: f64,
    /// Mean LPIPS, if weights were given; the report names network and input range.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub lpips: Option<f64>,
    /// Under the exposures and colours that neighbouring training photos suggest, with `--appearance`; not comparable with `psnr`.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub predicted: Option<Predicted>,
    /// Colour-corrected PSNR, if requested; not comparable with `psnr`.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub color_corrected: Option<ColorCorrected>,
    /// PSNR of the right halves after a fit to the left halves, with `--appearance`; not comparable with `psnr`.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub half_fitted: Option<HalfFitted>,
}

/// Means over the views under predicted corrections.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Predicted {
    /// dB.
    pub predicted_psnr: f64,
    pub predicted_ssim: f64,
}

/// Mean PSNR of the right halves of the held-out photos.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HalfFitted {
    /// What was fitted to the left half of each photo.
    pub model: AppearanceMode,
    /// As they are, dB.
    pub right_psnr: f64,
    /// Under the correction that was fitted to the left half, dB.
    pub fitted_right_psnr: f64,
}

/// Mean PSNR after fitting the colours of each render to its photo.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ColorCorrected {
    pub method: ColorCorrect,
    /// Mean over the views, dB.
    pub cc_psnr: f64,
}

impl TestMetrics {
    /// Text of the PSNR under predicted exposures and of the colour-corrected one, with their names; empty if not measured.
    pub fn corrected_text(&self) -> String {
        let predicted = self.predicted.map(|p| format!(", with predicted exposures {:.2} dB", p.predicted_psnr));
        let corrected =
            self.color_corrected.map(|c| format!(", colour-corrected PSNR ({}) {:.2} dB", c.method.name(), c.cc_psnr));
        predicted.unwrap_or_default() + &corrected.unwrap_or_default()
    }
}

/// Costs of the steps: CPU seconds of the whole run, the rest of this process (after a resume, of the steps since then).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct StepCosts {
    /// CPU seconds of all threads during the steps, over all processes of the run; absent if the system does not report
    /// them. Those of an earlier process follow from its last line of metrics, in proportion to the seconds of training
    /// up to its last commit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_cpu_seconds: Option<f64>,
    /// Bytes read from the drive by the steps.
    pub train_bytes_read: u64,
    /// Bytes written to the drive by steps and by commits of pages.
    pub train_bytes_written: u64,
    /// Seconds that the steps waited for the drive.
    pub train_stall_seconds: f64,
    /// Peak bytes allocated on the device; 0 on the CPU.
    pub device_bytes_peak: u64,
    /// Bytes of the files of the pages on the drive, which hardly ever shrink; 0 without a checkpoint.
    pub drive_bytes_peak: u64,
    /// What the run said at its start.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forecast: Option<Foreseen>,
}

/// What a process foresaw before its first step. Every figure stands beside what came of it in the same summary.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Foreseen {
    /// Gaussians at the end.
    pub gaussians: u64,
    /// Seconds of the steps that were to be done.
    pub train_seconds: f64,
    /// Peak memory of the process, bytes.
    pub host_bytes_peak: u64,
    /// Bytes of the files of the pages on the drive.
    pub drive_bytes_peak: u64,
    /// Bytes that import and steps write to the drive, without commits.
    pub bytes_written: f64,
}

/// Content of summary.json.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summary {
    /// Steps done.
    pub steps: u32,
    pub gaussians: u64,
    /// Those among them that result files leave out, because too few photos see them.
    #[serde(default)]
    pub gaussians_left_out: u64,
    /// Seconds spent in training steps, without evaluation.
    pub train_seconds: f64,
    /// Largest resident size of the process, bytes.
    pub host_bytes_peak: u64,
    /// Held-out metrics; absent without held-out views.
    pub test: Option<TestMetrics>,
    /// The scene that was trained.
    pub scene: PathBuf,
    pub version: String,
    /// Variant of `test.ssim`: same, valid or reflect.
    pub ssim_variant: String,
    /// Whether the run did all of its steps and the evaluation after them.
    pub finished: bool,
    /// Gaussians whose update was skipped because a gradient was not finite, over all steps.
    pub rows_skipped_non_finite: u64,
    /// Steps skipped because the loss was not finite, or gradients of more than .01 % of the Gaussians in view.
    pub steps_skipped_non_finite: u32,
    /// Figures of what the run has learnt of its photos ([`crate::photos`]). They are written only: a list of unknown names would
    /// read those of other fields too.
    #[serde(flatten, skip_deserializing)]
    pub photos: BTreeMap<&'static str, Value>,
    /// Costs of the steps alone.
    #[serde(flatten)]
    pub costs: StepCosts,
    /// The checks by which the run decided its count; empty if it did not.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub growth: Vec<GrowthCheck>,
    /// The file for viewers beside the PLY (`--export`), if it was asked for and written.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub export: Option<ExportFacts>,
    /// Further files, if several formats were asked for.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub more_exports: Vec<ExportFacts>,
    /// Traffic between the tiers, including import, evaluation and export.
    #[serde(flatten)]
    pub tiers: TierTraffic,
    /// Costs of the commits, if any; after a resume, of the commits since then.
    #[serde(flatten, skip_serializing_if = "Option::is_none", default)]
    pub commits: Option<CommitReport>,
}

/// A file for viewers in summary.json.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExportFacts {
    /// The file, inside the run's folder.
    pub file: PathBuf,
    /// Its bytes, or those of all files of its folder.
    pub bytes: u64,
    /// Gaussians in its finest level, and giants.
    pub gaussians: u64,
    /// Gaussians of the PLY that its format cannot hold.
    pub left_out: u64,
    /// Gaussians of each level of detail, the finest first, if the format has levels.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub levels: Option<[u64; LEVELS_MAX]>,
    /// Giants among them, which viewers show beside any level.
    pub always_shown: u64,
}

/// A PSNR for JSON: at most [`PSNR_PERFECT`]; NaN (a broken picture) becomes the worst value, 0.
pub fn json_psnr(psnr: f64) -> f64 {
    if psnr.is_nan() || psnr == f64::NEG_INFINITY { 0.0 } else { psnr.min(PSNR_PERFECT) }
}

/// Appends lines to metrics.jsonl.
pub struct MetricsLog {
    path: PathBuf,
    file: BufWriter<File>,
    /// The TensorBoard file, if requested.
    events: Option<EventFile>,
    /// The last line that stands in the file.
    last: Option<StepLine>,
    cpu: CpuClock,
}

/// CPU seconds of a run over its processes.
#[derive(Debug, Clone, Copy, Default)]
struct CpuClock {
    /// Seconds of earlier processes; `None` if they are not known.
    before: Option<f64>,
    /// The reading of this process at the start of its steps.
    start: Option<f64>,
}

impl MetricsLog {
    /// Creates the file.
    /// Errors: the file cannot be created.
    pub fn create(path: &Path) -> InputResult<Self> {
        let file = File::create(path).map_err(|e| InputError::io(path, "creating the metrics file", &e))?;
        Ok(MetricsLog::of(path, file, None))
    }

    fn of(path: &Path, file: File, last: Option<StepLine>) -> MetricsLog {
        let (path, file) = (path.to_path_buf(), BufWriter::new(file));
        MetricsLog { path, file, events: None, last, cpu: CpuClock::default() }
    }

    /// Starts the clock of the CPU seconds of this process, when `train_seconds` of training are done.
    pub fn start_clock(&mut self, train_seconds: f64) {
        let of_line = |line: &StepLine| {
            // The steps between the last line and the last commit are taken to be as dear as those before.
            line.train_cpu_seconds.map(|cpu| if line.seconds > 0.0 { cpu * train_seconds / line.seconds } else { cpu })
        };
        let before = if train_seconds > 0.0 { self.last.as_ref().and_then(of_line) } else { Some(0.0) };
        self.cpu = CpuClock { before, start: process_cpu_seconds() };
    }

    /// CPU seconds of training so far, over all processes of the run.
    pub fn cpu_seconds(&self) -> Option<f64> {
        Some(self.cpu.before? + process_cpu_seconds()? - self.cpu.start?)
    }

    /// Writes TensorBoard's event files to `folder` as well; `first_step` as for [`EventFile::create`].
    /// Errors: the folder cannot be written.
    pub fn with_events(self, folder: &Path, first_step: Option<u32>) -> InputResult<Self> {
        Ok(MetricsLog { events: Some(EventFile::create(folder, first_step)?), ..self })
    }

    /// Opens the file of a new run, or of a run that resumes after the first `bytes` bytes.
    /// Errors: as [`MetricsLog::create`] and [`MetricsLog::resume`].
    pub fn open(path: &Path, bytes: Option<u64>) -> InputResult<Self> {
        bytes.map_or_else(|| MetricsLog::create(path), |bytes| MetricsLog::resume(path, bytes))
    }

    /// Appends after the first `bytes` bytes of the file; later bytes belong to steps that are repeated. If bytes are
    /// missing, appends after the last whole line and warns: no step depends on the log.
    /// Errors: the file cannot be read or written.
    pub fn resume(path: &Path, bytes: u64) -> InputResult<Self> {
        let io = |e: std::io::Error| InputError::io(path, "continuing the metrics file", &e);
        let mut options = OpenOptions::new();
        let file = options.read(true).append(true).create(true).open(path).map_err(io)?;
        let there = file.metadata().map_err(io)?.len();
        let kept = if there < bytes { end_of_whole_lines(&file).map_err(io)? } else { bytes };
        if there < bytes {
            crate::tell!(
                "warning: {} has only {there} of {bytes} bytes: the curves of the report have a gap",
                path.display()
            );
        }
        file.set_len(kept).map_err(io)?;
        let last = last_line(&file).map_err(io)?;
        Ok(MetricsLog::of(path, file, last))
    }

    /// Makes the file durable; returns its length in bytes.
    /// Errors: the file cannot be written.
    pub fn sync(&mut self) -> InputResult<u64> {
        let io = |e: std::io::Error| InputError::io(&self.path, "writing metrics", &e);
        self.file.flush().map_err(io)?;
        self.file.get_ref().sync_all().map_err(io)?;
        Ok(self.file.get_ref().metadata().map_err(io)?.len())
    }

    /// Writes one line unbuffered, so that a crash of the process loses no written line.
    /// Errors: the file cannot be written.
    pub fn write(&mut self, line: StepLine) -> InputResult<()> {
        self.append(&line)?;
        if let Some(events) = &mut self.events {
            let scalars = [scalars_of_step(&line), line.test.as_ref().map_or(Vec::new(), scalars_of_test)].concat();
            events.write(line.step, &scalars)?;
            for (name, value) in &line.loss_terms {
                events.write(line.step, &[(&format!("loss/{name}"), *value)])?;
            }
        }
        self.last = Some(line);
        Ok(())
    }

    /// Writes the evaluation after the last step, `step`: that step's line again, with the evaluation. A log without a line
    /// stays as it is. TensorBoard gets some of the pictures in `pictures` as well.
    /// Errors: the file cannot be written.
    pub fn write_evaluation(&mut self, step: u32, test: TestMetrics, pictures: &Path) -> InputResult<()> {
        let Some(last) = self.last.clone() else { return Ok(()) };
        self.append(&StepLine { step, test: Some(test), ..last })?;
        match &mut self.events {
            None => Ok(()),
            Some(events) => {
                events.write(step, &scalars_of_test(&test))?;
                write_pictures(events, step, pictures)
            }
        }
    }

    fn append(&mut self, line: &StepLine) -> InputResult<()> {
        let io = |e: std::io::Error| InputError::io(&self.path, "writing metrics", &e);
        let text = serde_json::to_string(line).map_err(|e| io(e.into()))?;
        self.file.write_all(text.as_bytes()).and_then(|()| self.file.write_all(b"\n")).map_err(io)?;
        self.file.flush().map_err(io)
    }
}

/// Writes up to [`PICTURES_MAX`] of the pictures in `folder`, spread over their names.
fn write_pictures(events: &mut EventFile, step: u32, folder: &Path) -> InputResult<()> {
    let names = listed_pictures(folder);
    for name in names.keys().step_by(names.len().div_ceil(PICTURES_MAX).max(1)) {
        let file = &folder.join(name);
        let header = read_header(file)?;
        let png = std::fs::read(file).map_err(|e| InputError::io(file, "reading the picture", &e))?;
        let tag = format!("held-out/{}", file.file_stem().unwrap_or_default().to_string_lossy());
        events.write_picture(step, &tag, (header.width, header.height), &png)?;
    }
    Ok(())
}

/// The last line of a file that is a step's.
fn last_line(file: &File) -> std::io::Result<Option<StepLine>> {
    let (mut reader, mut line, mut last) = (BufReader::new(file), Vec::new(), None);
    reader.seek(SeekFrom::Start(0))?;
    while reader.read_until(b'\n', &mut line)? > 0 {
        last = serde_json::from_slice(&line).ok().or(last);
        line.clear();
    }
    Ok(last)
}

/// Length of the file up to the end of its last complete line, bytes.
fn end_of_whole_lines(file: &File) -> std::io::Result<u64> {
    let (mut reader, mut line, mut end) = (BufReader::new(file), Vec::new(), 0);
    while reader.read_until(b'\n', &mut line)? > 0 && line.ends_with(b"\n") {
        end += line.len() as u64;
        line.clear();
    }
    Ok(end)
}

fn scalars_of_step(line: &StepLine) -> Vec<(&'static str, f64)> {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let mut scalars = vec![
        ("loss/train", line.loss),
        ("gaussians", line.gaussians as f64),
        ("seconds", line.seconds),
        ("host_peak_mib", mib(line.host_bytes_peak)),
        ("disk/read_mib", mib(line.tiers.stats.bytes_read)),
        ("disk/written_mib", mib(line.tiers.stats.bytes_written)),
        ("disk/stall_seconds", line.tiers.stats.stall_seconds),
    ];
    scalars.extend(line.psnr.map(|psnr| ("psnr/train", psnr)));
    // A skipped step has no loss.
    scalars.retain(|(_, value)| *value < f64::MAX);
    scalars
}

fn scalars_of_test(test: &TestMetrics) -> Vec<(&'static str, f64)> {
    let mut scalars = vec![("psnr/test", test.psnr), ("ssim/test", test.ssim)];
    let name = |method| match method {
        ColorCorrect::Affine => "psnr_color_corrected_affine/test",
        ColorCorrect::Quadratic => "psnr_color_corrected_quadratic/test",
    };
    scalars.extend(test.color_corrected.map(|c| (name(c.method), c.cc_psnr)));
    scalars
}

/// Writes summary.json.
/// Errors: the folder cannot be written.
pub fn write_summary(path: &Path, summary: &Summary) -> InputResult<()> {
    let text = serde_json::to_string_pretty(summary).map_err(|e| InputError::io(path, "writing", &e.into()))?;
    write_whole(path, (text + "\n").as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_broken_picture_is_not_a_perfect_one() {
        assert_eq!(json_psnr(f64::INFINITY), 100.0);
        assert_eq!(json_psnr(f64::NAN), 0.0);
        assert_eq!(json_psnr(f64::NEG_INFINITY), 0.0);
        assert_eq!(json_psnr(23.5), 23.5);
    }
}
