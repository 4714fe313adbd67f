//! kill -9 before the first step and after the last one: while the scene is read, before config.toml is there, and while each result is
//! written. A resume begins the run again or writes its results, and ends with the same bytes.

use crate::support::workdir::{TRAIN, Workdir, copy_folder};

const FLAGS: &str = "scene --steps 20 --page-rows 64 --max-gaussians 3000 --test-every 4 --device cpu --quiet --export spz --threads 2 \
    --schedule run-length --strategy long-axis";

fn scene() -> Workdir {
    Workdir::city(16, 64, 48, 2000)
}

/// Starts a run, and kills it as soon as one of the files is there. Whether it was killed: a busy machine may look too late.
fn killed_at(work: &Workdir, out: &str, more: &str, files: &[&str]) -> bool {
    let folder = work.path(out);
    work.begin(&format!("{FLAGS} --out {out} {more}"))
        .once_quickly(|| files.iter().any(|file| folder.join(file).exists()))
        .kill()
}

#[test]
fn a_run_that_is_killed_while_it_writes_its_results_ends_with_the_same_files() {
    let work = scene();
    work.train(&format!("{FLAGS} --out alone"));
    let want = work.results("alone");
    for (begun, done) in [
        (".point_cloud.ply.part", "point_cloud.ply"),
        ("point_cloud.ply", "point_cloud.transform.json"),
        (".point_cloud.spz.part", "point_cloud.spz"),
        ("renders/test", "renders/test/views.json"),
        (".summary.json.part", "summary.json"),
        (".report.html.part", "report.html"),
    ] {
        // Without a commit, in memory and through the drive, and with one.
        for more in ["--commit-every 0", "--commit-every 0.02", "--spill-dir spill --spill-codec raw"] {
            killed_at(&work, "out", more, &[begun, done]);
            work.train("--resume out --quiet");
            let got = work.results("out");
            assert_eq!(got.keys().collect::<Vec<_>>(), want.keys().collect::<Vec<_>>(), "{begun}, {more}");
            assert!(got == want, "{begun}, {more}: other bytes");
            work.remove("out");
            work.remove("spill");
        }
    }
}

/// The moment between the mark of a run and its config.toml is that of reading photos and making pages.
#[test]
fn a_run_that_is_killed_before_its_config_is_there_begins_again() {
    let work = scene();
    work.train(&format!("{FLAGS} --out alone"));
    let want = work.results("alone");
    let mut marked = 0;
    for (i, more) in ["", "--spill-dir spill --spill-codec raw"].into_iter().cycle().take(6).enumerate() {
        // A path of two new folders, and settings that are not the defaults.
        let out = format!("new-{i}/out");
        killed_at(&work, &out, more, &[".gsscale-begun.toml", "config.toml"]);
        marked += u32::from(!work.exists(&format!("{out}/config.toml")));
        if i == 2 {
            // The first command again is as good.
            work.train(&format!("{FLAGS} --out {out} {more}"));
        } else {
            let said = work.output(TRAIN, &format!("--resume {out} --dry-run"));
            assert!(
                said.stderr.is_empty() && String::from_utf8_lossy(&said.stdout).contains("begins again"),
                "{said:?}"
            );
            assert!(work.train(&format!("--resume {out}")).contains("begins again"));
        }
        assert!(work.results(&out) == want, "{more}: {:?}", work.results(&out).keys());
        assert!(!work.exists("spill/FORMAT"));
    }
    assert!(marked > 0, "each kill came after config.toml");
}

/// A run that replaces an earlier one, and is killed at the end of the old files.
#[test]
fn a_run_that_is_killed_while_it_replaces_another_begins_again() {
    let work = scene();
    work.train(&format!("{FLAGS} --out alone"));
    let is_killed = (0..9).any(|_| {
        work.train(&format!("{FLAGS} --out out --seed 9 --overwrite"));
        assert!(work.ply("out") != work.ply("alone"));
        killed_at(&work, "out", "--overwrite", &[".gsscale-begun.toml"])
    });
    assert!(is_killed, "the run ended before each kill");
    // What the kill left: the mark beside some files of the earlier run.
    if work.exists("out/.gsscale-begun.toml") && work.exists("out/config.toml") {
        std::fs::remove_file(work.path("out/config.toml")).unwrap();
    }
    let said = work.train("--resume out");
    assert!(said.contains("begins again"), "{said}");
    assert!(work.results("out") == work.results("alone"), "{:?}", work.results("out").keys());
}

/// The folder is a run's from its mark on, also while its photos are read.
#[test]
fn a_run_that_begins_elsewhere_meanwhile_is_refused() {
    let work = scene();
    let first = work.begin(&format!("{FLAGS} --out out")).once_quickly(|| work.exists("out/.gsscale-begun.toml"));
    let said = work.refuses(&format!("{FLAGS} --out out --seed 9"), &["out"]);
    assert!(said.contains("another process") || said.contains("exists already"), "{said}");
    first.ends(0);
    work.train(&format!("{FLAGS} --out alone"));
    assert!(work.results("out") == work.results("alone"), "the second run touched the first one's results");
}

