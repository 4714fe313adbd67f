//! Ownership of checkpoints: a run touches only the checkpoint that it made, wherever other checkpoints lie.

use super::bench::{BUSY, Bench, Place, SELDOM, STEPS};
use crate::support::scenes::text;
use crate::support::workdir::{CKPT, TRAIN, copy_folder, succeeded};
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::spill_format::SlotLayout;
use std::path::Path;
use std::process::Command;

/// A spill directory with frames for every page.
const DRIVE: Place = Place::Spill(4000);

fn rename(bench: &Bench, from: &str, to: &str) {
    std::fs::rename(bench.path(from), bench.path(to)).unwrap();
}

/// A short run in `first`, whose pages were in `spill`.
fn whole_run(bench: &Bench) {
    bench.train(&bench.flags(DRIVE, "--out first --steps 20"));
    assert!(!bench.exists("spill/FORMAT"), "a run that is done leaves no checkpoint");
}

#[test]
fn a_run_that_is_done_leaves_the_checkpoint_of_the_run_after_it() {
    let bench = Bench::new();
    let alone = bench.alone("");
    whole_run(&bench);
    bench.stopped(Place::Spill(alone.fewest), 4, "");
    let before = bench.files("spill");
    let said = bench.train("--resume first --quiet");
    assert!(said.contains("left alone") && said.contains(text(&bench.path("out"))), "{said}");
    assert!(bench.files("spill") == before, "the checkpoint of another run was touched");
    bench.go_on("");
    assert!(bench.ply("out") == alone.ply, "the scene is another");
}

#[test]
fn a_checkpoint_that_cannot_be_opened_stays() {
    let bench = Bench::new();
    whole_run(&bench);
    bench.stopped(DRIVE, 4, "");
    bench.write("spill/map.redb", "damaged");
    let before = bench.files("spill");
    let said = bench.train("--resume first --quiet");
    assert!(said.contains("left alone"), "{said}");
    assert!(bench.files("spill") == before, "a store that cannot be opened was touched");
}

#[test]
fn a_run_does_not_go_on_from_the_checkpoint_of_another() {
    let bench = Bench::new();
    bench.stopped(DRIVE, 4, "");
    // The folder is given to another run with identical settings.
    rename(&bench, "out", "first");
    bench.remove("spill");
    bench.stopped(DRIVE, 8, "");
    let before = [bench.files("spill"), bench.files("first")];
    bench.refuses("--resume first --quiet", &["the checkpoint of another run", text(&bench.path("out"))]);
    for command in ["ls first", "verify first", "export first --out x.ply", "rollback first 1 --yes"] {
        bench.refuses_with(CKPT, command, &["the checkpoint of another run"]);
    }
    assert!([bench.files("spill"), bench.files("first")] == before, "a refusal changed something");
}

#[test]
fn starting_over_leaves_a_checkpoint_that_is_another_runs() {
    let bench = Bench::new();
    // Another run's pages lie in the place of those of the run in `out`.
    bench.stopped(Place::Memory, 4, "");
    bench.remove("out/checkpoint");
    bench
        .train(&format!("{BUSY} --out other --steps 60 --spill-dir out/checkpoint --keep-checkpoint --commit-every 0"));
    let before = bench.files("out/checkpoint");
    let over = bench.flags(Place::Memory, "--overwrite");
    bench.refuses(&over, &["another run", text(&bench.path("other"))]);
    bench.write("out/checkpoint/map.redb", "damaged");
    bench.refuses(&over, &["cannot be opened"]);
    bench.write("out/checkpoint/map.redb", &before[Path::new("map.redb")]);
    assert!(bench.files("out/checkpoint") == before, "another run's checkpoint was touched");
    // The run's own pictures are removed; other files stay.
    std::fs::remove_file(bench.path("out/metrics.jsonl")).unwrap();
    bench.remove("out/checkpoint");
    std::fs::create_dir_all(bench.path("out/renders/test/more")).unwrap();
    for name in ["a.png", "more/b.png", "notes.txt"] {
        bench.write(&format!("out/renders/test/{name}"), "x");
    }
    bench.stopped(Place::Memory, 2, "--overwrite");
    let left: Vec<_> =
        bench.files("out/renders/test").into_keys().filter(|path| path.components().count() == 1).collect();
    assert_eq!(left, [Path::new("notes.txt")]);
}

#[test]
fn the_checkpoint_alone_is_enough_to_go_on() {
    let bench = Bench::new();
    let alone = bench.alone("");
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        // A part of the metrics is missing, then all of them.
        bench.stopped(place, 6, "");
        let metrics = bench.bytes("out/metrics.jsonl");
        bench.write("out/metrics.jsonl", &metrics[..metrics.len() / 2]);
        let said = bench.resume(SELDOM).after_lines("out", 8).stop();
        assert!(said.contains("metrics.jsonl has"), "{said}");
        for file in ["out/metrics.jsonl", "out/config.toml"] {
            std::fs::remove_file(bench.path(file)).unwrap();
        }
        let mut named = "";
        if place != Place::Memory {
            // config.toml names the folder of the pages; without it, the user has to.
            bench.does_not_go_on("", &["--spill-dir"]);
            bench.remove("out");
            named = "--spill-dir spill";
        }
        let said = bench.go_on(named);
        assert!(said.contains("config.toml is missing") && said.contains("metrics.jsonl has only 0"), "{said}");
        assert!(bench.ply("out") == alone.ply, "{place:?}: the scene is another");
        let config = bench.text("out/config.toml");
        assert!(
            config.contains("[resolved]") && config.contains("scene = \"") && config.contains("scene\"\n"),
            "{config}"
        );
        assert!(!bench.checkpoint(place).join("FORMAT").exists(), "a run that is done leaves no checkpoint");
        bench.clear();
    }
}

