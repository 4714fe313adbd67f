//! Runs whose scene grows: a run finishes with the same bytes in every memory that its steps fit into. A run that stops
//! names an amount of memory that is larger than its own and sufficient. Through the real binary; `--frames` is set
//! only where a test concerns it.

#[cfg(target_os = "linux")]
use crate::support::memory_group::MemoryGroup;
use crate::support::scenes::{self, stderr, summary, text, train};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use std::path::{Path, PathBuf};
use std::process::Output;
use tempfile::TempDir;

/// Every kind of event happens several times: rounds (which also prune), opacity resets and raises of the SH degree.
/// Small pages split often. Pruning by size would start with the first reset.
const EVENTS: &str = "--page-rows 32 --refine-start 10 --refine-every 10 --reset-every 45 --sh-every 30 --prune-opa 0.05 \
    --prune-scale3d 1000 --view-order groups:4 --test-every 8 --threads 2 --device cpu --schedule classic --strategy default";

fn words(text: &str) -> Vec<&str> {
    text.split_whitespace().collect()
}

/// A city of 2 by 2 blocks: almost every view of 64x48 sees almost every page.
fn compact_city(folder: &Path) -> PathBuf {
    let scene = folder.join("scene");
    let size = CityOptions { seed: 5, views: 16, width: 64, height: 48, points: 3_000, ..CityOptions::default() };
    write_city(&scene, &CityOptions { blocks: Some(2), supersample: 1, ..size }, &|_, _| {}).unwrap();
    scene
}

/// A run into `out`, with its pages in a folder beside it.
fn train_in(scene: &Path, out: &Path, flags: &[&str]) -> Output {
    let spill = out.with_extension("spill");
    let fixed = [text(scene), "--out", text(out), "--overwrite", "--spill-dir", text(&spill)];
    train(&[&fixed[..], &words(EVENTS), flags].concat())
}

/// The final Gaussians of a run.
fn ply(out: &Path) -> Vec<u8> {
    std::fs::read(out.join("point_cloud.ply")).unwrap()
}

/// The number after `words` in a program's message, with its unit as a flag takes it.
fn named(said: &str, words: &str) -> String {
    let rest = said.split(words).nth(1).unwrap_or_else(|| panic!("{words} is not in: {said}"));
    let number: String = rest.chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '.' || *c == ' ').collect();
    number.split_whitespace().take(2).collect::<String>()
}

/// A number of MiB.
fn mebibytes(text: &str) -> f64 {
    text.strip_suffix("MiB").unwrap_or_else(|| panic!("'{text}' is no number of MiB")).parse().unwrap()
}

/// The smallest memory, MiB, with which a run of `scene` starts.
fn floor(scene: &Path, out: &Path, flags: &[&str]) -> f64 {
    // Enough for the pages of a view, but not for everything else.
    let output = train_in(scene, out, &[flags, &["--host-mem", "20MiB"]].concat());
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    mebibytes(&named(&stderr(&output), "give at least "))
}

/// Runs with a cap and without one, each with default memory, with much, and with little more than the minimum: all
/// write the bytes of the run in memory. The last of them has no cap; its bytes are those of the file in `alone`.
fn finishes_in_every_memory(folder: &Path, scene: &Path, first: u32, moves: bool) {
    let (alone, out) = (folder.join("alone"), folder.join("out"));
    // Caps that are reached in the first rounds and later: pages are full, half empty, or both.
    for cap in [first + first / 10, first + first / 2, 0] {
        let growth = format!("--grow-grad2d 0.001 --steps 100 --quiet --max-gaussians {cap}");
        let flags = words(&growth);
        let in_memory = [&[text(scene), "--out", text(&alone), "--overwrite"], &words(EVENTS)[..], &flags].concat();
        let output = train(&in_memory);
        assert!(output.status.success(), "{growth}: {}", stderr(&output));
        let whole = summary(&alone);
        assert!(whole["gaussians"].as_u64() > Some(u64::from(first) * 105 / 100), "it hardly grew: {whole}");
        // Room for the pages, 28 KiB each, that a view needs at the end, and half as much again for its rows.
        let pages = whole["pages_pinned_max"].as_f64().unwrap() * 28.0 / 1024.0;
        let close = format!("{}MiB", (floor(scene, &out, &flags) + 1.5 * pages).ceil());
        // Much memory holds all pages, as the default does: once is enough.
        let much = (cap == 0).then_some(Some("2GiB"));
        for host_mem in [None, Some(close.as_str())].into_iter().chain(much) {
            let what = format!("{growth}, memory {host_mem:?}");
            let memory = host_mem.map_or(Vec::new(), |bytes| vec!["--host-mem", bytes]);
            let output = train_in(scene, &out, &[&flags[..], &memory].concat());
            assert!(output.status.success(), "{what}: {}", stderr(&output));
            let done = summary(&out);
            assert!(done["finished"] == true && ply(&out) == ply(&alone), "{what}: another scene than in memory");
            let is_little = host_mem == Some(&close);
            assert_eq!(done["pages_read"].as_u64() > Some(0), moves && is_little, "{what}: {done}");
        }
    }
}

