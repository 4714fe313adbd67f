//! `gsscale-plan`: predicts what a run would read and write through the disk tier, and how long it would take. Parses,
//! calls the library, prints; leaves no file.

#[path = "plan/device.rs"]
mod device;
#[path = "plan/output.rs"]
mod output;

use clap::Parser;
use device::{DeviceModel, DeviceRow};
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::machine::host_bytes_peak;
use gsscale::base::say::exit_code;
use gsscale::base::text::read_text;
use gsscale::base::units::format_bytes;
use gsscale::config::command_line::parse_arguments;
use gsscale::config::file::{FILE_BYTES_MAX, TrainConfig, TrainOverrides};
use gsscale::config::new_run;
use gsscale::config::values::{ByteSize, Chosen};
use gsscale::gpu::EmulatedBus;
use gsscale::optim::method::Method;
use gsscale::optim::moments::Moments;
use gsscale::page::folder::measure::DriveRate;
use gsscale::page::format::slot_header::transfer_bytes;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::plan::cache_model::{CacheModel, StepChange, TooFewFrames};
use gsscale::paging::plan::steps::Plan;
use gsscale::paging::simulation::replay::{DriveModel, Figures, Replay, ReplayOptions, Stall, automatic_order, replay};
use gsscale::report::run_files::CONFIG_FILE;
use gsscale::scene::camera::Camera;
use gsscale::scene::page_layout::{PageLayout, capacity_bytes};
use gsscale::scene::page_meta::PageMeta;
use gsscale::schedule::order::{Order, ViewOrder};
use gsscale::schedule::visibility::ViewPages;
use gsscale::train::error::TrainError;
use gsscale::train::inputs::machine::set_up;
use gsscale::train::preflight::first_look::{LookFor, first_look};
use gsscale::train::preflight::forecast::{Forecast, STEP_GROWTH};
use gsscale::train::run::begin::forecast;
use gsscale::train::step::device_slots::slots_in;
use output::{json_of, json_of_forecast, report};
use serde_json::json;
use std::ffi::OsString;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-plan scans/village --compare-frames 10%,25%,50% --compare-orders shuffle,groups:9,groups:25,tour
  gsscale-plan scans/city --host-mem 4GiB --steps 200000 --spill-dir /nvme/pages
  gsscale-plan scans/city --host-mem 4GiB --drive-read 3GB --step-seconds 0.05   # another machine's drive and GPU
  gsscale-plan runs/city --host-mem 2GiB --lists 100..110
  gsscale-plan scans/city --device-mem 8GiB --bus 12GB/s,20us --step-seconds 0.03   # pages on a GPU, its time without copies

Pages are those of the first Gaussians; --growth 5 plans as if each page had grown five times as large.
'hit rate' is the fraction of a step's pages that are already in memory, for a cache that evicts as --evict says; 'of lru' the
same for least-recently-used eviction. Waiting assumes that the drive does one transfer at a time, and that every step takes
--step-seconds.
The first lines are those of the dry run: memory, drive and time with the Gaussians that the run will reach. The table compares
orders and frames with the Gaussians of the start, without import, evaluation, commits and decoding of photos.";

/// Epochs to simulate; later ones count as the mean of those after the first.
const EPOCHS: u32 = 4;

/// Numbers of frames to compare by default, percent of the pages.
const SHARES: [usize; 4] = [10, 25, 50, 100];
/// Assumed step time of a scene in which nothing can be timed, seconds.
const STEP_ASSUMED: f64 = 0.3;

