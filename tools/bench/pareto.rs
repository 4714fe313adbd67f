//! `gsscale-bench pareto`: the cost of each knob in accuracy, and its savings in time, bytes and Gaussians.

use super::facts::Facts;
use super::knobs::{KNOBS, Knobs};
use super::sweep::{PACE_STEPS_DEFAULT, Planned, Surroundings, Sweep, SweepArgs, use_drive};
use super::table::{figure, table};
use clap::Parser;
use clap::builder::PossibleValuesParser;
use gsscale::base::error::InputError;
use gsscale::base::units::format_bytes;
use gsscale::base::whole_file::write_whole;
use gsscale::config::choice::Choice;
use gsscale::config::file::TrainConfig;
use gsscale::page::format::codec::Codec;
use gsscale::report::front::{Setting, Verdict, against, settings};
use gsscale::report::record::RunRecord;
use gsscale::report::results_log::{ResultsLog, successful_run};
use gsscale::report::sweep_page::sweep_page;
use gsscale::train::error::TrainError;
use serde_json::Value;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench pareto scans/village --out sweeps/village --list
  gsscale-bench pareto scans/village --out sweeps/village --steps 3000 --page-rows 128 --seeds 1,2,3
  gsscale-bench pareto scans/village --out sweeps/village --knobs sh,moments --max-runs 5
  gsscale-bench pareto scans/city --out sweeps/city --steps 300 --share 25 --knobs budget,order,codec --strategy none

Each run is a process of its own and adds a line to results.jsonl in --out; the page is pareto.html, and the end is a
table. A sweep that
stopped continues when started again. The knobs budget, page and codec need a drive: see --spill.";

/// File of results in the output folder.
const RESULTS: &str = "results.jsonl";

/// Changes one knob of training at a time, and a few together, and charts PSNR and SSIM against the costs.
#[derive(Parser)]
#[command(name = "gsscale-bench pareto", bin_name = "gsscale-bench pareto", version, after_help = EXAMPLES)]
pub struct Args {
    #[command(flatten)]
    common: SweepArgs,
    /// Knobs to change [default: all]
    #[arg(long, value_delimiter = ',', value_name = "KNOB", hide_default_value = true)]
    #[arg(default_values = KNOBS, value_parser = PossibleValuesParser::new(KNOBS))]
    knobs: Vec<String>,
    /// Seeds. The base runs first, with all seeds; then all settings run with the first seed, then with the second
    #[arg(long, value_delimiter = ',', default_value = "1,2,3", value_name = "N")]
    seeds: Vec<u64>,
    /// Seeds for each setting; the base uses all
    #[arg(long, default_value_t = 1, value_name = "N")]
    setting_seeds: usize,
    /// Stop after this many runs; the next call continues
    #[arg(long, value_name = "N")]
    max_runs: Option<usize>,
    /// Print the runs with an estimate of their time, then stop
    #[arg(long)]
    list: bool,
    /// Frames of the base, in percent of the pages; 0 = all pages in memory
    #[arg(long, default_value_t = 0.0, value_name = "P")]
    share: f64,
    /// Train the base for this many steps before and after each run, and convert times to one pace of the machine where every run has
    /// these; 0 = do neither
    #[arg(long, default_value_t = PACE_STEPS_DEFAULT, value_name = "N")]
    pace_steps: u32,
}

/// Runs the sweep.
///
/// # Errors
/// The input is invalid, or the results cannot be written.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    check_numbers(args)?;
    let (base, settings) = plan(args, args.common.base_config()?)?;
    let runs = in_order(&base, &settings, &args.seeds, args.setting_seeds);
    if args.list {
        return list(args, &runs, &Surroundings::of(&args.common)?);
    }
    let mut sweep = Sweep::open(&args.common, &base.config, RESULTS)?.with_pace(args.pace_steps);
    let is_open = |r: &&Planned| successful_run(sweep.records(), &r.key(sweep.surroundings())).is_none();
    let open: Vec<&Planned> = runs.iter().filter(is_open).collect();
    let done = runs.len() - open.len();
    let count = open.len().min(args.max_runs.unwrap_or(usize::MAX));
    gsscale::tell!("{done} of {} runs are done; {count} to do now", runs.len());
    for (i, run) in open.iter().take(count).enumerate() {
        gsscale::tell!("run {} of {count}: {} {}, seed {}", i + 1, run.knob, run.label, run.config.seed);
        sweep.run(run, print)?;
        write_page(args, &base, &runs, &sweep)?;
    }
    write_page(args, &base, &runs, &sweep)?;
    if !args.common.json {
        let (records, times) = of_plan(&runs, &sweep);
        gsscale::say!("{}", text_of(&records));
        gsscale::tell!("{times}");
    }
    gsscale::tell!("done: {}", args.common.out.join("pareto.html").display());
    Ok(())
}

