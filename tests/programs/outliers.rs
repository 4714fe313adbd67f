//! Photos that contradict the scene, through the real binaries.

use crate::support::a_device;
use crate::support::scenes::add_boxes;
use crate::support::workdir::Workdir;
use gsscale::config::file::TrainConfig;
use gsscale::dataset::disturb::{Disturbance, plan, write_disturbed};
use gsscale::train::start::first_scene::prepare;

const SWAPPED: Disturbance = Disturbance::Swapped { share: 0.1, are_removed: false };

struct Disturbed<'a> {
    work: &'a Workdir,
    name: &'static str,
    test_after: i64,
    wrong: Vec<String>,
}

/// The scene, disturbed, in the folder `name`.
fn disturbed<'a>(work: &'a Workdir, name: &'static str, disturbance: &Disturbance) -> Disturbed<'a> {
    let dataset = prepare(&work.scene(), &TrainConfig::default()).unwrap().dataset;
    let made = plan(&dataset, disturbance, 3).unwrap();
    write_disturbed(&work.path(name), &dataset, disturbance, 3).unwrap();
    Disturbed { work, name, test_after: made.test_after.into(), wrong: made.wrong }
}

impl Disturbed<'_> {
    /// Trains on the CPU unless the flags say otherwise, and returns what it said.
    fn run(&self, out: &str, more: &str) -> String {
        let fixed = format!("{} --quiet --device cpu --test-after {}", self.name, self.test_after);
        self.work.train(&format!("{fixed} --out {out} {more}"))
    }
}

fn named(work: &Workdir, out: &str) -> Vec<String> {
    let summary = work.summary(out);
    let views = summary["outlier_views"].as_array().map_or(&[][..], Vec::as_slice);
    views.iter().map(|view| view["name"].as_str().unwrap().to_string()).collect()
}

/// A city large enough for quality to say something, and steps for it.
fn large_city() -> Workdir {
    Workdir::city(32, 128, 96, 3000)
}

const STEPS: &str = "--steps 600 --schedule run-length --max-gaussians 8000";

#[test]
fn swapped_photos_are_named_and_no_others_and_leaving_them_out_helps() {
    let work = large_city();
    let swapped = disturbed(&work, "swapped", &SWAPPED);
    assert_eq!(swapped.wrong.len(), 4);
    let said = swapped.run("c", &format!("{STEPS} --robust-views=off"));
    assert!(swapped.wrong.iter().all(|name| said.contains(name.as_str())) && said.contains("--robust-views"), "{said}");
    let said = swapped.run("d", &format!("{STEPS} --robust-views"));
    assert!(said.contains("are left out from here on"), "{said}");
    let [with, without] = ["c", "d"].map(|out| work.psnr(out));
    println!("swapped {with:.2} dB, without wrong views {without:.2} dB");
    assert_eq!(named(&work, "d"), swapped.wrong, "every wrong view and no right one");
    // Photos that are trained on in wrong places spoil the picture of a right neighbour too.
    let of_c = named(&work, "c");
    let beside = of_c.iter().filter(|name| !swapped.wrong.contains(name)).count();
    assert!(swapped.wrong.iter().all(|name| of_c.contains(name)) && beside <= 1, "{of_c:?}");
    // Four of 28 photos are lost whatever is done: .3 dB of the .8 dB that swapped photos cost after 1,500 steps.
    assert!(without > with + 0.2, "{without} {with}");
    let report = work.text("d/report.html");
    assert!(report.contains("Photos that contradict the scene") && report.contains("left out"));
}

/// Share of the photos that a run has masked.
fn masked(work: &Workdir, out: &str) -> f64 {
    work.summary(out)["masked_share"].as_f64().unwrap()
}

#[test]
fn masking_what_stands_on_one_photo_only_wins_decibels() {
    let work = large_city();
    let boxes = disturbed(&work, "boxes", &Disturbance::Boxes { count: 20, are_masked: false });
    let steps = format!("{STEPS} --steps 1200");
    boxes.run("c", &format!("{steps} --robust-pixels=off"));
    let said = boxes.run("e", &steps);
    assert!(said.contains("masked from here on"), "{said}");
    let said = disturbed(&work, "clean", &Disturbance::Nothing).run("b", &steps);
    assert!(!said.contains("masked"), "{said}");
    let contradicted = ["b", "e"].map(|out| work.summary(out)["contradicted_share"].as_f64().unwrap());
    println!("contradicted: {:.2} % of the clean city, {:.2} %", 100.0 * contradicted[0], 100.0 * contradicted[1]);
    assert!(2.0 * contradicted[0] < contradicted[1], "{contradicted:?}");
    let [with, masking] = ["c", "e"].map(|out| work.psnr(out));
    println!("boxes {with:.2} dB, masked by itself {masking:.2} dB, {:.1} %", 100.0 * masked(&work, "e"));
    assert!(masking > with + 0.3, "{masking} {with}");
    assert!(["b", "c"].iter().all(|out| work.summary(out)["masked_share"].is_null()));
    // Its checkpoint is gone, and with it what was measured; the decision holds.
    work.train("--resume e --steps 1240 --quiet --device cpu");
    assert!(masked(&work, "e") > 0.0);
    let reports =
        ["b", "e"].map(|out| work.text(&format!("{out}/report.html")).contains("Parts of photos that contradict"));
    assert_eq!(reports, [false, true]);
}

