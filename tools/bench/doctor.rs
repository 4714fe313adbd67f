//! `gsscale-bench doctor`: whether a GPU computes what the CPU computes, and how fast, in some minutes.
//!
//! Every check stands for itself: one that fails says what is wrong in plain words, and the others go on. The verdict names the flags to
//! use.
//!
//! Not here: the comparison with the CPU (`render/device_check`, `train/inputs/page_check`), and timings against the floor of each stage
//! (`cargo bench --bench gpu`).
//!
//! Invariant: the doctor writes into its own folder only, and its scenes are generated.

use clap::Parser;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::machine::cpu_model;
use gsscale::base::whole_file::write_whole;
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::config::values::{Choice, Chosen};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::dataset::target_cache::TargetCache;
use gsscale::densify::strategy::StrategyName;
use gsscale::gpu::{AdapterSummary, DeviceChoice, DeviceKind, Gpu, GpuOptions};
use gsscale::optim::method::OptimizerPlace;
use gsscale::optim::moments::Moments;
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::device_check::{self, DeviceVerdict, View, scene, view};
use gsscale::render::gpu::GpuRenderer;
use gsscale::render::{RenderOptions, Renderer};
use gsscale::report::html::{Cell, Page};
use gsscale::scene::columns::{Column, Columns};
use gsscale::train::error::TrainError;
use gsscale::train::inputs::page_check;
use gsscale::train::start::first_scene::{Prepared, prepare};
use gsscale::train::state::trainer::Trainer;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;
use tempfile::TempDir;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench doctor                        the best GPU; some three minutes
  gsscale-bench doctor --quick                the comparison with the CPU alone
  gsscale-bench doctor --device radeon --out doctor-radeon

doctor.json and doctor.html in --out hold all figures: please attach doctor.json to a report about a GPU.";

/// Checks a GPU: same pictures and gradients as the CPU, same bytes twice, rates, times of steps, a short training.
#[derive(Parser)]
#[command(name = "gsscale-bench doctor", version, after_help = EXAMPLES)]
pub struct Args {
    /// The GPU: a part of its name; default: the best one, software drivers last
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Folder of doctor.json and doctor.html
    #[arg(long, default_value = "doctor", value_name = "FOLDER")]
    out: PathBuf,
    /// Only compare with the CPU
    #[arg(long)]
    quick: bool,
    /// Most device memory of the checks, as --device-mem of gsscale-train
    #[arg(long, value_name = "SIZE", default_value = "0")]
    device_mem: gsscale::config::values::ByteSize,
}

/// Difference of the PSNR after a short training, dB: roundings grow over the steps as seeds do.
const TRAINED: f64 = 0.1;
/// Steps of the short training.
const STEPS: u32 = 200;
/// Gaussians of the timed steps; software drivers get the first.
const SIZES: [usize; 3] = [100_000, 1_000_000, 3_000_000];
/// Steps that are timed after as many that are not.
const TIMED: usize = 6;
/// Bytes of a copy.
const COPY: usize = 64 << 20;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Good,
    Failed,
}

/// What a check found.
#[derive(Debug, Serialize)]
struct Check {
    name: &'static str,
    verdict: Verdict,
    /// In plain words.
    found: String,
    figures: Value,
}

impl Check {
    fn of(name: &'static str, found: Result<(String, Value), String>) -> Check {
        let (verdict, (found, figures)) = match found {
            Ok(good) => (Verdict::Good, good),
            Err(why) => (Verdict::Failed, (why, Value::Null)),
        };
        Check { name, verdict, found, figures }
    }
}

