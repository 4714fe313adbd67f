//! A run that leaves out wrong views goes on with what it knows of them.

use super::bench::{Bench, Place, ended, ply, refused, signal, succeeded};
use gsscale::dataset::synthetic::{CityOptions, write_city};

const ROBUST: &[&str] = &["--robust-views"];

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

#[test]
fn a_run_without_wrong_views_resumes_without_them() {
    let bench = swapped();
    let alone = bench.alone(ROBUST);
    let out = bench.path("out");
    for (place, name, commits) in
        [(Place::Memory, "KILL", "0.02"), (Place::Spill(alone.fewest / 2), "INT", "0"), (Place::Memory, "INT", "0")]
    {
        let mut child = bench.begin(place, &[ROBUST, &["--commit-every", commits]].concat());
        bench.wait_for_lines(&mut child, 14);
        signal(&mut child, name);
        ended(child);
        if name == "INT" {
            let said = refused(bench.go_on(&["--robust-views=false"]));
            assert!(said.contains("robust-views was true and is false"), "{said}");
        }
        succeeded(bench.go_on(&[]));
        assert!(ply(&out) == alone.ply, "{place:?}, {name}: the resumed run gives another scene");
        std::fs::remove_dir_all(&out).unwrap();
    }
    // What is left out matters: with everything, the scene is another.
    let with = swapped();
    assert!(with.alone(&[]).ply != alone.ply, "no view was left out, so the test shows nothing");
}
