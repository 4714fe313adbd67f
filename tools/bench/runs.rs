//! Runs the trainings of a sweep, each in its own process, and logs the results. Not here: which runs there are ([`super::list`]).
//!
//! Invariants: 1. a logged run does not run again; its key is a digest of everything that the figures depend on: scene,
//! settings, seed, bytes of the program, machine and drive; 2. a run's folder gets its final name only after success;
//! 3. a failed run is logged and the sweep continues; an interrupted run ends the sweep; 4. a file in use is never
//! removed: each run holds the lock of the sweep while the run lives, even if the sweep itself was killed.

use super::city::{CityCut, CityPlace, borders};
use super::programs::{beside, problem, start};
use super::read_json;
use super::record::{Pace, RunRecord, convert_to_one_pace};
use super::results_log::{ResultsLog, successful_run};
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::machine::cpu_model;
use gsscale::base::whole_file::{open_locked, write_whole};
use gsscale::cells::work::{Done, status};
use gsscale::cells::{City, machine_flags};
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::read_options;
use gsscale::config::values::{ByteSize, Choice};
use gsscale::dataset::disturb::Disturbance;
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::photos::outlier::views;
use gsscale::report::run_files::{CONFIG_FILE, EVALUATED_AS_FILE, EVALUATED_FILE, PLY_FILE, SUMMARY_FILE};
use gsscale::train::log::report::Summary;
use serde_json::Value;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Instant;
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

/// Stands for a run's own spill directory in the config of a planned run.
const SPILL_PLACEHOLDER: &str = "spill";
/// File in the output folder that the sweep and its current run lock.
const LOCK: &str = "sweep.lock";
const AGAIN: &str = "start the sweep again";
/// File of results in the output folder.
pub const RESULTS: &str = "results.jsonl";

/// Where a sweep of one scene reads and writes.
#[derive(Debug, Clone)]
pub struct Place {
    pub scene: PathBuf,
    pub out: PathBuf,
    /// Folder of the pages; `spill` in `out` without.
    pub spill: Option<PathBuf>,
}

/// Everything except the settings that the figures of a run depend on.
pub struct Surroundings {
    /// Scene and its content, drive, program, processor and threads, as one text.
    text: String,
    /// Suffix of this sweep's folders on the drive, which other sweeps may also use.
    mark: String,
}

impl Surroundings {
    /// Reads scene, drive, program and machine; `base` says where the photos lie.
    /// Errors: `gsscale-train` is missing, or the scene cannot be read.
    pub fn of(place: &Place, base: &TrainConfig) -> InputResult<Surroundings> {
        let program = digest(&beside("gsscale-train")?.0)?;
        // The default folder in --out is not part of the key: an output folder may move with its results.
        let drive = place.spill.as_ref().map_or_else(String::new, |path| resolved(path).display().to_string());
        let (threads, cpu) = (rayon::current_num_threads(), cpu_model());
        let (scene, content) = (resolved(&place.scene), content_of(&place.scene, base)?);
        let text = format!("{}\n{content}\n{drive}\n{program}\n{threads}\n{cpu}", scene.display());
        let mark = format!("{:08x}", xxh3_64(resolved(&place.out).as_os_str().as_encoded_bytes()) as u32);
        Ok(Surroundings { text, mark })
    }
}

#[derive(Debug, Clone)]
pub struct Planned {
    /// Group and name of the run, `group/name`.
    pub name: String,
    /// All settings. The sweep replaces a spill directory that is not empty by one of its own.
    pub config: TrainConfig,
    /// The scene of the run, if it is not the scene of the sweep.
    pub scene: Option<MadeScene>,
    /// Environment variables of the run, by name. The runs of the sweep inherit all others.
    pub environment: BTreeMap<String, String>,
    /// Runs of one class and seed must end with the same bits; empty = this is not known.
    pub bits: String,
    /// The scene is trained in cells.
    pub city: Option<PlannedCity>,
    /// The run's folder keeps its PLY, with which cities are compared.
    pub keeps_ply: bool,
}

#[derive(Debug, Clone)]
pub struct PlannedCity {
    pub cut: CityCut,
    /// The keys of the run that the list, a config file or flags give. The prior and each cell derive the others from their own lengths.
    pub keys: toml::Table,
    /// The run with which the city is compared.
    pub reference: Box<Planned>,
}

