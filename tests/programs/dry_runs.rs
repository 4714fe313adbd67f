//! A dry run refuses what the run refuses, and changes nothing; that of `--resume` says what the resume would do.

use crate::support::scenes::{stderr, told};
#[cfg(unix)]
use crate::support::small_drive::Small;
use crate::support::workdir::{TRAIN, Workdir};

const SHORT: &str = "scene --steps 20 --strategy none --device cpu --quiet";

fn small() -> Workdir {
    Workdir::city(16, 64, 48, 500)
}

#[test]
fn a_dry_run_refuses_what_the_run_refuses() {
    let work = small();
    work.train(&format!("{SHORT} --out first --spill-dir store --keep-checkpoint"));
    work.write("file", "mine");
    std::fs::create_dir(work.path("foreign")).unwrap();
    work.write("foreign/diary.txt", "mine");
    let before = work.files("");
    for (flags, word) in [
        ("--spill-dir file --out new", "is not a folder"),
        ("--spill-dir none/below --out new", "make that folder first"),
        ("--spill-dir store --out new", "the checkpoint of another run"),
        ("--spill-dir foreign --out new", "diary.txt"),
        ("--out first", "exists already"),
        ("--out file --overwrite", "is a file"),
        ("--out file/below", "is a file"),
        ("--out foreign", "exists already"),
    ] {
        let [dry, run] = ["--dry-run", ""].map(|dry| {
            let output = work.output(TRAIN, &format!("{SHORT} {flags} {dry}"));
            let said = stderr(&output);
            assert!(!output.status.success() && said.contains(word) && said.contains("remedy"), "{flags}: {said}");
            said
        });
        assert_eq!(dry, run, "{flags}");
    }
    let output = work.output(TRAIN, "scene --out first --overwrite --dry-run --trace trace.json");
    let asked = String::from_utf8_lossy(&output.stdout);
    assert!(["memory", "views to train on"].iter().all(|word| asked.contains(word)), "not on standard output: {asked}");
    assert!(work.files("") == before && !work.exists("new"), "nothing may change");
}

/// The PLY of 500 Gaussians takes 124,000 bytes.
#[cfg(unix)]
#[test]
fn a_drive_without_room_for_the_result_is_refused_before_the_first_step() {
    let work = small();
    let Some(drive) = Small::mount(&work.path("drive"), 64 << 10) else { return };
    for dry in ["--dry-run", ""] {
        let said = stderr(&work.output(TRAIN, &format!("{SHORT} --out drive/out {dry}")));
        assert!(said.contains("the PLY of the first Gaussians") && !work.exists("drive/out"), "{said}");
    }
    drive.resize(160 << 10);
    let close = work.train(&format!("{SHORT} --out drive/out --dry-run"));
    assert!(close.contains("the results and the checkpoint may take"), "{close}");
    drive.resize(16 << 20);
    let fits = work.train(&format!("{SHORT} --out drive/out --dry-run"));
    assert!(!fits.contains("warning"), "{fits}");
}

#[test]
fn the_dry_run_of_a_resume_says_what_it_would_do() {
    let work = small();
    for (out, keep) in [("kept", "--keep-checkpoint"), ("plain", "--keep-checkpoint=false")] {
        work.train(&format!("{SHORT} --out {out} {keep} --log-every 2"));
    }
    let before = work.files("");
    for (flags, words) in [
        ("kept", &["is finished: all 20 steps"][..]),
        ("plain", &["is finished: all 20 steps"]),
        ("kept --steps 50", &["after 20 of 50 steps, from the last commit, 500 Gaussians", "30 steps to do and about"]),
        ("plain --steps 50", &["after 20 of 50 steps, from 500 Gaussians of point_cloud.ply"]),
        // What the resume refuses is refused.
        ("kept --steps 50 --seed 7", &["seed", "remedy"]),
        ("none", &["there is no such folder", "remedy"]),
        ("scene", &["neither a config.toml", "remedy"]),
    ] {
        let output = work.output(TRAIN, &format!("--resume {flags} --dry-run"));
        let said = told(&output);
        assert!(words.iter().all(|word| said.contains(word)), "{flags}: {said}");
        assert_eq!(output.status.success(), !words.contains(&"remedy"), "{flags}: {said}");
    }
    assert!(work.files("") == before, "nothing may change");
    work.train("--resume kept --steps 50 --quiet");
}
