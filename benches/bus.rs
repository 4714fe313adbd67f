//! Step time of runs with pages on a device, on emulated buses from fast to as slow as the compute of a step.
//!
//! `cargo bench --bench bus -- SCENE` runs `gsscale-train` once without an emulated bus, which gives the compute of each step, and once
//! for each bus whose uploads take a share of it. All of that in turns, `--rounds` times. Each step is compared with the same step of the
//! same round: its time over max(compute, upload) + download, where upload and download are the bytes that crossed the bus over its rate.
//! 1 is a step whose uploads hide behind compute; a step that hides nothing takes (compute + upload + download) over the same.
//!
//! A run with an emulated bus submits on a thread of its own ([`gsscale::gpu`]), so a software driver computes beside the host as well, and the
//! run without a bus does not. So the ratio may be below 1: compute then includes host work that hides too. `ratio_hidden_none` is that of a
//! step that hides nothing.

pub mod support;

use clap::Parser;
use gsscale::base::error::{InputError, InputResult};
use gsscale::train::error::TrainError;
use gsscale::train::log::report::StepLine;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use support::median;
use support::training::run_with_arguments;

const EXAMPLES: &str = "\
Examples:
  cargo bench --bench bus -- scans/city --device-mem 2GiB
  cargo bench --bench bus -- scans/city --device-mem 5MiB --shares 0.1,1 -- --page-rows 32 --view-order shuffle

A run takes part of the device memory for slots, so --device-mem says how many payloads a step lacks. Flags after -- are those of
gsscale-train.";

/// The device of the run, and what keeps its steps alike: no events.
const RUN: [&str; 14] = [
    "--device",
    "gpu",
    "--optimizer-on",
    "device",
    "--schedule",
    "classic",
    "--strategy",
    "none",
    "--sh-every",
    "0",
    "--test-every",
    "0",
    "--log-every",
    "1",
];
/// Environment variable of the emulated bus.
const BUS: &str = "GSSCALE_EMULATE_BUS";

/// Times steps on emulated buses, and prints a line of JSON for each bus.
#[derive(Parser)]
#[command(name = "bus", bin_name = "cargo bench --bench bus --", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), one with transforms.json, or Mega-NeRF's layout
    scene: PathBuf,
    /// Device memory of the runs; 0 for all pages
    #[arg(long, default_value = "0", value_name = "SIZE")]
    device_mem: String,
    /// Seconds of upload over seconds of compute, one bus for each
    #[arg(long, value_delimiter = ',', default_value = "0.0625,0.25,0.5,1", value_name = "S")]
    shares: Vec<f64>,
    /// Steps of a run
    #[arg(long, default_value_t = 90, value_name = "N", value_parser = clap::value_parser!(u32).range(4..))]
    steps: u32,
    /// Steps before the measurement
    #[arg(long, default_value_t = 30, value_name = "N")]
    warm_up: u32,
    /// Rounds
    #[arg(long, default_value_t = 3, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Further flags of gsscale-train
    #[arg(last = true, value_name = "FLAGS")]
    train: Vec<String>,
}

/// A measured step.
#[derive(Debug, Clone, Copy)]
struct Step {
    seconds: f64,
    bytes_up: f64,
    bytes_down: f64,
    loss: f64,
}

/// What a bus did to the steps.
#[derive(Debug, Clone, Default)]
struct OnBus {
    seconds: Vec<f64>,
    compute: Vec<f64>,
    upload: Vec<f64>,
    download: Vec<f64>,
    same_losses: bool,
}

fn main() -> ExitCode {
    run_with_arguments("bus", |arguments, print| start(&Args::parse_from(arguments), print))
}

/// Runs the benchmark.
///
/// # Errors
/// The input is invalid, or a run fails.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    if let Some(share) = args.shares.iter().find(|share| !(share.is_finite() && **share > 0.0)) {
        let problem = format!("{share} is no share");
        return Err(InputError::new("--shares", problem, "write for example 0.25,0.5,1").into());
    }
    let folder = std::env::temp_dir().join(format!("gsscale-bus-{}", std::process::id()));
    std::fs::create_dir(&folder).map_err(|e| InputError::io(&folder, "making the folder", &e))?;
    let measured = measure(args, &folder);
    let removed = std::fs::remove_dir_all(&folder).map_err(|e| InputError::io(&folder, "removing the folder", &e));
    let (rates, buses) = measured?;
    removed?;
    for ((share, rate), bus) in args.shares.iter().zip(rates).zip(buses) {
        print(&bus.line(args, *share, rate));
    }
    Ok(())
}

