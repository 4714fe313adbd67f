//! `gsscale-iotune`: measures how fast a drive moves pages and prints lines for a config. Parses flags, calls the
//! library, prints.

use clap::Parser;
use gsscale::base::count::new_bar;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::say::exit_code;
use gsscale::base::units::{format_bytes, parse_bytes};
use gsscale::config::command_line::parse_plain;
use gsscale::page::engine::open::IoEngine;
use gsscale::page::folder::file_system::FileSystem;
use gsscale::page::folder::measure::{Case, Limits, MeasuredCase, Sweep, codec_for, sweep};
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::transfer_bytes;
use gsscale::scene::page_layout::capacity_bytes;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  gsscale-iotune /mnt/nvme                        takes about 20 s, a test file of 512 MiB, writes up to 4 GiB
  gsscale-iotune /mnt/nvme --seconds 60           more stable figures
  gsscale-iotune /mnt/nvme --file 4GiB            larger than the drive's own cache

Figures are medians over rounds of all cases. No file stays on the drive.
Put the printed lines into a config file: gsscale-train SCENE --config FILE --spill-dir DIR";

/// Page sizes to measure, rows.
const PAGE_ROWS: [usize; 6] = [128, 256, 512, 1024, 2048, 4096];
/// Page size at which engines and depths are compared, rows.
const USUAL_ROWS: usize = 1024;
/// Queue depth at which sizes are compared.
const USUAL_DEPTH: usize = 8;
const DEPTHS: [usize; 6] = [1, 2, 4, 8, 16, 32];
/// Transfer sizes besides those of pages, bytes.
const POWERS: [usize; 7] = [64 << 10, 128 << 10, 256 << 10, 512 << 10, 1 << 20, 2 << 20, 4 << 20];
/// Engines in the order in which they win ties: least CPU work first.
const ENGINES: [IoEngine; 3] = [IoEngine::Uring, IoEngine::Pread, IoEngine::Mmap];
/// Fraction of the best rate that counts as equal: rates of one drive vary by more from day to day.
const AS_GOOD: f64 = 0.9;
/// SH degree of the measured pages.
const SH_DEGREE: u8 = 3;

/// Measures how fast a drive moves pages, and prints lines for a config
#[derive(Debug, Parser)]
#[command(name = "gsscale-iotune", version, after_help = EXAMPLES)]
pub struct Flags {
    /// A folder on the drive
    dir: PathBuf,
    /// Size of the test file
    #[arg(long, default_value = "512MiB", value_name = "SIZE", value_parser = parse_bytes)]
    file: u64,
    /// Total time, seconds
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Most bytes to write besides the test file
    #[arg(long, default_value = "4GiB", value_name = "SIZE", value_parser = parse_bytes)]
    written: u64,
}

fn main() -> ExitCode {
    run_with(std::env::args_os().collect())
}

/// The program, with the words of its command line; the first is its name.
pub fn run_with(arguments: Vec<OsString>) -> ExitCode {
    exit_code(run(&parse_plain::<Flags>(&arguments)))
}

fn run(flags: &Flags) -> InputResult<()> {
    if !(1.0..=3600.0).contains(&flags.seconds) {
        return Err(InputError::new("--seconds", format!("{} is out of range", flags.seconds), "use 1 to 3600"));
    }
    // The file must be large enough to keep the drive busy with the largest transfers.
    if !((64 << 20)..=(1 << 40)).contains(&flags.file) {
        return Err(InputError::new(
            "--file",
            format!("{} is out of range", format_bytes(flags.file)),
            "use 64MiB to 1TiB",
        ));
    }
    warn_about(&flags.dir);
    let cases = cases();
    let limits = Limits {
        file_bytes: flags.file - flags.file % (1 << 20),
        seconds: flags.seconds,
        written_bytes: flags.written,
    };
    let bar = new_bar(1000, "measuring {bar:40} {percent} %");
    let sweep = sweep(&flags.dir, &cases, limits, &mut |share| bar.set_position((share * 1000.0) as u64));
    bar.finish_and_clear();
    let sweep = sweep?;
    sweep.notes.iter().for_each(|note| gsscale::say!("note: {note}"));
    print_tables(&sweep);
    gsscale::say!(
        "\n{} complete rounds, {} written to the drive; the test files are removed.",
        sweep.rounds,
        format_bytes(sweep.written_bytes)
    );
    print_advice(&flags.dir, &sweep)
}

fn warn_about(folder: &Path) {
    match FileSystem::of(folder) {
        Ok(FileSystem::Memory) => {
            gsscale::say!("note: this folder is in memory, so the figures are not those of a drive")
        }
        Ok(FileSystem::Remote(kind)) => {
            gsscale::say!("note: this folder is on {kind}; training refuses it as --spill-dir")
        }
        // An unreadable folder is reported when it is used.
        _ => {}
    }
}

/// Bytes transferred for a full page.
fn page_bytes(rows: usize) -> usize {
    transfer_bytes(capacity_bytes(rows, SH_DEGREE))
}

/// The cases: the usual page at the usual depth first, since it matters most; then depths, then sizes.
fn cases() -> Vec<Case> {
    let usual = page_bytes(USUAL_ROWS);
    let depths = [USUAL_DEPTH].into_iter().chain(DEPTHS.into_iter().filter(|&d| d != USUAL_DEPTH));
    let sizes = PAGE_ROWS.map(page_bytes).into_iter().chain(POWERS).filter(|&b| b != usual);
    let shapes: Vec<(usize, usize)> = depths.map(|d| (usual, d)).chain(sizes.map(|b| (b, USUAL_DEPTH))).collect();
    shapes.iter().flat_map(|&(bytes, depth)| ENGINES.map(|engine| Case { engine, bytes, depth })).collect()
}

