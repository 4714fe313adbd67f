//! The command line of the benchmarks that train a scene. Measures nothing itself.

use gsscale::base::say::exit_code;
use gsscale::train::error::TrainError;
use serde_json::Value;
use std::ffi::OsString;
use std::process::ExitCode;

/// Runs the benchmark `name` with the arguments after `cargo bench --bench NAME --`, and prints its lines of JSON.
/// Without arguments the benchmark is skipped, so that a plain `cargo bench` reaches the others.
pub fn run_with_arguments(
    name: &str,
    start: impl FnOnce(&[OsString], &mut dyn FnMut(&Value)) -> Result<(), TrainError>,
) -> ExitCode {
    // Cargo adds --bench.
    let arguments: Vec<OsString> = std::env::args_os().filter(|argument| argument != "--bench").collect();
    if arguments.len() < 2 {
        gsscale::tell!("SKIPPED {name}: it needs arguments; see cargo bench --bench {name} -- --help");
        return ExitCode::SUCCESS;
    }
    exit_code(start(&arguments, &mut |line| gsscale::say!("{line}")))
}
