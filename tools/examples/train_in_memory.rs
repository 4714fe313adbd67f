//! Trains a scene from a folder of photos and poses in memory, and writes its PLY, its report and its held-out views.
//!
//! `cargo run --release --example train_in_memory -- scans/village runs/village`

use gsscale::config::file::TrainConfig;
use gsscale::train::error::TrainError;
use gsscale::train::run::begin::run;
use gsscale::train::run::request::{Existing, RunOutcome, RunRequest};
use std::path::PathBuf;

fn main() -> Result<(), TrainError> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let (Some(scene), Some(out)) = (arguments.next(), arguments.next()) else {
        gsscale::tell!("usage: train_in_memory SCENE OUT");
        std::process::exit(2);
    };
    let outcome = train(scene, out)?;
    if let Some(summary) = outcome.summary {
        gsscale::say!("{} Gaussians after {} steps", summary.gaussians, summary.steps);
        if let Some(test) = summary.test {
            gsscale::say!("PSNR {:.2} dB on {} held-out photos", test.psnr, test.views);
        }
    }
    Ok(())
}

pub fn train(scene: PathBuf, out: PathBuf) -> Result<RunOutcome, TrainError> {
    // Each flag of gsscale-train is a field. Without `spill_dir`, all pages stay in memory.
    let config = TrainConfig { steps: 300, max_gaussians: 50_000, max_resolution: 800, ..TrainConfig::default() };
    config.check()?;
    let existing = Existing::Refuse;
    run(&RunRequest { scene, out, config, dry_run: false, existing, quiet: true, live: None, leg: None })
}
