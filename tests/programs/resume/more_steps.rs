//! Kept checkpoints: named checkpoints, and finished runs continued to more steps.

use super::bench::{BUSY, Bench, Place, SELDOM, STEPS};
use crate::support::workdir::{Workdir, copy_folder, open_store};
use gsscale::checkpoint::run_state::RunState;

/// Named checkpoints keep their steps and evaluations; a run returns to one of them.
#[test]
fn saves_are_named_checkpoints() {
    let bench = Bench::new();
    let more = "--save-every 60 --eval-every 50 --keep-checkpoint --commit-every 0.05";
    let alone = bench.alone("");
    for place in [Place::Memory, Place::Spill(alone.fewest)] {
        bench.train(&bench.flags(place, more));
        assert!(bench.ply("out") == alone.ply && bench.exists("out/point_cloud_000120.ply"));
        let folder = bench.checkpoint(place);
        let (lock, opened, _) = open_store(&folder);
        let commits = opened.commits;
        let generations = commits.generations();
        let state = |generation| RunState::from_bytes(&commits.run_state(generation).unwrap()).unwrap().trainer;
        let saved = generations.pins().iter().map(|(name, &generation)| (name.as_str(), state(generation)));
        let saved: Vec<_> = saved.map(|(name, state)| (name, state.step, state.test.unwrap())).collect();
        let steps: Vec<_> = saved.iter().map(|(name, step, test)| (*name, *step, test.step)).collect();
        assert_eq!(steps, [("step-120", 120, 100), ("step-180", 180, 150), ("step-60", 60, 50)]);
        assert!(saved.iter().all(|(_, _, test)| test.psnr > 5.0 && test.views == 1));
        // The last two generations are kept, named or not.
        assert_eq!(generations.kept().count(), 5);
        let last = state(generations.latest());
        assert_eq!(last.step, STEPS);
        // JSON may change the last digit.
        assert!((last.test.unwrap().psnr - bench.psnr("out")).abs() < 1e-9);
        // Returns to a name and continues from there.
        let back = generations.pins()["step-120"];
        commits.rollback(back).unwrap();
        drop(lock);
        std::fs::remove_file(bench.path("out/point_cloud.ply")).unwrap();
        bench.go_on("--keep-checkpoint=false");
        assert!(bench.ply("out") == alone.ply, "{place:?}: the scene is another after going back");
        assert!(!folder.join("FORMAT").exists());
        bench.clear();
    }
}

/// A checkpoint in the output folder that its user has deleted cannot lie on a drive that is not mounted.
#[test]
fn a_kept_checkpoint_that_was_deleted_is_no_obstacle_to_more_steps() {
    let work = Workdir::city(8, 64, 48, 300);
    work.run("out", "--steps 10 --keep-checkpoint");
    work.remove("out/checkpoint");
    let said = work.train("--resume out --steps 20 --device cpu");
    assert!(said.contains("goes on from its Gaussians") && work.summary("out")["steps"] == 20, "{said}");
    assert!(work.exists("out/checkpoint/FORMAT"));
    // One that lies in its place is not looked for elsewhere, and one that lost a file is not gone.
    let before = work.files("out");
    work.refuses("--resume out --steps 30 --spill-dir new", &["out/checkpoint", "leave --spill-dir out"]);
    let format = work.bytes("out/checkpoint/FORMAT");
    std::fs::remove_file(work.path("out/checkpoint/FORMAT")).unwrap();
    work.refuses("--resume out --steps 30", &["has lost its file FORMAT", "gsscale-ckpt salvage"]);
    work.write("out/checkpoint/FORMAT", format);
    assert!(work.files("out") == before && !work.exists("new"));
    // A run that went on from its result goes on when its folder is moved.
    std::fs::rename(work.path("out"), work.path("moved")).unwrap();
    work.train("--resume moved --steps 25 --device cpu --quiet");
    std::fs::rename(work.path("moved"), work.path("out")).unwrap();
    // Settings that are cut off: the remedy costs nothing.
    let config = work.text("out/config.toml");
    work.write("out/config.toml", &config[..config.len() / 2]);
    work.refuses("--resume out --steps 30", &["move the file away"]);
    work.remove("out/checkpoint");
    work.refuses("--resume out --steps 30", &["repair it", "--init-ply"]);
    work.write("out/config.toml", config);
    work.train("--resume out --steps 30 --device cpu --quiet");
    let said = work.train("scene --out out --overwrite --steps 5 --device cpu --quiet");
    assert!(said.contains("--overwrite has removed the checkpoint of 30 steps"), "{said}");
}

