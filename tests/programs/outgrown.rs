//! A scene that outgrows its frames or its memory: the start warns, the run goes on with views in batches or with pages that
//! move to a drive, and ends with the bytes of a run that had memory for everything. Through the real binary.

#[cfg(target_os = "linux")]
use crate::support::memory_group::MemoryGroup;
#[cfg(target_os = "linux")]
use crate::support::scenes::stderr;
use crate::support::scenes::told;
#[cfg(target_os = "linux")]
use crate::support::small_drive::Small;
use crate::support::workdir::{TRAIN, Workdir, least_memory, says};
use gsscale::dataset::synthetic::{CityOptions, write_city};

const MIB: f64 = 1048576.0;

#[test]
fn a_run_that_may_outgrow_its_frames_says_so() {
    let work = Workdir::city_of(24, [64, 48], 6000, 20);
    let said = |cap: &str| {
        let flags = "scene --out out --steps 2 --page-rows 32 --overwrite --spill-dir spill --frames 200";
        work.train(&format!("{flags} {cap}"))
    };
    says(&said("--strategy default"), &["warning: the view", "no cap", "steps on such views take several batches"]);
    assert!(!work.exists("spill") || work.files("spill").is_empty(), "nothing is left of its pages");
    // A cap that the frames hold is no reason to warn.
    assert!(!said("--max-gaussians 6300").contains("warning: the view"));
    let warned = said("--max-gaussians 600000");
    assert!(warned.contains("--max-gaussians 600000") && warned.contains("200 frames"), "{warned}");
}

/// The purpose of the drive: a scene that outgrows its memory.
fn large_scene() -> Workdir {
    Workdir::city_of(33, [160, 120], 60_000, 12)
}

/// Grows sixfold; a round every 20 steps, all colour bands in use.
const GROWING: &str = "scene --steps 120 --page-rows 64 --grow-grad2d 0.00005 --refine-start 20 --refine-every 20 --view-order \
    groups:4 --test-every 11 --commit-every 0 --device cpu --threads 2 --image-cache 4MiB --prefetch-bytes 1MiB \
    --log-every 5 --sh-start 3";

/// The run in `out` has the bytes of that in `alone` and took at most this memory; the documented error is a tenth.
fn same_within(work: &Workdir, out: &str, bytes: f64) {
    let peak = work.count(out, "host_bytes_peak") as f64;
    assert!(peak <= 1.1 * bytes, "{out}: {:.1} MB at the peak", peak / 1e6);
    assert!(work.ply(out) == work.ply("alone"), "{out}: another scene than in memory");
}

