//! `gsscale-bench sweep`, which trains runs in child processes, and `gsscale-bench compare` of its runs.

use crate::support::bench::{number, parse};
use crate::support::browser::check_page;
use crate::support::scenes::stderr;
use crate::support::workdir::{BENCH, Running, Workdir};
use serde_json::Value;

/// A city whose views each see at most two thirds of it.
fn large_city() -> Workdir {
    Workdir::city(150, 48, 32, 8000)
}

fn names(work: &Workdir, folder: &str) -> Vec<String> {
    let entries = std::fs::read_dir(work.path(folder)).into_iter().flatten();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// The flags of a sweep into `out` on the scene with small pages; what it leaves is in `out/scene`.
fn sweep(list: &str, more: &str) -> String {
    format!("sweep {list} scene --out out --page-rows 16 --strategy none --pace-steps 0 {more}")
}

/// What a sweep that succeeds prints with `--json`: a line for each run.
fn lines(work: &Workdir, flags: &str) -> Vec<Value> {
    parse(&work.printed(BENCH, &format!("{flags} --json")))
}

fn of<'a>(records: &'a [Value], name: &str, seed: u64) -> &'a Value {
    let found = records.iter().find(|r| r["name"] == name && r["seed"] == seed);
    found.unwrap_or_else(|| panic!("{name} {seed} in {records:?}"))
}

#[test]
fn rungs_of_the_ladder_cost_less_and_less_and_end_alike() {
    let work = large_city();
    let flags = sweep("ladder", "--steps 60 --share 70 --seeds 3");
    let plain = format!("{flags} --pace-steps 20");
    let records = lines(&work, &plain);
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
    check_page(&work, "out/scene/sweep.html", &["the same, byte for byte", "seconds waiting"]);
    assert!(names(&work, "out/scene/spill").is_empty(), "scratch is removed");
    // Finished runs are not repeated. Without --json, the end is a table of them, in the order of the list.
    let table = work.printed(BENCH, &plain);
    let words: Vec<&str> =
        table.lines().filter_map(|line| line.strip_prefix("| ")?.split_whitespace().next()).collect();
    assert_eq!(words, ["run", "naive", "deferred", "planned", "overlap", "memory"], "{table}");
    assert!(table.contains(&format!(" {:.2} |", number(memory, "psnr"))) && !table.contains("DIFFER"));
    let results = "out/scene/results.jsonl";
    assert_eq!(parse(&work.text(results)), records);
    // A machine that was three times as slow during one rung: a third of its 90 seconds at the pace of the others.
    let mut paced = records.clone();
    paced.iter_mut().for_each(|rung| rung["pace"]["seconds"] = 2.0.into());
    let slow = paced.iter_mut().find(|rung| rung["name"] == "memory").unwrap();
    (slow["pace"]["seconds"], slow["seconds"]) = (6.0.into(), 90.0.into());
    work.write(results, paced.iter().map(|rung| format!("{rung}\n")).collect::<String>());
    let (converted, measured) = (work.printed(BENCH, &plain), work.printed(BENCH, &flags));
    assert!(converted.contains(" 30.0 |") && converted.contains("converted to the median pace"), "{converted}");
    assert!(measured.contains(" 90.0 |") && measured.contains("times as measured"), "{measured}");
}