/// What was measured, the landmarks and the decision are parts of a commit.
#[test]
fn a_run_that_is_killed_around_its_decision_decides_and_masks_the_same() {
    let work = Workdir::city(24, 64, 48, 1500);
    add_boxes(&work.photos());
    let flags = "--steps 1200 --strategy none --log-every 1";
    work.run("whole", flags);
    assert!(masked(&work, "whole") > 0.01, "nothing is masked, so the test shows nothing");
    // Two passes of 21 photos are measured before step 600.
    assert!(
        work.begin(&format!("scene --quiet --device cpu --out cut --commit-every 0.01 {flags}"))
            .after_lines("cut", 575)
            .kill()
    );
    assert!(work.begin("--resume cut --quiet --device cpu").after_lines("cut", 620).kill());
    work.train("--resume cut --quiet --device cpu --threads 1");
    assert!(work.ply("cut") == work.ply("whole"));
    let figures = ["contradicted_share", "masked_share"];
    assert_eq!(
        figures.map(|key| work.summary("cut")[key].clone()),
        figures.map(|key| work.summary("whole")[key].clone())
    );
}

#[test]
fn a_gpu_masks_and_names_what_the_cpu_does() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(24, 96, 64, 1500);
    for (name, how, flag) in [
        ("boxes", Disturbance::Boxes { count: 8, are_masked: false }, "--robust-pixels"),
        ("swapped", SWAPPED, "--robust-views"),
    ] {
        let scene = disturbed(&work, name, &how);
        let [cpu, gpu] = ["cpu", "gpu"].map(|device| {
            let out = format!("{name}-{device}");
            scene.run(&out, &format!("--steps 150 --strategy none {flag} --device {device}"));
            out
        });
        println!("{name}: {:.3} dB on the CPU, {:.3} dB on the GPU", work.psnr(&cpu), work.psnr(&gpu));
        if name == "boxes" {
            assert!(masked(&work, &cpu) > 0.01, "nothing is masked, so the test shows nothing");
            assert!((masked(&work, &cpu) - masked(&work, &gpu)).abs() < 0.01);
        } else {
            assert!(!named(&work, &cpu).is_empty(), "no view is named, so the test shows nothing");
            assert_eq!(named(&work, &cpu), named(&work, &gpu));
        }
        // As without remedies: rounding differences grow with every step, in both directions.
        assert!((work.psnr(&cpu) - work.psnr(&gpu)).abs() < 0.1);
    }
}

/// The host looks at the picture of a step whose pages a device holds, and ends the step there if the picture contradicts its photo.
#[test]
fn pages_on_a_device_give_the_same_bytes_without_wrong_views() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(24, 96, 64, 1500);
    let swapped = disturbed(&work, "swapped", &SWAPPED);
    let flags = "--steps 110 --strategy none --robust-views --device gpu --optimizer-on device --page-rows 32 --view-order shuffle";
    for (out, slots) in [("all", "64MiB"), ("few", "5MiB")] {
        swapped.run(out, &format!("{flags} --device-mem {slots}"));
    }
    assert!(!named(&work, "all").is_empty(), "no view was left out, so the test shows nothing");
    assert!(work.ply("all") == work.ply("few"), "fewer slots give other bytes");
}

/// The first exposures are fitted to a rough scene. They keep no right photo out, because photos that are left out are fitted too.
#[test]
fn exposures_of_the_first_looks_leave_no_right_view_out() {
    let work = large_city();
    for (name, disturbance) in [("clean", Disturbance::Nothing), ("swapped", SWAPPED)] {
        let mut of = disturbed(&work, name, &disturbance);
        of.run("out", &format!("{STEPS} --robust-views --appearance exposure --strategy long-axis --overwrite"));
        let mut named = named(&work, "out");
        named.sort();
        of.wrong.sort();
        assert_eq!(named, of.wrong, "{name}");
        let is_reported = work.text("out/report.html").contains("Photos that contradict the scene");
        assert_eq!(is_reported, !named.is_empty(), "{name}");
    }
}