#[derive(Debug, Clone)]
pub struct MadeScene {
    /// Its folder, which exists while the run lives.
    pub folder: PathBuf,
    /// A complete description of the scene, which stands for the folder in the run's key.
    pub how: String,
    pub disturbance: Disturbance,
    /// Training photos that are wrong in it, by name.
    pub wrong: Vec<String>,
}

/// An output folder of runs with their results.
pub struct Sweep {
    scene: PathBuf,
    out: PathBuf,
    spill: PathBuf,
    base: TrainConfig,
    surroundings: Surroundings,
    lock: File,
    log: ResultsLog,
    json: bool,
    /// Steps of the short trainings that show the pace of the machine; 0 = the pace is not measured.
    pace_steps: u32,
    /// The pace after the last run, which is that before the next run.
    pace_after_last_run: Option<Pace>,
}

/// Makes a config keep `frames` pages in memory and the others on the drive.
pub fn use_drive(config: &mut TrainConfig, frames: u32) {
    config.spill_dir = SPILL_PLACEHOLDER.into();
    config.frames = frames;
    config.host_mem = ByteSize(0);
}

impl Planned {
    /// Digest of all settings with the content of the files that they name, the seed, the scene, and the surroundings. A missing file
    /// counts as empty: the run refuses it.
    pub fn key(&self, surroundings: &Surroundings) -> String {
        let settings = toml::to_string(&self.config).unwrap_or_default();
        let config = &self.config;
        let files = [&config.init_ply, &config.pages_file, &config.views_file, &config.first_appearance];
        let files = files.map(|path| digest(Path::new(path)).unwrap_or_default()).join("\n");
        let how = self.scene.as_ref().map_or(String::new(), |scene| format!("\n{}", scene.how));
        let environment: String = self.environment.iter().map(|(name, value)| format!("\n{name}={value}")).collect();
        let city = self.city.as_ref().map_or(String::new(), |city| {
            format!("\n{:?}\n{}\n{}", city.cut, city.keys, city.reference.key(surroundings))
        });
        let all = format!("{}\n{settings}{how}{environment}{city}\n{files}", surroundings.text);
        format!("{:016x}", xxh3_64(all.as_bytes()))
    }

    /// Name of the run's folder.
    fn folder(&self, key: &str) -> String {
        let part = |text: &str| -> String {
            let keep = |c: char| if c.is_ascii_alphanumeric() || c == '.' { c } else { '-' };
            text.chars().map(keep).collect()
        };
        format!("{}-seed{}-{}", part(&self.name), self.config.seed, &key[..8])
    }
}

impl Sweep {
    /// Opens or creates the output folder, with its results; removes the leftovers of interrupted runs.
    /// Errors: the folder cannot be written, another sweep uses it, or the results cannot be read.
    pub fn open(
        place: &Place,
        surroundings: Surroundings,
        base: &TrainConfig,
        pace_steps: u32,
        json: bool,
    ) -> InputResult<Sweep> {
        let (Place { scene, out, spill }, base) = (place.clone(), base.clone());
        make_folder(&out.join("runs"))?;
        let lock = lock(&out)?;
        let log = ResultsLog::open(&out.join(RESULTS))?;
        let spill = spill.unwrap_or_else(|| out.join("spill"));
        // This process holds the lock, so no run uses these files.
        remove_parts(&out.join("runs"), &[".part", ".part.toml"])?;
        remove_parts(&spill, &[&format!("{}.part", surroundings.mark)])?;
        let pace_after_last_run = None;
        Ok(Sweep { scene, out, spill, base, surroundings, lock, log, json, pace_steps, pace_after_last_run })
    }

