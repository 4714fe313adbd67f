//! `gsscale-bench pareto`: what each knob costs in accuracy and saves in time, bytes and Gaussians.

use super::facts::Facts;
use super::knobs::{self, KNOBS, Knobs};
use super::sweep::{Planned, Surroundings, Sweep};
use clap::Parser;
use gsscale::base::error::InputError;
use gsscale::checkpoint::interval::CommitEvery;
use gsscale::config::choice::Choice;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::page::format::codec::Codec;
use gsscale::report::record::RunRecord;
use gsscale::report::results_log::ResultsLog;
use gsscale::report::sweep_page::sweep_page;
use gsscale::train::error::TrainError;
use gsscale::train::whole_file::write_whole;
use serde_json::Value;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  gsscale-bench pareto scans/village --out sweeps/village --list
  gsscale-bench pareto scans/village --out sweeps/village --steps 3000 --page-rows 128 --seeds 1,2,3
  gsscale-bench pareto scans/village --out sweeps/village --knobs sh,moments --max-runs 5
  gsscale-bench pareto scans/city --out sweeps/city --steps 300 --share 25 --knobs budget,order,codec --strategy none

Results are added to results.jsonl in --out run by run, and a sweep that is started again goes on where it stopped; the
page is pareto.html. Each run is a process of its own. Budget, page and codec need a drive: see --spill.";

/// File of results in the output folder.
const RESULTS: &str = "results.jsonl";
/// Steps of a run where none are given.
pub const STEPS_DEFAULT: u32 = 3000;
/// The SH degree rises after so many parts of a run where nothing else is said: band 3 is in use after three tenths.
const SH_RAISES: u32 = 10;

/// Sweeps the knobs of training one at a time and a few together, and draws PSNR and SSIM against what they take.
#[derive(Parser)]
#[command(name = "gsscale-bench pareto", bin_name = "gsscale-bench pareto", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), one with transforms.json, or Mega-NeRF's layout
    scene: PathBuf,
    /// Config file of the base; flags override it. Without one, steps are 3000 and --sh-every a tenth of the steps. Commits
    /// by the clock are made only with --commit-every
    #[arg(long)]
    config: Option<PathBuf>,
    /// Folder for the results and the page
    #[arg(long, short)]
    out: PathBuf,
    /// Knobs: optimizer, order, budget, page, codec, moments, sh, cap, resolution, steps, together [default: all]
    #[arg(long, value_delimiter = ',', value_name = "KNOB")]
    knobs: Vec<String>,
    /// Seeds. First the base runs with all of them, then every setting with the first, then with the second, and so on
    #[arg(long, value_delimiter = ',', default_value = "1,2,3", value_name = "N")]
    seeds: Vec<u64>,
    /// Settings are tried with this many of the seeds; the base with all
    #[arg(long, default_value_t = 1, value_name = "N")]
    setting_seeds: usize,
    /// Stop after so many runs; the next call goes on
    #[arg(long, value_name = "N")]
    max_runs: Option<usize>,
    /// Print the runs with an estimate of their time, and stop
    #[arg(long)]
    list: bool,
    /// Frames of the base, in percent of the pages; 0 = all pages in memory
    #[arg(long, default_value_t = 0.0, value_name = "P")]
    share: f64,
    /// Folder for pages that leave memory, on the drive to measure [default: spill in --out]
    #[arg(long, value_name = "DIR")]
    spill: Option<PathBuf>,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// Sweeps.
///
/// # Errors
/// Bad input, or the results cannot be written.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let names = match args.knobs.is_empty() {
        true => KNOBS.map(str::to_string).to_vec(),
        false => args.knobs.clone(),
    };
    knobs::check(&names)?;
    check_numbers(args)?;
    let config = bench_config(args.config.as_deref(), &args.keys)?;
    let (base, settings) = plan(args, &names, config)?;
    let runs = in_order(&base, &settings, &args.seeds, args.setting_seeds);
    if args.list {
        list(args, &runs, &Surroundings::of(&args.scene, &args.out, args.spill.as_deref())?)?;
        return Ok(());
    }
    let mut sweep = Sweep::open(&args.scene, &args.out, args.spill.as_deref(), &base.config, RESULTS)?;
    let open: Vec<&Planned> = runs.iter().filter(|r| sweep.log.done(&r.key(sweep.surroundings())).is_none()).collect();
    let done = runs.len() - open.len();
    let count = open.len().min(args.max_runs.unwrap_or(usize::MAX));
    eprintln!("{done} of {} runs are done; {count} to do now", runs.len());
    for (i, run) in open.iter().take(count).enumerate() {
        eprintln!("run {} of {count}: {} {}, seed {}", i + 1, run.knob, run.label, run.config.seed);
        let record = sweep.run(run)?;
        if let Some(problem) = &record.problem {
            eprintln!("warning: it failed: {problem}");
        }
        print(&serde_json::to_value(&record).unwrap_or_default());
        write_page(args, &base, &runs, &sweep)?;
    }
    write_page(args, &base, &runs, &sweep)?;
    eprintln!("{}", args.out.join("pareto.html").display());
    Ok(())
}

fn check_numbers(args: &Args) -> Result<(), TrainError> {
    if args.seeds.is_empty() || args.setting_seeds == 0 {
        return Err(InputError::new("--seeds", "there is no seed", "use --seeds 1,2,3 --setting-seeds 1").into());
    }
    if !(0.0..=100.0).contains(&args.share) {
        return Err(InputError::new("--share", "it must be 0 to 100", "use --share 25, or 0 for memory").into());
    }
    Ok(())
}

