//! `gsscale-bench` at its tiny sizes: every measurement runs, and what it prints is consistent.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "support/bench.rs"]
mod bench;
#[path = "support/scenes.rs"]
mod scenes;

use bench::{bench, large_city, lines, number};
use scenes::{city, stderr, text};
use serde_json::Value;
use std::path::Path;
use tempfile::TempDir;

#[test]
fn shares_of_the_state_train_to_the_bits_of_the_run_in_memory() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let spill = folder.path().join("spill");
    let sizes = ["--steps", "100", "--turn", "7", "--warm-up", "60", "--page-rows", "16", "--strategy", "none"];
    let more = ["--spill-dir", text(&spill), "--shares", "70,0.1", "--view-order", "groups:9"];
    let lines = lines(&[&["tiers", text(&scene)][..], &sizes, &more].concat());
    let [too_small, in_memory, share] = &lines[..] else { panic!("{lines:?}") };
    assert!(number(too_small, "frames") < number(too_small, "pages_of_largest_view"));
    assert_eq!((number(in_memory, "ratio_of_sums"), &in_memory["frames"]), (1.0, &Value::Null));
    assert_eq!(share["same_last_loss"], true);
    for key in ["steps", "pages", "overfetch", "rows_per_step", "view_order"] {
        assert_eq!(share[key], in_memory[key], "{key}");
    }
    assert!(number(share, "overfetch") >= 1.0 && number(share, "seconds_per_step_median") > 0.0);
    assert!((0.0..1e6).contains(&number(share, "stall_seconds_predicted")), "{share}");
    // The bound starts and ends where the measurement does; only what was read ahead at either end may differ, which an
    // eighth of the frames bounds.
    let reads = number(share, "pages_read_per_step") * 40.0;
    let bound = number(share, "belady_pages_per_step") * 40.0;
    assert!(bound > 0.0 && reads + number(share, "frames") / 8.0 >= bound, "{reads} pages read, {bound} at least");
    assert!(spill.is_dir() && spill.read_dir().unwrap().next().is_none(), "scratch is removed");
}

#[test]
fn orders_are_compared_in_quality_and_bytes() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let out = folder.path().join("orders.html");
    let sizes = ["--steps", "10", "--page-rows", "16", "--strategy", "none", "--share", "70", "--seeds", "1,2"];
    let more = ["--compare-orders", "shuffle,tour", "--out", text(&out)];
    let lines = lines(&[&["orders", text(&scene)][..], &sizes, &more].concat());
    let names: Vec<_> = lines.iter().map(|line| (line["view_order"].as_str().unwrap(), number(line, "seed"))).collect();
    assert_eq!(names, [("shuffle", 1.0), ("tour", 1.0), ("shuffle", 2.0), ("tour", 2.0)]);
    assert!(lines.iter().all(|line| number(line, "psnr") > 5.0));
    assert!(number(&lines[1], "bytes_read_per_step") < number(&lines[0], "bytes_read_per_step"), "a tour reads less");
    let page = std::fs::read_to_string(&out).unwrap();
    assert!(page.contains("<svg") && page.contains("<td>tour</td>"));
}

#[test]
fn commits_are_measured_and_nothing_is_left() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 64, 48, 3000);
    let spill = folder.path().join("spill");
    let sizes = ["--steps", "40", "--page-rows", "32", "--commit-every", "0.01", "--open-pages", "300"];
    let lines = lines(&[&["commit", text(&scene), "--spill-dir", text(&spill)][..], &sizes].concat());
    let [trained, opened] = &lines[..] else { panic!("{lines:?}") };
    assert_eq!((number(trained, "steps"), number(opened, "open_pages")), (40.0, 300.0));
    assert!(number(trained, "commits") > 1.0 && number(trained, "commit_bytes") > 0.0);
    let percent = number(trained, "commit_overhead_percent");
    assert!(percent > 0.0 && percent <= 100.0 && number(trained, "beside_percent") <= 100.0, "{trained}");
    assert!(number(trained, "commit_loss_seconds") > 0.0 && number(opened, "open_seconds") > 0.0);
    assert!(spill.read_dir().unwrap().next().is_none(), "what was written is removed");
}

#[test]
fn sizes_see_the_same_rows_whatever_lies_behind_them() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let spill = folder.path().join("spill");
    let sizes = ["--steps", "60", "--turn", "7", "--page-rows", "16", "--strategy", "none", "--copies", "1,3"];
    let lines = lines(&[&["sizes", text(&scene), "--spill-dir", text(&spill)][..], &sizes].concat());
    let [one, three] = &lines[..] else { panic!("{lines:?}") };
    assert_eq!(number(three, "gaussians"), 3.0 * number(one, "gaussians"));
    assert_eq!((&one["frames"], number(one, "ratio_of_medians")), (&three["frames"], 1.0));
    // Neighbours at the ends of a copy may differ, and with them a few first scales.
    assert!((number(three, "rows_ratio") - 1.0).abs() < 0.01, "{three}");
    assert!((number(three, "pages_per_step") / number(one, "pages_per_step") - 1.0).abs() < 0.2, "{one} {three}");
    assert!(number(three, "pages") > 2.5 * number(one, "pages") && number(three, "seconds_per_step_median") > 0.0);
    assert!(spill.read_dir().unwrap().next().is_none(), "scratch is removed");
}

