//! `gsscale-bench run NAME --data DIR`: trains a published scene and prints our figures beside the published figures.
//!
//! Checks the dataset's folder, trains through `train::run::begin` (as `gsscale-train` does), evaluates, and compares the
//! figures (`published_table`). Writes only the output folder and the pages in `--spill-dir`.

use super::published_table::{Comparison, Ours};
use super::read_json;
use clap::Parser;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::machine::reset_host_bytes_peak;
use gsscale::base::say::shell_word;
use gsscale::base::text::read_text;
use gsscale::base::units::counted;
use gsscale::base::whole_file::write_whole;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::{load_options, read_options, simd_path};
use gsscale::config::new_run;
use gsscale::config::published::{BUILT_IN, PublishedRun, differences};
use gsscale::config::values::Chosen;
use gsscale::dataset::layout::{Layout, find_layout};
use gsscale::dataset::loader::target_size;
use gsscale::dataset::model::{RawView, Split};
use gsscale::dataset::photo_header::read_header;
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::render::lpips::InputRange;
use gsscale::render::lpips::weights::read_lpips;
use gsscale::report::run_files::{BEGUN_FILE, CONFIG_FILE, PUBLISHED_FILE, PUBLISHED_PAGE_FILE, SUMMARY_FILE};
use gsscale::train::error::TrainError;
use gsscale::train::log::report::Summary;
use gsscale::train::run::begin::run;
use gsscale::train::run::eval_file::{EvalExtras, evaluate_file};
use gsscale::train::run::request::{Existing, RunRequest};
use gsscale::train::state::trainer::Trainer;
use serde_json::Value;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench run rubble --data /data/rubble-pixsfm --dry-run        is the folder complete? what would it take?
  gsscale-bench run rubble --data /data/rubble-pixsfm --out runs/rubble --lpips lpips_alex.safetensors
  gsscale-bench run rubble --data /data/rubble-pixsfm --with-defaults --steps 30000      are the published settings the better ones?
  gsscale-bench run building --data /data/building-pixsfm --tier S3 --spill-dir /nvme/pages --host-mem 12GiB
  gsscale-train --resume runs/rubble && gsscale-bench run rubble --data /data/rubble-pixsfm --out runs/rubble --no-train

Runs: rubble, building, residence, sciart, lfls, sziit, sztu, aerial. Standard output gets the figures as a line of
JSON; OUT/published.json and OUT/published.html keep them.";

/// Folder, inside the output folder, of the run with the defaults of gsscale.
const DEFAULTS_FOLDER: &str = "defaults";