#[test]
fn a_run_that_was_cut_off_before_its_first_commit_begins_again() {
    let bench = Bench::new();
    let alone = bench.alone("");
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        bench.start(place, SELDOM).after_lines("out", 1).kill();
        // A refusal changes nothing, before and after the first pages are made.
        bench.does_not_go_on("--device no-such-card", &["no-such-card"]);
        bench.does_not_go_on("--host-mem 1MiB --frames 0", &["--host-mem"]);
        if place == Place::Memory {
            // A process that is killed during its first commit leaves a store, which the end of the run removes.
            let layout = SlotLayout::new(4096, 1);
            SpillDir::create(&bench.checkpoint(place), layout, true).unwrap();
        }
        let said = bench.go_on("--commit-every 0");
        assert!(said.contains("begins again"), "{said}");
        assert!(bench.ply("out") == alone.ply, "{place:?}: the scene is another");
        assert_eq!(bench.logged("out", "step"), alone.logged, "{place:?}");
        assert!(!bench.checkpoint(place).join("FORMAT").exists(), "{place:?}: a store is left");
        bench.clear();
    }
    // An unmounted drive of pages is no reason to start over, nor is its mount point.
    bench.start(DRIVE, SELDOM).after_lines("out", 1).kill();
    bench.remove("spill");
    bench.does_not_go_on("", &["not mounted"]);
    std::fs::create_dir(bench.path("spill")).unwrap();
    bench.does_not_go_on("", &["not mounted"]);
    assert!(bench.files("spill").is_empty(), "something was written to a mount point");
    bench.clear();
    // A result is never overwritten by a second start.
    bench.start(Place::Memory, "--frames 4000").after_lines("out", 1).stop();
    let before = bench.files("out");
    bench.does_not_go_on("", &["not there", "start a new run"]);
    assert!(bench.files("out") == before);
    bench.clear();
    // Nor are scenes that it saved.
    bench.start(Place::Memory, "--frames 4000 --save-every 20").after_lines("out", 5).kill();
    let before = bench.bytes("out/point_cloud_000020.ply");
    bench.does_not_go_on("", &[]);
    assert!(bench.bytes("out/point_cloud_000020.ply") == before, "a saved scene is gone");
}

/// A run killed at any early moment: the same command, or `--resume` once a config exists, trains it.
#[test]
fn a_kill_in_the_first_second_is_in_nobodys_way() {
    let bench = Bench::new();
    let place = Place::Spill(bench.alone("").fewest);
    // A fast machine does the usual steps within the longest wait.
    let steps = format!("{SELDOM} --steps {}", 100 * STEPS);
    for milliseconds in [30, 60, 100, 150, 220, 300, 400, 550, 700] {
        let run = bench.start(place, &steps);
        std::thread::sleep(std::time::Duration::from_millis(milliseconds));
        run.kill();
        // Wait for lines of the second process.
        let _ = std::fs::remove_file(bench.path("out/metrics.jsonl"));
        let again = match bench.exists("out/config.toml") {
            true => bench.resume(SELDOM),
            false => bench.start(place, &steps),
        };
        again.after_lines("out", 2).stop();
        assert!(bench.exists("out/point_cloud.ply") && bench.exists("spill/FORMAT"), "after {milliseconds} ms");
        bench.clear();
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
    let out = bench.path("out");
    let traced = "-f -y -s 4096 -e trace=rename,renameat,renameat2,fsync,mkdir,mkdirat -o trace";
    let flags = format!("{traced} {TRAIN} {BUSY} --steps 2");
    succeeded(bench.command("strace", &flags).arg("--out").arg(&out).output().unwrap());
    let said = bench.text("trace");
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
    let alone = bench.alone("");
    bench.stopped(Place::Spill(alone.fewest), 4, "");
    copy_folder(&bench.path("out"), &bench.path("copy"));
    bench.train("--resume copy --quiet");
    assert!(bench.ply("copy") == alone.ply);
    bench.does_not_go_on("", &["not there"]);
}

/// An output folder whose config.toml names no run, is missing or is damaged does not get another run's checkpoint.
#[test]
fn a_folder_that_does_not_know_its_run_takes_no_other() {
    let bench = Bench::new();
    let alone = bench.alone("");
    let place = Place::Spill(alone.fewest);
    bench.stopped(place, 4, "");
    rename(&bench, "out", "first");
    bench.remove("spill");
    bench.stopped(place, 4, "");
    let config = bench.text("first/config.toml");
    let without: Vec<&str> = config.lines().filter(|line| !line.starts_with("run = ")).collect();
    assert!(without.len() + 1 == config.lines().count());
    bench.write("first/config.toml", without.join("\n"));
    let before = [bench.files("spill"), bench.files("first")];
    bench.refuses("--resume first --quiet", &["the checkpoint of another run"]);
    assert!([bench.files("spill"), bench.files("first")] == before);
    std::fs::remove_file(bench.path("first/config.toml")).unwrap();
    bench.refuses("--resume first --quiet --spill-dir spill", &["it holds results", text(&bench.path("out"))]);
    assert!(bench.files("spill") == before[0]);
    // The remedy for a damaged config.toml, followed literally.
    bench.write("out/config.toml", "");
    bench.does_not_go_on("", &["move the file away", "--spill-dir"]);
    rename(&bench, "out/config.toml", "damaged.toml");
    bench.go_on("--spill-dir spill");
    assert!(bench.ply("out") == alone.ply, "the scene is another");
}
