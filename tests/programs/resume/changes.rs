//! Keys that a resumed run may change, and keys that it may change only with explicit consent.

use super::bench::{Bench, Place, SELDOM, copy_folder, ended, logged, ply, refused, signal, succeeded};
use crate::support::scenes::{TextModel, stderr, summary, text};
use std::path::PathBuf;

/// The rows of a binary PLY as bytes, sorted.
fn rows(ply: &[u8]) -> Vec<&[u8]> {
    let end = b"end_header\n";
    let first = ply.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let header = std::str::from_utf8(&ply[..first]).unwrap();
    let count = header.lines().find_map(|l| l.strip_prefix("element vertex ")).unwrap().parse::<usize>().unwrap();
    let mut rows: Vec<&[u8]> = ply[first..].chunks((ply.len() - first) / count).collect();
    rows.sort_unstable();
    assert_eq!(rows.len(), count);
    rows
}

fn files(folder: PathBuf) -> Vec<(PathBuf, Vec<u8>)> {
    let paths = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let mut files: Vec<_> = paths.map(|p| (p.clone(), std::fs::read(p).unwrap())).collect();
    files.sort();
    files
}

#[test]
fn what_changed_is_said_and_left_as_it_was() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    let out = bench.path("out");
    let mut child = bench.begin(Place::Spill(alone.fewest), &SELDOM);
    bench.wait_for_lines(&mut child, 2);
    // The folder is in use: a second process is refused.
    let said = refused(bench.go_on(&[]));
    assert!(said.contains("another process"), "{said}");
    signal(&mut child, "INT");
    assert_eq!(ended(child).status.code(), Some(130));
    // The message lists every changed key and its earlier value.
    let said = refused(bench.go_on(&["--means-lr", "0.001", "--seed", "3", "--threads", "1"]));
    assert!(said.contains("\n    means-lr was 0.00016 and is 0.001"), "{said}");
    assert!(said.contains("seed was 42 and is 3") && said.contains("--accept-changes"), "{said}");
    assert!(!said.contains("threads"), "threads change nothing: {said}");
    // The layout of stored pages cannot change, and steps cannot be fewer than were done.
    let said = refused(bench.go_on(&["--page-rows", "64", "--accept-changes"]));
    assert!(said.contains("page-rows was 32 and is 64") && said.contains("--init-ply"), "{said}");
    let said = refused(bench.go_on(&["--steps", "3"]));
    assert!(said.contains("fewer than"), "{said}");
    // Poses, photos, points.
    let model = files(bench.scene.join("sparse/0"));
    let photos = files(bench.scene.join("images"));
    let mut moved = TextModel::of(&bench.scene);
    moved.views[3].tvec[0] += 0.01;
    moved.colors[17][1] ^= 1;
    moved.write(&bench.scene);
    std::fs::write(&photos[5].0, &photos[6].1).unwrap();
    let said = refused(bench.go_on(&[]));
    assert!(said.contains("view 4 (") && said.contains("another name, set, size or pose"), "{said}");
    assert!(said.contains("view 6 (") && said.contains("another photo or mask"), "{said}");
    assert!(said.contains("points") && said.contains("are others"), "{said}");
    std::fs::write(&photos[5].0, &photos[5].1).unwrap();
    std::fs::remove_dir_all(bench.scene.join("sparse/0")).unwrap();
    std::fs::create_dir(bench.scene.join("sparse/0")).unwrap();
    model.iter().for_each(|(path, bytes)| std::fs::write(path, bytes).unwrap());
    // The run still resumes, and reports the new settings.
    let child = crate::support::scenes::train(&["--resume", text(&out), "--threads", "1", "--evict", "lru"]);
    let said = stderr(&child);
    assert!(child.status.success(), "{said}");
    let line = said.lines().find(|l| l.starts_with("resume")).unwrap();
    assert!(line.contains("threads was 0 and is 1") && line.contains("evict was"), "{line}");
    assert!(ply(&out) == alone.ply, "the scene is another");
}