#[test]
fn a_run_whose_views_see_every_page_finishes_in_every_memory_that_holds_them() {
    let folder = TempDir::new().unwrap();
    let scene = compact_city(folder.path());
    finishes_in_every_memory(folder.path(), &scene, 3_000, false);
}

#[test]
fn a_run_whose_views_see_a_part_finishes_in_every_memory_that_holds_it() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 8_000);
    finishes_in_every_memory(folder.path(), &scene, 8_000, true);
    // Each of these events had an effect.
    let out = folder.path().join("out");
    let with = |flag: &str, value: &str| {
        let mut flags = words(EVENTS);
        let at = flags.iter().position(|word| *word == flag).unwrap();
        flags[at + 1] = value;
        let growth = words("--grow-grad2d 0.001 --steps 100 --quiet");
        let output = train(&[&[text(&scene), "--out", text(&out), "--overwrite"], &flags[..], &growth].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        ply(&out)
    };
    let want = ply(&folder.path().join("alone"));
    for (flag, never) in
        [("--refine-every", "1000"), ("--reset-every", "0"), ("--sh-every", "1000"), ("--prune-opa", "0")]
    {
        assert!(with(flag, never) != want, "{flag} {never} changes nothing");
    }
}

/// A run whose views outgrow its frames finishes with the bytes of the run in memory: in the smallest memory with which it
/// starts, in that with a quarter more, and with a given number of frames. A tenth less is refused.
#[test]
fn a_run_whose_views_outgrow_its_memory_goes_in_batches() {
    let folder = TempDir::new().unwrap();
    let wide = folder.path().join("wide");
    std::fs::create_dir(&wide).unwrap();
    let alone = folder.path().join("alone");
    // With two frames a step of the wide city is hundreds of batches, so the compact city alone has that case.
    for (name, scene, shares, more) in [
        (
            "compact",
            compact_city(folder.path()),
            &[2, 10, u64::MAX][..],
            "--grow-grad2d 0.0005 --steps 60 --quiet --spill-codec zstd:1 --image-cache 64KiB",
        ),
        ("large", scenes::wide_city(&wide, 8_000), &[2, 10], "--grow-grad2d 0.00002 --steps 70 --quiet"),
    ] {
        let (out, flags) = (folder.path().join(name), words(more));
        let output =
            train(&[&[text(&scene), "--out", text(&alone), "--overwrite"], &words(EVENTS)[..], &flags].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        let pages = summary(&alone)["pages_pinned_max"].as_u64().unwrap();
        let least = floor(&scene, &out, &flags).ceil();
        let memories = [least, (1.25 * least).ceil()].map(|least| format!("{least}MiB"));
        let frames: Vec<String> = shares.iter().map(|share| (pages / share).max(2).to_string()).collect();
        let flagged = |flag| move |value| [flag, value];
        let budgets = memories.iter().map(String::as_str).map(flagged("--host-mem"));
        for within in budgets.chain(frames.iter().map(String::as_str).map(flagged("--frames"))) {
            let output = train_in(&scene, &out, &[&flags[..], &within].concat());
            assert!(output.status.success(), "{name} {within:?}: {}", stderr(&output));
            let done = summary(&out);
            assert!(done["finished"] == true && ply(&out) == ply(&alone), "{name} {within:?}: another scene");
            if within[0] == "--frames" {
                let pinned = done["pages_pinned_max"].as_u64().unwrap();
                assert!(pinned <= within[1].parse().unwrap() && pinned < pages, "{name} {within:?}: {done}");
            } else {
                // A tenth on top, as everywhere.
                let peak = done["host_bytes_peak"].as_f64().unwrap() / 1048576.0;
                assert!(peak <= 1.1 * mebibytes(within[1]), "{name} {within:?}: {peak} MiB at the peak");
            }
        }
        // The floor has some margin for what a run measures anew.
        let less = format!("{}MiB", (0.9 * least).floor());
        let output = train_in(&scene, &out, &[&flags[..], &["--host-mem", &less]].concat());
        let said = stderr(&output);
        assert!(output.status.code() == Some(1) && said.contains("smallest batch of a view"), "{less}: {said}");
    }
}

#[test]
fn a_run_goes_on_in_less_memory_and_in_more() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 8_000);
    let (alone, out) = (folder.path().join("alone"), folder.path().join("out"));
    let growth = words("--grow-grad2d 0.001 --max-gaussians 12000 --quiet");
    let all = [&words(EVENTS)[..], &growth].concat();
    let output = train(&[&[text(&scene), "--out", text(&alone), "--steps", "100"], &all[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let half = ["--steps", "50", "--schedule-steps", "100", "--keep-checkpoint"];
    let rest = ["--steps", "100", "--keep-checkpoint=false", "--quiet"];
    let spill = folder.path().join("spill");
    let to_spill = ["--spill-dir", text(&spill)];
    let (much, little) = (["--host-mem", "2GiB"], ["--host-mem", "54MiB"]);
    // In memory with more than needed, then with less than all; then with less, with more, and with the default.
    for (is_paged, then, now) in [
        (false, &[][..], &[&little[..], &["--image-cache", "64KiB"]].concat()[..]),
        (true, &much[..], &little[..]),
        (true, &little[..], &["--host-mem", "0", "--image-cache", "1MiB"][..]),
    ] {
        let what = format!("{then:?} then {now:?}");
        let folders = [&[text(&scene), "--out", text(&out), "--overwrite"][..], if is_paged { &to_spill } else { &[] }];
        let output = train(&[&folders.concat()[..], &all, &half, then].concat());
        assert!(output.status.success(), "{what}: {}", stderr(&output));
        let output = train(&[&["--resume", text(&out)], &rest[..], now].concat());
        assert!(output.status.success(), "{what}: {}", stderr(&output));
        assert!(ply(&out) == ply(&alone), "{what}: another scene than without the stop");
    }
}

/// In a memory control group, which acts as a machine with that much memory: a run takes more than its first share
/// before it stops, whether its pages have a drive from the start or not.
#[cfg(target_os = "linux")]
#[test]
fn a_run_whose_memory_nobody_named_takes_what_the_machine_has() {
    let folder = TempDir::new().unwrap();
    let scene = scenes::wide_city(folder.path(), 8_000);
    let (alone, out, spill) = (folder.path().join("alone"), folder.path().join("out"), folder.path().join("spill"));
    let all = [&words(EVENTS)[..], &words("--grow-grad2d 0.0001 --max-gaussians 40000 --steps 80")].concat();
    let output = train(&[&[text(&scene), "--out", text(&alone), "--quiet"], &all[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    // 70 % hold the first view, but not the largest.
    let group = match MemoryGroup::new(60 << 20) {
        Ok(group) => group,
        Err(why) => return println!("skipped: no memory control group can be made here ({why})"),
    };
    let program = Path::new(env!("CARGO_BIN_EXE_gsscale-train"));
    for more in [&["--spill-dir", text(&spill)][..], &[]] {
        let args = [&[text(&scene), "--out", text(&out), "--overwrite", "--quiet"], &all[..], more].concat();
        let args: Vec<_> = args.iter().map(std::ffi::OsString::from).collect();
        let output = group.command(program, &args).output().unwrap();
        let said = stderr(&output);
        assert!(output.status.success(), "{more:?}: {:?}: {said}", output.status);
        assert_eq!(said.matches("takes more as long as the machine has it").count(), 1, "once: {more:?}: {said}");
        assert!(ply(&out) == ply(&alone), "{more:?}: another scene");
    }
}
