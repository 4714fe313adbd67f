//! `gsscale-plan` through its binary: figures that add up, exact lists, and refusals with a remedy.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "support/scenes.rs"]
mod scenes;

use scenes::{city, text};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};
use tempfile::TempDir;

fn plan(scene: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gsscale-plan")).arg(text(scene)).args(args).output().unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout.clone()).unwrap()
}

#[test]
fn a_scene_is_planned_for_several_memories_and_orders() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 300, 32, 24, 8000);
    let common = ["--page-rows", "32", "--steps", "1000", "--test-every", "0"];
    let with = |more: &[&str]| stdout(&plan(&scene, &[&common[..], more].concat()));
    let orders = "auto,shuffle,groups:4,tour";
    let value: Value =
        serde_json::from_str(&with(&["--compare-frames", "70%,100%", "--compare-orders", orders, "--json"])).unwrap();
    let plans = value["plans"].as_array().unwrap();
    assert_eq!((plans.len(), value["views"].as_u64().unwrap()), (8, 300));
    let number = |plan: &Value, key: &str| plan[key].as_f64().unwrap();
    for plan in &plans[..4] {
        assert!(number(plan, "hit_rate") >= number(plan, "lru_hit_rate") && plan["is_belady_bound"] == true);
        // Each page is written by the import; beyond it everything that is read pushes something out.
        assert!(number(plan, "bytes_written") >= number(&value, "state_bytes"));
        assert!(number(plan, "bytes_read") > 0.0 && number(plan, "share_of_endurance") < 1.0);
    }
    assert!(number(&plans[1], "hit_rate") < number(&plans[3], "hit_rate"), "a tour reads less than a shuffle");
    // When everything fits nothing is read again, and auto is a shuffle.
    assert!(
        plans[4..].iter().all(|plan| number(plan, "hit_rate") == 1.0 && number(plan, "stall_seconds_worst") == 0.0)
    );
    assert_eq!(plans[4]["view_order"], "shuffle");
    let table = with(&["--compare-frames", "70%", "--compare-orders", orders]);
    assert_eq!(table.lines().count(), 3 + 4, "{table}");
    // The exact lists of two steps: what leaves makes room for what enters.
    let lists = with(&["--compare-frames", "70%", "--view-order", "shuffle", "--lists", "700..740"]);
    let lines: Vec<&str> = lists.lines().collect();
    assert!(lines[0].starts_with("step 700: ") && lines.iter().any(|line| line.starts_with("step 701: ")), "{lists}");
    let count = |sign: &str| lines.iter().filter_map(|l| l.strip_prefix(sign)).flat_map(str::split_whitespace).count();
    assert!(count("  + ") > 0 && count("  + ") == count("  - "), "{lists}");
}

#[test]
fn a_run_folder_knows_its_scene_and_too_little_memory_is_refused() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 64, 48, 800);
    let run = folder.path().join("run");
    std::fs::create_dir(&run).unwrap();
    std::fs::write(run.join("config.toml"), format!("steps = 77\n[resolved]\nscene = {:?}\n", text(&scene))).unwrap();
    let told = stdout(&plan(&run, &["--page-rows", "16", "--compare-frames", "100%"]));
    assert!(told.contains("by all 77 steps"), "{told}");
    for (args, words) in [
        (&["--page-rows", "16", "--frames", "2"][..], ["2 frames", "--host-mem"]),
        (&["--compare-frames", "many"], ["'many'", "25%"]),
        (&["--compare-orders", "random"], ["'random'", "groups:<n>"]),
        (&["--drive-read", "0"], ["--drive-read", "bytes per second"]),
        (&["--lists", "5..5"], ["5..5", "100..110"]),
    ] {
        let output = plan(&run, args);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && words.iter().all(|word| said.contains(word)), "{said}");
    }
}