/// Examines a GPU; fails if it computes something else than the CPU.
///
/// Errors: there is no such GPU, or the folder cannot be written.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let doctor = Doctor { args, choice: args.device.clone().map_or(DeviceChoice::Gpu, DeviceChoice::Named) };
    let gpu = doctor.open(false).map_err(|e| {
        let problem = e.lines().next().unwrap_or_default().to_string();
        InputError::new("--device", problem, "choose one of gsscale-train --list-devices")
    })?;
    let (about, subgroups) = (gpu.summary().clone(), gpu.subgroups());
    drop(gpu);
    gsscale::tell!("examining {about}");
    let mut checks = vec![
        doctor.run_check("same as the CPU", Doctor::parity),
        doctor.run_check("same bytes twice", Doctor::same_bytes),
        doctor.run_check("pages on it", Doctor::pages),
    ];
    if !args.quick {
        checks.push(doctor.run_check("rates", Doctor::rates));
        checks.push(doctor.run_check("steps", |doctor| doctor.steps(&about)));
        checks.push(doctor.run_check("short training", Doctor::training));
    }
    let advice = advice(&checks, about.kind);
    let all = json!({
        "version": env!("CARGO_PKG_VERSION"), "device": about.to_string(), "kind": format!("{:?}", about.kind),
        "subgroups": subgroups,
        "cpu": cpu_model(), "cores": std::thread::available_parallelism().map_or(0, usize::from), "checks": checks,
        "advice": advice,
    });
    write(&args.out, &about, &checks, &advice, &all)?;
    print(&all);
    gsscale::tell!("{advice}\n{} has all figures", args.out.join("doctor.html").display());
    let failed: Vec<&str> = checks.iter().filter(|c| c.verdict == Verdict::Failed).map(|c| c.name).collect();
    match failed.is_empty() {
        true => Ok(()),
        false => Err(InputError::new("doctor", format!("failed: {}", failed.join(", ")), advice).into()),
    }
}

/// Which flags to use, by what was found.
fn advice(checks: &[Check], kind: DeviceKind) -> String {
    let failed = |name: &str| checks.iter().any(|c| c.name == name && c.verdict == Verdict::Failed);
    // Errors of a device are texts here.
    let says = |words: &str| checks.iter().any(|c| c.verdict == Verdict::Failed && c.found.contains(words));
    if says("the device was lost") {
        return "the GPU was lost during the checks (reset by its driver, without power, or unplugged), so they say nothing of what it \
                computes: give the command again; an update of the driver may help"
            .into();
    }
    if says("device memory") || says("out of memory") {
        return "the checks did not fit into the memory of the GPU: close other programs that use it, or raise --device-mem".into();
    }
    if failed("same as the CPU") || failed("same bytes twice") || failed("short training") {
        return "train with --device cpu: this GPU or its driver computes something else; an update of the driver may help".into();
    }
    if failed("pages on it") {
        return "train with --optimizer-on host, the default: the check of pages on this GPU failed, as said above"
            .into();
    }
    if kind == DeviceKind::Software {
        return "it computes what the CPU computes, but it is a driver in software: train with --device cpu, which is faster".into();
    }
    let seconds = |of: &str| {
        let steps = checks.iter().find(|c| c.name == "steps")?;
        steps.figures.as_array()?.last()?[of].as_f64()
    };
    match (seconds("cpu_seconds"), seconds("host_form_seconds"), seconds("device_form_seconds")) {
        (Some(cpu), Some(host), device) if cpu < host.min(device.unwrap_or(f64::INFINITY)) => {
            "train with --device cpu: the processor is faster than this GPU".into()
        }
        (_, Some(host), Some(device)) if device < host => {
            "train with --device gpu --optimizer-on device: pages on the device make steps faster".into()
        }
        (_, Some(_), _) => "train with --device gpu".into(),
        _ => "this GPU computes what the CPU computes: train with --device gpu".into(),
    }
}

struct Doctor<'a> {
    args: &'a Args,
    choice: DeviceChoice,
}

