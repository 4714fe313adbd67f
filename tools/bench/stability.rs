//! `gsscale-bench stability`: measures the loss of quality by faults of photos, poses and points, with and without remedies.

use super::sweep::{MadeScene, Planned, Surroundings, Sweep, SweepArgs};
use super::table::table;
use clap::Parser;
use clap::builder::PossibleValuesParser;
use gsscale::appearance::AppearanceMode;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::whole_file::write_whole;
use gsscale::config::choice::Chosen;
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::load_options;
use gsscale::dataset::disturb::{Disturbance, plan, write_disturbed};
use gsscale::dataset::loader::Dataset;
use gsscale::densify::strategy::StrategyName;
use gsscale::render::color_correct::ColorCorrect;
use gsscale::report::record::RunRecord;
use gsscale::report::results_log::successful_run;
use gsscale::report::stability_page::{CLEAN, Lost, NO_REMEDY, lost, spread_of_clean, stability_page};
use gsscale::schedule::order::Order;
use gsscale::train::error::TrainError;
use gsscale::train::inputs::prepare::prepare;
use serde_json::Value;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  gsscale-bench stability scans/village --out stability/village --list
  gsscale-bench stability scans/village --out stability/village --steps 1500 --max-resolution 400 --seeds 1,2,3
  gsscale-bench stability scans/village --out stability/village --only swapped10,boxes --remedies none,own

Disturbances: exposure05, exposure1 and exposure2 (photos brighter or darker by up to half a stop, a stop, two stops),
white-balance, swapped5 and swapped10 (photos that have changed places, percent), swapped10-removed (without these photos, as
by hand), poses005 and poses05 (noise on the places of cameras, percent of the scene), jpeg20 (quality), boxes (20 grey boxes
a photo), boxes-masked (with masks, as by hand), third (of the photos), points10 (a tenth of the points), points-random,
blurred10 (percent). Held-out photos stay clean.
Remedies: none; own, what is meant for the disturbance; all together.

Each run is a process of its own and adds a line to stability.jsonl in --out; the page is stability.html, and the end is a
table. A call that stopped continues when started again. Scenes are written to --out and removed after their runs.";

/// File of results in the output folder.
const RESULTS: &str = "stability.jsonl";
/// The remedies, in the order of the runs.
const REMEDIES: [&str; 3] = [NO_REMEDY, "own", "all"];

/// Change of a config.
type Change = fn(&mut TrainConfig);

/// Name of a disturbance, the disturbance, and its own remedy.
const DISTURBANCES: [(&str, Disturbance, Option<Change>); 17] = [
    (CLEAN, Disturbance::Nothing, None),
    ("exposure05", Disturbance::Exposure { stops: 0.5 }, Some(correct_exposure)),
    ("exposure1", Disturbance::Exposure { stops: 1.0 }, Some(correct_exposure)),
    ("exposure2", Disturbance::Exposure { stops: 2.0 }, Some(correct_exposure)),
    ("white-balance", Disturbance::WhiteBalance { stops: 0.3 }, Some(correct_colors)),
    ("swapped5", Disturbance::Swapped { share: 0.05, are_removed: false }, Some(leave_out_views)),
    ("swapped10", Disturbance::Swapped { share: 0.1, are_removed: false }, Some(leave_out_views)),
    ("swapped10-removed", Disturbance::Swapped { share: 0.1, are_removed: true }, None),
    ("poses005", Disturbance::PoseNoise { share: 0.0005 }, Some(refine_poses)),
    ("poses05", Disturbance::PoseNoise { share: 0.005 }, Some(refine_poses)),
    ("jpeg20", Disturbance::Jpeg { quality: 20 }, None),
    ("boxes", Disturbance::Boxes { count: 20, are_masked: false }, Some(mask_blocks)),
    ("boxes-masked", Disturbance::Boxes { count: 20, are_masked: true }, None),
    ("third", Disturbance::FewPhotos { one_in: 3 }, None),
    ("points10", Disturbance::FewPoints { one_in: 10 }, Some(adapt_to_few_points)),
    ("points-random", Disturbance::RandomPoints, Some(adapt_to_few_points)),
    ("blurred10", Disturbance::Blurred { one_in: 10 }, Some(leave_out_views)),
];

fn correct_exposure(config: &mut TrainConfig) {
    config.appearance = AppearanceMode::Exposure;
}

fn correct_colors(config: &mut TrainConfig) {
    config.appearance = AppearanceMode::Full;
}

fn leave_out_views(config: &mut TrainConfig) {
    config.robust_views = true;
}

