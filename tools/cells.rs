//! `gsscale-cells`: a city in cells, on several machines or one after the other. Parses, calls the library, prints.

use clap::{Parser, Subcommand};
use gsscale::base::allocator::return_freed_blocks;
use gsscale::base::environment::quiet_wayland;
use gsscale::base::units::{format_bytes, format_grouped, format_seconds, parse_count, parse_seconds};
use gsscale::cells::costs::{AsIf, PhaseCost};
use gsscale::cells::cut::{CutRequest, cut};
use gsscale::cells::merge::{MergeRequest, merge};
use gsscale::cells::plan::{CellCount, CityPlan};
use gsscale::cells::prior::{PriorRequest, prior};
use gsscale::cells::seam::seam;
use gsscale::cells::work::{COPY_EVERY, WorkError, WorkRequest, code_of, status, work};
use gsscale::config::command_line::parse_arguments;
use gsscale::config::file::TrainOverrides;
use gsscale::config::values::ByteSize;
use gsscale::train::error::TrainError;
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-cells prior scans/city --out city --steps 30000 --max-gaussians 20M   on one machine
  gsscale-cells cut scans/city --out city --cells 4                             on one machine
  gsscale-cells run city --cell 0 --spill-dir /nvme                             each cell, on any machine that sees the folder
  gsscale-cells status city
  gsscale-cells merge city --out runs/city
  gsscale-cells seam city runs/city                                             what the borders cost

Give what is to be trained (--steps, --max-gaussians, --max-resolution, ...) to `prior` alone. Every command may be repeated: it goes on, or
says that it is done. Exit codes of `run`: 0 done, 75 again (here or elsewhere), 76 again when the
other process that has the cell has ended, 2 never again.";

/// Trains a city in cells, on several machines or one after the other.
#[derive(Parser)]
#[command(name = "gsscale-cells", version, after_help = EXAMPLES)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Trains the whole scene coarsely: the start of every cell
    Prior(Box<PriorArgs>),
    /// Divides the scene into cells, and says what each will cost
    Cut(Box<CutArgs>),
    /// Trains a cell, or goes on with it
    Run(Box<RunArgs>),
    /// Shows what is done
    Status {
        /// Folder of the city
        city: PathBuf,
    },
    /// Makes one scene of the cells
    Merge {
        /// Folder of the city
        city: PathBuf,
        /// Folder of the scene
        #[arg(long, short)]
        out: PathBuf,
        /// Memory [default: 70 % of what is free]
        #[arg(long, default_value = "0", hide_default_value = true)]
        host_mem: ByteSize,
    },
    /// Measures a scene at the borders of the cells
    Seam {
        /// Folder of the city
        city: PathBuf,
        /// Folder of the merged scene, or of a run of the same photos
        model: PathBuf,
        /// The scene with the photos, if it has moved
        #[arg(long)]
        scene: Option<PathBuf>,
        /// Width of the bands along borders, pixels
        #[arg(long, default_value_t = 64.0)]
        band: f64,
    },
}

#[derive(clap::Args)]
struct PriorArgs {
    /// The scene
    scene: PathBuf,
    /// Folder of the city, which all machines see
    #[arg(long, short)]
    out: PathBuf,
    /// Config file of the whole scene; flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    /// Print only warnings and errors
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    keys: TrainOverrides,
}

#[derive(clap::Args)]
struct CutArgs {
    /// The scene
    scene: PathBuf,
    /// Folder of the city
    #[arg(long, short)]
    out: PathBuf,
    /// Number of cells; those with few photos are joined to a neighbour
    #[arg(long, required_unless_present = "max_gaussians_per_cell")]
    cells: Option<usize>,
    /// As many cells as it takes for none to train more Gaussians, such as 5M
    #[arg(long, conflicts_with = "cells", value_parser = parse_count)]
    max_gaussians_per_cell: Option<u64>,
    /// A cell takes a photo if it has this share of the photo's blending weight
    #[arg(long, default_value_t = 0.1)]
    view_share: f64,
    /// Width of the margin that is trained around a cell, as a share of its own
    #[arg(long, default_value_t = 0.25)]
    margin: f64,
    /// Print the cells, bytes and seconds; write nothing
    #[arg(long)]
    dry_run: bool,
    /// Bytes a second of the network behind the folder of the city and the scene, for the costs
    #[arg(long, default_value = "125MB")]
    network: ByteSize,
    /// Machines that work on cells, for the costs; 0 = one for each cell
    #[arg(long, default_value_t = 0)]
    machines: usize,
    /// With --dry-run, plan as if the scene was a larger one of the same kind: photos, Gaussians at the end, bytes of a photo and
    /// seconds of a step of the prior, such as 40000,100M,8MB,0.05
    #[arg(long, requires = "dry_run", value_name = "PHOTOS,GAUSSIANS,BYTES,SECONDS")]
    as_if: Option<AsIf>,
    /// Print only warnings and errors
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    keys: TrainOverrides,
}

#[derive(clap::Args)]
struct RunArgs {
    /// Folder of the city
    city: PathBuf,
    /// Number of the cell, from 0
    #[arg(long)]
    cell: usize,
    /// The scene with the photos, if this machine has it elsewhere
    #[arg(long)]
    scene: Option<PathBuf>,
    /// Time between copies of the cell's commits into the folder of the city (900, 15min; 0: at the end only)
    #[arg(long, default_value_t = COPY_EVERY, value_parser = parse_seconds)]
    copy_every: f64,
    /// Print only warnings and errors
    #[arg(long, short)]
    quiet: bool,
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
    match start(parse_arguments::<Args>(&arguments).command) {
        Ok(code) => ExitCode::from(code as u8),
        Err(error) => {
            gsscale::tell!("error: {error}");
            ExitCode::from(code_of(&error) as u8)
        }
    }
}

