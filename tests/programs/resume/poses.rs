//! A run that refines poses goes on with its motions.

use super::bench::{Bench, Place, ended, ply, refused, signal, succeeded};

const REFINE: &[&str] = &["--refine-poses"];

#[test]
fn a_run_that_refines_poses_resumes_with_its_motions() {
    let bench = Bench::new();
    let alone = bench.alone(REFINE);
    for place in [Place::Memory, Place::Spill(alone.fewest / 2)] {
        let out = bench.path("out");
        // Once killed after some commit, once asked to stop; poses move from step 46 on.
        for (name, commits) in [("KILL", "0.02"), ("INT", "0")] {
            let mut child = bench.begin(place, &[REFINE, &["--commit-every", commits]].concat());
            bench.wait_for_lines(&mut child, 11);
            signal(&mut child, name);
            ended(child);
            if name == "INT" {
                let said = refused(bench.go_on(&["--refine-poses=false"]));
                assert!(said.contains("refine-poses was true and is false"), "{said}");
            }
            succeeded(bench.go_on(&[]));
            assert!(ply(&out) == alone.ply, "{place:?}, {name}: the resumed run gives another scene");
            assert!(out.join("poses.json").exists());
            std::fs::remove_dir_all(&out).unwrap();
        }
    }
    // Motions are worth something: without them the scene is another.
    let without = Bench::new().alone(&[]);
    assert!(without.ply != alone.ply);
}
