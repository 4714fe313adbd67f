//! `gsscale-ckpt ls`: lists generations and named checkpoints.

use gsscale::base::units::format_bytes;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{GenerationLine, find_store, list};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt ls runs/village
  gsscale-ckpt ls /mnt/nvme/pages --json

'Gaussians' counts those in pages, 'at most' how many they can be after pending events: pages that no view has needed since
the last events apply them later, at an export too. 'bytes' counts all pages of a generation, 'alone' those that no other
generation needs. Works while the run trains.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let listed = list(&find_store(&args.dir)?)?;
    super::print(args.json, &listed, || {
        let heads = ["generation", "step", "PSNR", "Gaussians", "at most", "pages", "alone", "bytes", "names"];
        let mut rows = vec![heads.map(str::to_string).to_vec()];
        rows.extend(listed.generations.iter().map(row));
        let mut text = super::table(&rows);
        if listed.generations.is_empty() {
            text = "no commit yet".to_string();
        }
        text += &format!("\nsegment files: {}", format_bytes(listed.segment_bytes));
        if let Some(who) = &listed.used_by {
            text += &format!("\nin use ({who}): the state shown is that of the last commit");
        }
        text
    })?;
    Ok(ExitCode::SUCCESS)
}

fn row(line: &GenerationLine) -> Vec<String> {
    let mut names = line.names.join(",");
    if line.is_latest {
        names = [names.as_str(), "(last)"].join(" ").trim().to_string();
    }
    vec![
        line.generation.to_string(),
        line.step.to_string(),
        line.psnr.map_or_else(|| "-".to_string(), |psnr| format!("{psnr:.2}")),
        line.gaussians.to_string(),
        line.gaussians_at_most.to_string(),
        line.pages.to_string(),
        format_bytes(line.bytes_alone),
        format_bytes(line.bytes),
        names,
    ]
}
