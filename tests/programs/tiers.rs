//! Memory budgets and the spill directory at the command line: a budget that is too small is refused with numbers and
//! alternatives, files no longer needed are removed, and foreign files stay.

use crate::support::scenes::{city, stderr, summary, text, told, train};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn small() -> (TempDir, PathBuf) {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 3000);
    (folder, scene)
}

fn run(folder: &Path, scene: &Path, more: &[&str]) -> std::process::Output {
    let out = folder.join("out");
    train(&[&[text(scene), "--out", text(&out), "--steps", "12", "--overwrite"], more].concat())
}

/// Asserts that the run ends with code 1, prints all of `words`, and leaves no output.
fn refuses(folder: &Path, scene: &Path, more: &[&str], words: &[&str]) {
    let output = run(folder, scene, more);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for word in words.iter().chain(&["remedy"]) {
        assert!(said.contains(word), "{word} is not in: {said}");
    }
    assert!(!folder.join("out").exists(), "bad input leaves nothing behind");
}

#[test]
fn budgets_that_are_too_small_are_refused_with_numbers_and_alternatives() {
    let (folder, scene) = small();
    let spill = folder.path().join("spill");
    refuses(folder.path(), &scene, &["--host-mem", "8MiB"], &["--host-mem: 8.0 MiB", "--spill-dir", "of memory"]);
    let with_drive = ["--host-mem", "8MiB", "--spill-dir", text(&spill)];
    refuses(folder.path(), &scene, &with_drive, &["8.0 MiB", "take", "at least"]);
    assert!(!spill.exists(), "a refused run leaves no spill directory");
    refuses(folder.path(), &scene, &["--frames", "1", "--page-rows", "64"], &["--frames: 1", "give at least 2"]);
    // An unknown word of a flag is a usage error.
    for (flag, word, known) in
        [("--io", "floppy", "uring"), ("--spill-codec", "zip", "zstd:"), ("--view-order", "groups:0", "groups:")]
    {
        let output = run(folder.path(), &scene, &[flag, word]);
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        assert!(stderr(&output).contains(flag) && stderr(&output).contains(known), "{}", stderr(&output));
    }
    refuses(folder.path(), &scene, &["--page-rows", "3"], &["--page-rows"]);
    refuses(folder.path(), &scene, &["--sh-degree", "1", "--sh-start", "2"], &["--sh-start"]);
}

#[test]
fn the_spill_directory_goes_with_its_run_and_others_files_are_safe() {
    let (folder, scene) = small();
    let spill = folder.path().join("spill");
    let with_drive = ["--frames", "60", "--page-rows", "64", "--spill-dir", text(&spill), "--strategy", "none"];
    let output = run(folder.path(), &scene, &with_drive);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains("60 frames of pages") && stderr(&output).contains("drive "));
    assert!(!spill.exists(), "removed at a clean end");
    let done = summary(&folder.path().join("out"));
    // All 48 pages fit, so no page is read back.
    assert!(done["pages_read"] == 0 && done["frames"] == done["pages"], "{done}");
    let config = std::fs::read_to_string(folder.path().join("out/config.toml")).unwrap();
    assert!(config.contains("view-order = \"shuffle\""), "resolved once, and recorded: {config}");
    std::fs::remove_dir_all(folder.path().join("out")).unwrap();
    std::fs::create_dir(&spill).unwrap();
    std::fs::write(spill.join("diary.txt"), "mine").unwrap();
    refuses(folder.path(), &scene, &with_drive, &["diary.txt"]);
    assert_eq!(std::fs::read_to_string(spill.join("diary.txt")).unwrap(), "mine");
}

#[test]
fn a_dry_run_touches_no_spill_directory() {
    let (folder, scene) = small();
    let spill = folder.path().join("spill");
    let output = train(&[text(&scene), "--dry-run", "--spill-dir", text(&spill)]);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(!spill.exists());
    assert!(!stderr(&output).contains("warning"), "{}", stderr(&output));
    // Each kept checkpoint may come to hold every page.
    let kept = ["--spill-dir", text(&spill), "--save-every", "1", "--steps", "3000000"];
    let output = train(&[&[text(&scene), "--dry-run"], &kept[..]].concat());
    let said = stderr(&output);
    assert!(output.status.success() && said.contains("2999999 named checkpoints may take"), "{said}");
    assert!(said.contains("--save-every"), "{said}");
    // A dry run counts frames as a run does.
    let output = train(&[text(&scene), "--dry-run", "--frames", "1", "--page-rows", "64"]);
    assert!(output.status.code() == Some(1) && stderr(&output).contains("--frames: 1"), "{}", stderr(&output));
}