/// The config of a measurement whose runs are short by default.
///
/// # Errors
/// As for a run.
pub fn bench_config(file: Option<&Path>, keys: &TrainOverrides) -> Result<TrainConfig, TrainError> {
    let mut keys = keys.clone();
    if file.is_none() {
        let steps = *keys.steps.get_or_insert(STEPS_DEFAULT);
        // All bands are in use for most of a short run, as they are for nearly all of a long one.
        keys.sh_every.get_or_insert((steps / SH_RAISES).max(1));
    }
    // Commits go by the clock, and their bytes would count as the setting's.
    keys.commit_every.get_or_insert(CommitEvery::Seconds(0.0));
    super::settle(file, &keys)
}

/// The base with its order settled, and the settings beside it.
fn plan(args: &Args, names: &[String], mut config: TrainConfig) -> Result<(Planned, Vec<Planned>), TrainError> {
    (config.spill_dir, config.frames) = (String::new(), 0);
    // What is chosen by itself may change with the drive's mood.
    config.spill_codec.0.get_or_insert(Codec::Raw);
    let facts = Facts::of(&args.scene, &config)?;
    let frames = match args.share {
        0.0 => None,
        share => Some(facts.frames(share).ok_or_else(|| {
            let problem = format!(
                "{share} % of {} pages are too few: the largest view needs {} of the first {}, and views grow",
                facts.pages_at_end(),
                facts.largest_view,
                facts.pages
            );
            let least = facts.percent(facts.fewest_frames()).ceil();
            InputError::new("--share", problem, format!("use --share {least} or more, or smaller --page-rows"))
        })?),
    };
    if config.view_order.0.is_none() {
        config.view_order.0 = Some(facts.order(frames.unwrap_or(facts.pages), config.seed)?);
    }
    let base = Planned::base(&config);
    let base = match frames {
        Some(frames) => base.on_drive(frames),
        None => base,
    };
    let knobs = Knobs { scene: &args.scene, base: &base, facts: &facts, share: args.share };
    let settings = knobs.settings(names)?;
    Ok((base, settings))
}

/// The base with all seeds, then the settings seed by seed.
fn in_order(base: &Planned, settings: &[Planned], seeds: &[u64], setting_seeds: usize) -> Vec<Planned> {
    let with_seed = |run: &Planned, &seed: &u64| {
        let mut run = run.clone();
        run.config.seed = seed;
        run
    };
    let of_base = seeds.iter().map(|seed| with_seed(base, seed));
    let of_settings =
        seeds.iter().take(setting_seeds).flat_map(|seed| settings.iter().map(move |s| with_seed(s, seed)));
    of_base.chain(of_settings).collect()
}

/// Prints the runs, which of them are done, and how long the rest will take by those that are.
fn list(args: &Args, runs: &[Planned], surroundings: &Surroundings) -> Result<(), TrainError> {
    let records = ResultsLog::peek(&args.out.join(RESULTS))?;
    let done = |run: &Planned| {
        let key = run.key(surroundings);
        records.iter().rev().find(|r| r.key == key && r.problem.is_none())
    };
    let per_step: Vec<f64> =
        records.iter().filter(|r| r.problem.is_none()).map(|r| r.wall_seconds / f64::from(r.steps.max(1))).collect();
    let mean = (!per_step.is_empty()).then(|| per_step.iter().sum::<f64>() / per_step.len() as f64);
    let mut left = 0.0;
    for run in runs {
        let (name, steps) = (format!("{} {}", run.knob, run.label), f64::from(run.config.steps));
        let state = match (done(run), mean) {
            (Some(record), _) => format!("done in {:.0} s", record.wall_seconds),
            (None, Some(mean)) => {
                left += mean * steps;
                format!("about {:.0} s", mean * steps)
            }
            (None, None) => "to do".to_string(),
        };
        gsscale::say!("{name:<52} seed {:<4} {:>6} steps  {state}", run.config.seed, run.config.steps);
    }
    match mean {
        Some(_) => gsscale::say!("{} runs; about {:.0} min for those to do", runs.len(), left / 60.0),
        None => gsscale::say!("{} runs; no run is done yet, so there is no estimate: try --max-runs 1", runs.len()),
    }
    Ok(())
}

/// Draws the runs of this plan that are done.
fn write_page(args: &Args, base: &Planned, runs: &[Planned], sweep: &Sweep) -> Result<(), TrainError> {
    let (records, surroundings) = (sweep.log.records(), sweep.surroundings());
    let mut of_plan: Vec<RunRecord> = Vec::new();
    for run in runs {
        let key = run.key(surroundings);
        if let Some(record) = records.iter().rev().find(|r| r.key == key) {
            // One run may stand for two settings: it is named as the plan names it.
            of_plan.push(RunRecord { knob: run.knob.clone(), label: run.label.clone(), ..record.clone() });
        }
    }
    let config = &base.config;
    let place = if config.frames > 0 { format!("{} frames", config.frames) } else { "in memory".to_string() };
    let machine = of_plan.first().map_or(String::new(), |r| format!("; {} threads of {}", r.threads, r.cpu));
    let facts = format!(
        "base: {} steps, {}, {place}, pages of {} rows, SH {}, {}{machine}",
        config.steps,
        config.view_order.word(),
        config.page_rows,
        config.sh_degree,
        match (config.strategy.grows(), config.max_gaussians) {
            (false, _) => "no densification".to_string(),
            (_, 0) => "densification without a cap".to_string(),
            (_, cap) => format!("at most {cap} Gaussians"),
        },
    );
    let scene = args.scene.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let page = sweep_page(&scene, &facts, &of_plan);
    Ok(write_whole(&args.out.join("pareto.html"), page.as_bytes())?)
}
