//! Keys that a resumed run may change, and keys that it may change only with explicit consent.

use super::bench::{Bench, Place, SELDOM};
use crate::support::scenes::TextModel;
use crate::support::workdir::{Workdir, copy_folder, sorted_rows};

#[test]
fn what_changed_is_said_and_left_as_it_was() {
    let bench = Bench::new();
    let alone = bench.alone("");
    let run = bench.start(Place::Spill(alone.fewest), SELDOM).after_lines("out", 2);
    // The folder is in use: it cannot be started, resumed or overwritten by a second process.
    let (config, words) = (bench.bytes("out/config.toml"), ["another process trains into this folder"]);
    bench.does_not_go_on("", &words);
    bench.refuses(&bench.flags(Place::Memory, "--overwrite"), &words);
    assert!(bench.bytes("out/config.toml") == config);
    run.stop();
    // The message lists every changed key and its earlier value; threads change nothing.
    let changes =
        "--means-lr 0.001 --seed 3 --threads 1 --appearance exposure --refine-poses --robust-views --robust-pixels";
    let said = bench.does_not_go_on(
        changes,
        &[
            "\n    means-lr was 0.00016 and is 0.001",
            "seed was 42 and is 3",
            "--accept-changes",
            "appearance was \"off\" and is \"exposure\"",
        ],
    );
    for (key, was) in [("refine-poses", "off"), ("robust-views", "off"), ("robust-pixels", "auto")] {
        assert!(said.contains(&format!("{key} was \"{was}\" and is \"on\"")), "{said}");
    }
    assert!(!said.contains("threads"), "{said}");
    // The layout of stored pages cannot change, and steps cannot be fewer than were done.
    bench.does_not_go_on("--page-rows 64 --accept-changes", &["page-rows was 32 and is 64", "--init-ply"]);
    bench.does_not_go_on("--steps 3", &["fewer than"]);
    // Poses, photos, points.
    let (model, photos) = (bench.files("scene/sparse/0"), bench.photos());
    let mut moved = TextModel::of(&bench.scene());
    moved.views[3].tvec[0] += 0.01;
    moved.colors[17][1] ^= 1;
    moved.write(&bench.scene());
    let photo = std::fs::read(&photos[5]).unwrap();
    std::fs::copy(&photos[6], &photos[5]).unwrap();
    let (pose, file) = (["view 4 (", "another name, set, size or pose"], ["view 6 (", "another photo or mask"]);
    bench.does_not_go_on("", &[&pose[..], &file, &["points", "are others"]].concat());
    std::fs::write(&photos[5], photo).unwrap();
    bench.remove("scene/sparse/0");
    std::fs::create_dir(bench.path("scene/sparse/0")).unwrap();
    model.iter().for_each(|(file, bytes)| std::fs::write(bench.path("scene/sparse/0").join(file), bytes).unwrap());
    // The run still resumes, and reports the new settings.
    let said = bench.train("--resume out --threads 1 --evict lru");
    let line = said.lines().find(|l| l.starts_with("resume")).unwrap();
    assert!(line.contains("threads was 0 and is 1") && line.contains("evict was"), "{line}");
    assert!(bench.ply("out") == alone.ply, "the scene is another");
}

/// Accepted changes apply from the step at which the run stopped, independent of the pages in memory, and to all later
/// restarts.
#[test]
fn accepted_changes_are_the_same_in_any_memory() {
    let bench = Bench::new();
    let alone = bench.alone("");
    bench.stopped(Place::Memory, 12, "");
    for copy in ["twin", "still"] {
        copy_folder(&bench.path("out"), &bench.path(copy));
    }
    // The change itself moves no row: without another step the rows equal those of the stopped run bit for bit. Their
    // order may differ, because oversized pages are split by now.
    let (stopped, steps) = (bench.ply("still"), bench.count("still", "steps"));
    bench.train(&format!("--resume still --quiet --means-lr 0.1 --scales-lr 0.5 --accept-changes --steps {steps}"));
    assert!(
        sorted_rows(&bench.ply("still")) == sorted_rows(&stopped),
        "rows did not take the steps that they missed at the old rates"
    );
    let other = "--means-lr 0.002 --opacities-lr 0.01 --accept-changes";
    let said = bench.go_on(other);
    assert!(said.contains("accepted from step") && said.contains("means-lr was 0.00016 and is 0.002"), "{said}");
    // The twin has fewer frames (the largest view may grow by the change), and is stopped once more, if it has not finished by then.
    let twin = format!("--resume twin --quiet --frames {}", (alone.fewest + alone.pages) / 2);
    let run = bench.begin(&format!("{twin} {other} {SELDOM}")).after_lines("twin", bench.lines("out") - 8);
    crate::support::workdir::send(&run.child, "INT");
    run.end();
    bench.train(&twin);
    assert!(bench.ply("out") == bench.ply("twin"), "the same changes gave two scenes");
    assert!(bench.ply("out") != alone.ply, "the change changed nothing");
}