/// More steps than planned: the learning-rate schedule stays the same, whenever the change is given and however the run
/// is interrupted.
#[test]
fn more_steps_keep_the_schedule() {
    let bench = Bench::new();
    let alone = bench.alone("");
    // The same schedule from the start: it ends before the run does.
    bench.train(&format!("{BUSY} --out want --steps 260 --schedule-steps {STEPS}"));
    let planned = bench.ply("want");
    assert!(planned != alone.ply);
    // The evaluation after the last step is a second line of that step.
    let in_order = |steps: &[u64]| steps.windows(2).all(|pair| pair[0] <= pair[1]);
    // More steps make more rows, so the largest view needs more frames than it did.
    for place in [Place::Memory, Place::Spill(alone.fewest + 20)] {
        // Finished and kept; finished when asked again; then continued to more steps.
        bench.train(&bench.flags(place, "--keep-checkpoint"));
        assert!(bench.ply("out") == alone.ply);
        bench.go_on("");
        assert!(bench.checkpoint(place).join("FORMAT").exists(), "the kept checkpoint is gone");
        bench.resume(&format!("{SELDOM} --steps 260 --log-every 1")).after_lines("out", alone.logged.len() + 4).stop();
        // The run remembers its number of steps.
        bench.go_on("--keep-checkpoint=false");
        assert!(bench.ply("out") == planned, "{place:?}: the scene is another");
        assert_eq!(bench.count("out", "steps"), 260);
        let steps = bench.logged("out", "step");
        assert!(in_order(&steps) && steps.ends_with(&[260, 260]) && !steps.ends_with(&[260; 3]), "{steps:?}");
        bench.clear();
        // The change comes in mid-run.
        bench.stopped(place, 9, "");
        bench.go_on("--steps 260");
        assert!(bench.ply("out") == planned, "{place:?}: the scene is another when told before the end");
        let before = bench.psnr("out");
        // The checkpoint is gone: the run goes on from its PLY, which stays in its place until the new one replaces it.
        let lines = bench.lines("out");
        let run = bench.resume(&format!("{SELDOM} --steps 100000 --log-every 1")).after_lines("out", lines + 4);
        assert!(bench.ply("out") == planned, "{place:?}: a viewer finds no result meanwhile");
        run.signal("KILL").end();
        assert!(bench.ply("out") == planned && bench.bytes("out/point_cloud_000260.ply") == planned);
        let said = bench.go_on("--steps 300");
        assert!(said.contains("goes on from its Gaussians") && said.contains("lost: Adam's moments;"), "{said}");
        let done = bench.summary("out");
        assert!(
            done["steps"] == 300 && done["finished"] == true && done["train_seconds"].as_f64() > Some(0.0),
            "{done}"
        );
        assert!(bench.bytes("out/point_cloud_000260.ply") == planned && bench.ply("out") != planned);
        let steps = bench.logged("out", "step");
        assert!(in_order(&steps) && steps.last() == Some(&300), "lines of the attempt that was killed stay: {steps:?}");
        // 40 steps with fresh moments; a start from points is some 5 dB lower.
        assert!(bench.psnr("out") > before - 1.5, "{} after {before}", bench.psnr("out"));
        bench.clear();
    }
}

/// The result of an attempt may have replaced the earlier one when it is cut off before its summary. The next attempt goes on from the
/// earlier one all the same.
#[test]
fn a_kill_before_the_summary_of_more_steps_costs_no_result() {
    let work = Workdir::city(12, 64, 48, 600);
    work.train("scene --out out --steps 20 --device cpu --quiet");
    let first = work.ply("out");
    let summary = work.bytes("out/summary.json");
    work.train("--resume out --steps 40 --commit-every 0 --quiet");
    let want = work.ply("out");
    work.write("out/summary.json", summary);
    work.train("--resume out --commit-every 0 --quiet");
    assert!(work.bytes("out/point_cloud_000020.ply") == first, "the earlier result is gone");
    assert!(work.ply("out") == want && work.summary("out")["steps"] == 40);
}

/// As with a checkpoint. What is refused changes no file.
#[test]
fn more_steps_with_other_settings_are_refused_unless_accepted() {
    let work = Workdir::city(12, 64, 48, 600);
    work.train("scene --out out --steps 20 --device cpu --quiet");
    let before = work.files("out");
    copy_folder(&work.scene(), &work.path("copy"));
    let other = Workdir::city(14, 64, 48, 600);
    copy_folder(&other.scene(), &work.path("other"));
    for (flags, words) in [
        ("--seed 7", &["seed was", "--accept-changes"][..]),
        ("--sh-degree 1", &["sh-degree was 3 and is 1", "do not fit"]),
        ("--page-rows 64 --accept-changes", &["page-rows was", "do not fit"]),
        ("other --test-every 8", &["another scene"]),
        ("--host-mem 1MiB", &["--host-mem"]),
    ] {
        let (scene, flags) = flags.split_once("other ").map_or(("", flags), |(_, flags)| ("other", flags));
        work.refuses(&format!("--resume out {scene} --steps 40 --quiet {flags}"), words);
        assert!(work.files("out") == before, "{flags}: a refused resume changed something");
    }
    work.refuses("--resume out --steps 40 --seed 7 --dry-run", &["seed was"]);
    // A scene that was moved, and settings that change no number.
    let said = work.train("--resume out copy --steps 30 --seed 7 --accept-changes --threads 1");
    assert!(said.contains("accepted from step 20 on: seed was"), "{said}");
    assert_eq!(work.count("out", "steps"), 30);
}
