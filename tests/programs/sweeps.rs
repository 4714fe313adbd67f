//! `gsscale-bench` commands that train runs in child processes: ladder, sweep and compare.

use crate::support::bench::{bench, large_city, lines, number, parse};
use crate::support::browser::in_a_browser;
use crate::support::gpu;
use crate::support::scenes::{stderr, text};
use gsscale::gpu::GpuOptions;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Stdio};
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

#[test]
fn rungs_of_the_ladder_cost_less_and_less_and_end_alike() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let out = folder.path().join("ladder");
    let sizes = ["--steps", "60", "--page-rows", "16", "--strategy", "none", "--share", "70", "--seed", "3"];
    let command = [&["ladder", text(&scene), "--out", text(&out)][..], &sizes].concat();
    let plain = [&command[..], &["--pace-steps", "20"]].concat();
    let args = [&plain[..], &["--json"]].concat();
    let rungs = lines(&args);
    let labels: Vec<&str> = rungs.iter().map(|r| r["label"].as_str().unwrap()).collect();
    assert_eq!(labels, ["naive", "deferred", "planned", "overlap", "memory"]);
    let [naive, deferred, planned, overlap, memory] = &rungs[..] else { panic!("{rungs:?}") };
    for rung in [deferred, planned, overlap] {
        assert_eq!(rung["ply"], memory["ply"], "{} is not exact", rung["label"]);
    }
    assert_ne!(naive["ply"], memory["ply"], "dense updates round more often");
    // 60 steps amplify roundings of 1e-7 to a few thousandths of a decibel at most.
    assert!((number(naive, "psnr") - number(memory, "psnr")).abs() < 0.05);
    // A cache smaller than the scene keeps nothing if every step visits all pages in the same order.
    let pages = number(naive, "pages");
    let frames = number(naive, "frames");
    assert!(frames < pages && number(deferred, "frames") == frames);
    assert!(number(naive, "bytes_read") > 60.0 * (pages - frames) * 16.0 * 200.0);
    assert!(number(naive, "bytes_read") > 2.0 * number(deferred, "bytes_read"));
    assert!(number(planned, "bytes_read") < number(deferred, "bytes_read"), "Belady reads less than LRU");
    assert!(number(memory, "bytes_read") == 0.0 && number(overlap, "drive_bytes_peak") > 0.0);
    assert!(rungs.iter().all(|r| number(r, "cpu_seconds") > 0.0 && number(r, "host_bytes_peak") > 1e6));
    assert!(rungs.iter().all(|r| number(&r["pace"], "seconds") > 0.0), "the pace of the machine at each rung");
    check_page(&out.join("ladder.html"), &["the same, byte for byte"], folder.path());
    assert!(names(&out.join("spill")).is_empty(), "scratch is removed");
    // Finished runs are not repeated.
    assert_eq!(lines(&args), rungs);
    // Without --json, the end is a table of them.
    let table = String::from_utf8(bench(&plain).stdout).unwrap();
    let words: Vec<&str> = table.lines().filter_map(|line| line.split_whitespace().next()).collect();
    assert_eq!(words, ["rung", "naive", "deferred", "planned", "overlap", "memory"], "{table}");
    assert!(table.contains(&format!("{:.2}", number(memory, "psnr"))), "{table}");
    let results = out.join("ladder.jsonl");
    assert_eq!(parse(&std::fs::read_to_string(&results).unwrap()), rungs);
    // A machine that was three times as slow during the last rung: a third of its 90 seconds at the pace of the others.
    let mut paced = rungs.clone();
    paced.iter_mut().for_each(|rung| rung["pace"]["seconds"] = 2.0.into());
    (paced[4]["pace"]["seconds"], paced[4]["seconds"]) = (6.0.into(), 90.0.into());
    let text_of = |rungs: &[Value]| rungs.iter().map(|rung| format!("{rung}\n")).collect::<String>();
    std::fs::write(&results, text_of(&paced)).unwrap();
    let seconds_in_memory = |pace_steps: &str| {
        let output = bench(&[&command[..], &["--pace-steps", pace_steps]].concat());
        let table = String::from_utf8(output.stdout).unwrap();
        let line = table.lines().find(|line| line.starts_with("memory")).unwrap();
        let seconds = line.split_whitespace().nth(1).unwrap().to_string();
        (seconds, String::from_utf8(output.stderr).unwrap())
    };
    let (seconds, said) = seconds_in_memory("20");
    assert!(seconds == "30.0" && said.contains("converted to the median pace"), "{seconds} {said}");
    let (seconds, said) = seconds_in_memory("0");
    assert!(seconds == "90.0" && said.contains("times as measured"), "{seconds} {said}");
    paced[0]["pace"]["key"] = "another".into();
    std::fs::write(&results, text_of(&paced)).unwrap();
    let (seconds, said) = seconds_in_memory("20");
    assert!(seconds == "90.0" && said.contains("times as measured"), "{seconds} {said}");
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
    let args = ["--steps", "30", "--page-rows", "16", "--strategy", "none", "--share", "70", "--device-mem", "6MiB"];
    let more =
        ["--pace-steps", "0", "--rungs", "overlap,memory,pages,ahead,split,resident", "--device", "gpu", "--json"];
    let rungs = lines(&[&["ladder", text(&scene), "--out", text(&out)][..], &args, &more].concat());
    let [overlap, memory, pages, ahead, split, resident] = &rungs[..] else { panic!("{rungs:?}") };
    assert!(
        overlap["ply"] == memory["ply"] && [ahead, split, resident].iter().all(|r| r["ply"] == pages["ply"]),
        "{rungs:?}"
    );
    assert!(rungs.iter().all(|r| r["pace"].is_null()), "no pace was wanted");
    assert!(number(split, "device_bytes_peak") <= 3.0 * 1048576.0, "{split}");
    assert_ne!(memory["ply"], pages["ply"], "the device rounds as the host does");
    assert!((number(pages, "psnr") - number(memory, "psnr")).abs() < 0.1, "{rungs:?}");
    assert!(number(pages, "device_bytes_peak") < number(resident, "device_bytes_peak"), "{rungs:?}");
    let words =
        ["The results of overlap, memory are the same", "The results of pages, ahead, split, resident are the same"];
    check_page(&out.join("ladder.html"), &words, folder.path());
    let of_none = [&["ladder", text(&scene), "--out", text(&out)][..], &args[..args.len() - 2], &["--rungs", "split"]];
    let output = bench(&of_none.concat());
    assert!(!output.status.success() && stderr(&output).contains("name --device-mem"), "{}", stderr(&output));
    let on_cpu = [&["ladder", text(&scene), "--out", text(&out)][..], &args, &["--rungs", "pages", "--device", "cpu"]];
    let output = bench(&on_cpu.concat());
    assert!(!output.status.success() && stderr(&output).contains("use --device auto or gpu"), "{}", stderr(&output));
}