#[test]
fn a_sweep_that_is_killed_goes_on_where_it_stopped() {
    let work = large_city();
    let flags = sweep("pareto", "--steps 20 --seeds 1,2 --other-seeds 2 --only optimizer,budget,sh,resolution");
    let planned = work.printed(BENCH, &format!("{flags} --list-runs")).matches("to do").count();
    assert!(planned >= 16 && !work.exists("out"), "listing runs nothing");

    // Killed in the middle of a run.
    let (results, part) = ("out/scene/results.jsonl", "out/scene/runs/base-seed9-00000000.part");
    let so_far = || std::fs::read_to_string(work.path(results)).map_or(0, |text| text.lines().count());
    Running::spawn(&work, &mut work.command(BENCH, &flags)).once(|| so_far() >= 2).kill();
    let kept = work.text(results);
    let done = kept.lines().count();
    // And as after a crash of the machine in the middle of a line.
    work.write(results, format!("{kept}{{\"key\":\"0123"));
    std::fs::create_dir_all(work.path(part).join("renders")).unwrap();

    // The holder of the lock is at work, even if only a run that outlived its sweep.
    let lock = std::fs::File::open(work.path("out/scene/sweep.lock")).unwrap();
    lock.lock().unwrap();
    work.refuses_with(BENCH, &flags, &["left behind"]);
    assert!(work.exists(part), "it may be in use");
    drop(lock);

    let after = lines(&work, &format!("{flags} --max-runs 3"));
    assert_eq!(after.len(), 3);
    let rest = lines(&work, &flags);
    assert_eq!(done + after.len() + rest.len(), planned, "nothing is lost, nothing is done twice");
    let all = work.text(results);
    assert!(all.starts_with(&kept));
    let records = parse(&all);
    let keys: std::collections::BTreeSet<&str> = records.iter().map(|r| r["key"].as_str().unwrap()).collect();
    assert_eq!(keys.len(), planned);
    assert!(records.iter().all(|r| r["problem"].is_null()), "{records:?}");
    let runs = names(&work, "out/scene/runs");
    assert!(
        runs.len() == planned && runs.iter().all(|name| !name.contains(".part")),
        "half runs are removed: {runs:?}"
    );
    assert!(lines(&work, &flags).is_empty(), "all are done");
    // In a scene with another photo, nothing is done; no time of a file counts.
    let (photo, to_do) =
        (&work.photos()[0], || work.printed(BENCH, &format!("{flags} --list-runs")).matches("to do").count());
    let before = std::fs::read(photo).unwrap();
    std::fs::write(photo, [&before[..], &[0]].concat()).unwrap();
    assert_eq!(to_do(), planned);
    std::fs::write(photo, before).unwrap();
    assert_eq!(to_do(), 0);
    let table = work.printed(BENCH, &flags);
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
    check_page(&work, "out/scene/sweep.html", &["Pareto front", "the same bits", "CPU seconds"]);
    // As the help says: all runs of the sweep on one page, the reference first.
    let folders: Vec<String> = runs.iter().map(|name| format!("out/scene/runs/{name}")).collect();
    work.printed(BENCH, &format!("compare {} --out compare.html", folders.join(" ")));
    let figure = format!("<td class=\"number\">{:.3}</td>", number(small, "psnr"));
    let marks = ["PSNR and SSIM are of evaluated.json", "trained with data-factor 2 instead of 1", "are left out"];
    check_page(&work, "compare.html", &[&marks[..], &["PSNR of training views", &figure]].concat());
    let sliders = work.text("compare.html").matches("class=\"slider\"").count();
    assert_eq!((runs[0].starts_with("base-seed1"), sliders), (true, 12));
}

#[test]
fn wrong_input_is_refused_and_a_run_that_fails_stops_nobody() {
    let work = large_city();
    let refuses = |flags: &str, words: &str| {
        work.refuses_with(BENCH, flags, &[words]);
    };
    let own = "sweep own.toml scene --out out";
    let refuses_list = |list: &str, words: &str| {
        work.write("own.toml", list);
        refuses(own, words);
    };
    for (flags, words) in [
        ("sweep pareto scene --out out --only sh,colour", "possible values"),
        ("sweep pareto scene --out out --share 100", "--share"),
        ("sweep pareto scene scene --out out", "another scene has this name"),
        ("sweep ladder /nowhere --out out", "nowhere"),
        ("sweep no-such-list scene --out out", "name one of cells, pareto"),
        ("compare scene scene --out out", "metrics.jsonl"),
    ] {
        refuses(flags, words);
    }
    let on_device = sweep("ladder-gpu", "--share 70 --device-mem 6MiB --list-runs --device");
    assert_eq!(work.printed(BENCH, &format!("{on_device} gpu")).matches("to do").count(), 6);
    refuses(&format!("{on_device} cpu"), "use --device gpu");
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
    refuses_list(&with("{ name = \"a, b\" }"), "'a, b' has a comma");
    for climbing in ["../scene", "/scene", ".."] {
        let group =
            list.replace(", RUN", "").replace("name = \"\"", &format!("name = \"{climbing}\"\ndisturb = \"nothing\""));
        refuses_list(&group, "cannot name a folder");
    }
    refuses_list(&with("{ name = \"a\", times = { optimizer = 2.0 } }"), "optimizer is no number");
    refuses_list(&with("{ name = \"a\", set = { data-factor = 0.5 } }"), "data-factor");
    let in_cells =
        with("{ name = \"a\", city = { cells = 2 } }").replace("name = \"\"", "name = \"\"\ndisturb = \"nothing\"");
    refuses_list(&in_cells, "cannot have a disturbed scene");
    refuses_list(&with("{ name = \"a\", share = 50, city = { cells = 2 } }"), "cannot have a share");
    refuses_list(
        &list.replace(", RUN", "").replace("seeds = [1]", "seeds = [1]\nshare = 50"),
        "nothing would leave memory",
    );
    assert!(!work.exists("out"), "bad input leaves nothing behind");

    // Too little memory fails the run without a drive, and no other; what cannot run is left out; equal runs run once.
    let more = "{ name = \"same\" }, { name = \"paged\", share = 70, set = { page-rows = 16 } }, { name = \"big pages\", share = 1 }";
    work.write("own.toml", with(more));
    let flags = format!("{own} --strategy none --pace-steps 0 --image-cache 1B --host-mem 1MiB --json");
    let output = work.output(BENCH, &flags);
    assert!(stderr(&output).contains("big pages is left out"), "{}", stderr(&output));
    let records = parse(&String::from_utf8(output.stdout).unwrap());
    assert!(of(&records, "plain", 1)["problem"].as_str().is_some_and(|p| p.contains("--host-mem")), "{records:?}");
    assert!(records.len() == 2 && of(&records, "paged", 1)["problem"].is_null(), "{records:?}");
    // Only failed runs are repeated.
    assert_eq!(lines(&work, &flags).len(), 1);
    let page = work.text("out/scene/sweep.html");
    assert!(page.contains("failed: ") && page.contains("--host-mem"));
}

