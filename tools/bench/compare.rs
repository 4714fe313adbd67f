//! `gsscale-bench compare`: compares finished runs on one page.

use clap::Parser;
use gsscale::base::whole_file::{check_replaceable, write_whole};
use gsscale::report::compare_report::compare_report;
use gsscale::report::html::is_page;
use gsscale::train::error::TrainError;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench compare runs/village runs/village_sh1 --out compare.html
  gsscale-bench compare sweeps/village/runs/* --out compare.html

All runs are compared with the first. If a run's folder has evaluated.json, PSNR and SSIM come from that file.
gsscale-eval --json writes the file, and a sweep does so for runs on smaller photos.";

/// Compares finished runs: figures, curves over steps and seconds, renders of the same view under a slider.
#[derive(Parser)]
#[command(name = "gsscale-bench compare", version, after_help = EXAMPLES)]
pub struct Args {
    /// Output folders of gsscale-train
    #[arg(required = true, num_args = 2..)]
    runs: Vec<PathBuf>,
    /// Page to write
    #[arg(long, short, value_name = "FILE")]
    out: PathBuf,
}

/// Writes the page. Errors: a folder holds no run, or the page cannot be written, or would replace something else.
pub fn start(args: &Args) -> Result<(), TrainError> {
    check_replaceable("--out", &args.out, is_page)?;
    write_whole(&args.out, compare_report(&args.runs)?.as_bytes())?;
    gsscale::tell!("{}", args.out.display());
    Ok(())
}
