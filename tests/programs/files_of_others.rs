//! No command replaces or removes files of the user: photos, poses, models, results of another kind.

use crate::support::scenes::stderr;
use crate::support::workdir::{BENCH, CKPT, EVAL, Workdir, says};

/// A folder of photos and poses may have the name and the file names of the city of a demo.
#[test]
fn a_demo_takes_a_scene_for_its_own_only_by_the_mark() {
    let work = Workdir::city(3, 32, 24, 50);
    std::fs::create_dir(work.path("mine")).unwrap();
    std::fs::rename(work.scene(), work.path("mine/scene")).unwrap();
    std::fs::remove_file(work.path("mine/scene/.gsscale-city")).unwrap();
    let before = work.files("mine");
    work.refuses("--demo --out mine --steps 2 --device cpu", &["mine", "exists already"]);
    let words = ["sparse", ".gsscale-city", "nothing was overwritten"];
    work.refuses("--demo --out mine --steps 2 --device cpu --overwrite", &words);
    assert!(work.files("mine") == before);
}

#[test]
fn an_output_replaces_only_what_its_flag_writes() {
    let work = Workdir::city(4, 48, 32, 100);
    work.run("run", "--steps 2 --test-every 2 --keep-checkpoint");
    std::fs::create_dir(work.path("pictures")).unwrap();
    work.write("pictures/a.PNG", "a picture");
    std::fs::create_dir(work.path("levels")).unwrap();
    work.write("levels/lod-meta.json", "{}");
    let header =
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    work.write("scan.ply", format!("{header}1 2 3\n"));
    let before = work.files("");
    for (program, flags, words) in [
        (EVAL, "run --renders scene/images", ["among the photos", "scene/images"]),
        (EVAL, "run --renders scene/images/new", ["among the photos", "scene/images"]),
        (EVAL, "run --renders pictures", ["no evaluation wrote", "a.PNG"]),
        (EVAL, "run --json run/point_cloud.ply", ["--json would replace", "run/point_cloud.ply"]),
        (EVAL, "run --json scene/sparse/0/cameras.bin", ["--json would replace", "cameras.bin"]),
        (EVAL, "run --json run/summary.json", ["--json would replace", "summary.json"]),
        (EVAL, "levels/lod-meta.json scene --page scan.ply", ["--page would replace", "scan.ply"]),
        (BENCH, "compare run run --out run/config.toml", ["--out would replace", "config.toml"]),
        (CKPT, "export run --out scan.ply", ["--out would replace", "scan.ply"]),
    ] {
        work.refuses_with(program, flags, &words);
        assert!(work.files("") == before, "{flags}");
    }
    // What the same flag wrote before is replaced.
    for _ in 0..2 {
        work.succeeds(EVAL, "run --json figures.json --renders renders");
        work.succeeds(BENCH, "compare run run --out page.html");
        work.succeeds(CKPT, "export run --out exported.ply");
    }
    // An evaluation that was stopped left pictures, but only an empty list of them.
    work.write("renders/views.json", "[]");
    work.succeeds(EVAL, "run --renders renders");
    assert_eq!(work.json("renders/views.json").as_array().map(Vec::len), Some(2));
}

/// As macOS leaves them on drives that others share.
#[test]
fn a_file_among_the_pictures_costs_no_report() {
    let work = Workdir::city(4, 48, 32, 100);
    std::fs::create_dir_all(work.path("run/renders/test")).unwrap();
    work.write("run/renders/test/._view_0000.png", "no picture");
    work.run("run", "--steps 2 --test-every 2 --log tensorboard --overwrite");
    assert_eq!(work.text("run/report.html").matches("class=\"slider\"").count(), 2);
    // Nor does a picture that was damaged.
    work.write("run/renders/test/view_0000.png", "no picture");
    let said = stderr(&work.succeeds(BENCH, "compare run run --out both.html"));
    says(&said, &["warning: ", "view_0000.png"]);
    assert_eq!(work.text("both.html").matches("class=\"slider\"").count(), 1);
}

#[test]
fn results_do_not_go_among_the_photos() {
    let work = Workdir::city(4, 48, 32, 100);
    let before = work.files("scene");
    for flags in [
        "scene --out scene/images --overwrite",
        "scene --out scene/images/x",
        "scene --out scene/images/x --dry-run",
        "scene/images --out scene/images/x",
    ] {
        work.refuses(&format!("{flags} --steps 2 --device cpu"), &["among the photos of the scene", "--out"]);
        assert!(work.files("scene") == before && !work.exists("scene/images/x"), "{flags}");
    }
    // Beside them is room.
    work.run("scene/runs/a", "--steps 2");
}
