//! `gsscale-ckpt` through the real binary, on intact and damaged stores of stopped runs.
//!
//! `GSSCALE_CKPT_GAUSSIANS=5000000` sets the number of Gaussians to import and export within the budget (default
//! 40,000). `GSSCALE_WRITE_FIXTURE=1` rewrites the fixture store of the present format version.

mod bench;
mod fixture;

use crate::support::scenes::{self, stderr};
#[cfg(target_os = "linux")]
use crate::support::small_drive::Small;
use crate::support::workdir::{CKPT, Running, TRAIN, least_memory, split_ply};
use bench::{Bench, Ply, changed_pages, generations, pin};
use gsscale::exchange::meta::SceneMeta;
use gsscale::exchange::ply::write_gaussians;
use gsscale::page::format::slot_header::checksum;
use gsscale::scene::columns::{Column, Columns};
use serde_json::Value;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

fn number(value: &Value, key: &str) -> u64 {
    value[key].as_u64().unwrap_or_else(|| panic!("{key}: {value}"))
}

#[test]
fn inspecting_a_store_reports_what_the_run_left_and_changes_nothing() {
    let bench = Bench::new();
    bench.stopped("");
    let before = bench.store_files();
    // The output folder and the spill directory name the same store.
    let [listed, there] = ["out", "spill"].map(|dir| bench.ckpt_json(&format!("ls {dir}")));
    assert_eq!(generations(&listed), generations(&there));
    let [a, b] = generations(&listed)[..] else { panic!("{listed}") };
    let last = &listed["generations"][1];
    assert_eq!((&last["step"], &last["is_latest"]), (&bench.summary("out")["steps"], &true.into()));
    assert!(last["psnr"].as_f64().unwrap() > 5.0, "an evaluation was logged before: {last}");
    assert_eq!(there["generations"][1]["psnr"], last["psnr"], "the store itself knows");
    for generation in listed["generations"].as_array().unwrap() {
        let of = |key: &str| number(generation, key);
        assert!(of("pages") > 10 && of("bytes_alone") <= of("bytes") && of("gaussians") > 1000);
    }
    let words = bench.ckpt("ls out");
    assert!(words.contains("PSNR") && words.contains("(last)"), "{words}");

    let changed = changed_pages(&bench.spill(), a, b);
    let whole = bench.ckpt_json("inspect out");
    assert_eq!((number(&whole, "format_version"), number(&whole, "generation")), (1, b));
    assert_eq!((&whole["pages"], &whole["segment_bytes"]), (&last["pages"], &listed["segment_bytes"]));
    let state = whole["state"].to_string();
    assert!(state.contains(&format!("step {} of", last["step"])) && state.contains("rounds"), "{state}");
    let name = changed[0].as_str();
    let page = bench.ckpt_json(&format!("inspect out --page {name}"));
    assert!(number(&page, "since") == b && page["fault"].is_null() && number(&page, "rows") > 0, "{page}");
    assert!(page["stamp"]["most"].as_f64().unwrap() <= last["step"].as_f64().unwrap());
    assert!(bench.ckpt(&format!("inspect out --page {name}")).contains(&format!("page        {name}")));

    for deep in ["", "--deep"] {
        let verdict = bench.ckpt_json(&format!("verify out {deep}"));
        assert!(
            verdict["faults"].as_array().unwrap().is_empty() && verdict["versions"].as_u64() >= last["pages"].as_u64()
        );
    }
    bench.export("out", "");
    bench.ckpt("clone out copy");
    assert!(bench.store_files() == before, "a command that only looks changed the store");

    bench.fails("inspect out --page 99999", &["no page 99999", "remedy"]);
    bench.fails("inspect out --generation nosuch", &["'nosuch' is not kept", &b.to_string()]);
}