/// Runs all rounds; returns the rates of the buses, bytes per second, and what each did.
fn measure(args: &Args, folder: &Path) -> Result<(Vec<f64>, Vec<OnBus>), TrainError> {
    let mut rates: Vec<f64> = Vec::new();
    let mut buses = vec![OnBus { same_losses: true, ..OnBus::default() }; args.shares.len()];
    for round in 0..args.rounds {
        let alone = run(args, &folder.join(format!("alone{round}")), None)?;
        if rates.is_empty() {
            let sum = |of: fn(&Step) -> f64| alone.iter().map(of).sum::<f64>();
            let (bytes, seconds) = (sum(|step| step.bytes_up), sum(|step| step.seconds));
            rates = args.shares.iter().map(|share| (bytes / (share * seconds)).max(1.0)).collect();
        }
        for (i, (rate, bus)) in rates.iter().zip(&mut buses).enumerate() {
            let steps = run(args, &folder.join(format!("bus{round}-{i}")), Some(*rate))?;
            steps.iter().zip(&alone).for_each(|(step, alone)| bus.add(step, alone, *rate));
        }
    }
    Ok((rates, buses))
}

/// The measured steps of a run, on a bus of this rate.
fn run(args: &Args, out: &Path, rate: Option<f64>) -> InputResult<Vec<Step>> {
    let mut train = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
    train.arg(&args.scene).arg("--out").arg(out).args(RUN).args(["--device-mem", &args.device_mem, "--quiet"]);
    train.args(["--steps", &args.steps.to_string()]).args(&args.train).env_remove(BUS);
    if let Some(rate) = rate {
        train.env(BUS, format!("{}B/s,0us", rate.round()));
    }
    let output = train.output().map_err(|e| InputError::io(&args.scene, "starting gsscale-train", &e))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        return Err(InputError::new(&args.scene, format!("gsscale-train failed: {said}"), "correct the flags"));
    }
    let path = out.join("metrics.jsonl");
    let text = std::fs::read_to_string(&path).map_err(|e| InputError::io(&path, "reading the metrics", &e))?;
    let wrong = |e: serde_json::Error| InputError::new(&path, e.to_string(), "report this as a bug");
    let lines: Vec<StepLine> = text.lines().map(serde_json::from_str).collect::<Result<_, _>>().map_err(wrong)?;
    let step = |pair: &[StepLine]| Step {
        seconds: pair[1].seconds - pair[0].seconds,
        bytes_up: pair[1].bytes_uploaded as f64,
        bytes_down: pair[1].bytes_read_back as f64,
        loss: pair[1].loss,
    };
    let warm_up = args.warm_up.min(args.steps / 2) as usize;
    Ok(lines.windows(2).skip(warm_up.saturating_sub(1)).map(step).collect())
}

impl OnBus {
    /// Adds a step and the same step of the run without an emulated bus.
    fn add(&mut self, step: &Step, alone: &Step, rate: f64) {
        self.seconds.push(step.seconds);
        self.compute.push(alone.seconds);
        self.upload.push(step.bytes_up / rate);
        self.download.push(step.bytes_down / rate);
        self.same_losses &= step.loss.to_bits() == alone.loss.to_bits();
    }

    /// The median of a ratio, `over(compute, upload, download)` below.
    fn ratio(&self, of: impl Fn(usize) -> f64, over: impl Fn(f64, f64, f64) -> f64) -> f64 {
        let below = |i: usize| over(self.compute[i], self.upload[i], self.download[i]);
        median((0..self.seconds.len()).map(|i| of(i) / below(i).max(f64::MIN_POSITIVE)))
    }

    /// The line of JSON.
    fn line(&self, args: &Args, share: f64, rate: f64) -> Value {
        let median_of = |of: &[f64]| median(of.iter().copied());
        let hidden = |compute: f64, upload: f64, download: f64| compute.max(upload) + download;
        let none_hidden = |i: usize| self.compute[i] + self.upload[i] + self.download[i];
        json!({
            "scene": args.scene, "device_mem": args.device_mem, "upload_over_compute": share, "bytes_per_second": rate.round(),
            "steps": self.seconds.len(), "rounds": args.rounds, "seconds_per_step_median": median_of(&self.seconds),
            "compute_seconds_median": median_of(&self.compute), "upload_seconds_median": median_of(&self.upload),
            "download_seconds_median": median_of(&self.download), "ratio": self.ratio(|i| self.seconds[i], hidden),
            "ratio_hidden_none": self.ratio(none_hidden, hidden), "same_losses": self.same_losses,
            "version": env!("CARGO_PKG_VERSION"),
        })
    }
}