fn refine_poses(config: &mut TrainConfig) {
    config.refine_poses = true;
}

fn mask_blocks(config: &mut TrainConfig) {
    config.robust_pixels = true;
}

fn adapt_to_few_points(config: &mut TrainConfig) {
    config.strategy = StrategyName::LongAxis;
    config.adapt_to_poor_points(|_| true);
}

fn all_remedies(config: &mut TrainConfig) {
    correct_exposure(config);
    leave_out_views(config);
    mask_blocks(config);
    refine_poses(config);
}

/// Disturbs a scene in the ways of real captures, trains each with and without remedies, and charts the decibels lost.
#[derive(Parser)]
#[command(name = "gsscale-bench stability", bin_name = "gsscale-bench stability", version, after_help = EXAMPLES)]
pub struct Args {
    #[command(flatten)]
    common: SweepArgs,
    /// Disturbances [default: all]. The clean scene always runs
    #[arg(long, value_delimiter = ',', value_name = "NAME", hide_default_value = true)]
    #[arg(default_values = DISTURBANCES.map(|d| d.0), value_parser = PossibleValuesParser::new(DISTURBANCES.map(|d| d.0)))]
    only: Vec<String>,
    /// Remedies
    #[arg(long, value_delimiter = ',', default_value = "none,own,all", value_name = "NAME")]
    #[arg(value_parser = PossibleValuesParser::new(REMEDIES))]
    remedies: Vec<String>,
    /// Seeds of disturbances and runs. All runs have the first seed, then the second
    #[arg(long, value_delimiter = ',', default_value = "1,2", value_name = "N")]
    seeds: Vec<u64>,
    /// Stop after this many runs; the next call continues
    #[arg(long, value_name = "N")]
    max_runs: Option<usize>,
    /// Print the runs and whether they are done, then stop
    #[arg(long)]
    list: bool,
}

/// A scene with the runs on it.
struct Disturbed {
    disturbance: Disturbance,
    seed: u64,
    folder: PathBuf,
    runs: Vec<Planned>,
}

/// Runs the measurement.
///
/// # Errors
/// The input is invalid, or the results cannot be written.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    if args.seeds.is_empty() {
        return Err(InputError::new("--seeds", "no seed is given", "use --seeds 1,2").into());
    }
    let given = args.common.base_config()?;
    if !given.init_ply.is_empty() {
        let problem = "the points of the scene are disturbed, not a PLY";
        return Err(InputError::new("--init-ply", problem, "leave it out").into());
    }
    let dataset = prepare(&args.common.scene, &given)?.dataset;
    let scenes = plan_all(args, &dataset, &given)?;
    let runs = || scenes.iter().flat_map(|scene| &scene.runs);
    if args.list {
        return list(args, runs());
    }
    let mut sweep = Sweep::open(&args.common, &base_config(&given), RESULTS)?;
    let is_open = |sweep: &Sweep, r: &Planned| successful_run(sweep.records(), &r.key(sweep.surroundings())).is_none();
    let open = runs().filter(|run| is_open(&sweep, run)).count();
    let mut left = open.min(args.max_runs.unwrap_or(usize::MAX));
    gsscale::tell!("{} of {} runs are done; {left} to do now", runs().count() - open, runs().count());
    for scene in &scenes {
        let open: Vec<&Planned> = scene.runs.iter().filter(|run| is_open(&sweep, run)).take(left).collect();
        if open.is_empty() {
            continue;
        }
        // Of an earlier call that was interrupted: the lock of the sweep says that nobody uses it.
        remove(&scene.folder)?;
        write_disturbed(&scene.folder, &dataset, &scene.disturbance, scene.seed)?;
        for run in &open {
            gsscale::tell!("{}, remedy {}, seed {}; {left} runs left", run.knob, run.label, run.config.seed);
            sweep.run(run, print)?;
            left -= 1;
            write_page(args, &records_of(runs(), &sweep))?;
        }
        remove(&scene.folder)?;
    }
    let records = records_of(runs(), &sweep);
    write_page(args, &records)?;
    if !args.common.json {
        gsscale::say!("{}", text_of(&records));
    }
    gsscale::tell!("done: {}", args.common.out.join("stability.html").display());
    Ok(())
}

/// The config of all runs, without remedies. The disturbed scenes have photos of training size and their own split.
fn base_config(given: &TrainConfig) -> TrainConfig {
    let plain = TrainConfig::default();
    TrainConfig {
        images: plain.images,
        data_factor: plain.data_factor,
        max_resolution: plain.max_resolution,
        masks: true,
        invert_masks: false,
        allow_missing: false,
        view_order: Chosen(given.view_order.0.or(Some(Order::Shuffle))),
        color_correct: Chosen(given.color_correct.0.or(Some(ColorCorrect::Affine))),
        spill_dir: String::new(),
        frames: 0,
        ..given.clone()
    }
}

