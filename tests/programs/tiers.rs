//! Memory budgets and the spill directory at the command line: a budget that is too small is refused with numbers and
//! alternatives, and files no longer needed are removed.

use crate::support::scenes::{stderr, told};
use crate::support::workdir::{TRAIN, Workdir, least_memory, says};

fn small() -> Workdir {
    Workdir::city(12, 96, 64, 3000)
}

/// A city of whose pages a view sees at most two thirds.
fn large() -> Workdir {
    Workdir::city(150, 48, 32, 8000)
}

/// Asserts that the run ends with code 1, prints all of `words`, and leaves no output; returns what it says.
fn refuses(work: &Workdir, more: &str, words: &[&str]) -> String {
    let said = work.refuses(&format!("scene --out out --steps 12 --overwrite {more}"), words);
    assert!(!work.exists("out"), "bad input leaves nothing behind");
    said
}

#[test]
fn budgets_that_are_too_small_are_refused_with_numbers_and_alternatives() {
    let work = small();
    // A drive would take more memory than so few Gaussians.
    let said = refuses(&work, "--host-mem 8MiB", &["--host-mem: 8.0 MiB", "give at least", "of memory"]);
    assert!(!said.contains("--spill-dir"), "{said}");
    work.train(&format!("scene --dry-run --steps 12 --host-mem {}MiB", least_memory(&said)));
    refuses(&work, "--host-mem 8MiB --spill-dir spill", &["8.0 MiB", "take", "at least"]);
    assert!(!work.exists("spill"), "a refused run leaves no spill directory");
    refuses(&work, "--frames 1 --page-rows 64", &["--frames: 1", "give at least 2"]);
    refuses(&work, "--page-rows 3", &["--page-rows"]);
    refuses(&work, "--sh-degree 1 --sh-start 2", &["--sh-start"]);
}

#[test]
fn the_spill_directory_goes_with_its_run() {
    let work = small();
    let with_drive = "--frames 60 --page-rows 64 --spill-dir spill --strategy none";
    let said = work.train(&format!("scene --out out --steps 12 {with_drive}"));
    assert!(said.contains("60 frames of pages") && said.contains("drive "));
    assert!(!work.exists("spill"), "removed at a clean end");
    let done = work.summary("out");
    // All 48 pages fit, so no page is read back.
    assert!(done["pages_read"] == 0 && done["frames"] == done["pages"], "{done}");
    let config = work.text("out/config.toml");
    assert!(config.contains("view-order = \"shuffle\""), "resolved once, and recorded: {config}");
}

#[test]
fn a_dry_run_touches_no_spill_directory() {
    let work = small();
    let said = work.train("scene --dry-run --spill-dir spill");
    assert!(!work.exists("spill") && !said.contains("warning"), "{said}");
    // Each kept checkpoint may come to hold every page.
    let said = work.train("scene --dry-run --spill-dir spill --save-every 1 --steps 3000000");
    assert!(said.contains("2999999 named checkpoints may take") && said.contains("--save-every"), "{said}");
    // A dry run counts frames as a run does.
    work.refuses("scene --dry-run --frames 1 --page-rows 64", &["--frames: 1"]);
}

#[test]
fn bands_are_in_use_from_the_first_step_when_asked() {
    let work = small();
    work.run("out", "--steps 12 --sh-start 3 --strategy none");
    let rows = work.gaussians("out/point_cloud.ply").0;
    let trained = rows.sh_n.chunks_exact(45).filter(|row| row.iter().any(|&x| x != 0.0)).count();
    assert!(trained > 1000, "{trained} rows have trained bands");
}

#[test]
fn a_budget_that_was_refused_trains_with_what_the_remedy_names() {
    let work = large();
    // First frames get an eighth of this budget, which does not hold the pages of the largest view.
    // A driver takes more memory than all pages together, by an amount that varies.
    let more = "scene --device cpu --steps 12 --prefetch-bytes 1MiB --page-rows 16 --strategy none --spill-dir spill";
    let enough = least_memory(&work.refuses(&format!("{more} --out out --host-mem 32MiB"), &[]));
    work.train(&format!("{more} --out out --host-mem {enough}MiB"));
    // A dry run prints the same for frames over a drive, and needs no folder.
    let dry = |budget: &str| work.output(TRAIN, &format!("{more} --dry-run --host-mem {budget}"));
    let (enough, too_little) = (dry(&format!("{enough}MiB")), dry("32MiB"));
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
    assert!(!work.exists("spill"));
    let [frames, pinned, pages] = ["frames", "pages_pinned_max", "pages"].map(|key| work.count("out", key));
    assert!(pinned <= frames && frames < pages, "not all pages fit: {frames} of {pages}");
}

