//! `gsscale-train`: trains a scene from photos to a PLY. Parses, calls the library, prints.

use clap::Parser;
use gsscale::base::allocator::return_freed_blocks;
use gsscale::base::count::Count;
use gsscale::base::environment::quiet_wayland;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::say::shell_word;
use gsscale::base::trace;
use gsscale::base::units::{counted, format_grouped, format_seconds};
use gsscale::config::command_line::parse_arguments;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::new_run;
use gsscale::dataset::read::lacks_poses;
use gsscale::dataset::synthetic::{CityOptions, is_generated, write_city};
use gsscale::poses::{PoseSearch, PosesRequest, check_found};
use gsscale::report::live::{Live, parse_address};
use gsscale::report::run_files::{CONFIG_FILE, PLY_FILE, REPORT_FILE, SETTINGS_FILE};
use gsscale::train::error::TrainError;
use gsscale::train::run::begin::run;
use gsscale::train::run::out_folder::{check_usable_out, default_out, is_trace, remedy_of_existing};
use gsscale::train::run::request::{Existing, RunOutcome, RunRequest};
use gsscale::train::run::resume::{ResumeRequest, describe_resume, go_on, resume};
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use tempfile::TempDir;

/// Help with the examples before the flags.
const HELP: &str = "{about-with-newline}\n{before-help}{usage-heading} {usage}\n\n{all-args}{after-help}";

const FIRST_EXAMPLES: &str = "\
Examples:
  gsscale-train --demo                              train on a generated city, pictures in runs/demo
  gsscale-train scans/village --out runs/village    a COLMAP scene: images/ and sparse/0/
  gsscale-train scans/village --dry-run             print the settings and the memory needed
  gsscale-train --resume runs/village               resume a stopped or interrupted run";

const EXAMPLES: &str = "\
Examples:
  gsscale-train --demo                              generate a city, train on it, write pictures to runs/demo
  gsscale-train scans/village --out runs/village    a COLMAP scene: images/ and sparse/0/
  gsscale-train scans/village --out runs/quick --steps 7000 --max-resolution 800
  gsscale-train scans/village --out runs/big --max-gaussians 2000000 --config configs/in_core.toml
  gsscale-train scans/village --out runs/gpu --device gpu   on a GPU; --list-devices lists the GPUs
  gsscale-train --resume runs/village               resume a stopped or interrupted run
  gsscale-train --resume runs/village --steps 60k   more steps
  gsscale-train scans/village --dry-run             print the settings and the memory needed

