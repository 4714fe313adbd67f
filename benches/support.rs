//! Shared by the benchmarks: arguments, wall and CPU time, medians, a hash of results, generated scenes. Measures
//! nothing itself.
//!
//! CPU seconds count all threads of this program, so other load on the machine changes them little. On a system that
//! does not report CPU time they are wall seconds times threads.
#![allow(dead_code)] // each benchmark uses a part of it

pub mod cases;
pub mod cpu_bytes;
pub mod device_bytes;
pub mod floor;
pub mod touched;
pub mod training;

use gsscale::base::machine::cpu_model;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::config::values::Chosen;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;
use gsscale::train::step::pages::PagedScene;
use std::time::{Duration, Instant};

/// Unwraps a result that the measurement needs.
pub fn checked<T, E: std::fmt::Display>(result: Result<T, E>) -> T {
    result.unwrap_or_else(|error| panic!("{error}"))
}

/// The arguments of a benchmark.
#[derive(Debug, Clone, PartialEq)]
pub struct Args {
    /// Whether to measure the real sizes (`cargo bench` passes `--bench`) instead of a tiny case.
    pub real: bool,
    /// Print one JSON object per line instead of text.
    pub json: bool,
    /// Instruction path of `--path`.
    pub path: Option<SimdPath>,
    pub sizes: Vec<usize>,
    /// Parts of names of cases; if not empty, only matching cases run.
    pub only: Vec<String>,
}

impl Args {
    /// Reads the program's arguments; ends the program if an option is unknown.
    pub fn read() -> Args {
        Args::parse(std::env::args().skip(1)).unwrap_or_else(|problem| {
            gsscale::tell!("error: {problem}");
            std::process::exit(2)
        })
    }

    /// Parses arguments; the error is a message.
    pub fn parse(args: impl Iterator<Item = String>) -> Result<Args, String> {
        let mut out = Args { real: false, json: false, path: None, sizes: Vec::new(), only: Vec::new() };
        let mut args = args;
        while let Some(arg) = args.next() {
            match arg.as_str() {
                "--bench" => out.real = true,
                "--json" => out.json = true,
                "--path" => {
                    let name = args.next().unwrap_or_default();
                    let path = SimdPath::from_name(&name).filter(|p| p.is_supported());
                    out.path = Some(path.ok_or_else(|| format!("this machine has no instruction path '{name}'"))?);
                }
                other if other.starts_with('-') => {
                    return Err(format!("{other} is not known; there are --path, --json"));
                }
                other => match other.parse() {
                    Ok(size) => out.sizes.push(size),
                    Err(_) => out.only.push(arg),
                },
            }
        }
        Ok(out)
    }

    /// The instruction path to measure.
    pub fn simd(&self) -> SimdPath {
        self.path.unwrap_or_else(SimdPath::best)
    }

    /// Whether the arguments select the case with this name.
    pub fn wants(&self, case: &str) -> bool {
        self.only.is_empty() || self.only.iter().any(|word| case.contains(word.as_str()))
    }
}

/// The rows in pages in memory, and the options of a run whose colours have all bands from the first step.
pub fn paged(columns: &Columns, scene_scale: f32, simd: SimdPath) -> (PagedScene, RunOptions) {
    let config = TrainConfig { simd: Chosen(Some(simd)), sh_every: 0, ..TrainConfig::default() };
    let options = RunOptions::new(&config, scene_scale);
    let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
    (checked(PagedScene::new(columns, pager, &options)), options)
}

/// Wall and CPU seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seconds {
    /// Wall seconds.
    pub wall: f64,
    /// CPU seconds of all threads.
    pub cpu: f64,
}

/// CPU seconds of all threads of this program so far, in nanosecond resolution.
#[cfg(unix)]
pub fn cpu_seconds() -> Option<f64> {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Some(t.tv_sec as f64 + 1e-9 * t.tv_nsec as f64)
}

/// CPU seconds of all threads of this program so far.
#[cfg(not(unix))]
pub fn cpu_seconds() -> Option<f64> {
    None
}