#[test]
fn faults_of_a_capture_are_charted_and_their_scenes_are_removed() {
    let work = Workdir::city(24, 48, 32, 400);
    let only = "swapped10/none,swapped10/own,exposure1/none,exposure1/own,points10/none";
    let flags = sweep("stability", &format!("--steps 80 --seeds 1 --device cpu --only {only}"));
    let records = [lines(&work, &format!("{flags} --max-runs 2")), lines(&work, &flags)].concat();
    assert_eq!(records.len(), 6, "nothing is done twice");
    assert!(lines(&work, &flags).is_empty() && names(&work, "out/scene/scenes").is_empty(), "scenes are removed");
    let clean = of(&records, "clean/none", 1);
    let of = |name: &str| of(&records, name, 1);
    assert_ne!(clean["ply"], of("points10/none")["ply"]);
    assert!(number(of("points10/none"), "gaussians") < 0.3 * number(clean, "gaussians"));
    assert!(number(of("exposure1/none"), "psnr") < number(clean, "psnr"));
    assert_eq!(of("exposure1/own")["settings"]["appearance"], "exposure");
    assert_eq!(of("swapped10/own")["wrong_views"].as_array().unwrap().len(), 4);
    assert!(clean["cc_psnr"].is_number());
    let parts = ["PSNR, dB: lost against clean/none", "wrong views named", "exposure1/own"];
    check_page(&work, "out/scene/sweep.html", &parts);
    // Other photos are other scenes.
    assert_eq!(lines(&work, &format!("{flags} --max-resolution 40 --max-runs 1")).len(), 1);
}

#[test]
fn cities_in_cells_are_compared_with_the_reference_at_their_borders() {
    let work = Workdir::wide_city(3000);
    let city = |name: &str, keys: &str| format!("{{ name = \"{name}\", city = {{ cells = {keys} }} }}");
    work.write(
        "cells.toml",
        format!(
            "seeds = [1]\n[base]\nsteps = 120\nmax-gaussians = 4000\npage-rows = 32\nview-order = \"shuffle\"\n\
             [view]\ntitle = \"cells\"\nreference = \"one run\"\nfigures = [\"psnr\", \"band-loss\", \"trained-gaussians\"]\n\
             charts = [{{ figure = \"band-loss\" }}]\n[[group]]\nname = \"\"\n\
             runs = [{{ name = \"one run\" }}, {}, {}]\n",
            city("two", "2"),
            city("wide", "2, margin = 1.0, view-share = 0.05")
        ),
    );
    let flags = "sweep cells.toml scene --out out --device cpu --pace-steps 0";
    let records = lines(&work, flags);
    let [whole, two, wide] = ["one run", "two", "wide"].map(|name| of(&records, name, 1));
    assert!(records.len() == 3 && records.iter().all(|record| record["problem"].is_null()), "{records:?}");
    for city in [two, wide] {
        assert!(number(city, "border_loss").is_finite() && number(city, "band_loss").is_finite());
        assert!(number(city, "trained_gaussians") > number(city, "gaussians"), "margins are dropped at the merge");
    }
    assert!(number(wide, "trained_gaussians") > number(two, "trained_gaussians") && two["ply"] != wide["ply"]);
    // Cells derive their growth from their own steps.
    assert!(number(two, "gaussians") > 0.8 * number(whole, "gaussians"), "{two} {whole}");
    assert!(whole["band_loss"].is_null() && number(whole, "gaussians") > 1000.0);
    assert!(names(&work, "out/scene/runs").iter().all(|name| !name.contains(".part")), "cities are removed");
    check_page(&work, "out/scene/sweep.html", &["lost in bands along borders, dB", "wide", "two"]);
    assert!(lines(&work, flags).is_empty(), "all are done");
    // Without the PLY of the reference no other city could be compared.
    let reference = names(&work, "out/scene/runs").into_iter().find(|name| name.starts_with("one-run")).unwrap();
    std::fs::remove_file(work.path(&format!("out/scene/runs/{reference}/point_cloud.ply"))).unwrap();
    assert_eq!(lines(&work, flags)[0]["name"], "one run");
}
