//! The same training in memory and through the drive, with frames for shares of the pages.
//!
//! `cargo bench --bench tiers -- SCENE --spill-dir DIR` trains all contenders in one process, in turns of a few steps,
//! so that other load on the machine slows all alike. All contenders train on the same views, step by step. Prints one
//! line of JSON for each contender.

#[path = "support/demand.rs"]
mod demand;
pub mod support;

use clap::Parser;
use demand::{Demand, page_bytes};
use gsscale::base::error::InputError;
use gsscale::base::machine::host_bytes_peak;
use gsscale::base::machine::process_cpu_split;
use gsscale::config::file::parse_arguments;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::RunOptions;
use gsscale::config::values::ByteSize;
use gsscale::config::values::Chosen;
use gsscale::dataset::loader::Dataset;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::page::folder::measure::DriveRate;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::simulation::replay::{DriveModel, ReplayOptions, automatic_order, replay};
use gsscale::paging::stats::PagerStats;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::camera::Camera;
use gsscale::schedule::order::ViewOrder;
use gsscale::schedule::visibility::ViewPages;
use gsscale::train::error::TrainError;
use gsscale::train::start::first_scene::{Prepared, prepare};
use gsscale::train::start::tiers::{self, Tiers};
use gsscale::train::state::trainer::Trainer;
use serde_json::{Value, json};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;
use support::median;
use support::training::{config_with_drive, decode_all, extend, in_turns, run_with_arguments};

const EXAMPLES: &str = "\
Examples:
  cargo bench --bench tiers -- scans/city --spill-dir /mnt/nvme/bench --steps 600 --strategy none --view-order groups:25
  cargo bench --bench tiers -- scans/city --spill-dir /mnt/nvme/bench --steps 600 --shares 10,5 --page-rows 256

share_misses: share of the needed pages that were not in memory when a step asked for them. share_absent: the part of
these whose read had not started. share_absent_least: the least share_absent of any prefetcher, above 0 when the pages
of two consecutive steps exceed the frames.

Memory must hold the scene once for the run in memory and once for the sum of the shares. With --view-order auto, all
contenders use the order that is chosen for the smallest share.";

/// Memory limit for choosing the order of views, bytes.
const ORDER_BYTES: u64 = 256 << 20;

/// Trains a scene in memory and with frames for shares of its pages, in turns, and prints a line of JSON for each.
#[derive(Parser)]
#[command(name = "tiers", bin_name = "cargo bench --bench tiers --", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), one with transforms.json, or Mega-NeRF's layout
    scene: PathBuf,
    /// Frames, in percent of the pages at the start
    #[arg(long, value_delimiter = ',', default_value = "50,25,10", value_name = "P")]
    shares: Vec<f64>,
    /// Steps of a turn
    #[arg(long, default_value_t = 25, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    turn: u32,
    /// Steps before the measurement, while the frames fill [default: one epoch, at most half of the steps]
    #[arg(long, value_name = "N")]
    warm_up: Option<u32>,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// One of the compared trainings.
struct Contender {
    share: Option<f64>,
    trainer: Trainer,
    /// Dropped after the trainer, whose pages are in this folder.
    tiers: Tiers,
    before: PagerStats,
    demand: Demand,
    seconds: Vec<f64>,
    /// User time and system time.
    cpu_seconds: [f64; 2],
    rows: u64,
    rows_pinned: u64,
    last_loss: f64,
}

fn main() -> ExitCode {
    run_with_arguments("tiers", |arguments, print| start(&parse_arguments(arguments), print))
}

/// Runs the benchmark.
///
/// # Errors
/// The input is invalid, or a step fails.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let mut config = config_with_drive(&args.keys)?;
    if let Some(share) = args.shares.iter().find(|s| !(**s > 0.0 && **s <= 100.0)) {
        let problem = format!("{share} is no share");
        return Err(InputError::new("--shares", problem, "write for example 50,25,10").into());
    }
    let prepared = prepare(&args.scene, &config)?;
    let targets = TargetCache::new(&prepared.dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    let dataset = &prepared.dataset;
    let mut contenders = vec![contender(&prepared, &config, None, usize::MAX)?];
    let pages = contenders[0].trainer.scene.pager.index().len();
    let frames = |share: f64| (share / 100.0 * pages as f64).ceil() as usize;
    settle_order(&mut config, dataset, &mut contenders[0].trainer, args.shares.iter().copied().map(frames))?;
    let most = views(dataset, &contenders[0].trainer).most();
    for &share in &args.shares {
        if frames(share) < most {
            print(&json!({ "share_percent": share, "frames": frames(share), "pages_of_largest_view": most }));
            continue;
        }
        contenders.push(contender(&prepared, &config, Some(share), frames(share))?);
    }
    let warm_up = args.warm_up.unwrap_or(dataset.train_views().len() as u32).min(config.steps / 2);
    decode_all(dataset, &targets, &config)?;
    // If this fails, the line has no prediction; the measurements are complete.
    let rate = DriveRate::measure(Path::new(&config.spill_dir)).ok();
    in_turns(&mut contenders, 0..warm_up, args.turn, |c| c.step(dataset, &targets, false))?;
    contenders.iter_mut().for_each(Contender::begin);
    in_turns(&mut contenders, warm_up..config.steps, args.turn, |c| c.step(dataset, &targets, true))?;
    let facts = json!({
        "scene": args.scene, "page_rows": config.page_rows, "pages": pages, "gaussians": contenders[0].trainer.scene.rows(),
        "view_order": contenders[0].trainer.view_order().order().to_string(), "steps": config.steps - warm_up,
        "pages_of_view": views(dataset, &contenders[0].trainer).total() as f64 / dataset.train_views().len() as f64,
        "pages_of_largest_view": most, "threads": rayon::current_num_threads(), "host_bytes_peak": host_bytes_peak(),
        "version": env!("CARGO_PKG_VERSION"),
    });
    let predicted = rate.map(|rate| Prediction::new(&config, (dataset, warm_up), &contenders[0], rate));
    let lines: Vec<Value> = contenders.iter().map(|c| c.line(&contenders[0], predicted.as_ref(), &facts)).collect();
    lines.iter().for_each(print);
    Ok(())
}

