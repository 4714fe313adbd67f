//! Step time against the size of the scene, at an equal visible set.
//!
//! `cargo bench --bench sizes -- SCENE --spill-dir DIR` trains scenes of several sizes.
//!
//! The benchmark repeats the points of a scene behind its cameras, where no view sees the copies. The work of a step
//! stays the same, and the number of pages on the drive grows. All sizes train in one process with the same number of
//! frames, in turns of a few steps, on the same views step by step. The benchmark prints one line of JSON for each
//! size.

pub mod support;

use clap::Parser;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::machine::host_bytes_peak;
use gsscale::base::machine::process_cpu_seconds;
use gsscale::config::file::parse_arguments;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::{self, RunOptions};
use gsscale::dataset::import::{Budget, ImportOptions, PointSource, import_points};
use gsscale::dataset::loader::{Dataset, load_dataset};
use gsscale::dataset::read::read_scene;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::paging::stats::PagerStats;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::init::InitOptions;
use gsscale::scene::partition::first_fill;
use gsscale::train::error::TrainError;
use gsscale::train::start::tiers::{self, Tiers};
use gsscale::train::state::trainer::Trainer;
use gsscale::train::step::pages::PagedScene;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;
use support::median;
use support::training::{config_with_drive, decode_all, extend, in_turns, run_with_arguments};

const EXAMPLES: &str = "\
Examples:
  cargo bench --bench sizes -- scans/city --spill-dir /mnt/nvme/bench --steps 400 --strategy none --view-order groups:25
  cargo bench --bench sizes -- scans/city --spill-dir /mnt/nvme/bench --copies 1,20 --frames 400

With a city of a million points the sizes are 1, 4 and 20 million Gaussians, which need 19 GB of the drive.";

/// Memory of an import, bytes.
const IMPORT_BYTES: usize = 512 << 20;
/// Default frames, as a multiple of the pages of the largest view.
const VIEWS_IN_FRAMES: usize = 3;

/// Trains scenes of several sizes on the same visible Gaussians, in turns, and prints a line of JSON for each.
#[derive(Parser)]
#[command(name = "sizes", bin_name = "cargo bench --bench sizes --", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene with points: a COLMAP folder (images/, sparse/), or a folder with transforms.json
    scene: PathBuf,
    /// Sizes in copies of the scene's points; all sizes are compared with the first
    #[arg(long, value_delimiter = ',', default_value = "1,4,20", value_name = "N")]
    copies: Vec<u32>,
    /// Steps of a turn
    #[arg(long, default_value_t = 10, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    turn: u32,
    /// Steps before the measurement, while the frames fill [default: a quarter of the steps]
    #[arg(long, value_name = "N")]
    warm_up: Option<u32>,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// The points of a scene, and copies of them along a line.
struct Copies<'a> {
    dataset: &'a Dataset,
    count: u32,
    /// Offset between copies, local units.
    shift: [f32; 3],
}

impl PointSource for Copies<'_> {
    fn read(&self, take: &mut dyn FnMut([f32; 3], [u8; 3]) -> InputResult<()>) -> InputResult<()> {
        let Dataset { points, colors, .. } = self.dataset;
        (0..self.count).try_for_each(|copy| {
            let moved = |p: &[f32; 3]| std::array::from_fn(|i| p[i] + copy as f32 * self.shift[i]);
            points.iter().zip(colors).try_for_each(|(p, &color)| take(moved(p), color))
        })
    }
}

/// One of the sizes.
struct Size {
    copies: u32,
    trainer: Trainer,
    /// Dropped after the trainer, whose pages are in this folder.
    tiers: Tiers,
    before: PagerStats,
    seconds: Vec<f64>,
    cpu_seconds: f64,
    rows: u64,
}

fn main() -> ExitCode {
    run_with_arguments("sizes", |arguments, print| start(&parse_arguments(arguments), print))
}

/// Runs the benchmark.
///
/// # Errors
/// The input is invalid, or a step fails.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let config = config_with_drive(&args.keys)?;
    if args.copies.is_empty() || args.copies.contains(&0) {
        return Err(InputError::new("--copies", "each size needs at least one copy", "use for example 1,4,20").into());
    }
    let dataset =
        load_dataset(read_scene(&args.scene, &limits::read_options(&config))?, &limits::load_options(&config))?;
    if dataset.points.is_empty() || dataset.train_views().is_empty() {
        let problem = "there are no points or no views to train on";
        return Err(InputError::new(&args.scene, problem, "choose another scene").into());
    }
    let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    let frames = frames(&config, &dataset)?;
    let shift = behind_the_cameras(&dataset);
    let mut sizes = Vec::new();
    for &count in &args.copies {
        sizes.push(size(&config, &Copies { dataset: &dataset, count, shift }, frames)?);
    }
    let warm_up = args.warm_up.unwrap_or(config.steps / 4).min(config.steps / 2);
    decode_all(&dataset, &targets, &config)?;
    in_turns(&mut sizes, 0..warm_up, args.turn, |size| size.step(&dataset, &targets, false))?;
    sizes.iter_mut().for_each(|size| size.before = size.trainer.scene.pager.stats());
    in_turns(&mut sizes, warm_up..config.steps, args.turn, |size| size.step(&dataset, &targets, true))?;
    let facts = json!({
        "scene": args.scene, "page_rows": config.page_rows, "steps": config.steps - warm_up, "frames": frames,
        "threads": rayon::current_num_threads(), "version": env!("CARGO_PKG_VERSION"),
    });
    sizes.iter().map(|size| size.line(&sizes[0], &facts)).for_each(|line| print(&line));
    Ok(())
}