#[test]
fn an_export_is_the_trainers_file_byte_for_byte_and_can_be_a_part_of_it() {
    let bench = Bench::new();
    bench.stopped("--up keep");
    let want = bench.ply("out");
    assert!(bench.export("out", "") == want, "the export is not what the trainer wrote");
    // The minimum budget, from the tool's own message.
    let least = least_memory(&bench.fails("export out --out x.ply --host-mem 1MiB", &[]));
    let within = format!("--host-mem {least}MiB");
    assert!(bench.export("out", &within) == want, "the budget changed the file");

    // The box is in the coordinates of the dataset, which are those of this file.
    let all = Ply::of(&want);
    let export = |more: &str| Ply::of(&bench.export("out", more));
    let middle = all.median();
    let part = export(&format!("--crop {},{},{},{},1e9,1e9", middle[0], middle[1], -1e9, 1e9));
    let inside = |row: &&Vec<f32>| f64::from(row[0]) >= middle[0] && f64::from(row[1]) >= middle[1];
    let expected = all.rows.iter().filter(inside).count();
    assert!(expected > 100 && expected < all.rows.len());
    // The file's coordinates are rounded once more than the compared ones: a row on the border may differ.
    assert!(part.rows.len().abs_diff(expected) <= 2, "{} of {expected}", part.rows.len());
    assert!(part.rows.iter().filter(inside).count() + 2 >= part.rows.len());

    let few = export("--max-gaussians 200");
    assert_eq!(few.rows.len(), 200);
    let mut visible: Vec<f64> = all.rows.iter().map(|row| all.visibility(row)).collect();
    visible.sort_by(f64::total_cmp);
    let least = visible[visible.len() - 200];
    assert!(few.rows.iter().all(|row| all.visibility(row) >= least * (1.0 - 1e-4)), "others are more visible");
    assert_eq!(export("--max-gaussians 99999999").rows.len(), all.rows.len());
    let flat = export("--sh-degree 0");
    assert_eq!((flat.names.len(), flat.rows.len()), (17, all.rows.len()));

    bench.fails("export out --out x.ply --crop 1e8,1e8,1e8,2e8,2e8,2e8", &["no Gaussian lies in this box"]);
    bench.fails("export out --out x.ply --crop 1,2,3", &["is not a box"]);
    // Files of others stay.
    for (other, out) in
        [("mine.spz", "mine.spz"), ("mine.transform.json", "mine.ply"), ("mine.spz.transform.json", "mine.spz")]
    {
        bench.write(other, "{\"mine\": 1}");
        bench.fails(&format!("export out --out {out}"), &[other, "writes no such file"]);
        assert_eq!(bench.text(other), "{\"mine\": 1}");
        std::fs::remove_file(bench.path(other)).unwrap();
    }
    bench.fails("export out --out no/folder.ply", &["no/folder.ply"]);
    bench.fails("export out --out spill/mine.ply", &["it would lie in a store", "name a place outside"]);
    // In the frame of the run's cameras.
    let local = bench.ckpt("export out --out local.ply --export-frame local");
    assert!(local.contains("positions are local: local.transform.json leads back"), "{local}");
    assert!(split_ply(&bench.bytes("local.ply")).0.contains("comment frame local"));
}

#[test]
fn what_stopped_attempts_leave_is_in_nobodys_way() {
    let bench = Bench::empty();
    write_gaussians(&bench.path("in.ply"), &wave(60_000), &SceneMeta::default()).unwrap();
    // Small pages that are compressed hard take minutes.
    let slow = "import in.ply --out store --page-rows 16 --spill-codec zstd:19";
    let begin = |flags: &str| Running::spawn(&bench, &mut bench.command(CKPT, flags));
    let written = || bench.path("store.part/FORMAT").exists();
    let said = begin(slow).once(written).signal("TERM").ends(143);
    assert!(said.contains("was stopped") && !bench.exists("store.part") && !bench.exists("store"), "{said}");
    assert!(begin(slow).once(written).kill());
    assert!(bench.exists("store.part"), "it left nothing, so the test shows nothing");
    let quick = "import in.ply --out store --page-rows 1024";
    for least in ["--page-rows 100", "--page-rows 512", "--page-rows 777"] {
        let refused = bench.fails(&format!("import in.ply --out other {least} --host-mem 2MiB"), &[]);
        bench.ckpt(&format!("import in.ply --out other {least} --host-mem {}MiB", least_memory(&refused)));
        bench.remove("other");
    }
    bench.ckpt(quick);
    assert!(!bench.exists("store.part"));
    // A store under such a name may be anybody's.
    bench.ckpt("clone store other.part");
    bench.fails("clone store other", &["other.part", "an earlier attempt left", "remove it, or name another folder"]);
    assert!(bench.is_intact("other.part"));
}

#[cfg(target_os = "linux")]
#[test]
fn a_drive_that_is_too_small_for_a_new_store_is_named() {
    let bench = Bench::empty();
    write_gaussians(&bench.path("in.ply"), &wave(20_000), &SceneMeta::default()).unwrap();
    bench.ckpt("import in.ply --out store");
    let Some(_drive) = Small::mount(&bench.path("drive"), 1 << 20) else { return };
    for room in [1u64 << 20, 6 << 20] {
        _drive.resize(room);
        for flags in ["import in.ply --out drive/new", "clone store drive/new", "salvage store --out drive/new"] {
            bench.fails(flags, &["drive/new", "there is no space", "name a folder on another drive"]);
            assert!(!bench.exists("drive/new.part"), "{flags}");
        }
    }
}

