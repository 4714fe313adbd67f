//! `gsscale-bench`: measures training and prints lines of JSON. The first argument names the measurement; without a
//! name it is `run`. Parses, calls, prints.

#[path = "bench/bounded.rs"]
mod bounded;
#[path = "bench/commit.rs"]
mod commit;
#[path = "bench/compare.rs"]
mod compare;
#[path = "bench/demand.rs"]
mod demand;
#[path = "bench/facts.rs"]
mod facts;
#[path = "bench/knobs.rs"]
mod knobs;
#[path = "bench/ladder.rs"]
mod ladder;
#[path = "bench/memory_group.rs"]
mod memory_group;
#[path = "bench/orders.rs"]
mod orders;
#[path = "bench/pareto.rs"]
mod pareto;
#[path = "bench/published.rs"]
mod published;
#[path = "bench/published_table.rs"]
mod published_table;
#[path = "bench/run.rs"]
mod run;
#[path = "bench/sizes.rs"]
mod sizes;
#[path = "bench/statistics.rs"]
mod statistics;
#[path = "bench/sweep.rs"]
mod sweep;
#[path = "bench/tiers.rs"]
mod tiers;
#[path = "bench/touched.rs"]
mod touched;

use clap::Parser;
use gsscale::base::error::InputError;
use gsscale::config::file::{TrainConfig, TrainOverrides, parse_arguments};
use gsscale::config::limits::simd_path;
use gsscale::dataset::loader::Dataset;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::train::error::TrainError;
use serde_json::Value;
use std::ffi::OsString;
use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    let mut arguments: Vec<OsString> = std::env::args_os().collect();
    let name = arguments.get(1).and_then(|a| a.to_str()).map(str::to_string);
    let mut named = |known: &str| {
        let is = name.as_deref() == Some(known);
        if is {
            // The remaining arguments are parsed as those of a program of its own, whose usage line names the
            // measurement.
            arguments.remove(1);
        }
        is
    };
    let mut print = |line: &Value| gsscale::say!("{line}");
    let done = if named("tiers") {
        tiers::start(&parse_arguments(&arguments), &mut print)
    } else if named("commit") {
        commit::start(&parse_arguments(&arguments), &mut print)
    } else if named("orders") {
        orders::start(&parse_arguments(&arguments), &mut print)
    } else if named("bounded") {
        bounded::start(&bounded::Args::parse_from(&arguments), &mut print)
    } else if named("sizes") {
        sizes::start(&parse_arguments(&arguments), &mut print)
    } else if named("touched") {
        touched::start(&parse_arguments(&arguments), &mut print)
    } else if named("ladder") {
        ladder::start(&parse_arguments(&arguments), &mut print)
    } else if named("pareto") {
        pareto::start(&parse_arguments(&arguments), &mut print)
    } else if named("compare") {
        compare::start(&compare::Args::parse_from(&arguments))
    } else if named("run") && published::is_meant(&arguments) {
        match published::start(&parse_arguments(&arguments), &mut print) {
            Ok(code) => return code,
            Err(error) => Err(error),
        }
    } else {
        run::start(&parse_arguments(&arguments), &mut print)
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The checked config of a measurement; starts its worker threads.
fn settle(file: Option<&Path>, keys: &TrainOverrides) -> Result<TrainConfig, TrainError> {
    let mut config = file.map_or_else(|| Ok(TrainConfig::default()), TrainConfig::read)?;
    keys.clone().apply(&mut config);
    config.check()?;
    if !simd_path(&config).is_supported() {
        let problem = format!("this machine cannot run {}", config.simd);
        return Err(InputError::new("--simd", problem, "use --simd auto").into());
    }
    if config.threads > 0 {
        // Fails only if the pool exists already, which it does not at the start of main.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(config.threads as usize).build_global();
    }
    Ok(config)
}

/// Refuses devices other than the CPU: the measurement covers the CPU path.
fn refuse_devices(config: &TrainConfig) -> Result<(), TrainError> {
    match config.device.as_str() {
        "auto" | "cpu" => Ok(()),
        other => {
            let problem = format!("this measurement is of the CPU path, not of '{other}'");
            Err(InputError::new("--device", problem, "leave it out, or use gsscale-bench pareto or ladder").into())
        }
    }
}

/// As [`refuse_devices`]; also refuses a drive: the measurement covers a run in memory.
fn refuse_tiers(config: &TrainConfig) -> Result<(), TrainError> {
    refuse_devices(config)?;
    let given = [
        ("--spill-dir", !config.spill_dir.is_empty()),
        ("--frames", config.frames > 0),
        ("--host-mem", config.host_mem.0 > 0),
    ];
    match given.into_iter().find(|(_, is_given)| *is_given) {
        None => Ok(()),
        Some((flag, _)) => {
            let remedy = "leave it out, or use gsscale-bench tiers or ladder for the drive";
            Err(InputError::new(flag, "this measurement keeps all pages in memory", remedy).into())
        }
    }
}

/// Decodes every photo first, so that no contender of a comparison decodes for the others; if the cache is too small
/// for all photos, all contenders decode equally.
fn decode_all(dataset: &Dataset, targets: &TargetCache, config: &TrainConfig) -> Result<(), TrainError> {
    if TargetCache::bytes_to_keep_all(&dataset.views, rayon::current_num_threads()) > config.image_cache.0 {
        return Ok(());
    }
    dataset.train_views().into_iter().try_for_each(|view| targets.get(view).map(|_| ()))?;
    Ok(())
}