/// Frames for all sizes: `--frames`, or three times the pages of the largest view of the original scene.
fn frames(config: &TrainConfig, dataset: &Dataset) -> Result<usize, TrainError> {
    if config.frames > 0 {
        return Ok(config.frames as usize);
    }
    let in_memory = TrainConfig { spill_dir: String::new(), ..config.clone() };
    let one = size(&in_memory, &Copies { dataset, count: 1, shift: [0.0; 3] }, usize::MAX)?;
    let of = |view: usize| one.trainer.scene.pager.pages_of_view(&dataset.views[view].camera).len();
    Ok(VIEWS_IN_FRAMES * dataset.train_views().into_iter().map(of).max().unwrap_or(1))
}

/// The offset between copies. It points against the mean viewing direction and is longer than the scene is wide, so
/// that all copies are behind all cameras.
fn behind_the_cameras(dataset: &Dataset) -> [f32; 3] {
    let mut ahead = [0.0f64; 3];
    for view in &dataset.views {
        (0..3).for_each(|i| ahead[i] += f64::from(view.camera.viewmat[2][i]));
    }
    let norm = ahead.iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-9);
    let mut widest = 0.0f64;
    for axis in 0..3 {
        let of = dataset.points.iter().map(|p| f64::from(p[axis]));
        let (low, high) = of.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        widest = widest.max(high - low);
    }
    std::array::from_fn(|i| (-3.0 * widest * ahead[i] / norm) as f32)
}

fn size(config: &TrainConfig, points: &Copies<'_>, frames: usize) -> Result<Size, TrainError> {
    let own = match config.residence().spill_dir() {
        None => config.clone(),
        Some(above) => {
            std::fs::create_dir_all(above).map_err(|e| InputError::io(above, "making the folder", &e))?;
            let spill_dir = above.join(format!("copies-{}", points.count)).display().to_string();
            TrainConfig { spill_dir, frames: frames as u32, ..config.clone() }
        }
    };
    let dataset = points.dataset;
    let options = RunOptions::new(&own, dataset.scene_scale);
    let rows = dataset.points.len() * points.count as usize;
    let (pager, tiers) = tiers::open(&own, rows.div_ceil(options.page_rows), u64::MAX, false)?;
    let init = InitOptions { scene_scale: dataset.scene_scale, ..limits::init_options(&own) };
    let folder = std::env::temp_dir();
    let beside = Path::new(&own.spill_dir).parent().filter(|p| p.is_dir()).unwrap_or(&folder);
    let fill = first_fill(options.page_rows, options.strategy.grows());
    let import = ImportOptions { init: &init, fill, budget: Budget { folder: beside, bytes: IMPORT_BYTES } };
    let mut scene = PagedScene::empty(pager, &options);
    import_points(points, &import, &mut |page| {
        let id = page.id;
        let mut state = page.into_state();
        state.raise_sh_degree(options.sh_degree_at(0));
        scene.insert_first_page(id, &state).map_err(|e| InputError::new("the pages", e.to_string(), "check the drive"))
    })?;
    let trainer = Trainer::of_scene(scene, dataset, Box::new(CpuRenderer::new()), options);
    let before = trainer.scene.pager.stats();
    let copies = points.count;
    Ok(Size { copies, trainer, tiers, before, seconds: Vec::new(), cpu_seconds: 0.0, rows: 0 })
}

impl Size {
    fn step(&mut self, dataset: &Dataset, targets: &TargetCache, measures: bool) -> Result<(), TrainError> {
        let (began, cpu) = (Instant::now(), process_cpu_seconds());
        let outcome = self.trainer.step(dataset, targets)?;
        if measures {
            self.seconds.push(began.elapsed().as_secs_f64());
            self.cpu_seconds += process_cpu_seconds().zip(cpu).map_or(0.0, |(after, before)| after - before);
            self.rows += outcome.rows as u64;
        }
        Ok(())
    }

    fn line(&self, first: &Size, facts: &Value) -> Value {
        let steps = self.seconds.len().max(1) as f64;
        let (now, before) = (self.trainer.scene.pager.stats(), self.before);
        let mut line = json!({
            "copies": self.copies, "gaussians": self.trainer.scene.rows(),
            "pages": self.trainer.scene.pager.index().len(), "engine": self.tiers.engine,
            "seconds_per_step_median": median(self.seconds.iter().copied()),
            "ratio_of_medians": median(self.seconds.iter().copied()) / median(first.seconds.iter().copied()),
            "median_of_ratios": median(self.seconds.iter().zip(&first.seconds).map(|(own, base)| own / base)),
            "cpu_seconds_per_step": self.cpu_seconds / steps, "cpu_ratio": self.cpu_seconds / first.cpu_seconds,
            "rows_per_step": self.rows as f64 / steps, "rows_ratio": self.rows as f64 / first.rows.max(1) as f64,
            "pages_per_step": (now.pages_needed - before.pages_needed) as f64 / steps,
            "bytes_read_per_step": (now.bytes_read - before.bytes_read) as f64 / steps,
            "stall_seconds": now.stall_seconds - before.stall_seconds, "host_bytes_peak": host_bytes_peak(),
        });
        extend(&mut line, facts);
        line
    }
}