    /// The planned runs that have no result yet.
    pub fn open_runs<'a>(&self, runs: &'a [Planned]) -> Vec<&'a Planned> {
        let is_open = |run: &&Planned| {
            let key = run.key(&self.surroundings);
            let has_ply = || self.out.join("runs").join(run.folder(&key)).join(PLY_FILE).is_file();
            successful_run(self.log.records(), &key).is_none() || run.keeps_ply && !has_ply()
        };
        runs.iter().filter(is_open).collect()
    }

    /// The results of the planned runs, in their order. Converts times to one pace of the machine if all have a pace, unless the
    /// pace is not wanted (0 steps); also returns what the times are.
    pub fn records_of(&self, runs: &[Planned]) -> (Vec<RunRecord>, &'static str) {
        let of_run = |run: &Planned| {
            let key = run.key(&self.surroundings);
            let record = self.log.records().iter().rev().find(|r| r.key == key)?;
            Some(RunRecord { name: run.name.clone(), bits: run.bits.clone(), ..record.clone() })
        };
        let mut records: Vec<RunRecord> = runs.iter().filter_map(of_run).collect();
        let times = if self.pace_steps == 0 { "times as measured" } else { convert_to_one_pace(&mut records) };
        (records, times)
    }

    /// Trains a run and logs its result. Prints the result as JSON if that was asked for; warns if the run failed.
    /// Errors: the program is missing or was interrupted, or results cannot be written. A failed run is a result.
    pub fn run(&mut self, planned: &Planned, print: &mut dyn FnMut(&Value)) -> InputResult<()> {
        let key = planned.key(&self.surroundings);
        if self.pace_after_last_run.is_none() {
            // The first training also brings the photos into memory.
            self.measure_pace()?;
            self.pace_after_last_run = self.measure_pace()?;
        }
        let before = self.pace_after_last_run.take();
        let mut record = match &planned.city {
            Some(city) => self.train_city(planned, city, &key)?,
            None => self.train(planned, &key)?,
        };
        let after = self.measure_pace();
        // An interrupted pace does not take the run with it.
        record.pace = before.zip(after.as_ref().ok().cloned().flatten()).map(|(before, after)| mean(&before, &after));
        self.log.append(record.clone())?;
        self.pace_after_last_run = after?;
        if let Some(problem) = &record.problem {
            gsscale::tell!("warning: the run failed: {problem}");
        }
        if self.json {
            print(&serde_json::to_value(&record).unwrap_or_default());
        }
        Ok(())
    }

    /// The pace of a short training of the reference; `None` if it is not wanted. A training that fails is the last one.
    fn measure_pace(&mut self) -> InputResult<Option<Pace>> {
        if self.pace_steps == 0 {
            return Ok(None);
        }
        let config = TrainConfig { steps: self.pace_steps, ..self.base.clone() };
        let (name, environment, bits) = (String::from("pace"), BTreeMap::new(), String::new());
        let planned = Planned { name, config, scene: None, environment, bits, city: None, keeps_ply: false };
        let key = planned.key(&self.surroundings);
        let record = self.train(&planned, &key)?;
        remove(&self.out.join("runs").join(planned.folder(&key)))?;
        if let Some(problem) = record.problem {
            gsscale::tell!(
                "warning: the pace of the machine is not measured, because {} steps of the reference failed: {problem}",
                self.pace_steps
            );
            self.pace_steps = 0;
            return Ok(None);
        }
        Ok(Some(Pace { key, seconds: record.seconds - record.stall_seconds, cpu_seconds: record.cpu_seconds }))
    }

    fn train(&self, planned: &Planned, key: &str) -> InputResult<RunRecord> {
        let name = planned.folder(key);
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
        let scene = planned.scene.as_ref().map_or(&self.scene, |scene| &scene.folder);
        let arguments = [scene, Path::new("--out"), &part, Path::new("--config"), &file];
        let output = start("gsscale-train", &arguments, &planned.environment, &self.lock)?;
        record.wall_seconds = began.elapsed().as_secs_f64();
        if !output.status.success() {
            // Before the folders are removed: an interrupted run keeps its checkpoint.
            record.problem = Some(problem(&output)?);
        } else {
            self.read_figures(&mut record, &config, &part)?;
            if record.problem.is_none() && !planned.keeps_ply {
                remove(&part.join(PLY_FILE))?;
            }
        }
        remove(&spill)?;
        remove(&file)?;
        self.finish(&name, &part, &record)?;
        Ok(record)
    }

    /// The record of a run without its figures.
    fn record(&self, planned: &Planned, key: &str) -> RunRecord {
        RunRecord {
            key: key.to_string(),
            scene: self.scene.display().to_string(),
            name: planned.name.clone(),
            settings: changes(&self.base, &planned.config),
            seed: planned.config.seed,
            steps: planned.config.steps,
            version: env!("CARGO_PKG_VERSION").to_string(),
            threads: rayon::current_num_threads() as u64,
            cpu: cpu_model(),
            wrong_views: planned.scene.as_ref().map_or(Vec::new(), |scene| scene.wrong.clone()),
            ..RunRecord::default()
        }
    }

    /// Gives the folder of a run its final name, or removes it if the run failed.
    fn finish(&self, name: &str, part: &Path, record: &RunRecord) -> InputResult<()> {
        let folder = self.out.join("runs").join(name);
        remove(&folder)?;
        match record.problem {
            Some(_) => remove(part),
            None => std::fs::rename(part, &folder).map_err(|e| InputError::io(&folder, "naming the run", &e)),
        }
    }

    /// Reads the figures from the run's folder.
    fn read_figures(&self, record: &mut RunRecord, config: &TrainConfig, folder: &Path) -> InputResult<()> {
        let summary: Summary = read_json(&folder.join(SUMMARY_FILE), AGAIN)?;
        record.ply = digest(&folder.join(PLY_FILE))?;
        (record.psnr, record.ssim) = (summary.test.map(|t| t.psnr), summary.test.map(|t| t.ssim));
        record.predicted_psnr = summary.test.and_then(|t| t.predicted).map(|p| p.predicted_psnr);
        record.cc_psnr = summary.test.and_then(|t| t.color_corrected).map(|c| c.cc_psnr);
        record.outlier_views = views::names_in(&read_json(&folder.join(SUMMARY_FILE), AGAIN)?);
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
        record.view_order = TrainConfig::read(&folder.join(CONFIG_FILE))?.view_order.word().into_owned();
        let photos = |c: &TrainConfig| (c.data_factor, c.max_resolution);
        if photos(config) != photos(&self.base) {
            // Smaller photos raise PSNR, so every run is evaluated on the photos of the reference.
            self.evaluate(record, folder)?;
        }
        Ok(())
    }

    /// Evaluates the PLY in a folder on the photos of the sweep's base. Returns the report; null of an evaluation that failed.
    fn evaluate(&self, record: &mut RunRecord, folder: &Path) -> InputResult<Value> {
        let [ply, file, json] = [PLY_FILE, EVALUATED_AS_FILE, EVALUATED_FILE].map(|name| folder.join(name));
        write_config(&file, &self.base)?;
        let arguments = [&ply, self.scene.as_path(), Path::new("--config"), &file, Path::new("--json"), &json];
        let output = start("gsscale-eval", &arguments, &BTreeMap::new(), &self.lock)?;
        if !output.status.success() {
            record.problem = Some(problem(&output)?);
            return Ok(Value::Null);
        }
        let report: Value = read_json(&json, AGAIN)?;
        let test = &report["test"];
        (record.psnr, record.ssim) = (test["psnr"].as_f64(), test["ssim"].as_f64());
        record.cc_psnr = test["color_corrected"]["cc_psnr"].as_f64();
        record.predicted_psnr = test["predicted"]["predicted_psnr"].as_f64();
        Ok(report)
    }

    /// Trains a scene in cells and compares its borders with those of the reference, if that has its PLY.
    fn train_city(&self, planned: &Planned, city: &PlannedCity, key: &str) -> InputResult<RunRecord> {
        let (name, runs) = (planned.folder(key), self.out.join("runs"));
        let at = |end: &str| runs.join(format!("{name}{end}"));
        let (part, folder, file) = (at(".part"), at(".city.part"), at(".part.toml"));
        let mut record = self.record(planned, key);
        let keys =
            toml::to_string(&city.keys).map_err(|e| InputError::new(&file, e.to_string(), "report this as a bug"))?;
        write_whole(&file, keys.as_bytes())?;
        let began = Instant::now();
        let cells = |arguments: &[OsString]| start("gsscale-cells", arguments, &planned.environment, &self.lock);
        let place = CityPlace { scene: &self.scene, config: &file, city: &folder, merged: &part };
        record.problem = city.cut.train(&place, &machine_flags(&city.keys), &cells)?;
        record.wall_seconds = began.elapsed().as_secs_f64();
        if record.problem.is_none() {
            record.ply = digest(&part.join(PLY_FILE))?;
            let report = self.evaluate(&mut record, &part)?;
            record.gaussians = report["gaussians"].as_u64().unwrap_or_default();
            let prior: Summary = read_json(&City(folder.clone()).prior_run().join(SUMMARY_FILE), AGAIN)?;
            let done: Vec<Done> = status(&folder)?.1.into_iter().filter_map(|cell| cell.done.ok().flatten()).collect();
            record.seconds = prior.train_seconds + done.iter().map(|cell| cell.seconds).sum::<f64>();
            record.trained_gaussians = Some(done.iter().map(|cell| cell.gaussians).sum());
        }
        let reference = runs.join(city.reference.folder(&city.reference.key(&self.surroundings)));
        if record.problem.is_none() && reference.join(PLY_FILE).is_file() {
            match (borders(&folder, &reference, &cells)?, borders(&folder, &part, &cells)?) {
                (Ok(reference), Ok(own)) => {
                    let lost = |a: Option<f64>, b: Option<f64>| Some(a? - b?);
                    record.border_loss = lost(reference.crossing_psnr, own.crossing_psnr);
                    record.band_loss = lost(reference.band_psnr, own.band_psnr);
                }
                (Err(problem), _) | (_, Err(problem)) => record.problem = Some(problem),
            }
        }
        remove(&part.join(PLY_FILE))?;
        remove(&folder)?;
        remove(&file)?;
        self.finish(&name, &part, &record)?;
        Ok(record)
    }
}