fn sweep<'a>(scene: &'a Path, out: &'a Path) -> Vec<&'a str> {
    let sizes = ["--steps", "20", "--page-rows", "16", "--strategy", "none", "--seeds", "1,2", "--setting-seeds", "2"];
    let knobs = ["--pace-steps", "20", "--knobs", "optimizer,budget,sh,resolution", "--json"];
    [&["pareto", text(scene), "--out", text(out)][..], &sizes, &knobs].concat()
}

#[test]
fn a_sweep_that_is_killed_goes_on_where_it_stopped() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let out = folder.path().join("sweep");
    let args = sweep(&scene, &out);
    let listed = bench(&[&args[..], &["--list"]].concat());
    let planned = String::from_utf8_lossy(&listed.stdout).lines().filter(|l| l.contains("to do")).count();
    assert!(planned >= 16 && !out.exists(), "listing runs nothing");

    // Killed in the middle of a run.
    let program = env!("CARGO_BIN_EXE_gsscale-bench");
    let mut killed = Command::new(program).args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
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
    std::fs::create_dir_all(out.join("runs/base-base-seed9-00000000.part/renders")).unwrap();

    // The holder of the lock is at work, even if only a run that outlived its sweep.
    let lock = std::fs::File::open(out.join("sweep.lock")).unwrap();
    lock.lock().unwrap();
    let refused = bench(&args);
    assert!(!refused.status.success() && stderr(&refused).contains("left behind"), "{}", stderr(&refused));
    assert!(out.join("runs/base-base-seed9-00000000.part").is_dir(), "it may be in use");
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
    check_sweep(&records, &out, folder.path());
    assert!(lines(&args).is_empty(), "all are done");
    let plain: Vec<&str> = args.iter().copied().filter(|arg| *arg != "--json").collect();
    let table = String::from_utf8(bench(&plain).stdout).unwrap();
    assert!(table.starts_with("knob ") && table.contains("the same bits") && !table.contains('{'), "{table}");
}

