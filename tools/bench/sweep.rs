//! `gsscale-bench sweep`: trains the runs of a list on scenes, and compares them in a table and on a page.
//!
//! Not here: the list and its runs ([`super::list`]), the processes and the log ([`super::runs`]).

use super::list::{List, Plan};
use super::results_log::{ResultsLog, successful_run};
use super::runs::{Place, Planned, RESULTS, Surroundings, Sweep};
use super::sweep_page::{sweep_page, sweep_table};
use clap::Parser;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::whole_file::write_whole;
use gsscale::base::whole_folder::remove_ours;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::new_run;
use gsscale::dataset::disturb::{is_of_disturbed, write_disturbed};
use gsscale::train::error::TrainError;
use serde_json::Value;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  gsscale-bench sweep pareto scans/village --out sweeps/pareto --list-runs
  gsscale-bench sweep pareto scans/village --out sweeps/pareto --only order,moments --page-rows 128 --max-runs 5
  gsscale-bench sweep ladder scans/village scans/city --out sweeps/ladder --strategy none --share 25
  gsscale-bench sweep stability scans/village --out sweeps/stability --only swapped10,boxes --seeds 1,2,3
  gsscale-bench sweep mine.toml scans/village --out sweeps/mine

Lists:
  pareto      one change of a setting at a time, and a few together: cost in accuracy, savings in time, bytes, Gaussians
  ladder      the ideas of out-of-core training, added one by one
  ladder-gpu  the same on a GPU; needs --device gpu --device-mem SIZE
  cells       a city in cells: margins, and which photos a cell takes
  speed       what few and many steps and Gaussians reach, beside other programs
  stability   faults of photos, poses and points, and remedies
\"Sweeps\" in configs/README.md says how to write another one.

Each run is a process of its own and adds a line to OUT/SCENE/results.jsonl; the page is OUT/SCENE/sweep.html, and the end is
a table. A sweep that stopped continues when started again.";

/// Trains the runs of a list on each scene.
#[derive(Parser)]
#[command(name = "gsscale-bench sweep", version, after_help = EXAMPLES)]
pub struct Args {
    /// cells, pareto, ladder, ladder-gpu, speed, stability, or a TOML file
    list: PathBuf,
    /// Scenes: COLMAP folders (images/, sparse/), with transforms.json, or in Mega-NeRF's layout
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Config file over the base of the list; flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    /// Folder with a folder of results for each scene
    #[arg(long, short)]
    out: PathBuf,
    /// Spill directory, on the drive to measure [default: spill in the folder of results]
    #[arg(long, value_name = "DIR")]
    spill: Option<PathBuf>,
    /// Groups or runs to train (GROUP, NAME or GROUP/NAME), beside the reference [default: all]
    #[arg(long, value_delimiter = ',', value_name = "NAME")]
    only: Vec<String>,
    /// Seeds [default: those of the list]
    #[arg(long, value_delimiter = ',', value_name = "N")]
    seeds: Vec<u64>,
    /// Seeds for each run but the reference, which uses all [default: that of the list]
    #[arg(long, value_name = "N")]
    other_seeds: Option<usize>,
    /// Frames in percent of the pages; 0 = all pages in memory [default: that of the list]
    #[arg(long, value_name = "P")]
    share: Option<f64>,
    /// Stop after this many runs of each scene; the next call continues
    #[arg(long, value_name = "N")]
    max_runs: Option<usize>,
    /// Print the runs and whether they are done, then stop
    #[arg(long)]
    list_runs: bool,
    /// Train the reference for this many steps before and after each run, and convert times to one pace of the machine where every
    /// run has these; 0 = do neither. Not for disturbed scenes
    #[arg(long, default_value_t = 200, value_name = "N")]
    pace_steps: u32,
    /// Print each result as a line of JSON, instead of a table at the end
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// Runs the sweep. Errors: the input is invalid, or the results cannot be written.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let mut list = List::read(&args.list)?;
    if !args.only.is_empty() {
        list.keep(&args.only)?;
    }
    if !args.seeds.is_empty() {
        list.seeds.clone_from(&args.seeds);
    }
    list.other_seeds = args.other_seeds.or(list.other_seeds);
    list.share = args.share.unwrap_or(list.share);
    if !(0.0..100.0).contains(&list.share) {
        let remedy = "use --share 25, or 0 for all pages in memory";
        return Err(InputError::new("--share", "the value must be 0 or more, and below 100", remedy).into());
    }
    let given = new_run::given_keys(args.config.as_deref(), &args.keys)?;
    super::settle(args.config.as_deref(), &args.keys)?;
    let mut plans: Vec<(Place, Plan)> = Vec::new();
    for scene in &args.scenes {
        std::fs::metadata(scene).map_err(|e| InputError::io(scene, "reading the scene", &e))?;
        let name = scene.file_name().unwrap_or(scene.as_os_str());
        let place = Place { scene: scene.clone(), out: args.out.join(name), spill: args.spill.clone() };
        if plans.iter().any(|(other, _)| other.out == place.out) {
            return Err(InputError::new(scene, "another scene has this name", "use one sweep for each").into());
        }
        let plan = list.plan(&place, &given)?;
        plans.push((place, plan));
    }
    for (place, plan) in &plans {
        let in_order = list.in_order(&plan.runs);
        match args.list_runs {
            true => list_runs(place, plan, &in_order)?,
            false => sweep_scene(args, &list, place, plan, &in_order, print)?,
        }
    }
    Ok(())
}

