//! Ownership of checkpoints: a run touches only the checkpoint that it made, wherever other checkpoints lie.

use super::bench::{BUSY, Bench, Place, SELDOM, STEPS, copy_folder, ended, ply, refused, signal, succeeded};
use crate::support::scenes::{stderr, text, train};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Every file of a folder with its bytes.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    // The lock names the last process.
    let entries = entries.filter(|path| path.is_file() && path.file_name().is_some_and(|name| name != "LOCK"));
    entries.map(|path| (path.clone(), std::fs::read(&path).unwrap())).collect()
}

/// A complete run in `out` with this spill directory.
fn whole_run(bench: &Bench, out: &Path, spill: &Path, steps: &str) {
    let spill = ["--spill-dir", text(spill), "--frames", "4000", "--spill-codec", "raw"];
    let output = train(&[&[text(&bench.scene), "--out", text(out), "--steps", steps], BUSY, &spill].concat());
    assert!(output.status.success(), "{}", stderr(&output));
}

#[test]
fn a_run_that_is_done_leaves_the_checkpoint_of_the_run_after_it() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    let (first, spill) = (bench.path("first"), bench.path("spill"));
    whole_run(&bench, &first, &spill, "20");
    assert!(!spill.join("FORMAT").exists(), "a run that is done leaves no checkpoint");
    let place = Place::Spill(alone.fewest);
    bench.stopped(place, 4);
    let before = files(&spill);
    let said = succeeded(bench.go_on_in("first", &[]));
    assert!(said.contains("left alone") && said.contains(text(&bench.path("out"))), "{said}");
    assert!(files(&spill) == before, "the checkpoint of another run was touched");
    succeeded(bench.go_on(&[]));
    assert!(ply(&bench.path("out")) == alone.ply, "the scene is another");
}

#[test]
fn a_checkpoint_that_cannot_be_opened_stays() {
    let bench = Bench::new();
    let (out, spill) = (bench.path("first"), bench.path("spill"));
    whole_run(&bench, &out, &spill, "20");
    bench.stopped(Place::Spill(4000), 4);
    std::fs::write(spill.join("map.redb"), b"damaged").unwrap();
    let before = files(&spill);
    assert!(succeeded(bench.go_on_in("first", &[])).contains("left alone"));
    assert!(files(&spill) == before, "a store that cannot be opened was touched");
}

#[test]
fn a_run_does_not_go_on_from_the_checkpoint_of_another() {
    let bench = Bench::new();
    let (out, spill) = (bench.path("out"), bench.path("spill"));
    let place = Place::Spill(4000);
    bench.stopped(place, 4);
    // The folder is given to another run with identical settings.
    std::fs::rename(&out, bench.path("first")).unwrap();
    std::fs::remove_dir_all(&spill).unwrap();
    bench.stopped(place, 8);
    let (before, results) = (files(&spill), files(&bench.path("first")));
    let said = refused(bench.go_on_in("first", &[]));
    assert!(said.contains("the checkpoint of another run") && said.contains(text(&out)), "{said}");
    let first = bench.path("first");
    for command in [&["ls"][..], &["verify"], &["export", "--out", "x.ply"], &["rollback", "1", "--yes"]] {
        let args = [&[command[0], text(&first)], &command[1..]].concat();
        let output = Command::new(env!("CARGO_BIN_EXE_gsscale-ckpt")).args(&args).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        assert!(stderr(&output).contains("the checkpoint of another run"), "{}", stderr(&output));
    }
    assert!(files(&spill) == before && files(&bench.path("first")) == results, "a refusal changed something");
}