#[test]
fn touched_bytes_are_timed_beside_a_copy() {
    let args = ["touched", "--rows", "5000", "--rounds", "3", "--listed", "100,50", "--page-rows", "128"];
    let lines = lines(&args);
    let listed: Vec<f64> = lines.iter().map(|line| number(line, "rows_listed")).collect();
    assert!(listed[0] == 5000.0 && (2200.0..2800.0).contains(&listed[1]), "{listed:?}");
    for line in &lines {
        for of in ["forwarding", "optimizer", "copy", "plain_forwarding", "plain_optimizer"] {
            assert!(number(line, &format!("{of}_bytes_per_second")) > 0.0, "{line}");
        }
        for of in ["forwarding", "optimizer", "both"] {
            assert!(number(line, &format!("{of}_over_copy")) > 0.0, "{line}");
            assert!(number(line, &format!("{of}_over_plain")) > 0.0, "{line}");
        }
    }
}

#[test]
fn touched_bytes_of_the_rows_that_views_list() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 64, 48, 3000);
    let of = |views: &str, rounds: &str| {
        lines(&["touched", text(&scene), "--views", views, "--rounds", rounds, "--page-rows", "64"])
    };
    let lines = of("2", "2");
    assert_eq!(lines.len(), 2);
    assert_ne!(lines[0]["view"], lines[1]["view"]);
    // What is listed does not depend on what was measured before, and no view is measured twice.
    let more = of("1000", "5");
    assert_eq!((&more[0]["rows_listed"], more.len()), (&lines[0]["rows_listed"], 21));
    let second = more.iter().find(|line| line["view"] == lines[1]["view"]).unwrap();
    assert_eq!(second["rows_listed"], lines[1]["rows_listed"]);
    for line in &lines {
        let (listed, rows, run) = (number(line, "rows_listed"), number(line, "rows"), number(line, "rows_in_a_run"));
        assert!(listed >= 1.0 && listed <= rows && (1.0..=listed).contains(&run), "{line}");
        // Neighbours lie side by side, so that a view lists them together; drawn ones would be apart.
        let share = listed / rows;
        assert!(share == 1.0 || run > 1.0 / (1.0 - share), "{line}");
        assert!(number(line, "both_over_copy") > 0.0, "{line}");
    }
}

/// A control group is made where this user may make one; else the line says why not.
#[test]
#[cfg(unix)]
fn a_city_larger_than_memory_trains_under_a_hard_limit() {
    let folder = TempDir::new().unwrap();
    let dir = folder.path().join("bounded");
    let sizes = ["--gaussians", "240000", "--city", "20000", "--views", "24", "--steps", "12", "--page-rows", "128"];
    let lines = lines(&[&["bounded", "--dir", text(&dir), "--host-mem", "128MiB"][..], &sizes].concat());
    let [line] = &lines[..] else { panic!("{lines:?}") };
    assert_eq!((number(line, "gaussians"), number(line, "steps")), (240_000.0, 12.0), "{line}");
    assert!(line["is_bounded"] == true && line["finished"] == true, "{line}");
    assert_ne!(line["limited_by"].is_null(), line["no_limit_because"].is_null(), "{line}");
    assert!(number(line, "state_bytes") > number(line, "limit_bytes"), "{line}");
    assert!(number(line, "host_bytes_peak") <= number(line, "limit_bytes"), "{line}");
    assert!(!dir.exists(), "all of it is removed");
}

#[test]
fn a_run_needs_no_name_and_wrong_input_is_refused() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 10, 64, 48, 300);
    let line = |args: &[&str]| {
        let all = lines(&[args, &[text(&scene), "--steps", "4", "--threads", "1"]].concat());
        assert_eq!(all.len(), 1);
        all[0]["last_loss_bits"].clone()
    };
    assert_eq!(line(&[]), line(&["run"]));
    let refuses = |args: &[&str], words: &str| {
        let output = bench(args);
        assert_eq!(output.status.code(), Some(1));
        assert!(stderr(&output).contains(words) && stderr(&output).contains("remedy"), "{}", stderr(&output));
    };
    refuses(&["tiers", text(&scene)], "--spill-dir");
    refuses(&["commit", text(&scene)], "--spill-dir");
    let spill = text(folder.path());
    refuses(&["tiers", text(&scene), "--spill-dir", spill, "--shares", "0"], "--shares");
    refuses(&["orders", text(&scene), "--compare-orders", "random"], "--compare-orders");
    refuses(&["orders", text(&scene), "--share", "101"], "--share");
    refuses(&["sizes", text(&scene)], "--spill-dir");
    refuses(&["sizes", text(&scene), "--spill-dir", spill, "--copies", "1,0"], "--copies");
    refuses(&["touched", "--listed", "0"], "--listed");
    refuses(&["touched", text(&folder.path().join("nowhere"))], "nowhere");
    let taken = text(folder.path());
    refuses(&["bounded", "--dir", taken], "exists already");
    let new = folder.path().join("new");
    refuses(&["bounded", "--dir", text(&new), "--gaussians", "lots"], "--gaussians");
    refuses(&["bounded", "--dir", text(&new), "--gaussians", "999"], "fewer than");
    assert!(!new.exists());
    refuses(&["run", text(Path::new("/nowhere"))], "nowhere");
}
