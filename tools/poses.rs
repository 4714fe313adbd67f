//! `gsscale-poses`: finds the camera poses of photos with COLMAP or pycolmap. Parses flags, calls the library, prints.

use clap::Parser;
use gsscale::base::error::InputResult;
use gsscale::base::say::{exit_code, shell_word};
use gsscale::config::command_line::parse_plain;
use gsscale::poses::program::{FeatureOptions, ProgramPaths};
use gsscale::poses::{PoseSearch, PosesRequest};
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-poses scans/village                        photos in scans/village or in scans/village/images
  gsscale-poses /media/card/DCIM --out scans/village photos in sub-folders stay where they are
  gsscale-poses scans/village --dry-run              print the number of pairs and a forecast of time

It runs COLMAP (3.8 or newer) or pycolmap, whichever is installed, with or without a GPU, and needs no display. GPS places
in the photos choose the pairs that are compared, and give the model metres, north and up. A stopped search goes on when it is started again.
Next: gsscale-train scans/village";

/// Finds the camera poses of photos, for gsscale-train
#[derive(Debug, Parser)]
#[command(name = "gsscale-poses", version, after_help = EXAMPLES)]
pub struct Flags {
    /// Folder of photos, or of a scene whose photos are in images/
    photos: PathBuf,
    /// Folder of the scene, which gets sparse/0/, and images/ with links to the photos [default: the folder of the photos]
    #[arg(long, short)]
    out: Option<PathBuf>,
    /// Longer side to which photos are reduced for the search, pixels; the photos themselves stay as they are
    #[arg(long, default_value_t = 1600, value_parser = clap::value_parser!(u32).range(100..=65_535))]
    max_resolution: u32,
    /// Most features of a photo. Half as many take a quarter of the time to compare, and give fewer points
    #[arg(long, default_value_t = 8192, value_parser = clap::value_parser!(u32).range(100..=65_535))]
    features: u32,
    /// Path of COLMAP [default: searched]
    #[arg(long, conflicts_with = "python")]
    colmap: Option<PathBuf>,
    /// Path of a Python that has pycolmap [default: GSSCALE_PYTHON, python3]
    #[arg(long)]
    python: Option<PathBuf>,
    /// Print what will be done, then stop
    #[arg(long)]
    dry_run: bool,
    /// Print only warnings and errors
    #[arg(long, short)]
    quiet: bool,
}

fn main() -> ExitCode {
    run_with(std::env::args_os().collect())
}

/// The program, with the words of its command line; the first is its name.
pub fn run_with(arguments: Vec<OsString>) -> ExitCode {
    exit_code(start(&parse_plain::<Flags>(&arguments)))
}

fn start(flags: &Flags) -> InputResult<()> {
    let search = PoseSearch::new(&PosesRequest {
        photos: flags.photos.clone(),
        out: flags.out.clone(),
        places: ProgramPaths { colmap: flags.colmap.clone(), python: flags.python.clone() },
        features: FeatureOptions { max_image_size: flags.max_resolution, max_features: flags.features },
    })?;
    if flags.dry_run {
        search.warnings.iter().for_each(|warning| gsscale::tell!("warning: {warning}"));
        gsscale::say!("{}", search.forecast());
        return Ok(());
    }
    let found = search.run_shown(flags.quiet)?;
    if !flags.quiet {
        gsscale::tell!("next: gsscale-train {}", shell_word(&found.scene));
    }
    Ok(())
}
