//! A run that leaves out wrong views, or masks blocks of photos, goes on with what it knows of them.

use super::bench::{Bench, Place, ended, ply, refused, signal, succeeded};
use gsscale::dataset::synthetic::{CityOptions, write_city};

/// A city whose views share much, so that a wrong photo is noticed within two epochs, before the first opacity reset. Two photos are negatives.
fn with_negatives() -> Bench {
    let bench = Bench::new();
    std::fs::remove_dir_all(&bench.scene).unwrap();
    let size = CityOptions { seed: 5, views: 24, width: 64, height: 48, points: 1500, ..CityOptions::default() };
    write_city(&bench.scene, &size, &|_, _| {}).unwrap();
    for name in ["view_0003.jpg", "view_0016.jpg"] {
        let path = bench.scene.join("images").join(name);
        let mut photo = image::open(&path).unwrap().to_rgb8();
        photo.iter_mut().for_each(|value| *value = 255 - *value);
        photo.save(&path).unwrap();
    }
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
    let robust = resumes_alike(&with_negatives(), "--robust-views");
    // What is left out matters: with everything, the scene is another.
    assert!(with_negatives().alone(&[]).ply != robust, "no view was left out, so the test shows nothing");
}

#[test]
fn a_run_that_masks_blocks_resumes_with_its_masks() {
    // A negative differs in its blocks too.
    let robust = resumes_alike(&with_negatives(), "--robust-pixels");
    assert!(with_negatives().alone(&[]).ply != robust, "no block was masked, so the test shows nothing");
}
