//! `gsscale-eval`: held-out PSNR and SSIM of a PLY, of a run's PLY, or of the levels of SOGs. Parses, calls the library,
//! prints.

use clap::Parser;
use gsscale::base::allocator::return_freed_blocks;
use gsscale::base::environment::quiet_wayland;
use gsscale::base::error::InputError;
use gsscale::base::say::exit_code;
use gsscale::base::units::counted;
use gsscale::base::whole_file::{check_replaceable, folder_of, write_whole};
use gsscale::config::command_line::parse_arguments;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::values::Chosen;
use gsscale::exchange::sog::is_tree;
use gsscale::photos::exposure::FILE as APPEARANCE_FILE;
use gsscale::render::lpips::InputRange;
use gsscale::report::chart::{Chart, Mark};
use gsscale::report::html::{Cell, Page, is_page};
use gsscale::train::error::TrainError;
use gsscale::train::run::eval_file::{EvalExtras, EvalReport, LevelReport, evaluate_file};
use gsscale::train::run::model_of_run::{ModelOfRun, gaussians_left_out};
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-eval runs/village
  gsscale-eval point_cloud.ply scans/village --data-factor 4 --test-every 83
  gsscale-eval runs/village scans/village --renders pictures --json eval.json
  gsscale-eval runs/village scans/village --lpips lpips_alex.safetensors --color-correct affine
  gsscale-eval runs/village/point_cloud_sog/lod-meta.json --page levels.html";

/// Evaluates Gaussians on the held-out photos of a scene.
#[derive(Parser)]
#[command(name = "gsscale-eval", version, after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder (its config.toml is used), a PLY, or the lod-meta.json of a folder of SOGs (each level is measured)
    model: PathBuf,
    /// The scene with the photos [default: that of the run]
    scene: Option<PathBuf>,
    /// Config file; by default the run's own, or the defaults for a bare file with a scene. Flags override it
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
    /// Write a page with charts of PSNR and SSIM by level of detail (lod-meta.json)
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
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
    let ModelOfRun { file: ply, scene, config: run_config } =
        ModelOfRun::find("gsscale-eval", &args.model, args.scene.clone())?;
    if args.page.is_some() && !is_tree(&ply) {
        let remedy = "give the lod-meta.json of a folder of SOGs (--export sog), or leave --page out";
        return Err(InputError::new("--page", format!("{} has no levels of detail", ply.display()), remedy).into());
    }
    args.json.as_deref().map_or(Ok(()), |file| check_replaceable("--json", file, EvalReport::is_in))?;
    args.page.as_deref().map_or(Ok(()), |file| check_replaceable("--page", file, is_page))?;
    let values = run_config.as_deref().map(|config| folder_of(config).join(APPEARANCE_FILE));
    let file = args.config.as_deref().or(run_config.as_deref());
    let mut config = file.map_or_else(|| Ok(TrainConfig::default()), TrainConfig::read)?;
    args.keys.apply(&mut config);
    // An evaluation takes no step, so a run with its optimizer on a device is evaluated on any.
    config.optimizer_on = Chosen(None);
    config.check()?;
    let extras = EvalExtras {
        pictures: args.renders.as_deref(),
        lpips: args.lpips.as_deref().map(|weights| (weights, args.lpips_range)),
        appearance: values.as_deref().filter(|file| file.is_file()),
    };
    let report = evaluate_file(&ply, &scene, &config, &extras)?;
    let left_out = run_config.as_deref().map_or(0, |config| gaussians_left_out(folder_of(config)));
    if left_out > 0 {
        gsscale::tell!(
            "the file lacks {} that too few photos see (--export-clean); the figures of the run are of all",
            counted(left_out, "Gaussian")
        );
    }
    let text = serde_json::to_string_pretty(&report)
        .map_err(|e| InputError::new(&ply, format!("writing JSON failed: {e}"), "report this as a bug"))?;
    gsscale::say!("{text}");
    if let Some(path) = &args.json {
        write_whole(path, (text + "\n").as_bytes())?;
    }
    if let Some(path) = &args.page {
        write_whole(path, page_of(&report).as_bytes())?;
    }
    Ok(())
}

/// The page of the levels of a report, the finest first: PSNR and SSIM of held-out photos by level.
fn page_of(report: &EvalReport) -> String {
    let (views, scene) = (report.test.map_or(0, |test| test.views), report.scene.display());
    let facts = format!("{views} held-out photos of {scene}; SSIM: {}", report.ssim_variant);
    let mut page = Page::new(&format!("gsscale: levels of detail of {}", report.ply.display()), &facts);
    page.paragraph(
        "Each level was drawn everywhere. A viewer mixes levels, finer ones near the camera, so its pictures lie between the finest and \
         the coarsest level that it shows.",
    );
    let psnr = |level: &LevelReport| level.figures.test.map(|test| test.psnr);
    let ssim = |level: &LevelReport| level.figures.test.map(|test| test.ssim);
    let chart = |title: &str, unit: &str, of: &dyn Fn(&LevelReport) -> Option<f64>| {
        let label = |level: &LevelReport| {
            Some((f64::from(level.level), of(level)?, format!("{} Gaussians", level.figures.gaussians)))
        };
        let labels: Vec<(f64, f64, String)> = report.levels.iter().filter_map(label).collect();
        let line = labels.iter().map(|&(level, value, _)| (level, value)).collect();
        let chart = Chart { labels, ..Chart::new(title, "level", unit).with("", line, Mark::LineAndDots) };
        (chart.svg(), String::new())
    };
    page.charts(&[chart("PSNR by level", "PSNR, dB", &psnr), chart("SSIM by level", "SSIM", &ssim)]);
    let finest = report.levels.first().and_then(psnr);
    let row = |level: &LevelReport| {
        vec![
            Cell::Number(level.level.to_string()),
            Cell::Number(level.figures.gaussians.to_string()),
            Cell::number(psnr(level), 2),
            Cell::difference(psnr(level).zip(finest).map(|(own, finest)| own - finest), 2),
            Cell::number(ssim(level), 3),
        ]
    };
    page.table(["level", "Gaussians", "PSNR, dB", "against the finest", "SSIM"], report.levels.iter().map(row));
    page.finish()
}