/// Accepted changes apply from the step at which the run stopped, independent of the pages in memory, and to all later
/// restarts.
#[test]
fn accepted_changes_are_the_same_in_any_memory() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    bench.stopped(Place::Memory, 12);
    copy_folder(&bench.path("out"), &bench.path("twin"));
    copy_folder(&bench.path("out"), &bench.path("still"));
    // The change itself moves no row: without another step the rows equal those of the stopped run bit for bit. Their
    // order may differ, because oversized pages are split by now.
    let (stopped, steps) = (ply(&bench.path("still")), summary(&bench.path("still"))["steps"].to_string());
    let much = ["--means-lr", "0.1", "--scales-lr", "0.5", "--accept-changes", "--steps", &steps];
    succeeded(bench.go_on_in("still", &much));
    assert!(
        rows(&ply(&bench.path("still"))) == rows(&stopped),
        "rows did not take the steps that they missed at the old rates"
    );
    let other = ["--means-lr", "0.002", "--opacities-lr", "0.01", "--accept-changes"];
    let said = succeeded(bench.go_on(&other));
    assert!(said.contains("accepted from step") && said.contains("means-lr was 0.00016 and is 0.002"), "{said}");
    // The twin has fewer frames (the largest view may grow by the change), and is stopped once more.
    let frames = ((alone.fewest + alone.pages) / 2).to_string();
    let mut child = bench.go_on_in("twin", &[&other[..], &["--frames", &frames], &SELDOM[..]].concat());
    bench.wait_for_lines_in("twin", &mut child, logged(&bench.path("out")).len() - 8);
    signal(&mut child, "INT");
    let output = ended(child);
    // The run may have finished before the signal arrived.
    assert!(output.status.code() == Some(130) || output.status.success(), "{}", stderr(&output));
    succeeded(bench.go_on_in("twin", &["--frames", &frames]));
    let (first, second) = (ply(&bench.path("out")), ply(&bench.path("twin")));
    assert!(first == second, "the same changes gave two scenes");
    assert!(first != alone.ply, "the change changed nothing");
}

/// Accepted changes belong to the run: later restarts need no flag, and end with the same bytes.
#[test]
fn other_bands_are_accepted_once() {
    let bench = Bench::new();
    for keys in [["--sh-start", "2"], ["--sh-every", "0"]] {
        bench.stopped(Place::Memory, 2);
        copy_folder(&bench.path("out"), &bench.path("twin"));
        let accepted = [&keys[..], &["--accept-changes"]].concat();
        assert!(refused(bench.go_on(&keys)).contains(&keys[0][2..]));
        succeeded(bench.go_on_in("twin", &accepted));
        let mut child = bench.go_on(&[&accepted[..], &SELDOM].concat());
        bench.wait_for_lines(&mut child, logged(&bench.path("out")).len() + 3);
        signal(&mut child, "INT");
        assert_eq!(ended(child).status.code(), Some(130));
        succeeded(bench.go_on(&[]));
        assert!(ply(&bench.path("out")) == ply(&bench.path("twin")), "{keys:?}: the scene is another");
        ["out", "twin"].iter().for_each(|out| std::fs::remove_dir_all(bench.path(out)).unwrap());
    }
}

/// A dataset and first Gaussians are recognized by their contents, not by their path.
#[test]
fn a_scene_and_a_start_that_were_moved_are_named_and_the_run_goes_on() {
    let bench = Bench::new();
    let (first, moved) = (bench.path("first.ply"), bench.path("moved"));
    succeeded(bench.begin(Place::Memory, &[]));
    std::fs::rename(bench.path("out/point_cloud.ply"), &first).unwrap();
    std::fs::remove_dir_all(bench.path("out")).unwrap();
    succeeded(bench.begin(Place::Memory, &["--init-ply", text(&first)]));
    let want = ply(&bench.path("out"));
    std::fs::remove_dir_all(bench.path("out")).unwrap();
    bench.stopped_with(Place::Memory, 4, &["--init-ply", text(&first)]);
    std::fs::create_dir(&moved).unwrap();
    std::fs::rename(&bench.scene, moved.join("scene")).unwrap();
    std::fs::rename(&first, moved.join("first.ply")).unwrap();
    let (scene, start) = (moved.join("scene"), moved.join("first.ply"));
    assert!(refused(bench.go_on(&[])).contains("out SCENE"), "how to name the moved one");
    assert!(refused(bench.go_on(&[text(&scene)])).contains("first.ply"));
    let mut child = bench.go_on(&[&[text(&scene), "--init-ply", text(&start)], &SELDOM[..]].concat());
    bench.wait_for_lines(&mut child, logged(&bench.path("out")).len() + 3);
    signal(&mut child, "INT");
    assert_eq!(ended(child).status.code(), Some(130));
    // Afterwards the file exists.
    succeeded(bench.go_on(&[]));
    assert!(ply(&bench.path("out")) == want, "the scene is another");
}
