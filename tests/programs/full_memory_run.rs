//! A full drive under a run in memory: its commits and each of its results wait for space and say so, and the results are those of a run
//! with room. If no space is freed, the run ends with its last commit, and says what can be saved on another drive.

use crate::support::scenes::{classic, stderr, summary, text, train, wide_city};
use crate::support::small_drive::Small;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const MIB: u64 = 1 << 20;
/// Enough for everything.
const ROOM: u64 = 400 * MIB;

const FLAGS: &str = "--steps 100 --page-rows 32 --max-gaussians 9000 --view-order groups:4 --test-every 8 --device cpu \
    --quiet --threads 1 --export spz --log tensorboard";

/// Flags that a test may give otherwise.
const USUAL: [[&str; 2]; 2] = [["--log-every", "2"], ["--refine-start", "1000"]];

struct Bench {
    folder: TempDir,
    scene: PathBuf,
    drive: Small,
}

/// A run on the small drive, and what it has said so far.
struct Run {
    child: Child,
    said: String,
}

impl Bench {
    /// `None` if this user may not mount drives.
    fn new() -> Option<Bench> {
        let folder = TempDir::new().unwrap();
        let scene = wide_city(folder.path(), 8_000);
        let drive = Small::mount(&folder.path().join("drive"), ROOM)?;
        Some(Bench { scene, drive, folder })
    }

    fn out(&self) -> PathBuf {
        self.drive.0.join("out")
    }

    fn args(&self, out: &Path, more: &[&str]) -> Vec<String> {
        let mut args = vec![text(&self.scene), "--out", text(out)];
        args.extend(FLAGS.split_whitespace());
        args.extend(classic(&args));
        args.extend(USUAL.iter().filter(|[flag, _]| !more.contains(flag)).flatten());
        [&args[..], more].concat().iter().map(ToString::to_string).collect()
    }

    /// The PLY and the files of a run with room.
    fn alone(&self, more: &[&str]) -> (Vec<u8>, Vec<PathBuf>) {
        let out = self.folder.path().join("alone");
        let args = self.args(&out, &[&["--commit-every", "0"], more].concat());
        let output = train(&args.iter().map(String::as_str).collect::<Vec<_>>());
        assert!(output.status.success(), "{}", stderr(&output));
        (std::fs::read(out.join("point_cloud.ply")).unwrap(), files(&out))
    }

    fn begin(&self, more: &[&str]) -> Run {
        let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
        let command = command.args(self.args(&self.out(), more)).stdout(Stdio::null()).stderr(Stdio::piped());
        Run { child: command.spawn().unwrap(), said: String::new() }
    }

    /// Waits until the run has logged this many commits.
    fn wait_for_commits(&self, least: u64) {
        let commits = |line: &str| serde_json::from_str::<serde_json::Value>(line).ok()?["commits"].as_u64();
        let metrics = || std::fs::read_to_string(self.out().join("metrics.jsonl")).unwrap_or_default();
        wait_until("a commit", || metrics().lines().filter_map(commits).any(|commits| commits >= least));
    }

    /// Takes all space of the drive but `left` bytes, into the file of an earlier call if there is one.
    fn fill(&self, left: u64) -> PathBuf {
        let path = self.drive.0.join("other");
        let mut other = std::fs::File::options().create(true).append(true).open(&path).unwrap();
        while other.write_all(&[0; 1 << 16]).is_ok() {}
        while other.write_all(&[0; 4096]).is_ok() {}
        let taken = other.metadata().unwrap().len();
        other.set_len(taken.saturating_sub(left)).unwrap();
        path
    }
}

impl Run {
    /// Reads what the run says until `words` come; false if it ended before.
    fn wait_for(&mut self, words: &str) -> bool {
        let mut bytes = [0; 4096];
        while !self.said.contains(words) {
            match self.child.stderr.as_mut().unwrap().read(&mut bytes) {
                Ok(n @ 1..) => self.said.push_str(&String::from_utf8_lossy(&bytes[..n])),
                _ => return false,
            }
        }
        true
    }

    fn end(mut self) -> (Option<i32>, String) {
        self.child.stderr.as_mut().unwrap().read_to_string(&mut self.said).unwrap();
        (self.child.wait().unwrap().code(), self.said)
    }
}

/// The files below a folder, by their paths, without event files (whose names tell the time), pages and the lock.
fn files(folder: &Path) -> Vec<PathBuf> {
    let (mut files, mut folders) = (Vec::new(), vec![folder.to_path_buf()]);
    while let Some(next) = folders.pop() {
        for path in std::fs::read_dir(next).unwrap().map(|entry| entry.unwrap().path()) {
            let name = path.file_name().unwrap().to_str().unwrap();
            match path.is_dir() {
                true if name != "tensorboard" && name != "checkpoint" => folders.push(path),
                false => files.push(path.strip_prefix(folder).unwrap().to_path_buf()),
                true => {}
            }
        }
    }
    files.sort();
    files
}