fn find(sweep: &Sweep, engine: IoEngine, bytes: usize, depth: usize) -> Option<&MeasuredCase> {
    sweep.measured.iter().find(|m| m.case == Case { engine, bytes, depth })
}

fn print_tables(sweep: &Sweep) {
    let heads: Vec<String> = ENGINES.iter().map(|e| format!("{:>15}", e.name())).collect();
    let heads = heads.concat();
    gsscale::say!("MB/s, random reads / durable random writes\n");
    gsscale::say!("{:>22}{heads}", format!("{USUAL_DEPTH} at once"));
    let pages = PAGE_ROWS.map(|rows| (format!("page of {rows} rows"), page_bytes(rows)));
    let powers = POWERS.map(|bytes| (format_bytes(bytes as u64), bytes));
    for (name, bytes) in pages.into_iter().chain(powers) {
        print_line(sweep, &name, bytes, USUAL_DEPTH);
    }
    gsscale::say!("\n{:>22}{heads}", format!("page of {USUAL_ROWS} rows"));
    for depth in DEPTHS {
        print_line(sweep, &format!("{depth} at once"), page_bytes(USUAL_ROWS), depth);
    }
}

fn print_line(sweep: &Sweep, name: &str, bytes: usize, depth: usize) {
    let rate = |r: Option<f64>| r.map_or("-".into(), |r| format!("{:.0}", r / 1e6));
    let mut line = format!("{name:>22}");
    for engine in ENGINES {
        let measured = find(sweep, engine, bytes, depth);
        let text = measured.map_or("-".into(), |m| format!("{} / {}", rate(m.read), rate(m.write)));
        line.push_str(&format!("{text:>15}"));
    }
    gsscale::say!("{line}");
}

/// Recommended settings.
#[derive(Debug, PartialEq)]
struct Advice {
    engine: IoEngine,
    page_rows: usize,
    codec: Codec,
}

/// The first engine that equals the best one, then its smallest page that equals its best page (smaller pages waste
/// fewer rows on views that see only part of them).
fn advise(sweep: &Sweep) -> Option<Advice> {
    let both = |engine, rows| find(sweep, engine, page_bytes(rows), USUAL_DEPTH).and_then(MeasuredCase::both);
    let best = ENGINES.iter().filter_map(|&e| both(e, USUAL_ROWS)).fold(0.0, f64::max);
    let engine = ENGINES.into_iter().find(|&e| both(e, USUAL_ROWS).is_some_and(|r| r >= AS_GOOD * best))?;
    let best = PAGE_ROWS.iter().filter_map(|&rows| both(engine, rows)).fold(0.0, f64::max);
    let is_good = |&rows: &usize| both(engine, rows).is_some_and(|r| r >= AS_GOOD * best);
    let page_rows = PAGE_ROWS.into_iter().find(is_good)?;
    Some(Advice { engine, page_rows, codec: codec_for(both(engine, page_rows)?) })
}

fn print_advice(folder: &Path, sweep: &Sweep) -> InputResult<()> {
    let Some(advice) = advise(sweep) else {
        let problem = "the time was too short to measure anything";
        return Err(InputError::new(
            folder,
            problem,
            "give more time with --seconds, or measure with a smaller --file",
        ));
    };
    gsscale::say!("\n# for this drive; a resumed run cannot change page-rows");
    gsscale::say!("io = \"{}\"", advice.engine);
    gsscale::say!("page-rows = {}", advice.page_rows);
    gsscale::say!("spill-codec = \"{}\"", advice.codec);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A drive of known rates: requests cost a fixed time, plus bytes at a rate that depends on the engine.
    fn imagined(rate_of: impl Fn(IoEngine) -> f64, seconds_per_request: f64) -> Sweep {
        let measured = cases().into_iter().map(|case| {
            let bytes = case.bytes as f64;
            let rate = Some(bytes / (bytes / rate_of(case.engine) + seconds_per_request));
            MeasuredCase { case, read: rate, write: rate }
        });
        Sweep { measured: measured.collect(), notes: Vec::new(), rounds: 1, written_bytes: 0 }
    }

    #[test]
    fn advice_follows_the_figures() {
        let same = advise(&imagined(|_| 3e9, 0.0)).unwrap();
        assert_eq!(same, Advice { engine: IoEngine::Uring, page_rows: 128, codec: Codec::Raw });
        let slow_ring = |engine| if engine == IoEngine::Uring { 1e9 } else { 3e9 };
        assert_eq!(advise(&imagined(slow_ring, 0.0)).unwrap().engine, IoEngine::Pread);
        // At 3 GB/s a page of 4096 rows takes 1 ms, so 0.1 ms per request matters for smaller pages.
        let costly = advise(&imagined(|_| 3e9, 1e-4)).unwrap();
        assert!(costly.page_rows > 512, "{costly:?}");
        let disk = advise(&imagined(|_| 2e8, 0.0)).unwrap();
        assert_eq!(disk.codec, Codec::Zstd { level: 1 });
        let nothing = Sweep { measured: Vec::new(), notes: Vec::new(), rounds: 0, written_bytes: 0 };
        assert_eq!(advise(&nothing), None);
    }

    #[test]
    fn no_case_is_measured_twice() {
        let cases = cases();
        for (i, case) in cases.iter().enumerate() {
            assert!(!cases[..i].contains(case), "{case:?}");
        }
    }
}
