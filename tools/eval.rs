//! `gsscale-eval`: held-out PSNR and SSIM of a PLY (or of a run's PLY). Parses, calls the library, prints.

use clap::Parser;
use gsscale::base::allocator::return_freed_blocks;
use gsscale::base::environment::quiet_wayland;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::whole_file::{folder_of, write_whole};
use gsscale::config::command_line::parse_command_line;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::render::lpips::InputRange;
use gsscale::report::run_files::{CONFIG_FILE, PLY_FILE};
use gsscale::train::error::TrainError;
use gsscale::train::log::facts::read_resolved;
use gsscale::train::state::eval::{EvalExtras, evaluate_ply};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-eval runs/village
  gsscale-eval point_cloud.ply scans/village --data-factor 4 --test-every 83
  gsscale-eval runs/village scans/village --renders pictures --json eval.json
  gsscale-eval runs/village scans/village --lpips lpips_alex.safetensors --color-correct affine";

/// Evaluates Gaussians on the held-out photos of a scene.
#[derive(Parser)]
#[command(name = "gsscale-eval", version, after_help = EXAMPLES)]
struct Args {
    /// A run's output folder (its config.toml is used), or a PLY
    model: PathBuf,
    /// The scene with the photos [default: that of the run]
    scene: Option<PathBuf>,
    /// Config file; by default the run's own, or the defaults for a bare PLY. Flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    /// Write pictures of render and photo side by side into this folder
    #[arg(long)]
    renders: Option<PathBuf>,
    /// Measure LPIPS as well, with these weights (safetensors; see tools/README.md)
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    /// Input range of LPIPS's network: signed (-1..1, as it was trained) or unit (0..1, as in the 3DGS code)
    #[arg(long, default_value = "signed", value_name = "RANGE")]
    lpips_range: InputRange,
    /// Also write the numbers to this file, as JSON
    #[arg(long)]
    json: Option<PathBuf>,
    #[command(flatten)]
    keys: TrainOverrides,
}

fn main() -> ExitCode {
    return_freed_blocks();
    quiet_wayland();
    match start(parse_command_line()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn start(args: Args) -> Result<(), TrainError> {
    let (ply, run_config) = if args.model.is_dir() {
        (args.model.join(PLY_FILE), Some(args.model.join(CONFIG_FILE)))
    } else {
        (args.model.clone(), None)
    };
    let scene = args.scene.clone().map_or_else(|| scene_of(&ply), Ok)?;
    let mut config = read_config(args.config.as_deref().or(run_config.as_deref()))?;
    args.keys.apply(&mut config);
    config.check()?;
    let extras = EvalExtras {
        pictures: args.renders.as_deref(),
        lpips: args.lpips.as_deref().map(|weights| (weights, args.lpips_range)),
    };
    let report = evaluate_ply(&ply, &scene, &config, &extras)?;
    let text = serde_json::to_string_pretty(&report)
        .map_err(|e| InputError::new(&ply, format!("writing JSON failed: {e}"), "report this as a bug"))?;
    gsscale::say!("{text}");
    if let Some(path) = &args.json {
        write_whole(path, (text + "\n").as_bytes())?;
    }
    Ok(())
}

/// The scene of the run that wrote `ply`.
fn scene_of(ply: &Path) -> InputResult<PathBuf> {
    let config = folder_of(ply).join(CONFIG_FILE);
    if !config.is_file() {
        let problem = "a PLY outside of a run's folder does not say its scene";
        return Err(InputError::new(ply, problem, "name the scene: gsscale-eval FILE SCENE"));
    }
    let scene = read_resolved(&config)?.scene;
    if scene.exists() {
        return Ok(scene);
    }
    let remedy = format!("if it was moved: gsscale-eval {} SCENE", ply.display());
    Err(InputError::new(&scene, "the scene of this run is missing", remedy))
}

fn read_config(path: Option<&Path>) -> InputResult<TrainConfig> {
    path.map_or_else(|| Ok(TrainConfig::default()), TrainConfig::read)
}
