//! `gsscale-bench sweep`, which trains runs in child processes, and `gsscale-bench compare` of its runs.

use crate::support::bench::{bench, large_city, lines, number, parse};
use crate::support::browser::in_a_browser;
use crate::support::gpu;
use crate::support::scenes::{stderr, text};
use gsscale::gpu::GpuOptions;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Asserts that a report page is complete and self-contained, and that it opens in a browser if one is installed.
fn check_page(page: &Path, parts: &[&str], scratch: &Path) {
    let html = std::fs::read_to_string(page).unwrap();
    for part in parts.iter().chain(&["<svg", "</html>"]) {
        assert!(html.contains(part), "{part} is missing in {}", page.display());
    }
    let addresses = html.replace("http://www.w3.org/2000/svg", "");
    assert!(!addresses.contains("http://") && !addresses.contains("https://") && !addresses.contains("src=\"/"));
    in_a_browser(page, scratch);
}

/// Arguments of a sweep on a scene with small pages.
fn sweep<'a>(list: &'a str, scene: &'a Path, out: &'a Path, more: &[&'a str]) -> Vec<&'a str> {
    let common = ["--page-rows", "16", "--strategy", "none", "--pace-steps", "0"];
    [&["sweep", list, text(scene), "--out", text(out)][..], &common, more].concat()
}

/// The record of a run.
fn of<'a>(records: &'a [Value], name: &str, seed: u64) -> &'a Value {
    let found = records.iter().find(|r| r["name"] == name && r["seed"] == seed);
    found.unwrap_or_else(|| panic!("{name} {seed} in {records:?}"))
}

fn said(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

#[test]
fn rungs_of_the_ladder_cost_less_and_less_and_end_alike() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let out = folder.path().join("ladder");
    let command = sweep("ladder", &scene, &out, &["--steps", "60", "--share", "70", "--seeds", "3"]);
    let at = command.iter().position(|arg| *arg == "--pace-steps").unwrap() + 1;
    let with_pace = |steps: &'static str| {
        let mut command = command.clone();
        command[at] = steps;
        command
    };
    let plain = with_pace("20");
    let records = lines(&[&plain[..], &["--json"]].concat());
    let [naive, deferred, planned, overlap, memory] =
        ["naive", "deferred", "planned", "overlap", "memory"].map(|name| of(&records, name, 3));
    for rung in [deferred, planned, overlap] {
        assert_eq!(rung["ply"], memory["ply"], "{} is not exact", rung["name"]);
    }
    assert_ne!(naive["ply"], memory["ply"], "dense updates round more often");
    // 60 steps amplify roundings of 1e-7 to a few thousandths of a decibel at most.
    assert!((number(naive, "psnr") - number(memory, "psnr")).abs() < 0.05);
    // A cache smaller than the scene keeps nothing if every step visits all pages in the same order.
    let (pages, frames) = (number(naive, "pages"), number(naive, "frames"));
    assert!(frames < pages && number(deferred, "frames") == frames);
    assert!(number(naive, "bytes_read") > 60.0 * (pages - frames) * 16.0 * 200.0);
    assert!(number(naive, "bytes_read") > 2.0 * number(deferred, "bytes_read"));
    assert!(number(planned, "bytes_read") < number(deferred, "bytes_read"), "Belady reads less than LRU");
    assert!(number(memory, "bytes_read") == 0.0 && number(overlap, "drive_bytes_peak") > 0.0);
    assert!(records.iter().all(|r| number(r, "cpu_seconds") > 0.0 && number(r, "host_bytes_peak") > 1e6));
    assert!(records.iter().all(|r| number(&r["pace"], "seconds") > 0.0), "the pace of the machine at each rung");
    let own = out.join(scene.file_name().unwrap());
    check_page(&own.join("sweep.html"), &["the same, byte for byte", "seconds waiting"], folder.path());
    assert!(names(&own.join("spill")).is_empty(), "scratch is removed");
    // Finished runs are not repeated. Without --json, the end is a table of them, in the order of the list.
    let table = said(&bench(&plain));
    let words: Vec<&str> =
        table.lines().filter_map(|line| line.strip_prefix("| ")?.split_whitespace().next()).collect();
    assert_eq!(words, ["run", "naive", "deferred", "planned", "overlap", "memory"], "{table}");
    assert!(table.contains(&format!(" {:.2} |", number(memory, "psnr"))) && !table.contains("DIFFER"));
    let results = own.join("results.jsonl");
    assert_eq!(parse(&std::fs::read_to_string(&results).unwrap()), records);
    // A machine that was three times as slow during one rung: a third of its 90 seconds at the pace of the others.
    let mut paced = records.clone();
    paced.iter_mut().for_each(|rung| rung["pace"]["seconds"] = 2.0.into());
    let slow = paced.iter_mut().find(|rung| rung["name"] == "memory").unwrap();
    (slow["pace"]["seconds"], slow["seconds"]) = (6.0.into(), 90.0.into());
    std::fs::write(&results, paced.iter().map(|rung| format!("{rung}\n")).collect::<String>()).unwrap();
    let (converted, measured) = (said(&bench(&plain)), said(&bench(&with_pace("0"))));
    assert!(converted.contains(" 30.0 |") && converted.contains("converted to the median pace"), "{converted}");
    assert!(measured.contains(" 90.0 |") && measured.contains("times as measured"), "{measured}");
}

