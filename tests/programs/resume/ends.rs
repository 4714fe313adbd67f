//! kill -9 before the first step and after the last one: while the scene is read, before config.toml is there, and while each result is
//! written. A resume begins the run again or writes its results, and ends with the same bytes.

use super::bench::{ended, ply, succeeded};
use crate::support::scenes::{city, stderr, text, train};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const FLAGS: &str =
    "--steps 20 --page-rows 64 --max-gaussians 3000 --test-every 4 --device cpu --quiet --export spz --threads 2";

struct Bench {
    folder: TempDir,
    scene: PathBuf,
}

impl Bench {
    fn new() -> Bench {
        let folder = TempDir::new().unwrap();
        let scene = city(folder.path(), 16, 64, 48, 2000);
        Bench { scene, folder }
    }

    fn begin(&self, out: &Path, more: &[&str]) -> Child {
        let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
        let command = command.args([text(&self.scene), "--out", text(out)]).args(FLAGS.split_whitespace()).args(more);
        command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
    }

    /// Starts a run, and kills it as soon as one of the files is there, or when it ends.
    fn killed_at(&self, out: &Path, more: &[&str], files: &[&str]) {
        let mut child = self.begin(out, more);
        let began = Instant::now();
        while child.try_wait().unwrap().is_none() && !files.iter().any(|file| out.join(file).exists()) {
            assert!(began.elapsed() < Duration::from_secs(120), "{files:?} do not appear");
        }
        let _ = child.kill();
        ended(child);
    }
}

/// The files of a run by their names, with the bytes of those that tell no time.
fn files(out: &Path) -> BTreeMap<String, Vec<u8>> {
    let (mut files, mut folders) = (BTreeMap::new(), vec![out.to_path_buf()]);
    while let Some(next) = folders.pop() {
        for path in std::fs::read_dir(next).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.strip_prefix(out).unwrap().to_str().unwrap().to_string();
            let tells_time =
                ["report.html", "summary.json", "metrics.jsonl", "config.toml", "pages.json"].contains(&name.as_str());
            let bytes = if tells_time { Vec::new() } else { std::fs::read(&path).unwrap() };
            files.insert(name, bytes);
        }
    }
    files
}

#[test]
fn a_run_that_is_killed_while_it_writes_its_results_ends_with_the_same_files() {
    let bench = Bench::new();
    let alone = bench.folder.path().join("alone");
    succeeded(bench.begin(&alone, &[]));
    let want = files(&alone);
    let spill = bench.folder.path().join("spill");
    let to_spill = ["--spill-dir", text(&spill), "--spill-codec", "raw"];
    for (i, (begun, done)) in [
        (".point_cloud.ply.part", "point_cloud.ply"),
        ("point_cloud.ply", "point_cloud.transform.json"),
        (".point_cloud.spz.part", "point_cloud.spz"),
        ("renders/test", "renders/test/views.json"),
        (".summary.json.part", "summary.json"),
        (".report.html.part", "report.html"),
    ]
    .into_iter()
    .enumerate()
    {
        // Without a commit, in memory and through the drive, and with one.
        for (kind, more) in [(0, &["--commit-every", "0"][..]), (1, &["--commit-every", "0.02"]), (2, &to_spill)] {
            let out = bench.folder.path().join(format!("out-{i}-{kind}"));
            bench.killed_at(&out, more, &[begun, done]);
            let output = train(&["--resume", text(&out), "--quiet"]);
            assert!(output.status.success(), "{begun}, {more:?}: {}", stderr(&output));
            let got = files(&out);
            assert_eq!(got.keys().collect::<Vec<_>>(), want.keys().collect::<Vec<_>>(), "{begun}, {more:?}");
            assert!(got == want, "{begun}, {more:?}: other bytes");
            let _ = std::fs::remove_dir_all(&spill);
        }
    }
}

/// The moment between the mark of a run and its config.toml is that of reading photos and making pages.
#[test]
fn a_run_that_is_killed_before_its_config_is_there_begins_again() {
    let bench = Bench::new();
    let alone = bench.folder.path().join("alone");
    succeeded(bench.begin(&alone, &[]));
    let want = files(&alone);
    let spill = bench.folder.path().join("spill");
    let mut marked = 0;
    for (i, more) in
        [&[][..], &["--spill-dir", text(&spill), "--spill-codec", "raw"]].into_iter().cycle().take(6).enumerate()
    {
        // A path of two new folders, and settings that are not the defaults.
        let out = bench.folder.path().join(format!("new-{i}/out"));
        bench.killed_at(&out, more, &[".gsscale-begun.toml", "config.toml"]);
        marked += u32::from(!out.join("config.toml").exists());
        if i == 2 {
            // The first command again is as good.
            succeeded(bench.begin(&out, more));
        } else {
            let said = train(&["--resume", text(&out), "--dry-run"]);
            assert!(
                stderr(&said).is_empty() && String::from_utf8_lossy(&said.stdout).contains("begins again"),
                "{said:?}"
            );
            let output = train(&["--resume", text(&out)]);
            assert!(output.status.success() && stderr(&output).contains("begins again"), "{}", stderr(&output));
        }
        assert!(files(&out) == want, "{more:?}: {:?}", files(&out).keys());
        assert!(!spill.join("FORMAT").exists());
    }
    assert!(marked > 0, "each kill came after config.toml");
}

/// A run that replaces an earlier one, and is killed at the end of the old files.
#[test]
fn a_run_that_is_killed_while_it_replaces_another_begins_again() {
    let bench = Bench::new();
    let (alone, out) = (bench.folder.path().join("alone"), bench.folder.path().join("out"));
    succeeded(bench.begin(&alone, &[]));
    succeeded(bench.begin(&out, &["--seed", "9"]));
    let other = ply(&out);
    assert!(other != ply(&alone));
    bench.killed_at(&out, &["--overwrite"], &[".gsscale-begun.toml"]);
    // What the kill left: the mark beside some files of the earlier run.
    let is_marked = out.join(".gsscale-begun.toml").exists();
    if is_marked && out.join("config.toml").exists() {
        std::fs::remove_file(out.join("config.toml")).unwrap();
    }
    let output = train(&["--resume", text(&out)]);
    assert!(output.status.success() && stderr(&output).contains("begins again"), "{}", stderr(&output));
    assert!(files(&out) == files(&alone), "{:?}", files(&out).keys());
}

/// A run that is refused leaves nothing, not even the folders of its path.
#[test]
fn a_run_that_is_refused_leaves_no_mark() {
    let bench = Bench::new();
    let out = bench.folder.path().join("new/deep/out");
    let output = ended(bench.begin(&out, &["--host-mem", "1MiB"]));
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert!(!bench.folder.path().join("new").exists());
    std::fs::create_dir_all(&out).unwrap();
    ended(bench.begin(&out, &["--host-mem", "1MiB"]));
    assert!(std::fs::read_dir(&out).unwrap().next().is_none());
}