#[test]
fn positions_that_floats_move_are_told() {
    let bench = Bench::empty();
    let gaussians = wave(500);
    let write = |name: &str, kind: &str, offset: f64| {
        let names = [
            "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
            "rot_3",
        ];
        let of = |name: &str| format!("property float {name}\n");
        let place: String = ["x", "y", "z"].map(|axis| format!("property {kind} {axis}\n")).concat();
        let rest: String = names.map(of).concat();
        let mut ply = format!("ply\nformat ascii 1.0\nelement vertex 500\n{place}{rest}end_header\n");
        for row in 0..500 {
            let mean = gaussians.row(Column::Means, row);
            let at = |axis: usize| f64::from(mean[axis]) + offset;
            ply += &format!("{} {} {} 1 1 1 2 -3 -3 -4 1 0 0 0\n", at(0), at(1), at(2));
        }
        bench.write(name, ply);
    };
    // At 4.6 million, floats are half a unit apart; sigma is .05.
    let said = |name: &str| stderr(&bench.succeeds(CKPT, &format!("import {name} --out {name}.store")));
    write("utm.ply", "double", 4_567_890.0);
    let utm = said("utm.ply");
    assert!(utm.contains("Gaussians moved by more than a tenth of their size"), "{utm}");
    write("near.ply", "double", 40.0);
    write("floats.ply", "float", 4_567_890.0);
    assert_eq!([said("near.ply"), said("floats.ply")], ["", ""]);
}

#[test]
fn a_run_and_an_export_write_the_same_files_in_memory_or_spilled_or_resumed() {
    let bench = Bench::new();
    bench.alone("--export spz,sog");
    bench.stopped("--export spz,sog");
    let [spz, transform] = ["point_cloud.spz", "point_cloud.spz.transform.json"];
    let files = |folder: &str, sog: &str| {
        let of_spz = [spz, transform].map(|name| bench.bytes(&format!("{folder}/{name}")));
        (of_spz, bench.files(&format!("{folder}/{sog}")))
    };
    let (ply, early) = (bench.ply("out").len(), files("out", "point_cloud_sog"));
    assert!(early.0[0].len() < ply / 4, "{} of {ply} bytes", early.0[0].len());
    let export = bench.summary("out")["more_exports"][0].clone();
    assert_eq!(export["file"], "point_cloud_sog/lod-meta.json");
    let finest = export["levels"][0].as_u64().unwrap();
    assert_eq!(finest + number(&export, "always_shown"), number(&export, "gaussians"), "{export}");
    let report = bench.text("out/report.html");
    assert!(report.contains("For viewers") && report.contains("point_cloud_sog/lod-meta.json: "));
    bench.ckpt(&format!("export out --out {spz}"));
    let said = bench.ckpt("export out --out sog/lod-meta.json");
    assert!(said.contains("levels of "), "{said}");
    assert!(files(".", "sog") == early, "the exports are not what the trainer wrote");
    assert_eq!(bench.json(transform)["up_in_file"], serde_json::json!([0.0, 1.0, 0.0]));
    bench.fails("export out --out a.splat", &["use .ply, .spz, or lod-meta.json in a folder of its own"]);
    bench.fails("export out --out lod-meta.json", &["city/lod-meta.json"]);
    // The writer's memory counts.
    bench.fails("export out --out sog/lod-meta.json --host-mem 25MiB", &["give at least"]);
    assert!(!bench.exists("a.splat"));
    // A PLY beside the folder has a transform of its own.
    bench.ckpt("export out --out sog.ply");
    assert_eq!(bench.json("sog/transform.json")["file"], "lod-meta.json");
    assert_eq!(bench.json("sog.transform.json")["file"], "sog.ply");
    // What could not be replaced at the end is refused before the first step: a folder where the file is to be written, and a folder that holds
    // a file of others.
    let block = |name: &str| {
        let path = bench.path("out").join(name);
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
    };
    let foreign = || bench.write("out/point_cloud_sog/mine.txt", "");
    let remove_foreign = || std::fs::remove_file(bench.path("out/point_cloud_sog/mine.txt")).unwrap();
    let before = bench.bytes("out/metrics.jsonl");
    block(spz);
    bench.refuses("--resume out --quiet", &["is a folder where a file"]);
    bench.remove(&format!("out/{spz}"));
    foreign();
    bench.refuses("--resume out --quiet", &["mine.txt"]);
    assert!(bench.bytes("out/metrics.jsonl") == before, "it trained before it refused");
    remove_foreign();
    // The export fails at the end, at its transform: the run still has its evaluation and its report, and can be resumed.
    block(transform);
    bench.refuses("--resume out --quiet", &[spz]);
    let done = bench.summary("out");
    assert!(done["finished"] == false && done["test"]["psnr"].is_number() && bench.exists("out/report.html"), "{done}");
    bench.remove(&format!("out/{transform}"));
    bench.go_on("");
    let late = files("out", "point_cloud_sog");
    assert!(late == files("alone", "point_cloud_sog") && late != early, "the resumed run ended with other files");
    // A new run in the folder removes them, and nothing of others.
    let again = "scene --out out --overwrite --steps 1 --quiet --device cpu";
    foreign();
    let said = stderr(&bench.output(TRAIN, again));
    assert!(said.contains("mine.txt"), "{said}");
    remove_foreign();
    bench.train(again);
    assert!(!bench.exists("out/point_cloud_sog") && !bench.exists(&format!("out/{spz}")));
}

