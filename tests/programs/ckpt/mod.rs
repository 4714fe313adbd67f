//! `gsscale-ckpt` through the real binary, on intact and damaged stores of stopped runs.
//!
//! `GSSCALE_CKPT_GAUSSIANS=5000000` sets the number of Gaussians to import and export within the budget (default
//! 40,000). `GSSCALE_WRITE_FIXTURE=1` rewrites the fixture store of the present format version.

mod bench;
mod fixture;

use crate::support::scenes::{self, stderr, summary, text, train};
use bench::{Bench, EVENTLESS, Ply, changed_pages, ckpt, failed, json, pin, train_from};
use gsscale::exchange::meta::SceneMeta;
use gsscale::exchange::ply::write_gaussians;
use gsscale::page::format::slot_header::checksum;
use gsscale::scene::columns::{Column, Columns};
use serde_json::Value;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

fn generations(listed: &Value) -> Vec<u64> {
    listed["generations"].as_array().unwrap().iter().map(|g| g["generation"].as_u64().unwrap()).collect()
}

#[test]
fn inspecting_a_store_reports_what_the_run_left_and_changes_nothing() {
    let bench = Bench::new();
    let out = bench.stopped(&[]);
    let before = bench.store_files();
    // The output folder and the spill directory name the same store.
    let listed = json(&["ls", text(&out)]);
    let there = json(&["ls", text(&bench.spill())]);
    assert_eq!(generations(&listed), generations(&there));
    let [a, b] = generations(&listed)[..] else { panic!("{listed}") };
    let last = &listed["generations"][1];
    assert_eq!(last["step"], summary(&out)["steps"]);
    assert_eq!(last["is_latest"], true);
    assert!(last["psnr"].as_f64().unwrap() > 5.0, "an evaluation was logged before: {last}");
    assert_eq!(there["generations"][1]["psnr"], last["psnr"], "the store itself knows");
    for generation in listed["generations"].as_array().unwrap() {
        let number = |key: &str| generation[key].as_u64().unwrap();
        assert!(number("pages") > 10 && number("bytes_alone") <= number("bytes") && number("gaussians") > 1000);
    }
    let words = ckpt(&["ls", text(&out)]);
    assert!(words.contains("PSNR") && words.contains("(last)"), "{words}");

    let changed = changed_pages(&bench.spill(), a, b);
    let whole = json(&["inspect", text(&out)]);
    assert_eq!((whole["format_version"].as_u64(), whole["generation"].as_u64()), (Some(1), Some(b)));
    assert_eq!((&whole["pages"], &whole["segment_bytes"]), (&last["pages"], &listed["segment_bytes"]));
    let state = whole["state"].to_string();
    assert!(state.contains(&format!("step {} of", last["step"])) && state.contains("rounds"), "{state}");
    let name = changed[0].as_str();
    let page = json(&["inspect", text(&out), "--page", name]);
    assert_eq!(page["since"].as_u64(), Some(b));
    assert!(page["fault"].is_null() && page["rows"].as_u64().unwrap() > 0);
    assert!(page["stamp"]["most"].as_f64().unwrap() <= last["step"].as_f64().unwrap());
    assert!(ckpt(&["inspect", text(&out), "--page", name]).contains(&format!("page        {name}")));

    for deep in [&[][..], &["--deep"]] {
        let verdict = json(&[&["verify", text(&out)], deep].concat());
        assert!(
            verdict["faults"].as_array().unwrap().is_empty() && verdict["versions"].as_u64() >= last["pages"].as_u64()
        );
    }
    bench.export(&out, &[]);
    bench.copy("clone", &out);
    assert!(bench.store_files() == before, "a command that only looks changed the store");

    let said = failed(&["inspect", text(&out), "--page", "99999"]);
    assert!(said.contains("no page 99999") && said.contains("remedy"), "{said}");
    let said = failed(&["inspect", text(&out), "--generation", "nosuch"]);
    assert!(said.contains("'nosuch' is not kept") && said.contains(&b.to_string()), "{said}");
}

