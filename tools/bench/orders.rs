//! `gsscale-bench orders`: what orders of views cost in quality and save in bytes.
//!
//! Every order trains in memory, for every seed; what it would read with fewer frames follows from playing its steps
//! through (`paging::simulation::replay`) with the pages of the end. Prints one line of JSON for each run; with `--out` writes a
//! page with a table and a chart.

use super::demand::page_bytes;
use clap::Parser;
use gsscale::base::error::InputError;
use gsscale::base::machine::process_cpu_seconds;
use gsscale::base::units::format_bytes;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::RunOptions;
use gsscale::dataset::loader::Dataset;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::simulation::replay::{ReplayOptions, replay};
use gsscale::render::cpu::CpuRenderer;
use gsscale::report::chart::{Chart, Mark};
use gsscale::report::html::{Cell, Page};
use gsscale::scene::camera::Camera;
use gsscale::schedule::order::{Order, ViewOrder};
use gsscale::schedule::visibility::ViewPages;
use gsscale::train::report::write_whole;
use gsscale::train::run::{Prepared, prepare};
use gsscale::train::trainer::{TrainError, Trainer};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench orders scans/village --steps 3000 --strategy none --page-rows 128 --out orders.html
  gsscale-bench orders scans/village --steps 3000 --compare-orders shuffle,groups:9 --seeds 1,2,3 --share 10";

/// Epochs that are played through for the bytes.
const EPOCHS: u32 = 4;
/// Memory that playing them may take, bytes.
const PLAN_BYTES: u64 = 256 << 20;

/// Trains with each order of views and prints its PSNR and what it would read with frames for a share of the pages.
#[derive(Parser)]
#[command(name = "gsscale-bench orders", bin_name = "gsscale-bench orders", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), one with transforms.json, or Mega-NeRF's layout
    scene: PathBuf,
    /// Config file; flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    /// Orders: shuffle, groups:N, tour
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "shuffle,groups:4,groups:9,groups:25,tour",
        value_name = "ORDER"
    )]
    compare_orders: Vec<String>,
    /// Seeds
    #[arg(long, value_delimiter = ',', default_value = "1", value_name = "N")]
    seeds: Vec<u64>,
    /// Frames for the bytes, in percent of the pages
    #[arg(long, default_value_t = 25.0, value_name = "P")]
    share: f64,
    /// Page to write: table and chart
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// One run.
struct Run {
    order: Order,
    seed: u64,
    psnr: f64,
    ssim: f64,
    /// Bytes read by a step after the first epoch, with the share of frames; `None` where the largest view needs more.
    read_per_step: Option<f64>,
    /// Of needed pages, those that had to be read.
    share_read: Option<f64>,
    pages: usize,
    largest_view: usize,
    gaussians: u64,
    seconds: f64,
    cpu_seconds: Option<f64>,
}

/// Measures.
///
/// # Errors
/// Bad input, or a step that fails.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let config = super::settle(args.config.as_deref(), &args.keys)?;
    super::refuse_tiers(&config)?;
    let parse = |text: &String| text.parse().map_err(|p: String| InputError::new("--compare-orders", p, "see --help"));
    let orders: Vec<Order> = args.compare_orders.iter().map(parse).collect::<Result<_, _>>()?;
    if !(args.share > 0.0 && args.share <= 100.0) {
        return Err(InputError::new("--share", "it must be above 0 and at most 100", "use --share 25").into());
    }
    let mut runs = Vec::new();
    for &seed in &args.seeds {
        let config = TrainConfig { seed, ..config.clone() };
        let prepared = prepare(&args.scene, &config)?;
        for &order in &orders {
            let run = train(&prepared, &config, order, args.share / 100.0)?;
            print(&run.line(args, &config));
            runs.push(run);
        }
    }
    if let Some(out) = &args.out {
        write_whole(out, page(args, &config, &orders, &runs).as_bytes())?;
    }
    Ok(())
}

