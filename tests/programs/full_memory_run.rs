//! A full drive under a run in memory: its commits and each of its results wait for space and say so, and the results are those of a run
//! with room. If no space is freed, the run ends with its last commit, and says what can be saved on another drive.

use crate::support::scenes::stderr;
use crate::support::small_drive::Small;
use crate::support::workdir::{CKPT, TRAIN, Workdir, says};
use std::path::PathBuf;

const ROOM: u64 = 400 << 20;

const FLAGS: &str = "scene --steps 100 --page-rows 32 --max-gaussians 9000 --view-order groups:4 --test-every 8 --device cpu \
    --quiet --threads 1 --export spz --log tensorboard --log-every 2 --refine-start 1000";

/// A run of these flags on a small drive, `drive/out`.
struct Bench {
    drive: Small,
    work: Workdir,
    more: &'static str,
}

impl Bench {
    /// `None` if this user may not mount drives.
    fn new(more: &'static str) -> Option<Bench> {
        let work = Workdir::wide_city(8_000);
        let drive = Small::mount(&work.path("drive"), ROOM)?;
        work.train(&format!("{FLAGS} --out alone --commit-every 0 {more}"));
        Some(Bench { work, drive, more })
    }

    fn flags(&self, more: &str) -> String {
        format!("{FLAGS} --out drive/out {} {more}", self.more)
    }

    /// The PLY of the run with room.
    fn want(&self) -> Vec<u8> {
        self.work.ply("alone")
    }

    fn ply(&self) -> Vec<u8> {
        self.work.ply("drive/out")
    }

    /// The run has all files of the run with room.
    fn is_whole(&self) {
        // The names of event files tell the time; pages are not results.
        let files = |out: &str| -> Vec<PathBuf> {
            let files = self.work.files(out).into_keys();
            files.filter(|file| !file.starts_with("tensorboard") && !file.starts_with("checkpoint")).collect()
        };
        assert_eq!(files("drive/out"), files("alone"));
        assert_eq!(self.work.summary("drive/out")["finished"], true);
    }
}

#[test]
fn commits_of_a_run_in_memory_wait_for_space() {
    let Some(bench) = Bench::new("") else { return };
    // Room for a PLY, without which no run begins, and not for a commit.
    bench.drive.fill(bench.want().len() as u64 + 100_000);
    let mut run = bench.work.begin(&bench.flags("--commit-every 0.02 --disk-full-wait 300"));
    run.says("paused:");
    std::thread::sleep(std::time::Duration::from_millis(200));
    assert!(run.child.try_wait().unwrap().is_none(), "it waits");
    bench.drive.free();
    let said = run.ends(0);
    says(&said, &["No space", "needs", "free", "--disk-full-wait", "there is space again", "training goes on"]);
    assert!(bench.ply() == bench.want(), "waiting changed the scene");
    assert_eq!(bench.work.summary("drive/out")["commit_interval"], 0.02);
    bench.is_whole();
}

/// The drive has room for the PLY of the first Gaussians, so that the run begins, and not for that of the grown scene. Then there is room for
/// the PLY and a tenth of it, which is less than the file for viewers takes while it is written: that file waits, and the run says
/// that the PLY is whole.
#[test]
fn each_result_of_a_run_in_memory_waits_for_space() {
    // Lines of metrics wait too, so only the last step has one.
    let Some(bench) = Bench::new("--refine-start 20 --refine-every 20 --log-every 1000") else { return };
    let (ply, first) = (bench.want().len() as u64, 8_000 * 248);
    assert!(ply > first + 200_000, "the scene hardly grew: {ply} bytes");
    bench.drive.fill(first + 100_000);
    let mut run = bench.work.begin(&bench.flags("--commit-every 0 --disk-full-wait 300"));
    run.says("paused:");
    assert!(!bench.work.exists("drive/out/point_cloud.ply"));
    bench.drive.fill(ply + ply / 10);
    run.says("point_cloud.ply is whole and can be copied");
    assert!(bench.ply() == bench.want(), "it is whole");
    bench.drive.free();
    let said = run.ends(0);
    assert!(said.matches("paused:").count() >= 2, "{said}");
    bench.is_whole();
}

#[test]
fn a_drive_that_stays_full_ends_a_run_in_memory_with_its_last_commit() {
    let Some(bench) = Bench::new("") else { return };
    // The run is not over before the little that is left then is taken.
    bench.drive.fill(ROOM / 10);
    let run = bench.work.begin(&bench.flags("--commit-every 0.02 --disk-full-wait 5"));
    let mut run = run.once(|| bench.work.has_committed("drive/out"));
    bench.drive.fill(0);
    run.says("paused:");
    // A commit that fails gives back what it had taken.
    bench.drive.fill(0);
    let said = run.ends(1);
    says(&said, &["is full: it needs", "the commit after step", "remedy: free space", "gsscale-train --resume"]);
    bench.drive.free();
    bench.work.train("--resume drive/out --quiet");
    assert!(bench.ply() == bench.want(), "the scene is another");
    bench.is_whole();
}

/// The drive has room for commits and none for the PLY: the run says how to export its last commit to another drive, and a resume writes
/// the results without a step.
#[test]
fn what_a_commit_holds_can_be_saved_on_another_drive() {
    let Some(bench) = Bench::new("") else { return };
    // Some commits of all pages, so that later ones take their slots.
    bench.work.train(&bench.flags("--commit-every 0 --keep-checkpoint"));
    for steps in [120, 140, 150] {
        bench.work.train(&format!("--resume drive/out --quiet --steps {steps}"));
    }
    let before = bench.ply();
    bench.drive.fill(before.len() as u64 / 2);
    let output = bench.work.output(TRAIN, "--resume drive/out --quiet --steps 160 --disk-full-wait 2");
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    says(
        &said,
        &[
            "paused:",
            "is full: it needs space for",
            "point_cloud.ply",
            "the commit after step 160 is intact",
            "gsscale-ckpt export",
        ],
    );
    assert!(!bench.work.exists("drive/out/.point_cloud.ply.part") && bench.ply() == before, "the earlier result stays");
    assert!(bench.work.output(CKPT, "export drive/out --out elsewhere.ply").status.success());
    bench.drive.free();
    bench.work.train("--resume drive/out --quiet");
    assert!(bench.ply() == bench.work.bytes("elsewhere.ply"));
    bench.is_whole();
    assert_eq!(bench.work.count("drive/out", "steps"), 160);
}
