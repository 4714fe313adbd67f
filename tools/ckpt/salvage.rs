//! `gsscale-ckpt salvage`: rebuilds a damaged store elsewhere.

use gsscale::train::error::TrainError;
use gsscale::train::stores::{SalvageRequest, Salvaged, find_store, salvage};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt salvage runs/village --out /mnt/other/rescued
  gsscale-ckpt salvage /mnt/nvme/pages --out rescued --config runs/village/config.toml
  gsscale-ckpt export rescued --out rescued.ply

If the map is intact, damaged pages are replaced by their newest older versions, and gsscale-train --resume OUT
--spill-dir TO continues. If the map is lost, the newest intact version of every page is taken: a scene to export or to
start from. Missing pages are listed. DIR is never written.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// The new store: a folder that does not exist yet
    #[arg(long, short, value_name = "TO")]
    out: PathBuf,
    /// config.toml of the run, if the map is lost and DIR is the spill directory
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let request = SalvageRequest { to: args.out.clone(), config: args.config.clone() };
    let done = salvage(&find_store(&args.dir)?, &request)?;
    super::print(args.json, &done, || text_of(&done))?;
    Ok(ExitCode::SUCCESS)
}

fn text_of(done: &Salvaged) -> String {
    let mut text = String::new();
    for page in &done.lost {
        let rows = page.rows.map_or(String::new(), |rows| format!(" of {rows} Gaussians"));
        let taken = match page.taken {
            Some(generation) => format!("its version of generation {generation} was taken"),
            None => "the page is lost".to_string(),
        };
        text += &format!("page {}{rows}: {}; {taken}\n", page.page, page.what);
    }
    done.notes.iter().for_each(|note| text += &format!("{note}\n"));
    text += &format!(
        "{}: {} Gaussians in {} pages, step {}; {} pages are missing, incomplete or older",
        done.to.display(),
        done.gaussians,
        done.pages,
        done.step,
        done.lost.len(),
    );
    text
}
