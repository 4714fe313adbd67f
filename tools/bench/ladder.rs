//! `gsscale-bench ladder`: the gain of each idea of out-of-core training, added one by one.
//!
//! Every rung trains the same steps on the same views in a process of its own. Rungs that round alike end with the same bits
//! ([`Rounding`]): all on the host but the first, which rewrites every Gaussian at every step; and those on a device.

use super::facts::Facts;
use super::sweep::{PACE_STEPS_DEFAULT, Planned, Sweep, SweepArgs, use_drive};
use super::table::{figure, table};
use clap::Parser;
use clap::builder::PossibleValuesParser;
use gsscale::base::error::InputError;
use gsscale::base::units::format_bytes;
use gsscale::base::whole_file::write_whole;
use gsscale::config::choice::{Choice, Chosen};
use gsscale::config::file::TrainConfig;
use gsscale::config::values::ByteSize;
use gsscale::optim::method::{Method, OptimizerPlace};
use gsscale::page::format::codec::Codec;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::timing::Transfers;
use gsscale::report::ladder_page::{LadderRung, Rounding, ladder_page};
use gsscale::report::record::RunRecord;
use gsscale::schedule::order::Order;
use gsscale::train::error::TrainError;
use serde_json::Value;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench ladder scans/village --out ladders/village --steps 3000 --strategy none --page-rows 128
  gsscale-bench ladder scans/city --out ladders/city --steps 300 --strategy none --share 25 --view-order groups:25
  gsscale-bench ladder scans/city --out ladders/gpu --rungs overlap,pages,ahead,split,resident --device gpu --device-mem 4GiB

Rungs:
  naive      every step updates every Gaussian; pages are read on demand; the least recently used page is evicted
  deferred   a step touches only the Gaussians in view
  planned    pages are prefetched before their step; the page with the farthest next use is evicted
  overlap    reads and writes overlap with compute
  memory     all pages are in memory
  pages      as overlap, with the pages of --device-mem on the GPU, which updates them (--device gpu)
  ahead      a step is submitted before the numbers of the last one are waited for (--device gpu)
  split      as ahead with half of --device-mem: a view that does not fit is drawn in parts (--device gpu)
  resident   all pages are in memory and on the GPU (--device gpu)

Without --rungs, the first five run.
All rungs use the same order of views, a shuffle without --view-order. The page is ladder.html. Figures go to
ladder.jsonl, and a rung in that file does not run again.";

/// File of results in the output folder.
const RESULTS: &str = "ladder.jsonl";

/// Trains a scene on each rung, from naive offloading to all pages in memory, and charts the costs.
#[derive(Parser)]
#[command(name = "gsscale-bench ladder", bin_name = "gsscale-bench ladder", version, after_help = EXAMPLES)]
pub struct Args {
    #[command(flatten)]
    common: SweepArgs,
    /// Frames in percent of the pages, for all rungs but the last; raised to the need of the largest view
    #[arg(long, default_value_t = 50.0, value_name = "P")]
    share: f64,
    /// Train the base for this many steps before and after each run, and convert times to one pace of the machine where every run has
    /// these; 0 = do neither
    #[arg(long, default_value_t = PACE_STEPS_DEFAULT, value_name = "N")]
    pace_steps: u32,
    /// Rungs to run [default: those that need no GPU]
    #[arg(long, value_delimiter = ',', value_name = "RUNG", hide_default_value = true)]
    #[arg(default_values = HOST_RUNGS, value_parser = PossibleValuesParser::new(RUNGS.map(|r| r.name)))]
    rungs: Vec<String>,
}

/// A rung: name, idea, and change to the config of the rung `overlap`.
struct Rung {
    name: &'static str,
    what: &'static str,
    rounding: Rounding,
    change: fn(&mut TrainConfig),
    environment: &'static [(&'static str, &'static str)],
}

/// The rungs that need no GPU.
const HOST_RUNGS: [&str; 5] = ["naive", "deferred", "planned", "overlap", "memory"];

/// Environment variable of the steps that a device has in flight.
const IN_FLIGHT: &str = "GSSCALE_STEPS_IN_FLIGHT";

const RUNGS: [Rung; 9] = [
    Rung {
        name: "naive",
        what: "naive offloading: dense updates, pages on demand, LRU",
        rounding: Rounding::Dense,
        change: |c| {
            c.optimizer = Method::Dense;
            (c.transfers, c.evict) = (Transfers::Demand, EvictPolicy::LeastRecentlyUsed);
        },
        environment: &[],
    },
    Rung {
        name: "deferred",
        what: "+ deferred Adam",
        rounding: Rounding::Host,
        change: |c| (c.transfers, c.evict) = (Transfers::Demand, EvictPolicy::LeastRecentlyUsed),
        environment: &[],
    },
    Rung {
        name: "planned",
        what: "+ planned cache and prefetch",
        rounding: Rounding::Host,
        change: |c| c.transfers = Transfers::Ahead,
        environment: &[],
    },
    Rung {
        name: "overlap",
        what: "+ overlap with compute",
        rounding: Rounding::Host,
        change: |_| {},
        environment: &[],
    },
    Rung { name: "memory", what: "all in memory", rounding: Rounding::Host, change: in_memory, environment: &[] },
    Rung {
        name: "pages",
        what: "+ pages on the device",
        rounding: Rounding::Device,
        change: on_device,
        environment: &[(IN_FLIGHT, "0")],
    },
    Rung {
        name: "ahead",
        what: "+ steps submitted ahead",
        rounding: Rounding::Device,
        change: on_device,
        environment: &[(IN_FLIGHT, "2")],
    },
    Rung {
        name: "split",
        what: "+ half of the device memory, views in parts",
        rounding: Rounding::Device,
        change: |c| {
            on_device(c);
            c.device_mem = ByteSize(c.device_mem.0 / 2);
        },
        environment: &[(IN_FLIGHT, "2")],
    },
    Rung {
        name: "resident",
        what: "all in memory and on the device",
        rounding: Rounding::Device,
        change: |c| {
            in_memory(c);
            on_device(c);
            c.device_mem = ByteSize(0);
        },
        environment: &[(IN_FLIGHT, "2")],
    },
];

