//! What a new user types first, and what the programs answer.

use crate::support::scenes::{stderr, text};
use crate::support::workdir::{EVAL, TRAIN, Workdir};

#[test]
fn a_run_needs_no_folder_and_says_where_everything_is() {
    let work = Workdir::city(16, 64, 48, 500);
    let short = "--steps 0.05k --eval-every 20 --save-every 20 --strategy none --device cpu";
    let said = work.train(&format!("scene {short}"));
    let done: Vec<&str> = said.lines().skip_while(|line| !line.starts_with("done: 50 steps, 500 Gaussians")).collect();
    for end in ["runs/scene/point_cloud.ply", "runs/scene/report.html", "gsscale-train --resume runs/scene --steps 100"]
    {
        assert!(done.iter().any(|line| line.ends_with(end)), "{said}");
    }
    assert!(done.last().is_some_and(|line| line.contains("--keep-checkpoint")), "{said}");
    let lines: Vec<&str> = said.lines().filter(|line| line.starts_with("step ")).collect();
    assert!(lines.iter().any(|line| line.starts_with("step 20: PSNR ")), "{said}");
    assert!(lines.last().is_some_and(|line| line.starts_with("step 50/50  500 Gaussians  PSNR ")), "{said}");
    assert!(lines.iter().all(|line| line.len() <= 80), "{said}");
    let plan = said.lines().take_while(|line| !line.starts_with("step "));
    assert!(plan.filter(|line| line.chars().count() > 80).count() == 0, "{said}");
    assert!(done.iter().any(|line| line.starts_with("  quality     test PSNR ")), "{said}");
    let out = "runs/scene";
    assert!([20, 40].iter().all(|step| work.exists(&format!("{out}/point_cloud_0000{step}.ply"))));

    // The curves hold the evaluation of the result, at its step.
    let metrics = work.metrics(out);
    let tested: Vec<u64> =
        metrics.iter().filter(|m| m["test"]["psnr"].is_f64()).filter_map(|m| m["step"].as_u64()).collect();
    assert_eq!(tested, [20, 40, 50]);
    assert_eq!(metrics.last().unwrap()["test"], work.summary(out)["test"]);
    let cpu = |value: &serde_json::Value| value["train_cpu_seconds"].as_f64();
    // A system that does not report CPU seconds has neither.
    assert_eq!(cpu(&metrics[0]).is_some(), cpu(&work.summary(out)).is_some());

    // An evaluation knows the scene of a run, by its folder or its PLY.
    for model in ["runs/scene", "runs/scene/point_cloud.ply"] {
        // Rounding in the PLY.
        assert!((work.eval_psnr(&format!("{model} --test-every 8")) - work.psnr(out)).abs() < 2e-3);
    }
    work.write("bare.ply", work.ply(out));
    let refused = work.output(EVAL, "bare.ply");
    assert!(!refused.status.success() && stderr(&refused).contains("gsscale-eval FILE SCENE"), "{}", stderr(&refused));

    // The same command again takes another folder, whatever the name by which the scene is called.
    let quiet = format!("{short} --quiet");
    let again = work.command(TRAIN, &format!(". {quiet}")).current_dir(work.scene()).output().unwrap();
    assert!(stderr(&again).is_empty() && work.exists("scene/runs/scene/point_cloud.ply"), "{}", stderr(&again));
    work.train(&format!("{} {quiet}", text(&work.scene())));
    assert!(work.exists("runs/scene-2/point_cloud.ply"));
    let by_cargo = work.command(TRAIN, "scene --steps 2 --device cpu").env("CARGO", "cargo").output().unwrap();
    assert!(stderr(&by_cargo).contains("cargo install --path . puts them on the PATH"), "{}", stderr(&by_cargo));
    let said = stderr(&work.output(TRAIN, "scene --dry-run"));
    assert!(said.contains("runs/scene is taken: results go to runs/scene-4; "), "{said}");
}

/// A command that is said for a folder with a space and a quote in its name works in a shell.
#[cfg(unix)]
#[test]
fn commands_that_are_said_can_be_pasted_into_a_shell() {
    use crate::support::workdir::{CKPT, VIEW, says, succeeded};
    let work = Workdir::city(12, 48, 32, 200);
    let out = "my runs/it's";
    let mut train = work.command(TRAIN, "scene --steps 4 --strategy none --device cpu");
    let said = stderr(&succeeded(train.args(["--out", out]).output().unwrap()));
    let command = said.lines().find_map(|line| line.strip_prefix("  more steps  ")).unwrap();
    assert_eq!(command, r"gsscale-train --resume 'my runs/it'\''s' --steps 8");
    let programs = std::path::Path::new(TRAIN).parent().unwrap();
    let mut shell = std::process::Command::new("/bin/sh");
    succeeded(shell.args(["-c", command]).env("PATH", programs).current_dir(work.path("")).output().unwrap());
    assert_eq!(work.count(out, "steps"), 8);

    // A run that was stopped has no result, and what to do about it is said.
    std::fs::remove_file(work.path(out).join("point_cloud.ply")).unwrap();
    let told = |program: &str, flags: &str| stderr(&work.command(program, flags).arg(out).output().unwrap());
    let resume = r"gsscale-train --resume 'my runs/it'\''s'";
    for program in [EVAL, VIEW] {
        let told = told(program, "");
        says(&told, &["still trains or was stopped", resume]);
        assert!(!told.contains("live page"), "{told}");
    }
    says(&told(CKPT, "ls"), &["has not made a commit", resume]);
}

/// In a quiet environment, as of a container.
#[test]
fn drivers_do_not_speak_for_gsscale() {
    let work = Workdir::new();
    let listed = work.command(TRAIN, "--list-devices").env_remove("XDG_RUNTIME_DIR").output().unwrap();
    assert!(!stderr(&listed).contains("XDG_RUNTIME_DIR"), "{}", stderr(&listed));
}