/// Pages on a device give the same bits whatever lies there, and other bits than the host's optimizer.
#[test]
fn rungs_on_a_device_end_alike() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let out = folder.path().join("ladder");
    let sizes = ["--steps", "30", "--share", "70"];
    let args = sweep("ladder-gpu", &scene, &out, &sizes);
    let records = lines(&[&args[..], &["--device-mem", "6MiB", "--device", "gpu", "--json"]].concat());
    let [overlap, memory, pages, ahead, split, resident] =
        ["overlap", "memory", "pages", "ahead", "split", "resident"].map(|name| of(&records, name, 42));
    assert!(
        overlap["ply"] == memory["ply"] && [ahead, split, resident].iter().all(|r| r["ply"] == pages["ply"]),
        "{records:?}"
    );
    assert!(records.iter().all(|r| r["pace"].is_null()), "no pace was wanted");
    assert!(number(split, "device_bytes_peak") <= 3.0 * 1048576.0, "{split}");
    assert_ne!(memory["ply"], pages["ply"], "the device rounds as the host does");
    assert!((number(pages, "psnr") - number(memory, "psnr")).abs() < 0.1, "{records:?}");
    assert!(number(pages, "device_bytes_peak") < number(resident, "device_bytes_peak"), "{records:?}");
    let words =
        ["The results of overlap, memory are the same", "The results of pages, ahead, split, resident are the same"];
    check_page(&out.join(scene.file_name().unwrap()).join("sweep.html"), &words, folder.path());
    let output = bench(&[&args[..], &["--device", "cpu"]].concat());
    assert!(!output.status.success() && stderr(&output).contains("use --device auto or gpu"), "{}", stderr(&output));
}