fn on_device(config: &mut TrainConfig) {
    config.optimizer_on = Chosen(Some(OptimizerPlace::Device));
}

fn in_memory(config: &mut TrainConfig) {
    (config.spill_dir, config.frames) = (String::new(), 0);
}

/// Runs the ladder.
///
/// # Errors
/// The input is invalid, or the results cannot be written.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    if !(args.share > 0.0 && args.share < 100.0) {
        return Err(InputError::new("--share", "the value must be above 0 and below 100", "use --share 50").into());
    }
    let mut config = args.common.base_config()?;
    fix_common_keys(&mut config);
    let chosen = || RUNGS.iter().filter(|r| args.rungs.iter().any(|n| n == r.name));
    for rung in chosen() {
        let mut config = config.clone();
        (rung.change)(&mut config);
        config.check()?;
    }
    if config.device_mem.0 == 0 && chosen().any(|rung| rung.name == "split") {
        let problem = "the rung split halves a budget that is not given";
        return Err(InputError::new("--rungs", problem, "name --device-mem, or leave the rung out").into());
    }
    let (scene, page) = (&args.common.scene, args.common.out.join("ladder.html"));
    let facts = Facts::of(scene, &config)?;
    let frames = facts.frames(args.share).unwrap_or_else(|| facts.fewest_frames());
    if frames >= facts.pages_at_end() {
        let (largest, pages) = (facts.largest_view, facts.pages);
        let problem = format!("the largest view needs {largest} of {pages} pages: nothing would leave memory");
        let remedy = "use smaller --page-rows, or a scene whose views see a smaller part";
        return Err(InputError::new(scene, problem, remedy).into());
    }
    let facts = format!(
        "{}: {} steps, {} Gaussians in {} pages of {} rows, the largest view needs {}; {frames} frames; order {}",
        scene.display(),
        config.steps,
        facts.gaussians,
        facts.pages,
        config.page_rows,
        facts.largest_view,
        config.view_order.word(),
    );
    gsscale::tell!("{facts}");
    use_drive(&mut config, frames);
    let mut sweep = Sweep::open(&args.common, &config, RESULTS)?.with_pace(args.pace_steps);
    let mut done = Vec::new();
    for rung in chosen() {
        let environment = rung.environment;
        let mut planned = Planned { environment, ..Planned::new("ladder", rung.name, config.clone()) };
        (rung.change)(&mut planned.config);
        gsscale::tell!("{}: {}", rung.name, rung.what);
        let record = sweep.run(&planned, print)?;
        done.push(LadderRung { name: rung.name.into(), what: rung.what.into(), rounding: rung.rounding, record });
        let (rungs, times) = at_one_pace(&sweep, &done);
        write_whole(&page, ladder_page(&format!("{facts}; {times}"), &rungs).as_bytes())?;
    }
    if !args.common.json {
        let (rungs, times) = at_one_pace(&sweep, &done);
        gsscale::say!("{}", text_of(&rungs));
        gsscale::tell!("{times}");
    }
    gsscale::tell!("done: {}", page.display());
    Ok(())
}

/// The rungs with their times converted to one pace of the machine, and what the times are.
fn at_one_pace(sweep: &Sweep, rungs: &[LadderRung]) -> (Vec<LadderRung>, &'static str) {
    let mut records: Vec<RunRecord> = rungs.iter().map(|rung| rung.record.clone()).collect();
    let times = sweep.convert_times(&mut records);
    let converted = rungs.iter().zip(records).map(|(rung, record)| LadderRung { record, ..rung.clone() });
    (converted.collect(), times)
}

/// The rungs as a table.
fn text_of(rungs: &[LadderRung]) -> String {
    let row = |rung: &LadderRung| {
        let r = &rung.record;
        vec![
            rung.name.clone(),
            figure(Some(r.seconds), 1),
            figure(r.cpu_seconds, 1),
            figure(Some(r.stall_seconds), 1),
            format_bytes(r.bytes_read),
            format_bytes(r.bytes_written),
            format_bytes(r.host_bytes_peak),
            figure(r.psnr, 2),
        ]
    };
    let rows: Vec<Vec<String>> = rungs.iter().map(row).collect();
    table(&["rung", "seconds", "CPU s", "waited", "read", "written", "peak", "PSNR"], 1, &rows)
}

/// Fixes the keys that a rung could otherwise choose automatically, and resets the keys that distinguish the rungs.
fn fix_common_keys(config: &mut TrainConfig) {
    (config.spill_dir, config.frames) = (String::new(), 0);
    config.view_order.0.get_or_insert(Order::Shuffle);
    config.spill_codec.0.get_or_insert(Codec::Raw);
    let best = TrainConfig::default();
    (config.optimizer, config.evict, config.transfers) = (best.optimizer, best.evict, best.transfers);
    config.optimizer_on = best.optimizer_on;
}
