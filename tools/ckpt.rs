//! `gsscale-ckpt`: lists, verifies, exports, imports, copies and repairs checkpoints. Parses, calls the library,
//! prints; one file per subcommand.

#[path = "ckpt/clone.rs"]
mod clone;
#[path = "ckpt/export.rs"]
mod export;
#[path = "ckpt/import.rs"]
mod import;
#[path = "ckpt/inspect.rs"]
mod inspect;
#[path = "ckpt/ls.rs"]
mod ls;
#[path = "ckpt/prune.rs"]
mod prune;
#[path = "ckpt/rollback.rs"]
mod rollback;
#[path = "ckpt/salvage.rs"]
mod salvage;
#[path = "ckpt/verify.rs"]
mod verify;

use clap::{Parser, Subcommand};
use gsscale::base::error::InputError;
use gsscale::page::map::commit::CommitError;
use gsscale::page::map::entries::MapError;
use gsscale::train::error::TrainError;
use serde::Serialize;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt ls runs/village                         generations: step, PSNR, Gaussians, bytes
  gsscale-ckpt verify runs/village --deep              verifies every checksum and value; exit code 1 on damage
  gsscale-ckpt export runs/village --out village.ply   the PLY as of the last commit
  gsscale-ckpt rollback runs/village 41 --yes          the next --resume continues from generation 41
  gsscale-ckpt clone runs/village /mnt/other/village   copies the store to another drive
  gsscale-ckpt salvage runs/village --out rescued      if verify reports a damaged map

DIR is the output folder of a run, or its spill directory. ls, inspect, verify, export, clone and salvage never
write to it. `gsscale-ckpt COMMAND --help` shows examples.";

/// Lists, verifies, exports, imports, copies and repairs checkpoints.
#[derive(Parser)]
#[command(name = "gsscale-ckpt", version, after_help = EXAMPLES)]
struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Lists generations and named checkpoints
    Ls(ls::Args),
    /// Shows a store, its training state, or one page
    Inspect(inspect::Args),
    /// Verifies a store and lists every fault; exit code 1 if there is one
    Verify(verify::Args),
    /// Makes an earlier generation the latest one
    Rollback(rollback::Args),
    /// Removes names of checkpoints, and frees pages that only they kept
    Prune(prune::Args),
    /// Writes the Gaussians of a generation as a PLY
    Export(export::Args),
    /// Makes a store from the Gaussians of a PLY
    Import(import::Args),
    /// Copies a store to another drive
    Clone(clone::Args),
    /// Rebuilds a damaged store elsewhere from its intact pages
    Salvage(salvage::Args),
}

fn main() -> ExitCode {
    let done = match Args::parse().command {
        Command::Ls(args) => ls::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Verify(args) => verify::run(&args),
        Command::Rollback(args) => rollback::run(&args),
        Command::Prune(args) => prune::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Import(args) => import::run(&args),
        Command::Clone(args) => clone::run(&args),
        Command::Salvage(args) => salvage::run(&args),
    };
    done.unwrap_or_else(|error| {
        gsscale::tell!("error: {error}");
        if is_damaged_map(&error) {
            gsscale::tell!(
                "  remedy: gsscale-ckpt salvage DIR --out TO rebuilds the map from the pages, and never writes to DIR"
            );
        }
        ExitCode::FAILURE
    })
}

fn is_damaged_map(error: &TrainError) -> bool {
    use MapError::{Damaged, Panicked, Stale};
    matches!(
        error,
        TrainError::Commit(CommitError::Map(Damaged(_) | Panicked(_) | Stale { .. }) | CommitError::NoStore)
    )
}

/// Prints `value` as JSON or as text.
fn print(json: bool, value: &impl Serialize, text: impl FnOnce() -> String) -> Result<(), TrainError> {
    let text = match json {
        true => serde_json::to_string_pretty(value)
            .map_err(|e| InputError::new("--json", format!("writing JSON failed: {e}"), "report this as a bug"))?,
        false => text(),
    };
    gsscale::say!("{}", text.trim_end_matches('\n'));
    Ok(())
}

/// Formats rows of words as columns, the first left-aligned, the others right-aligned.
fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns)
        .map(|c| rows.iter().filter_map(|row| row.get(c)).map(|cell| cell.chars().count()).max().unwrap_or(0))
        .collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths).enumerate();
        let cells = cells.map(|(c, (cell, &w))| if c == 0 { format!("{cell:<w$}") } else { format!("{cell:>w$}") });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_string()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}
