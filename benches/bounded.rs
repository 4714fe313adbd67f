//! `gsscale-train` imports and trains a city far larger than memory, under a hard limit of `--host-mem` plus a tenth.
//!
//! `cargo bench --bench bounded -- --dir DIR` generates a small city and repeats it side by side (`gsscale-synth
//! --tile`), which needs little memory. The benchmark prints one line of JSON. It writes only to one new folder, and
//! removes the folder at the end.

#[path = "support/memory_group.rs"]
mod memory_group;
pub mod support;

use clap::Parser;
use gsscale::base::error::{InputError, InputResult};
use gsscale::config::file::TrainConfig;
use gsscale::config::values::ByteSize;
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::page::folder::file_system::free_bytes;
use gsscale::page::format::slot_header::transfer_bytes;
use gsscale::scene::page_layout::capacity_bytes;
use gsscale::train::error::TrainError;
use memory_group::MemoryGroup;
use serde_json::{Value, json};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, ExitStatus, Stdio};
use std::time::Instant;
use support::training::run_with_arguments;

const EXAMPLES: &str = "\
Examples:
  cargo bench --bench bounded -- --dir /mnt/nvme/bounded                      20 million Gaussians in 2 GiB, 200 steps
  cargo bench --bench bounded -- --dir /mnt/nvme/bounded --gaussians max      as many as leave a fifth of the free drive free
  cargo bench --bench bounded -- --dir /mnt/nvme/bounded --gaussians 5000000 --host-mem 512MiB
  cargo bench --bench bounded -- --dir /mnt/nvme/bounded --overviews 2        two photos show 40 % of the city each

The limit is a memory control group of Linux, which a user such as root may create. Without a group, the line gives the
reason, and only the peak that the run measured itself is known. 20 million Gaussians need some 17 GB of the drive.";

/// Bytes per Gaussian on the drive beside the pages: the point in the scene, and the data that the import sorts.
const SCENE_BYTES: u64 = 51 + 120;
/// Share of the free drive that `--gaussians max` uses.
const DRIVE_SHARE: f64 = 0.8;

/// Trains a city far larger than memory under a hard limit, and prints time and memory as a line of JSON.
#[derive(Parser)]
#[command(name = "bounded", bin_name = "cargo bench --bench bounded --", version, after_help = EXAMPLES)]
pub struct Args {
    /// New folder on the drive; the benchmark removes it at the end
    #[arg(long, value_name = "DIR")]
    dir: PathBuf,
    /// Gaussians, rounded down to whole copies of the city; max uses four fifths of the free drive
    #[arg(long, default_value = "20000000", value_name = "N|max")]
    gaussians: String,
    /// Gaussians of one copy of the city
    #[arg(long, default_value_t = 1_000_000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    city: u32,
    /// Photos
    #[arg(long, default_value_t = 300, value_name = "N")]
    views: u32,
    /// Further photos from high above, each of two fifths of the city
    #[arg(long, default_value_t = 0, value_name = "N")]
    overviews: u32,
    /// Memory of the run
    #[arg(long, default_value = "2GiB", value_name = "SIZE")]
    host_mem: ByteSize,
    /// Steps
    #[arg(long, default_value_t = 200, value_name = "N")]
    steps: u32,
    /// Gaussians per page
    #[arg(long, default_value_t = 1024, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    page_rows: u32,
}

fn main() -> ExitCode {
    run_with_arguments("bounded", |arguments, print| start(&Args::parse_from(arguments), print))
}

/// Runs the benchmark.
///
/// # Errors
/// The folder cannot be created, or `gsscale-train` cannot be started. A failed run is a result.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    if args.dir.symlink_metadata().is_ok() {
        return Err(InputError::new(&args.dir, "already exists", "use a new folder").into());
    }
    std::fs::create_dir_all(&args.dir).map_err(|e| InputError::io(&args.dir, "making the folder", &e))?;
    let scratch = Scratch(args.dir.clone());
    let tiles = tiles(args)?;
    let began = Instant::now();
    let options = CityOptions {
        views: args.views,
        overviews: args.overviews,
        points: args.city,
        width: 320,
        height: 208,
        supersample: 1,
        tiles,
        ..CityOptions::default()
    };
    let city = write_city(&args.dir.join("scene"), &options, &|_, _| {})?;
    let city_seconds = began.elapsed().as_secs_f64();
    let run = train(args)?;
    let summary = read_summary(&args.dir.join("out/summary.json"));
    let steps = steps(&args.dir.join("out/metrics.jsonl"));
    drop(scratch);
    let of = |key: &str| summary.get(key).cloned().unwrap_or(Value::Null);
    let peak = summary["host_bytes_peak"].as_u64();
    let share = summary["pages_pinned_max"].as_f64().zip(summary["pages"].as_f64()).map(|(most, all)| most / all);
    print(&json!({
        "gaussians": city.points, "pages": of("pages"), "state_bytes": state_bytes(args, city.points),
        "largest_view_share_of_pages": share, "steps": of("steps"), "host_mem": args.host_mem.0,
        "limit_bytes": limit(args), "limited_by": run.limited_by, "no_limit_because": run.no_limit_because,
        "finished": of("finished"), "exit_code": run.status.code(), "killed_by_signal": killed_by(&run.status),
        "host_bytes_peak": peak, "group_bytes_peak": run.group_peak,
        "is_bounded": run.status.success() && peak.is_some_and(|peak| peak <= limit(args)),
        "train_seconds": of("train_seconds"), "stall_seconds": of("stall_seconds"), "frames": of("frames"),
        "bytes_read": of("bytes_read"), "bytes_written": of("bytes_written"), "psnr": summary["test"]["psnr"],
        "widest_step": steps.first(), "median_step": steps.get(steps.len() / 2),
        "run_seconds": run.seconds, "city_seconds": city_seconds, "said": run.last_words,
        "version": env!("CARGO_PKG_VERSION"),
    }));
    Ok(())
}

