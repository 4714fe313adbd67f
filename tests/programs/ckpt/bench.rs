//! Runs that are stopped early, and the output of `gsscale-ckpt` on their stores.

use crate::support::scenes::{classic, stderr, text, train};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::codec::Codec;
use gsscale::page::map::commit::Commits;
use gsscale::page::map::opening::StoredPage;
use gsscale::page::tool::reading::{Access, StoreReader, WitnessRule, commit_config};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Rounds, resets and raises of the SH degree before the stop; pages that split.
const BUSY: &[&str] = &[
    "--steps",
    "400",
    "--page-rows",
    "32",
    "--grow-grad2d",
    "0.001",
    "--refine-start",
    "15",
    "--refine-every",
    "10",
    "--refine-stop",
    "100",
    "--reset-every",
    "40",
    "--sh-every",
    "20",
    "--view-order",
    "groups:4",
    "--log-every",
    "3",
    "--eval-every",
    "12",
    "--test-every",
    "12",
    "--device",
    "cpu",
    "--frames",
    "4000",
    "--commit-every",
    "0",
    "--quiet",
];

/// Names of the pages that differ between two generations of a store.
pub fn changed_pages(store: &Path, from: u64, to: u64) -> Vec<String> {
    let store = StoreReader::open(store, Access::Map, WitnessRule::Obeyed).unwrap();
    let before = store.pages_at(from).unwrap();
    let is_changed = |page: &StoredPage| before.iter().any(|b| b.page == page.page && b.slot != page.slot);
    store.pages_at(to).unwrap().iter().filter(|page| is_changed(page)).map(|page| page.page.to_string()).collect()
}

/// Flags of a run without events.
pub const EVENTLESS: &[&str] = &["--strategy", "none", "--sh-every", "0"];

/// The usual flags; a key in `more` replaces the usual one.
pub fn with<'a>(more: &[&'a str]) -> Vec<&'a str> {
    let pairs = BUSY.chunks(2).filter(|pair| !more.contains(&pair[0]));
    pairs.flatten().chain(more).copied().collect()
}

/// A scene, and one run on it at a time.
pub struct Bench {
    folder: TempDir,
    scene: PathBuf,
}