/// The time of `work`.
pub fn time(mut work: impl FnMut()) -> Seconds {
    let (begin, before) = (Instant::now(), cpu_seconds());
    work();
    let wall = begin.elapsed().as_secs_f64();
    let after = before.and_then(|_| cpu_seconds());
    let cpu = after.zip(before).map_or(wall * rayon::current_num_threads() as f64, |(after, before)| after - before);
    Seconds { wall, cpu }
}

/// Shortest timed batch: the system updates the CPU time of other running threads only at its ticks.
const BATCH: Duration = Duration::from_millis(100);

/// Time of one run of `work`: the medians over batches of runs, measured for at least `least`.
pub fn steady_time(least: Duration, mut work: impl FnMut()) -> Seconds {
    let (start, batch) = (Instant::now(), least.min(BATCH));
    let mut batches = Vec::new();
    loop {
        let mut runs = 0.0;
        let t = time(|| {
            let begin = Instant::now();
            while runs == 0.0 || begin.elapsed() < batch {
                work();
                runs += 1.0;
            }
        });
        batches.push(Seconds { wall: t.wall / runs, cpu: t.cpu / runs });
        if start.elapsed() >= least {
            break;
        }
    }
    Seconds { wall: median(batches.iter().map(|s| s.wall)), cpu: median(batches.iter().map(|s| s.cpu)) }
}

/// The median; for an even count, the mean of the middle two; 0 without values.
pub fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => 0.0,
        n if n % 2 == 1 => values[n / 2],
        n => 0.5 * (values[n / 2 - 1] + values[n / 2]),
    }
}

/// FNV-1a over 64-bit words, to compare the bits of results.
#[derive(Debug, Clone, Copy)]
pub struct Hash(pub u64);

impl Default for Hash {
    fn default() -> Self {
        Hash(0xcbf2_9ce4_8422_2325)
    }
}

impl Hash {
    pub fn add(&mut self, word: u64) {
        for byte in word.to_le_bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

/// One line about the machine and its load, which the figures depend on.
pub fn machine(simd: SimdPath) -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load = load.split_whitespace().next().unwrap_or("unknown").to_string();
    format!("{}, {} threads, path {}, load {load}", cpu_model(), rayon::current_num_threads(), simd.name())
}

/// A rough terrain seen obliquely: rows, and a camera that sees nearly all of them. The Gaussians are flat, sized by
/// their spacing, and mostly half opaque.
pub fn terrain(n: usize, width: u32, height: u32) -> (Columns, Camera) {
    let mut draws = Stream::new(1, Purpose::Test, n as u64, 0);
    let mut c = Columns::zeros(n, 3);
    let spacing = 4.0 / (n as f64).sqrt();
    for row in 0..n {
        let (x, y) = (draws.range(-2.0, 2.0), draws.range(-2.0, 2.0));
        let z = 0.2 * (libm::sin(3.0 * x) + libm::cos(4.0 * y)) + draws.range(-0.15, 0.15);
        c.means[3 * row..3 * row + 3].copy_from_slice(&[x as f32, y as f32, z as f32]);
        for i in 0..4 {
            c.quats[4 * row + i] = draws.normal() as f32;
        }
        for i in 0..3 {
            c.scales[3 * row + i] = libm::log(spacing * libm::exp(0.6 * draws.normal()) * 0.8) as f32;
        }
        c.opacities[row] = draws.range(-2.0, 3.0) as f32;
    }
    c.sh0.iter_mut().chain(&mut c.sh_n).for_each(|x| *x = 0.2 * draws.normal() as f32);
    // The camera looks down at 45 degrees from negative y.
    let h = std::f32::consts::FRAC_1_SQRT_2;
    let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, -h, -h, 0.0], [0.0, h, -h, 3.0]];
    let f = width as f32 * 0.9;
    (c, Camera::pinhole(viewmat, [f, f, 0.5 * width as f32, 0.5 * height as f32], [width, height]))
}