Results in --out: point_cloud.ply (opens in any splat viewer), renders/test/*.png (render beside photo),
report.html (open it in a browser), summary.json, metrics.jsonl, pages.json, config.toml (every setting of the run; usable with --config).";

/// Trains a 3D Gaussian Splatting scene from photos with known poses.
#[derive(Parser)]
#[command(name = "gsscale-train", version, help_template = HELP, arg_required_else_help = true)]
#[command(before_help = FIRST_EXAMPLES, before_long_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), or one of the other layouts that --help names
    ///
    /// These are one with transforms.json, an OpenDroneMap project, RealityScan's CSV, and Mega-NeRF's layout
    #[arg(required_unless_present_any = ["demo", "list_devices", "resume", "data"])]
    scene: Option<PathBuf>,
    /// The scene as a flag, as other trainers name it
    #[arg(long, short = 's', aliases = ["data-dir", "data-path", "source-path", "source", "input"], hide = true, conflicts_with_all = ["scene", "demo"])]
    data: Option<PathBuf>,
    /// Photos without poses: `auto` finds the poses first, as gsscale-poses does
    #[arg(long, value_name = "HOW", value_parser = ["auto"], hide_short_help = true)]
    poses: Option<String>,
    /// Output folder [default: runs/NAME, with the name of the scene]
    ///
    /// If that is taken, runs/NAME-2 and so on
    #[arg(long, short, aliases = ["result-dir", "model-path", "output-dir", "output-path", "output", "export-path"], short_alias = 'm')]
    out: Option<PathBuf>,
    /// Config file; flags override it
    #[arg(long, hide_short_help = true)]
    config: Option<PathBuf>,
    /// Generate a small city in the folder `scene` inside --out and train on it
    #[arg(long, conflicts_with = "scene", hide_short_help = true)]
    demo: bool,
    /// Resume the run in this output folder, with its config and scene
    ///
    /// The run was stopped, interrupted, or kept its checkpoint. These may be given anew: memory, frames, threads, I/O, device and logging; more --steps; the scene or
    /// --init-ply if they moved
    #[arg(long, value_name = "OUT", conflicts_with_all = ["out", "config", "demo", "overwrite"])]
    resume: Option<PathBuf>,
    /// With --resume: continue although the dataset changed, or with other values of keys that change numbers
    #[arg(long, requires = "resume", hide_short_help = true)]
    accept_changes: bool,
    /// Print what the run will need, then stop
    ///
    /// With --resume: what it will do. Nothing is written
    #[arg(long)]
    dry_run: bool,
    /// Print the GPUs available to --device, best first, then stop
    #[arg(long, hide_short_help = true)]
    list_devices: bool,
    /// Replace the results of an earlier run in --out; its spill directory must be removed first
    #[arg(long, hide_short_help = true)]
    overwrite: bool,
    /// Print only warnings and errors
    #[arg(long, short, hide_short_help = true)]
    quiet: bool,
    /// If the GPU is lost during the steps, go on from the last commit in this process, up to N times
    #[arg(long, value_name = "N", default_value_t = 3, hide_short_help = true)]
    restarts: u32,
    /// Write a trace of the host's work in every step (uploads, submissions, waits, read-backs, pages, events) to this file.
    /// Perfetto (ui.perfetto.dev) and chrome://tracing open it
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    trace: Option<PathBuf>,
    /// Serve a live page of the run, with its curves and a picture from a camera that you move. ADDRESS is a port of this
    /// machine (8080), or an address with a port (0.0.0.0:8080 lets the network see the page)
    #[arg(long, value_name = "ADDRESS", value_parser = parse_address, hide_short_help = true)]
    serve: Option<SocketAddr>,
    #[command(flatten)]
    keys: TrainOverrides,
}

fn main() -> ExitCode {
    run_with(std::env::args_os().collect())
}

/// The program, with the words of its command line; the first is its name.
pub fn run_with(arguments: Vec<OsString>) -> ExitCode {
    return_freed_blocks();
    quiet_wayland();
    let mut args: Args = parse_arguments(&arguments);
    args.scene = args.scene.or(args.data.take());
    if args.list_devices {
        list_devices();
        return ExitCode::SUCCESS;
    }
    let quiet = args.quiet;
    let begun = args.trace.as_deref().filter(|_| !args.dry_run).map_or(Ok(()), trace::start);
    let outcome = begun.map_err(TrainError::from).and_then(|()| start(args));
    if let Err(error) = trace::finish() {
        gsscale::tell!("warning: {error}");
    }
    match outcome {
        Ok(outcome) => finish(&outcome, quiet),
        Err(error) => {
            gsscale::tell!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Prints one line per adapter, and one for the CPU renderer, which always exists.
fn list_devices() {
    for (number, adapter) in (1..).zip(gsscale::gpu::list_adapters()) {
        gsscale::say!("#{number} {adapter}");
    }
    gsscale::say!("cpu: the CPU renderer");
}

fn start(args: Args) -> Result<RunOutcome, TrainError> {
    let live = args.serve.filter(|_| !args.dry_run).map(Live::begin).transpose()?;
    if let Some(live) = &live {
        gsscale::tell!("live page: http://{}/", live.address());
    }
    if let Some(out) = args.resume {
        let (accept_changes, quiet) = (args.accept_changes, args.quiet);
        let request = ResumeRequest { out, keys: args.keys, scene: args.scene, accept_changes, quiet, live, leg: None };
        if args.dry_run {
            gsscale::say!("{}", describe_resume(&request)?);
            return Ok(RunOutcome::of_nothing(request.out));
        }
        return go_on(resume(&request), &request, args.restarts);
    }
    let config = match (&args.config, args.demo) {
        (None, true) => demo_config(&args.keys)?,
        (file, _) => new_run::of_new_run(file.as_deref(), &args.keys)?,
    };
    config.check()?;
    let out = args.out.unwrap_or_else(|| {
        let (out, first) = default_out(args.scene.as_deref());
        if out != first && !args.quiet {
            gsscale::tell!(
                "{} is taken: results go to {}; to resume the run there: gsscale-train --resume {}",
                first.display(),
                out.display(),
                shell_word(&first)
            );
        }
        out
    });
    if args.demo {
        check_demo_out(&out, args.overwrite)?;
    }
    let existing = if args.overwrite || args.demo { Existing::Overwrite } else { Existing::Refuse };
    let mut scratch = None;
    let scene = match args.scene {
        Some(photos) if args.poses.is_some() && lacks_poses(&photos) => {
            // Not hours later.
            check_usable_out(&out, existing)?;
            let search = PoseSearch::new(&PosesRequest::of(&photos))?;
            if args.dry_run {
                gsscale::say!("{}", search.forecast());
                return Ok(RunOutcome::of_nothing(out));
            }
            let found = search.run_shown(args.quiet)?;
            check_found(&photos)?;
            found.scene
        }
        Some(scene) => {
            if args.poses.is_some() {
                check_found(&scene)?;
            }
            scene
        }
        None if args.dry_run => make_city(scratch.insert(scratch_folder()?).path(), &config, args.quiet)?,
        None => demo_scene(&out, &config, args.quiet)?,
    };
    let (dry_run, quiet) = (args.dry_run, args.quiet);
    // What the run was started with is in its config.
    let (keys, accept_changes) = (TrainOverrides::default(), false);
    let request = RunRequest { scene, out, config, dry_run, existing, quiet, live, leg: None };
    let (out, live) = (request.out.clone(), request.live.clone());
    let again = ResumeRequest { out, keys, scene: None, accept_changes, quiet, live, leg: None };
    go_on(run(&request), &again, args.restarts)
}

/// Config of the demo where `keys` leave it open: enough steps for a good picture within minutes on two cores, and enough Gaussians for
/// the drive to be used.
fn demo_config(keys: &TrainOverrides) -> InputResult<TrainConfig> {
    let keys = TrainOverrides {
        steps: keys.steps.or(Some(4000)),
        max_gaussians: keys.max_gaussians.or(Some(150_000)),
        eval_every: keys.eval_every.or(Some(1000)),
        ..keys.clone()
    };
    new_run::of_new_run(None, &keys)
}

/// Refuses an output folder of a demo that holds more than the city of an earlier demo.
fn check_demo_out(out: &Path, overwrite: bool) -> InputResult<()> {
    // A demo that was stopped before its first step left only its city.
    let is_city = |entry: &std::fs::DirEntry| entry.file_name() == "scene" && is_generated(&entry.path());
    let is_foreign = |entry: std::fs::DirEntry| !is_city(&entry) && !is_trace(&entry.file_name());
    let is_taken = std::fs::read_dir(out).is_ok_and(|entries| entries.flatten().any(is_foreign));
    if !overwrite && (is_taken || out.is_file()) {
        return Err(InputError::new(out, "exists already", remedy_of_existing(out)));
    }
    Ok(())
}

/// Generates the city beside the results, or reuses that of an earlier demo with the same seed.
fn demo_scene(out: &Path, config: &TrainConfig, quiet: bool) -> Result<PathBuf, TrainError> {
    let scene = out.join("scene");
    let same_seed = TrainConfig::read(&out.join(CONFIG_FILE)).is_ok_and(|earlier| earlier.seed == config.seed);
    if same_seed && scene.join("sparse/0/points3D.bin").is_file() {
        return Ok(scene);
    }
    make_city(&scene, config, quiet)
}

fn make_city(scene: &Path, config: &TrainConfig, quiet: bool) -> Result<PathBuf, TrainError> {
    if !quiet {
        gsscale::tell!("generating a city in {}", scene.display());
    }
    let options = CityOptions { seed: config.seed, overwrite: true, ..CityOptions::default() };
    let shown = Count::new("photos made", options.photos(), quiet);
    write_city(scene, &options, &|done, _| shown.show(done))?;
    Ok(scene.to_path_buf())
}

/// Of a dry run, for files needed to compute its requirements; removed when dropped.
fn scratch_folder() -> InputResult<TempDir> {
    let at = std::env::temp_dir();
    TempDir::with_prefix_in("gsscale-dry-", &at).map_err(|e| InputError::io(&at, "creating a scratch folder", &e))
}

fn finish(outcome: &RunOutcome, quiet: bool) -> ExitCode {
    if let (Some(summary), false) = (&outcome.summary, quiet) {
        let test = match &summary.test {
            Some(t) => {
                let corrected = t.corrected_text();
                let views = counted(t.views.into(), "held-out view");
                format!("test PSNR {:.2} dB, SSIM {:.4}{corrected} on {views}", t.psnr, t.ssim)
            }
            None if summary.finished => String::from("not measured: there is no held-out photo that counts"),
            None => String::from("not evaluated"),
        };
        gsscale::tell!(
            "{} {}, {}, {} of training",
            if summary.finished { "done:" } else { "stopped after" },
            counted(summary.steps.into(), "step"),
            counted(summary.gaussians, "Gaussian"),
            format_seconds(summary.train_seconds),
        );
        let out = &outcome.out;
        gsscale::tell!("  quality     {test}");
        let left_out = match summary.gaussians_left_out {
            0 => String::new(),
            count => format!(" (without {} that too few photos see)", format_grouped(count)),
        };
        gsscale::tell!("  Gaussians   {}{left_out}", out.join(PLY_FILE).display());
        for export in summary.export.iter().chain(&summary.more_exports) {
            let is_spz = export.file.extension().is_some_and(|ending| ending == "spz");
            gsscale::tell!("  {}         {}", if is_spz { "SPZ" } else { "SOG" }, out.join(&export.file).display());
        }
        if out.join(SETTINGS_FILE).is_file() {
            gsscale::tell!("  start view  {} (for viewers)", out.join(SETTINGS_FILE).display());
        }
        gsscale::tell!("  report      {}", out.join(REPORT_FILE).display());
        gsscale::tell!("  look        gsscale-view {}", shell_word(out));
        if summary.finished {
            let more = summary.steps.saturating_mul(2);
            gsscale::tell!("  more steps  gsscale-train --resume {} --steps {more}", shell_word(out));
            if !outcome.keeps_checkpoint {
                gsscale::tell!(
                    "              (a little worse than in one go; a run with --keep-checkpoint goes on exactly)"
                );
            }
        }
        if std::env::var_os("CARGO").is_some() {
            gsscale::tell!("  commands    cargo install --path . puts them on the PATH");
        }
    }
    ExitCode::from(outcome.exit_code as u8)
}
