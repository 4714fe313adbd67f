//! `gsscale-bench run`: trains a scene for some steps and prints time, memory and quality as a line of JSON. Writes no
//! file.

use clap::Parser;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::machine::{cpu_model, host_bytes_peak, process_cpu_seconds};
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::{RunOptions, simd_path};
use gsscale::config::values::Device;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::gpu::DeviceChoice;
use gsscale::render::cpu::CpuRenderer;
use gsscale::train::error::TrainError;
use gsscale::train::start::first_scene::prepare;
use gsscale::train::state::trainer::Trainer;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench scans/village --steps 500 --strategy none
  gsscale-bench scans/village --steps 2000 --max-gaussians 200000 --threads 1 >> runs.jsonl

gsscale-bench help lists the other measurements.

cpu_seconds_per_step counts all threads during the steps, including the decoding of photos and without loading and
evaluation. host_bytes_peak excludes the copy that writing a PLY needs.";

/// Trains a scene and prints one line of JSON: steps, seconds, CPU seconds, peak memory, PSNR, SSIM, machine.
#[derive(Parser)]
#[command(name = "gsscale-bench run", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), one with transforms.json, or Mega-NeRF's layout
    scene: PathBuf,
    /// Config file; flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    /// Skip the evaluation on held-out photos
    #[arg(long)]
    no_eval: bool,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// Rejects the flags of devices and drives: this measurement runs on the CPU with all pages in memory.
fn check_flags(config: &TrainConfig) -> InputResult<()> {
    let given = [
        ("--device", !matches!(config.device, Device::Cpu | Device::Gpu(DeviceChoice::Auto))),
        ("--spill-dir", config.residence().spill_dir().is_some()),
        ("--frames", config.frames > 0),
        ("--host-mem", config.host_mem.0 > 0),
    ];
    match given.into_iter().find(|(_, is_given)| *is_given) {
        None => Ok(()),
        Some((flag, _)) => {
            let problem = "this measurement runs on the CPU with all pages in memory";
            Err(InputError::new(flag, problem, "remove the flag, or use gsscale-bench sweep"))
        }
    }
}

/// Runs the measurement. Errors: the errors of a run.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let config = super::settle(args.config.as_deref(), &args.keys)?;
    check_flags(&config)?;
    let began = Instant::now();
    let prepared = prepare(&args.scene, &config)?;
    let dataset = prepared.dataset;
    let load_seconds = began.elapsed().as_secs_f64();
    let gaussians_at_start = prepared.columns.rows();
    let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    let options =
        RunOptions { sh_degree_start: prepared.sh_degree_start, ..RunOptions::new(&config, dataset.scene_scale) };
    let mut trainer = Trainer::new(prepared.columns, &dataset, Box::new(CpuRenderer::new()), options)?;
    let (began, cpu_before) = (Instant::now(), process_cpu_seconds());
    let mut loss = 0.0;
    while trainer.steps_done() < config.steps {
        loss = trainer.step(&dataset, &targets)?.loss.loss;
    }
    let seconds = began.elapsed().as_secs_f64();
    let cpu_seconds = process_cpu_seconds().zip(cpu_before).map(|(after, before)| after - before);
    let test = if args.no_eval { None } else { trainer.evaluate(&dataset, &targets, None, &|_| {})? };
    print(&json!({
        "scene": args.scene,
        "steps": config.steps,
        "gaussians_at_start": gaussians_at_start,
        "gaussians": trainer.scene.rows(),
        "load_seconds": load_seconds,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "cpu_seconds_per_step": cpu_seconds.map(|s| s / f64::from(config.steps)),
        "host_bytes_peak": host_bytes_peak(),
        "psnr": test.map(|t| t.psnr),
        "ssim": test.map(|t| t.ssim),
        "ssim_variant": config.ssim_variant,
        "last_loss": loss,
        "last_loss_bits": format!("{:016x}", loss.to_bits()),
        "version": env!("CARGO_PKG_VERSION"),
        "renderer": trainer.renderer.name(),
        "simd": simd_path(&config).name(),
        "threads": rayon::current_num_threads(),
        "cpu": cpu_model(),
        "cores": std::thread::available_parallelism().map_or(0, usize::from),
    }));
    Ok(())
}