/// The scenes in the order of their runs: seed by seed, the clean scene first.
fn plan_all(args: &Args, dataset: &Dataset, given: &TrainConfig) -> InputResult<Vec<Disturbed>> {
    let is_wanted = |name: &str| name == CLEAN || args.only.iter().any(|only| only == name);
    let mut scenes = Vec::new();
    for &seed in &args.seeds {
        for (name, disturbance, own) in DISTURBANCES.iter().filter(|d| is_wanted(d.0)) {
            let folder = args.common.out.join("scenes").join(format!("{name}-seed{seed}"));
            let made = plan(dataset, disturbance, seed)?;
            let how = format!("{disturbance:?} seed {seed} {:?}", load_options(given));
            let scene = MadeScene { folder: folder.clone(), how, wrong: made.wrong };
            let mut base = base_config(given);
            (base.seed, base.test_after) = (seed, i64::from(made.test_after));
            let runs = REMEDIES.into_iter().filter(|r| args.remedies.iter().any(|wanted| wanted == r));
            let runs = runs.filter_map(|remedy| {
                let mut config = base.clone();
                match remedy {
                    NO_REMEDY => {}
                    "own" => (*own)?(&mut config),
                    _ => all_remedies(&mut config),
                }
                let scene = Some(scene.clone());
                Some(Planned { scene, ..Planned::new(name, remedy, config) })
            });
            scenes.push(Disturbed { disturbance: *disturbance, seed, folder, runs: runs.collect() });
        }
    }
    Ok(scenes)
}

fn list<'a>(args: &Args, runs: impl Iterator<Item = &'a Planned>) -> Result<(), TrainError> {
    let records = gsscale::report::results_log::ResultsLog::peek(&args.common.out.join(RESULTS))?;
    let surroundings = Surroundings::of(&args.common)?;
    for run in runs {
        let state = match successful_run(&records, &run.key(&surroundings)) {
            Some(record) => format!("done in {:.0} s", record.wall_seconds),
            None => "to do".to_string(),
        };
        gsscale::say!(
            "{:<16} {:<6} seed {:<4} {:>6} steps  {state}",
            run.knob,
            run.label,
            run.config.seed,
            run.config.steps
        );
    }
    Ok(())
}

/// The runs of this plan that are done.
fn records_of<'a>(runs: impl Iterator<Item = &'a Planned>, sweep: &Sweep) -> Vec<RunRecord> {
    let of_run = |run: &Planned| {
        let key = run.key(sweep.surroundings());
        let record = sweep.records().iter().rev().find(|r| r.key == key)?;
        // Two remedies may be the same run; each has its own name.
        Some(RunRecord { knob: run.knob.clone(), label: run.label.clone(), ..record.clone() })
    };
    runs.filter_map(of_run).collect()
}

/// The figures as a table of at most 80 columns.
fn text_of(records: &[RunRecord]) -> String {
    let row = |l: &Lost| {
        vec![
            l.knob.clone(),
            l.remedy.clone(),
            format!("{:.2}", l.psnr),
            format!("{:+.2}", -l.lost.mean),
            format!("{:.2}", l.lost.width()),
            l.cc_lost.map_or(String::new(), |s| format!("{:+.2}", -s.mean)),
            l.named_text(),
        ]
    };
    let rows: Vec<Vec<String>> = lost(records).iter().map(row).collect();
    let names = ["disturbance", "remedy", "PSNR", "to clean", "spread", "affine", "named"];
    let spread = spread_of_clean(records).map_or(String::new(), |s| format!("\nspread of the clean scene: {s:.2} dB"));
    table(&names, 2, &rows) + &spread
}

fn write_page(args: &Args, records: &[RunRecord]) -> Result<(), TrainError> {
    let scene = args.common.scene.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let facts =
        records.first().map_or(String::new(), |r| format!("{} steps; {} threads of {}", r.steps, r.threads, r.cpu));
    let page = stability_page(&scene, &facts, records);
    Ok(write_whole(&args.common.out.join("stability.html"), page.as_bytes())?)
}

/// Removes the scene of an earlier call, if there is one.
fn remove(folder: &Path) -> InputResult<()> {
    match std::fs::remove_dir_all(folder) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(InputError::io(folder, "removing", &e)),
        _ => Ok(()),
    }
}