fn check_numbers(args: &Args) -> Result<(), TrainError> {
    if args.seeds.is_empty() || args.setting_seeds == 0 {
        return Err(InputError::new("--seeds", "no seed is given", "use --seeds 1,2,3 --setting-seeds 1").into());
    }
    if !(0.0..=100.0).contains(&args.share) {
        let remedy = "use --share 25, or 0 for all pages in memory";
        return Err(InputError::new("--share", "the value must be 0 to 100", remedy).into());
    }
    Ok(())
}

/// The base with a resolved order of views, and the settings.
fn plan(args: &Args, mut config: TrainConfig) -> Result<(Planned, Vec<Planned>), TrainError> {
    (config.spill_dir, config.frames) = (String::new(), 0);
    // An automatic choice may differ from run to run, because it measures the drive.
    config.spill_codec.0.get_or_insert(Codec::Raw);
    let facts = Facts::of(&args.common.scene, &config)?;
    let frames = match args.share {
        0.0 => None,
        share => Some(facts.frames(share).ok_or_else(|| {
            let problem = format!(
                "{share} % of {} pages is too small: the largest view needs {} of the first {} pages, and views grow",
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
    if let Some(frames) = frames {
        use_drive(&mut config, frames);
    }
    let knobs = Knobs { scene: &args.common.scene, base: &config, facts: &facts, share: args.share };
    let settings = knobs.settings(&args.knobs)?;
    Ok((Planned::new("base", "base", config), settings))
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

/// Prints the runs and which of them are done, and estimates the time of the others from those that are done.
fn list(args: &Args, runs: &[Planned], surroundings: &Surroundings) -> Result<(), TrainError> {
    let records = ResultsLog::peek(&args.common.out.join(RESULTS))?;
    let per_step: Vec<f64> =
        records.iter().filter(|r| r.problem.is_none()).map(|r| r.wall_seconds / f64::from(r.steps.max(1))).collect();
    let mean = (!per_step.is_empty()).then(|| per_step.iter().sum::<f64>() / per_step.len() as f64);
    let mut left = 0.0;
    for run in runs {
        let (name, steps) = (format!("{} {}", run.knob, run.label), f64::from(run.config.steps));
        let state = match (successful_run(&records, &run.key(surroundings)), mean) {
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
        Some(_) => gsscale::say!("{} runs; about {:.0} min for the runs to do", runs.len(), left / 60.0),
        None => gsscale::say!("{} runs; an estimate needs one finished run: use --max-runs 1", runs.len()),
    }
    Ok(())
}

/// The runs of this plan that are done. Two settings may share a run; each has the name of the planned setting.
/// Times are converted to one pace of the machine, if possible; also returns what the times are.
fn of_plan(runs: &[Planned], sweep: &Sweep) -> (Vec<RunRecord>, &'static str) {
    let of_run = |run: &Planned| {
        let key = run.key(sweep.surroundings());
        let record = sweep.records().iter().rev().find(|r| r.key == key)?;
        Some(RunRecord { knob: run.knob.clone(), label: run.label.clone(), ..record.clone() })
    };
    let mut records: Vec<RunRecord> = runs.iter().filter_map(of_run).collect();
    let times = sweep.convert_times(&mut records);
    (records, times)
}

/// The settings as a table: means over seeds.
fn text_of(records: &[RunRecord]) -> String {
    let settings = settings(records);
    let base = settings.first().filter(|s| s.verdict == Verdict::Base);
    let row = |s: &Setting| {
        let difference = base.filter(|_| s.verdict != Verdict::Base).and_then(|base| against(s, base, |r| r.psnr));
        let bytes = |of: fn(&RunRecord) -> u64| {
            s.mean(|r| Some(of(r) as f64)).map_or(String::new(), |b| format_bytes(b as u64))
        };
        vec![
            s.knob.clone(),
            s.label.clone(),
            figure(s.psnr.map(|p| p.mean), 2),
            difference.map_or(String::new(), |d| format!("{d:+.2}")),
            figure(s.ssim.map(|p| p.mean), 3),
            figure(s.mean(|r| Some(r.seconds)), 1),
            bytes(|r| r.host_bytes_peak),
            bytes(RunRecord::bytes_moved),
            s.verdict.words().to_string(),
        ]
    };
    let rows: Vec<Vec<String>> = settings.iter().map(row).collect();
    let names = ["knob", "setting", "PSNR", "to base", "SSIM", "seconds", "peak", "moved", "accuracy"];
    table(&names, 2, &rows)
}

/// Writes the page of the runs of this plan that are done.
fn write_page(args: &Args, base: &Planned, runs: &[Planned], sweep: &Sweep) -> Result<(), TrainError> {
    let (of_plan, times) = of_plan(runs, sweep);
    let config = &base.config;
    let place = if config.frames > 0 { format!("{} frames", config.frames) } else { "in memory".to_string() };
    let machine = of_plan.first().map_or(String::new(), |r| format!("; {} threads of {}", r.threads, r.cpu));
    let facts = format!(
        "base: {} steps, {}, {place}, pages of {} rows, SH {}, {}{machine}; {times}",
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
    let scene = args.common.scene.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let page = sweep_page(&scene, &facts, &of_plan);
    Ok(write_whole(&args.common.out.join("pareto.html"), page.as_bytes())?)
}