/// Predicts what a run would read and write through the disk tier and how long it would take, for any memory, page size
/// and view order.
#[derive(Parser)]
#[command(name = "gsscale-plan", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder, or a folder with transforms.json; or a run's output folder (its config.toml is used)
    scene: PathBuf,
    /// Config file; flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    /// Numbers of frames to compare, or percentages of all pages; default: --frames or --host-mem if given, otherwise
    /// 10%,25%,50%,100%, but at least as many as the largest view needs
    #[arg(long, value_delimiter = ',', value_name = "N|N%", help_heading = "Plan")]
    compare_frames: Vec<String>,
    /// View orders to compare: auto, shuffle, groups:N, tour; default: --view-order if given, otherwise auto and
    /// shuffle
    #[arg(long, value_delimiter = ',', value_name = "ORDER", help_heading = "Plan")]
    compare_orders: Vec<Chosen<Order>>,
    /// Plan as if every page had grown by this factor
    #[arg(long, default_value_t = 1.0, value_name = "X", help_heading = "Plan")]
    growth: f64,
    /// List the pages read and evicted in these steps, for the first order and number of frames
    #[arg(long, value_parser = parse_range, value_name = "A..B", help_heading = "Plan")]
    lists: Option<Range<u32>>,
    /// Read rate of the drive, bytes per second; default: measured on the drive of --spill-dir, or 3GB without one
    #[arg(long, value_name = "SIZE", help_heading = "Drive")]
    drive_read: Option<ByteSize>,
    /// Write rate of the drive, bytes per second; default: measured likewise, or 2GB
    #[arg(long, value_name = "SIZE", help_heading = "Drive")]
    drive_write: Option<ByteSize>,
    /// Seconds per step without waiting for pages; default: timed in a few steps on the run's device
    #[arg(long, value_name = "S", help_heading = "Drive")]
    step_seconds: Option<f64>,
    /// Rate and latency of the bus to the GPU, such as 12GB/s,20us: also plans for --optimizer-on device, whose pages lie in --device-mem
    /// (0: all of them), with --step-seconds as the GPU's own time
    #[arg(long, value_name = "RATE,LATENCY", value_parser = parse_bus, help_heading = "Device")]
    bus: Option<EmulatedBus>,
    /// Bytes that the drive is rated to write in its lifetime
    #[arg(long, default_value = "300TB", value_name = "SIZE", help_heading = "Drive")]
    endurance: ByteSize,
    /// Memory for the planning itself; with less the plan looks less far ahead
    #[arg(long, default_value = "1GiB", value_name = "SIZE", help_heading = "Plan")]
    plan_mem: ByteSize,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    keys: TrainOverrides,
}

fn parse_range(text: &str) -> Result<Range<u32>, String> {
    let wrong = || format!("'{text}' is not a range of steps; write for example 100..110");
    let (from, to) = text.split_once("..").ok_or_else(wrong)?;
    let range = from.parse().map_err(|_| wrong())?..to.parse().map_err(|_| wrong())?;
    if range.is_empty() { Err(wrong()) } else { Ok(range) }
}

fn parse_bus(text: &str) -> Result<EmulatedBus, String> {
    EmulatedBus::parse(text)
        .ok_or_else(|| format!("'{text}' is not a rate and a latency; write for example 12GB/s,20us"))
}

/// Data shared by all plans of this program.
struct Scene {
    config: TrainConfig,
    cameras: Vec<Camera>,
    index: Vec<PageMeta>,
    /// Bytes of each page on disk, including header and padding.
    page_bytes: Vec<u32>,
    /// Bytes of each page's payload, and the largest that a payload may have.
    payload_bytes: Vec<u32>,
    payload_most: u64,
    /// Bytes of one frame.
    frame_bytes: u64,
    drive: DriveModel,
    /// The device that rendered the timed steps.
    timed_on: Option<String>,
    views: ViewPages,
    gaussians: u64,
    /// Number of frames that fit in --host-mem besides the run's other memory, if it was given.
    frames_within: Option<u64>,
    /// What the run will take, as its dry run says it, or why that is not known.
    forecast: Result<Forecast, String>,
}

/// One line of the result.
struct Row {
    order: Order,
    is_automatic: bool,
    frames: usize,
    planned: Replay,
    figures: Figures,
    lru: Figures,
    stall: Stall,
    /// Time of all steps, seconds.
    seconds: f64,
    total_read: f64,
    total_written: f64,
}

fn main() -> ExitCode {
    run_with(std::env::args_os().collect())
}

