//! `gsscale-bench doctor`: what it says of a sound device, of one with too little memory, and of one that computes wrongly.

use crate::support::a_device;
use crate::support::scenes::stderr;
use crate::support::workdir::{BENCH, EVAL, TRAIN, Workdir, succeeded};
use serde_json::Value;
use std::process::{Command, Output};

/// Runs the doctor, on a device that compiles a shader wrongly if `fault` says so.
fn doctor(work: &Workdir, flags: &[&str], fault: Option<&str>) -> Output {
    let mut doctor = Command::new(BENCH);
    doctor.current_dir(work.path("")).args(["doctor", "--quick"]).args(flags);
    doctor.envs(fault.map(|fault| ("GSSCALE_SHADER_FAULT", fault))).output().unwrap()
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap()
}

#[test]
fn a_sound_device_is_told_from_one_with_too_little_memory() {
    let Some(()) = a_device() else { return };
    let work = Workdir::new();
    succeeded(doctor(&work, &[], None));
    let found = json(&work.text("doctor/doctor.json"));
    let checks = found["checks"].as_array().unwrap();
    assert!(checks.len() == 3 && checks.iter().all(|check| check["verdict"] == "good"), "{found}");
    assert!(work.text("doctor/doctor.html").contains("8 views agree with the CPU"));
    let has_subgroups = &found["subgroups"];

    // A driver whose subgroups hold their invocations in another order computes without them, and is sound.
    let other_order = "scan.wgsl:workgroup_scan(1u=workgroup_scan(place.lane & 1u";
    succeeded(doctor(&work, &["--out", "shuffled"], Some(other_order)));
    let found = json(&work.text("shuffled/doctor.json"));
    assert_eq!((has_subgroups.as_bool(), found["subgroups"].as_bool()), (Some(true), Some(false)), "{found}");

    let poor = doctor(&work, &["--device-mem", "100KiB", "--out", "poor"], None);
    assert_eq!(poor.status.code(), Some(1), "{}", stderr(&poor));
    let found = json(&work.text("poor/doctor.json"));
    assert_eq!(found["checks"][0]["verdict"], "failed", "{found}");
    assert!(found["checks"][0]["found"].as_str().unwrap().contains("memory"), "{found}");

    assert!(stderr(&poor).contains("did not fit into the memory of the GPU"), "{}", stderr(&poor));
    let mut lost = Command::new(BENCH);
    lost.current_dir(work.path("")).args(["doctor", "--quick", "--out", "lost"]).env("GSSCALE_GPU_FAULT", "lost@5");
    let lost = stderr(&lost.output().unwrap());
    assert!(lost.contains("was lost during the checks") && !lost.contains("computes something else"), "{lost}");

    let none = doctor(&work, &["--device", "no such card"], None);
    assert!(!none.status.success() && stderr(&none).contains("--list-devices"), "{}", stderr(&none));
}

/// Each is a shader that a driver compiles wrongly, and the stage that the doctor names.
#[test]
fn a_wrong_constant_is_found_and_its_stage_is_named() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(6, 64, 48, 300);
    for (fault, stage) in [
        ("sh_fwd.wgsl:0.28209479=0.3", "sh_fwd"),
        ("sh_bwd.wgsl:0.28209479=0.3", "sh_bwd"),
        ("project_bwd.wgsl:-2.0 * (s=-2.1 * (s", "project_bwd"),
        ("rasterize_bwd.wgsl:alpha * over=1.01 * alpha * over", "rasterize_bwd"),
    ] {
        let wrong = doctor(&work, &[], Some(fault));
        assert_eq!(wrong.status.code(), Some(1), "{fault}: {}", stderr(&wrong));
        let said = stderr(&wrong);
        assert!(said.contains(stage) && said.contains("--device cpu"), "{fault}: {said}");
    }
    let of_pages = "update.wgsl:g * g *=1.01 * g * g *";
    let wrong = doctor(&work, &[], Some(of_pages));
    let said = stderr(&wrong);
    assert_eq!(wrong.status.code(), Some(1), "{said}");
    assert!(said.contains("8 views agree") && said.contains("--optimizer-on host"), "{said}");

    // A run on such a device does not begin, unless it needs no pages there.
    let run = |fault: &str, flags: &str| {
        let mut run = work.command(TRAIN, &format!("scene --overwrite --out run --device gpu --steps 1 {flags}"));
        run.env("GSSCALE_CHECK_DEVICE", "1").env("GSSCALE_SHADER_FAULT", fault).output().unwrap()
    };
    for (fault, flags, stage, remedy) in [
        ("sh_fwd.wgsl:0.28209479=0.3", "", "sh_fwd", "--device cpu"),
        (of_pages, "--optimizer-on device", "gather and update", "--optimizer-on host"),
    ] {
        let refused = run(fault, flags);
        let said = stderr(&refused);
        assert!(!refused.status.success() && said.contains(stage) && said.contains(remedy), "{said}");
        assert!(!work.path("run/point_cloud.ply").exists());
    }
    succeeded(run(of_pages, ""));

    // Pictures of a run with its pages on a sound device need no update of pages.
    work.train("scene --out sound --quiet --device gpu --optimizer-on device --steps 1");
    let mut eval = work.command(EVAL, "sound --device gpu");
    succeeded(eval.env("GSSCALE_CHECK_DEVICE", "1").env("GSSCALE_SHADER_FAULT", of_pages).output().unwrap());
}
