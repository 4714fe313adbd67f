//! `gsscale-ckpt import`: makes a store from the Gaussians of a PLY.

use gsscale::base::units::format_bytes;
use gsscale::config::values::ByteSize;
use gsscale::page::format::codec::Codec;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{ImportRequest, import};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt import city.ply --out /mnt/nvme/city
  gsscale-ckpt import city.ply --out /mnt/nvme/city --host-mem 512MiB --page-rows 512
  gsscale-train scans/city --out runs/city --init-ply /mnt/nvme/city --spill-dir /mnt/nvme/pages
  gsscale-ckpt export /mnt/nvme/city --out block.ply --crop 0,0,0,10,10,10

The file may be larger than memory. Its values are kept bit for bit; moments are zero. gsscale-train starts from the
store with --init-ply.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A PLY of Gaussians
    #[arg(value_name = "FILE.ply")]
    file: PathBuf,
    /// The store to make: a folder that does not exist yet
    #[arg(long, short, value_name = "DIR")]
    out: PathBuf,
    /// Most memory to use
    #[arg(long, default_value = "1GiB", value_name = "SIZE")]
    host_mem: ByteSize,
    /// Gaussians per page
    #[arg(long, default_value_t = 1024, value_name = "N", value_parser = clap::value_parser!(u32).range(16..=65_536))]
    page_rows: u32,
    /// Codec of the pages: raw, halves, or zstd:LEVEL
    #[arg(long, default_value = "raw", value_name = "CODEC")]
    spill_codec: Codec,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let done = import(&ImportRequest {
        file: args.file.clone(),
        out: args.out.clone(),
        host_mem: args.host_mem.0,
        page_rows: args.page_rows,
        codec: args.spill_codec,
    })?;
    super::print(args.json, &done, || {
        let mut text = format!(
            "{}: {} Gaussians with SH degree {} in {} pages, at most {} of memory used\n",
            done.store.display(),
            done.gaussians,
            done.sh_degree,
            done.pages,
            format_bytes(done.host_bytes_peak),
        );
        if done.dropped > 0 {
            text += &format!("{} Gaussians are not finite and were left out\n", done.dropped);
        }
        text
    })?;
    Ok(ExitCode::SUCCESS)
}