/// The program, with the words of its command line; the first is its name.
pub fn run_with(arguments: Vec<OsString>) -> ExitCode {
    gsscale::base::allocator::return_freed_blocks();
    gsscale::base::environment::quiet_wayland();
    exit_code(start(&parse_arguments(&arguments)).map(|text| gsscale::say!("{text}")))
}

fn start(args: &Args) -> InputResult<String> {
    let scene = load(args)?;
    let frames = frames(args, &scene)?;
    if let Some(range) = &args.lists {
        return lists(args, &scene, frames[0], range.clone());
    }
    let mut rows = Vec::new();
    for &frames in &frames {
        let mut compared = Vec::new();
        for asked in orders(args, &scene.config) {
            let order = order(args, &scene, frames, asked)?;
            // Where nobody named the orders, the one that auto chose needs no second row.
            if !args.compare_orders.is_empty() || !compared.contains(&order) {
                compared.push(order);
                rows.push(row(args, &scene, frames, order, asked)?);
            }
        }
    }
    let devices = args.bus.map_or(Ok(Vec::new()), |bus| device_rows(args, &scene, &rows, bus))?;
    if args.json {
        let value = json!({
            "gaussians": scene.gaussians, "views": scene.cameras.len(), "steps": scene.config.steps,
            "pages": scene.index.len(), "page_rows": scene.config.page_rows, "frame_bytes": scene.frame_bytes,
            "state_bytes": state_bytes(&scene), "host_bytes_peak": host_bytes_peak(), "pages_of_largest_view": scene.views.most(),
            "drive_read_bytes_per_second": scene.drive.read_rate, "drive_write_bytes_per_second": scene.drive.write_rate,
            "run": scene.forecast.as_ref().ok().map(json_of_forecast), "step_seconds": scene.drive.step_seconds, "step_timed_on": scene.timed_on,
            "device": devices.iter().map(DeviceRow::json).collect::<Vec<_>>(),
            "plans": rows.iter().map(|row| json_of(args, &scene, row)).collect::<Vec<_>>(),
        });
        return Ok(format!("{value:#}"));
    }
    Ok(report(args, &scene, &rows) + &device::report(&devices))
}

fn load(args: &Args) -> InputResult<Scene> {
    let run_config = args.scene.join(CONFIG_FILE);
    let is_run = run_config.is_file();
    let config_path = args.config.clone().or_else(|| is_run.then(|| run_config.clone()));
    let config = new_run::of_new_run(config_path.as_deref(), &args.keys)?;
    config.check()?;
    set_up(&config)?;
    if config.optimizer == Method::Dense {
        let problem = "dense reads and writes every page at every step, which this tool does not plan";
        return Err(InputError::new("--optimizer", problem, "plan for deferred, which gives the same result"));
    }
    for (flag, value, least) in
        [("--growth", args.growth, 1.0), ("--step-seconds", args.step_seconds.unwrap_or(0.0), 0.0)]
    {
        if !(least..=1e6).contains(&value) {
            return Err(InputError::new(flag, format!("{value} is out of range"), format!("use {least} to 1000000")));
        }
    }
    for (flag, bytes) in
        [("--drive-read", args.drive_read), ("--drive-write", args.drive_write), ("--endurance", Some(args.endurance))]
    {
        if bytes.is_some_and(|bytes| bytes.0 == 0) {
            return Err(InputError::new(flag, "0 bytes", "give a size above 0, such as 3GB"));
        }
    }
    let path = if is_run { scene_of_run(&run_config)? } else { args.scene.clone() };
    let drive_rate = drive_rates(args, &config)?;
    // If frames are given, the memory limit is not needed.
    let is_asked = args.compare_frames.is_empty() && config.frames == 0 && config.host_mem.0 > 0;
    let forecast = forecast_of(args, &path, (&config, drive_rate), is_asked)?;
    let known = forecast.as_ref().ok().filter(|_| is_asked).and_then(|forecast| forecast.tiers.frames);
    let look_for = LookFor {
        frames_within: (is_asked && known.is_none()).then_some(config.host_mem.0),
        step: args.step_seconds.is_none() && args.lists.is_none(),
    };
    let look = first_look(&path, &config, &folder_for(&config), look_for).map_err(not_planned)?;
    let cameras = look.dataset.train_cameras();
    let grown = |bytes: usize| (bytes as f64 * args.growth) as u64;
    let slot = |&bytes: &u32| grown(transfer_bytes(bytes as usize)).min(u64::from(u32::MAX)) as u32;
    let frame_bytes = transfer_bytes(capacity_bytes(config.page_rows as usize, config.sh_degree));
    // Packing shortens the payload of every page by about the same share.
    let full = PageLayout { rows: config.page_rows as usize, sh_degree: config.sh_degree };
    let on_device = full.bytes_on_device(config.moments == Moments::Bf16);
    let share = on_device as f64 / full.bytes() as f64;
    Ok(Scene {
        views: ViewPages::new(&look.index, &cameras),
        page_bytes: look.page_bytes.iter().map(slot).collect(),
        payload_bytes: look
            .page_bytes
            .iter()
            .map(|&bytes| (share * grown(bytes as usize) as f64).min(f64::from(u32::MAX)) as u32)
            .collect(),
        payload_most: grown(on_device as usize),
        frame_bytes: grown(frame_bytes),
        drive: DriveModel {
            read_rate: drive_rate.read,
            write_rate: drive_rate.write,
            step_seconds: match (args.step_seconds, &look.step) {
                (Some(named), _) => named,
                (None, Some(timed)) => timed.seconds * args.growth.powf(STEP_GROWTH),
                (None, None) => STEP_ASSUMED,
            },
        },
        timed_on: look.step.map(|step| step.device),
        gaussians: look.gaussians,
        frames_within: known.or(look.frames).map(|frames| ((frames as f64 / args.growth) as u64).max(1)),
        forecast,
        config,
        cameras,
        index: look.index,
    })
}

