//! A dry run refuses what the run refuses, and changes nothing; that of `--resume` says what the resume would do.

use crate::support::scenes::{city, stderr, text, told, train};
use crate::support::small_drive::Small;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Output;
use tempfile::TempDir;

const SHORT: &str = "--steps 20 --strategy none --device cpu --quiet";

fn short(scene: &Path, more: &[&str]) -> Output {
    let flags: Vec<&str> = SHORT.split_whitespace().collect();
    train(&[&[text(scene)], &flags[..], more].concat())
}

/// Every file below `folder` with its bytes.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
        match entry.file_type().unwrap().is_dir() {
            true => found.extend(files(&entry.path()).into_iter().chain([(entry.path(), Vec::new())])),
            false => found.extend([(entry.path(), std::fs::read(entry.path()).unwrap())]),
        }
    }
    found
}

#[test]
fn a_dry_run_refuses_what_the_run_refuses() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 16, 64, 48, 500);
    let paths = ["first", "store", "file", "file/below", "none/below", "foreign", "new"];
    let [first, store, file, below, none, foreign, new] = paths.map(|name| folder.path().join(name));
    let begun = short(&scene, &["--out", text(&first), "--spill-dir", text(&store), "--keep-checkpoint"]);
    assert!(begun.status.success(), "{}", stderr(&begun));
    std::fs::write(&file, "mine").unwrap();
    std::fs::create_dir(&foreign).unwrap();
    std::fs::write(foreign.join("diary.txt"), "mine").unwrap();
    let before = files(folder.path());
    let cases: [(&[&str], &str); 8] = [
        (&["--spill-dir", text(&file)], "is not a folder"),
        (&["--spill-dir", text(&none)], "make that folder first"),
        (&["--spill-dir", text(&store)], "the checkpoint of another run"),
        (&["--spill-dir", text(&foreign)], "diary.txt"),
        (&["--out", text(&first)], "exists already"),
        (&["--out", text(&file), "--overwrite"], "is a file"),
        (&["--out", text(&below)], "is a file"),
        (&["--out", text(&foreign)], "exists already"),
    ];
    for (flags, word) in cases {
        let out = if flags[0] == "--out" { &[][..] } else { &["--out", text(&new)] };
        let [dry, run] = [&["--dry-run"][..], &[]].map(|dry| short(&scene, &[flags, out, dry].concat()));
        for output in [&dry, &run] {
            let said = stderr(output);
            assert!(!output.status.success() && said.contains(word) && said.contains("remedy"), "{flags:?}: {said}");
        }
        assert_eq!(stderr(&dry), stderr(&run), "{flags:?}");
    }
    let trace = folder.path().join("trace.json");
    let allowed = short(&scene, &["--out", text(&first), "--overwrite", "--dry-run", "--trace", text(&trace)]);
    assert!(allowed.status.success(), "{}", stderr(&allowed));
    assert_eq!(files(folder.path()), before, "nothing may change");
}

/// The PLY of 500 Gaussians takes 124,000 bytes.
#[test]
fn a_drive_without_room_for_the_result_is_refused_before_the_first_step() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 16, 64, 48, 500);
    let Some(drive) = Small::mount(&folder.path().join("drive"), 64 << 10) else { return };
    let out = drive.0.join("out");
    let refused = |dry: &[&str]| {
        let output = short(&scene, &[&["--out", text(&out)], dry].concat());
        let said = stderr(&output);
        assert!(!output.status.success() && said.contains("the PLY of the first Gaussians"), "{said}");
        assert!(!out.exists());
    };
    refused(&["--dry-run"]);
    refused(&[]);
    drive.resize(160 << 10);
    let close = short(&scene, &["--out", text(&out), "--dry-run"]);
    assert!(
        close.status.success() && stderr(&close).contains("the results and the checkpoint may take"),
        "{}",
        stderr(&close)
    );
    drive.resize(16 << 20);
    let fits = short(&scene, &["--out", text(&out), "--dry-run"]);
    assert!(fits.status.success() && !stderr(&fits).contains("warning"), "{}", stderr(&fits));
}

#[test]
fn the_dry_run_of_a_resume_says_what_it_would_do() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 16, 64, 48, 500);
    let [kept, plain] = ["kept", "plain"].map(|name| folder.path().join(name));
    for (out, keep) in [(&kept, "--keep-checkpoint"), (&plain, "--keep-checkpoint=false")] {
        let output = short(&scene, &["--out", text(out), keep, "--log-every", "2"]);
        assert!(output.status.success(), "{}", stderr(&output));
    }
    let before = files(folder.path());
    let dry = |out: &Path, more: &[&str]| train(&[&["--resume", text(out), "--dry-run"], more].concat());
    for out in [&kept, &plain] {
        let said = told(&dry(out, &[]));
        assert!(said.contains("is finished: all 20 steps"), "{said}");
    }
    let said = told(&dry(&kept, &["--steps", "50"]));
    assert!(said.contains("after 20 of 50 steps, from the last commit, 500 Gaussians"), "{said}");
    assert!(said.contains("30 steps to do and about"), "{said}");
    let said = told(&dry(&plain, &["--steps", "50"]));
    assert!(said.contains("after 20 of 50 steps, from 500 Gaussians of point_cloud.ply"), "{said}");
    // What the resume refuses is refused.
    let refused = dry(&kept, &["--steps", "50", "--seed", "7"]);
    assert!(!refused.status.success() && stderr(&refused).contains("seed"), "{}", stderr(&refused));
    let refused = dry(&folder.path().join("none"), &[]);
    assert!(!refused.status.success() && stderr(&refused).contains("neither a config.toml"), "{}", stderr(&refused));
    assert_eq!(files(folder.path()), before, "nothing may change");
    let output = train(&["--resume", text(&kept), "--steps", "50", "--quiet"]);
    assert!(output.status.success(), "{}", stderr(&output));
}