#[test]
fn an_export_is_the_trainers_file_byte_for_byte_and_can_be_a_part_of_it() {
    let bench = Bench::new();
    let out = bench.stopped(&["--up", "keep"]);
    let want = std::fs::read(out.join("point_cloud.ply")).unwrap();
    let file = bench.export(&out, &[]);
    assert!(std::fs::read(&file).unwrap() == want, "the export is not what the trainer wrote");
    // The minimum budget, from the tool's own message.
    let said = failed(&["export", text(&out), "--out", text(&file), "--host-mem", "1MiB"]);
    let least = said.split("give at least ").nth(1).unwrap().trim().replace(' ', "");
    let file = bench
        .export(&out, &["--host-mem", &format!("{}MiB", least.trim_end_matches("MiB").parse::<f64>().unwrap() + 1.0)]);
    assert!(std::fs::read(&file).unwrap() == want, "the budget changed the file");

    // The box is in the coordinates of the dataset, which are those of this file.
    let all = Ply::read(&file);
    let middle = all.median();
    let crop = format!("{},{},{},{},1e9,1e9", middle[0], middle[1], -1e9, 1e9);
    let inside = |row: &[f32]| f64::from(row[0]) >= middle[0] && f64::from(row[1]) >= middle[1];
    let part = Ply::read(&bench.export(&out, &["--crop", &crop]));
    let expected: Vec<&Vec<f32>> = all.rows.iter().filter(|row| inside(row)).collect();
    assert!(expected.len() > 100 && expected.len() < all.rows.len());
    // The file's coordinates are rounded once more than the compared ones: a row on the border may differ.
    assert!(part.rows.len().abs_diff(expected.len()) <= 2, "{} of {}", part.rows.len(), expected.len());
    assert!(part.rows.iter().filter(|row| inside(row)).count() + 2 >= part.rows.len());

    let few = Ply::read(&bench.export(&out, &["--max-gaussians", "200"]));
    assert_eq!(few.rows.len(), 200);
    let mut visible: Vec<f64> = all.rows.iter().map(|row| all.visibility(row)).collect();
    visible.sort_by(f64::total_cmp);
    let least = visible[visible.len() - 200];
    assert!(few.rows.iter().all(|row| all.visibility(row) >= least * (1.0 - 1e-4)), "others are more visible");
    assert_eq!(Ply::read(&bench.export(&out, &["--max-gaussians", "99999999"])).rows.len(), all.rows.len());
    let flat = Ply::read(&bench.export(&out, &["--sh-degree", "0"]));
    assert_eq!((flat.names.len(), flat.rows.len()), (17, all.rows.len()));

    let said = failed(&["export", text(&out), "--out", text(&file), "--crop", "1e8,1e8,1e8,2e8,2e8,2e8"]);
    assert!(said.contains("no Gaussian lies in this box"), "{said}");
    assert!(failed(&["export", text(&out), "--out", text(&file), "--crop", "1,2,3"]).contains("is not a box"));
    let said = failed(&["export", text(&out), "--out", text(&bench.path("no/folder.ply"))]);
    assert!(said.contains("no/folder.ply"), "{said}");
}

#[test]
fn a_run_and_an_export_write_the_same_spz() {
    let bench = Bench::new();
    let out = bench.stopped(&["--export", "spz"]);
    let files = ["point_cloud.spz", "point_cloud.spz.transform.json"];
    let want = files.map(|name| std::fs::read(out.join(name)).unwrap());
    let ply = std::fs::metadata(out.join("point_cloud.ply")).unwrap().len();
    assert!((want[0].len() as u64) < ply / 4, "{} of {ply} bytes", want[0].len());
    let file = bench.path("point_cloud.spz");
    ckpt(&["export", text(&out), "--out", text(&file)]);
    let got = files.map(|name| std::fs::read(bench.path(name)).unwrap());
    assert!(got == want, "the export is not what the trainer wrote");
    let transform: Value = serde_json::from_slice(&want[1]).unwrap();
    assert_eq!(transform["up_in_file"], serde_json::json!([0.0, 1.0, 0.0]), "{transform}");
    let said = failed(&["export", text(&out), "--out", text(&bench.path("a.splat"))]);
    assert!(
        said.contains("use .ply, .spz, or lod-meta.json in a folder of its own") && !bench.path("a.splat").exists(),
        "{said}"
    );
    // A folder stands where the file is to be written: refused before the first step.
    std::fs::remove_file(out.join(files[0])).unwrap();
    std::fs::create_dir(out.join(files[0])).unwrap();
    let refused = train(&["--resume", text(&out), "--quiet"]);
    let said = stderr(&refused);
    assert!(refused.status.code() == Some(1) && said.contains("is a folder where a file"), "{said}");
    assert!(summary(&out)["test"].is_null(), "no step was trained");
    std::fs::remove_dir(out.join(files[0])).unwrap();
    // The export fails at the end, at its transform: the run still has its evaluation and its report, and can be resumed.
    std::fs::remove_file(out.join(files[1])).unwrap();
    std::fs::create_dir(out.join(files[1])).unwrap();
    let failed_export = train(&["--resume", text(&out), "--quiet"]);
    let said = stderr(&failed_export);
    assert!(failed_export.status.code() == Some(1) && said.contains("point_cloud.spz"), "{said}");
    let done = summary(&out);
    assert!(
        done["finished"] == false && done["test"]["psnr"].is_number() && out.join("report.html").exists(),
        "{done}"
    );
    std::fs::remove_dir(out.join(files[1])).unwrap();
    // A new start in the folder removes the files of the run before.
    bench.go_on(&[]);
    assert_eq!(summary(&out)["finished"], true);
    assert!(std::fs::read(out.join(files[0])).unwrap() != want[0], "the end of the run wrote its own");
}

/// Every file of a folder of SOGs.
fn sog_files(sog: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(sog).unwrap().map(|entry| entry.unwrap().path()) {
        match entry.is_dir() {
            true => found.extend(std::fs::read_dir(entry).unwrap().map(|entry| entry.unwrap().path())),
            false => found.push(entry),
        }
    }
    found.sort();
    let parent = sog.parent().unwrap();
    found.into_iter().map(|path| (path.strip_prefix(parent).unwrap().into(), std::fs::read(path).unwrap())).collect()
}