/// The forecast of the run with this config; with a budget and no spill directory, of one that has a spill directory. If the
/// budget is asked for, a run that it cannot hold is an error.
fn forecast_of(
    args: &Args,
    scene: &Path,
    (config, drive_rate): (&TrainConfig, DriveRate),
    is_asked: bool,
) -> InputResult<Result<Forecast, String>> {
    if !args.compare_frames.is_empty() || config.frames > 0 || args.lists.is_some() {
        return Ok(Err(String::from("frames are given")));
    }
    let mut config = config.clone();
    if is_asked && config.residence().spill_dir().is_none() {
        config.spill_dir = std::env::temp_dir().join("gsscale-pages").to_string_lossy().into_owned();
    }
    match forecast(scene, &config, drive_rate) {
        Ok(Some(forecast)) => Ok(Ok(forecast)),
        Ok(None) => Ok(Err(String::from("its first pages take more than half of --host-mem"))),
        Err(error) if is_asked => Err(not_planned(error)),
        Err(error) => Ok(Err(error.to_string())),
    }
}

/// Folder for lists that exceed memory: beside the pages, if their folder is known.
fn folder_for(config: &TrainConfig) -> PathBuf {
    let above = config.residence().spill_dir().and_then(|dir| dir.ancestors().find(|folder| folder.is_dir()));
    above.map_or_else(std::env::temp_dir, Path::to_path_buf)
}

/// Read and write rates: from the flags, measured on the drive of the spill directory, or those of a common drive.
fn drive_rates(args: &Args, config: &TrainConfig) -> InputResult<DriveRate> {
    let named = [args.drive_read, args.drive_write].map(|rate| rate.map(|rate| rate.0 as f64));
    let DriveRate { read, write } = match named {
        [Some(_), Some(_)] => DriveRate::COMMON,
        _ if config.residence().spill_dir().is_none() => DriveRate::COMMON,
        _ => DriveRate::measure(&folder_for(config))?,
    };
    Ok(DriveRate { read: named[0].unwrap_or(read), write: named[1].unwrap_or(write) })
}

fn not_planned(error: TrainError) -> InputError {
    match error {
        TrainError::Input(error) => error,
        other => InputError::new("--host-mem", other.to_string(), "plan for --frames and --step-seconds instead"),
    }
}