#[test]
fn a_scene_that_grows_stays_within_its_memory_and_within_less_than_its_views_take() {
    const BUDGET: f64 = 160.0 * MIB;
    let work = large_scene();
    work.train(&format!("{GROWING} --out alone --quiet"));
    let said = work.train(&format!("{GROWING} --out out --spill-dir spill --host-mem 160MiB"));
    assert!(said.contains("growth has no cap") && said.contains(" frames of pages"), "{said}");
    // Without a folder for its pages it begins in memory, and finds the drive of its results when it does not fit. Stopped after the
    // move, the run continues in the same memory.
    let half = "--spill-codec zstd:1 --evict lru --keep-checkpoint --steps 90 --schedule-steps 120";
    let said = work.train(&format!("{GROWING} --out moved --host-mem 160MiB {half}"));
    assert!(said.contains("its pages move between memory and moved/checkpoint"), "{said}");
    assert!(work.count("moved", "drive_bytes_peak") > 0);
    work.train("--resume moved --steps 120 --schedule-steps 120 --keep-checkpoint=false --quiet");
    assert!(!work.exists("moved/checkpoint"), "removed at a clean end");
    let in_memory = work.count("alone", "host_bytes_peak") as f64;
    assert!(in_memory > 1.8 * BUDGET, "{:.1} MB in memory: it hardly grew", in_memory / 1e6);
    assert_eq!(work.count("alone", "bytes_read"), 0);
    for out in ["out", "moved"] {
        same_within(&work, out, BUDGET);
        let frames = work.logged(out, "frames");
        let (most, least) = (frames.iter().max().unwrap(), frames[frames.len() / 2..].iter().min().unwrap());
        assert!(least * 4 < most * 3, "none gave way: {frames:?}");
        assert!(work.count(out, "bytes_read") > work.count(out, "other_bytes_read"), "{out}: no step read a page");
    }
    // 42 MiB of Gaussians belong on a drive.
    work.refuses(
        &format!("{GROWING} --out none --host-mem 40MiB"),
        &["name a folder on a fast drive with --spill-dir", "give at least"],
    );
    // 92 MiB do not hold the largest view of the grown scene. Its pages move to the drive of its checkpoint; a run whose pages have a
    // drive from the start is that of `a_run_whose_views_outgrow_its_memory_goes_in_batches`.
    let said = work.train(&format!("{GROWING} --out out --overwrite --host-mem 92MiB"));
    // What its steps will write is foreseen.
    says(&said, &["outgrown 92.0 MiB, --host-mem,", "its pages move to checkpoint/", "to write without commits"]);
    assert!(work.summary("out")["forecast"]["bytes_written"].as_f64().unwrap() > 0.0);
    same_within(&work, "out", 92.0 * MIB);
    let [pinned, whole] = ["out", "alone"].map(|out| work.count(out, "pages_pinned_max"));
    assert!(work.summary("out")["finished"] == true && pinned < whole, "no view was cut: {pinned} of {whole}");
}

/// The least memory of a run that outgrows it counts pages in transfer, and is enough.
#[test]
fn the_least_memory_of_a_run_that_outgrows_it_is_enough() {
    let work = Workdir::city(48, 160, 104, 1500);
    let dry = |budget: f64| {
        work.output(TRAIN, &format!("scene --steps 300 --schedule run-length --strategy long-axis --dry-run --device cpu --host-mem {budget}MiB"))
    };
    let said = told(&dry(32.0));
    says(&said, &["its pages move to checkpoint/", "in transfer, and the plan", "fewest frames"]);
    let said = told(&dry(least_memory(&said)));
    assert!(said.contains("memory  about") && !said.contains("fewest frames"), "{said}");
}

/// A photo from high above needs most of the memory for its own rows. Afterwards the frames have this memory again.
#[test]
fn frames_return_after_a_photo_that_shows_much_of_the_scene() {
    let work = Workdir::new();
    let size = CityOptions { width: 96, height: 64, points: 50_000, tiles: [2, 4], ..CityOptions::default() };
    let city = CityOptions { seed: 5, views: 24, overviews: 2, supersample: 1, ..size };
    write_city(&work.scene(), &city, &|_, _| {}).unwrap();
    let flags = "--steps 60 --page-rows 64 --strategy none --test-every 0 --commit-every 0 --log-every 1 --image-cache 4MiB \
        --prefetch-bytes 1MiB --sh-degree 1 --view-order shuffle";
    work.run("alone", flags);
    work.run("out", &format!("{flags} --spill-dir spill --host-mem 128MiB"));
    let frames = work.logged("out", "frames");
    // The first step with the fewest frames is that of a photo from high above; few photos follow until all are ordinary.
    let (wide, least) = frames.iter().enumerate().min_by_key(|(_, frames)| **frames).unwrap();
    let again = frames[wide..].iter().max().unwrap();
    // How much of the budget is free for frames is measured in the process, so their number varies by some percent.
    assert!(3 * again >= 4 * least, "{least} frames at step {wide}, at most {again} after it: {frames:?}");
    same_within(&work, "out", 128.0 * MIB);
}