impl Doctor<'_> {
    /// Runs a check, and says how it ended.
    fn run_check(&self, name: &'static str, check: impl FnOnce(&Self) -> Result<(String, Value), String>) -> Check {
        let check = Check::of(name, check(self));
        gsscale::tell!("{name}: {}", check.found);
        check
    }

    fn open(&self, profile: bool) -> Result<Gpu, String> {
        let budget = Some(self.args.device_mem.0).filter(|bytes| *bytes > 0);
        let options = GpuOptions { profile, budget, ..GpuOptions::default() };
        Gpu::open_with(&self.choice, &options).map_err(|e| e.to_string())
    }

    fn renderer(&self, profile: bool) -> Result<GpuRenderer, String> {
        GpuRenderer::new(self.open(profile)?).map_err(|e| format!("its shaders cannot be used: {e}"))
    }

    /// Views of generated Gaussians, clean and with one in a hundred broken, in every SH degree, from one to several workgroups.
    fn parity(&self) -> Result<(String, Value), String> {
        match device_check::check(&mut self.renderer(false)?).map_err(|e| e.to_string())? {
            DeviceVerdict::Differs(difference) => Err(difference),
            DeviceVerdict::Agrees(views) => {
                let figures = views.iter().map(
                    |of| json!({ "view": of.view, "pixel": of.pixel, "loss": of.loss, "gradients": of.gradients }),
                );
                Ok((format!("{} views agree with the CPU", views.len()), figures.collect()))
            }
        }
    }

    /// Steps of the optimizer in pages on the device.
    fn pages(&self) -> Result<(String, Value), String> {
        for moments in [Moments::F32, Moments::Bf16] {
            if let Some(difference) =
                page_check::check(&mut self.renderer(false)?, moments).map_err(|e| e.to_string())?
            {
                return Err(format!("with --moments {}: {difference}", moments.word()));
            }
        }
        Ok(("steps of the optimizer agree with the CPU, with moments of 32 and of 16 bits".into(), Value::Null))
    }

    fn same_bytes(&self) -> Result<(String, Value), String> {
        let (columns, camera) = scene(20_000, 320, 200, false);
        let mut hashes = Vec::new();
        for _ in 0..2 {
            let mut gpu = self.renderer(false)?;
            for _ in 0..2 {
                let view = view(&mut gpu, &columns, &camera, &RenderOptions::default()).map_err(|e| e.to_string())?;
                hashes.push(xxhash_rust::xxh3::xxh3_64(bytemuck::cast_slice(&bits(&view))));
            }
        }
        hashes.dedup();
        match hashes.len() {
            1 => Ok(("four times the same bits".into(), Value::Null)),
            _ => Err(
                "the same view has other bits when it is drawn again: a stage reads what another has not written yet"
                    .into(),
            ),
        }
    }

    /// Rates of copies in GB/s: on the device, up, down, and how much of a copy up hides behind a copy on the device.
    fn rates(&self) -> Result<(String, Value), String> {
        let gpu = self.open(false)?;
        let data = vec![7u32; COPY / 4];
        let on_device = || -> gsscale::gpu::GpuResult<[f64; 4]> {
            let (from, to) = (gpu.buffer("copied", COPY as u64)?, gpu.buffer("copy", COPY as u64)?);
            let mut best = [f64::INFINITY; 4];
            for _ in 0..5 {
                for (i, best) in best.iter_mut().enumerate() {
                    let began = Instant::now();
                    let mut recorder = gpu.begin("doctor");
                    let _up = if i % 2 == 1 { Some(recorder.buffer_with("up", &data)?) } else { None };
                    if i == 0 || i == 3 {
                        (0..4).try_for_each(|_| recorder.copy(&from.view(), &to.view()))?;
                    }
                    let down = if i == 2 { Some(recorder.read_back("down", &from.view())?) } else { None };
                    let submission = gpu.submit(recorder)?;
                    match down {
                        Some(down) => drop(down.to_vec::<u32>()?),
                        None => gpu.wait(&submission)?,
                    }
                    *best = best.min(began.elapsed().as_secs_f64());
                }
            }
            Ok(best)
        };
        let [copy, up, down, both] = on_device().map_err(|e| format!("copies failed: {e}"))?;
        let rate = |seconds: f64, times: f64| times * COPY as f64 / seconds / 1e9;
        let hidden = ((copy + up - both) / copy.min(up)).clamp(0.0, 1.0);
        let (copy, up, down) = (rate(copy, 8.0), rate(up, 1.0), rate(down, 1.0));
        let found = format!(
            "{copy:.1} GB/s on the device, {up:.1} up, {down:.1} down; {:.0} % of a copy up hides behind one on the device",
            100.0 * hidden
        );
        Ok((found, json!({ "device_gb_s": copy, "up_gb_s": up, "down_gb_s": down, "hidden": hidden })))
    }

    /// Steps of growing scenes: on the CPU, with the optimizer on the host, and with it on the device.
    fn steps(&self, about: &AdapterSummary) -> Result<(String, Value), String> {
        let sizes = if about.kind == DeviceKind::Software { &SIZES[..1] } else { &SIZES[..] };
        let mut figures: Vec<Value> = Vec::new();
        let (mut found, mut small) = (String::new(), None);
        for &rows in sizes {
            match self.steps_of(rows) {
                Ok(of_size) => {
                    let ms =
                        |name: &str| of_size[name].as_f64().map_or(String::from("-"), |s| format!("{:.1}", 1e3 * s));
                    let [cpu, host, device] = ["cpu_seconds", "host_form_seconds", "device_form_seconds"].map(ms);
                    found += &format!(
                        "{rows} Gaussians: {cpu} ms on the CPU, {host} on the GPU, {device} with pages on it. "
                    );
                    if let Some(failure) = of_size["device_form_failure"].as_str() {
                        found += &format!("Pages on it: {failure}. ");
                    }
                    figures.push(of_size);
                }
                // A size that does not fit says something about the next ones, and nothing about those before.
                Err(why) => {
                    small = Some(format!("{rows} Gaussians: {why}"));
                    break;
                }
            }
        }
        match (figures.is_empty(), small) {
            (true, why) => Err(why.unwrap_or_default()),
            (false, why) => Ok((found + &why.unwrap_or_default(), Value::from(figures))),
        }
    }

    fn steps_of(&self, rows: usize) -> Result<Value, String> {
        let folder = scratch_folder()?;
        let city = CityOptions { views: 8, width: 640, height: 480, points: rows as u32, ..CityOptions::default() };
        let config = TrainConfig {
            strategy: StrategyName::None,
            sh_every: 0,
            test_every: 0,
            steps: 10_000,
            ..TrainConfig::default()
        };
        let scene = CityScene::new(folder.path(), &city, config)?;
        let cpu = scene.step_seconds(Box::new(CpuRenderer::new()), OptimizerPlace::Host)?;
        let host = scene.step_seconds(Box::new(self.renderer(false)?), OptimizerPlace::Host)?;
        let on_device = scene.step_seconds(Box::new(self.renderer(false)?), OptimizerPlace::Device);
        let (device, failure) = (on_device.as_ref().ok(), on_device.as_ref().err());
        let mut profiled = self.renderer(true)?;
        let stages = scene.stage_seconds(&mut profiled)?;
        Ok(json!({
            "gaussians": scene.columns.rows(), "cpu_seconds": cpu, "host_form_seconds": host, "device_form_seconds": device,
            "device_form_failure": failure,
            "stage_seconds": stages, "device_bytes_peak": profiled.traffic().device_bytes_peak,
        }))
    }

    fn training(&self) -> Result<(String, Value), String> {
        let folder = scratch_folder()?;
        let city = CityOptions { views: 24, width: 160, height: 112, points: 6000, ..CityOptions::default() };
        let config = TrainConfig { steps: STEPS, ..TrainConfig::default() };
        let scene = CityScene::new(folder.path(), &city, config)?;
        let cpu = scene.psnr(Box::new(CpuRenderer::new()))?;
        let gpu = scene.psnr(Box::new(self.renderer(false)?))?;
        let figures = json!({ "steps": STEPS, "cpu_psnr": cpu, "gpu_psnr": gpu });
        match (cpu - gpu).abs() <= TRAINED {
            true => Ok((format!("{gpu:.2} dB after {STEPS} steps, {cpu:.2} on the CPU"), figures)),
            false => Err(format!("{gpu:.2} dB after {STEPS} steps, but {cpu:.2} on the CPU")),
        }
    }
}