/// The mean of two paces of one training.
fn mean(a: &Pace, b: &Pace) -> Pace {
    let cpu_seconds = a.cpu_seconds.zip(b.cpu_seconds).map(|(a, b)| (a + b) / 2.0);
    Pace { key: a.key.clone(), seconds: (a.seconds + b.seconds) / 2.0, cpu_seconds }
}

/// Keys of `config` that differ from `base`, except the seed.
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

/// The absolute path with links resolved, as far as the path exists: creating the folder does not change the result.
fn resolved(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let of = |up: &Path| Some(std::fs::canonicalize(up).ok()?.join(path.strip_prefix(up).ok()?));
    path.ancestors().find_map(of).unwrap_or_else(|| path.clone())
}

fn lock(out: &Path) -> InputResult<File> {
    let path = out.join(LOCK);
    open_locked(&path).map_err(|e| InputError::io(&path, "opening the lock", &e))?.ok_or_else(|| {
        let problem = "in use by another sweep, or by a run that a killed sweep left behind";
        InputError::new(out, problem, "wait for its end, or choose another --out")
    })
}

/// Digest of the views of a scene, of the lengths of their photos, and of its points. Times of files do not count: a copy is the same.
fn content_of(scene: &Path, base: &TrainConfig) -> InputResult<String> {
    let options = ReadOptions { allow_missing: true, points_later: true, ..read_options(base) };
    let (raw, mut hash) = (read_scene(scene, &options)?, Xxh3::new());
    for view in &raw.views {
        let bytes = std::fs::metadata(&view.image_path).map_or(0, |about| about.len());
        let facts = format!("{}\n{bytes} {:?} {:?} {:?}\n", view.name, view.intrinsics, view.pose, view.split);
        hash.update(facts.as_bytes());
    }
    hash.update(bytemuck::cast_slice(&raw.points.positions));
    hash.update(raw.points.colors.as_flattened());
    let points = raw.points_path.map_or(Ok(String::new()), |path| digest(&path))?;
    Ok(format!("{:016x}{points}", hash.digest()))
}

fn digest(path: &Path) -> InputResult<String> {
    let io = |e: std::io::Error| InputError::io(path, "reading", &e);
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

/// Removes a file or folder, if it exists. Errors: it cannot be removed.
pub fn remove(path: &Path) -> InputResult<()> {
    let removed = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    match removed {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(InputError::io(path, "removing", &e)),
        _ => Ok(()),
    }
}

/// Removes the leftovers of interrupted runs from a folder: names with one of these endings.
fn remove_parts(folder: &Path, ends: &[&str]) -> InputResult<()> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Ok(()) };
    let is_part = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.contains("-seed") && ends.iter().any(|end| name.ends_with(end))
    };
    entries.flatten().map(|e| e.path()).filter(is_part).try_for_each(|path| remove(&path))
}