/// Checks the figures that follow from the knobs, and the page.
fn check_sweep(records: &[Value], out: &Path, scratch: &Path) {
    let of = |knob: &str, label: &str, seed: u64| -> &Value {
        let found = records.iter().find(|r| r["knob"] == knob && r["label"] == label && r["seed"] == seed);
        found.unwrap_or_else(|| panic!("{knob} {label} {seed}"))
    };
    let base = of("base", "base", 1);
    assert_ne!(base["ply"], of("base", "base", 2)["ply"], "seeds matter");
    let paged = records.iter().find(|r| r["knob"] == "budget" && r["seed"] == 1).unwrap();
    assert_eq!(paged["ply"], base["ply"], "a budget changes no bit");
    assert!(number(paged, "bytes_read") > 0.0 && number(base, "bytes_read") == 0.0);
    let sparse = of("optimizer", "sparse", 1);
    assert_ne!(sparse["ply"], base["ply"]);
    assert_eq!(sparse["settings"]["optimizer"], "sparse");
    assert!(records.iter().all(|r| number(&r["pace"], "seconds") > 0.0), "the pace of the machine at each run");
    // Quality is measured on the photos of the base: half of the resolution is worse there, and would be better on its
    // own photos.
    let small = of("resolution", "1/2", 1);
    assert!(number(small, "psnr") < number(base, "psnr"), "{small} {base}");
    let parts = ["Pareto front", "the same bits", "mean of the base less its spread", "CPU seconds"];
    check_page(&out.join("pareto.html"), &parts, scratch);
    let names = names(&out.join("runs"));
    // As the help says: all runs of the sweep, the base first.
    let folders: Vec<_> = names.iter().map(|name| out.join("runs").join(name)).collect();
    let folders: Vec<&str> = folders.iter().map(|folder| text(folder)).collect();
    let page = out.join("compare.html");
    let compared = bench(&[&["compare"][..], &folders[..], &["--out", text(&page)]].concat());
    assert!(compared.status.success(), "{}", stderr(&compared));
    let figure = format!("<td class=\"number\">{:.3}</td>", number(small, "psnr"));
    let marks = ["PSNR and SSIM are of evaluated.json", "trained with data-factor 2 instead of 1", "are left out"];
    check_page(&page, &[&marks[..], &["PSNR of training views", figure.as_str()]].concat(), scratch);
    let sliders = std::fs::read_to_string(&page).unwrap().matches("class=\"slider\"").count();
    assert_eq!((names[0].starts_with("base-base-seed1"), sliders), (true, 12));
}

#[test]
fn wrong_input_is_refused_and_a_run_that_fails_stops_nobody() {
    let folder = TempDir::new().unwrap();
    let scene = large_city(folder.path());
    let out = folder.path().join("out");
    let (scene, out) = (text(&scene), text(&out));
    let refuses = |args: &[&str], words: &str| {
        let output = bench(args);
        assert_eq!(output.status.code(), Some(1));
        assert!(stderr(&output).contains(words) && stderr(&output).contains("remedy"), "{}", stderr(&output));
    };
    let is_usage = |args: &[&str], word: &str| {
        let output = bench(args);
        assert_eq!(output.status.code(), Some(2));
        assert!(stderr(&output).contains(word) && stderr(&output).contains("possible values"), "{}", stderr(&output));
    };
    is_usage(&["pareto", scene, "--out", out, "--knobs", "sh,colour"], "colour");
    is_usage(&["ladder", scene, "--out", out, "--rungs", "gpu"], "gpu");
    refuses(&["pareto", scene, "--out", out, "--share", "1"], "--share");
    refuses(&["ladder", "/nowhere", "--out", out], "nowhere");
    refuses(&["compare", scene, scene, "--out", out], "metrics.jsonl");
    assert!(!Path::new(out).exists(), "bad input leaves nothing behind");
    refuses(&["ladder", scene, "--out", out], "nothing would leave memory");
    refuses(&[scene, "--spill-dir", out], "--spill-dir");
    refuses(&[scene, "--steps", "1", "--device", "gpu"], "--device");
    assert!(!Path::new(out).exists(), "nor does a flag that means nothing here");

    // The drive is unusable: the rungs that need it fail with a reason, the one in memory runs.
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let output = bench(&["ladder", scene, "--out", out, "--steps", "4", "--page-rows", "16", "--spill", text(&file)]);
    assert!(!output.status.success() && stderr(&output).contains("file"), "{}", stderr(&output));
    let failing = ["--steps", "4", "--image-cache", "1B", "--host-mem", "1MiB", "--knobs", "budget", "--seeds", "1"];
    let args =
        [&["pareto", scene, "--out", out, "--page-rows", "16", "--strategy", "none", "--json"][..], &failing].concat();
    let records = lines(&args);
    assert!(records[0]["problem"].as_str().is_some_and(|p| p.contains("--host-mem")), "{records:?}");
    assert!(records[1..].iter().all(|r| r["problem"].is_null()) && records.len() > 1, "{records:?}");
    // Only failed runs are repeated.
    assert_eq!(lines(&args).len(), 1);
    let page = std::fs::read_to_string(Path::new(out).join("pareto.html")).unwrap();
    assert!(page.contains("Runs that failed") && page.contains("--host-mem"));
}