fn train(prepared: &Prepared, config: &TrainConfig, order: Order, share: f64) -> Result<Run, TrainError> {
    let dataset = &prepared.dataset;
    let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    let options = RunOptions {
        view_order: order,
        sh_degree_start: prepared.sh_degree_start,
        ..RunOptions::new(config, dataset.scene_scale)
    };
    let mut trainer = Trainer::new(prepared.columns.clone(), dataset, Box::new(CpuRenderer::new()), options)?;
    let (began, cpu) = (Instant::now(), process_cpu_seconds());
    while trainer.steps_done() < config.steps {
        trainer.step(dataset, &targets)?;
    }
    let (seconds, cpu_seconds) = (began.elapsed().as_secs_f64(), process_cpu_seconds().zip(cpu).map(|(a, b)| a - b));
    let test = trainer.evaluate(dataset, &targets, None)?.ok_or_else(|| {
        InputError::new("--test-every", "no photo is held out, so there is no PSNR", "hold out every 8th")
    })?;
    let (read, pages, largest_view) = reads(&trainer, dataset, config, order, share);
    Ok(Run {
        order,
        seed: config.seed,
        psnr: test.psnr,
        ssim: test.ssim,
        read_per_step: read.map(|r| r.0),
        share_read: read.map(|r| r.1),
        pages,
        largest_view,
        gaussians: trainer.scene.rows(),
        seconds,
        cpu_seconds,
    })
}

/// Bytes read by a step and share of the needed pages that are read; all pages, and those of the largest view.
fn reads(
    trainer: &Trainer,
    dataset: &Dataset,
    config: &TrainConfig,
    order: Order,
    share: f64,
) -> (Option<(f64, f64)>, usize, usize) {
    let cameras: Vec<Camera> = dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect();
    let index = trainer.scene.pager.index();
    let views = ViewPages::new(index, &cameras);
    let bytes: Vec<u32> = page_bytes(index).iter().map(|&b| b as u32).collect();
    let options = ReplayOptions {
        frames: (share * index.len() as f64).ceil() as usize,
        policy: EvictPolicy::FarthestNextUse,
        reads_ahead: false,
        steps: EPOCHS * cameras.len() as u32,
        plan_bytes: PLAN_BYTES,
    };
    let played = replay(&views, &bytes, &ViewOrder::new(order, config.seed, &cameras), &options);
    let figures = played.ok().map(|p| p.figures(p.steady()));
    (figures.map(|f| (f.read_per_step, 1.0 - f.hit_rate)), index.len(), views.most())
}

impl Run {
    fn line(&self, args: &Args, config: &TrainConfig) -> Value {
        json!({
            "scene": args.scene, "steps": config.steps, "view_order": self.order.to_string(), "seed": self.seed,
            "psnr": self.psnr, "ssim": self.ssim, "share_percent": args.share, "bytes_read_per_step": self.read_per_step,
            "share_of_pages_read": self.share_read, "pages": self.pages, "page_rows": config.page_rows,
            "pages_of_largest_view": self.largest_view, "gaussians": self.gaussians, "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds, "threads": rayon::current_num_threads(), "version": env!("CARGO_PKG_VERSION"),
        })
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0), |(sum, count), v| (sum + v, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

fn page(args: &Args, config: &TrainConfig, orders: &[Order], runs: &[Run]) -> String {
    let facts = format!(
        "{}, {} steps, {} seeds, pages of {} rows, frames for {} % of the pages",
        args.scene.display(),
        config.steps,
        args.seeds.len(),
        config.page_rows,
        args.share
    );
    let mut page = Page::new("Orders of views", &facts);
    let mut chart = Chart::new("Quality against reads", "MB read per step", "test PSNR, dB");
    let mut rows = Vec::new();
    for &order in orders {
        let of: Vec<&Run> = runs.iter().filter(|r| r.order == order).collect();
        let bytes = mean(of.iter().filter_map(|r| r.read_per_step));
        let psnr = |r: &&Run| r.psnr;
        let range = of.iter().map(psnr).fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], p| [l.min(p), h.max(p)]);
        rows.push(vec![
            Cell::Text(order.to_string()),
            Cell::Number(mean(of.iter().map(psnr)).map_or(String::new(), |p| format!("{p:.3}"))),
            Cell::Number(format!("{:.3} to {:.3}", range[0], range[1])),
            Cell::Number(mean(of.iter().map(|r| r.ssim)).map_or(String::new(), |s| format!("{s:.4}"))),
            Cell::Number(bytes.map_or(String::from("too few frames"), |b| format_bytes(b as u64))),
            Cell::Number(mean(of.iter().filter_map(|r| r.share_read)).map_or(String::new(), |s| format!("{s:.3}"))),
        ]);
        let points = of.iter().filter_map(|r| Some((r.read_per_step? / 1e6, r.psnr))).collect();
        chart = chart.with(&order.to_string(), points, Mark::Dots);
    }
    page.charts(&[(chart.svg(), String::from("One dot a run. Reads after the first epoch, by the optimal cache."))]);
    page.heading("By order");
    page.table(&["order", "PSNR, dB", "of all seeds", "SSIM", "read per step", "share of pages read"], &rows);
    page.finish()
}
