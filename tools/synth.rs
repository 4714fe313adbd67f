//! `gsscale-synth`: writes a generated city as a COLMAP scene. Parses flags, calls the library, prints.

use clap::Parser;
use gsscale::base::count::new_bar;
use gsscale::base::error::InputResult;
use gsscale::base::say::{exit_code, shell_word};
use gsscale::base::units::{counted, format_bytes};
use gsscale::config::command_line::parse_plain;
use gsscale::dataset::synthetic::{CityOptions, CitySummary, write_city};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  gsscale-synth city                                  60 photos of 480x320, a city of 3x3 blocks
  gsscale-synth town --views 1000 --resolution 1152x864 --points 1000000
  gsscale-synth hard --exposure 0.03 --noise 0.01     exposure changes by 3 %, sensor noise of 1 %
  gsscale-synth metropolis --points 1000000 --tile 4x5  20 copies of a city side by side, 20 million points
  gsscale-synth utm --offset 500000,4600000,120       coordinates as large as UTM's

The same flags give the same bytes for any number of threads.
Next: gsscale-train city --out runs/city";

/// Generates a city, flies over it, and writes the photos as a COLMAP scene
#[derive(Debug, Parser)]
#[command(name = "gsscale-synth", version, after_help = EXAMPLES)]
pub struct Flags {
    /// Folder to write: images/ and sparse/0/
    dir: PathBuf,
    /// Number of photos; the city grows with it
    #[arg(long, default_value_t = 60, help_heading = "Size")]
    views: u32,
    /// Further photos from high above
    #[arg(long, default_value_t = 0, value_name = "N", help_heading = "Size")]
    overviews: u32,
    /// Share of the area of all copies of the city that each of them shows
    #[arg(long, default_value_t = 0.4, value_name = "SHARE", help_heading = "Size")]
    overview_area: f64,
    /// Size of a photo, pixels
    #[arg(long, default_value = "480x320", value_name = "WxH", value_parser = parse_size, help_heading = "Size")]
    resolution: (u32, u32),
    /// Number of points, as if from structure from motion
    #[arg(long, default_value_t = 20_000, help_heading = "Size")]
    points: u32,
    /// Side of the city in blocks of 60 m [default: covers the views]
    #[arg(long, help_heading = "Size")]
    blocks: Option<u32>,
    /// Repeat the city this many times along x and y: --points times AxB points in total, written in bounded memory.
    /// The photos are divided among the copies, and do not show neighbouring copies, except for --overviews
    #[arg(long, default_value = "1x1", value_name = "AxB", value_parser = parse_size, help_heading = "Size")]
    tile: (u32, u32),
    /// Seed of the city
    #[arg(long, default_value_t = 1, help_heading = "Size")]
    seed: u64,
    /// Angle of the cameras to the vertical, degrees: beyond some 60 they see the sky [default: 40, or less for tall photos]
    #[arg(long, value_name = "DEGREES", help_heading = "Camera")]
    tilt: Option<f64>,
    /// Standard deviation of the photos' brightness: 0.03 is 3 %
    #[arg(long, default_value_t = 0.0, help_heading = "Camera")]
    exposure: f64,
    /// Standard deviation of the sensor noise as a fraction of white
    #[arg(long, default_value_t = 0.0, help_heading = "Camera")]
    noise: f64,
    /// Cast NxN rays through a pixel where surfaces meet
    #[arg(long, default_value_t = 3, value_name = "N", help_heading = "Camera")]
    supersample: u32,
    /// Offset added to all coordinates, metres
    #[arg(long, default_value = "0,0,0", value_name = "X,Y,Z", value_parser = parse_offset, allow_hyphen_values = true, help_heading = "Output")]
    offset: [f64; 3],
    /// Threads [default: all]
    #[arg(long, value_name = "N", help_heading = "Output")]
    threads: Option<usize>,
    /// Replace the scene in the folder
    #[arg(long, help_heading = "Output")]
    overwrite: bool,
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let wrong = || format!("'{text}' is not a size; write for example 480x320 (photos), 4x5 (tiles)");
    let (w, h) = text.split_once('x').ok_or_else(wrong)?;
    Ok((w.parse().map_err(|_| wrong())?, h.parse().map_err(|_| wrong())?))
}

fn parse_offset(text: &str) -> Result<[f64; 3], String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|t| t.trim().parse::<f64>()).collect();
    let numbers = numbers.map_err(|e| format!("'{text}': {e}; write for example 500000,4600000,120"))?;
    numbers.try_into().map_err(|_| format!("'{text}' is not three numbers; write for example 500000,4600000,120"))
}

fn main() -> ExitCode {
    run_with(std::env::args_os().collect())
}

/// The program, with the words of its command line; the first is its name.
pub fn run_with(arguments: Vec<OsString>) -> ExitCode {
    exit_code(run(&parse_plain::<Flags>(&arguments)))
}

fn run(flags: &Flags) -> InputResult<()> {
    if let Some(threads) = flags.threads {
        // Fails only if the pool exists already, which it does not at the start of main.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
    }
    let options = CityOptions {
        seed: flags.seed,
        views: flags.views,
        overviews: flags.overviews,
        overview_area: flags.overview_area,
        tilt: flags.tilt,
        width: flags.resolution.0,
        height: flags.resolution.1,
        points: flags.points,
        blocks: flags.blocks,
        exposure: flags.exposure,
        noise: flags.noise,
        supersample: flags.supersample,
        tiles: flags.tile.into(),
        offset: flags.offset,
        overwrite: flags.overwrite,
    };
    let start = Instant::now();
    let bar = new_bar(u64::from(options.photos()), "{bar:32} {pos}/{len} photos  {per_sec}  {eta} left");
    let summary = write_city(&flags.dir, &options, &|done, _| bar.set_position(u64::from(done)))?;
    bar.finish_and_clear();
    report(flags, &options, &summary, start.elapsed().as_secs_f64());
    Ok(())
}

fn report(flags: &Flags, options: &CityOptions, s: &CitySummary, seconds: f64) {
    let dir = &flags.dir;
    let size = |sub: &str| format_bytes(folder_bytes(&dir.join(sub)));
    let rate = s.rays as f64 / seconds / 1e6;
    gsscale::say!(
        "A city of {0}x{0} blocks ({1:.0} m), {2} solids, seed {3}",
        s.blocks,
        s.side,
        s.solids,
        options.seed
    );
    if options.tiles != [1, 1] {
        gsscale::say!("in {}x{} copies side by side", options.tiles[0], options.tiles[1]);
    }
    gsscale::say!("{}/", dir.display());
    gsscale::say!(
        "  images/    {} of {}x{}, {}",
        counted(s.views.into(), "photo"),
        options.width,
        options.height,
        size("images")
    );
    let sparse = size("sparse/0");
    gsscale::say!(
        "  sparse/0/  1 camera, {} poses, {} points in {} observations, {sparse}",
        s.views,
        s.points,
        s.observations
    );
    gsscale::say!("{seconds:.1} s, {rate:.1} million camera rays per second");
    gsscale::say!("next: gsscale-train {} --out RUN", shell_word(dir));
}

fn folder_bytes(folder: &Path) -> u64 {
    let Ok(entries) = std::fs::read_dir(folder) else { return 0 };
    entries.flatten().filter_map(|e| e.metadata().ok()).map(|m| m.len()).sum()
}