#[test]
fn starting_over_leaves_a_checkpoint_that_is_another_runs() {
    let bench = Bench::new();
    let (out, checkpoint) = (bench.path("out"), bench.path("out/checkpoint"));
    // Another run's pages lie in the place of those of the run in `out`.
    bench.stopped(Place::Memory, 4);
    std::fs::remove_dir_all(&checkpoint).unwrap();
    let (other, steps) = (bench.path("other"), "60");
    let spill = ["--spill-dir", text(&checkpoint), "--keep-checkpoint", "--commit-every", "0"];
    let args = [&[text(&bench.scene), "--out", text(&other), "--steps", steps], BUSY, &spill].concat();
    let output = train(&args);
    assert!(output.status.success(), "{}", stderr(&output));
    let before = files(&checkpoint);
    let said = refused(bench.begin(Place::Memory, &["--overwrite"]));
    assert!(said.contains("another run") && said.contains(text(&other)), "{said}");
    std::fs::write(checkpoint.join("map.redb"), b"damaged").unwrap();
    let said = refused(bench.begin(Place::Memory, &["--overwrite"]));
    assert!(said.contains("cannot be opened"), "{said}");
    std::fs::write(checkpoint.join("map.redb"), &before[&checkpoint.join("map.redb")]).unwrap();
    assert!(files(&checkpoint) == before, "another run's checkpoint was touched");
    // The run's own pictures are removed; other files stay.
    std::fs::remove_file(out.join("metrics.jsonl")).unwrap();
    std::fs::remove_dir_all(&checkpoint).unwrap();
    std::fs::create_dir_all(out.join("renders/test/more")).unwrap();
    for name in ["a.png", "more/b.png", "notes.txt"] {
        std::fs::write(out.join("renders/test").join(name), "x").unwrap();
    }
    let mut child = bench.begin(Place::Memory, &[&SELDOM[..], &["--overwrite"]].concat());
    bench.wait_for_lines(&mut child, 2);
    signal(&mut child, "INT");
    assert_eq!(ended(child).status.code(), Some(130));
    let left = files(&out.join("renders/test")).into_keys().collect::<Vec<_>>();
    assert_eq!(left, [out.join("renders/test/notes.txt")]);
}

#[test]
fn the_checkpoint_alone_is_enough_to_go_on() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    let out = bench.path("out");
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        // A part of the metrics is missing, then all of them.
        bench.stopped(place, 6);
        let metrics = std::fs::read(out.join("metrics.jsonl")).unwrap();
        std::fs::write(out.join("metrics.jsonl"), &metrics[..metrics.len() / 2]).unwrap();
        let mut child = bench.go_on(&SELDOM);
        bench.wait_for_lines(&mut child, 8);
        signal(&mut child, "INT");
        let output = ended(child);
        assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
        assert!(stderr(&output).contains("metrics.jsonl has"), "{}", stderr(&output));
        std::fs::remove_file(out.join("metrics.jsonl")).unwrap();
        std::fs::remove_file(out.join("config.toml")).unwrap();
        let spill = bench.path("spill");
        let mut named = vec![];
        if place != Place::Memory {
            // config.toml names the folder of the pages; without it, the user has to.
            assert!(refused(bench.go_on(&[])).contains("--spill-dir"));
            std::fs::remove_dir_all(&out).unwrap();
            named.extend(["--spill-dir", text(&spill)]);
        }
        let said = succeeded(bench.go_on(&named));
        assert!(said.contains("config.toml is missing") && said.contains("metrics.jsonl has only 0"), "{said}");
        assert!(ply(&out) == alone.ply, "{place:?}: the scene is another");
        let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
        assert!(config.contains("[resolved]") && config.contains(text(&bench.scene)), "{config}");
        assert!(!bench.checkpoint(place).join("FORMAT").exists(), "a run that is done leaves no checkpoint");
        std::fs::remove_dir_all(&out).unwrap();
    }
}