#[test]
fn a_run_that_was_rolled_back_or_cloned_ends_with_the_same_bytes() {
    let bench = Bench::new();
    let want = bench.alone("");
    bench.stopped("");
    let listed = bench.ckpt_json("ls out");
    let [a, b] = generations(&listed)[..] else { panic!("{listed}") };
    bench.fails(&format!("rollback out {a}"), &["--yes"]);
    assert_eq!(bench.generations("out"), [a, b], "nothing may be done without --yes");
    bench.ckpt("clone out copy");
    assert_eq!(bench.ckpt_json(&format!("rollback out {a} --yes"))["dropped"][0].as_u64(), Some(b));
    let now = bench.ckpt_json("ls out");
    assert_eq!((generations(&now), &now["generations"][0]["step"]), (vec![a], &listed["generations"][0]["step"]));
    assert!(bench.ckpt(&format!("rollback out {a}")).contains("already the latest"));
    assert!(bench.is_intact("out"));

    // The copy has both generations with their numbers, in its own slots.
    let of = |listed: &Value| -> Vec<String> {
        let keys = ["generation", "step", "gaussians", "pages", "bytes", "bytes_alone", "names"];
        let lines = listed["generations"].as_array().unwrap().iter();
        lines.map(|line| keys.map(|key| line[key].to_string()).join(" ")).collect()
    };
    assert_eq!(of(&bench.ckpt_json("ls copy")), of(&listed));
    assert!(bench.is_intact("copy"));
    assert_ne!(bench.ckpt_json("inspect copy")["identity"], bench.ckpt_json("inspect out")["identity"]);
    bench.fails("clone out copy", &["exists already"]);
    bench.fails("clone out copy/sub", &["would lie in a store"]);

    // The run then uses its copy, and does not return to a store that lacks the newer steps.
    bench.go_on_until_stopped("--spill-dir copy");
    let config = bench.text("out/config.toml");
    assert!(config.contains("spill-dir = \"") && config.contains("copy\"\n"), "{config}");
    let step = bench.count("out", "steps");
    assert!(step > number(&listed["generations"][1], "step"));
    assert_eq!(number(&bench.ckpt_json("ls out")["generations"][1], "step"), step);
    bench.go_on("");
    assert!(bench.ply("out") == want, "the run went on with the copy and ended otherwise");
    assert!(!bench.exists("copy/map.redb") && bench.exists("spill/map.redb"));
    // The output files are those of the end; the store's older generation is still the latest there.
    std::fs::remove_file(bench.path("out/summary.json")).unwrap();
    bench.go_on("--spill-dir spill");
    assert!(bench.ply("out") == want, "the run went back and ended otherwise");
}

