//! Kept checkpoints: named checkpoints, and finished runs continued to more steps.

use super::bench::{Bench, Place, SELDOM, STEPS, ended, logged, ply, signal, succeeded};
use crate::support::scenes::{stderr, summary, text, train};
use gsscale::checkpoint::run_state::RunState;
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::map::commit::{CommitConfig, Commits};
use std::path::Path;

fn open(folder: &Path) -> (SpillDir, Commits) {
    let spill = SpillDir::open(folder, false).unwrap();
    let config = CommitConfig { store: spill.format().store, cache_bytes: 1 << 20, reserve_bytes: 0 };
    let commits = Commits::open(Box::new(DriveFolder::new(folder)), config).unwrap().commits;
    (spill, commits)
}

/// Named checkpoints keep their steps and evaluations; a run returns to one of them.
#[test]
fn saves_are_named_checkpoints() {
    let bench = Bench::new();
    let more = ["--save-every", "60", "--eval-every", "50", "--keep-checkpoint", "--commit-every", "0.05"];
    let alone = bench.alone(&[]);
    for place in [Place::Memory, Place::Spill(alone.fewest)] {
        let out = bench.path("out");
        succeeded(bench.begin(place, &more));
        assert!(ply(&out) == alone.ply && out.join("point_cloud_000120.ply").is_file());
        let (spill, commits) = open(&bench.checkpoint(place));
        let generations = commits.generations();
        let states: Vec<(String, RunState)> = generations
            .pins()
            .iter()
            .map(|(name, &g)| (name.clone(), RunState::from_bytes(&commits.run_state(g).unwrap()).unwrap()))
            .collect();
        let steps: Vec<(&str, u32)> = states.iter().map(|(name, s)| (name.as_str(), s.trainer.step)).collect();
        assert_eq!(steps, [("step-120", 120), ("step-180", 180), ("step-60", 60)]);
        let tests: Vec<u32> = states.iter().map(|(_, s)| s.trainer.test.unwrap().step).collect();
        assert_eq!(tests, [100, 150, 50]);
        assert!(states.iter().all(|(_, s)| s.trainer.test.unwrap().psnr > 5.0 && s.trainer.test.unwrap().views == 1));
        // The last two generations are kept, named or not.
        let kept: Vec<u64> = generations.kept().collect();
        assert_eq!(kept.len(), 5, "{kept:?}");
        let last = RunState::from_bytes(&commits.run_state(generations.latest()).unwrap()).unwrap();
        let psnr = summary(&out)["test"]["psnr"].as_f64().unwrap();
        assert_eq!(last.trainer.step, STEPS);
        // JSON may change the last digit.
        assert!((last.trainer.test.unwrap().psnr - psnr).abs() < 1e-9);
        // Returns to a name and continues from there.
        let back = generations.pins()["step-120"];
        commits.rollback(back).unwrap();
        drop(spill);
        std::fs::remove_file(out.join("point_cloud.ply")).unwrap();
        succeeded(bench.go_on(&["--keep-checkpoint=false"]));
        assert!(ply(&out) == alone.ply, "{place:?}: the scene is another after going back");
        assert!(!bench.checkpoint(place).join("FORMAT").exists());
        std::fs::remove_dir_all(&out).unwrap();
        let _ = std::fs::remove_dir(bench.checkpoint(place));
    }
}

/// More steps than planned: the learning-rate schedule stays the same, whenever the change is given and however the run
/// is interrupted.
#[test]
fn more_steps_keep_the_schedule() {
    let bench = Bench::new();
    let (want, out) = (bench.path("want"), bench.path("out"));
    let alone = bench.alone(&[]);
    // The same schedule from the start: it ends before the run does.
    let planned = bench.longer(&want, 260);
    assert!(planned != alone.ply);
    // More steps make more rows, so the largest view needs more frames than it did.
    for place in [Place::Memory, Place::Spill(alone.fewest + 20)] {
        // Finished and kept; finished when asked again; then continued to more steps.
        succeeded(bench.begin(place, &["--keep-checkpoint"]));
        assert!(ply(&out) == alone.ply);
        succeeded(bench.go_on(&[]));
        assert!(bench.checkpoint(place).join("FORMAT").exists(), "the kept checkpoint is gone");
        let mut child = bench.go_on(&[&SELDOM[..], &["--steps", "260", "--log-every", "1"]].concat());
        bench.wait_for_lines(&mut child, alone.logged.len() + 4);
        signal(&mut child, "INT");
        assert_eq!(ended(child).status.code(), Some(130));
        // The run remembers its number of steps.
        succeeded(bench.go_on(&["--keep-checkpoint=false"]));
        assert!(ply(&out) == planned, "{place:?}: the scene is another");
        assert_eq!(summary(&out)["steps"], 260);
        let steps = logged(&out);
        // The evaluation after the last step is a second line of that step.
        assert!(steps.windows(2).all(|pair| pair[0] <= pair[1]) && steps.last() == Some(&260), "{steps:?}");
        assert_eq!(steps.iter().filter(|&&step| step == 260).count(), 2);
        std::fs::remove_dir_all(&out).unwrap();
        // The change comes in mid-run.
        bench.stopped(place, 9);
        succeeded(bench.go_on(&["--steps", "260"]));
        assert!(ply(&out) == planned, "{place:?}: the scene is another when told before the end");
        let psnr = |out: &Path| summary(out)["test"]["psnr"].as_f64().unwrap();
        let before = psnr(&out);
        // The checkpoint is gone: the run goes on from its PLY, which stays in its place until the new one replaces it.
        let lines = logged(&out).len();
        let mut child = bench.go_on(&[&SELDOM[..], &["--steps", "100000", "--log-every", "1"]].concat());
        bench.wait_for_lines(&mut child, lines + 4);
        assert!(ply(&out) == planned, "{place:?}: a viewer finds no result meanwhile");
        signal(&mut child, "KILL");
        ended(child);
        assert!(ply(&out) == planned);
        assert!(std::fs::read(out.join("point_cloud_000260.ply")).unwrap() == planned);
        let said = stderr(&ended(bench.go_on(&["--steps", "300"])));
        assert!(said.contains("goes on from its Gaussians") && said.contains("Adam's moments are lost"), "{said}");
        let done = summary(&out);
        assert_eq!((done["steps"].as_u64(), done["finished"].as_bool()), (Some(300), Some(true)), "{said}");
        assert!(std::fs::read(out.join("point_cloud_000260.ply")).unwrap() == planned && ply(&out) != planned);
        let steps = logged(&out);
        assert!(done["train_seconds"].as_f64().unwrap() > 0.0 && steps.last() == Some(&300));
        assert!(
            steps.windows(2).all(|pair| pair[0] <= pair[1]),
            "lines of the attempt that was killed stay: {steps:?}"
        );
        // 40 steps with fresh moments; a start from points is some 5 dB lower.
        assert!(psnr(&out) > before - 1.5, "{} after {before}", psnr(&out));
        std::fs::remove_dir_all(&out).unwrap();
        let _ = std::fs::remove_dir(bench.checkpoint(place));
    }
}

impl Bench {
    /// The bytes of an uninterrupted run of more steps with the usual schedule.
    fn longer(&self, out: &Path, steps: u32) -> Vec<u8> {
        let (steps, schedule) = (steps.to_string(), STEPS.to_string());
        let args = ["--out", text(out), "--steps", &steps, "--schedule-steps", &schedule];
        let output = train(&[&[text(&self.scene)], &args[..], super::bench::BUSY].concat());
        assert!(output.status.success());
        ply(out)
    }
}