fn start(command: Command) -> Result<i32, TrainError> {
    match command {
        Command::Prior(args) => {
            let PriorArgs { scene, out: city, config, quiet, keys } = *args;
            prior(&PriorRequest { scene, city, config, keys, quiet })
        }
        Command::Cut(args) => {
            let most = args.max_gaussians_per_cell.map(CellCount::MostGaussians);
            let cells = args.cells.map(CellCount::Cells).or(most).unwrap_or(CellCount::Cells(1));
            let CutArgs { scene, out: city, view_share, margin, machines, as_if, dry_run, quiet, keys, .. } = *args;
            let network = args.network.0;
            let request =
                CutRequest { scene, city, cells, view_share, margin, network, machines, as_if, keys, dry_run, quiet };
            let (plan, costs) = cut(&request)?;
            gsscale::say!("{}{}", text_of(&plan), text_of_costs(&costs));
            Ok(0)
        }
        Command::Run(args) => {
            let RunArgs { city, cell, scene, copy_every, quiet, keys } = *args;
            work(&WorkRequest { city, cell, scene, keys, copy_every, quiet }).or_else(|WorkError { error, code }| {
                gsscale::tell!("error: {error}");
                Ok(code)
            })
        }
        Command::Status { city } => show_status(&city),
        Command::Merge { city, out, host_mem } => {
            let merged = merge(&MergeRequest { city, out: out.clone(), host_mem: host_mem.0 })?;
            let kept: Vec<String> = merged.kept.iter().map(|rows| format_grouped(*rows)).collect();
            gsscale::say!(
                "{}: {} Gaussians ({} from the cells, {} put back); dropped {} beyond their cell, {} that came twice",
                out.display(),
                format_grouped(merged.gaussians),
                kept.join(" + "),
                merged.put_back,
                format_grouped(merged.beyond),
                merged.twice
            );
            Ok(0)
        }
        Command::Seam { city, model, scene, band } => {
            let report = seam(&city, &model, scene.as_deref(), band)?;
            gsscale::say!("{}", serde_json::to_string_pretty(&report).unwrap_or_default());
            Ok(0)
        }
    }
}

/// The cells of a plan with what each costs.
fn text_of(plan: &CityPlan) -> String {
    let mut text = format!(
        "{} Gaussians of the prior, {} training photos, {} cells; each grows up to {:.2} times\n\
         cell  photos  steps  Gaussians  ring  at most  bytes  time (modelled)",
        format_grouped(plan.gaussians),
        plan.views,
        plan.cells.len(),
        plan.growth
    );
    for (number, cell) in plan.cells.iter().enumerate() {
        let [trained, frozen, most] = [cell.trained, cell.frozen, cell.max_gaussians].map(format_grouped);
        let (bytes, seconds) = (format_bytes(cell.bytes), format_seconds(cell.seconds));
        let (views, steps) = (cell.train_views, cell.steps);
        text.push_str(&format!(
            "\n{number:4}  {views:6}  {steps:5}  {trained:9}  {frozen}  {most}  {bytes}  {seconds}"
        ));
    }
    text
}

/// What the phases cost; empty without phases.
fn text_of_costs(costs: &[PhaseCost]) -> String {
    if costs.is_empty() {
        return String::new();
    }
    let line = |phase: &str, machines: &str, seconds: f64, bytes: [f64; 2]| {
        let (time, [all, photos]) = (format_seconds(seconds), bytes.map(|bytes| format_bytes(bytes as u64)));
        format!("\n{phase:6}  {machines:>8}  {time:>8}  {all:>10}  {photos:>10}")
    };
    let of_phase =
        |cost: &PhaseCost| line(cost.phase, &cost.machines.to_string(), cost.seconds, [cost.network, cost.photos]);
    let sum = |of: fn(&PhaseCost) -> f64| costs.iter().map(of).sum();
    let all = line("all", "", sum(|cost| cost.seconds), [sum(|cost| cost.network), sum(|cost| cost.photos)]);
    let lines: String = costs.iter().map(of_phase).chain([all]).collect();
    format!("\n\nphase   machines      time     network  photos of it   (modelled){lines}")
}

fn show_status(city: &std::path::Path) -> Result<i32, TrainError> {
    let (plan, cells) = status(city)?;
    for (number, (cell, planned)) in cells.iter().zip(&plan.cells).enumerate() {
        let state = match (&cell.done, &cell.owner) {
            (Err(error), _) => error.to_string(),
            (Ok(Some(done)), _) => format!("done: {} Gaussians", format_grouped(done.gaussians)),
            (Ok(None), Some(owner)) => format!("running on {owner}"),
            (Ok(None), None) => "waiting".to_string(),
        };
        gsscale::say!("cell {number}: {} of {} steps copied, {state}", cell.copied, planned.steps);
    }
    let done = cells.iter().filter(|cell| matches!(cell.done, Ok(Some(_)))).count();
    gsscale::say!("{done} of {} cells are done", cells.len());
    Ok(0)
}
