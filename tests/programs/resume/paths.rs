//! SIMD paths across restarts: a run resumes on a path with the same bits; another path counts as a change of results.
//! Also the other facts in a run state that prevent resuming.

use super::bench::{Bench, Place, ply, refused, succeeded};
use crate::support::scenes::{stderr, text, train};
use gsscale::base::simd::SimdPath;
use gsscale::checkpoint::run_state::RunState;
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::codec::Codec;
use gsscale::page::map::commit::{CommitConfig, Commits, Cut};
use std::path::Path;

/// Commits the store in `folder` once more, with another run state and the same pages.
fn edit_run_state(folder: &Path, edit: impl FnOnce(&mut RunState)) {
    let spill = SpillDir::open(folder, false).unwrap();
    let config = CommitConfig { store: spill.format().store, cache_bytes: 1 << 20, reserve_bytes: 0 };
    let opened = Commits::open(Box::new(DriveFolder::new(folder)), config).unwrap();
    let engine = open_engine(IoEngine::Pread, folder, 2).unwrap().store;
    let mut store = opened.paged_store(engine, spill.format().layout, Codec::Raw).unwrap();
    let mut state = RunState::from_bytes(&opened.run_state).unwrap();
    edit(&mut state);
    let cut = Cut { changes: &[], run_state: &state.to_bytes().unwrap(), note: b"", pin: None };
    let mut commits = opened.commits;
    commits.commit(&mut store, &mut Vec::new(), &cut).unwrap();
}

/// A machine without the path of the last commit, but with a path of the same bits, resumes without a message.
#[test]
fn a_run_goes_on_on_another_path_of_the_same_bits() {
    if !SimdPath::Avx2.is_supported() {
        println!("SKIPPED: this machine has one class of instruction paths");
        return;
    }
    let bench = Bench::new();
    let alone = bench.alone(&["--simd", "avx2"]);
    for place in [Place::Memory, Place::Spill(alone.fewest)] {
        // As if the first process had run on a machine with AVX-512.
        bench.stopped_with(place, 9, &["--simd", "avx2"]);
        edit_run_state(&bench.checkpoint(place), |state| {
            assert_eq!(state.origin.simd, "avx2");
            state.origin.simd = "avx512".into();
        });
        let output = train(&["--resume", text(&bench.path("out"))]);
        let said = stderr(&output);
        assert!(output.status.success(), "{said}");
        assert!(said.contains("simd was avx512 and is avx2 (the same bits)") && !said.contains("accept"), "{said}");
        assert!(ply(&bench.path("out")) == alone.ply, "{place:?}: the scene is another");
        std::fs::remove_dir_all(bench.path("out")).unwrap();
        let _ = std::fs::remove_dir(bench.checkpoint(place));
    }
    // With AVX-512, the test really switches forth and back.
    if !SimdPath::Avx512.is_supported() {
        println!("SKIPPED: this machine lacks AVX-512");
        return;
    }
    for [first, second] in [["avx512", "avx2"], ["avx2", "avx512"]] {
        bench.stopped_with(Place::Memory, 9, &["--simd", first]);
        succeeded(bench.go_on(&["--simd", second]));
        assert!(ply(&bench.path("out")) == alone.ply, "{first}, then {second}: the scene is another");
        std::fs::remove_dir_all(bench.path("out")).unwrap();
    }
}

#[test]
fn the_baseline_has_bits_of_its_own() {
    if !SimdPath::Avx2.is_supported() {
        println!("SKIPPED: this machine has one class of instruction paths");
        return;
    }
    let bench = Bench::new();
    bench.stopped_with(Place::Memory, 9, &["--simd", "avx2"]);
    let said = refused(bench.go_on(&["--simd", "baseline"]));
    assert!(said.contains("simd was avx2 and is baseline") && said.contains("--accept-changes"), "{said}");
    edit_run_state(&bench.checkpoint(Place::Memory), |state| state.origin.simd = "baseline".into());
    let said = refused(bench.go_on(&[]));
    assert!(said.contains("simd was baseline and is avx2"), "{said}");
    // An unknown path belongs to no known class.
    edit_run_state(&bench.checkpoint(Place::Memory), |state| state.origin.simd = "neon".into());
    assert!(refused(bench.go_on(&[])).contains("simd was neon and is avx2"));
    succeeded(bench.go_on(&["--accept-changes"]));
}

#[test]
fn a_run_with_too_small_an_epsilon_does_not_go_on() {
    let bench = Bench::new();
    bench.stopped(Place::Memory, 9);
    for value in ["0", "1e-30", "9.9e-17", "-1e-15", "nan"] {
        let said = refused(bench.go_on(&[&format!("--adam-eps={value}"), "--accept-changes"]));
        assert!(said.contains("--adam-eps") && said.contains("1e-16 to 1"), "{value}: {said}");
    }
}
