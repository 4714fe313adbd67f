//! `gsscale-ckpt export`: writes a generation as a PLY, SPZ or SOG.

use gsscale::base::units::format_bytes;
use gsscale::config::values::ByteSize;
use gsscale::exchange::format::ExportFormat;
use gsscale::exchange::sink::LevelCounts;
use gsscale::train::error::TrainError;
use gsscale::train::stores::{ExportRequest, export, find_store};
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-ckpt export runs/city --out city.ply
  gsscale-ckpt export runs/city --generation 41 --out then.ply
  gsscale-ckpt export runs/city --out city.spz
  gsscale-ckpt export runs/city --out city/lod-meta.json
  gsscale-ckpt export runs/city --out small.ply --max-gaussians 2000000 --sh-degree 1
  gsscale-ckpt export runs/city --out block.ply --crop 350,120,-5,420,190,60
  gsscale-ckpt export runs/city --out city.ply --host-mem 256MiB

Pages are read one by one: --host-mem bounds the memory for a scene of any size. Without --max-gaussians, --crop
and --sh-degree the file is the one that gsscale-train would have written after that step.";

#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// A run's output folder, or a spill directory
    dir: PathBuf,
    #[arg(long, short, value_name = "FILE", help = format!("The file to write; its name says the format: {}", ExportFormat::NAMES))]
    out: PathBuf,
    /// Number or name of a generation [default: the latest]
    #[arg(long, value_name = "GEN|NAME")]
    generation: Option<String>,
    /// Export only this many Gaussians, those that can cover the most of a picture
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    max_gaussians: Option<u64>,
    /// Export only Gaussians whose means are in this box of dataset coordinates
    #[arg(long, value_name = "MINX,MINY,MINZ,MAXX,MAXY,MAXZ", value_parser = parse_box, allow_hyphen_values = true)]
    crop: Option<[f64; 6]>,
    /// Export only spherical harmonics up to this degree
    #[arg(long, value_name = "0..3", value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: Option<u8>,
    /// Most memory to use
    #[arg(long, default_value = "1GiB", value_name = "SIZE")]
    host_mem: ByteSize,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn parse_box(text: &str) -> Result<[f64; 6], String> {
    let wrong = || format!("'{text}' is not a box; write minx,miny,minz,maxx,maxy,maxz");
    let values: Result<Vec<f64>, _> = text.split(',').map(|v| v.trim().parse()).collect();
    let corners: [f64; 6] = values.map_err(|_| wrong())?.try_into().map_err(|_| wrong())?;
    let is_box = corners.iter().all(|x| x.is_finite()) && (0..3).all(|i| corners[i] <= corners[3 + i]);
    if is_box { Ok(corners) } else { Err(wrong() + ", each min at most its max") }
}

pub fn run(args: &Args) -> Result<ExitCode, TrainError> {
    let request = ExportRequest {
        generation: args.generation.clone(),
        out: args.out.clone(),
        host_mem: args.host_mem.0,
        max_gaussians: args.max_gaussians,
        crop: args.crop,
        sh_degree: args.sh_degree,
    };
    let done = export(&find_store(&args.dir)?, &request)?;
    super::print(args.json, &done, || {
        let mut text = format!(
            "{}: {} Gaussians as of generation {} (step {}), {}; {} of pages read, at most {} of memory used\n",
            done.file.display(),
            done.gaussians,
            done.generation,
            done.step,
            format_bytes(done.bytes),
            format_bytes(done.bytes_read),
            format_bytes(done.host_bytes_peak),
        );
        if let Some(rows) = done.levels {
            text += &format!("{}\n", LevelCounts { rows, always_shown: done.always_shown });
        }
        if done.is_local {
            text += "positions are local: the file transform.json of the export leads back to the dataset's\n";
        }
        if done.skipped > 0 {
            text +=
                &format!("{} Gaussians are not finite, or too far for the format, and were left out\n", done.skipped);
        }
        text
    })?;
    Ok(ExitCode::SUCCESS)
}
