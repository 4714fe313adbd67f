//! SIMD paths across restarts: a run resumes on a path with the same bits; another path counts as a change of results.
//! Also the other facts in a run state that prevent resuming.

use super::bench::{Bench, Place};
use crate::support::workdir::open_store;
use gsscale::base::simd::SimdPath;
use gsscale::checkpoint::run_state::RunState;
use gsscale::page::map::commit::Cut;
use std::path::Path;

/// Commits the store in `folder` once more, with another path in its run state and the same pages. Returns the path that was there.
fn rename_path(folder: &Path, simd: &str) -> String {
    let (_lock, mut opened, mut store) = open_store(folder);
    let mut state = RunState::from_bytes(&opened.run_state).unwrap();
    let was = std::mem::replace(&mut state.origin.simd, simd.into());
    let cut = Cut { changes: &[], run_state: &state.to_bytes().unwrap(), note: b"", pin: None };
    opened.commits.commit(&mut store, &mut Vec::new(), &cut).unwrap();
    was
}

/// Whether this machine has the path; says so if not.
fn has(path: SimdPath) -> bool {
    if !path.is_supported() {
        println!("SKIPPED: this machine lacks {}", path.name());
    }
    path.is_supported()
}

/// A machine without the path of the last commit, but with a path of the same bits, resumes without a message.
#[test]
fn a_run_goes_on_on_another_path_of_the_same_bits() {
    if !has(SimdPath::Avx2) {
        return;
    }
    let bench = Bench::new();
    let alone = bench.alone("--simd avx2");
    for place in [Place::Memory, Place::Spill(alone.fewest)] {
        // As if the first process had run on a machine with AVX-512.
        bench.stopped(place, 9, "--simd avx2");
        assert_eq!(rename_path(&bench.checkpoint(place), "avx512"), "avx2");
        let said = bench.train("--resume out");
        assert!(said.contains("simd was avx512 and is avx2 (the same bits)") && !said.contains("accept"), "{said}");
        assert!(bench.ply("out") == alone.ply, "{place:?}: the scene is another");
        bench.clear();
    }
    // With AVX-512, the test really switches forth and back.
    if !has(SimdPath::Avx512) {
        return;
    }
    for [first, second] in [["avx512", "avx2"], ["avx2", "avx512"]] {
        bench.stopped(Place::Memory, 9, &format!("--simd {first}"));
        bench.go_on(&format!("--simd {second}"));
        assert!(bench.ply("out") == alone.ply, "{first}, then {second}: the scene is another");
        bench.clear();
    }
}

#[test]
fn the_baseline_has_bits_of_its_own() {
    if !has(SimdPath::Avx2) {
        return;
    }
    let bench = Bench::new();
    bench.stopped(Place::Memory, 9, "--simd avx2");
    bench.does_not_go_on("--simd baseline", &["simd was avx2 and is baseline", "--accept-changes"]);
    // An unknown path belongs to no known class.
    for path in ["baseline", "neon"] {
        rename_path(&bench.checkpoint(Place::Memory), path);
        bench.does_not_go_on("", &[&format!("simd was {path} and is avx2")]);
    }
    bench.go_on("--accept-changes");
}

#[test]
fn a_run_with_too_small_an_epsilon_does_not_go_on() {
    let bench = Bench::new();
    bench.stopped(Place::Memory, 9, "");
    bench.does_not_go_on("--adam-eps=-1e-15 --accept-changes", &["--adam-eps", "1e-16 to 1"]);
}