impl Bench {
    pub fn new() -> Bench {
        let folder = TempDir::new().unwrap();
        let scene = folder.path().join("scene");
        let (views, width, height, points) = (24, 48, 36, 3000);
        let blocks = Some(12);
        let city =
            CityOptions { seed: 5, views, width, height, points, blocks, supersample: 1, ..CityOptions::default() };
        write_city(&scene, &city, &|_, _| {}).unwrap();
        Bench { folder, scene }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn spill(&self) -> PathBuf {
        self.path("spill")
    }

    /// The PLY of the run.
    pub fn ply(&self) -> Vec<u8> {
        std::fs::read(self.path("out/point_cloud.ply")).unwrap()
    }

    /// The PLY of the uninterrupted run.
    pub fn alone(&self) -> Vec<u8> {
        std::fs::read(self.run_alone(&[]).join("point_cloud.ply")).unwrap()
    }

    /// The folder of the uninterrupted run, in memory.
    pub fn run_alone(&self, more: &[&str]) -> PathBuf {
        let out = self.path("alone");
        let output = train(&[&[text(&self.scene), "--out", text(&out)], &with(more)[..]].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        out
    }

    /// A run in progress.
    pub fn running(&self, more: &[&str]) -> (PathBuf, Child) {
        let (out, spill) = (self.path("out"), self.spill());
        let mut args = vec![text(&self.scene), "--out", text(&out), "--spill-dir", text(&spill)];
        args.extend(with(more));
        let mut child = spawn(&args);
        self.wait_for_lines(&mut child, 20);
        (out, child)
    }

    /// A run stopped twice, some steps apart, long before its end: two generations.
    pub fn stopped(&self, more: &[&str]) -> PathBuf {
        let (out, child) = self.running(more);
        stop(child);
        self.go_on_until_stopped(&[]);
        out
    }

    /// Resumes the run to its end.
    pub fn go_on(&self, more: &[&str]) {
        let output = train(&[&["--resume", text(&self.path("out")), "--quiet"], more].concat());
        assert!(output.status.success(), "{}", stderr(&output));
    }

    /// Resumes the run for a few steps.
    pub fn go_on_until_stopped(&self, more: &[&str]) {
        stop(self.going_on(more));
    }

    /// A resumed run, some steps later.
    pub fn going_on(&self, more: &[&str]) -> Child {
        let lines = self.lines();
        let mut child = spawn(&[&["--resume", text(&self.path("out")), "--quiet"], more].concat());
        self.wait_for_lines(&mut child, lines + 4);
        child
    }

    fn lines(&self) -> usize {
        std::fs::read_to_string(self.path("out/metrics.jsonl")).map_or(0, |text| text.lines().count())
    }

    fn wait_for_lines(&self, child: &mut Child, lines: usize) {
        let started = Instant::now();
        while self.lines() < lines {
            assert!(child.try_wait().unwrap().is_none(), "the run ended before it could be stopped");
            assert!(started.elapsed() < Duration::from_secs(120), "the run does not get on");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Exports to a new file each time.
    pub fn export(&self, dir: &Path, more: &[&str]) -> PathBuf {
        let file = (0..).map(|i| self.path(&format!("export{i}.ply"))).find(|path| !path.exists()).unwrap();
        ckpt(&[&["export", text(dir), "--out", text(&file)], more].concat());
        file
    }

    /// Clones to a new folder each time.
    pub fn copy(&self, command: &str, dir: &Path) -> PathBuf {
        let to = (0..).map(|i| self.path(&format!("copy{i}"))).find(|path| !path.exists()).unwrap();
        ckpt(&[command, text(dir), text(&to)]);
        to
    }

    /// Every file of the spill directory with its bytes and modification time.
    pub fn store_files(&self) -> BTreeMap<PathBuf, (Vec<u8>, std::time::SystemTime)> {
        let entries = std::fs::read_dir(self.spill()).unwrap().map(|entry| entry.unwrap().path());
        entries
            .map(|path| {
                let written = std::fs::metadata(&path).unwrap().modified().unwrap();
                let bytes = std::fs::read(&path).unwrap();
                (path, (bytes, written))
            })
            .collect()
    }
}

fn spawn(args: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
    command.args(args).args(classic(args)).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Sends SIGTERM and waits.
pub fn stop(child: Child) {
    assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143), "{}", stderr(&output));
}

pub fn run(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gsscale-ckpt")).args(args).output().unwrap()
}

/// The output of a successful call.
pub fn ckpt(args: &[&str]) -> String {
    let output = run(args);
    assert!(output.status.success(), "{args:?}: {}", stderr(&output));
    String::from_utf8(output.stdout).unwrap()
}

/// The output with `--json`.
pub fn json(args: &[&str]) -> serde_json::Value {
    serde_json::from_str(&ckpt(&[args, &["--json"]].concat())).unwrap()
}

/// The message of a failing call, which prints nothing else.
pub fn failed(args: &[&str]) -> String {
    let output = run(args);
    assert!(matches!(output.status.code(), Some(1 | 2)), "{args:?}: {output:?}");
    stderr(&output)
}

/// Names generations, as the trainer does.
pub fn pin(spill: &Path, names: &[(&str, u64)]) {
    let dir = SpillDir::open(spill, true).unwrap();
    let mut opened = Commits::open(Box::new(DriveFolder::new(spill)), commit_config(dir.format().store)).unwrap();
    let engine = open_engine(IoEngine::Pread, spill, 1).unwrap();
    let mut store = opened.paged_store(engine.store, dir.format().layout, Codec::Raw).unwrap();
    let names: Vec<(String, u64)> = names.iter().map(|(name, generation)| ((*name).to_string(), *generation)).collect();
    opened.commits.pin(&mut store, &names, &[]).unwrap();
}

/// A PLY of floats, read without gsscale's reader.
pub struct Ply {
    pub names: Vec<String>,
    pub rows: Vec<Vec<f32>>,
}

impl Ply {
    pub fn read(path: &Path) -> Ply {
        let bytes = std::fs::read(path).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&bytes[..end]).unwrap();
        let names: Vec<String> =
            header.lines().filter_map(|l| l.strip_prefix("property float ")).map(str::to_string).collect();
        let value = |b: &[u8]| f32::from_le_bytes(b.try_into().unwrap());
        let rows: Vec<Vec<f32>> =
            bytes[end..].chunks_exact(4 * names.len()).map(|row| row.chunks_exact(4).map(value).collect()).collect();
        let count = header.lines().find_map(|l| l.strip_prefix("element vertex ")).unwrap();
        assert_eq!(rows.len(), count.parse::<usize>().unwrap());
        Ply { names, rows }
    }

    /// The median of each coordinate.
    pub fn median(&self) -> [f64; 3] {
        std::array::from_fn(|i| {
            let mut values: Vec<f32> = self.rows.iter().map(|row| row[i]).collect();
            values.sort_by(f32::total_cmp);
            f64::from(values[values.len() / 2])
        })
    }

    /// Opacity times the area of the two longest axes.
    pub fn visibility(&self, row: &[f32]) -> f64 {
        let at = |name: &str| f64::from(row[self.names.iter().position(|n| n == name).unwrap()]);
        let mut scales = [at("scale_0"), at("scale_1"), at("scale_2")];
        scales.sort_by(f64::total_cmp);
        (scales[1] + scales[2]).exp() / (1.0 + (-at("opacity")).exp())
    }
}

/// A run of a few steps from the Gaussians of `init`.
pub fn train_from(bench: &Bench, init: &Path, out: &str) -> Vec<u8> {
    let out = bench.path(out);
    let more =
        ["--init-ply", text(init), "--steps", "12", "--page-rows", "32", "--refine-start", "4", "--refine-every", "4"];
    let args =
        [&[text(&bench.scene), "--out", text(&out), "--quiet", "--device", "cpu", "--grow-grad2d", "0.001"], &more[..]];
    let output = train(&args.concat());
    assert!(output.status.success(), "{}", stderr(&output));
    std::fs::read(out.join("point_cloud.ply")).unwrap()
}
