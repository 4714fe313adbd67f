//! Runs that are compared: each one trains in a process of its own, and its figures go to a file of results.
//!
//! Invariants: 1. a run that is in the file is not done again; what keys it is all that its figures depend on: the scene,
//! every setting, the seed, the program's bytes, the machine and the drive; 2. a run's folder appears under its name only
//! when the run has ended well; 3. a run that fails is written down and the others go on, but a run that is interrupted
//! ends everything; 4. what is being written is never removed: a run holds the sweep's lock as long as it lives, also when
//! the sweep itself was killed.

use gsscale::base::error::{InputError, InputResult};
use gsscale::base::machine::cpu_model;
use gsscale::config::choice::Choice;
use gsscale::config::file::{ByteSize, TrainConfig};
use gsscale::report::record::RunRecord;
use gsscale::report::results_log::ResultsLog;
use gsscale::train::report::Summary;
use gsscale::train::whole_file::write_whole;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Instant;
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

/// Where pages of a run go when they leave memory; the run's own folder takes its place.
const SPILL_PLACE: &str = "spill";
/// Characters of a failed run's message that are kept.
const PROBLEM_MAX: usize = 600;

/// Held by the sweep and by the run that it started, in the output folder.
const LOCK: &str = "sweep.lock";

/// All that the figures of a run depend on beside its settings.
pub struct Surroundings {
    /// Scene, drive, program, processor and threads, as one text.
    text: String,
    /// Ends the names of this sweep's folders on the drive, which other sweeps may use as well.
    mark: String,
}

impl Surroundings {
    /// Looks at scene, drive, program and machine. `spill` is the folder for pages, as the sweep was given it.
    ///
    /// # Errors
    /// `gsscale-train` is missing.
    pub fn of(scene: &Path, out: &Path, spill: Option<&Path>) -> InputResult<Surroundings> {
        let program = digest(&beside("gsscale-train")?)?;
        // The folder in --out needs no mention: an output folder may move with its results.
        let drive = spill.map_or_else(String::new, |path| whole(path).display().to_string());
        let (threads, cpu) = (rayon::current_num_threads(), cpu_model());
        let text = format!("{}\n{drive}\n{program}\n{threads}\n{cpu}", whole(scene).display());
        let mark = format!("{:08x}", xxh3_64(whole(out).as_os_str().as_encoded_bytes()) as u32);
        Ok(Surroundings { text, mark })
    }
}

/// A run to be done.
#[derive(Debug, Clone)]
pub struct Planned {
    /// What is turned.
    pub knob: String,
    /// To what, for people.
    pub label: String,
    /// All settings. A spill directory that is not empty stands for one that the sweep chooses.
    pub config: TrainConfig,
}

/// A folder of runs with their results.
pub struct Sweep {
    scene: PathBuf,
    out: PathBuf,
    spill: PathBuf,
    base: TrainConfig,
    surroundings: Surroundings,
    lock: File,
    /// The results so far.
    pub log: ResultsLog,
}

impl Planned {
    /// A run with the settings of the base.
    pub fn base(config: &TrainConfig) -> Planned {
        Planned { knob: "base".into(), label: "base".into(), config: config.clone() }
    }

    /// Digest of all settings, the seed, and what surrounds the run.
    pub fn key(&self, surroundings: &Surroundings) -> String {
        let settings = toml::to_string(&self.config).unwrap_or_default();
        format!("{:016x}", xxh3_64(format!("{}\n{settings}", surroundings.text).as_bytes()))
    }

    /// The same run, its pages going through a drive.
    pub fn on_drive(mut self, frames: u64) -> Planned {
        self.config.spill_dir = SPILL_PLACE.into();
        self.config.frames = u32::try_from(frames).unwrap_or(u32::MAX);
        self.config.host_mem = ByteSize(0);
        self
    }

    /// Name of the run's folder.
    fn name(&self, key: &str) -> String {
        let part = |text: &str| -> String {
            let keep = |c: char| if c.is_ascii_alphanumeric() || c == '.' { c } else { '-' };
            text.chars().map(keep).collect()
        };
        format!("{}-{}-seed{}-{}", part(&self.knob), part(&self.label), self.config.seed, &key[..8])
    }
}

impl Sweep {
    /// Opens or makes the folder; removes what runs that were cut off left in it.
    ///
    /// # Errors
    /// The folder cannot be written, another sweep uses it, or its results cannot be read.
    pub fn open(scene: &Path, out: &Path, spill: Option<&Path>, base: &TrainConfig, file: &str) -> InputResult<Sweep> {
        let io = |e: std::io::Error| InputError::io(out, "making the output folder", &e);
        std::fs::create_dir_all(out.join("runs")).map_err(io)?;
        let lock = lock(out)?;
        let log = ResultsLog::open(&out.join(file))?;
        let surroundings = Surroundings::of(scene, out, spill)?;
        let spill = spill.map_or_else(|| out.join("spill"), Path::to_path_buf);
        let (scene, out, base) = (scene.to_path_buf(), out.to_path_buf(), base.clone());
        // Only the one who holds the lock comes here, so nothing that is being written is removed.
        remove_parts(&out.join("runs"), &[".part", ".part.toml"])?;
        remove_parts(&spill, &[&format!("{}.part", surroundings.mark)])?;
        Ok(Sweep { scene, out, spill, base, surroundings, lock, log })
    }