/// Trains a published run and prints our figures beside the published ones.
#[derive(Parser)]
#[command(name = "gsscale-bench run", version, after_help = EXAMPLES)]
pub struct Args {
    /// Name of a published run, or a config file with a table `published`
    run: PathBuf,
    /// Folder of the dataset
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Output folder [default: runs/NAME]
    #[arg(long, short)]
    out: Option<PathBuf>,
    /// Densification tier of the config, S0 (fewest Gaussians) to S5 (most)
    #[arg(long)]
    tier: Option<String>,
    /// Also measure LPIPS, with these weights (safetensors; see tools/README.md)
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    /// Input range of the LPIPS network: signed (-1..1) or unit (0..1)
    #[arg(long, default_value = "signed", value_name = "RANGE")]
    lpips_range: InputRange,
    /// Also train with gsscale's own defaults, on the same photos; results go to the folder `defaults` in the output folder
    #[arg(long, conflicts_with = "dry_run")]
    with_defaults: bool,
    /// Check the folder, print the setup and the memory of the run, then stop
    #[arg(long)]
    dry_run: bool,
    /// Evaluate the results in the output folder instead of training; --with-defaults still trains its run if there is none
    #[arg(long, conflicts_with_all = ["dry_run", "overwrite", "tier"])]
    no_train: bool,
    /// Replace the results of an earlier run in the output folder
    #[arg(long)]
    overwrite: bool,
    /// Print only warnings, errors and the line of JSON
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// Whether these arguments (the program's name first) request a published run: they contain `--data`, or start with the
/// name of a published run or a config file.
pub fn is_published_run(arguments: &[OsString]) -> bool {
    let is_run =
        |a: &OsString| BUILT_IN.iter().any(|(name, _)| a == name) || Path::new(a).extension() == Some("toml".as_ref());
    let is_data = |a: &OsString| a.to_str().is_some_and(|a| a == "--data" || a.starts_with("--data="));
    arguments.get(1).is_some_and(is_run) || arguments.iter().any(is_data)
}

/// The setup of a run, before training.
struct Setting {
    run: PublishedRun,
    layout: Layout,
    /// The published config, with the point cloud that was found.
    published: TrainConfig,
    out: PathBuf,
    /// Differences to the published run, which make the figures incomparable.
    caveats: Vec<String>,
}

/// Runs the command. Errors: the folder is incomplete, or the run fails.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<ExitCode, TrainError> {
    let mut run = PublishedRun::find(&args.run)?;
    let out = args.out.clone().unwrap_or_else(|| Path::new("runs").join(&run.name));
    let finished = if args.no_train { Some(config_of_ended(&out)?) } else { None };
    // With --no-train, the tier is that of the finished run.
    let of_finished = finished.as_ref().and_then(|config| run.tier_of(config)).map(str::to_string);
    if let Some(tier) = args.tier.clone().or(of_finished) {
        run.use_tier(&tier)?;
    }
    let mut setting = settle(run, args, out)?;
    let mut config = finished.unwrap_or_else(|| setting.published.clone());
    args.keys.clone().apply(&mut config);
    config.check()?;
    if let Some(weights) = &args.lpips {
        // Hours of training come before their use.
        read_lpips(weights, simd_path(&config))?;
    }
    setting.caveats.extend(differences(&setting.published, &config));
    check_photos(args, &config, &mut setting)?;
    if !args.quiet {
        let (name, title, data) = (&setting.run.name, &setting.run.facts.title, args.data.display());
        let (tier, layout) = (setting.run.tier_of(&config).unwrap_or("none"), setting.layout.name());
        gsscale::tell!("run     {name} ({title}), tier {tier}, {data} laid out as {layout}");
        for caveat in &setting.caveats {
            gsscale::tell!("warning: not the published run: {caveat}");
        }
    }
    let trained =
        if args.no_train { Ok(read_summary(&setting.out)?) } else { train(args, (&setting, &setting.out), &config)? };
    let summary = match trained {
        Ok(summary) => summary,
        Err(code) => return Ok(code),
    };
    if !summary.finished {
        setting.caveats.push(format!("the run stopped after {} steps", summary.steps));
    }
    let ours = measure(args, &setting.out, &config, summary)?;
    let with_defaults = match args.with_defaults {
        true => match run_with_defaults(args, &setting, &config)? {
            Ok(ours) => Some(ours),
            Err(code) => return Ok(code),
        },
        false => None,
    };
    let comparison = Comparison {
        run: &setting.run,
        tier: setting.run.tier_of(&config),
        layout: setting.layout.name(),
        data: &args.data,
        out: &setting.out,
        caveats: &setting.caveats,
        ours: &ours,
        with_defaults: with_defaults.as_ref(),
    };
    let json = comparison.json();
    write_whole(&setting.out.join(PUBLISHED_FILE), format!("{json:#}\n").as_bytes())?;
    write_whole(&setting.out.join(PUBLISHED_PAGE_FILE), comparison.page().as_bytes())?;
    if !args.quiet {
        gsscale::tell!("{}", comparison.text());
    }
    print(&json);
    Ok(ExitCode::SUCCESS)
}

/// Finds the layout of the folder and its point cloud.
fn settle(run: PublishedRun, args: &Args, out: PathBuf) -> InputResult<Setting> {
    let parse = |name: &String| {
        let refuse = |problem| InputError::new(&args.run, problem, "correct the config").at("layouts");
        name.parse::<Layout>().map_err(refuse)
    };
    let layouts: Vec<Layout> = run.facts.layouts.iter().map(parse).collect::<InputResult<_>>()?;
    if layouts.is_empty() {
        return Err(InputError::new(&args.run, "no layout is given", "add one, such as \"colmap\"").at("layouts"));
    }
    let layout = find_layout(&args.data, &layouts, &run.facts.fetch)?;
    let mut published = run.config.clone();
    let mut caveats = Vec::new();
    let cloud = run.facts.clouds.iter().map(|name| args.data.join(name)).find(|path| path.is_file());
    if let Some(cloud) = cloud {
        let cloud = std::path::absolute(&cloud).map_err(|e| InputError::io(&cloud, "finding the cloud", &e))?;
        published.init_ply = cloud.to_string_lossy().into_owned();
    } else if layout == Layout::Colmap && !run.facts.clouds.is_empty() {
        let places = run.facts.clouds.join(", ");
        caveats.push(format!("starts from the model's own points: the published point cloud is missing ({places})"));
    }
    Ok(Setting { run, layout, published, out, caveats })
}