#[test]
fn a_run_that_was_cut_off_before_its_first_commit_begins_again() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    let (out, spill) = (bench.path("out"), bench.path("spill"));
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        let mut child = bench.begin(place, &SELDOM);
        bench.wait_for_lines(&mut child, 1);
        child.kill().unwrap();
        ended(child);
        let said = succeeded(bench.go_on(&[]));
        assert!(said.contains("begins again"), "{said}");
        assert!(ply(&out) == alone.ply, "{place:?}: the scene is another");
        assert_eq!(super::bench::logged(&out), alone.logged, "{place:?}");
        std::fs::remove_dir_all(&out).unwrap();
    }
    // An unmounted drive of pages is no reason to start over.
    let mut child = bench.begin(Place::Spill(4000), &SELDOM);
    bench.wait_for_lines(&mut child, 1);
    child.kill().unwrap();
    ended(child);
    std::fs::rename(&spill, bench.path("unmounted")).unwrap();
    assert!(refused(bench.go_on(&[])).contains("not mounted"));
    std::fs::remove_dir_all(bench.path("unmounted")).unwrap();
    std::fs::remove_dir_all(&out).unwrap();
    // A result is never overwritten by a second start.
    let mut child = bench.begin(Place::Memory, &["--frames", "4000"]);
    bench.wait_for_lines(&mut child, 1);
    signal(&mut child, "INT");
    assert_eq!(ended(child).status.code(), Some(130));
    let before = files(&out);
    let said = refused(bench.go_on(&[]));
    assert!(said.contains("not there") && said.contains("start a new run"), "{said}");
    assert!(files(&out) == before);
}

/// A run killed at any early moment: the same command, or `--resume` once a config exists, trains it.
#[test]
fn a_kill_in_the_first_second_is_in_nobodys_way() {
    let mut bench = Bench::new();
    let alone = bench.alone(&[]);
    // A fast machine does the usual steps within the longest wait.
    bench.steps = 100 * STEPS;
    let (out, spill) = (bench.path("out"), bench.path("spill"));
    for milliseconds in [30, 60, 100, 150, 220, 300, 400, 550, 700] {
        let mut child = bench.begin(Place::Spill(alone.fewest), &SELDOM);
        std::thread::sleep(std::time::Duration::from_millis(milliseconds));
        child.kill().unwrap();
        ended(child);
        // Wait for lines of the second process.
        let _ = std::fs::remove_file(out.join("metrics.jsonl"));
        let mut again = match out.join("config.toml").exists() {
            true => bench.go_on(&SELDOM),
            false => bench.begin(Place::Spill(alone.fewest), &SELDOM),
        };
        bench.wait_for_lines(&mut again, 2);
        signal(&mut again, "INT");
        let output = ended(again);
        assert_eq!(output.status.code(), Some(130), "after {milliseconds} ms: {}", stderr(&output));
        assert!(out.join("point_cloud.ply").exists() && spill.join("FORMAT").exists());
        std::fs::remove_dir_all(&spill).unwrap();
        std::fs::remove_dir_all(&out).unwrap();
    }
}

/// After a power failure the folder still has the names of the run's files: the folder and its parent are synced.
#[test]
fn the_output_folder_is_synced_after_its_config_was_renamed() {
    if Command::new("strace").args(["-o", "/dev/null", "true"]).status().is_err() {
        assert!(std::env::var_os("CI").is_none(), "strace is not installed: .ci/run installs it");
        println!("skipped: strace is not installed");
        return;
    }
    let bench = Bench::new();
    let (out, trace) = (bench.path("out"), bench.path("trace"));
    let program = env!("CARGO_BIN_EXE_gsscale-train");
    let traced =
        ["-f", "-y", "-s", "4096", "-e", "trace=rename,renameat,renameat2,fsync,mkdir,mkdirat", "-o", text(&trace)];
    let args = [&[program, text(&bench.scene), "--out", text(&out), "--steps", "2"], BUSY].concat();
    let output = Command::new("strace").args(traced).args(args).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let said = std::fs::read_to_string(&trace).unwrap();
    let lines: Vec<&str> = said.lines().collect();
    let synced = |folder: &Path| format!("<{}>)", folder.display());
    let is_sync = |line: &&str, folder: &Path| line.contains("fsync(") && line.contains(&synced(folder));
    let made = lines.iter().position(|l| l.contains("mkdir") && l.contains(&format!("\"{}\"", out.display()))).unwrap();
    let renamed = lines.iter().position(|l| l.contains("rename") && l.contains("config.toml\"")).unwrap();
    assert!(lines[made..].iter().any(|l| is_sync(l, out.parent().unwrap())), "the parent is not synced\n{said}");
    assert!(lines[renamed..].iter().any(|l| is_sync(l, &out)), "the folder is not synced\n{said}");
}