/// The drive of the results is full when the pages should move there: the run reports it and continues in memory.
#[cfg(target_os = "linux")]
#[test]
fn a_run_with_no_drive_to_move_to_goes_on_in_memory() {
    let (work, fewer) = (large_scene(), format!("{GROWING} --steps 66 --quiet"));
    let Some(_drive) = Small::mount(&work.path("drive"), 60 << 20) else { return };
    work.train(&format!("{fewer} --out alone"));
    let said = work.train(&format!("{fewer} --out drive/out --host-mem 160MiB"));
    assert_eq!(said.matches("its pages cannot be moved to a drive").count(), 1, "once, not at every step: {said}");
    assert_eq!(work.count("drive/out", "bytes_read"), 0);
    assert!(work.ply("drive/out") == work.ply("alone"), "another scene than in memory");
}

/// Every kind of event happens several times: rounds (which also prune), opacity resets and raises of the SH degree.
/// Small pages split often. Pruning by size would start with the first reset.
const EVENTS: &str = "scene --page-rows 32 --refine-start 10 --refine-every 10 --reset-every 45 --sh-every 30 --prune-opa 0.05 \
    --prune-scale3d 1000 --view-order groups:4 --test-every 8 --threads 2 --device cpu --quiet";

/// A run whose views outgrow its frames finishes with the bytes of the run in memory: in the smallest memory with which it
/// starts, in that with a quarter more, and with few frames. A tenth less is refused. (A third of a view's pages: `matrix`.)
#[test]
fn a_run_whose_views_outgrow_its_memory_goes_in_batches() {
    let work = Workdir::city_of(16, [64, 48], 3000, 2);
    let flags = format!("{EVENTS} --grow-grad2d 0.0005 --steps 48 --spill-codec zstd:1 --image-cache 64KiB");
    work.train(&format!("{flags} --out alone"));
    let pages = work.count("alone", "pages_pinned_max");
    let flags = format!("{flags} --out out --overwrite --spill-dir spill");
    // Enough for the pages of a view, but not for everything else.
    let least = least_memory(&work.refuses(&format!("{flags} --host-mem 20MiB"), &[])).ceil();
    let finishes = |within: &str| {
        work.train(&format!("{flags} {within}"));
        assert!(work.summary("out")["finished"] == true && work.ply("out") == work.ply("alone"), "{within}");
    };
    for mebibytes in [least, (1.25 * least).ceil()] {
        finishes(&format!("--host-mem {mebibytes}MiB"));
        // A tenth on top, as everywhere.
        let peak = work.count("out", "host_bytes_peak") as f64 / MIB;
        assert!(peak <= 1.1 * mebibytes, "{peak} MiB at the peak, of {mebibytes}");
    }
    for frames in [pages / 10, 2] {
        finishes(&format!("--frames {frames}"));
        let pinned = work.count("out", "pages_pinned_max");
        assert!(pinned <= frames && pinned < pages, "{pinned} pinned of {frames}");
    }
    // The floor has some margin for what a run measures anew.
    let less = format!("--host-mem {}MiB", (0.9 * least).floor());
    work.remove("out");
    work.refuses(&format!("{flags} {less}"), &["smallest batch of a view"]);
}

/// In a memory control group, which acts as a machine with that much memory: a run takes more than its first share
/// before it stops, whether its pages have a drive from the start or not.
#[cfg(target_os = "linux")]
#[test]
fn a_run_whose_memory_nobody_named_takes_what_the_machine_has() {
    let work = Workdir::wide_city(8000);
    let flags = format!("{EVENTS} --grow-grad2d 0.0001 --max-gaussians 40000 --steps 80");
    work.train(&format!("{flags} --out alone"));
    // 70 % hold the first view, but not the largest.
    let group = match MemoryGroup::new(60 << 20) {
        Ok(group) => group,
        Err(why) => return println!("skipped: no memory control group can be made here ({why})"),
    };
    for more in ["--spill-dir spill", ""] {
        let output = work.within(&group, TRAIN, &format!("{flags} --out out --overwrite {more}"));
        let said = stderr(&output);
        assert!(output.status.success(), "{more}: {:?}: {said}", output.status);
        assert_eq!(said.matches("takes more as long as the machine has it").count(), 1, "once: {more}: {said}");
        assert!(work.ply("out") == work.ply("alone"), "{more}: another scene");
    }
}
