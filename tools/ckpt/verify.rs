//! `gsscale-ckpt verify`: verifies a store.

use gsscale::base::units::format_bytes;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{Fault, Verdict, find_store, verify};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt verify runs/village           verify the map, every state, every segment's length, every slot's header
  gsscale-ckpt verify runs/village --deep    also every page's checksum and values: reads everything
  gsscale-ckpt verify runs/village --deep --json | jq .faults

Exit code 0: intact; 1: faults, which are listed, or the store cannot be read.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Read every page: verify its checksum, and that its values are finite
    #[arg(long)]
    deep: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let verdict = verify(&find_store(&args.dir)?, args.deep)?;
    super::print(args.json, &verdict, || text_of(&verdict, args))?;
    Ok(if verdict.faults.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn text_of(verdict: &Verdict, args: &Args) -> String {
    let mut text: String = verdict.faults.iter().map(|fault| line(fault) + "\n").collect();
    let read = if verdict.deep { format!(", {} read", format_bytes(verdict.bytes_read)) } else { String::new() };
    let what = format!("{} generations, {} page versions{read}", verdict.generations, verdict.versions);
    text += &match verdict.faults.len() {
        0 if verdict.deep => format!("intact: {what}"),
        0 => format!("intact according to all headers: {what}; --deep reads the pages"),
        n => {
            let dir = args.dir.display();
            format!(
                "{n} faults: {what}\n\
                 remedy: roll back to a generation without them (gsscale-ckpt rollback {dir} GEN), or recover the intact pages\n\
                 (gsscale-ckpt salvage {dir} --out TO)"
            )
        }
    };
    text
}

fn line(fault: &Fault) -> String {
    let mut words = vec![format!("FAULT {}", fault.kind)];
    words.extend(fault.page.as_ref().map(|page| format!("page {page}")));
    words.extend(fault.generation.map(|generation| format!("generation {generation}")));
    words.extend(fault.file.as_ref().map(|file| match fault.offset {
        Some(offset) => format!("{file} offset {offset}"),
        None => file.clone(),
    }));
    format!("{}: {}", words.join(", "), fault.what)
}