/// Two folders with the same run: the stale folder neither trains nor removes anything.
#[test]
fn a_copy_of_an_output_folder_is_the_same_run() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    bench.stopped(Place::Spill(alone.fewest), 4);
    copy_folder(&bench.path("out"), &bench.path("copy"));
    succeeded(bench.go_on_in("copy", &[]));
    assert!(ply(&bench.path("copy")) == alone.ply);
    let said = refused(bench.go_on(&[]));
    assert!(said.contains("not there"), "{said}");
}

/// A running run cannot be started, resumed or overwritten by another process.
#[test]
fn one_process_at_a_time_trains_into_a_folder() {
    let bench = Bench::new();
    let out = bench.path("out");
    let mut child = bench.begin(Place::Memory, &SELDOM);
    bench.wait_for_lines(&mut child, 1);
    let config = std::fs::read(out.join("config.toml")).unwrap();
    let said = refused(bench.go_on(&[]));
    assert!(said.contains("another process trains into this folder"), "{said}");
    let said = refused(bench.begin(Place::Memory, &["--overwrite"]));
    assert!(said.contains("another process trains into this folder"), "{said}");
    assert!(std::fs::read(out.join("config.toml")).unwrap() == config);
    signal(&mut child, "INT");
    assert_eq!(ended(child).status.code(), Some(130));
    succeeded(bench.go_on(&[]));
}

/// Saved scenes and the mount point of an unmounted drive are no reasons to start over.
#[test]
fn a_run_with_a_past_is_not_begun_again() {
    let bench = Bench::new();
    let (out, spill) = (bench.path("out"), bench.path("spill"));
    let mut child = bench.begin(Place::Memory, &["--frames", "4000", "--save-every", "20"]);
    bench.wait_for_lines(&mut child, 5);
    child.kill().unwrap();
    ended(child);
    let saved = out.join("point_cloud_000020.ply");
    let before = std::fs::read(&saved).unwrap();
    refused(bench.go_on(&[]));
    assert!(std::fs::read(&saved).unwrap() == before, "a saved scene is gone");
    std::fs::remove_dir_all(&out).unwrap();
    let mut child = bench.begin(Place::Spill(4000), &SELDOM);
    bench.wait_for_lines(&mut child, 1);
    child.kill().unwrap();
    ended(child);
    std::fs::remove_dir_all(&spill).unwrap();
    std::fs::create_dir(&spill).unwrap();
    assert!(refused(bench.go_on(&[])).contains("not mounted"));
    assert_eq!(std::fs::read_dir(&spill).unwrap().count(), 0, "something was written to a mount point");
}

/// An output folder whose config.toml names no run, is missing or is damaged does not get another run's checkpoint.
#[test]
fn a_folder_that_does_not_know_its_run_takes_no_other() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    let (out, spill, first) = (bench.path("out"), bench.path("spill"), bench.path("first"));
    let place = Place::Spill(alone.fewest);
    bench.stopped(place, 4);
    std::fs::rename(&out, &first).unwrap();
    std::fs::remove_dir_all(&spill).unwrap();
    bench.stopped(place, 4);
    let config = std::fs::read_to_string(first.join("config.toml")).unwrap();
    let without: Vec<&str> = config.lines().filter(|line| !line.starts_with("run = ")).collect();
    assert!(without.len() + 1 == config.lines().count());
    std::fs::write(first.join("config.toml"), without.join("\n")).unwrap();
    let before = (files(&spill), files(&first));
    assert!(refused(bench.go_on_in("first", &[])).contains("the checkpoint of another run"));
    assert!((files(&spill), files(&first)) == before);
    std::fs::remove_file(first.join("config.toml")).unwrap();
    let said = refused(bench.go_on_in("first", &["--spill-dir", text(&spill)]));
    assert!(said.contains("it holds results") && said.contains(text(&out)), "{said}");
    assert!(files(&spill) == before.0);
    // The remedy for a damaged config.toml, followed literally.
    std::fs::write(out.join("config.toml"), "").unwrap();
    assert!(refused(bench.go_on(&[])).contains("remove the file"));
    std::fs::remove_file(out.join("config.toml")).unwrap();
    succeeded(bench.go_on(&["--spill-dir", text(&spill)]));
    assert!(ply(&out) == alone.ply, "the scene is another");
}
