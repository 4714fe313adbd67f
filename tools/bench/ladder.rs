//! `gsscale-bench ladder`: what each idea of out-of-core training brings, one added to the other.
//!
//! Every rung trains the same steps on the same views in a process of its own. All but the first end with the same bits;
//! the first, which rewrites every Gaussian at every step, differs by roundings.

use super::facts::Facts;
use super::pareto::bench_config;
use super::sweep::{Planned, Sweep};
use clap::Parser;
use gsscale::base::error::InputError;
use gsscale::config::choice::Choice;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::optim::method::Method;
use gsscale::page::format::codec::Codec;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::timing::Transfers;
use gsscale::report::ladder_page::{LadderRung, ladder_page};
use gsscale::schedule::order::Order;
use gsscale::train::error::TrainError;
use gsscale::train::whole_file::write_whole;
use serde_json::Value;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench ladder scans/village --out ladders/village --steps 3000 --strategy none --page-rows 128
  gsscale-bench ladder scans/city --out ladders/city --steps 300 --strategy none --share 25 --view-order groups:25

Rungs: naive (every Gaussian updated at every step, pages fetched when needed, the least recently used leaves), deferred
(only what a view sees is touched), planned (the page whose next use is farthest leaves, pages are fetched before their
step), overlap (while the step before computes), memory. All train on the views in the same order, which is a shuffle
unless --view-order says otherwise. The page is ladder.html; ladder.jsonl keeps the figures, and rungs that are in it are
not run again.";

/// File of results in the output folder.
const RESULTS: &str = "ladder.jsonl";

/// Trains a scene on each rung from naive offloading to all in memory, and draws what each takes.
#[derive(Parser)]
#[command(name = "gsscale-bench ladder", bin_name = "gsscale-bench ladder", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene: a COLMAP folder (images/, sparse/), one with transforms.json, or Mega-NeRF's layout
    scene: PathBuf,
    /// Config file; flags override it. Without one, steps are 3000 and --sh-every a tenth of the steps. Commits by the clock
    /// are made only with --commit-every
    #[arg(long)]
    config: Option<PathBuf>,
    /// Folder for the results and the page
    #[arg(long, short)]
    out: PathBuf,
    /// Frames in percent of the pages, for all rungs but the last; raised to what the largest view needs
    #[arg(long, default_value_t = 50.0, value_name = "P")]
    share: f64,
    /// Rungs: naive, deferred, planned, overlap, memory [default: all]
    #[arg(long, value_delimiter = ',', value_name = "RUNG")]
    rungs: Vec<String>,
    /// Folder for pages that leave memory, on the drive to measure [default: spill in --out]
    #[arg(long, value_name = "DIR")]
    spill: Option<PathBuf>,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// A rung: its name, what it is, and how it differs from all pages on the drive by the best means.
struct Rung {
    name: &'static str,
    what: &'static str,
    turn: fn(&mut TrainConfig),
}

const RUNGS: [Rung; 5] = [
    Rung {
        name: "naive",
        what: "naive offloading: dense updates, pages on demand, LRU",
        turn: |c| {
            c.optimizer = Method::Dense;
            (c.transfers, c.evict) = (Transfers::Demand, EvictPolicy::LeastRecentlyUsed);
        },
    },
    Rung {
        name: "deferred",
        what: "+ deferred Adam",
        turn: |c| (c.transfers, c.evict) = (Transfers::Demand, EvictPolicy::LeastRecentlyUsed),
    },
    Rung { name: "planned", what: "+ planned cache and prefetch", turn: |c| c.transfers = Transfers::Ahead },
    Rung { name: "overlap", what: "+ overlap with compute", turn: |_| {} },
    Rung { name: "memory", what: "all in memory", turn: |c| (c.spill_dir, c.frames) = (String::new(), 0) },
];

/// Rungs of GS-Scale's figure that this program does not have.
const NOT_BUILT: [&str; 3] =
    ["selective offloading: geometry stays on the device", "forwarding of parameters in chunks", "image splitting"];

/// Climbs.
///
/// # Errors
/// Bad input, or the results cannot be written.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    if let Some(name) = args.rungs.iter().find(|n| RUNGS.iter().all(|r| r.name != n.as_str())) {
        let names = RUNGS.map(|r| r.name).join(",");
        return Err(InputError::new("--rungs", format!("'{name}' is no rung"), format!("use some of: {names}")).into());
    }
    if !(args.share > 0.0 && args.share < 100.0) {
        return Err(InputError::new("--share", "it must be above 0 and below 100", "use --share 50").into());
    }
    let mut config = bench_config(args.config.as_deref(), &args.keys)?;
    settle(&mut config);
    let facts = Facts::of(&args.scene, &config)?;
    let frames = facts.frames(args.share).unwrap_or_else(|| facts.fewest_frames());
    if frames >= facts.pages_at_end() {
        let problem = format!(
            "the largest view needs {} of {} pages: nothing would leave memory",
            facts.largest_view, facts.pages
        );
        return Err(InputError::new(
            &args.scene,
            problem,
            "use smaller --page-rows, or a scene that views see less of",
        )
        .into());
    }
    let facts = format!(
        "{}: {} steps, {} Gaussians in {} pages of {} rows, the largest view needs {}; {frames} frames; order {}",
        args.scene.display(),
        config.steps,
        facts.gaussians,
        facts.pages,
        config.page_rows,
        facts.largest_view,
        config.view_order.word(),
    );
    eprintln!("{facts}");
    let base = Planned::base(&config).on_drive(frames);
    let mut sweep = Sweep::open(&args.scene, &args.out, args.spill.as_deref(), &base.config, RESULTS)?;
    let mut done = Vec::new();
    for rung in RUNGS.iter().filter(|r| args.rungs.is_empty() || args.rungs.iter().any(|n| n == r.name)) {
        let mut planned = Planned { knob: "ladder".into(), label: rung.name.into(), ..base.clone() };
        (rung.turn)(&mut planned.config);
        eprintln!("{}: {}", rung.name, rung.what);
        let record = sweep.run(&planned)?;
        if let Some(problem) = &record.problem {
            eprintln!("warning: it failed: {problem}");
        }
        print(&serde_json::to_value(&record).unwrap_or_default());
        done.push(LadderRung { name: rung.name.into(), what: rung.what.into(), record });
        let page = ladder_page(&facts, &done, &NOT_BUILT);
        write_whole(&args.out.join("ladder.html"), page.as_bytes())?;
    }
    eprintln!("{}", args.out.join("ladder.html").display());
    Ok(())
}

/// What must be the same on every rung, whatever it would choose by itself.
fn settle(config: &mut TrainConfig) {
    (config.spill_dir, config.frames) = (String::new(), 0);
    config.view_order.0.get_or_insert(Order::Shuffle);
    config.spill_codec.0.get_or_insert(Codec::Raw);
    // What rungs differ in, each names for itself.
    let best = TrainConfig::default();
    (config.optimizer, config.evict, config.transfers) = (best.optimizer, best.evict, best.transfers);
}
