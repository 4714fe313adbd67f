//! Shared by the benchmarks that train a scene: command lines, config, turns, lines of JSON. Measures nothing itself.

use gsscale::base::error::InputError;
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::simd_path;
use gsscale::config::values::Device;
use gsscale::dataset::loader::Dataset;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::gpu::DeviceChoice;
use gsscale::train::error::TrainError;
use serde_json::Value;
use std::ffi::OsString;
use std::ops::Range;
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
    match start(&arguments, &mut |line| gsscale::say!("{line}")) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            gsscale::tell!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The checked config of a benchmark that needs a drive; starts the worker threads.
///
/// # Errors
/// A key is invalid, the spill directory is missing, or the device is not the CPU.
pub fn config_with_drive(keys: &TrainOverrides) -> Result<TrainConfig, TrainError> {
    let mut config = TrainConfig::default();
    keys.clone().apply(&mut config);
    config.check()?;
    if !matches!(config.device, Device::Cpu | Device::Gpu(DeviceChoice::Auto)) {
        let problem = format!("this benchmark measures the CPU path, not '{}'", config.device);
        return Err(InputError::new("--device", problem, "remove the flag").into());
    }
    if !simd_path(&config).is_supported() {
        let problem = format!("this machine cannot run {}", simd_path(&config).name());
        return Err(InputError::new("--simd", problem, "use --simd auto").into());
    }
    if config.residence().spill_dir().is_none() {
        let remedy = "name a folder on the drive to measure";
        return Err(InputError::new("--spill-dir", "there is no drive to measure", remedy).into());
    }
    if config.threads > 0 {
        // Fails only if the pool already exists; main has not started one.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(config.threads as usize).build_global();
    }
    Ok(config)
}

/// Decodes every photo, so that no contender decodes for the others. If the cache cannot hold all photos, all
/// contenders decode equally during the steps.
///
/// # Errors
/// A photo cannot be decoded.
pub fn decode_all(dataset: &Dataset, targets: &TargetCache, config: &TrainConfig) -> Result<(), TrainError> {
    if TargetCache::bytes_to_keep_all(&dataset.views, rayon::current_num_threads()) > config.image_cache.0 {
        return Ok(());
    }
    dataset.train_views().into_iter().try_for_each(|view| targets.get(view).map(|_| ()))?;
    Ok(())
}

/// Runs `steps` for all contenders, in turns of `turn` steps, so that other load on the machine slows all equally.
///
/// # Errors
/// A step fails.
pub fn in_turns<T>(
    contenders: &mut [T],
    steps: Range<u32>,
    turn: u32,
    mut step: impl FnMut(&mut T) -> Result<(), TrainError>,
) -> Result<(), TrainError> {
    let mut first = steps.start;
    while first < steps.end {
        let end = first.saturating_add(turn).min(steps.end);
        for contender in &mut *contenders {
            (first..end).try_for_each(|_| step(contender))?;
        }
        first = end;
    }
    Ok(())
}

/// Adds the keys of `more` to `line`; both are objects.
pub fn extend(line: &mut Value, more: &Value) {
    if let (Some(line), Some(more)) = (line.as_object_mut(), more.as_object()) {
        line.extend(more.clone());
    }
}
