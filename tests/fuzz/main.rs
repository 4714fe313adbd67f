//! Everything that reads untrusted bytes, fed with damaged ones: the result is a value or an error with a remedy, never a
//! panic, an endless loop, a huge allocation, or a path outside its folder.
//!
//! Each target is a function of bytes. A plain run tries a fixed number of inputs from a fixed seed. On demand,
//! `GSSCALE_FUZZ_SECONDS=60 cargo test --release --test fuzz -- --nocapture` runs each target for that time from a seed of
//! the clock (`GSSCALE_FUZZ_SEED=7`: from that seed). Runners with a process for each test (cargo-nextest) use every core.
//! A failing input is saved; `GSSCALE_FUZZ_INPUT=FILE cargo test --test fuzz NAME` runs it again. Inputs under
//! `tests/fuzz/corpus/NAME/` run every time. This test binary has an allocator of its own, which counts bytes.
//!
//! | target | what it reads |
//! | --- | --- |
//! | `slot_header` | slot headers (also with a valid checksum), slot references, labels, the FORMAT file |
//! | `page_payload` | stored payloads of all codecs; a whole slot through the store |
//! | `map_values` | a page map with valid seals and wrong values |
//! | `run_state` | run states |
//! | `store_dir` | a spill directory with flipped bytes and truncated, removed, swapped, grown or outdated files |
//! | `ply` | PLY, text and binary |
//! | `colmap_binary`, `colmap_text` | the three files of a model |
//! | `transforms` | transforms.json |
//! | `opensfm` | reconstruction.json of OpenSfM and OpenDroneMap |
//! | `reality_capture` | CSV of RealityCapture and RealityScan |
//! | `image_names` | file names in all of the formats: no path leaves its folder |
//! | `config` | config.toml, sizes, orders, codecs |
//! | `torch` | files of PyTorch in Mega-NeRF's layout, and the pickles in them |
//! | `photo` | JPEG and PNG, header, EXIF data and decoding |
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

mod allocation;
#[allow(dead_code)] // other tests use all of it
#[path = "../support/exif.rs"]
mod exif;
#[path = "../support/hush.rs"]
mod hush;
mod mutate;
mod scene_folder;
mod targets;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

const SEED: u64 = 2026;
/// A case that takes longer counts as an endless loop, however busy the machine is.
const ENDLESS: Duration = Duration::from_secs(100);

/// A function that reads untrusted bytes.
pub struct Target {
    /// Name in messages and file names.
    pub name: &'static str,
    /// Panics on a violation.
    pub run: fn(&[u8]),
    /// Valid inputs.
    pub seeds: Vec<Vec<u8>>,
    /// Words of its format.
    pub words: &'static [&'static str],
    /// Inputs of a plain run.
    pub cases: u64,
    /// Most bytes that a case may hold at once: a constant, and a number for each byte of input.
    pub memory: [u64; 2],
}

/// Allocations are counted for the whole process, so one target runs at a time.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// Ends the process if a case does not end.
fn watch(name: &'static str, is_over: &AtomicBool) {
    let mut last = (u64::MAX, Instant::now());
    while !is_over.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(20));
        let case = allocation::CASE.load(Ordering::Relaxed);
        if case != last.0 {
            last = (case, Instant::now());
        } else if last.1.elapsed() > ENDLESS {
            eprintln!("{name}: case {case} does not end");
            std::process::abort();
        }
    }
}

fn number_from(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().and_then(|text| text.parse().ok())
}

fn clock() -> u64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(1, |d| d.as_nanos() as u64)
}

/// Runs one input. Returns its peak memory, or the violation.
fn check(target: &Target, input: &[u8]) -> Result<u64, String> {
    let mut ended = Ok(());
    let peak = allocation::peak_of(|| ended = catch_unwind(AssertUnwindSafe(|| (target.run)(input))));
    if let Err(panic) = ended {
        let text = panic.downcast_ref::<&str>().map(|s| (*s).to_string());
        return Err(text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default());
    }
    let [base, each] = target.memory;
    let allowed = base + each * input.len() as u64;
    if peak > allowed {
        return Err(format!("{peak} bytes were held for {} bytes of input; {allowed} are allowed", input.len()));
    }
    Ok(peak)
}