/// Compares the folder with the published run: photos, held-out photos, size of photos, points.
fn check_photos(args: &Args, config: &TrainConfig, setting: &mut Setting) -> InputResult<()> {
    let raw = read_scene(&args.data, &ReadOptions { points_later: true, ..read_options(config) })?;
    let (facts, caveats) = (&setting.run.facts, &mut setting.caveats);
    let list = match config.views_file.as_str() {
        "" => None,
        file => Some(read_text(Path::new(file), 1 << 30, "give a file with the name of a photo on each line")?),
    };
    let listed: Option<BTreeSet<&str>> = list.as_deref().map(|text| text.lines().collect());
    let is_used = |view: &RawView| listed.as_ref().is_none_or(|names| names.contains(view.name.as_str()));
    // A views file takes photos away and moves none to the other set.
    let used: Vec<(usize, &RawView)> = raw.views.iter().enumerate().filter(|(_, view)| is_used(view)).collect();
    let held_out = used.iter().filter(|(i, view)| is_held_out(*i, view, config)).count();
    for (what, published, found) in [("photo", facts.views, used.len()), ("held-out photo", facts.held_out, held_out)] {
        if let Some(published) = published.filter(|&n| n as usize != found) {
            caveats.push(format!("{} instead of {published}", counted(found as u64, what)));
        }
    }
    // The loader refuses a photo without a header.
    let header = used.iter().find(|(_, view)| view.image_path.is_file()).map(|(_, view)| read_header(&view.image_path));
    if let (Some([w, h]), Some(Ok(header))) = (facts.size, header) {
        let (options, stored) = (load_options(config), (header.width, header.height));
        let trained_on = target_size(stored, options.data_factor, options.max_resolution);
        // Undistortion and rounding change the size by a few pixels; another set of photos differs by more.
        let is_near = |own: u32, published: u32| (f64::from(own) / f64::from(published) - 1.0).abs() <= 0.01;
        let is_published = |size: (u32, u32)| is_near(size.0, w) && is_near(size.1, h);
        if !is_published(trained_on) {
            let is_reduced = config.data_factor > 1.0 && is_published(stored);
            let remedy = if is_reduced { ": the photos are reduced already: use --data-factor 1" } else { "" };
            caveats.push(format!("photos of {}x{} instead of {w}x{h}{remedy}", trained_on.0, trained_on.1));
        }
    }
    if raw.points_path.is_none() && raw.points.positions.is_empty() && config.init_ply.is_empty() {
        caveats.push("starts from random points: the folder has no points".to_string());
    }
    Ok(())
}

/// Whether the view with this index in the scene is held out.
fn is_held_out(index: usize, view: &RawView, config: &TrainConfig) -> bool {
    match (view.split, u32::try_from(config.test_after), config.test_every) {
        (Some(split), _, _) => split == Split::Test,
        (None, Ok(after), _) => index > after as usize,
        (None, Err(_), 0) => false,
        (None, Err(_), every) => index.is_multiple_of(every as usize),
    }
}