    /// What keys the results beside the settings.
    pub fn surroundings(&self) -> &Surroundings {
        &self.surroundings
    }

    /// The result of a run: from the file, or of a process that trains now.
    ///
    /// # Errors
    /// The program is missing or was interrupted, or results cannot be written. A run that fails is a result.
    pub fn run(&mut self, planned: &Planned) -> InputResult<RunRecord> {
        let key = planned.key(&self.surroundings);
        if let Some(done) = self.log.done(&key) {
            return Ok(done.clone());
        }
        let record = self.train(planned, &key)?;
        self.log.append(record.clone())?;
        Ok(record)
    }

    fn train(&self, planned: &Planned, key: &str) -> InputResult<RunRecord> {
        let name = planned.name(key);
        let part = self.out.join("runs").join(format!("{name}.part"));
        let mut config = planned.config.clone();
        let spill = self.spill.join(format!("{name}-{}.part", self.surroundings.mark));
        if config.residence().spill_dir().is_some() {
            make_folder(&self.spill)?;
            config.spill_dir = spill.display().to_string();
        }
        let mut record = self.record(planned, key);
        let file = self.out.join("runs").join(format!("{name}.part.toml"));
        write_config(&file, &config)?;
        let began = Instant::now();
        let arguments = [&self.scene, Path::new("--out"), &part, Path::new("--config"), &file];
        let output = self.spawn("gsscale-train", &arguments)?;
        record.wall_seconds = began.elapsed().as_secs_f64();
        if !output.status.success() {
            // Said before the folders go: a run that stops early would keep its checkpoint.
            refuse_interrupted(&output)?;
            record.problem = Some(problem(&output));
        } else {
            self.read_figures(&mut record, &config, &part)?;
        }
        remove(&spill)?;
        remove(&file)?;
        let folder = self.out.join("runs").join(name);
        remove(&folder)?;
        match record.problem {
            Some(_) => remove(&part)?,
            None => std::fs::rename(&part, &folder).map_err(|e| InputError::io(&folder, "naming the run", &e))?,
        }
        Ok(record)
    }

    fn record(&self, planned: &Planned, key: &str) -> RunRecord {
        RunRecord {
            key: key.to_string(),
            scene: self.scene.display().to_string(),
            knob: planned.knob.clone(),
            label: planned.label.clone(),
            settings: changes(&self.base, &planned.config),
            seed: planned.config.seed,
            steps: planned.config.steps,
            version: env!("CARGO_PKG_VERSION").to_string(),
            threads: rayon::current_num_threads() as u64,
            cpu: cpu_model(),
            ..RunRecord::default()
        }
    }

    /// Takes the figures from what the run left in `folder`, and removes its PLY, which is large.
    fn read_figures(&self, record: &mut RunRecord, config: &TrainConfig, folder: &Path) -> InputResult<()> {
        let summary: Summary = read_json(&folder.join("summary.json"))?;
        let ply = folder.join("point_cloud.ply");
        record.ply = digest(&ply)?;
        (record.psnr, record.ssim) = (summary.test.map(|t| t.psnr), summary.test.map(|t| t.ssim));
        record.seconds = summary.train_seconds;
        record.cpu_seconds = summary.costs.train_cpu_seconds;
        record.stall_seconds = summary.costs.train_stall_seconds;
        record.bytes_read = summary.costs.train_bytes_read;
        record.bytes_written = summary.costs.train_bytes_written;
        record.gaussians = summary.gaussians;
        (record.frames, record.pages) = (summary.tiers.frames, summary.tiers.pages);
        record.host_bytes_peak = summary.host_bytes_peak;
        record.device_bytes_peak = summary.costs.device_bytes_peak;
        record.drive_bytes_peak = summary.costs.drive_bytes_peak;
        record.view_order = TrainConfig::read(&folder.join("config.toml"))?.view_order.word().into_owned();
        let photos = |c: &TrainConfig| (c.data_factor, c.max_resolution);
        if photos(config) != photos(&self.base) {
            // Smaller photos are easier: all are judged on the photos of the base.
            let file = folder.join("evaluated-as.toml");
            write_config(&file, &self.base)?;
            let json = folder.join("evaluated.json");
            let arguments = [&ply, self.scene.as_path(), Path::new("--config"), &file, Path::new("--json"), &json];
            let output = self.spawn("gsscale-eval", &arguments)?;
            if !output.status.success() {
                refuse_interrupted(&output)?;
                record.problem = Some(problem(&output));
                return Ok(());
            }
            let report: Value = read_json(&json)?;
            (record.psnr, record.ssim) = (report["test"]["psnr"].as_f64(), report["test"]["ssim"].as_f64());
        }
        remove(&ply)
    }

