//! A run that leaves out wrong views, or masks blocks of photos, goes on with what it knows of them.

use super::bench::{Bench, Place, ended, ply, refused, signal, succeeded};
use gsscale::dataset::synthetic::{CityOptions, write_city};

/// A city whose views share much, so that a photo in a wrong place is noticed within a few epochs. Two photos change places.
fn swapped() -> Bench {
    let bench = Bench::new();
    std::fs::remove_dir_all(&bench.scene).unwrap();
    let size = CityOptions { seed: 5, views: 24, width: 64, height: 48, points: 1500, ..CityOptions::default() };
    write_city(&bench.scene, &size, &|_, _| {}).unwrap();
    let [a, b] = ["view_0003.jpg", "view_0016.jpg"].map(|name| bench.scene.join("images").join(name));
    let [photo_a, photo_b] = [&a, &b].map(|path| std::fs::read(path).unwrap());
    std::fs::write(a, photo_b).unwrap();
    std::fs::write(b, photo_a).unwrap();
    bench
}

/// Runs that end in several ways and places, and resume, give the bytes of a run that nobody disturbed. The flag lasts.
fn resumes_alike(bench: &Bench, flag: &str) -> Vec<u8> {
    let name = flag.trim_start_matches("--");
    let alone = bench.alone(&[flag]);
    let out = bench.path("out");
    for (place, signal_name, commits) in
        [(Place::Memory, "KILL", "0.02"), (Place::Spill(alone.fewest / 2), "INT", "0"), (Place::Memory, "INT", "0")]
    {
        let mut child = bench.begin(place, &[flag, "--commit-every", commits]);
        bench.wait_for_lines(&mut child, 14);
        signal(&mut child, signal_name);
        ended(child);
        if signal_name == "INT" {
            let said = refused(bench.go_on(&[&format!("{flag}=false")]));
            assert!(said.contains(&format!("{name} was true and is false")), "{said}");
        }
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply, "{place:?}, {signal_name}: the resumed run gives another scene");
        std::fs::remove_dir_all(&out).unwrap();
    }
    alone.ply
}

#[test]
fn a_run_without_wrong_views_resumes_without_them() {
    let robust = resumes_alike(&swapped(), "--robust-views");
    // What is left out matters: with everything, the scene is another.
    let with = swapped();
    assert!(with.alone(&[]).ply != robust, "no view was left out, so the test shows nothing");
}

#[test]
fn a_run_that_masks_blocks_resumes_with_its_masks() {
    // A photo in a wrong place differs in its blocks too.
    let robust = resumes_alike(&swapped(), "--robust-pixels");
    assert!(swapped().alone(&[]).ply != robust, "no block was masked, so the test shows nothing");
}
