//! `gsscale-bench commit`: what commits cost a run on a drive, and how long a store takes to open.
//!
//! Trains through the disk tier as `gsscale-train` does, with its commits, and prints one line of JSON: what training
//! waited for them, and how much slower the steps beside them were. Then opens a store whose map names many pages. What
//! it writes is removed.

use clap::Parser;
use gsscale::base::error::InputError;
use gsscale::base::ids::PageId;
use gsscale::base::machine::process_cpu_seconds;
use gsscale::checkpoint::run_state::RunIdentity;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::{RunOptions, simd_path};
use gsscale::dataset::loader::Dataset;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::engine::segment_files::segment_file_name;
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::{SlotRef, StoredAs};
use gsscale::page::map::commit::{CommitConfig, Commits, Cut, PageChange};
use gsscale::page::versions::slots::SlotLayout;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::page_layout::capacity_bytes;
use gsscale::scene::partition::first_fill;
use gsscale::train::checkpoint::{Checkpoint, Origin};
use gsscale::train::dataset_print::dataset_print;
use gsscale::train::memory::{host_budget, host_bytes_peak};
use gsscale::train::report::MetricsLog;
use gsscale::train::start::Start;
use gsscale::train::tiers;
use gsscale::train::trainer::{TrainError, Trainer};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench commit scans/city --spill-dir /mnt/nvme/bench --seconds 300 --strategy none --view-order groups:25
  gsscale-bench commit scans/city --spill-dir /mnt/nvme/bench --commit-every 5 --frames 4000

commit_overhead_percent is the time that training waited for commits, in percent of the time measured;
beside_percent is what the steps during commits took longer than the median of the others, of the same time.
The first seconds, until every frame was used, are measured as well: commits are dearest then.";

/// Trains a scene through the disk tier and prints what its commits cost, then the time to open a store of many pages.
#[derive(Parser)]
#[command(name = "gsscale-bench commit", bin_name = "gsscale-bench commit", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), one with transforms.json, or Mega-NeRF's layout
    scene: PathBuf,
    /// Config file; flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    /// Seconds to train, at most --steps
    #[arg(long, default_value_t = 240.0, value_name = "S")]
    seconds: f64,
    /// Pages of the store that is opened
    #[arg(long, default_value_t = 100_000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..10_000_000))]
    open_pages: u32,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// Steps by whether a commit was under way when they began, seconds each.
#[derive(Debug, Default)]
struct Steps {
    alone: Vec<f64>,
    beside: Vec<f64>,
}

impl Steps {
    /// Seconds that the steps beside commits took longer than the median of the others.
    fn slower(&self) -> f64 {
        let mut alone = self.alone.clone();
        alone.sort_unstable_by(f64::total_cmp);
        let median = alone.get(alone.len() / 2).copied().unwrap_or(0.0);
        (self.beside.iter().sum::<f64>() - median * self.beside.len() as f64).max(0.0)
    }
}

/// Measures.
///
/// # Errors
/// Bad input, or a step or a commit that fails.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let mut config = super::settle(args.config.as_deref(), &args.keys)?;
    super::refuse_devices(&config)?;
    if config.spill_dir.is_empty() {
        let remedy = "name a folder on the drive to measure";
        return Err(InputError::new("--spill-dir", "there is no drive to measure", remedy).into());
    }
    let above = PathBuf::from(&config.spill_dir);
    std::fs::create_dir_all(&above).map_err(|e| InputError::io(&above, "making the folder", &e))?;
    config.spill_dir = above.join("commit").display().to_string();
    print(&train(args, &config)?);
    let seconds = open_seconds(&above.join("open"), args.open_pages, &config)?;
    print(&json!({ "open_pages": args.open_pages, "open_seconds": seconds, "version": env!("CARGO_PKG_VERSION") }));
    Ok(())
}