#[test]
fn faults_of_a_capture_are_charted_and_a_call_that_stopped_goes_on() {
    let folder = TempDir::new().unwrap();
    let scene = crate::support::scenes::city(folder.path(), 24, 48, 32, 400);
    let out = folder.path().join("stability");
    let sizes = ["--steps", "80", "--seeds", "1,2", "--device", "cpu", "--strategy", "none"];
    let only = ["--only", "swapped10,exposure1,points10", "--remedies", "none,own"];
    let plain = [&["stability", text(&scene), "--out", text(&out)][..], &sizes, &only].concat();
    let json = [&plain[..], &["--json"]].concat();
    let listed = String::from_utf8(bench(&[&plain[..], &["--list"]].concat()).stdout).unwrap();
    // The clean scene has no remedy of its own.
    assert!(listed.matches("to do").count() == 14 && !out.exists(), "{listed}");
    let first = lines(&[&json[..], &["--max-runs", "5"]].concat());
    let rest = lines(&json);
    assert_eq!((first.len(), rest.len()), (5, 9), "nothing is done twice");
    assert!(lines(&json).is_empty() && names(&out.join("scenes")).is_empty(), "scenes are removed");
    let of = |knob: &str, label: &str, seed: u64| -> Value {
        let found = first.iter().chain(&rest).find(|r| r["knob"] == knob && r["label"] == label && r["seed"] == seed);
        found.unwrap_or_else(|| panic!("{knob} {label} {seed}")).clone()
    };
    assert_ne!(of("clean", "none", 1)["ply"], of("points10", "none", 1)["ply"]);
    assert!(number(&of("points10", "none", 1), "gaussians") < 0.3 * number(&of("clean", "none", 1), "gaussians"));
    assert!(number(&of("exposure1", "none", 1), "psnr") < number(&of("clean", "none", 1), "psnr"));
    assert_eq!(of("exposure1", "own", 1)["settings"]["appearance"], "exposure");
    assert_eq!(of("swapped10", "own", 2)["wrong_views"].as_array().unwrap().len(), 4);
    assert!(of("clean", "none", 1)["cc_psnr"].is_number());
    let table = String::from_utf8(bench(&plain).stdout).unwrap();
    assert!(table.starts_with("disturbance ") && table.contains("spread of the clean scene"), "{table}");
    assert!(table.lines().all(|line| line.chars().count() <= 80), "{table}");
    let parts = ["PSNR lost, dB", "wrong views named", "exposure1"];
    check_page(&out.join("stability.html"), &parts, folder.path());
    // Other photos are other scenes.
    let smaller = [&json[..], &["--max-resolution", "40", "--max-runs", "1"]].concat();
    assert_eq!(lines(&smaller).len(), 1);
    let output = bench(&["stability", text(&scene), "--out", text(&out), "--only", "fog"]);
    assert!(output.status.code() == Some(2) && stderr(&output).contains("possible values"), "{}", stderr(&output));
}