#[test]
fn bands_are_in_use_from_the_first_step_when_asked() {
    let (folder, scene) = small();
    let output = run(folder.path(), &scene, &["--sh-start", "3", "--strategy", "none", "--quiet"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let ply = std::fs::read(folder.path().join("out/point_cloud.ply")).unwrap();
    let header_end = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let rows: Vec<f32> = ply[header_end..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    // 62 floats a row; the higher bands start at the tenth.
    let trained = rows.chunks_exact(62).filter(|row| row[9..54].iter().any(|&x| x != 0.0)).count();
    assert!(trained > 1000, "{trained} rows have trained bands");
}

#[test]
fn a_budget_that_was_refused_trains_with_what_the_remedy_names() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 150, 48, 32, 8000);
    let spill = folder.path().join("spill");
    // First frames get an eighth of this budget, which does not hold the pages of the largest view.
    let more = ["--prefetch-bytes", "1MiB", "--page-rows", "16", "--strategy", "none", "--spill-dir", text(&spill)];
    let refused = run(folder.path(), &scene, &[&["--host-mem", "32MiB"][..], &more].concat());
    let said = stderr(&refused);
    assert_eq!(refused.status.code(), Some(1), "{said}");
    let least = said.split("give at least ").nth(1).and_then(|rest| rest.split(" MiB").next()).expect(&said);
    let enough = format!("{:.1}MiB", least.parse::<f64>().unwrap() + 0.1);
    let trained = run(folder.path(), &scene, &[&["--host-mem", enough.as_str()][..], &more].concat());
    assert!(trained.status.success(), "{enough}: {}", stderr(&trained));
    // A dry run prints the same for frames over a drive, and needs no folder.
    let dry = |budget: &str| {
        let flags = [&["--steps", "12", "--dry-run", "--host-mem", budget][..], &more].concat();
        train(&[&[text(&scene)], &flags[..]].concat())
    };
    let (enough, too_little) = (dry(&enough), dry("32MiB"));
    let said = told(&enough);
    assert!(enough.status.success() && said.contains("frames of pages") && said.contains("drive  "), "{said}");
    let said = stderr(&too_little);
    assert!(
        too_little.status.code() == Some(1) && said.contains("a view") && !said.contains("name a folder"),
        "{said}"
    );
    // A dry run does not load Gaussians beyond the memory.
    let said = told(&dry("8MiB"));
    assert!(said.contains("a dry run writes none") && said.contains("8000 Gaussians"), "{said}");
    assert!(!spill.exists());
    let done = summary(&folder.path().join("out"));
    assert!(done["frames"].as_u64().unwrap() >= done["pages_pinned_max"].as_u64().unwrap());
    assert!(done["frames"].as_u64().unwrap() < done["pages"].as_u64().unwrap(), "not all pages fit");
}

/// `auto` is resolved once, at the start of a run: the order stays even if another budget would choose another order.
#[test]
fn an_order_that_was_chosen_is_kept_under_another_budget() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 150, 48, 32, 8000);
    let path = |name: &str| folder.path().join(name);
    let (out, spill, alone) = (path("out"), path("spill"), path("alone"));
    let common = ["--page-rows", "16", "--strategy", "none", "--device", "cpu", "--test-every", "0", "--quiet"];
    let begin =
        ["--steps", "60", "--frames", "330", "--spill-dir", text(&spill), "--keep-checkpoint", "--out", text(&out)];
    let begun = train(&[&[text(&scene)], &common[..], &begin].concat());
    assert!(begun.status.success(), "{}", stderr(&begun));
    let order = order_of(&out);
    assert!(order.starts_with("groups:"), "{order}");
    // All pages fit now.
    let more = ["--steps", "200", "--frames", "1000", "--keep-checkpoint=false", "--quiet"];
    let resumed = train(&[&["--resume", text(&out)], &more[..]].concat());
    assert!(resumed.status.success(), "{}", stderr(&resumed));
    assert_eq!(order_of(&out), order);
    let with_order = |order: &str| {
        let flags =
            ["--steps", "200", "--schedule-steps", "60", "--overwrite", "--view-order", order, "--out", text(&alone)];
        let output = train(&[&[text(&scene)], &common[..], &flags].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        std::fs::read(alone.join("point_cloud.ply")).unwrap()
    };
    let got = std::fs::read(out.join("point_cloud.ply")).unwrap();
    assert!(got == with_order(&order), "another scene than with {order} from the start");
    assert!(got != with_order("auto"), "in memory auto is a shuffle, so this shows nothing");
}