#[test]
fn names_keep_generations_until_they_are_pruned() {
    let bench = Bench::new();
    bench.stopped("");
    let first = bench.generations("out")[0];
    pin(&bench.spill(), &[("early", first), ("also-early", first)]);
    bench.go_on_until_stopped("");
    let listed = bench.ckpt_json("ls out");
    let (kept, names) = (generations(&listed), r#"["also-early","early"]"#);
    assert_eq!((kept.len(), kept[0]), (3, first), "{listed}");
    assert_eq!(listed["generations"][0]["names"].to_string(), names);
    bench.ckpt("clone out copy");
    assert_eq!(bench.ckpt_json("ls copy")["generations"][0]["names"].to_string(), names);
    assert!(bench.export("copy", "--generation early") == bench.export("out", "--generation early"));
    assert!(!changed_pages(&bench.spill(), first, kept[2]).is_empty());

    bench.fails("prune out nosuch", &["'nosuch'", "also-early"]);
    let told = bench.ckpt_json("prune out --keep 0 --dry-run");
    assert_eq!((&told["is_done"], told["dropped_names"].as_array().unwrap().len()), (&Value::from(false), 2));
    assert_eq!(bench.generations("out").len(), 3);
    let one = bench.ckpt_json("prune out early");
    assert!(one["dropped"].as_array().unwrap().is_empty() && one["bytes_freed"] == 0, "another name keeps it: {one}");
    assert!(bench.ckpt_json("prune out --keep 1")["dropped_names"].as_array().unwrap().is_empty());
    let done = bench.ckpt_json("prune out --keep 0");
    let alone = number(&listed["generations"][0], "bytes_alone");
    assert_eq!((done["dropped"][0].as_u64(), number(&done, "bytes_freed")), (Some(first), alone));
    assert!(alone > 0);
    assert_eq!(bench.generations("out"), kept[1..]);
    assert!(bench.is_intact("out"));
}

#[test]
fn a_store_in_use_is_never_written_and_readers_report_the_use() {
    let bench = Bench::new();
    let run = bench.running("--steps 20000 --commit-every 0.02");
    let process = format!("process {}", run.child.id());
    let busy = bench.ckpt_json("ls out");
    assert!(busy["used_by"].as_str().unwrap().contains(&process), "{busy}");
    assert!(bench.ckpt("ls out").contains("in use"));
    assert!(bench.ckpt("inspect out").contains("that of the last commit"));
    for command in
        ["verify out", "export out --out x.ply", "clone out copy", "salvage out --out copy", "prune out --keep 0"]
    {
        bench.fails(command, &[&process, "remedy"]);
    }
    bench.fails(&format!("rollback out {} --yes", generations(&busy)[0]), &[&process, "remedy"]);
    assert!(!bench.exists("x.ply") && !bench.exists("copy"));
    assert!(run.kill());
    assert!(bench.ckpt_json("ls out")["used_by"].is_null(), "the lock goes with its process");
    assert!(bench.is_intact("out"));
}

/// A resumed run no longer needs its starting Gaussians.
#[test]
fn a_store_that_a_run_was_started_from_is_free_once_the_run_goes_on() {
    let bench = Bench::new();
    bench.stopped("");
    bench.ckpt("clone out seed");
    let first = bench.generations("seed")[0];
    ["out", "spill"].iter().for_each(|folder| bench.remove(folder));
    // The import gets a part of the budget; messages name the given budget and a sufficient one. Detecting a GPU loads its driver,
    // which may take more than the rest of this budget.
    let flags = "scene --device cpu --init-ply seed --out none --steps 1 --host-mem";
    let said = bench.refuses(&format!("{flags} 48MiB"), &["48.0 MiB is not enough for this store"]);
    bench.train(&format!("{flags} {:.1}MiB", least_memory(&said) + 0.1));
    bench.stopped("--init-ply seed");
    let mut run = bench.going_on("");
    let dropped = bench.ckpt_json(&format!("rollback seed {first} --yes"));
    assert!(run.child.try_wait().unwrap().is_none() && dropped["dropped"].as_array().unwrap().len() == 1);
    run.signal("TERM").ends(143);
}

/// Flips a bit, so many bytes after the beginning of the slot of a page. Returns the slot's file and offset.
fn flip_in_page(bench: &Bench, page: &str, at: u64) -> (String, u64) {
    let page = bench.ckpt_json(&format!("inspect out --page {page}"));
    let (file, offset) = (page["file"].as_str().unwrap().to_string(), number(&page, "offset"));
    flip(&bench.spill().join(&file), offset + at);
    (file, offset)
}

fn flip(file: &Path, at: u64) {
    let file = std::fs::OpenOptions::new().read(true).write(true).open(file).unwrap();
    let mut byte = [0];
    file.read_exact_at(&mut byte, at).unwrap();
    file.write_all_at(&[byte[0] ^ 0x10], at).unwrap();
}

const IN_PAYLOAD: u64 = 4096 + 77;

#[test]
fn flipped_bits_in_pages_are_named_and_older_versions_take_their_place() {
    let bench = Bench::new();
    bench.stopped("");
    let listed = bench.ckpt_json("ls out");
    let [a, b] = generations(&listed)[..] else { panic!("{listed}") };
    let names = changed_pages(&bench.spill(), a, b);
    flip_in_page(&bench, &names[0], IN_PAYLOAD);
    assert!(bench.ckpt_json("verify out")["faults"].as_array().unwrap().is_empty(), "headers do not know");
    let (file, offset) = flip_in_page(&bench, &names[1], 20);
    let output = bench.output(CKPT, "verify out --deep --json");
    assert_eq!(output.status.code(), Some(1));
    let verdict: Value = serde_json::from_slice(&output.stdout).unwrap();
    let fault = |fault: &Value| ["generation", "page", "kind"].map(|key| fault[key].to_string().replace('"', ""));
    let mut faults: Vec<[String; 3]> = verdict["faults"].as_array().unwrap().iter().map(fault).collect();
    let mut want =
        [(&names[0], "payload"), (&names[1], "header")].map(|(page, kind)| [b.to_string(), page.clone(), kind.into()]);
    faults.sort();
    want.sort();
    assert_eq!(faults, want);
    let words = String::from_utf8(bench.output(CKPT, "verify out --deep").stdout).unwrap();
    assert!(words.contains("2 faults") && words.contains(&format!("{file} offset {offset}")), "{words}");
    // Commands that need the pages name a damaged one; no partial copy is left.
    bench.fails("clone out copy", &["page ", "remedy"]);
    assert!(!bench.exists("copy") && !bench.exists("copy.part"));
    bench.fails("export out --out x.ply", &["is damaged"]);
    assert!(!bench.exists("x.ply"));

    let before = bench.store_files();
    let done = bench.ckpt_json("salvage out --out rescued");
    assert!(bench.store_files() == before, "salvage wrote to the damaged store");
    assert!(done["has_state"] == true && done["pages"] == listed["generations"][1]["pages"], "{done}");
    let lost = done["lost"].as_array().unwrap();
    assert_eq!(lost.len(), 2);
    assert!(lost.iter().all(|page| page["taken"].as_u64().is_some_and(|taken| taken <= a)), "{done}");
    assert!(bench.is_intact("rescued"));
    bench.export("rescued", "");
    // A rollback avoids the damage as well, and the run resumes from either.
    bench.ckpt(&format!("rollback out {a} --yes"));
    assert!(bench.is_intact("out"));
    bench.go_on("--spill-dir rescued");
}

/// Older versions have other statistics than the run has counted, and pending rounds that newer versions have applied: with rounds
/// between the generations that grow much, and with statistics that no round cleared.
#[test]
fn a_run_resumes_from_many_older_pages() {
    for rounds in [
        "--refine-every 10 --grow-grad2d 0.0001 --refine-stop 120",
        "--refine-every 150 --grow-grad2d 0.001 --refine-stop 200",
    ] {
        let bench = Bench::new();
        bench.stopped(&format!("{rounds} --steps 240"));
        let [a, b] = bench.generations("out")[..] else { panic!("two generations") };
        let names = changed_pages(&bench.spill(), a, b);
        for name in &names {
            flip_in_page(&bench, name, IN_PAYLOAD);
        }
        let done = bench.ckpt_json("salvage out --out rescued");
        let taken = done["lost"].as_array().unwrap().iter().filter(|page| !page["taken"].is_null()).count();
        assert!(taken > 10 && taken == names.len(), "{taken} older pages: {done}");
        assert!(bench.is_intact("rescued"));
        bench.export("rescued", "");
        bench.go_on("--spill-dir rescued");
    }
}

#[test]
fn a_lost_map_is_rebuilt_from_the_slots() {
    let bench = Bench::new();
    // Without events.
    bench.stopped("--strategy none --sh-every 0");
    let last = bench.ckpt_json("ls out")["generations"][1].clone();
    let want = bench.ply("out");
    std::fs::remove_file(bench.path("spill/map.redb")).unwrap();
    bench.fails("ls out", &["no page map", "salvage"]);
    let output = bench.output(CKPT, "verify out");
    assert_eq!(output.status.code(), Some(1));
    let verdict = String::from_utf8_lossy(&output.stdout);
    assert!(verdict.contains("FAULT map") && verdict.contains("salvage") && !verdict.contains("rollback"), "{verdict}");
    let done = bench.ckpt_json("salvage out --out rescued");
    assert!(["step", "pages", "gaussians"].iter().all(|key| done[key] == last[key]), "{done}, {last}");
    assert!(done["has_state"] == false && done["lost"].as_array().unwrap().is_empty(), "{done}");
    assert!(done["notes"].to_string().contains("state is lost"), "{done}");
    // Without pending events, no part of the scene is in the map alone.
    assert!(bench.export("rescued", "") == want, "the rescued scene is another");

    // Without FORMAT and without the run's config: local coordinates, the same Gaussians.
    std::fs::remove_file(bench.path("spill/FORMAT")).unwrap();
    let done = bench.ckpt_json("salvage spill --out bare");
    assert_eq!(done["gaussians"], last["gaussians"]);
    assert!(done["notes"].to_string().contains("config is not known"), "{done}");
    // A damaged page is reported, and its older version is used or its rows are missing.
    let first = number(&bench.ckpt_json("inspect rescued"), "pages");
    flip(&bench.path("spill/seg-00000000.dat"), 4096 + 100);
    let done = bench.ckpt_json("salvage spill --out third --config out/config.toml");
    let lost = done["lost"].as_array().unwrap().len() as u64;
    assert!(lost <= 1 && number(&done, "pages") + lost >= first, "{done}");
    segments(&bench).iter().for_each(|segment| std::fs::write(segment, b"").unwrap());
    bench.fails("salvage spill --out fourth", &["no slot header"]);
    assert!(!bench.exists("fourth"));
}

/// The files of slots, sorted.
fn segments(bench: &Bench) -> Vec<PathBuf> {
    bench.store_files().into_keys().filter(|path| path.extension().is_some_and(|e| e == "dat")).collect()
}

/// The histogram in the run state is lost with the map; the statistics in the pages remain. Growth uses both.
#[test]
fn growth_goes_on_after_a_salvage_without_a_map() {
    let bench = Bench::new();
    // The rounds come after the stop; the cap allows half of the uncapped growth.
    let more = "--refine-every 150 --refine-stop 400 --grow-grad2d 0.0001 --max-gaussians 4000";
    bench.alone(more);
    bench.stopped(more);
    std::fs::remove_file(bench.path("spill/map.redb")).unwrap();
    let done = bench.ckpt_json("salvage out --out rescued");
    assert!(number(&done, "step") < 150 && done["lost"].as_array().unwrap().is_empty(), "{done}");
    let said = bench.train("--resume out --spill-dir rescued --accept-changes --quiet --device cpu");
    // The statistics in the pages and in the run state agree: nothing was recounted.
    assert!(!said.contains("counted anew"), "{said}");
    let (first, grown, want) =
        (number(&done, "gaussians"), bench.count("out", "gaussians"), bench.count("alone", "gaussians"));
    println!("{first} Gaussians grew to {grown}; without the damage to {want}");
    // A few pending opacity resets are lost together with the statistics of their pages: 3 % of the growth.
    let off = grown.abs_diff(want) as f64 / (want - first) as f64;
    assert!(want > first + 500 && off < 0.03, "{first} grew to {grown}; without the damage to {want}");
}

#[test]
fn split_pages_are_not_rescued_twice() {
    let bench = Bench::new();
    bench.stopped("");
    let last = bench.ckpt_json("ls out")["generations"][1].clone();
    bench.write("spill/map.redb", vec![7; 100_000]);
    let done = bench.ckpt_json("salvage out --out rescued");
    // Slots of emptied pages look like slots of existing pages.
    for (key, more) in [("pages", 2), ("gaussians", 64)] {
        let (got, want) = (number(&done, key), number(&last, key));
        assert!((want..=want + more).contains(&got), "{got} {key} instead of {want}: {done}");
    }
    assert!(bench.is_intact("rescued"));
}

#[test]
fn a_lost_witness_costs_nothing() {
    let bench = Bench::new();
    let want = bench.alone("");
    bench.stopped("");
    bench.write("spill/witness", "gone");
    bench.fails("ls out", &["witness"]);
    let done = bench.ckpt_json("salvage out --out rescued");
    assert!(done["has_state"] == true && done["lost"].as_array().unwrap().is_empty(), "{done}");
    bench.go_on("--spill-dir rescued");
    assert!(bench.ply("out") == want, "the run ended otherwise");
}

#[test]
fn segments_that_are_cut_short_or_gone_are_named() {
    let bench = Bench::new();
    bench.stopped("");
    let segment = segments(&bench).remove(0);
    let first = std::fs::OpenOptions::new().write(true).open(&segment).unwrap();
    let bytes = first.metadata().unwrap().len();
    first.set_len(bytes / 2 + 4096 + 512).unwrap();
    let faults = || -> Vec<Value> {
        let output = bench.output(CKPT, "verify out --json");
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()["faults"].as_array().unwrap().clone()
    };
    let found = faults();
    assert!(found[0]["kind"] == "segment" && found[0]["what"].to_string().contains(&bytes.to_string()), "{found:?}");
    assert!(found[1]["kind"] == "header" && found[1]["what"].to_string().contains("ends inside"), "{found:?}");
    std::fs::remove_file(&segment).unwrap();
    let found = faults();
    assert!(found[0]["what"] == "it is missing" && found.len() > 20, "{found:?}");
    assert!(found[1]["what"].to_string().contains("seg-00000000.dat is missing"), "{found:?}");
}

#[test]
fn other_folders_and_other_versions_are_refused_by_name() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("photos")).unwrap();
    bench.write("photos/a.jpg", "mine");
    for command in [
        "ls DIR",
        "verify DIR",
        "inspect DIR",
        "rollback DIR 1 --yes",
        "prune DIR --keep 0",
        "export DIR --out to",
        "salvage DIR --out to",
    ] {
        bench.fails(&command.replace("DIR", "photos"), &["neither a store nor a run's output folder", "remedy"]);
        bench.fails(&command.replace("DIR", "no/such/folder"), &["no such folder"]);
    }
    assert!(bench.files("photos").len() == 1 && !bench.exists("to"));

    bench.stopped("");
    let good = bench.bytes("spill/FORMAT");
    let with = |at: usize, value: u8| {
        let mut bytes = good.clone();
        bytes[at] = value;
        let sum = checksum(&bytes[..240]).to_le_bytes();
        bytes[240..].copy_from_slice(&sum);
        bench.write("spill/FORMAT", bytes);
    };
    let refused = |words: &[&str]| {
        for command in ["ls out", "verify out", "rollback out 1 --yes"] {
            bench.fails(command, &[words, &["remedy"]].concat());
        }
        bench.refuses("--resume out --quiet", words);
    };
    with(8, 2);
    refused(&["format version 2", "newer", "knows version 1"]);
    with(13, 0x40);
    refused(&["features that this program does not know", "0x4000"]);
    // A compatible feature bit is accepted and shown.
    with(49, 0x01);
    assert_eq!(bench.ckpt_json("inspect out")["features_compatible"], 256);
    bench.write("spill/FORMAT", &good[..200]);
    refused(&["damaged or cut short"]);
    bench.write("spill/FORMAT", &good);
    bench.go_on("");
}