/// A generated city in a folder, and what is done with it.
struct CityScene {
    prepared: Prepared,
    columns: Columns,
    config: TrainConfig,
}

impl CityScene {
    fn new(folder: &Path, city: &CityOptions, config: TrainConfig) -> Result<CityScene, String> {
        let city = CityOptions { supersample: 1, overwrite: true, ..city.clone() };
        write_city(folder, &city, &|_, _| {}).map_err(|e| e.to_string())?;
        let prepared = prepare(folder, &config).map_err(|e| e.to_string())?;
        Ok(CityScene { columns: prepared.columns.clone(), prepared, config })
    }

    fn trainer(&self, renderer: Box<dyn Renderer>, optimizer_on: OptimizerPlace) -> Result<Trainer, String> {
        let config = TrainConfig { optimizer_on: Chosen(Some(optimizer_on)), ..self.config.clone() };
        let dataset = &self.prepared.dataset;
        let options = RunOptions {
            sh_degree_start: self.prepared.sh_degree_start,
            ..RunOptions::new(&config, dataset.scene_scale)
        };
        Trainer::new(self.columns.clone(), dataset, renderer, options).map_err(|e| e.to_string())
    }

    /// Median seconds of a step.
    fn step_seconds(&self, renderer: Box<dyn Renderer>, optimizer_on: OptimizerPlace) -> Result<f64, String> {
        let mut trainer = self.trainer(renderer, optimizer_on)?;
        let dataset = &self.prepared.dataset;
        let targets = TargetCache::new(&dataset.views, u64::MAX, 1).map_err(|e| e.to_string())?;
        let mut seconds = Vec::new();
        for _ in 0..2 * TIMED {
            let began = Instant::now();
            trainer.step(dataset, &targets).map_err(|e| e.to_string())?;
            seconds.push(began.elapsed().as_secs_f64());
        }
        let timed = &mut seconds[TIMED..];
        timed.sort_unstable_by(f64::total_cmp);
        Ok(timed[TIMED / 2])
    }