/// The limit: a tenth above `--host-mem`.
fn limit(args: &Args) -> u64 {
    args.host_mem.0 + args.host_mem.0 / 10
}

fn state_bytes(args: &Args, gaussians: u64) -> u64 {
    let degree = TrainConfig::default().sh_degree;
    let page = transfer_bytes(capacity_bytes(args.page_rows as usize, degree)) as u64;
    gaussians.div_ceil(u64::from(args.page_rows)) * page
}

/// Copies of the city along each side, as square as possible.
fn tiles(args: &Args) -> InputResult<[u32; 2]> {
    let wanted = match args.gaussians.as_str() {
        "max" => {
            let io = |e: std::io::Error| InputError::io(&args.dir, "asking for the free space", &e);
            let unknown = || InputError::new(&args.dir, "the system does not report free space", "give --gaussians");
            let free = free_bytes(&args.dir).map_err(io)?.ok_or_else(unknown)?;
            let each = state_bytes(args, 1_000_000) as f64 / 1e6 + SCENE_BYTES as f64;
            (free as f64 * DRIVE_SHARE / each) as u64
        }
        text => text.parse().map_err(|_| {
            InputError::new("--gaussians", format!("unknown number '{text}'"), "use a number such as 20000000, or max")
        })?,
    };
    let copies = (wanted / u64::from(args.city)).min(10_000) as u32;
    if copies == 0 {
        let problem = format!("{wanted} Gaussians are fewer than one copy of the city ({})", args.city);
        return Err(InputError::new("--gaussians", problem, "use more Gaussians, or a smaller --city"));
    }
    // Nearly the wanted number in a nearly square shape: the best of the widths up to the square root.
    let most = (f64::from(copies).sqrt() as u32).max(1);
    let across = (most.div_ceil(2)..=most).max_by_key(|across| (copies / across * across, *across)).unwrap_or(1);
    Ok([across, copies / across])
}

/// The outcome of the run.
struct Run {
    status: ExitStatus,
    limited_by: Option<&'static str>,
    no_limit_because: Option<String>,
    group_peak: Option<u64>,
    seconds: f64,
    last_words: Option<String>,
}

fn train(args: &Args) -> InputResult<Run> {
    let program = Path::new(env!("CARGO_BIN_EXE_gsscale-train"));
    let path = |name: &str| args.dir.join(name).into_os_string();
    let flags = [
        ("--out", path("out")),
        ("--spill-dir", path("pages")),
        ("--host-mem", args.host_mem.0.to_string().into()),
        ("--steps", args.steps.to_string().into()),
        ("--page-rows", args.page_rows.to_string().into()),
        ("--sh-start", "3".into()),
        ("--strategy", "none".into()),
        ("--device", "cpu".into()),
        ("--log-every", "1".into()),
        // Without commits the drive holds the state once.
        ("--commit-every", "0".into()),
    ];
    let mut arguments: Vec<OsString> = vec![path("scene"), "--quiet".into()];
    arguments.extend(flags.into_iter().flat_map(|(flag, value)| [flag.into(), value]));
    let group = MemoryGroup::new(limit(args));
    let mut command = match &group {
        Ok(group) => group.command(program, &arguments),
        Err(_) => {
            let mut command = Command::new(program);
            command.args(&arguments);
            command
        }
    };
    let began = Instant::now();
    let output = command.stdout(Stdio::null()).stderr(Stdio::piped()).output();
    let output = output.map_err(|e| InputError::io(program, "starting the trainer", &e))?;
    let said = String::from_utf8_lossy(&output.stderr).trim().to_string();
    Ok(Run {
        status: output.status,
        limited_by: group.as_ref().ok().map(MemoryGroup::name),
        group_peak: group.as_ref().ok().and_then(MemoryGroup::peak_bytes),
        no_limit_because: group.err(),
        seconds: began.elapsed().as_secs_f64(),
        last_words: (!said.is_empty()).then_some(said),
    })
}

fn read_summary(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    serde_json::from_str(&text).unwrap_or(Value::Null)
}

/// Pages, seconds and bytes of each step but the first, by falling number of pages.
fn steps(path: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    let lines: Vec<Value> = text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let of_step = |pair: &[Value]| {
        let less = |key: &str| Some(pair[1][key].as_f64()? - pair[0][key].as_f64()?);
        let (pages, seconds) = (less("pages_needed")?, less("seconds")?);
        let (read, written) = (less("bytes_read")?, less("bytes_written")?);
        Some(json!({
            "step": pair[1]["step"], "pages": pages, "seconds": seconds, "bytes_read": read, "bytes_written": written,
        }))
    };
    let mut steps: Vec<Value> = lines.windows(2).filter_map(of_step).collect();
    steps.sort_by(|a, b| b["pages"].as_f64().unwrap_or(0.0).total_cmp(&a["pages"].as_f64().unwrap_or(0.0)));
    steps
}

#[cfg(unix)]
fn killed_by(status: &ExitStatus) -> Option<i32> {
    std::os::unix::process::ExitStatusExt::signal(status)
}

#[cfg(not(unix))]
fn killed_by(_status: &ExitStatus) -> Option<i32> {
    None
}

/// The new folder, removed at the end and on errors.
struct Scratch(PathBuf);

impl Drop for Scratch {
    fn drop(&mut self) {
        if let Err(error) = std::fs::remove_dir_all(&self.0) {
            gsscale::tell!("warning: {} could not be removed: {error}", self.0.display());
        }
    }
}