fn wait_until(what: &str, is_so: impl Fn() -> bool) {
    let began = Instant::now();
    while !is_so() {
        assert!(began.elapsed() < Duration::from_secs(120), "{what} does not happen");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn commits_of_a_run_in_memory_wait_for_space() {
    let Some(bench) = Bench::new() else { return };
    let (want, all) = bench.alone(&[]);
    // Room for a PLY, without which no run begins, and not for a commit.
    let other = bench.fill(want.len() as u64 + 100_000);
    let mut run = bench.begin(&["--commit-every", "0.02", "--disk-full-wait", "300"]);
    assert!(run.wait_for("paused:"), "{}", run.said);
    std::thread::sleep(Duration::from_millis(200));
    assert!(run.child.try_wait().unwrap().is_none(), "it waits");
    std::fs::remove_file(other).unwrap();
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("No space") && said.contains("--disk-full-wait") && said.contains("there is space again"),
        "{said}"
    );
    assert!(std::fs::read(bench.out().join("point_cloud.ply")).unwrap() == want, "waiting changed the scene");
    assert_eq!(files(&bench.out()), all);
}

/// The drive has room for the PLY of the first Gaussians, so that the run begins, and not for that of the grown scene. Then there is room for
/// the PLY and a tenth of it, which is less than the file for viewers takes while it is written: that file waits, and the run says
/// that the PLY is whole.
#[test]
fn each_result_of_a_run_in_memory_waits_for_space() {
    let Some(bench) = Bench::new() else { return };
    // Lines of metrics wait too, so only the last step has one.
    let grows = ["--refine-start", "20", "--refine-every", "20", "--log-every", "1000"];
    let (want, all) = bench.alone(&grows);
    let ply = want.len() as u64;
    let first = 8_000 * 248;
    assert!(ply > first + 200_000, "the scene hardly grew: {ply} bytes");
    let path = bench.fill(first + 100_000);
    let mut run = bench.begin(&[&grows[..], &["--commit-every", "0", "--disk-full-wait", "300"]].concat());
    assert!(run.wait_for("paused:"), "{}", run.said);
    assert!(!bench.out().join("point_cloud.ply").exists(), "{}", run.said);
    bench.fill(ply + ply / 10);
    assert!(run.wait_for("point_cloud.ply is whole and can be copied"), "{}", run.said);
    assert!(std::fs::read(bench.out().join("point_cloud.ply")).unwrap() == want, "it is whole");
    std::fs::remove_file(path).unwrap();
    let (code, said) = run.end();
    assert_eq!(code, Some(0), "{said}");
    assert!(said.matches("paused:").count() >= 2, "{said}");
    assert_eq!((files(&bench.out()), summary(&bench.out())["finished"] == true), (all, true));
}

#[test]
fn a_drive_that_stays_full_ends_a_run_in_memory_with_its_last_commit() {
    let Some(bench) = Bench::new() else { return };
    let (want, all) = bench.alone(&[]);
    // The run is not over before the little that is left then is taken.
    bench.fill(ROOM / 10);
    let mut run = bench.begin(&["--commit-every", "0.02", "--disk-full-wait", "5"]);
    bench.wait_for_commits(1);
    bench.fill(0);
    assert!(run.wait_for("paused:"), "{}", run.said);
    // A commit that fails gives back what it had taken.
    bench.fill(0);
    let (code, said) = run.end();
    assert_eq!(code, Some(1), "{said}");
    for words in
        ["paused:", "is full: it needs", "the commit after step", "remedy: free space", "gsscale-train --resume"]
    {
        assert!(said.contains(words), "{words} in: {said}");
    }
    std::fs::remove_file(bench.drive.0.join("other")).unwrap();
    let output = train(&["--resume", text(&bench.out()), "--quiet"]);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(std::fs::read(bench.out().join("point_cloud.ply")).unwrap() == want, "the scene is another");
    assert_eq!(files(&bench.out()), all);
}

/// The drive has room for commits and none for the PLY: the run says how to export its last commit to another drive, and a resume writes
/// the results without a step.
#[test]
fn what_a_commit_holds_can_be_saved_on_another_drive() {
    let Some(bench) = Bench::new() else { return };
    let (want, all) = bench.alone(&[]);
    let out = bench.out();
    // Some commits of all pages, so that later ones take their slots.
    let (code, said) = bench.begin(&["--commit-every", "0", "--keep-checkpoint"]).end();
    assert_eq!(code, Some(0), "{said}");
    let resume = |more: &[&str]| train(&[&["--resume", text(&out), "--quiet"], more].concat());
    for steps in ["120", "140", "150"] {
        let output = resume(&["--steps", steps]);
        assert!(output.status.success(), "{}", stderr(&output));
    }
    let before = std::fs::read(out.join("point_cloud.ply")).unwrap();
    bench.fill(want.len() as u64 / 2);
    let output = resume(&["--steps", "160", "--disk-full-wait", "2"]);
    let (code, said) = (output.status.code(), stderr(&output));
    assert_eq!(code, Some(1), "{said}");
    for words in [
        "paused:",
        "is full: it needs space for",
        "point_cloud.ply",
        "the commit after step 160 is intact",
        "gsscale-ckpt export",
    ] {
        assert!(said.contains(words), "{words} in: {said}");
    }
    assert!(!out.join(".point_cloud.ply.part").exists());
    assert!(std::fs::read(out.join("point_cloud.ply")).unwrap() == before, "the earlier result stays");
    let elsewhere = bench.folder.path().join("elsewhere.ply");
    let mut export = Command::new(env!("CARGO_BIN_EXE_gsscale-ckpt"));
    assert!(export.args(["export", text(&out), "--out", text(&elsewhere)]).status().unwrap().success());
    std::fs::remove_file(bench.drive.0.join("other")).unwrap();
    let output = resume(&[]);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(std::fs::read(out.join("point_cloud.ply")).unwrap() == std::fs::read(elsewhere).unwrap());
    assert_eq!((files(&out), summary(&out)["steps"] == 160), (all, true));
}
