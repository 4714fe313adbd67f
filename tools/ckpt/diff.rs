//! `gsscale-ckpt diff`: compares two generations.

use gsscale::base::units::format_bytes;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{StoreDiff, diff, find_store};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt diff runs/village 41 47
  gsscale-ckpt diff runs/village before-resets 47 --names --json

A page that was split counts as removed, its halves as added. Works while the run trains.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Number or name of the first generation
    #[arg(value_name = "A")]
    from: String,
    /// Number or name of the second generation
    #[arg(value_name = "B")]
    to: String,
    /// List the pages that differ
    #[arg(long)]
    names: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let found = diff(&find_store(&args.dir)?, &args.from, &args.to, args.names)?;
    super::print(args.json, &found, || text_of(&found))?;
    Ok(ExitCode::SUCCESS)
}

fn text_of(d: &StoreDiff) -> String {
    let mut rows = vec![["", "pages", "Gaussians", "bytes"].map(str::to_string).to_vec()];
    for (what, sum) in [("added", d.added), ("removed", d.removed), ("changed", d.changed), ("same", d.same)] {
        rows.push(vec![what.to_string(), sum.pages.to_string(), sum.rows.to_string(), format_bytes(sum.bytes)]);
    }
    let mut text = format!(
        "generation {} (step {}, {} Gaussians) to {} (step {}, {} Gaussians)\n{}\n",
        d.from,
        d.steps[0],
        d.rows[0],
        d.to,
        d.steps[1],
        d.rows[1],
        super::table(&rows)
    );
    for (what, names) in ["added", "removed", "changed"].iter().zip(&d.names) {
        if !names.is_empty() {
            text += &format!("{what}: {}\n", names.join(" "));
        }
    }
    text
}
