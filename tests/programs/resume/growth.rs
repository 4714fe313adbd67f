//! A run that decides its count goes on with its decisions, and a run with relocations with its draws.

use super::bench::{Bench, Place, SELDOM, ended, ply, signal, succeeded};
use crate::support::scenes::summary;

const DECIDES: &[&str] = &["--strategy", "long-axis", "--quality", "archive"];

#[test]
fn a_run_that_decides_its_count_resumes_with_its_checks() {
    let bench = Bench::new();
    let alone = bench.alone(DECIDES);
    let out = bench.path("out");
    // Stopped before the first check, between checks, while no check is left, and killed at some moment.
    for (place, lines, name) in [
        (Place::Memory, 9, "INT"),
        (Place::Spill(alone.fewest / 2), 13, "INT"),
        (Place::Memory, 18, "INT"),
        (Place::Spill(alone.fewest / 2), 12, "KILL"),
    ] {
        let commits: &[&str] = if name == "KILL" { &["--commit-every", "0.02"] } else { &SELDOM };
        let mut child = bench.begin(place, &[DECIDES, commits].concat());
        bench.wait_for_lines(&mut child, lines);
        signal(&mut child, name);
        ended(child);
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply, "{place:?}, {lines} lines, {name}: the resumed run gives another scene");
        let growth = summary(&out)["growth"].clone();
        let steps: Vec<u64> = growth.as_array().unwrap().iter().map(|check| check["step"].as_u64().unwrap()).collect();
        assert_eq!(steps, [91, 121]);
        std::fs::remove_dir_all(&out).unwrap();
    }
    // A cap that is given is another run.
    assert!(Bench::new().alone(&[DECIDES, &["--max-gaussians", "4000"]].concat()).ply != alone.ply);
}

const RELOCATES: &[&str] = &["--strategy", "mcmc", "--max-gaussians", "4000"];

#[test]
fn a_run_with_relocations_resumes_with_its_draws() {
    let bench = Bench::new();
    let alone = bench.alone(RELOCATES);
    let out = bench.path("out");
    for (place, lines) in [(Place::Memory, 9), (Place::Spill(alone.fewest / 2), 14)] {
        let mut child = bench.begin(place, &[RELOCATES, &SELDOM[..]].concat());
        bench.wait_for_lines(&mut child, lines);
        signal(&mut child, "INT");
        ended(child);
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply, "{place:?}, {lines} lines: the resumed run gives another scene");
        std::fs::remove_dir_all(&out).unwrap();
    }
}