#[test]
fn a_run_and_an_export_write_the_same_sog_in_memory_or_spilled_or_resumed() {
    let bench = Bench::new();
    let sog = "point_cloud_sog";
    let want = sog_files(&bench.run_alone(&["--export", "sog"]).join(sog));
    let out = bench.stopped(&["--export", "sog"]);
    let early = sog_files(&out.join(sog));
    let export = summary(&out)["export"].clone();
    let finest = export["levels"][0].as_u64().unwrap();
    assert_eq!(export["file"], "point_cloud_sog/lod-meta.json");
    assert_eq!(Some(finest + export["always_shown"].as_u64().unwrap()), export["gaussians"].as_u64(), "{export}");
    let report = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(report.contains("For viewers") && report.contains("point_cloud_sog/lod-meta.json: "));
    let said = ckpt(&["export", text(&out), "--out", text(&bench.path(sog).join("lod-meta.json"))]);
    assert!(said.contains("levels of "), "{said}");
    assert!(sog_files(&bench.path(sog)) == early, "the export is not what the trainer wrote");
    let said = failed(&["export", text(&out), "--out", "lod-meta.json"]);
    assert!(said.contains("city/lod-meta.json"), "{said}");
    let said =
        failed(&["export", text(&out), "--out", text(&bench.path(sog).join("lod-meta.json")), "--host-mem", "25MiB"]);
    assert!(said.contains("give at least"), "the writer's memory counts: {said}");
    // A PLY beside the folder has a transform of its own.
    let beside = bench.path(sog).with_extension("ply");
    ckpt(&["export", text(&out), "--out", text(&beside)]);
    let file_of = |path: PathBuf| -> Value {
        serde_json::from_slice::<Value>(&std::fs::read(path).unwrap()).unwrap()["file"].clone()
    };
    assert_eq!(file_of(bench.path(sog).join("transform.json")), "lod-meta.json");
    assert_eq!(file_of(beside.with_extension("transform.json")), "point_cloud_sog.ply");
    // A folder that could not be replaced at the end is refused before the first step.
    let foreign = out.join(sog).join("mine.txt");
    std::fs::write(&foreign, b"").unwrap();
    let logged = || std::fs::read(out.join("metrics.jsonl")).unwrap();
    let before = logged();
    let refused = train(&["--resume", text(&out), "--quiet"]);
    assert!(refused.status.code() == Some(1) && stderr(&refused).contains("mine.txt"), "{}", stderr(&refused));
    assert!(logged() == before, "it trained before it refused");
    std::fs::remove_file(foreign).unwrap();
    bench.go_on(&[]);
    assert!(sog_files(&out.join(sog)) == want, "the resumed run ended with other files");
    // A new run in the folder removes them, and nothing of others.
    std::fs::write(out.join(sog).join("mine.txt"), b"").unwrap();
    let again =
        |flags: &[&str]| train(&[&[text(&bench.path("scene")), "--out", text(&out), "--overwrite"], flags].concat());
    let flags = ["--steps", "1", "--quiet", "--device", "cpu"];
    let said = stderr(&again(&flags));
    assert!(said.contains("mine.txt"), "{said}");
    std::fs::remove_file(out.join(sog).join("mine.txt")).unwrap();
    let output = again(&flags);
    assert!(output.status.success() && !out.join(sog).exists(), "{}", stderr(&output));
}

#[test]
fn a_run_that_was_rolled_back_or_cloned_ends_with_the_same_bytes() {
    let bench = Bench::new();
    let want = bench.alone();
    let out = bench.stopped(&[]);
    let listed = json(&["ls", text(&out)]);
    let [a, b] = generations(&listed)[..] else { panic!("{listed}") };
    let said = failed(&["rollback", text(&out), &a.to_string()]);
    assert!(said.contains("--yes"), "{said}");
    assert_eq!(generations(&json(&["ls", text(&out)])), [a, b], "nothing may be done without --yes");
    let copy = bench.copy("clone", &out);
    assert_eq!(json(&["rollback", text(&out), &a.to_string(), "--yes"])["dropped"][0].as_u64(), Some(b));
    let now = json(&["ls", text(&out)]);
    assert_eq!((generations(&now), &now["generations"][0]["step"]), (vec![a], &listed["generations"][0]["step"]));
    assert!(ckpt(&["rollback", text(&out), &a.to_string()]).contains("already the latest"));
    assert!(json(&["verify", text(&out), "--deep"])["faults"].as_array().unwrap().is_empty());

    // The copy has both generations with their numbers, in its own slots.
    let copied = json(&["ls", text(&copy)]);
    let of = |listed: &Value| -> Vec<String> {
        let keys = ["generation", "step", "gaussians", "pages", "bytes", "bytes_alone", "names"];
        let lines = listed["generations"].as_array().unwrap().iter();
        lines.map(|line| keys.map(|key| line[key].to_string()).join(" ")).collect()
    };
    assert_eq!(of(&copied), of(&listed));
    assert!(json(&["verify", text(&copy), "--deep"])["faults"].as_array().unwrap().is_empty());
    assert_ne!(json(&["inspect", text(&copy)])["identity"], json(&["inspect", text(&out)])["identity"]);
    let said = failed(&["clone", text(&out), text(&copy)]);
    assert!(said.contains("exists already"), "{said}");

    // The run then uses its copy, and does not return to a store that lacks the newer steps.
    bench.go_on_until_stopped(&["--spill-dir", text(&copy)]);
    let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
    assert!(config.contains(&format!("spill-dir = \"{}\"", text(&copy))), "{config}");
    let step = summary(&out)["steps"].as_u64().unwrap();
    assert!(step > listed["generations"][1]["step"].as_u64().unwrap());
    assert_eq!(json(&["ls", text(&out)])["generations"][1]["step"].as_u64(), Some(step));
    bench.go_on(&[]);
    assert!(bench.ply() == want, "the run went on with the copy and ended otherwise");
    assert!(!copy.join("map.redb").exists() && bench.spill().join("map.redb").exists());
    // The output files are those of the end; the store's older generation is still the latest there.
    std::fs::remove_file(out.join("summary.json")).unwrap();
    bench.go_on(&["--spill-dir", text(&bench.spill())]);
    assert!(bench.ply() == want, "the run went back and ended otherwise");
}

