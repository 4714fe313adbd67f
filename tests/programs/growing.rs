//! Runs whose scene grows: a run whose views outgrow its memory finishes in batches, within that memory, and a run that stops names an
//! amount of memory that is larger than its own and sufficient. That the bytes are those of a run in memory is in `matrix` as well.

#[cfg(target_os = "linux")]
use crate::support::memory_group::MemoryGroup;
#[cfg(target_os = "linux")]
use crate::support::scenes::stderr;
#[cfg(target_os = "linux")]
use crate::support::workdir::TRAIN;
use crate::support::workdir::{Workdir, least_memory};

/// Every kind of event happens several times: rounds (which also prune), opacity resets and raises of the SH degree.
/// Small pages split often. Pruning by size would start with the first reset.
const EVENTS: &str = "scene --page-rows 32 --refine-start 10 --refine-every 10 --reset-every 45 --sh-every 30 --prune-opa 0.05 \
    --prune-scale3d 1000 --view-order groups:4 --test-every 8 --threads 2 --device cpu --quiet";

/// A run whose views outgrow its frames finishes with the bytes of the run in memory: in the smallest memory with which it
/// starts, in that with a quarter more, and with a given number of frames. A tenth less is refused.
#[test]
fn a_run_whose_views_outgrow_its_memory_goes_in_batches() {
    // With two frames a step of the wide city is hundreds of batches, so the compact city alone has that case.
    for (work, shares, more) in [
        (
            Workdir::city_of(16, [64, 48], 3000, 2),
            &[2, 10, u64::MAX][..],
            "--grow-grad2d 0.0005 --steps 60 --spill-codec zstd:1 --image-cache 64KiB",
        ),
        (Workdir::wide_city(8000), &[2, 10], "--grow-grad2d 0.00002 --steps 70"),
    ] {
        work.train(&format!("{EVENTS} --out alone {more}"));
        let pages = work.count("alone", "pages_pinned_max");
        let flags = format!("{EVENTS} --out out --overwrite --spill-dir spill {more}");
        // Enough for the pages of a view, but not for everything else.
        let least = least_memory(&work.refuses(&format!("{flags} --host-mem 20MiB"), &[])).ceil();
        let finishes = |within: &str| {
            work.train(&format!("{flags} {within}"));
            assert!(work.summary("out")["finished"] == true && work.ply("out") == work.ply("alone"), "{more} {within}");
        };
        for mebibytes in [least, (1.25 * least).ceil()] {
            finishes(&format!("--host-mem {mebibytes}MiB"));
            // A tenth on top, as everywhere.
            let peak = work.count("out", "host_bytes_peak") as f64 / 1048576.0;
            assert!(peak <= 1.1 * mebibytes, "{more}: {peak} MiB at the peak, of {mebibytes}");
        }
        for frames in shares.iter().map(|share| (pages / share).max(2)) {
            finishes(&format!("--frames {frames}"));
            let pinned = work.count("out", "pages_pinned_max");
            assert!(pinned <= frames && pinned < pages, "{more}: {pinned} pinned of {frames}");
        }
        // The floor has some margin for what a run measures anew.
        let less = format!("--host-mem {}MiB", (0.9 * least).floor());
        work.remove("out");
        work.refuses(&format!("{flags} {less}"), &["smallest batch of a view"]);
    }
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