/// Trains the runs of a scene that are not done.
fn sweep_scene(
    args: &Args,
    list: &List,
    place: &Place,
    plan: &Plan,
    in_order: &[Planned],
    print: &mut dyn FnMut(&Value),
) -> Result<(), TrainError> {
    // The reference of disturbed scenes is no training of the scene itself.
    let pace_steps = if plan.dataset.is_some() { 0 } else { args.pace_steps };
    let mut sweep = Sweep::open(place, Surroundings::of(place, &plan.base)?, &plan.reference, pace_steps, args.json)?;
    let open = sweep.open_runs(&plan.runs);
    let (all, count) = (plan.runs.len(), open.len().min(args.max_runs.unwrap_or(usize::MAX)));
    gsscale::tell!("{}: {} of {all} runs are done; {count} to do now", place.scene.display(), all - open.len());
    let page = place.out.join("sweep.html");
    let write_page = |sweep: &Sweep| -> InputResult<String> {
        let (mut records, times) = sweep.records_of(in_order);
        let machine = records.first().map_or(String::new(), |r| format!("; {} threads of {}", r.threads, r.cpu));
        let facts = format!("reference: {}{machine}; {times}", in_words(&plan.reference));
        records.extend(list.known(&place.scene, &plan.reference));
        let html = sweep_page(&list.view, &place.scene.display().to_string(), &facts, &records);
        write_whole(&page, html.as_bytes())?;
        Ok(format!("{}\n{times}", sweep_table(&list.view, &records)))
    };
    let mut made: Option<&Path> = None;
    for (i, run) in open.into_iter().take(count).enumerate() {
        gsscale::tell!("run {} of {count}: {}, seed {}", i + 1, run.name, run.config.seed);
        let folder = run.scene.as_ref().map(|scene| scene.folder.as_path());
        if folder != made {
            made.iter().try_for_each(|folder| remove_ours(folder, is_of_disturbed))?;
            if let (Some(scene), Some(dataset)) = (&run.scene, &plan.dataset) {
                // Of an earlier call that was interrupted: the lock of the sweep says that nobody uses it.
                remove_ours(&scene.folder, is_of_disturbed)?;
                write_disturbed(&scene.folder, dataset, &scene.disturbance, run.config.seed)?;
            }
            made = folder;
        }
        sweep.run(run, print)?;
        write_page(&sweep)?;
    }
    made.iter().try_for_each(|folder| remove_ours(folder, is_of_disturbed))?;
    let table = write_page(&sweep)?;
    if !args.json {
        gsscale::say!("{table}");
    }
    gsscale::tell!("done: {}", page.display());
    Ok(())
}

fn in_words(config: &TrainConfig) -> String {
    let growth = match (config.strategy.grows(), config.max_gaussians) {
        (false, _) => "no densification".to_string(),
        (_, 0) => "densification without a cap".to_string(),
        (_, cap) => format!("at most {cap} Gaussians"),
    };
    format!("{} steps, pages of {} rows, SH {}, {growth}", config.steps, config.page_rows, config.sh_degree)
}

/// Prints the runs and which of them are done.
fn list_runs(place: &Place, plan: &Plan, runs: &[Planned]) -> InputResult<()> {
    let records = ResultsLog::peek(&place.out.join(RESULTS))?;
    let surroundings = Surroundings::of(place, &plan.base)?;
    for run in runs {
        let state = match successful_run(&records, &run.key(&surroundings)) {
            Some(record) => format!("done in {:.0} s", record.wall_seconds),
            None => "to do".to_string(),
        };
        gsscale::say!("{:<40} seed {:<4} {:>6} steps  {state}", run.name, run.config.seed, run.config.steps);
    }
    Ok(())
}
