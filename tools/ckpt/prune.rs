//! `gsscale-ckpt prune`: removes names of checkpoints.

use gsscale::base::units::format_bytes;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{PruneRequest, Pruned, find_store, prune};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt prune runs/village --keep 3            keep the three newest named checkpoints
  gsscale-ckpt prune runs/village step-7000           remove this one
  gsscale-ckpt prune runs/village --keep 0 --dry-run

The last two generations always stay. The run reuses slots that become free; the segment files keep
their length.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Names to remove
    #[arg(value_name = "NAME", required_unless_present = "keep")]
    names: Vec<String>,
    /// Keep this many of the newest named checkpoints
    #[arg(long, value_name = "N", conflicts_with = "names")]
    keep: Option<usize>,
    /// Only print what would be removed
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let request = PruneRequest { names: args.names.clone(), keep: args.keep, dry_run: args.dry_run };
    let pruned = prune(&find_store(&args.dir)?, &request)?;
    super::print(args.json, &pruned, || text_of(&pruned))?;
    Ok(ExitCode::SUCCESS)
}

fn text_of(pruned: &Pruned) -> String {
    let list = |numbers: &[u64]| match numbers {
        [] => "none".to_string(),
        numbers => numbers.iter().map(u64::to_string).collect::<Vec<_>>().join(", "),
    };
    if pruned.dropped_names.is_empty() {
        return format!("no name to remove; kept generations: {}", list(&pruned.kept));
    }
    let (names, removed) = (pruned.dropped_names.join(", "), list(&pruned.dropped));
    match pruned.is_done {
        true => format!(
            "removed names: {names}; removed generations: {removed}; kept: {}; {} free for the run",
            list(&pruned.kept),
            format_bytes(pruned.bytes_freed)
        ),
        false => {
            format!("would remove names: {names}; would remove generations: {removed}; kept: {}", list(&pruned.kept))
        }
    }
}