/// Accepted changes belong to the run: later restarts need no flag, and end with the same bytes.
#[test]
fn other_bands_are_accepted_once() {
    let bench = Bench::new();
    for (key, value) in [("sh-start", 2), ("sh-every", 0)] {
        let other = format!("--{key} {value}");
        bench.stopped(Place::Memory, 2, "");
        copy_folder(&bench.path("out"), &bench.path("twin"));
        bench.does_not_go_on(&other, &[key]);
        bench.train(&format!("--resume twin --quiet --accept-changes {other}"));
        let lines = bench.lines("out");
        bench.resume(&format!("{other} --accept-changes {SELDOM}")).after_lines("out", lines + 3).stop();
        bench.go_on("");
        assert!(bench.ply("out") == bench.ply("twin"), "{key}: the scene is another");
        ["out", "twin"].iter().for_each(|out| bench.remove(out));
    }
}

/// A dataset and first Gaussians are recognized by their contents, not by their path.
#[test]
fn a_scene_and_a_start_that_were_moved_are_named_and_the_run_goes_on() {
    let bench = Bench::new();
    let moves = |from: &str, to: &str| std::fs::rename(bench.path(from), bench.path(to)).unwrap();
    bench.train(&bench.flags(Place::Memory, ""));
    moves("out/point_cloud.ply", "first.ply");
    bench.clear();
    bench.train(&bench.flags(Place::Memory, "--init-ply first.ply"));
    let want = bench.ply("out");
    bench.clear();
    bench.stopped(Place::Memory, 4, "--init-ply first.ply");
    std::fs::create_dir(bench.path("moved")).unwrap();
    moves("scene", "moved/scene");
    moves("first.ply", "moved/first.ply");
    bench.does_not_go_on("", &["out SCENE"]);
    bench.refuses("--resume out moved/scene --quiet", &["first.ply"]);
    let lines = bench.lines("out");
    bench
        .begin(&format!("--resume out moved/scene --quiet --init-ply moved/first.ply {SELDOM}"))
        .after_lines("out", lines + 3)
        .stop();
    // Afterwards the file exists.
    bench.go_on("");
    assert!(bench.ply("out") == want, "the scene is another");
}

/// A drive of photos that goes away and comes back costs no step.
#[test]
fn a_photo_that_cannot_be_read_ends_the_run_with_a_commit() {
    let work = Workdir::city(14, 64, 48, 300);
    let flags = "scene --steps 300 --device cpu --strategy none --log-every 1 --image-cache 1KiB --quiet";
    work.train(&format!("{flags} --out whole"));
    // In memory, which needs no flag, and through the drive.
    for (out, drive) in [("memory", ""), ("drive", "--spill-dir spill")] {
        let run = work.begin(&format!("{flags} --out {out} {drive} {SELDOM}")).after_lines(out, 8);
        std::fs::rename(work.path("scene/images"), work.path("gone")).unwrap();
        let said = run.ends(1);
        assert!(said.contains("opening the photo failed"), "{said}");
        std::fs::rename(work.path("gone"), work.path("scene/images")).unwrap();
        assert!(work.count(out, "steps") < 300, "the run had all its photos in memory");
        let said = work.train(&format!("--resume {out} --device cpu"));
        assert!(!said.contains("begins again") && work.ply(out) == work.ply("whole"), "{said}");
    }
}

/// A scene may be the file `transforms.json`, also in the commands that go on with its run. Accepted photos are those of later runs.
#[test]
fn a_run_on_a_file_of_transforms_goes_on_with_the_photos_that_were_accepted() {
    let work = Workdir::city(16, 64, 48, 300);
    TextModel::of(&work.scene()).write_transforms(&work.scene());
    work.train("scene/transforms.json --out out --steps 20 --device cpu --keep-checkpoint --quiet");
    work.refuses(
        "--resume out --steps 30 --test-every 4 --device cpu",
        &["test-every was 8 and is 4", "--accept-changes"],
    );
    work.train("--resume out --steps 30 --test-every 4 --accept-changes --device cpu --keep-checkpoint=false --quiet");
    let said = work.train("--resume out --steps 40 --device cpu");
    assert!(said.contains("12 views to train on, 4 held out") && work.summary("out")["steps"] == 40, "{said}");
}
