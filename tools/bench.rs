//! `gsscale-bench`: measures training and prints the figures. The first argument names the measurement; without a
//! name it is `run`. Parses, calls, prints. (Measurements of the program's own parts are benchmarks: `benches/`.)

#[path = "bench/city.rs"]
mod city;
#[path = "bench/compare.rs"]
mod compare;
#[path = "bench/doctor.rs"]
pub mod doctor;
#[path = "bench/facts.rs"]
mod facts;
#[path = "bench/front.rs"]
mod front;
#[path = "bench/list.rs"]
mod list;
#[path = "bench/programs.rs"]
mod programs;
#[path = "bench/published.rs"]
mod published;
#[path = "bench/published_table.rs"]
mod published_table;
#[path = "bench/record.rs"]
mod record;
#[path = "bench/results_log.rs"]
mod results_log;
#[path = "bench/run.rs"]
mod run;
#[path = "bench/runs.rs"]
mod runs;
#[path = "bench/sweep.rs"]
mod sweep;
#[path = "bench/sweep_page.rs"]
mod sweep_page;

use clap::{Command, CommandFactory};
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::say::exit_code;
use gsscale::base::text::{OWN_FILE_MOST, read_text};
use gsscale::config::command_line::{parse_arguments, parse_plain};
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::simd_path;
use gsscale::config::new_run;
use gsscale::config::published::BUILT_IN;
use gsscale::config::values::Choice;
use gsscale::train::error::TrainError;
use serde_json::Value;
use std::ffi::OsString;
use std::path::Path;
use std::process::ExitCode;

/// The measurements, the most used first.
const HELP: &str = "\
Measures training.

  gsscale-bench SCENE                  trains a scene (the same as run SCENE)
  gsscale-bench run NAME --data DIR    trains a published scene; prints our figures beside the published figures
  gsscale-bench doctor                 checks your GPU against the CPU, and says which flags to use
  gsscale-bench compare A B --out F    shows finished runs side by side on one page
  gsscale-bench sweep LIST SCENE... --out DIR
                                       trains the runs of a list and compares them: cells, pareto, ladder, ladder-gpu,
                                       speed, stability, or a file

Each command has --help with examples: gsscale-bench run --help, gsscale-bench run rubble --help.
Published scenes: ";

fn main() -> ExitCode {
    run_with(std::env::args_os().collect())
}

/// The program, with the words of its command line; the first is its name.
pub fn run_with(mut arguments: Vec<OsString>) -> ExitCode {
    gsscale::base::allocator::return_freed_blocks();
    gsscale::base::environment::quiet_wayland();
    let name = arguments.get(1).and_then(|a| a.to_str()).map(str::to_string);
    let mut named = |known: &str| {
        let is = name.as_deref() == Some(known);
        if is {
            // The remaining arguments are parsed as those of a program of its own, whose name is that of both.
            let both = format!("{} {known}", arguments[0].to_string_lossy());
            arguments.splice(..2, [both.into()]);
        }
        is
    };
    let mut print = |line: &Value| gsscale::say!("{line}");
    let done = if named("help") || named("--help") || named("-h") {
        gsscale::say!("{HELP}{}", published_names());
        Ok(())
    } else if named("sweep") {
        sweep::start(&parse_arguments(&arguments), &mut print)
    } else if named("doctor") {
        doctor::start(&parse_plain(&arguments), &mut print)
    } else if named("compare") {
        compare::start(&parse_plain(&arguments))
    } else if named("run") && published::is_published_run(&arguments) {
        match published::start(&parse_arguments(&arguments), &mut print) {
            Ok(code) => return code,
            Err(error) => Err(error),
        }
    } else {
        run::start(&parse_arguments(&arguments), &mut print)
    };
    exit_code(done)
}

/// The command line, for completions and man pages.
pub fn command() -> Command {
    Command::new("bench")
        .about("Measures training")
        .after_help(HELP.to_string() + &published_names())
        .subcommand(doctor::Args::command().name("doctor"))
        .subcommand(run::Args::command().name("run"))
        .subcommand(compare::Args::command().name("compare"))
        .subcommand(sweep::Args::command().name("sweep"))
}

fn published_names() -> String {
    BUILT_IN.map(|(name, _)| name).join(", ")
}

/// The checked config of a measurement; starts the worker threads.
fn settle(file: Option<&Path>, keys: &TrainOverrides) -> Result<TrainConfig, TrainError> {
    let config = new_run::of_new_run(file, keys)?;
    config.check()?;
    if !simd_path(&config).is_supported() {
        let problem = format!("this machine cannot run {}", config.simd.word());
        return Err(InputError::new("--simd", problem, "use --simd auto").into());
    }
    if config.threads > 0 {
        // Fails only if the pool already exists; main has not started one.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(config.threads as usize).build_global();
    }
    Ok(config)
}

/// A file of a run.
fn read_json<T: serde::de::DeserializeOwned>(path: &Path, remedy: &str) -> InputResult<T> {
    let text = read_text(path, OWN_FILE_MOST, remedy)?;
    serde_json::from_str(&text).map_err(|e| InputError::new(path, format!("cannot be parsed: {e}"), remedy))
}