fn train(args: &Args, config: &TrainConfig) -> Result<Value, TrainError> {
    let host_mem = host_budget(config);
    let start = Start::read(&args.scene, config, host_mem)?;
    let options =
        RunOptions { sh_degree_start: start.sh_degree_start, ..RunOptions::new(config, start.dataset.scene_scale) };
    let origin = Origin {
        config: toml::to_string(config).map_err(|e| InputError::new("--config", e.to_string(), "report this"))?,
        simd: simd_path(config).name().to_string(),
        sh_degree_start: start.sh_degree_start,
        dataset: dataset_print(&start)?,
        run: RunIdentity::default(),
    };
    let fill = first_fill(options.page_rows, options.densify.is_some());
    let pages = start.rows.div_ceil(fill as u64) as usize;
    // Dropped after the trainer, whose pages lie there.
    let (pager, mut tiers) = tiers::open(config, pages, host_mem.unwrap_or(u64::MAX), false)?;
    // Whatever was committed is of no use afterwards: the folder goes.
    tiers.is_done = true;
    let (dataset, scene) = start.into_pages(pager, &options, config, host_mem)?;
    let mut trainer = Trainer::of_scene(scene, &dataset, Box::new(CpuRenderer::new()), options);
    let frames = match (config.frames, host_mem) {
        (0, Some(bytes)) => (bytes / 2 / trainer.scene.pager.frame_bytes() as u64) as usize,
        (0, None) => usize::MAX - 1,
        (frames, _) => frames as usize,
    };
    trainer.scene.pager.allow_frames(frames);
    let Some(checkpoint) = &mut tiers.checkpoint else {
        return Err(InputError::new("--spill-dir", "nothing is committed there", "report this as a bug").into());
    };
    checkpoint.set_origin(origin);
    let metrics_file = Path::new(&config.spill_dir).with_extension("jsonl");
    let mut metrics = MetricsLog::create(&metrics_file)?;
    let measured = take_steps(args.seconds, config, (&dataset, &mut trainer), checkpoint, &mut metrics);
    let _ = std::fs::remove_file(&metrics_file);
    let (seconds, cpu_seconds, steps) = measured?;
    let (report, stats, slower) = (checkpoint.report(), trainer.scene.pager.stats(), steps.slower());
    Ok(json!({
        "scene": args.scene, "gaussians": trainer.scene.rows(), "pages": trainer.scene.pager.index().len(),
        "frames": trainer.scene.pager.frames(), "page_rows": config.page_rows, "steps": trainer.steps_done(),
        "view_order": trainer.view_order().order().to_string(), "commit_every": config.commit_every.to_string(),
        "seconds": seconds, "cpu_seconds": cpu_seconds, "stall_seconds": stats.stall_seconds,
        "bytes_written": stats.bytes_written, "bytes_read": stats.bytes_read,
        "commits": report.commits, "commit_bytes": report.commit_bytes, "commit_seconds": report.commit_seconds,
        "commit_overhead_percent": 100.0 * report.commit_seconds / seconds.max(1e-9),
        "steps_beside_commits": steps.beside.len(), "beside_percent": 100.0 * slower / seconds.max(1e-9),
        "commit_interval": report.commit_interval, "commit_loss_seconds": report.commit_loss_seconds,
        "engine": tiers.engine, "codec": tiers.codec, "host_bytes_peak": host_bytes_peak(),
        "threads": rayon::current_num_threads(), "version": env!("CARGO_PKG_VERSION"),
    }))
}

/// Steps with their commits; wall seconds, CPU seconds and the steps.
fn take_steps(
    seconds: f64,
    config: &TrainConfig,
    (dataset, trainer): (&Dataset, &mut Trainer),
    checkpoint: &mut Checkpoint,
    metrics: &mut MetricsLog,
) -> Result<(f64, Option<f64>, Steps), TrainError> {
    let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    let mut steps = Steps::default();
    let (began, cpu) = (Instant::now(), process_cpu_seconds());
    while trainer.steps_done() < config.steps && began.elapsed().as_secs_f64() < seconds {
        let is_beside = trainer.scene.pager.is_frozen();
        let of_step = Instant::now();
        trainer.step(dataset, &targets)?;
        let of_step = of_step.elapsed().as_secs_f64();
        if is_beside {
            steps.beside.push(of_step)
        } else {
            steps.alone.push(of_step)
        }
        checkpoint.between_steps(trainer, metrics)?;
    }
    let cpu = process_cpu_seconds().zip(cpu).map(|(after, before)| after - before);
    Ok((began.elapsed().as_secs_f64(), cpu, steps))
}

/// Seconds to open a store whose map names `pages` pages; their segments are files of holes, and none is read.
fn open_seconds(folder: &Path, pages: u32, config: &TrainConfig) -> Result<f64, TrainError> {
    std::fs::create_dir(folder).map_err(|e| InputError::io(folder, "making the folder", &e))?;
    let measured = fill_and_open(folder, pages, config);
    std::fs::remove_dir_all(folder).map_err(|e| InputError::io(folder, "removing", &e))?;
    measured
}

fn fill_and_open(at: &Path, pages: u32, config: &TrainConfig) -> Result<f64, TrainError> {
    let of_commits = CommitConfig { store: 0xbe, cache_bytes: 8 << 20, reserve_bytes: 0 };
    let layout = SlotLayout::new(capacity_bytes(config.page_rows as usize, config.sh_degree), u64::from(pages));
    let opened = Commits::create(Box::new(DriveFolder::new(at)), of_commits)?;
    let mut store = opened.paged_store(Box::new(MemoryEngine::new()), layout, Codec::Raw)?;
    let change = |page: u32| {
        let (place, checksum) = (layout.place(u64::from(page)), u128::from(page) << 64);
        let codec = StoredAs::Raw;
        let slot = SlotRef { place, stored_bytes: 9, payload_bytes: 9, generation: 1, checksum, codec };
        // A label is as long as bounds and counts of a page are.
        PageChange { page: PageId::initial(page), version: Some((slot, vec![7; 64])) }
    };
    let changes: Vec<PageChange> = (0..pages).map(change).collect();
    let mut commits = opened.commits;
    let cut = Cut { changes: &changes, run_state: &[1; 4096], note: b"", pin: None };
    commits.commit(&mut store, &mut Vec::new(), &cut)?;
    drop((commits, store));
    for segment in 0..=layout.place(u64::from(pages - 1)).segment {
        let file = at.join(segment_file_name(segment));
        let made = std::fs::File::create(&file).and_then(|file| file.set_len(layout.segment_bytes()));
        made.map_err(|e| InputError::io(&file, "making a segment", &e))?;
    }
    let began = Instant::now();
    let opened = Commits::open(Box::new(DriveFolder::new(at)), of_commits)?;
    opened.paged_store(open_engine(IoEngine::Pread, at, 8)?.store, layout, Codec::Raw)?;
    Ok(began.elapsed().as_secs_f64())
}