fn scene_of_run(config: &Path) -> InputResult<PathBuf> {
    let text = read_text(config, FILE_BYTES_MAX, "give the scene's folder instead")?;
    let scene =
        text.parse::<toml::Table>().ok().and_then(|t| t.get("resolved")?.get("scene")?.as_str().map(PathBuf::from));
    scene.ok_or_else(|| InputError::new(config, "it does not name its scene", "give the scene's folder instead"))
}

fn state_bytes(scene: &Scene) -> u64 {
    scene.page_bytes.iter().map(|&b| u64::from(b)).sum()
}

/// The numbers of frames to plan for.
fn frames(args: &Args, scene: &Scene) -> InputResult<Vec<usize>> {
    let pages = scene.index.len();
    let config = &scene.config;
    let mut frames = Vec::new();
    if args.compare_frames.is_empty() && config.frames > 0 {
        return Ok(vec![config.frames as usize]);
    }
    frames.extend(scene.frames_within.map(|frames| frames as usize));
    if args.compare_frames.is_empty() && frames.is_empty() {
        // Default numbers are raised to what the largest view needs.
        let share = |percent: usize| (percent * pages).div_ceil(100).max(scene.views.most());
        frames.extend(SHARES.map(share));
        frames.dedup();
    }
    for text in &args.compare_frames {
        let count = match text.strip_suffix('%') {
            Some(share) => share
                .parse()
                .ok()
                .filter(|s| (0.0..=100.0).contains(s))
                .map(|s: f64| (s / 100.0 * pages as f64).ceil() as usize),
            None => text.parse().ok(),
        };
        let count = count.filter(|&count: &usize| count > 0);
        let wrong = || {
            InputError::new(
                "--compare-frames",
                format!("'{text}' is not a number of frames"),
                "write for example 2000 or 25%",
            )
        };
        frames.push(count.ok_or_else(wrong)?);
    }
    Ok(frames)
}

/// The view orders to plan for.
fn orders(args: &Args, config: &TrainConfig) -> Vec<Chosen<Order>> {
    match (args.compare_orders.is_empty(), config.view_order) {
        (false, _) => args.compare_orders.clone(),
        (true, Chosen(None)) => vec![Chosen(None), Chosen(Some(Order::Shuffle))],
        (true, order) => vec![order],
    }
}

fn order(args: &Args, scene: &Scene, frames: usize, asked: Chosen<Order>) -> InputResult<Order> {
    if let Chosen(Some(order)) = asked {
        return Ok(order);
    }
    let pages = scene.index.len();
    automatic_order(&scene.views, &scene.cameras, pages, frames, scene.config.seed, args.plan_mem.0)
        .map_err(|e| too_few(scene, &e))
}

fn too_few(scene: &Scene, error: &TooFewFrames) -> InputError {
    let most = scene.views.most().max(error.needed);
    let bytes = format_bytes(most as u64 * scene.frame_bytes);
    let remedy = format!(
        "plan with --frames {most}, {bytes} of --host-mem besides the run's other memory; a run takes larger views in batches"
    );
    InputError::new("--frames", error.to_string(), remedy)
}

fn row(args: &Args, scene: &Scene, frames: usize, order: Order, asked: Chosen<Order>) -> InputResult<Row> {
    let views = ViewOrder::new(order, scene.config.seed, &scene.cameras);
    let steps = scene.config.steps.min((EPOCHS * scene.cameras.len() as u32).max(1));
    let run = |policy, reads_ahead| {
        let options = ReplayOptions { frames, policy, reads_ahead, steps, plan_bytes: args.plan_mem.0 };
        replay(&scene.views, &scene.page_bytes, &views, &options).map_err(|e| too_few(scene, &e))
    };
    let (planned, lru) = (run(scene.config.evict, false)?, run(EvictPolicy::LeastRecentlyUsed, false)?);
    let figures = planned.figures(planned.steady());
    let timed = run(scene.config.evict, true)?;
    let stall = timed.stall(timed.steady(), &scene.drive);
    let (_, written) = planned.totals();
    let rest = f64::from(scene.config.steps - steps);
    Ok(Row {
        order,
        is_automatic: asked.0.is_none(),
        frames,
        lru: lru.figures(lru.steady()),
        seconds: f64::from(scene.config.steps) * scene.drive.step_seconds
            + timed.stall(0..timed.steps.len(), &scene.drive).seconds
            + rest * stall.seconds / f64::from(figures.steps.max(1)),
        stall,
        // The import leaves pages in the frames, so that the run need not read them.
        total_read: planned.read_by_run() as f64 + rest * figures.read_per_step,
        // Every page is written once before the first step.
        total_written: state_bytes(scene) as f64 + written as f64 + rest * figures.written_per_step,
        planned,
        figures,
    })
}

