//! `gsscale-ckpt rollback`: makes an earlier generation the latest one.

use gsscale::train::error::TrainError;
use gsscale::train::stores::{RolledBack, find_store, rollback};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt rollback runs/village 41          prints what would be lost
  gsscale-ckpt rollback runs/village 41 --yes    then gsscale-train --resume runs/village continues from there";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Number or name of the generation to roll back to
    #[arg(value_name = "GEN|NAME")]
    generation: String,
    /// Do it: removes later generations and their names
    #[arg(long)]
    yes: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let done = rollback(&find_store(&args.dir)?, &args.generation, args.yes)?;
    super::print(args.json, &done, || text_of(&done))?;
    if done.is_done || done.dropped.is_empty() {
        return Ok(ExitCode::SUCCESS);
    }
    gsscale::tell!("nothing was changed\n  remedy: give --yes to roll back");
    Ok(ExitCode::FAILURE)
}

fn text_of(done: &RolledBack) -> String {
    let RolledBack { generation, step, dropped, dropped_names, is_done } = done;
    if dropped.is_empty() {
        return format!("generation {generation} (step {step}) is already the latest");
    }
    let list: Vec<String> = dropped.iter().map(u64::to_string).collect();
    let names = match dropped_names.as_slice() {
        [] => String::new(),
        names => format!(" with the names {}", names.join(", ")),
    };
    let list = list.join(", ");
    match is_done {
        true => format!("the store is at generation {generation} (step {step}); removed: {list}{names}"),
        false => format!("would go back to generation {generation} (step {step}) and remove: {list}{names}"),
    }
}