/// The order of views in the config of a run.
fn order_of(work: &Workdir, out: &str) -> String {
    let config = work.text(&format!("{out}/config.toml"));
    let line = config.lines().find(|line| line.starts_with("view-order = ")).unwrap();
    line.split('"').nth(1).unwrap().to_string()
}

/// `auto` is resolved once, at the start of a run: the order stays even if another budget would choose another order.
#[test]
fn an_order_that_was_chosen_is_kept_under_another_budget() {
    let work = large();
    let common = "--page-rows 16 --strategy none --test-every 0";
    work.run("out", &format!("{common} --steps 60 --frames 330 --spill-dir spill --keep-checkpoint"));
    let order = order_of(&work, "out");
    assert!(order.starts_with("groups:"), "{order}");
    // All pages fit now.
    work.train("--resume out --steps 200 --frames 1000 --keep-checkpoint=false --quiet");
    assert_eq!(order_of(&work, "out"), order);
    let with_order = |order: &str| {
        work.run("alone", &format!("{common} --steps 200 --schedule-steps 60 --overwrite --view-order {order}"))
    };
    let got = work.ply("out");
    assert!(got == with_order(&order), "another scene than with {order} from the start");
    assert!(got != with_order("auto"), "in memory auto is a shuffle, so this shows nothing");
}

/// Rounds come at the ends of epochs where views come in groups, also where the run has chosen the groups. A resumed run finds the order
/// by its name.
#[test]
fn an_order_that_was_chosen_has_the_rounds_of_the_same_order_by_name() {
    let work = large();
    let run = |out: &str, more: &str| {
        let rounds = "--strategy long-axis --refine-start 60 --refine-every 60 --max-gaussians 10000";
        work.run(out, &format!("--steps 480 --page-rows 16 --test-every 0 {rounds} {more}"))
    };
    let chosen = run("chosen", "--frames 330 --spill-dir spill");
    let order = order_of(&work, "chosen");
    assert!(order.starts_with("groups:"), "{order}");
    assert!(chosen == run("named", &format!("--view-order {order}")), "{order} by name gives another scene");
    // An epoch has 150 steps. A round of it recycles as many rows as all rounds of the config's steps would.
    let seldom = run("seldom", &format!("--view-order {order} --refine-every 150"));
    assert!(chosen != seldom, "the config of the rounds changes nothing, so this shows little");
}

/// The codec that a run announces at its start.
#[test]
fn the_codec_follows_from_the_moments() {
    let work = small();
    for (moments, codec) in [("f32", "raw"), ("bf16", "halves")] {
        let flags = "scene --steps 12 --frames 80 --page-rows 64 --spill-dir spill --dry-run --moments";
        let said = told(&work.output(TRAIN, &format!("{flags} {moments}")));
        let line = said.lines().find(|line| line.contains("one version is ")).expect(&said);
        assert_eq!(line.split(['(', ')']).nth(1), Some(codec), "{line}");
    }
}

#[test]
fn metrics_and_progress_tell_what_moves() {
    let work = large();
    let drive = "--frames 330 --page-rows 16 --spill-dir spill --view-order shuffle";
    let said = work.train(&format!(
        "scene --out out --steps 120 --log-every 10 --strategy none --test-every 0 --device cpu {drive}"
    ));
    let last = said.lines().rfind(|line| line.starts_with("step 120/120")).expect(&said);
    says(last, &["/s", "PSNR ", " Gaussians", "0 s left"]);
    assert!(last.len() <= 80, "{last}");
    let lines = work.metrics("out");
    assert_eq!(lines.len(), 12);
    // Totals since the start, equal to the final summary.
    let done = work.summary("out");
    for key in
        ["pages_needed", "pages_read", "late_misses", "bytes_read", "bytes_written", "stall_seconds", "host_bytes_peak"]
    {
        let values: Vec<f64> = lines.iter().map(|line| line[key].as_f64().expect(key)).collect();
        let total = done[key].as_f64().expect(key);
        assert!(values.is_sorted() && total >= values[11], "{key}: {total} in the summary, {values:?}");
        // Every transfer was planned, and planned transfers need not be waited for.
        assert!(values[11] > 0.0 || ["late_misses", "stall_seconds"].contains(&key), "{key}: {values:?}");
    }
    assert!(done["belady_bytes_read"].as_u64() > Some(0), "{done}");
}
