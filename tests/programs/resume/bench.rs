//! A small scene and runs on it in which rounds, resets and raises of the SH degree each happen several times.

use crate::support::scenes::{classic, stderr, summary, text, train};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use serde_json::Value;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Steps of a run.
pub const STEPS: u32 = 200;

/// Flags of every run.
pub const BUSY: &[&str] = &[
    "--page-rows",
    "32",
    "--grow-grad2d",
    "0.001",
    "--refine-start",
    "60",
    "--refine-every",
    "30",
    "--reset-every",
    "80",
    "--sh-every",
    "50",
    "--view-order",
    "groups:4",
    "--log-every",
    "7",
    "--test-every",
    "24",
    "--device",
    "cpu",
    "--quiet",
];

/// Commits only when a run is asked to stop, and at the end.
pub const SELDOM: [&str; 2] = ["--commit-every", "0"];

/// Where a run keeps its pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// In memory.
    Memory,
    /// In a spill directory, with this many frames.
    Spill(u64),
}

pub struct Bench {
    folder: TempDir,
    pub scene: PathBuf,
    /// The argument of `--device`.
    device: &'static str,
    /// The argument of `--steps` of runs in `out`.
    pub steps: u32,
}

/// The result of an uninterrupted run.
pub struct Alone {
    pub ply: Vec<u8>,
    /// Steps in metrics.jsonl.
    pub logged: Vec<u64>,
    /// Pages at the end.
    pub pages: u64,
    /// The most pages of a step.
    pub fewest: u64,
    /// The most bytes of device memory; 0 on the CPU.
    pub device_bytes: u64,
}

impl Bench {
    pub fn new() -> Bench {
        Bench::on("cpu")
    }

    /// A bench whose runs train on this device.
    pub fn on(device: &'static str) -> Bench {
        let folder = TempDir::new().unwrap();
        let scene = folder.path().join("scene");
        let (views, width, height, points) = (24, 64, 48, 6000);
        let blocks = Some(20);
        let city =
            CityOptions { seed: 5, views, width, height, points, blocks, supersample: 1, ..CityOptions::default() };
        write_city(&scene, &city, &|_, _| {}).unwrap();
        Bench { folder, scene, device, steps: STEPS }
    }

    /// [`BUSY`] with the bench's device.
    fn flags(&self) -> Vec<&'static str> {
        BUSY.iter().map(|&word| if word == "cpu" { self.device } else { word }).collect()
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The uninterrupted run, in memory.
    pub fn alone(&self, more: &[&str]) -> Alone {
        let out = self.path("alone");
        let steps = STEPS.to_string();
        let output =
            train(&[&[text(&self.scene), "--out", text(&out), "--steps", &steps], &self.flags()[..], more].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        let done = summary(&out);
        assert_ne!(done["gaussians"], 6000, "no round changed anything, so the test shows little");
        let of = |key: &str| done[key].as_u64().unwrap();
        let (pages, fewest) = (of("pages"), of("pages_pinned_max"));
        let device_bytes = lines(&out).iter().filter_map(|line| line["device_bytes_peak"].as_u64()).max().unwrap_or(0);
        let alone = Alone { ply: ply(&out), logged: logged(&out), pages, fewest, device_bytes };
        std::fs::remove_dir_all(&out).unwrap();
        alone
    }

    /// Starts a run in `out`.
    pub fn begin(&self, place: Place, more: &[&str]) -> Child {
        let (out, spill, steps) = (self.path("out"), self.path("spill"), self.steps.to_string());
        let mut args = vec![text(&self.scene), "--out", text(&out), "--steps", &steps];
        let frames;
        if let Place::Spill(count) = place {
            frames = count.to_string();
            // A given codec saves the second of measuring the drive.
            args.extend(["--spill-dir", text(&spill), "--frames", &frames, "--spill-codec", "raw"]);
        }
        spawn(&[&args, &self.flags()[..], more].concat())
    }

    /// Resumes the run in `out`.
    pub fn go_on(&self, more: &[&str]) -> Child {
        self.go_on_in("out", more)
    }

    /// Resumes the run in the folder of this name.
    pub fn go_on_in(&self, out: &str, more: &[&str]) -> Child {
        spawn(&[&["--resume", text(&self.path(out)), "--quiet"], more].concat())
    }

    /// Starts a run in `out` and asks it to stop after some lines of metrics.
    pub fn stopped(&self, place: Place, lines: usize) {
        self.stopped_with(place, lines, &[]);
    }

    /// Like [`Bench::stopped`], with the flags `more`.
    pub fn stopped_with(&self, place: Place, lines: usize, more: &[&str]) {
        let mut child = self.begin(place, &[&SELDOM, more].concat());
        self.wait_for_lines(&mut child, lines);
        signal(&mut child, "INT");
        let output = ended(child);
        assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
    }

    /// The checkpoint of the run in `out`.
    pub fn checkpoint(&self, place: Place) -> PathBuf {
        self.path(if place == Place::Memory { "out/checkpoint" } else { "spill" })
    }

    /// Waits until the run in `out` has logged more than `lines` lines, or has ended.
    pub fn wait_for_lines(&self, child: &mut Child, lines: usize) {
        self.wait_for_lines_in("out", child, lines);
    }

    /// Like [`Bench::wait_for_lines`], for the run in the folder of this name.
    pub fn wait_for_lines_in(&self, out: &str, child: &mut Child, lines: usize) {
        let started = Instant::now();
        let file = self.path(out).join("metrics.jsonl");
        let count = || std::fs::read_to_string(&file).map_or(0, |text| text.lines().count());
        while count() <= lines && child.try_wait().unwrap().is_none() {
            assert!(started.elapsed() < Duration::from_secs(240), "the run does not get on");
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

fn spawn(args: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
    command.args(args).args(classic(args)).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

pub fn ply(out: &Path) -> Vec<u8> {
    std::fs::read(out.join("point_cloud.ply")).unwrap()
}

/// metrics.jsonl.
pub fn lines(out: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Steps in metrics.jsonl.
pub fn logged(out: &Path) -> Vec<u64> {
    lines(out).iter().map(|line| line["step"].as_u64().unwrap()).collect()
}

/// Sends a signal to a run that must still go on; a run that has ended fails the test with its own words.
pub fn signal(child: &mut Child, name: &str) {
    let done = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
    if !done.success() {
        let mut said = String::new();
        child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
        panic!("the run ended before the signal with {:?}: {said}", child.wait());
    }
}

pub fn ended(child: Child) -> Output {
    child.wait_with_output().unwrap()
}

/// Waits for a run that must succeed.
pub fn succeeded(child: Child) -> String {
    let output = ended(child);
    assert!(output.status.success(), "{}", stderr(&output));
    stderr(&output)
}

/// Waits for a run that must refuse with a remedy; returns stderr.
pub fn refused(child: Child) -> String {
    let output = ended(child);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert!(stderr(&output).contains("remedy"), "{}", stderr(&output));
    stderr(&output)
}

/// Copies a folder recursively.
pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy_folder(&entry.path(), &to),
            false => std::fs::copy(entry.path(), to).map(|_| ()).unwrap(),
        }
    }
}
