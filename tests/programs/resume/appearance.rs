//! A run that corrects its photos goes on with their values.

use super::bench::{Bench, Place, ended, ply, refused, signal, succeeded};
use crate::support::exif::{Settings, add_exif};

const FULL: &[&str] = &["--appearance", "full"];

#[test]
fn a_run_with_appearance_resumes_with_its_values() {
    let bench = Bench::new();
    let alone = bench.alone(FULL);
    for place in [Place::Memory, Place::Spill(alone.fewest / 2)] {
        let out = bench.path("out");
        // Once killed after some commit, once asked to stop.
        for (name, commits) in [("KILL", "0.02"), ("INT", "0")] {
            let mut child = bench.begin(place, &[FULL, &["--commit-every", commits]].concat());
            bench.wait_for_lines(&mut child, 9);
            signal(&mut child, name);
            ended(child);
            if name == "INT" {
                let said = refused(bench.go_on(&["--appearance", "exposure"]));
                assert!(said.contains("appearance was \"full\" and is \"exposure\""), "{said}");
            }
            succeeded(bench.go_on(&[]));
            assert!(ply(&out) == alone.ply, "{place:?}, {name}: the resumed run gives another scene");
            assert!(out.join("appearance.json").exists());
            std::fs::remove_dir_all(&out).unwrap();
        }
    }
    // Values are worth something: without them the scene is another.
    let without = Bench::new().alone(&[]);
    assert!(without.ply != alone.ply);
}

#[test]
fn exposures_that_started_from_exif_data_are_resumed() {
    let bench = Bench::new();
    let without = bench.alone(FULL);
    let mut photos: Vec<_> =
        std::fs::read_dir(bench.scene.join("images")).unwrap().map(|entry| entry.unwrap().path()).collect();
    photos.sort();
    for (i, photo) in photos.iter().enumerate() {
        add_exif(photo, &Settings::brighter_by((i % 5) as f64 - 2.0).tiff());
    }
    let alone = bench.alone(FULL);
    assert!(alone.ply != without.ply, "the first exposures have changed nothing");
    let out = bench.path("out");
    // Killed before the first step has ended or soon after it, and asked to stop later.
    for (name, lines) in [("KILL", 0), ("INT", 9)] {
        let mut child = bench.begin(Place::Memory, &[FULL, &["--commit-every", "0.02"]].concat());
        bench.wait_for_lines(&mut child, lines);
        signal(&mut child, name);
        ended(child);
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply, "{name} after {lines} lines: the resumed run gives another scene");
        let values = std::fs::read_to_string(out.join("appearance.json")).unwrap();
        assert!(values.contains("\"exposures_from_exif\": 23"), "{name}: the count of the start is lost");
        std::fs::remove_dir_all(&out).unwrap();
    }
}