#[test]
fn a_sweep_that_is_killed_goes_on_where_it_stopped() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let out = folder.path().join("sweep");
    let knobs = ["--steps", "20", "--seeds", "1,2", "--other-seeds", "2", "--only", "optimizer,budget,sh,resolution"];
    let plain = sweep("pareto", &scene, &out, &knobs);
    let args = [&plain[..], &["--json"]].concat();
    let planned = said(&bench(&[&args[..], &["--list-runs"]].concat())).matches("to do").count();
    assert!(planned >= 16 && !out.exists(), "listing runs nothing");

    // Killed in the middle of a run.
    let program = env!("CARGO_BIN_EXE_gsscale-bench");
    let mut killed = Command::new(program).args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let out = out.join(scene.file_name().unwrap());
    let results = out.join("results.jsonl");
    let began = Instant::now();
    while std::fs::read_to_string(&results).map_or(0, |t| t.lines().count()) < 2 {
        assert!(began.elapsed() < Duration::from_secs(120), "no run ended");
        std::thread::sleep(Duration::from_millis(5));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    let kept = std::fs::read_to_string(&results).unwrap();
    let done = kept.lines().count();
    // And as after a crash of the machine in the middle of a line.
    std::fs::write(&results, format!("{kept}{{\"key\":\"0123")).unwrap();
    std::fs::create_dir_all(out.join("runs/base-seed9-00000000.part/renders")).unwrap();

    // The holder of the lock is at work, even if only a run that outlived its sweep.
    let lock = std::fs::File::open(out.join("sweep.lock")).unwrap();
    lock.lock().unwrap();
    let refused = bench(&args);
    assert!(!refused.status.success() && stderr(&refused).contains("left behind"), "{}", stderr(&refused));
    assert!(out.join("runs/base-seed9-00000000.part").is_dir(), "it may be in use");
    drop(lock);

    let after = lines(&[&args[..], &["--max-runs", "3"]].concat());
    assert_eq!(after.len(), 3);
    let rest = lines(&args);
    assert_eq!(done + after.len() + rest.len(), planned, "nothing is lost, nothing is done twice");
    let records = parse(&std::fs::read_to_string(&results).unwrap());
    assert!(std::fs::read_to_string(&results).unwrap().starts_with(&kept));
    let mut keys: Vec<&str> = records.iter().map(|r| r["key"].as_str().unwrap()).collect();
    keys.sort_unstable();
    keys.dedup();
    assert_eq!(keys.len(), planned);
    assert!(records.iter().all(|r| r["problem"].is_null()), "{records:?}");
    assert!(names(&out.join("runs")).iter().all(|name| !name.contains(".part")), "half runs are removed");
    assert_eq!(names(&out.join("runs")).len(), planned);
    assert!(lines(&args).is_empty(), "all are done");
    let table = said(&bench(&plain));
    assert!(table.starts_with("| run ") && table.contains("the same bits") && !table.contains('{'), "{table}");

    // The figures that follow from the settings.
    let base = of(&records, "base", 1);
    assert_ne!(base["ply"], of(&records, "base", 2)["ply"], "seeds matter");
    let paged = of(&records, "budget/75 %", 1);
    assert_eq!(paged["ply"], base["ply"], "a budget changes no bit");
    assert!(number(paged, "bytes_read") > 0.0 && number(base, "bytes_read") == 0.0);
    let sparse = of(&records, "optimizer/sparse", 1);
    assert!(sparse["ply"] != base["ply"] && sparse["settings"]["optimizer"] == "sparse");
    // Quality is measured on the photos of the reference: half of the resolution is worse there, and would be better on its
    // own photos.
    let small = of(&records, "resolution/1/2", 1);
    assert!(number(small, "psnr") < number(base, "psnr"), "{small} {base}");
    check_page(&out.join("sweep.html"), &["Pareto front", "the same bits", "CPU seconds"], folder.path());
    compare(&out, small, folder.path());
}

/// As the help says: all runs of the sweep on one page, the reference first.
fn compare(out: &Path, small: &Value, scratch: &Path) {
    let names = names(&out.join("runs"));
    let folders: Vec<_> = names.iter().map(|name| out.join("runs").join(name)).collect();
    let folders: Vec<&str> = folders.iter().map(|folder| text(folder)).collect();
    let page = out.join("compare.html");
    let compared = bench(&[&["compare"][..], &folders[..], &["--out", text(&page)]].concat());
    assert!(compared.status.success(), "{}", stderr(&compared));
    let figure = format!("<td class=\"number\">{:.3}</td>", number(small, "psnr"));
    let marks = ["PSNR and SSIM are of evaluated.json", "trained with data-factor 2 instead of 1", "are left out"];
    check_page(&page, &[&marks[..], &["PSNR of training views", figure.as_str()]].concat(), scratch);
    let sliders = std::fs::read_to_string(&page).unwrap().matches("class=\"slider\"").count();
    assert_eq!((names[0].starts_with("base-seed1"), sliders), (true, 12));
}