    /// Seconds of each stage of a view, by the clock of the device; empty without timestamps.
    fn stage_seconds(&self, renderer: &mut GpuRenderer) -> Result<Value, String> {
        let camera = &self.prepared.dataset.views[0].camera;
        for _ in 0..TIMED {
            view(renderer, &self.columns, camera, &RenderOptions::default()).map_err(|e| e.to_string())?;
        }
        let times = renderer.gpu().stage_times().map_err(|e| e.to_string())?;
        Ok(times.iter().map(|t| (t.stage.to_string(), Value::from(t.seconds / TIMED as f64))).collect())
    }

    /// PSNR on the held-out photos after the steps of the config, dB.
    fn psnr(&self, renderer: Box<dyn Renderer>) -> Result<f64, String> {
        let mut trainer = self.trainer(renderer, OptimizerPlace::Host)?;
        let dataset = &self.prepared.dataset;
        let targets = TargetCache::new(&dataset.views, u64::MAX, 1).map_err(|e| e.to_string())?;
        while trainer.steps_done() < self.config.steps {
            trainer.step(dataset, &targets).map_err(|e| e.to_string())?;
        }
        let test = trainer.evaluate(dataset, &targets, None, &|_| {}).map_err(|e| e.to_string())?;
        test.map(|test| test.psnr).ok_or_else(|| "no photo is held out".to_string())
    }
}

fn bits(view: &View) -> Vec<u32> {
    let columns = Column::ALL.into_iter().flat_map(|c| view.grads.columns.column(c));
    let floats = view.image.rgb.iter().chain(columns).chain(view.grads.means2d.as_flattened());
    let loss = view.loss.loss.to_bits();
    floats.map(|x| x.to_bits()).chain([loss as u32, (loss >> 32) as u32]).collect()
}

/// For a scene; removed when dropped.
fn scratch_folder() -> Result<TempDir, String> {
    let nowhere = |e| format!("no folder can be made in {} ({e}): set TMPDIR to one", std::env::temp_dir().display());
    TempDir::with_prefix("gsscale-doctor-").map_err(nowhere)
}

/// Writes doctor.json and doctor.html.
fn write(out: &Path, about: &AdapterSummary, checks: &[Check], advice: &str, all: &Value) -> InputResult<()> {
    std::fs::create_dir_all(out).map_err(|e| InputError::io(out, "making the folder", &e))?;
    let text = serde_json::to_string_pretty(all).unwrap_or_default();
    write_whole(&out.join("doctor.json"), text.as_bytes())?;
    let mut page = Page::new(&format!("Doctor: {}", about.name), &about.to_string());
    page.paragraph(advice);
    let word = |check: &Check| match check.verdict {
        Verdict::Good => "good",
        Verdict::Failed => "FAILED",
    };
    let found = |c: &Check| vec![Cell::text(c.name), Cell::text(word(c)), Cell::text(c.found.clone())];
    page.table(["check", "", "found"], checks.iter().map(found));
    if let Some(sizes) = checks.iter().find(|c| c.name == "steps").and_then(|c| c.figures.as_array()) {
        page.heading("Time of a step");
        let ms = |seconds: &Value| Cell::number(seconds.as_f64().map(|s| 1e3 * s), 1);
        let times = ["cpu_seconds", "host_form_seconds", "device_form_seconds"];
        let row = |size: &Value| {
            let rows = Cell::number(size["gaussians"].as_f64(), 0);
            std::iter::once(rows).chain(times.iter().map(|name| ms(&size[*name]))).collect()
        };
        page.table(["Gaussians", "CPU, ms", "GPU, ms", "pages on the GPU, ms"], sizes.iter().map(row));
        if let Some(stages) = sizes.last().and_then(|s| s["stage_seconds"].as_object()).filter(|s| !s.is_empty()) {
            page.heading("Stages of a view, the largest size");
            let row = |(stage, seconds): (&String, &Value)| vec![Cell::text(stage.clone()), ms(seconds)];
            page.table(["stage", "ms"], stages.iter().map(row));
        }
    }
    page.folded("doctor.json", &text);
    write_whole(&out.join("doctor.html"), page.finish().as_bytes())
}