    /// Runs a program that lies beside this one to its end. Its input is the lock, which stays held as long as it lives.
    fn spawn(&self, program: &str, arguments: &[&Path]) -> InputResult<Output> {
        let path = beside(program)?;
        let held = self.lock.try_clone().map_err(|e| InputError::io(&self.out, "handing on the lock", &e))?;
        let mut command = Command::new(&path);
        command.args(arguments).stdin(Stdio::from(held)).stdout(Stdio::null()).stderr(Stdio::piped());
        if program == "gsscale-train" {
            command.arg("--quiet");
        }
        command.output().map_err(|e| InputError::io(&path, "starting the program", &e))
    }
}

/// Keys of `config` that are not as in `base`, the seed left out.
fn changes(base: &TrainConfig, config: &TrainConfig) -> BTreeMap<String, String> {
    let table = |c: &TrainConfig| toml::Table::try_from(c).unwrap_or_default();
    let base = table(base);
    let changed = table(config).into_iter().filter(|(key, value)| key != "seed" && base.get(key) != Some(value));
    changed.map(|(key, value)| (key, value.as_str().map_or_else(|| value.to_string(), str::to_string))).collect()
}

fn write_config(path: &Path, config: &TrainConfig) -> InputResult<()> {
    let text = toml::to_string(config)
        .map_err(|e| InputError::new(path, format!("writing failed: {e}"), "report this as a bug"))?;
    write_whole(path, text.as_bytes())
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> InputResult<T> {
    let text = std::fs::read(path).map_err(|e| InputError::io(path, "reading", &e))?;
    serde_json::from_slice(&text)
        .map_err(|e| InputError::new(path, format!("is not what a run writes: {e}"), "run it again"))
}

/// The same path whether the folder is there yet or not: links of what is there are followed.
fn whole(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let of = |up: &Path| Some(std::fs::canonicalize(up).ok()?.join(path.strip_prefix(up).ok()?));
    path.ancestors().find_map(of).unwrap_or_else(|| path.clone())
}

/// A program that lies beside this one.
fn beside(program: &str) -> InputResult<PathBuf> {
    let own = std::env::current_exe().map_err(|e| InputError::io(program, "finding this program", &e))?;
    let path = own.with_file_name(format!("{program}{}", std::env::consts::EXE_SUFFIX));
    match path.is_file() {
        true => Ok(path),
        false => Err(InputError::new(&path, "is missing", "build all programs: cargo build --release")),
    }
}

/// Takes the lock of an output folder.
fn lock(out: &Path) -> InputResult<File> {
    let path = out.join(LOCK);
    let io = |e: std::io::Error| InputError::io(&path, "opening the lock", &e);
    let file = OpenOptions::new().write(true).create(true).truncate(false).open(&path).map_err(io)?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => {
            let problem = "another sweep, or a run that a killed one left behind, is at work here";
            Err(InputError::new(out, problem, "wait until it has ended, or choose another --out"))
        }
        // Where a file system knows no locks there is one sweep all the same.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(file),
    }
}

/// A run that somebody stopped is no result: the sweep stops too, and goes on with this run next time.
fn refuse_interrupted(output: &Output) -> InputResult<()> {
    match output.status.code() {
        Some(130 | 143) => {
            Err(InputError::new("the sweep", "was interrupted", "the same command goes on where it stopped"))
        }
        _ => Ok(()),
    }
}

/// What a failed program said last, or how it ended.
fn problem(output: &Output) -> String {
    let said = String::from_utf8_lossy(&output.stderr);
    let errors = said.rfind("error: ").map_or(said.trim(), |at| said[at..].trim());
    let text = if errors.is_empty() { output.status.to_string() } else { errors.replace('\n', " ") };
    text.chars().take(PROBLEM_MAX).collect()
}

fn digest(path: &Path) -> InputResult<String> {
    let io = |e: std::io::Error| InputError::io(path, "reading the result", &e);
    let mut file = File::open(path).map_err(io)?;
    let (mut hash, mut buffer) = (Xxh3::new(), vec![0; 1 << 20]);
    loop {
        match file.read(&mut buffer).map_err(io)? {
            0 => return Ok(format!("{:016x}", hash.digest())),
            n => hash.update(&buffer[..n]),
        }
    }
}

fn make_folder(path: &Path) -> InputResult<()> {
    std::fs::create_dir_all(path).map_err(|e| InputError::io(path, "making the folder", &e))
}

/// Removes a file or folder of a run, if it is there.
fn remove(path: &Path) -> InputResult<()> {
    let removed = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    match removed {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(InputError::io(path, "removing", &e)),
        _ => Ok(()),
    }
}

/// Removes what runs that were cut off left in a folder, by how the names end.
fn remove_parts(folder: &Path, ends: &[&str]) -> InputResult<()> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Ok(()) };
    let is_part = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.contains("-seed") && ends.iter().any(|end| name.ends_with(end))
    };
    entries.flatten().map(|e| e.path()).filter(is_part).try_for_each(|path| remove(&path))
}