/// Rounds come at the ends of epochs where views come in groups, also where the run has chosen the groups. A resumed run finds the order
/// by its name.
#[test]
fn an_order_that_was_chosen_has_the_rounds_of_the_same_order_by_name() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 150, 48, 32, 8000);
    let path = |name: &str| folder.path().join(name);
    let common =
        "--steps 480 --page-rows 16 --strategy long-axis --refine-start 60 --max-gaussians 10000 --test-every 0";
    let common: Vec<&str> = common.split(' ').chain(["--device", "cpu", "--quiet"]).collect();
    let often = ["--refine-every", "60"];
    let run = |name: &str, more: &[&str]| {
        let output = train(&[&[text(&scene), "--out", text(&path(name))], &common[..], more].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        std::fs::read(path(name).join("point_cloud.ply")).unwrap()
    };
    let spill = path("spill");
    let chosen = run("chosen", &[&["--frames", "330", "--spill-dir", text(&spill)], &often[..]].concat());
    let order = order_of(&path("chosen"));
    assert!(order.starts_with("groups:"), "{order}");
    let named = ["--view-order", order.as_str()];
    assert!(chosen == run("named", &[&named, &often[..]].concat()), "{order} by name gives another scene");
    // An epoch has 150 steps. A round of it recycles as many rows as all rounds of the config's steps would.
    let seldom = run("seldom", &[&named[..], &["--refine-every", "150"]].concat());
    assert!(chosen != seldom, "the config of the rounds changes nothing, so this shows little");
}

/// The order of views in the config of a run.
fn order_of(out: &Path) -> String {
    let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
    let line = config.lines().find(|line| line.starts_with("view-order = ")).unwrap();
    line.split('"').nth(1).unwrap().to_string()
}

#[test]
fn the_codec_follows_from_the_moments() {
    let (folder, scene) = small();
    let spill = folder.path().join("spill");
    for (moments, codec) in [("f32", "raw"), ("bf16", "halves")] {
        let more =
            ["--frames", "80", "--page-rows", "64", "--spill-dir", text(&spill), "--dry-run", "--moments", moments];
        assert_eq!(codec_of(&run(folder.path(), &scene, &more)), codec);
    }
}

/// The codec that a run announces at its start.
fn codec_of(output: &std::process::Output) -> String {
    let said = told(output);
    let line = said.lines().find(|line| line.contains("one version is ")).expect(&said);
    line.split(['(', ')']).nth(1).expect(line).to_string()
}

#[test]
fn metrics_and_progress_tell_what_moves() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 150, 48, 32, 8000);
    let spill = folder.path().join("spill");
    let flags = [
        "--frames",
        "330",
        "--page-rows",
        "16",
        "--strategy",
        "none",
        "--spill-dir",
        text(&spill),
        "--test-every",
        "0",
    ];
    let more = ["--steps", "120", "--log-every", "10", "--view-order", "shuffle", "--device", "cpu"];
    let out = folder.path().join("out");
    let output = train(&[&[text(&scene), "--out", text(&out)], &flags[..], &more].concat());
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    let last = said.lines().rfind(|line| line.starts_with("step 120/120")).expect(&said);
    for word in ["/s", "PSNR ", " Gaussians", "0 s left"] {
        assert!(last.contains(word), "{word} is not in: {last}");
    }
    assert!(last.len() <= 80, "{last}");
    let metrics = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    let lines: Vec<serde_json::Value> = metrics.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 12);
    // Totals since the start, equal to the final summary.
    let done = summary(&out);
    for key in
        ["pages_needed", "pages_read", "late_misses", "bytes_read", "bytes_written", "stall_seconds", "host_bytes_peak"]
    {
        let values: Vec<f64> = lines.iter().map(|line| line[key].as_f64().expect(key)).collect();
        assert!(values.windows(2).all(|pair| pair[0] <= pair[1]), "{key}: {values:?}");
        let total = done[key].as_f64().expect(key);
        assert!(total >= values[11], "{key}: {total} in the summary, {values:?}");
        // Every transfer was planned, and planned transfers need not be waited for.
        assert!(values[11] > 0.0 || ["late_misses", "stall_seconds"].contains(&key), "{key}: {values:?}");
    }
    assert!(done["belady_bytes_read"].as_u64() > Some(0), "{done}");
}