fn cameras(dataset: &Dataset) -> Vec<Camera> {
    dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect()
}

fn views(dataset: &Dataset, trainer: &Trainer) -> ViewPages {
    ViewPages::new(trainer.scene.pager.index(), &cameras(dataset))
}

/// One order for all contenders, so that all train on the same views. An automatic order is that of the fewest frames.
fn settle_order(
    config: &mut TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    frames: impl Iterator<Item = usize>,
) -> Result<(), TrainError> {
    if config.view_order.0.is_some() {
        return Ok(());
    }
    let (views, pages) = (views(dataset, trainer), trainer.scene.pager.index().len());
    let frames = frames.min().unwrap_or(pages).max(views.most());
    let order = automatic_order(&views, &cameras(dataset), pages, frames, config.seed, ORDER_BYTES)
        .map_err(|e| InputError::new("--shares", e.to_string(), "give larger shares"))?;
    config.view_order = Chosen(Some(order));
    trainer.set_view_order(order, dataset);
    Ok(())
}

/// A contender in memory, or with this many frames and its own folder in the spill directory.
fn contender(
    prepared: &Prepared,
    config: &TrainConfig,
    share: Option<f64>,
    frames: usize,
) -> Result<Contender, TrainError> {
    let folder = share.map(|s| Path::new(&config.spill_dir).join(format!("share-{s}")));
    if let Some(above) = folder.as_deref().and_then(Path::parent) {
        std::fs::create_dir_all(above).map_err(|e| InputError::io(above, "making the folder", &e))?;
    }
    let spill_dir = folder.map_or_else(String::new, |f| f.display().to_string());
    let frames_key = if share.is_some() { u32::try_from(frames).unwrap_or(u32::MAX) } else { 0 };
    // --shares sets the memory.
    let own = TrainConfig { spill_dir, frames: frames_key, host_mem: ByteSize(0), ..config.clone() };
    let scale = prepared.dataset.scene_scale;
    let options = RunOptions { sh_degree_start: prepared.sh_degree_start, ..RunOptions::new(&own, scale) };
    let (pager, tiers) = tiers::open(&own, prepared.columns.rows().div_ceil(options.page_rows), u64::MAX, false)?;
    let columns = prepared.columns.clone();
    let trainer = Trainer::with_pager(columns, pager, &prepared.dataset, Box::new(CpuRenderer::new()), options)?;
    Ok(Contender {
        share,
        before: trainer.scene.pager.stats(),
        demand: Demand::default(),
        trainer,
        tiers,
        seconds: Vec::new(),
        cpu_seconds: [0.0; 2],
        rows: 0,
        rows_pinned: 0,
        last_loss: 0.0,
    })
}

impl Contender {
    fn begin(&mut self) {
        self.before = self.trainer.scene.pager.stats();
        self.demand = Demand::begin(&self.trainer.scene.pager);
    }

    fn step(&mut self, dataset: &Dataset, targets: &TargetCache, measures: bool) -> Result<(), TrainError> {
        if measures && self.share.is_some() {
            let view = self.trainer.next_view();
            self.demand.steps.push(self.trainer.scene.pager.pages_of_view(&dataset.views[view].camera));
        }
        let (began, cpu) = (Instant::now(), process_cpu_split());
        let outcome = self.trainer.step(dataset, targets)?;
        if measures {
            self.seconds.push(began.elapsed().as_secs_f64());
            if let (Some(after), Some(before)) = (process_cpu_split(), cpu) {
                (0..2).for_each(|i| self.cpu_seconds[i] += after[i] - before[i]);
            }
            self.rows += outcome.rows as u64;
            self.rows_pinned += outcome.rows_pinned as u64;
        }
        self.last_loss = outcome.loss.loss;
        Ok(())
    }