#[test]
fn names_keep_generations_until_they_are_pruned() {
    let bench = Bench::new();
    let out = bench.stopped(&[]);
    let first = generations(&json(&["ls", text(&out)]))[0];
    pin(&bench.spill(), &[("early", first), ("also-early", first)]);
    bench.go_on_until_stopped(&[]);
    let listed = json(&["ls", text(&out)]);
    let kept = generations(&listed);
    assert_eq!((kept.len(), kept[0]), (3, first), "{listed}");
    assert_eq!(listed["generations"][0]["names"].to_string(), r#"["also-early","early"]"#);
    let whole = bench.export(&out, &["--generation", "early"]);
    let copy = bench.copy("clone", &out);
    assert_eq!(json(&["ls", text(&copy)])["generations"][0]["names"].to_string(), r#"["also-early","early"]"#);
    assert!(std::fs::read(bench.export(&copy, &["--generation", "early"])).unwrap() == std::fs::read(whole).unwrap());
    assert!(!changed_pages(&bench.spill(), first, kept[2]).is_empty());

    let said = failed(&["prune", text(&out), "nosuch"]);
    assert!(said.contains("'nosuch'") && said.contains("also-early"), "{said}");
    let told = json(&["prune", text(&out), "--keep", "0", "--dry-run"]);
    assert_eq!((&told["is_done"], told["dropped_names"].as_array().unwrap().len()), (&Value::from(false), 2));
    assert_eq!(generations(&json(&["ls", text(&out)])).len(), 3);
    let one = json(&["prune", text(&out), "early"]);
    assert!(one["dropped"].as_array().unwrap().is_empty() && one["bytes_freed"] == 0, "another name keeps it: {one}");
    assert!(json(&["prune", text(&out), "--keep", "1"])["dropped_names"].as_array().unwrap().is_empty());
    let done = json(&["prune", text(&out), "--keep", "0"]);
    let alone = listed["generations"][0]["bytes_alone"].as_u64().unwrap();
    assert_eq!((done["dropped"][0].as_u64(), done["bytes_freed"].as_u64()), (Some(first), Some(alone)));
    assert!(alone > 0);
    assert_eq!(generations(&json(&["ls", text(&out)])), kept[1..]);
    assert!(json(&["verify", text(&out), "--deep"])["faults"].as_array().unwrap().is_empty());
}

#[test]
fn a_store_in_use_is_never_written_and_readers_report_the_use() {
    let bench = Bench::new();
    let (out, mut child) = bench.running(&["--steps", "20000", "--commit-every", "0.02"]);
    let busy = json(&["ls", text(&out)]);
    assert!(busy["used_by"].as_str().unwrap().contains(&format!("process {}", child.id())), "{busy}");
    assert!(ckpt(&["ls", text(&out)]).contains("in use"));
    assert!(ckpt(&["inspect", text(&out)]).contains("that of the last commit"));
    let generation = generations(&busy)[0].to_string();
    let (file, to) = (bench.path("x.ply"), bench.path("copy"));
    for command in [
        &["verify", text(&out)][..],
        &["export", text(&out), "--out", text(&file)],
        &["clone", text(&out), text(&to)],
        &["salvage", text(&out), "--out", text(&to)],
        &["rollback", text(&out), &generation, "--yes"],
        &["prune", text(&out), "--keep", "0"],
    ] {
        let said = failed(command);
        assert!(said.contains(&format!("process {}", child.id())) && said.contains("remedy"), "{command:?}: {said}");
    }
    assert!(!file.exists() && !to.exists());
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(json(&["ls", text(&out)])["used_by"].is_null(), "the lock goes with its process");
    assert!(json(&["verify", text(&out), "--deep"])["faults"].as_array().unwrap().is_empty());
}

/// A resumed run no longer needs its starting Gaussians.
#[test]
fn a_store_that_a_run_was_started_from_is_free_once_the_run_goes_on() {
    let bench = Bench::new();
    let out = bench.stopped(&[]);
    let seed = bench.copy("clone", &out);
    let first = generations(&json(&["ls", text(&seed)]))[0].to_string();
    [out, bench.spill()].iter().for_each(|folder| std::fs::remove_dir_all(folder).unwrap());
    // The import gets a part of the budget; messages name the given budget and a sufficient one.
    let with_budget = |budget: &str| {
        let out = bench.path("none");
        let flags = ["--init-ply", text(&seed), "--host-mem", budget, "--out", text(&out), "--steps", "1"];
        // Detecting a GPU loads its driver, which may take more than the rest of this budget.
        train(&[&[text(&bench.path("scene")), "--device", "cpu"], &flags[..]].concat())
    };
    let said = stderr(&with_budget("48MiB"));
    assert!(said.contains("48.0 MiB is not enough for this store"), "{said}");
    let least = said.split("give at least ").nth(1).and_then(|rest| rest.split(" MiB").next()).expect(&said);
    let enough = format!("{:.1}MiB", least.parse::<f64>().unwrap() + 0.1);
    let output = with_budget(&enough);
    assert!(!stderr(&output).contains("is not enough for this store"), "{enough} would do: {}", stderr(&output));
    assert!(output.status.success(), "{}", stderr(&output));
    bench.stopped(&["--init-ply", text(&seed)]);
    let mut child = bench.going_on(&[]);
    let dropped = json(&["rollback", text(&seed), &first, "--yes"]);
    assert!(child.try_wait().unwrap().is_none() && dropped["dropped"].as_array().unwrap().len() == 1);
    bench::stop(child);
}

/// The slot of the page that `verify` or `inspect` names: file and offset.
fn slot_of(dir: &Path, page: &str) -> (PathBuf, u64) {
    let page = json(&["inspect", text(dir), "--page", page]);
    (PathBuf::from(page["file"].as_str().unwrap()), page["offset"].as_u64().unwrap())
}

fn flip(file: &Path, at: u64) {
    let file = std::fs::OpenOptions::new().read(true).write(true).open(file).unwrap();
    let mut byte = [0];
    file.read_exact_at(&mut byte, at).unwrap();
    file.write_all_at(&[byte[0] ^ 0x10], at).unwrap();
}

#[test]
fn flipped_bits_in_pages_are_named_and_older_versions_take_their_place() {
    let bench = Bench::new();
    let out = bench.stopped(&[]);
    let listed = json(&["ls", text(&out)]);
    let [a, b] = generations(&listed)[..] else { panic!("{listed}") };
    let names = changed_pages(&bench.spill(), a, b);
    let (payload, header) = (names[0].as_str(), names[1].as_str());
    let (file, offset) = slot_of(&out, payload);
    flip(&bench.spill().join(file), offset + 4096 + 77);
    assert!(json(&["verify", text(&out)])["faults"].as_array().unwrap().is_empty(), "headers do not know");
    let (file, offset) = slot_of(&out, header);
    flip(&bench.spill().join(&file), offset + 20);
    let output = bench::run(&["verify", text(&out), "--deep", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let verdict: Value = serde_json::from_slice(&output.stdout).unwrap();
    let mut faults: Vec<(String, String)> = verdict["faults"]
        .as_array()
        .unwrap()
        .iter()
        .map(|fault| {
            assert_eq!(fault["generation"].as_u64(), Some(b));
            (fault["page"].as_str().unwrap().to_string(), fault["kind"].as_str().unwrap().to_string())
        })
        .collect();
    faults.sort();
    let mut want = vec![(payload.to_string(), "payload".to_string()), (header.to_string(), "header".to_string())];
    want.sort();
    assert_eq!(faults, want);
    let words = String::from_utf8(bench::run(&["verify", text(&out), "--deep"]).stdout).unwrap();
    assert!(words.contains("2 faults") && words.contains(&format!("{} offset {offset}", file.display())), "{words}");
    // Commands that need the pages name a damaged one; no partial copy is left.
    let to = bench.path("copy");
    let said = failed(&["clone", text(&out), text(&to)]);
    assert!(said.contains("page ") && said.contains("remedy"), "{said}");
    assert!(!to.exists() && !bench.path("copy.part").exists());
    let said = failed(&["export", text(&out), "--out", text(&bench.path("x.ply"))]);
    assert!(said.contains("is damaged") && !bench.path("x.ply").exists(), "{said}");

    let before = bench.store_files();
    let rescued = bench.path("rescued");
    let done = json(&["salvage", text(&out), "--out", text(&rescued)]);
    assert!(bench.store_files() == before, "salvage wrote to the damaged store");
    assert_eq!(done["has_state"], true);
    assert_eq!(done["pages"], listed["generations"][1]["pages"], "{done}");
    let lost = done["lost"].as_array().unwrap();
    assert_eq!(lost.len(), 2);
    assert!(lost.iter().all(|page| page["taken"].as_u64().is_some_and(|taken| taken <= a)), "{done}");
    assert!(json(&["verify", text(&rescued), "--deep"])["faults"].as_array().unwrap().is_empty());
    bench.export(&rescued, &[]);
    // A rollback avoids the damage as well, and the run resumes from either.
    json(&["rollback", text(&out), &a.to_string(), "--yes"]);
    assert!(json(&["verify", text(&out), "--deep"])["faults"].as_array().unwrap().is_empty());
    bench.go_on(&["--spill-dir", text(&rescued)]);
}

/// Older versions have other statistics than the run has counted, and pending rounds that newer versions have applied.
#[test]
fn a_run_resumes_from_many_older_pages() {
    // With rounds between the generations that grow much, and with statistics that no round cleared.
    for (every, grow, last) in [("10", "0.0001", "120"), ("150", "0.001", "200")] {
        let rounds = ["--refine-every", every, "--grow-grad2d", grow, "--refine-stop", last];
        goes_on_from_older_pages(&[&rounds[..], &["--steps", "240"]].concat());
    }
}

fn goes_on_from_older_pages(more: &[&str]) {
    let bench = Bench::new();
    let out = bench.stopped(more);
    let listed = json(&["ls", text(&out)]);
    let [a, b] = generations(&listed)[..] else { panic!("{listed}") };
    let names = changed_pages(&bench.spill(), a, b);
    for name in &names {
        let (file, offset) = slot_of(&out, name);
        flip(&bench.spill().join(file), offset + 4096 + 77);
    }
    let rescued = bench.path("rescued");
    let done = json(&["salvage", text(&out), "--out", text(&rescued)]);
    let taken = done["lost"].as_array().unwrap().iter().filter(|page| !page["taken"].is_null()).count();
    assert!(taken > 10 && taken == names.len(), "{taken} older pages: {done}");
    assert!(json(&["verify", text(&rescued), "--deep"])["faults"].as_array().unwrap().is_empty());
    bench.export(&rescued, &[]);
    bench.go_on(&["--spill-dir", text(&rescued)]);
}

#[test]
fn a_lost_map_is_rebuilt_from_the_slots() {
    let bench = Bench::new();
    let out = bench.stopped(EVENTLESS);
    let listed = json(&["ls", text(&out)]);
    let want = std::fs::read(out.join("point_cloud.ply")).unwrap();
    std::fs::remove_file(bench.spill().join("map.redb")).unwrap();
    let said = failed(&["ls", text(&out)]);
    assert!(said.contains("no page map") && said.contains("salvage"), "{said}");
    let output = bench::run(&["verify", text(&out)]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stdout).contains("FAULT map"));
    let done = json(&["salvage", text(&out), "--out", text(&bench.path("rescued"))]);
    assert_eq!((&done["has_state"], &done["step"]), (&Value::from(false), &listed["generations"][1]["step"]));
    assert_eq!(
        (&done["pages"], &done["gaussians"]),
        (&listed["generations"][1]["pages"], &listed["generations"][1]["gaussians"])
    );
    assert!(
        done["lost"].as_array().unwrap().is_empty() && done["notes"].to_string().contains("state is lost"),
        "{done}"
    );
    // Without pending events, no part of the scene is in the map alone.
    let file = bench.export(&bench.path("rescued"), &[]);
    assert!(std::fs::read(&file).unwrap() == want, "the rescued scene is another");

    // Without FORMAT and without the run's config: local coordinates, the same Gaussians.
    std::fs::remove_file(bench.spill().join("FORMAT")).unwrap();
    let done = json(&["salvage", text(&bench.spill()), "--out", text(&bench.path("bare"))]);
    assert_eq!(&done["gaussians"], &listed["generations"][1]["gaussians"]);
    assert!(done["notes"].to_string().contains("config is not known"), "{done}");
    // A damaged page is reported, and its older version is used or its rows are missing.
    let first = json(&["inspect", text(&bench.path("rescued"))])["pages"].as_u64().unwrap();
    let segment = bench.spill().join("seg-00000000.dat");
    flip(&segment, 4096 + 100);
    let done = json(&[
        "salvage",
        text(&bench.spill()),
        "--out",
        text(&bench.path("third")),
        "--config",
        text(&out.join("config.toml")),
    ]);
    let lost = done["lost"].as_array().unwrap().len() as u64;
    assert!(lost <= 1 && done["pages"].as_u64().unwrap() + lost >= first, "{done}");
    let segments = bench.store_files().into_keys().filter(|p| p.extension().is_some_and(|e| e == "dat"));
    segments.for_each(|segment| std::fs::write(segment, b"").unwrap());
    let said = failed(&["salvage", text(&bench.spill()), "--out", text(&bench.path("fourth"))]);
    assert!(said.contains("no slot header") && !bench.path("fourth").exists(), "{said}");
}

/// The histogram in the run state is lost with the map; the statistics in the pages remain. Growth uses both.
#[test]
fn growth_goes_on_after_a_salvage_without_a_map() {
    let bench = Bench::new();
    // The rounds come after the stop; the cap allows half of the uncapped growth.
    let more = ["--refine-every", "150", "--refine-stop", "400", "--grow-grad2d", "0.0001", "--max-gaussians", "4000"];
    let (scene, alone) = (bench.path("scene"), bench.path("alone"));
    let args = [&[text(&scene), "--out", text(&alone)], &bench::with(&more)[..]].concat();
    let output = train(&args);
    assert!(output.status.success(), "{}", stderr(&output));
    let out = bench.stopped(&more);
    std::fs::remove_file(bench.spill().join("map.redb")).unwrap();
    let rescued = bench.path("rescued");
    let done = json(&["salvage", text(&out), "--out", text(&rescued)]);
    assert!(done["step"].as_u64().unwrap() < 150 && done["lost"].as_array().unwrap().is_empty(), "{done}");
    let output = train(&[
        "--resume",
        text(&out),
        "--spill-dir",
        text(&rescued),
        "--accept-changes",
        "--quiet",
        "--device",
        "cpu",
    ]);
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    // The statistics in the pages and in the run state agree: nothing was recounted.
    assert!(!said.contains("counted anew"), "{said}");
    let of = |out: &Path| summary(out)["gaussians"].as_u64().unwrap();
    let (first, grown, want) = (done["gaussians"].as_u64().unwrap(), of(&out), of(&alone));
    println!("{first} Gaussians grew to {grown}; without the damage to {want}");
    // A few pending opacity resets are lost together with the statistics of their pages: 3 % of the growth.
    let off = grown.abs_diff(want) as f64 / (want - first) as f64;
    assert!(want > first + 500 && off < 0.03, "{first} grew to {grown}; without the damage to {want}");
}

#[test]
fn split_pages_are_not_rescued_twice() {
    let bench = Bench::new();
    let out = bench.stopped(&[]);
    let listed = json(&["ls", text(&out)]);
    let last = &listed["generations"][1];
    std::fs::write(bench.spill().join("map.redb"), vec![7; 100_000]).unwrap();
    let done = json(&["salvage", text(&out), "--out", text(&bench.path("rescued"))]);
    // Slots of emptied pages look like slots of existing pages.
    let (pages, rows) = (done["pages"].as_u64().unwrap(), done["gaussians"].as_u64().unwrap());
    let (want, want_rows) = (last["pages"].as_u64().unwrap(), last["gaussians"].as_u64().unwrap());
    assert!(pages >= want && pages <= want + 2, "{pages} pages instead of {want}: {done}");
    assert!(rows >= want_rows && rows <= want_rows + 64, "{rows} rows instead of {want_rows}");
    assert!(json(&["verify", text(&bench.path("rescued")), "--deep"])["faults"].as_array().unwrap().is_empty());
}

#[test]
fn a_lost_witness_costs_nothing() {
    let bench = Bench::new();
    let want = bench.alone();
    let out = bench.stopped(&[]);
    std::fs::write(bench.spill().join("witness"), b"gone").unwrap();
    assert!(failed(&["ls", text(&out)]).contains("witness"));
    let rescued = bench.path("rescued");
    let done = json(&["salvage", text(&out), "--out", text(&rescued)]);
    assert!(done["has_state"] == true && done["lost"].as_array().unwrap().is_empty(), "{done}");
    bench.go_on(&["--spill-dir", text(&rescued)]);
    assert!(bench.ply() == want, "the run ended otherwise");
}

#[test]
fn segments_that_are_cut_short_or_gone_are_named() {
    let bench = Bench::new();
    let out = bench.stopped(&[]);
    let mut segments: Vec<PathBuf> =
        bench.store_files().into_keys().filter(|p| p.extension().is_some_and(|e| e == "dat")).collect();
    segments.sort();
    let first = std::fs::OpenOptions::new().write(true).open(&segments[0]).unwrap();
    let bytes = first.metadata().unwrap().len();
    first.set_len(bytes / 2 + 4096 + 512).unwrap();
    let faults = |args: &[&str]| -> Vec<Value> {
        let output = bench::run(&[args, &["--json"]].concat());
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()["faults"].as_array().unwrap().clone()
    };
    let found = faults(&["verify", text(&out)]);
    assert!(found[0]["kind"] == "segment" && found[0]["what"].to_string().contains(&bytes.to_string()), "{found:?}");
    assert!(found[1]["kind"] == "header" && found[1]["what"].to_string().contains("ends inside"), "{found:?}");
    std::fs::remove_file(&segments[0]).unwrap();
    let found = faults(&["verify", text(&out)]);
    assert!(found[0]["what"] == "it is missing" && found.len() > 20, "{found:?}");
    assert!(found[1]["what"].to_string().contains("seg-00000000.dat is missing"), "{found:?}");
}

#[test]
fn other_folders_and_other_versions_are_refused_by_name() {
    let bench = Bench::new();
    let foreign = bench.path("photos");
    std::fs::create_dir(&foreign).unwrap();
    std::fs::write(foreign.join("a.jpg"), b"mine").unwrap();
    let to = bench.path("to");
    for command in [&["ls"][..], &["verify"], &["inspect"], &["rollback"], &["prune"], &["export"], &["salvage"]] {
        let more: &[&str] = match command[0] {
            "rollback" => &["1", "--yes"],
            "prune" => &["--keep", "0"],
            "export" | "salvage" => &["--out", text(&to)],
            _ => &[],
        };
        let said = failed(&[command, &[text(&foreign)], more].concat());
        assert!(said.contains("neither a store nor a run's output folder") && said.contains("remedy"), "{said}");
        assert!(failed(&[command, &["no/such/folder"], more].concat()).contains("no such folder"));
    }
    assert_eq!(std::fs::read_dir(&foreign).unwrap().count(), 1);
    assert!(!to.exists());

    let out = bench.stopped(&[]);
    let path = bench.spill().join("FORMAT");
    let good = std::fs::read(&path).unwrap();
    let with = |at: usize, value: u8| {
        let mut bytes = good.clone();
        bytes[at] = value;
        let sum = checksum(&bytes[..240]).to_le_bytes();
        bytes[240..].copy_from_slice(&sum);
        std::fs::write(&path, bytes).unwrap();
    };
    let commands = [&["ls", text(&out)][..], &["verify", text(&out)], &["rollback", text(&out), "1", "--yes"]];
    let refused = |words: &[&str]| {
        for command in commands {
            let said = failed(command);
            assert!(words.iter().all(|word| said.contains(word)) && said.contains("remedy"), "{said}");
        }
        let said = stderr(&train(&["--resume", text(&out), "--quiet"]));
        assert!(words.iter().all(|word| said.contains(word)), "the trainer: {said}");
    };
    with(8, 2);
    refused(&["format version 2", "newer", "knows version 1"]);
    with(13, 0x40);
    refused(&["features that this program does not know", "0x4000"]);
    // A compatible feature bit is accepted and shown.
    with(49, 0x01);
    assert_eq!(json(&["inspect", text(&out)])["features_compatible"], 256);
    std::fs::write(&path, &good[..200]).unwrap();
    refused(&["damaged or cut short"]);
    std::fs::write(&path, &good).unwrap();
    bench.go_on(&[]);
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
    let folder = tempfile::tempdir().unwrap();
    let ply = folder.path().join("in.ply");
    let path = |name: &str| folder.path().join(name);
    // Each view sees at most one of ten parts.
    let mut gaussians = wave(150_000);
    gaussians.means.chunks_exact_mut(3).enumerate().for_each(|(row, mean)| mean[1] += 2000.0 * (row / 15_000) as f32);
    write_gaussians(&ply, &gaussians, &SceneMeta::default()).unwrap();
    let scene = scenes::city(folder.path(), 8, 32, 24, 200);
    let (alone, out, spill) = (path("alone"), path("out"), path("spill"));
    let flags =
        ["--steps", "20", "--page-rows", "128", "--strategy", "none", "--view-order", "shuffle", "--device", "cpu"];
    let common = [&[text(&scene), "--init-ply", text(&ply), "--threads", "2"][..], &flags].concat();
    let refused = train(&[&common, &["--out", text(&out), "--host-mem", "30MiB"][..]].concat());
    let said = stderr(&refused);
    assert_eq!(refused.status.code(), Some(1), "{said}");
    assert!(
        said.contains("in.ply") && said.contains("150000 Gaussians take") && said.contains("--spill-dir"),
        "{said}"
    );
    // The values alone take 35 MB, 109 MB with moments; paged training equals training in memory.
    let in_memory = train(&[&common, &["--out", text(&alone)][..]].concat());
    assert!(in_memory.status.success(), "{}", stderr(&in_memory));
    let within = ["--out", text(&out), "--spill-dir", text(&spill), "--host-mem", "64MiB"];
    let paged = train(&[&common, &within[..]].concat());
    assert!(paged.status.success(), "{}", stderr(&paged));
    let peak = |out: &Path| summary(out)["host_bytes_peak"].as_u64().unwrap();
    assert!(peak(&out) <= 64 << 20 && peak(&alone) > 128 << 20, "{} and {} bytes", peak(&out), peak(&alone));
    let [got, want] = [&out, &alone].map(|folder| std::fs::read(folder.join("point_cloud.ply")).unwrap());
    assert!(got == want, "another scene than in memory");
}

#[test]
fn gaussians_round_trip_through_a_store_within_the_budget() {
    let rows = std::env::var("GSSCALE_CKPT_GAUSSIANS").ok().map_or(40_000, |n| n.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write_gaussians(&path("in.ply"), &wave(rows), &SceneMeta::default()).unwrap();
    // The rows alone take 29 MB at 40,000 rows, and exceed the budget from 150,000 rows on.
    let (budget, bytes) = ("112MiB", 112u64 << 20);
    let done = json(&["import", text(&path("in.ply")), "--out", text(&path("store")), "--host-mem", budget]);
    assert_eq!((done["gaussians"].as_u64(), done["sh_degree"].as_u64()), (Some(rows as u64), Some(3)));
    assert!(done["host_bytes_peak"].as_u64().unwrap() <= bytes, "{done}");
    assert!(json(&["verify", text(&path("store")), "--deep"])["faults"].as_array().unwrap().is_empty());
    let listed = json(&["ls", text(&path("store"))]);
    assert_eq!((listed["generations"][0]["step"].as_u64(), generations(&listed).len()), (Some(0), 1));
    let out = path("out.ply");
    let done = json(&["export", text(&path("store")), "--out", text(&out), "--host-mem", budget]);
    assert!(done["host_bytes_peak"].as_u64().unwrap() <= bytes, "{done}");
    if rows <= 1_000_000 {
        let sorted = |path: &Path| {
            let mut rows = Ply::read(path).rows;
            rows.sort_by(|a, b| {
                a.iter().zip(b).map(|(a, b)| a.total_cmp(b)).find(|o| o.is_ne()).unwrap_or(std::cmp::Ordering::Equal)
            });
            rows
        };
        assert!(sorted(&out) == sorted(&path("in.ply")), "a value changed on its way");
    }
    // Pages are local in space: a small box reads few of them.
    let part = json(&["export", text(&path("store")), "--out", text(&out), "--crop", "0,0,-9,12,12,9"]);
    assert!(part["bytes_read"].as_u64().unwrap() * 4 < done["bytes_read"].as_u64().unwrap(), "{part}");

    let again = failed(&["import", text(&path("in.ply")), "--out", text(&path("store"))]);
    assert!(again.contains("exists already"), "{again}");
    let little = failed(&["import", text(&path("in.ply")), "--out", text(&path("other")), "--host-mem", "20MiB"]);
    assert!(little.contains("is not enough") && little.contains("give at least"), "{little}");
    let bytes = std::fs::read(path("in.ply")).unwrap();
    std::fs::write(path("cut.ply"), &bytes[..bytes.len() / 2]).unwrap();
    let cut = failed(&["import", text(&path("cut.ply")), "--out", text(&path("other"))]);
    assert!(cut.contains("cut.ply") && !path("other").exists() && !path("other.part").exists(), "{cut}");
}

#[test]
fn a_run_starts_from_a_store_as_from_the_file_that_it_was_made_of() {
    let bench = Bench::new();
    let out = bench.stopped(&["--export-frame", "local"]);
    let (file, store) = (out.join("point_cloud.ply"), bench.path("store"));
    json(&["import", text(&file), "--out", text(&store), "--page-rows", "32"]);
    let want = train_from(&bench, &file, "from-file");
    assert!(train_from(&bench, &store, "from-store") == want, "the store is another start than its file");
    // A run's checkpoint also serves as a start; its pages differ from the file's, and so do the roundings.
    let rows = Ply::read(&file).rows.len();
    train_from(&bench, &out, "from-run");
    let started = summary(&bench.path("from-run"));
    assert!(started["gaussians"].as_u64().unwrap().abs_diff(rows as u64) < rows as u64 / 5, "{started}");
}

#[test]
fn every_subcommand_has_help_with_examples() {
    let help = ckpt(&["--help"]);
    for name in ["ls", "inspect", "verify", "rollback", "prune", "export", "import", "clone", "salvage"] {
        assert!(help.contains(&format!("\n  {name} ")), "{help}");
        let of = ckpt(&[name, "--help"]);
        assert!(of.contains("Examples:") && of.contains("--json"), "{of}");
    }
}