/// Gaussians on a wavy plane; all columns differ.
fn wave(rows: usize) -> Columns {
    let mut columns = Columns::zeros(rows, 3);
    for row in 0..rows {
        let (x, y) = ((row % 811) as f32 * 0.37, (row / 811) as f32 * 0.41);
        columns.means[row * 3..row * 3 + 3].copy_from_slice(&[x, y, (x * 0.1).sin() + (y * 0.07).cos()]);
    }
    for (at, column) in Column::ALL.into_iter().enumerate().skip(1) {
        let values = columns.column_mut(column).iter_mut().enumerate();
        values.for_each(|(i, v)| *v = ((i * (at + 3)) % 1009) as f32 * 0.003 - 1.5);
    }
    columns
}

#[test]
fn gaussians_that_do_not_fit_are_refused_by_the_header_or_go_into_pages() {
    let bench = Bench::empty();
    // Each view sees at most one of ten parts.
    let mut gaussians = wave(150_000);
    gaussians.means.chunks_exact_mut(3).enumerate().for_each(|(row, mean)| mean[1] += 2000.0 * (row / 15_000) as f32);
    write_gaussians(&bench.path("in.ply"), &gaussians, &SceneMeta::default()).unwrap();
    scenes::city(&bench.path(""), 8, 32, 24, 200);
    let flags = "scene --init-ply in.ply --threads 2 --steps 20 --page-rows 128 --strategy none --view-order shuffle --device cpu";
    let words = ["in.ply", "150000 Gaussians take", "--spill-dir"];
    bench.refuses(&format!("{flags} --out out --host-mem 30MiB"), &words);
    // The values alone take 35 MB, 109 MB with moments; paged training equals training in memory.
    bench.train(&format!("{flags} --out alone"));
    bench.train(&format!("{flags} --out out --spill-dir spill --host-mem 64MiB"));
    let [paged, alone] = ["out", "alone"].map(|out| bench.count(out, "host_bytes_peak"));
    assert!(paged <= 64 << 20 && alone > 128 << 20, "{paged} and {alone} bytes");
    assert!(bench.ply("out") == bench.ply("alone"), "another scene than in memory");
}