/// The steps of `--optimizer-on device` under each view order of the rows.
fn device_rows(args: &Args, scene: &Scene, rows: &[Row], bus: EmulatedBus) -> InputResult<Vec<DeviceRow>> {
    let config = &scene.config;
    let pages = scene.index.len();
    let slot_bytes = scene.payload_most;
    let slots = match config.device_mem.0 {
        0 => pages,
        budget => pages.min(usize::try_from(slots_in(budget, slot_bytes)).unwrap_or(usize::MAX)),
    };
    if slots == 0 {
        let problem = format!("a page takes {}, which is more than the share for pages", format_bytes(slot_bytes));
        return Err(InputError::new("--device-mem", problem, "give more, or lower --page-rows"));
    }
    let mean = |sum: f64, count: usize| sum / count.max(1) as f64;
    let model = DeviceModel {
        bus,
        slots,
        slot_bytes,
        payload: mean(scene.payload_bytes.iter().map(|&bytes| f64::from(bytes)).sum(), pages),
        pixels: mean(scene.cameras.iter().map(|camera| camera.pixels() as f64).sum(), scene.cameras.len()),
        gpu_seconds: scene.drive.step_seconds,
    };
    let mut orders: Vec<Order> = rows.iter().map(|row| row.order).collect();
    orders.dedup();
    let steps = config.steps.min((EPOCHS * scene.cameras.len() as u32).max(1));
    let policy = EvictPolicy::FarthestNextUse;
    let of_order = |order| {
        let views = ViewOrder::new(order, config.seed, &scene.cameras);
        let run = |reads_ahead| {
            let options = ReplayOptions { frames: slots, policy, reads_ahead, steps, plan_bytes: args.plan_mem.0 };
            replay(&scene.views, &scene.payload_bytes, &views, &options).map_err(|e| too_few(scene, &e))
        };
        Ok(DeviceRow::new(order, model, [&run(true)?, &run(false)?]))
    };
    orders.into_iter().map(of_order).collect()
}

/// The pages read and evicted in some steps.
fn lists(args: &Args, scene: &Scene, frames: usize, range: Range<u32>) -> InputResult<String> {
    let order = order(args, scene, frames, orders(args, &scene.config)[0])?;
    let mut views = ViewOrder::new(order, scene.config.seed, &scene.cameras);
    let mut plan = Plan::new(0, args.plan_mem.0);
    let mut cache = CacheModel::new(frames, scene.config.evict);
    let (end, mut change) = (range.end.min(scene.config.steps), StepChange::default());
    loop {
        let step = plan.steps().start;
        while plan.steps().end < step.saturating_add(2 * scene.cameras.len() as u32).min(scene.config.steps) {
            if !plan.push(scene.views.of(views.view_at(plan.steps().end))) {
                break;
            }
        }
        if step >= range.start.min(end) {
            break;
        }
        let next_use = |page| plan.next_use(page, step + 1);
        cache.step(step, plan.pages(step), next_use, &mut change).map_err(|e| too_few(scene, &e))?;
        plan.pop();
    }
    let planned = cache.changes(&plan, range.start.min(end)..end).map_err(|e| too_few(scene, &e))?;
    let lines: Vec<String> = planned.iter().map(ToString::to_string).collect();
    Ok(lines.join("\n"))
}
