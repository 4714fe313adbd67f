//! What the benchmarks share: arguments, time by wall clock and by CPU, medians, a hash of results, and made-up scenes.
//! Measures nothing itself.
//!
//! CPU seconds are those of all threads of this program. They are the figure to compare on a machine that does other
//! work too; where the system does not tell them they are wall seconds times threads.
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
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;
use std::time::{Duration, Instant};

/// A result without which there is nothing to measure.
pub fn checked<T, E: std::fmt::Display>(result: Result<T, E>) -> T {
    result.unwrap_or_else(|error| panic!("{error}"))
}

/// What was asked for on the command line.
#[derive(Debug, Clone, PartialEq)]
pub struct Args {
    /// The real size (`cargo bench` says so by `--bench`); otherwise the tiny one.
    pub real: bool,
    /// One JSON object a line instead of text.
    pub json: bool,
    /// Instruction path, if one was named with `--path`.
    pub path: Option<SimdPath>,
    /// Numbers given: sizes.
    pub sizes: Vec<usize>,
    /// Words given: only cases whose name holds one of them.
    pub only: Vec<String>,
}

impl Args {
    /// Reads the program's arguments; ends it when an option is unknown.
    pub fn read() -> Args {
        Args::parse(std::env::args().skip(1)).unwrap_or_else(|problem| {
            eprintln!("error: {problem}");
            std::process::exit(2)
        })
    }

    /// Reads arguments; the error is a sentence.
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

    /// The path to measure.
    pub fn simd(&self) -> SimdPath {
        self.path.unwrap_or_else(SimdPath::best)
    }

    /// Whether the case of this name was asked for.
    pub fn wants(&self, case: &str) -> bool {
        self.only.is_empty() || self.only.iter().any(|word| case.contains(word.as_str()))
    }
}

/// Wall and CPU seconds of some work.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seconds {
    /// By the clock.
    pub wall: f64,
    /// Of all threads.
    pub cpu: f64,
}

/// CPU seconds of all threads that this program has had, by the nanosecond.
#[cfg(unix)]
pub fn cpu_seconds() -> Option<f64> {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Some(t.tv_sec as f64 + 1e-9 * t.tv_nsec as f64)
}

/// CPU seconds of all threads that this program has had.
#[cfg(not(unix))]
pub fn cpu_seconds() -> Option<f64> {
    None
}

/// The time that `work` takes.
pub fn time(mut work: impl FnMut()) -> Seconds {
    let (begin, before) = (Instant::now(), cpu_seconds());
    work();
    let wall = begin.elapsed().as_secs_f64();
    let after = before.and_then(|_| cpu_seconds());
    let cpu = after.zip(before).map_or(wall * rayon::current_num_threads() as f64, |(after, before)| after - before);
    Seconds { wall, cpu }
}

/// Least length of what is timed at once: the system books the time of other running threads at its ticks only.
const BATCH: Duration = Duration::from_millis(100);

/// Time of one run of `work`: the medians over batches of runs, for at least as long as `least`.
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

/// The middle value; of an even number, the mean of the middle two. 0 of none.
pub fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => 0.0,
        n if n % 2 == 1 => values[n / 2],
        n => 0.5 * (values[n / 2 - 1] + values[n / 2]),
    }
}

/// FNV-1a over 64-bit words: the same bits of a result give the same number.
#[derive(Debug, Clone, Copy)]
pub struct Hash(pub u64);

impl Default for Hash {
    fn default() -> Self {
        Hash(0xcbf2_9ce4_8422_2325)
    }
}

impl Hash {
    /// Adds a word.
    pub fn add(&mut self, word: u64) {
        for byte in word.to_le_bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

/// One line about the machine and how busy it is: figures mean little without it.
pub fn machine(simd: SimdPath) -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load = load.split_whitespace().next().unwrap_or("unknown").to_string();
    format!("{}, {} threads, path {}, load {load}", cpu_model(), rayon::current_num_threads(), simd.name())
}

/// A rough terrain seen obliquely, covered by flat Gaussians whose size follows their spacing; most are half opaque.
/// Rows and a camera that sees nearly all of them.
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
    // Looks down at 45 degrees from the side of negative y.
    let h = std::f32::consts::FRAC_1_SQRT_2;
    let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, -h, -h, 0.0], [0.0, h, -h, 3.0]];
    let f = width as f32 * 0.9;
    let (cx, cy) = (0.5 * width as f32, 0.5 * height as f32);
    (c, Camera { viewmat, fx: f, fy: f, cx, cy, width, height, near_plane: 0.01, far_plane: 1e10 })
}
