//! `gsscale-ckpt inspect`: shows a store, its training state, or one page.

use gsscale::base::ids::PageId;
use gsscale::base::units::format_bytes;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{Inspected, PageInspected, find_store, inspect, inspect_page};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt inspect runs/village
  gsscale-ckpt inspect runs/village --generation 41
  gsscale-ckpt inspect runs/village --page 17.0 --json    the lower half of page 17: its header and its rows";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    /// Number or name of a generation [default: the latest]
    #[arg(long, value_name = "GEN|NAME")]
    generation: Option<String>,
    /// Show this page: 17, or 17.0.1 for a part of it
    #[arg(long, value_name = "PAGE")]
    page: Option<PageId>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let place = find_store(&args.dir)?;
    match args.page {
        Some(page) => {
            let page = inspect_page(&place, args.generation.as_deref(), page)?;
            super::print(args.json, &page, || page_text(&page))?;
        }
        None => {
            let store = inspect(&place, args.generation.as_deref())?;
            super::print(args.json, &store, || store_text(&store))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn store_text(s: &Inspected) -> String {
    let [raw, zstd, halves] = s.pages_by_codec;
    let [d0, d1, d2, d3] = s.pages_by_degree;
    let mut text = format!(
        "store       {} ({})\n\
         format      version {}, features {:#x} (incompatible), {:#x} (compatible)\n\
         slots       {} each, {} a segment\n\
         segments    {} files, {}\n\
         map         {} transactions\n\
         generation  {}: {} pages, {} with pending events\n\
         codec       {raw} raw, {zstd} zstd, {halves} halves; {} of payload in {}\n\
         degrees     {d0} pages with degree 0, {d1} with 1, {d2} with 2, {d3} with 3\n",
        s.identity,
        s.store.display(),
        s.format_version,
        s.features_incompatible,
        s.features_compatible,
        format_bytes(s.slot_bytes),
        s.slots_per_segment,
        s.segments,
        format_bytes(s.segment_bytes),
        s.transactions,
        s.generation,
        s.pages,
        s.pages_behind,
        format_bytes(s.payload_bytes[0]),
        format_bytes(s.payload_bytes[1]),
    );
    for (i, word) in s.state.iter().enumerate() {
        text += &format!("{:<12}{word}\n", if i == 0 { "trainer" } else { "" });
    }
    if let Some(who) = &s.used_by {
        text += &format!("in use ({who}): the state shown is that of the last commit\n");
    }
    text
}

fn page_text(p: &PageInspected) -> String {
    let spread = |s: &gsscale::train::stores::Spread| format!("{:.4} to {:.4}, mean {:.4}", s.least, s.most, s.mean);
    let mut text = format!(
        "page        {}, since generation {}\n\
         slot        {} offset {}, write {}\n\
         payload     {}, {} bytes, {} stored, xxh3-128 {}\n\
         rows        {} with SH degree {}, {} of {} events applied\n\
         means       {:?} to {:?}, sigma at most {}\n\
         updated     step {}\n\
         moments     zero in {} rows\n\
         opacity     {}\n\
         sigma       {}\n\
         views       {} since the last round\n",
        p.page,
        p.since,
        p.file,
        p.offset,
        p.serial,
        p.codec,
        p.payload_bytes[0],
        p.payload_bytes[1],
        p.checksum,
        p.rows,
        p.sh_degree,
        p.events[0],
        p.events[1],
        p.bounds[0],
        p.bounds[1],
        p.sigma_max,
        spread(&p.stamp),
        p.rows_without_moments,
        spread(&p.opacity),
        spread(&p.sigma),
        spread(&p.views),
    );
    if let Some(fault) = &p.fault {
        text += &format!("FAULT       {fault}\n");
    }
    text
}
