//! `gsscale-view`: a page that shows the Gaussians of a run or a file beside the photos. Parses, calls the library.

use clap::Parser;
use gsscale::base::allocator::return_freed_blocks;
use gsscale::base::environment::quiet_wayland;
use gsscale::base::say::exit_code;
use gsscale::config::command_line::parse_arguments;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::report::live::{Live, parse_address};
use gsscale::report::run_files::METRICS_FILE;
use gsscale::train::error::TrainError;
use gsscale::train::run::model_of_run::ModelOfRun;
use gsscale::train::run::viewer::{ShowRequest, config_to_show, show};
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-view runs/village                                       opens at http://127.0.0.1:8080/
  gsscale-view point_cloud.ply scans/village --serve 9000
  gsscale-view runs/village/checkpoint scans/village              the last commit of a run that was stopped
  gsscale-view city.ply scans/city --host-mem 4GiB --spill-dir /mnt/fast/view      larger than memory";

/// Shows Gaussians beside the photos of their scene, on a page with a camera that you move.
#[derive(Parser)]
#[command(name = "gsscale-view", version, after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, a PLY, the lod-meta.json of a folder of SOGs (its finest level), or a store
    model: PathBuf,
    /// The scene with the photos [default: that of the run]
    scene: Option<PathBuf>,
    /// A port of this machine, or an address with a port (0.0.0.0:8080 lets the network see the page) [default: 8080, or another
    /// port if that is taken]
    #[arg(long, value_name = "ADDRESS", value_parser = parse_address)]
    serve: Option<SocketAddr>,
    /// Config file; by default the run's own, or the defaults for a bare file with a scene. Flags override it
    #[arg(long)]
    config: Option<PathBuf>,
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
    exit_code(start(parse_arguments(&arguments)))
}

fn start(args: Args) -> Result<(), TrainError> {
    let ModelOfRun { file, scene, config } = ModelOfRun::find("gsscale-view", &args.model, args.scene)?;
    let of_run = config.as_deref().map(|config| config.with_file_name(""));
    let saved = of_run.filter(|folder| folder.join(METRICS_FILE).is_file());
    let config = args.config.or(config).map_or_else(|| Ok(TrainConfig::default()), |file| TrainConfig::read(&file))?;
    let (mut config, spill_dir, host_mem) = (config, args.keys.spill_dir.clone(), args.keys.host_mem);
    args.keys.apply(&mut config);
    let config = config_to_show(config, &file, spill_dir, host_mem);
    config.check()?;
    let on_port = |port| Live::begin(SocketAddr::from(([127, 0, 0, 1], port)));
    let live = args.serve.map_or_else(|| on_port(8080).or_else(|_| on_port(0)), Live::begin)?;
    show(&ShowRequest { gaussians: file, scene, config, saved, live })
}