#[test]
fn gaussians_round_trip_through_a_store_within_the_budget() {
    let rows = std::env::var("GSSCALE_CKPT_GAUSSIANS").ok().map_or(40_000, |n| n.parse().unwrap());
    let bench = Bench::empty();
    write_gaussians(&bench.path("in.ply"), &wave(rows), &SceneMeta::default()).unwrap();
    // The rows alone take 29 MB at 40,000 rows, and exceed the budget from 150,000 rows on.
    let (budget, bytes) = ("--host-mem 112MiB", 112u64 << 20);
    let done = bench.ckpt_json(&format!("import in.ply --out store {budget}"));
    assert_eq!((number(&done, "gaussians"), number(&done, "sh_degree")), (rows as u64, 3));
    assert!(number(&done, "host_bytes_peak") <= bytes, "{done}");
    assert!(bench.is_intact("store"));
    let listed = bench.ckpt_json("ls store");
    assert_eq!((number(&listed["generations"][0], "step"), generations(&listed).len()), (0, 1));
    let done = bench.ckpt_json(&format!("export store --out out.ply {budget}"));
    assert!(number(&done, "host_bytes_peak") <= bytes, "{done}");
    if rows <= 1_000_000 {
        let sorted = |name: &str| {
            let mut rows = Ply::of(&bench.bytes(name)).rows;
            rows.sort_by(|a, b| a.partial_cmp(b).unwrap());
            rows
        };
        assert!(sorted("out.ply") == sorted("in.ply"), "a value changed on its way");
    }
    // Pages are local in space: a small box reads few of them.
    let part = bench.ckpt_json("export store --out out.ply --crop 0,0,-9,12,12,9");
    assert!(number(&part, "bytes_read") * 4 < number(&done, "bytes_read"), "{part}");

    bench.fails("import in.ply --out store", &["exists already"]);
    bench.fails("import in.ply --out other --host-mem 20MiB", &["is not enough", "give at least"]);
    let bytes = bench.bytes("in.ply");
    bench.write("cut.ply", &bytes[..bytes.len() / 2]);
    bench.fails("import cut.ply --out other", &["cut.ply"]);
    assert!(!bench.exists("other") && !bench.exists("other.part"));
}