fn fail(target: &Target, input: &[u8], whence: &str, what: &str) -> ! {
    let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz-{}.bin", target.name));
    std::fs::write(&file, input).unwrap();
    panic!(
        "{} fails on {whence}: {what}\nthe input is saved; GSSCALE_FUZZ_INPUT={} runs it again",
        target.name,
        file.display()
    );
}

fn corpus(name: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus").join(name);
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).into_iter().flatten().map(|e| e.unwrap().path()).collect();
    files.sort();
    files
}

fn fuzz(target: fn() -> Target) {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    hush::hush_library_panics();
    let target = target();
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| watch(target.name, &is_over));
        let ended = catch_unwind(AssertUnwindSafe(|| run_all(&target)));
        is_over.store(true, Ordering::Relaxed);
        if let Err(panic) = ended {
            std::panic::resume_unwind(panic);
        }
    });
}

fn run_all(target: &Target) {
    let one = std::env::var_os("GSSCALE_FUZZ_INPUT").map(PathBuf::from);
    for file in one.clone().into_iter().chain(corpus(target.name)) {
        let input = std::fs::read(&file).unwrap();
        check(target, &input).unwrap_or_else(|what| fail(target, &input, &file.display().to_string(), &what));
    }
    for input in &target.seeds {
        check(target, input).unwrap_or_else(|what| fail(target, input, "a seed", &what));
    }
    if one.is_some() {
        return;
    }
    let seconds = number_from("GSSCALE_FUZZ_SECONDS");
    let seed = number_from("GSSCALE_FUZZ_SEED").unwrap_or_else(|| if seconds.is_some() { clock() } else { SEED });
    let traces = std::env::var_os("GSSCALE_FUZZ_TRACE").is_some();
    let (start, mut most, mut cases) = (Instant::now(), [0, 0], 0);
    let is_more = |cases: u64| seconds.map_or(cases < target.cases, |s| start.elapsed().as_secs() < s);
    while is_more(cases) {
        allocation::CASE.store(cases, Ordering::Relaxed);
        if traces {
            eprintln!("{}: case {cases}", target.name);
        }
        let input = mutate::Draws::of(target.name, seed, cases).input(&target.seeds, target.words);
        let whence = format!("case {cases} of seed {seed}");
        let peak = check(target, &input).unwrap_or_else(|what| fail(target, &input, &whence, &what));
        most = most.max([peak, input.len() as u64]);
        cases += 1;
    }
    let took = start.elapsed().as_secs_f64();
    println!("{}: {cases} cases of seed {seed} in {took:.1} s; most memory {} KiB", target.name, most[0] >> 10);
}

macro_rules! tests {
    ($($name:ident),+ $(,)?) => { $( #[test] fn $name() { fuzz(targets::$name); } )+ };
}

tests!(
    slot_header,
    page_payload,
    map_values,
    run_state,
    store_dir,
    ply,
    colmap_binary,
    colmap_text,
    transforms,
    opensfm,
    reality_capture,
    image_names,
    config,
    torch,
    photo,
);

/// The memory that [`gsscale::dataset::photo_header`] announces against the memory that decoding holds, for every pixel
/// format.
#[test]
fn photos_are_decoded_within_what_their_headers_announce() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    for (name, bytes) in targets::pictures() {
        for (what, peak, announced) in targets::decoded(&bytes) {
            // Decompressor windows and rows: less than half a byte for each of 3 million pixels, so that an
            // announcement one byte too small shows.
            assert!(peak <= announced + (1 << 20), "{name} as {what}: {peak} bytes were held, {announced} announced");
        }
    }
}