    /// The line of JSON: the measurements, the ratios to the run in memory, and the common facts.
    fn line(&self, in_memory: &Contender, predicted: Option<&Prediction>, facts: &Value) -> Value {
        let steps = self.seconds.len().max(1) as f64;
        let sum = |of: &Contender| of.seconds.iter().sum::<f64>();
        let cpu = |of: &Contender| of.cpu_seconds[0] + of.cpu_seconds[1];
        let pager = &self.trainer.scene.pager;
        let (now, before) = (pager.stats(), self.before);
        let frames_max = pager.frames_max();
        let needed = (now.pages_needed - before.pages_needed).max(1) as f64;
        let pages_read = now.pages_read - before.pages_read;
        let bytes_read = now.bytes_read - before.bytes_read;
        let ratios = self.seconds.iter().zip(&in_memory.seconds).map(|(own, base)| own / base);
        let mut line = json!({
            "share_percent": self.share, "frames": self.share.map(|_| frames_max), "engine": self.tiers.engine,
            "seconds_per_step_median": median(self.seconds.iter().copied()),
            "seconds_per_step": sum(self) / steps, "cpu_seconds_per_step": cpu(self) / steps,
            "cpu_system_seconds_per_step": self.cpu_seconds[1] / steps,
            "ratio_of_medians": median(self.seconds.iter().copied()) / median(in_memory.seconds.iter().copied()),
            "median_of_ratios": median(ratios),
            "ratio_of_sums": sum(self) / sum(in_memory),
            "cpu_ratio": cpu(self) / cpu(in_memory),
            "overfetch": self.rows_pinned as f64 / self.rows.max(1) as f64,
            "rows_per_step": self.rows as f64 / steps,
            "same_last_loss": self.last_loss.to_bits() == in_memory.last_loss.to_bits(),
        });
        if self.share.is_some() {
            let bytes = page_bytes(pager.index());
            let bound = self.demand.fewest_reads(frames_max, &bytes);
            let in_time = self.demand.fewest_reads_in_time(frames_max, &bytes);
            let tier = json!({
                "pages_read_per_step": pages_read as f64 / steps, "bytes_read_per_step": bytes_read as f64 / steps,
                "bytes_written_per_step": (now.bytes_written - before.bytes_written) as f64 / steps,
                "belady_pages_per_step": bound.map(|(pages, _)| pages as f64 / steps),
                "belady_bytes_per_step": bound.map(|(_, bytes)| bytes as f64 / steps),
                "pages_over_belady": bound.map(|(pages, _)| pages_read as f64 / pages.max(1) as f64),
                "bytes_over_belady": bound.map(|(_, bytes)| bytes_read as f64 / bytes.max(1) as f64),
                "belady_in_time_over_belady": bound.zip(in_time).map(|((_, a), (_, b))| b as f64 / a.max(1) as f64),
                "share_misses": (now.misses - before.misses) as f64 / needed,
                "share_absent": (now.absent - before.absent) as f64 / needed,
                "share_absent_least": self.demand.fewest_absent(frames_max) as f64 / needed,
                "share_late_misses": (now.late_misses - before.late_misses) as f64 / needed,
                "stall_seconds": now.stall_seconds - before.stall_seconds,
                "stall_seconds_predicted": predicted.and_then(|p| p.stall_seconds(frames_max)),
            });
            extend(&mut line, &tier);
        }
        extend(&mut line, facts);
        line
    }
}

/// The prediction of `gsscale-plan`'s model for the same steps.
struct Prediction {
    views: ViewPages,
    page_bytes: Vec<u32>,
    order: ViewOrder,
    steps: Range<u32>,
    policy: EvictPolicy,
    drive: DriveModel,
}

impl Prediction {
    /// The model for a drive with this rate, and for steps as long as those in memory.
    fn new(
        config: &TrainConfig,
        (dataset, warm_up): (&Dataset, u32),
        in_memory: &Contender,
        rate: DriveRate,
    ) -> Prediction {
        let trainer = &in_memory.trainer;
        let step_seconds = in_memory.seconds.iter().sum::<f64>() / in_memory.seconds.len().max(1) as f64;
        Prediction {
            views: views(dataset, trainer),
            page_bytes: page_bytes(trainer.scene.pager.index()).into_iter().map(|bytes| bytes as u32).collect(),
            order: trainer.view_order().clone(),
            steps: warm_up..config.steps,
            policy: config.evict,
            drive: DriveModel { read_rate: rate.read, write_rate: rate.write, step_seconds },
        }
    }

    /// Seconds that the measured steps wait for the drive, with this many frames.
    fn stall_seconds(&self, frames: usize) -> Option<f64> {
        let (policy, steps) = (self.policy, self.steps.end);
        let options = ReplayOptions { frames, policy, reads_ahead: true, steps, plan_bytes: ORDER_BYTES };
        let run = replay(&self.views, &self.page_bytes, &self.order, &options).ok()?;
        Some(run.stall(self.steps.start as usize..self.steps.end as usize, &self.drive).seconds)
    }
}