#[test]
fn a_run_starts_from_a_store_as_from_the_file_that_it_was_made_of() {
    let bench = Bench::new();
    bench.stopped("--export-frame local");
    bench.ckpt("import out/point_cloud.ply --out store --page-rows 32");
    let from = |init: &str, out: &str| {
        let rounds = "--steps 12 --page-rows 32 --refine-start 4 --refine-every 4 --grow-grad2d 0.001";
        bench.run(out, &format!("--init-ply {init} {rounds}"))
    };
    let want = from("out/point_cloud.ply", "from-file");
    assert!(from("store", "from-store") == want, "the store is another start than its file");
    // A run's checkpoint also serves as a start; its pages differ from the file's, and so do the roundings.
    let rows = Ply::of(&bench.ply("out")).rows.len() as u64;
    from("out", "from-run");
    assert!(bench.count("from-run", "gaussians").abs_diff(rows) < rows / 5);
}

#[test]
fn every_subcommand_has_help_with_examples() {
    let bench = Bench::empty();
    let help = bench.ckpt("--help");
    for name in ["ls", "inspect", "verify", "rollback", "prune", "export", "import", "clone", "salvage"] {
        assert!(help.contains(&format!("\n  {name} ")), "{help}");
        let of = bench.ckpt(&format!("{name} --help"));
        assert!(of.contains("Examples:") && of.contains("--json"), "{of}");
    }
}
