//! `gsscale-ckpt clone`: copies a store to another drive.

use gsscale::base::units::format_bytes;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{clone_store, find_store};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt clone runs/village /mnt/other/village
  gsscale-train --resume runs/village --spill-dir /mnt/other/village    resumes from the copy

The copy has all kept generations with their names and numbers, and only the slots they need. Every page read is verified.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// The copy: a folder that does not exist yet
    to: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let done = clone_store(&find_store(&args.dir)?, &args.to)?;
    super::print(args.json, &done, || {
        format!(
            "{}: {} generations, {} page versions, {} read and verified\n\
             continue from the copy: gsscale-train --resume OUT --spill-dir {}",
            done.to.display(),
            done.generations.len(),
            done.versions,
            format_bytes(done.bytes_read),
            done.to.display(),
        )
    })?;
    Ok(ExitCode::SUCCESS)
}
