//! Going on with a run that stopped: from its output folder and its spill directory to the end.
//!
//! Invariants: 1. a run that goes on ends with the bytes that it would have had without the stop; 2. keys that change
//! numbers, and the dataset, are those of the run, or it is refused with the difference; 3. a refused resume leaves
//! everything as it was.

use super::checkpoint::{check_dataset, dataset_print};
use super::machine;
use super::memory::host_budget;
use super::pages::PagedScene;
use super::report::{Summary, read_resolved};
use super::run::{Begun, RunOutcome, RunRequest, begin, see_through};
use super::start::Start;
use super::tiers::Stored;
use super::trainer::{TrainError, Trainer};
use crate::base::error::{InputError, InputResult};
use crate::checkpoint::run_state::{RunState, RunStateError};
use crate::config::file::{TrainConfig, TrainOverrides};
use crate::config::limits::{self, RunOptions};
use crate::densify::stats::GradHistogram;
use crate::page::commit::CommitError;
use crate::page::spill_dir::SpillDir;
use crate::paging::pager::Pager;
use crate::report::run_report::write_run_report;
use std::path::{Path, PathBuf};

/// Keys that a run may have otherwise when it goes on: they change no number of the result.
const FREE_KEYS: &[&str] = &[
    "image-cache",
    "eval-every",
    "save-every",
    "log-every",
    "log",
    "ssim-variant",
    "color-correct",
    "export-frame",
    "host-mem",
    "spill-dir",
    "frames",
    "io",
    "spill-codec",
    "commit-every",
    "evict",
    "prefetch-bytes",
    "threads",
    "simd",
    "device",
    "deterministic",
    "device-mem",
];

/// Which run, and what it is given now.
#[derive(Debug, Clone)]
pub struct ResumeRequest {
    /// Its output folder.
    pub out: PathBuf,
    /// Flags.
    pub keys: TrainOverrides,
    /// Nothing but errors on the terminal.
    pub quiet: bool,
}

/// Goes on with a run, to its end.
///
/// # Errors
/// There is no run that could go on, or it is not the same any more (nothing is changed then); else as
/// [`super::run::run`].
pub fn resume(request: &ResumeRequest) -> Result<RunOutcome, TrainError> {
    let file = request.out.join("config.toml");
    let mut config = TrainConfig::read(&file)?;
    let scene = read_resolved(&file)?.scene;
    request.keys.clone().apply(&mut config);
    config.check()?;
    if config.spill_dir.is_empty() {
        let problem = "this run kept its pages in memory and committed nothing";
        return Err(InputError::new(&file, problem, "start it again with --overwrite, and with --spill-dir").into());
    }
    if let Some(outcome) = already_done(request, &config)? {
        return Ok(outcome);
    }
    machine::set_up(&config)?;
    let host_mem = host_budget(&config);
    let stored = Stored::open(Path::new(&config.spill_dir))?;
    let state = stored.run_state.clone();
    check_config(&file, &state, &config)?;
    let start = Start::read(&scene, &config, host_mem)?;
    check_dataset(&start.dataset, &state.dataset, &dataset_print(&start.dataset, start.rows))?;
    check_start(&start, &state)?;
    let (renderer, options, driver) = begin(request.quiet, &config, &start)?;
    let dataset = start.dataset;
    if renderer.device() != state.device {
        let (there, here) = (&state.device, renderer.device());
        eprintln!("warning: the run was rendered by {there}, and is by {here} from here on: other roundings");
    }
    let (pager, tiers) = stored.into_tiers(&config, host_mem.unwrap_or(u64::MAX))?;
    tiers.notes.iter().for_each(|note| eprintln!("warning: {note}"));
    let scene_pages = restore_pages(pager, &options, &state)?;
    let mut trainer = Trainer::of_scene(scene_pages, &dataset, renderer, options);
    trainer.restore_counts(&state);
    if !request.quiet {
        eprintln!("resume  {} after {} of {} steps", request.out.display(), state.step, config.steps);
    }
    let RunState { config: text, dataset: print, metrics_bytes, sh_degree_start, .. } = state;
    let begun = Begun { print, sh_degree_start, past: Some((text, metrics_bytes)), host_mem, driver };
    let (out, quiet) = (request.out.clone(), request.quiet);
    let request = RunRequest { scene, out, config, dry_run: false, overwrite: false, quiet };
    see_through(&request, &dataset, tiers, trainer, begun)
}

/// A run that did all of its steps and wrote its results, but was killed before its spill directory was gone: what is left
/// of that is removed, and nothing is trained.
fn already_done(request: &ResumeRequest, config: &TrainConfig) -> InputResult<Option<RunOutcome>> {
    let text = std::fs::read_to_string(request.out.join("summary.json")).unwrap_or_default();
    let summary: Option<Summary> = serde_json::from_str(&text).ok();
    let Some(summary) = summary.filter(|s| s.finished && s.steps >= config.steps) else { return Ok(None) };
    // Without its FORMAT, or in use, it is left alone.
    if let Ok(spill) = SpillDir::open(Path::new(&config.spill_dir), false) {
        spill.remove()?;
    }
    write_run_report(&request.out)?;
    if !request.quiet {
        eprintln!("{} is done: all {} steps, results are there", request.out.display(), summary.steps);
    }
    Ok(Some(RunOutcome { summary: Some(summary), exit_code: 0 }))
}

fn restore_pages(pager: Pager, options: &RunOptions, state: &RunState) -> Result<PagedScene, TrainError> {
    let broken = |e: RunStateError| CommitError::Contradiction(e.to_string());
    let histogram = GradHistogram::from_filled(&state.histogram);
    let histogram = histogram.ok_or_else(|| CommitError::Contradiction("statistics without bins".to_string()))?;
    let events = state.event_log().map_err(broken)?;
    Ok(PagedScene::restore(pager, options, events, histogram, [state.rows, state.rows_bound]))
}

fn check_start(start: &Start, state: &RunState) -> InputResult<()> {
    if start.sh_degree_start == state.sh_degree_start {
        return Ok(());
    }
    let (there, here) = (state.sh_degree_start, start.sh_degree_start);
    let problem = format!("the first Gaussians had {there} bands in use and have {here}");
    Err(InputError::new("--init-ply", problem, "bring the file back as it was, or start a new run"))
}

/// Refuses keys that change numbers and are not those of the run.
fn check_config(file: &Path, state: &RunState, config: &TrainConfig) -> InputResult<()> {
    let broken = |e: String| InputError::new(file, e, "start the run again");
    let there: toml::Table = state.config.parse().map_err(|e: toml::de::Error| broken(e.to_string()))?;
    let here = toml::Table::try_from(config).map_err(|e| broken(e.to_string()))?;
    let mut differences = Vec::new();
    for (key, now) in here.iter().filter(|(key, _)| !FREE_KEYS.contains(&key.as_str())) {
        match there.get(key) {
            Some(then) if then == now => {}
            Some(then) => differences.push(format!("{key} was {then} and is {now}")),
            None => differences.push(format!("{key} was not there and is {now}")),
        }
    }
    let simd = limits::simd_path(config).name();
    if simd != state.simd {
        differences.push(format!("simd was {} and is {simd}", state.simd));
    }
    if differences.is_empty() {
        return Ok(());
    }
    let problem = format!("the run cannot go on with other numbers: {}", differences.join("; "));
    Err(InputError::new(file, problem, "leave these keys as they were, or start a new run with another --out"))
}