/// A run that is refused leaves nothing, not even the folders of its path.
#[test]
fn a_run_that_is_refused_leaves_no_mark() {
    let work = scene();
    let refused = || work.refuses(&format!("{FLAGS} --out new/deep/out --host-mem 1MiB"), &["--host-mem"]);
    refused();
    assert!(!work.exists("new"));
    std::fs::create_dir_all(work.path("new/deep/out")).unwrap();
    refused();
    assert!(work.files("new").is_empty());
}

#[test]
fn a_run_that_is_killed_before_its_first_commit_begins_again() {
    let work = scene();
    let flags = "--steps 600 --log-every 1 --strategy none --schedule-steps 20";
    work.run("alone", flags);
    // In memory, which needs no flag, and through the drive.
    for (out, drive) in [("memory", ""), ("drive", "--spill-dir spill")] {
        let begun = work.begin(&format!("scene --quiet --device cpu --out {out} {flags} {drive} --commit-every 0"));
        assert!(begun.after_lines(out, 10).kill());
        // A file of `--save-every`, which precedes the commit of its step. Without a store, the commit may be elsewhere.
        if !drive.is_empty() {
            work.write("drive/point_cloud_000005.ply", "of the run");
        }
        let said = work.train(&format!("--resume {out} --quiet --device cpu"));
        assert!(said.contains("begins again") && work.ply(out) == work.ply("alone"), "{said}");
        assert!(!work.exists("spill/FORMAT"));
    }
    // A run that goes on as it was planned is that of a run that nothing stopped.
    let cut = format!("scene --quiet --device cpu --out cut {flags} --commit-every 0.01");
    assert!(work.begin(&cut).after_lines("cut", 10).kill());
    let said = work.train("--resume cut --device cpu");
    assert!(!said.contains("final values") && work.ply("cut") == work.ply("alone"), "{said}");
}

#[test]
fn a_resume_writes_nothing_into_a_folder_that_is_no_run() {
    let work = scene();
    let before = work.files("scene").len();
    work.refuses("--resume scene", &["neither a config.toml nor a checkpoint"]);
    assert_eq!(work.files("scene").len(), before);
    // Half of a model, and photos that lie in sub-folders: neither goes around in circles.
    let cameras = ["bin", "txt"].map(|ending| work.path(&format!("scene/sparse/0/cameras.{ending}")));
    cameras.iter().for_each(|file| drop(std::fs::remove_file(file)));
    work.refuses("scene --out half", &["there is no cameras."]);
    std::fs::create_dir_all(work.path("card/DCIM")).unwrap();
    for photo in work.photos() {
        std::fs::copy(&photo, work.path("card/DCIM").join(photo.file_name().unwrap())).unwrap();
    }
    work.refuses("card --out card_run", &["gsscale-poses card --out FOLDER"]);
}

/// Segments go first, then the map, then what shows that the folder holds a store.
#[test]
fn what_a_killed_removal_leaves_of_a_store_goes_with_the_next_resume() {
    let work = scene();
    work.run("out", "--steps 12 --spill-dir spill --keep-checkpoint --device cpu");
    copy_folder(&work.path("spill"), &work.path("kept"));
    let all: Vec<String> = work.files("kept").keys().map(|name| name.display().to_string()).collect();
    let all: Vec<&str> = all.iter().map(String::as_str).chain(["LOCK"]).collect();
    assert!(all.contains(&"map.redb"), "{all:?}");
    for left in [&all, &["FORMAT", "LOCK", "witness", "map.redb"][..], &["FORMAT", "LOCK", "witness"], &["FORMAT"]] {
        for named in ["", "--spill-dir spill", "--spill-dir scene/../spill"] {
            work.remove("spill");
            std::fs::create_dir(work.path("spill")).unwrap();
            left.iter().for_each(|name| {
                std::fs::copy(work.path("kept").join(name), work.path("spill").join(name)).unwrap();
            });
            work.train(&format!("--resume out --keep-checkpoint=false --quiet {named}"));
            assert!(!work.exists("spill"), "{left:?} {named}");
        }
    }
}

/// The last steps of a run whose result cannot be written are committed.
#[test]
fn a_result_that_cannot_be_written_costs_no_step() {
    let work = scene();
    let flags = "--spill-dir spill --keep-checkpoint --commit-every 0 --log-every 1 --device cpu";
    work.run("out", &format!("--steps 20 {flags}"));
    // A folder in the place of the result's temporary file, which a resume meets at its end.
    let part = work.path("out/.point_cloud.ply.part");
    std::fs::create_dir(&part).unwrap();
    work.refuses("--resume out --steps 40 --quiet", &["point_cloud.ply"]);
    let trained = work.lines("out");
    assert!(trained >= 40, "{trained} lines: the steps were not trained");
    std::fs::remove_dir(&part).unwrap();
    work.train("--resume out --quiet");
    assert!(work.lines("out") <= trained + 1 && work.summary("out")["finished"] == true, "steps were trained again");
}