/// Trains to the end, into `out`. A dry run and a stopped run return only an exit code.
fn train(
    args: &Args,
    (setting, out): (&Setting, &Path),
    config: &TrainConfig,
) -> Result<Result<Summary, ExitCode>, TrainError> {
    let outcome = run(&RunRequest {
        scene: args.data.clone(),
        out: out.to_path_buf(),
        // Figures without training come from the PLY, which therefore holds all Gaussians.
        config: TrainConfig { export_clean: Chosen(config.export_clean.0.or(Some(false))), ..config.clone() },
        dry_run: args.dry_run,
        existing: if args.overwrite { Existing::Overwrite } else { Existing::Refuse },
        quiet: args.quiet,
        live: None,
        leg: None,
    })?;
    if outcome.exit_code == 0 {
        return Ok(outcome.summary.ok_or(ExitCode::SUCCESS));
    }
    let [name, data, all] = [&args.run, &args.data, &setting.out].map(shell_word);
    let resume = format!("gsscale-train --resume {}", shell_word(out));
    let mut more = String::new();
    if args.with_defaults {
        more.push_str(" --with-defaults");
        // The command trains the run with the defaults if that has not begun.
        for (key, value) in new_run::given_keys(None, &args.keys)? {
            let value = value.as_str().map_or_else(|| value.to_string().replace(['[', ']', ' '], ""), str::to_string);
            more.push_str(&format!(" {}", shell_word(format!("--{key}={value}"))));
        }
    }
    if let Some(weights) = &args.lpips {
        more.push_str(&format!(" --lpips {} --lpips-range {}", shell_word(weights), args.lpips_range.name()));
    }
    gsscale::tell!(
        "stopped; to go on: {resume}; for the table: gsscale-bench run {name} --data {data} --out {all}{more} --no-train"
    );
    Ok(Err(ExitCode::from(outcome.exit_code as u8)))
}

/// The run with the defaults of gsscale: photos, held-out photos, first points and the variant of SSIM are those of `first`, the config of
/// the other run.
fn run_with_defaults(
    args: &Args,
    setting: &Setting,
    first: &TrainConfig,
) -> Result<Result<Ours, ExitCode>, TrainError> {
    let out = setting.out.join(DEFAULTS_FOLDER);
    if args.no_train && has_run(&out) {
        let config = config_of_ended(&out)?;
        return Ok(Ok(measure(args, &out, &config, read_summary(&out)?)?));
    }
    let mut keys = args.keys.clone();
    keys.data_factor.get_or_insert(first.data_factor);
    keys.test_every.get_or_insert(first.test_every);
    keys.test_after.get_or_insert(first.test_after);
    keys.init_ply.get_or_insert_with(|| first.init_ply.clone());
    keys.ssim_variant.get_or_insert(first.ssim_variant);
    let config = new_run::of_new_run(None, &keys)?;
    config.check()?;
    if !args.quiet {
        let why = if args.no_train { ", which holds no run yet" } else { "" };
        gsscale::tell!("run     the same photos with the defaults of gsscale, into {}{why}", out.display());
    }
    reset_host_bytes_peak();
    Ok(match train(args, (setting, &out), &config)? {
        Ok(summary) => Ok(measure(args, &out, &config, summary)?),
        Err(code) => Err(code),
    })
}

fn has_run(out: &Path) -> bool {
    [CONFIG_FILE, BEGUN_FILE].iter().any(|name| out.join(name).exists())
}

/// The config of a run for its figures. Errors: there is no run, or it has not ended.
fn config_of_ended(out: &Path) -> InputResult<TrainConfig> {
    if !has_run(out) {
        return Err(InputError::new(out, "there is no run in this folder", "leave out --no-train"));
    }
    if !out.join(SUMMARY_FILE).exists() {
        let remedy = format!("gsscale-train --resume {}, then this command again", shell_word(out));
        return Err(InputError::new(out, "the run in this folder has not ended", remedy));
    }
    TrainConfig::read(&out.join(CONFIG_FILE))
}

fn read_summary(out: &Path) -> InputResult<Summary> {
    read_json(&out.join(SUMMARY_FILE), "use the output folder of a run")
}

/// Our figures, from the run's summary or, for LPIPS and --no-train, from an evaluation of the PLY.
fn measure(args: &Args, out: &Path, config: &TrainConfig, summary: Summary) -> Result<Ours, TrainError> {
    let mut ours = Ours::new(summary, config);
    if args.lpips.is_some() || args.no_train {
        let extras =
            EvalExtras { lpips: args.lpips.as_deref().map(|file| (file, args.lpips_range)), ..EvalExtras::default() };
        let report = evaluate_file(&Trainer::ply_path(out), &args.data, config, &extras)?;
        (ours.test, ours.lpips_variant) = (report.test, report.lpips_variant);
    }
    Ok(ours)
}
