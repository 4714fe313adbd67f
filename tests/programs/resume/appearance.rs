//! A run that corrects its photos goes on with their values.

use super::bench::{Bench, Place, ended, ply, refused, signal, succeeded};

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
