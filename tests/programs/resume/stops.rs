//! Ctrl-C and SIGTERM, followed by the same command again.

use super::bench::{Bench, Place, SELDOM, ended, logged, ply, refused, signal, succeeded};
use crate::support::scenes::{stderr, summary};

#[test]
fn a_run_that_is_asked_to_stop_says_how_to_go_on_and_does() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    let out = bench.path("out");
    for place in [Place::Spill(alone.fewest), Place::Memory] {
        // Commits only at the stops.
        let mut child = bench.begin(place, &SELDOM);
        for (lines, (name, code)) in [(3, ("INT", 130)), (12, ("TERM", 143))] {
            bench.wait_for_lines(&mut child, lines);
            signal(&mut child, name);
            let output = ended(child);
            assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
            assert!(
                stderr(&output).contains(&format!("gsscale-train --resume {}", out.display())),
                "{}",
                stderr(&output)
            );
            assert!(bench.checkpoint(place).join("map.redb").exists() && out.join("point_cloud.ply").exists());
            assert_eq!(summary(&out)["finished"], false);
            child = bench.go_on(&SELDOM);
        }
        succeeded(child);
        assert!(ply(&out) == alone.ply, "{place:?}: the scene is another");
        assert_eq!(logged(&out), alone.logged);
        assert!(place != Place::Memory || !out.join("checkpoint").exists(), "a run that is done leaves no checkpoint");
        // The run made the folder of its pages, in its first life.
        assert!(!bench.path("spill").exists(), "{place:?}: an empty folder is left");
        std::fs::remove_dir_all(&out).unwrap();
    }
}

/// Neither results nor checkpoints are overwritten silently.
#[test]
fn the_same_command_again_says_that_there_is_a_run() {
    let bench = Bench::new();
    assert!(refused(bench.go_on(&[])).contains("config.toml"));
    bench.stopped(Place::Spill(4000), 2);
    let said = refused(bench.begin(Place::Spill(4000), &[]));
    assert!(said.contains("--resume") && said.contains("another --out") && !said.contains("overwrite"), "{said}");
    // `--overwrite` covers the output, but not a spill directory.
    let said = refused(bench.begin(Place::Spill(4000), &["--overwrite"]));
    assert!(said.contains("checkpoint of another run"), "{said}");
    std::fs::remove_dir_all(bench.path("out")).unwrap();
    std::fs::remove_dir_all(bench.path("spill")).unwrap();
    bench.stopped(Place::Memory, 2);
    let said = refused(bench.begin(Place::Memory, &[]));
    assert!(said.contains("--resume") && !said.contains("overwrite"), "{said}");
    // A run that was killed before it wrote a result may be started over.
    std::fs::rename(bench.path("out/point_cloud.ply"), bench.path("kept.ply")).unwrap();
    let said = refused(bench.begin(Place::Memory, &[]));
    assert!(said.contains("--resume") && said.contains("start over with --overwrite"), "{said}");
    std::fs::rename(bench.path("kept.ply"), bench.path("out/point_cloud.ply")).unwrap();
    assert!(bench.path("out/checkpoint/FORMAT").exists());
    // Starting over removes the checkpoint, but not foreign files beside it.
    std::fs::write(bench.path("out/checkpoint/notes.txt"), "mine").unwrap();
    std::fs::remove_file(bench.path("out/metrics.jsonl")).unwrap();
    let mut child = bench.begin(Place::Memory, &[&SELDOM[..], &["--overwrite"]].concat());
    bench.wait_for_lines(&mut child, 2);
    assert!(!bench.path("out/checkpoint/FORMAT").exists() && bench.path("out/checkpoint/notes.txt").exists());
    // Nothing can be committed there; the run is unaffected.
    signal(&mut child, "INT");
    let output = ended(child);
    assert_eq!(output.status.code(), Some(130));
    assert!(stderr(&output).contains("not committed") && !stderr(&output).contains("--resume"), "{}", stderr(&output));
}

/// A run whose last evaluation failed is unfinished: its checkpoint stays, and the same command completes it.
#[test]
fn a_run_without_its_last_evaluation_goes_on_to_it() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    bench.stopped(Place::Spill(alone.fewest), 2);
    let out = bench.path("out");
    // A file blocks the folder of the pictures.
    std::fs::write(out.join("renders"), "mine").unwrap();
    assert!(refused(bench.go_on(&[])).contains("renders"));
    assert!(ply(&out) == alone.ply, "all steps were done");
    assert!(summary(&out)["finished"] == false && bench.path("spill/map.redb").exists());
    std::fs::remove_file(out.join("renders")).unwrap();
    // An older result of gsscale-eval.
    std::fs::write(out.join("evaluated.json"), "{}").unwrap();
    succeeded(bench.go_on(&[]));
    assert!(!out.join("evaluated.json").exists(), "comparisons would take it for this run's");
    let done = summary(&out);
    assert!(done["finished"] == true && done["test"]["psnr"].as_f64().is_some(), "{done}");
    assert!(ply(&out) == alone.ply && !bench.path("spill/map.redb").exists());
}

/// A run that was killed between the commit of its last evaluation and its end logs that evaluation once.
#[test]
fn a_run_that_is_killed_after_its_last_evaluation_logs_it_once() {
    let bench = Bench::new();
    let alone = bench.alone(&[]);
    let out = bench.path("out");
    succeeded(bench.begin(Place::Spill(alone.fewest), &["--keep-checkpoint"]));
    assert_eq!(logged(&out), alone.logged);
    // The summary follows that commit.
    std::fs::remove_file(out.join("summary.json")).unwrap();
    succeeded(bench.go_on(&[]));
    assert_eq!(logged(&out), alone.logged);
    assert!(summary(&out)["finished"] == true && ply(&out) == alone.ply);
}