#[test]
fn wrong_input_is_refused_and_a_run_that_fails_stops_nobody() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let (out, own) = (folder.path().join("out"), folder.path().join("own.toml"));
    let (scene_text, out_text, own_text) = (text(&scene), text(&out), text(&own));
    let refuses = |args: &[&str], words: &str| {
        let output = bench(args);
        assert_eq!(output.status.code(), Some(1));
        assert!(stderr(&output).contains(words) && stderr(&output).contains("remedy"), "{}", stderr(&output));
    };
    let refuses_list = |list: &str, words: &str| {
        std::fs::write(&own, list).unwrap();
        refuses(&["sweep", own_text, scene_text, "--out", out_text], words);
    };
    refuses(&["sweep", "pareto", scene_text, "--out", out_text, "--only", "sh,colour"], "possible values");
    refuses(&["sweep", "pareto", scene_text, "--out", out_text, "--share", "100"], "--share");
    refuses(&["sweep", "pareto", scene_text, scene_text, "--out", out_text], "another scene has this name");
    refuses(&["sweep", "ladder", "/nowhere", "--out", out_text], "nowhere");
    refuses(&["sweep", "no-such-list", scene_text, "--out", out_text], "no-such-list");
    refuses(&["compare", scene_text, scene_text, "--out", out_text], "metrics.jsonl");
    let list = "seeds = [1]\n[base]\nsteps = 4\n[view]\ntitle = \"own\"\nreference = \"plain\"\nfigures = [\"psnr\"]\n\
                charts = []\n[[group]]\nname = \"\"\nruns = [{ name = \"plain\" }, RUN]\n";
    let with = |run: &str| list.replace("RUN", run);
    refuses_list(
        &list.replace("reference = \"plain\"", "reference = \"other\"").replace(", RUN", ""),
        "no run of the list",
    );
    refuses_list(&list.replace("psnr", "beauty").replace(", RUN", ""), "beauty");
    refuses_list(&with("{ name = \"plain\" }"), "two runs plain");
    refuses_list(&with("{ name = \"a\", environment = { PATH = \"/\" } }"), "PATH");
    refuses_list(&with("{ name = \"a\", set = { stepz = 3 } }"), "stepz");
    refuses_list(&with("{ name = \"a\", times = { optimizer = 2.0 } }"), "optimizer is no number");
    refuses_list(&with("{ name = \"a\", set = { data-factor = 0.5 } }"), "data-factor");
    refuses_list(
        &list.replace(", RUN", "").replace("seeds = [1]", "seeds = [1]\nshare = 50"),
        "nothing would leave memory",
    );
    refuses(&[scene_text, "--spill-dir", out_text], "--spill-dir");
    assert!(!out.exists(), "bad input leaves nothing behind");

    // Too little memory fails the run without a drive, and no other; what cannot run is left out; equal runs run once.
    let more = "{ name = \"same\" }, { name = \"paged\", share = 70, set = { page-rows = 16 } }, { name = \"big pages\", share = 1 }";
    std::fs::write(&own, with(more)).unwrap();
    let args = ["sweep", own_text, scene_text, "--out", out_text, "--strategy", "none", "--json", "--pace-steps", "0"];
    let args = [&args[..], &["--image-cache", "1B", "--host-mem", "1MiB"]].concat();
    let output = bench(&args);
    assert!(stderr(&output).contains("big pages is left out"), "{}", stderr(&output));
    let records = parse(&said(&output));
    assert!(of(&records, "plain", 1)["problem"].as_str().is_some_and(|p| p.contains("--host-mem")), "{records:?}");
    assert!(records.len() == 2 && of(&records, "paged", 1)["problem"].is_null(), "{records:?}");
    // Only failed runs are repeated.
    assert_eq!(lines(&args).len(), 1);
    let page = std::fs::read_to_string(out.join(scene.file_name().unwrap()).join("sweep.html")).unwrap();
    assert!(page.contains("failed: ") && page.contains("--host-mem"));
}

#[test]
fn faults_of_a_capture_are_charted_and_their_scenes_are_removed() {
    let folder = TempDir::new().unwrap();
    let scene = crate::support::scenes::city(folder.path(), 24, 48, 32, 400);
    let out = folder.path().join("stability");
    let only = "swapped10/none,swapped10/own,exposure1/none,exposure1/own,points10/none";
    let args = ["--steps", "80", "--seeds", "1", "--device", "cpu", "--only", only];
    let plain = sweep("stability", &scene, &out, &args);
    let json = [&plain[..], &["--json"]].concat();
    let own = out.join(scene.file_name().unwrap());
    let records = [lines(&[&json[..], &["--max-runs", "2"]].concat()), lines(&json)].concat();
    assert_eq!(records.len(), 6, "nothing is done twice");
    assert!(lines(&json).is_empty() && names(&own.join("scenes")).is_empty(), "scenes are removed");
    let clean = of(&records, "clean/none", 1);
    let of = |name: &str| of(&records, name, 1);
    assert_ne!(clean["ply"], of("points10/none")["ply"]);
    assert!(number(of("points10/none"), "gaussians") < 0.3 * number(clean, "gaussians"));
    assert!(number(of("exposure1/none"), "psnr") < number(clean, "psnr"));
    assert_eq!(of("exposure1/own")["settings"]["appearance"], "exposure");
    assert_eq!(of("swapped10/own")["wrong_views"].as_array().unwrap().len(), 4);
    assert!(clean["cc_psnr"].is_number());
    let parts = ["PSNR, dB: lost against clean/none", "wrong views named", "exposure1/own"];
    check_page(&own.join("sweep.html"), &parts, folder.path());
    // Other photos are other scenes.
    let smaller = [&json[..], &["--max-resolution", "40", "--max-runs", "1"]].concat();
    assert_eq!(lines(&smaller).len(), 1);
}
