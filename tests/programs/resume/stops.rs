//! Ctrl-C and SIGTERM, followed by the same command again.

use super::bench::{Bench, Place, SELDOM};

#[test]
fn a_run_that_is_asked_to_stop_says_how_to_go_on_and_does() {
    let bench = Bench::new();
    let alone = bench.alone("");
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        // Commits only at the stops.
        let mut run = bench.begin(&bench.flags(place, SELDOM).replace("--quiet", ""));
        for (lines, name, code) in [(3, "INT", 130), (12, "TERM", 143)] {
            let said = run.after_lines("out", lines).signal(name).ends(code);
            assert!(said.contains("gsscale-train --resume out"), "{said}");
            assert!(bench.checkpoint(place).join("map.redb").exists() && bench.exists("out/point_cloud.ply"));
            assert_eq!(bench.summary("out")["finished"], false);
            // There are held-out photos, but none was evaluated: neither stderr nor the report claims otherwise.
            let report = bench.text("out/report.html");
            assert!(report.contains(" of 200 steps. To go on: gsscale-train --resume") && !report.contains("held-out"));
            assert!(said.contains("quality     not evaluated") || lines > 3, "{said}");
            run = bench.resume(SELDOM);
        }
        run.ends(0);
        assert!(bench.ply("out") == alone.ply, "{place:?}: the scene is another");
        assert_eq!(bench.logged("out", "step"), alone.logged);
        assert!(!bench.exists("out/checkpoint"), "a run that is done leaves no checkpoint");
        // The run made the folder of its pages, in its first life.
        assert!(!bench.exists("spill"), "{place:?}: an empty folder is left");
        bench.clear();
    }
}

/// Neither results nor checkpoints are overwritten silently.
#[test]
fn the_same_command_again_says_that_there_is_a_run() {
    let bench = Bench::new();
    let refuses = |place, more: &str, words: &[&str]| bench.refuses(&bench.flags(place, more), words);
    let (drive, memory) = (Place::Spill(4000), Place::Memory);
    bench.stopped(drive, 2, "");
    assert!(!refuses(drive, "", &["--resume", "another --out"]).contains("overwrite"));
    // `--overwrite` covers the output, but not a spill directory.
    refuses(drive, "--overwrite", &["checkpoint of another run"]);
    bench.clear();
    bench.stopped(memory, 2, "");
    assert!(!refuses(memory, "", &["--resume"]).contains("overwrite"));
    // A run that was killed before it wrote a result may be started over.
    std::fs::remove_file(bench.path("out/point_cloud.ply")).unwrap();
    std::fs::remove_file(bench.path("out/summary.json")).unwrap();
    refuses(memory, "", &["--resume", "start over with --overwrite"]);
    assert!(bench.exists("out/checkpoint/FORMAT"));
    // Starting over removes the checkpoint, but not foreign files beside it.
    bench.write("out/checkpoint/notes.txt", "mine");
    std::fs::remove_file(bench.path("out/metrics.jsonl")).unwrap();
    let run = bench.start(memory, &format!("{SELDOM} --overwrite")).after_lines("out", 2);
    assert!(!bench.exists("out/checkpoint/FORMAT") && bench.exists("out/checkpoint/notes.txt"));
    // Nothing can be committed there; the run is unaffected.
    let said = run.stop();
    assert!(said.contains("not committed") && !said.contains("--resume"), "{said}");
}

/// A run whose last evaluation failed is unfinished: its checkpoint stays, and the same command completes it.
#[test]
fn a_run_without_its_last_evaluation_goes_on_to_it() {
    let bench = Bench::new();
    let alone = bench.alone("");
    bench.stopped(Place::Spill(alone.fewest), 2, "");
    // A file blocks the folder of the pictures.
    bench.write("out/renders", "mine");
    bench.does_not_go_on("", &["renders"]);
    assert!(bench.ply("out") == alone.ply, "all steps were done");
    assert!(bench.summary("out")["finished"] == false && bench.exists("spill/map.redb"));
    std::fs::remove_file(bench.path("out/renders")).unwrap();
    // An older result of gsscale-eval.
    bench.write("out/evaluated.json", "{}");
    bench.go_on("");
    assert!(!bench.exists("out/evaluated.json"), "comparisons would take it for this run's");
    let done = bench.summary("out");
    assert!(done["finished"] == true && done["test"]["psnr"].as_f64().is_some(), "{done}");
    assert!(bench.ply("out") == alone.ply && !bench.exists("spill/map.redb"));
}

/// A run that was killed between the commit of its last evaluation and its end logs that evaluation once.
#[test]
fn a_run_that_is_killed_after_its_last_evaluation_logs_it_once() {
    let bench = Bench::new();
    let alone = bench.alone("");
    bench.train(&bench.flags(Place::Spill(alone.fewest), "--keep-checkpoint"));
    assert_eq!(bench.logged("out", "step"), alone.logged);
    // The summary follows that commit.
    std::fs::remove_file(bench.path("out/summary.json")).unwrap();
    bench.go_on("");
    assert_eq!(bench.logged("out", "step"), alone.logged);
    assert!(bench.summary("out")["finished"] == true && bench.ply("out") == alone.ply);
}
