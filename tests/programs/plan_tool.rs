//! `gsscale-plan` through its binary: sums that agree, exact lists, and refusals with a remedy.

use crate::support::scenes::{stderr, stdout, told};
use crate::support::workdir::{TRAIN, Workdir};
use serde_json::Value;

const PLAN: &str = env!("CARGO_BIN_EXE_gsscale-plan");

fn plan(work: &Workdir, flags: &str) -> String {
    work.printed(PLAN, &format!("scene {flags}"))
}

fn json(work: &Workdir, flags: &str) -> Value {
    work.json_of(PLAN, &format!("scene {flags} --json"))
}

fn refuses(work: &Workdir, flags: &str, words: &[&str]) {
    let output = work.output(PLAN, flags);
    let said = stderr(&output);
    assert!(!output.status.success() && words.iter().all(|word| said.contains(word)), "{flags}: {said}");
}

#[test]
fn a_scene_is_planned_for_several_memories_and_orders() {
    let work = Workdir::city(300, 32, 24, 8000);
    let common = "--page-rows 32 --steps 1000 --test-every 0";
    let orders = "--compare-orders auto,shuffle,groups:4,tour";
    let value = json(&work, &format!("{common} --compare-frames 70%,100% {orders}"));
    let plans = value["plans"].as_array().unwrap();
    assert_eq!((plans.len(), value["views"].as_u64().unwrap()), (8, 300));
    let number = |plan: &Value, key: &str| plan[key].as_f64().unwrap();
    for plan in &plans[..4] {
        assert!(number(plan, "hit_rate") >= number(plan, "lru_hit_rate") && plan["is_belady_bound"] == true);
        // The import writes each page; beyond that, every read evicts a page.
        assert!(number(plan, "bytes_written") >= number(&value, "state_bytes"));
        assert!(number(plan, "bytes_read") > 0.0);
        // The endurance of a common drive: 300 TB.
        let share = number(plan, "bytes_written") / 300e12;
        assert!((number(plan, "share_of_endurance") / share - 1.0).abs() < 1e-9, "{plan}");
    }
    assert!(number(&plans[1], "hit_rate") < number(&plans[3], "hit_rate"), "a tour reads less than a shuffle");
    // If everything fits, nothing is read again, and auto chooses a shuffle.
    assert!(
        plans[4..].iter().all(|plan| number(plan, "hit_rate") == 1.0 && number(plan, "stall_seconds_worst") == 0.0)
    );
    assert_eq!(plans[4]["view_order"], "shuffle");
    let table = plan(&work, &format!("{common} --compare-frames 70% {orders}"));
    assert!(table.lines().nth(2).unwrap().contains("hit rate    of lru"), "{table}");
    assert!(table.lines().nth(3 + 4).unwrap().starts_with("*  "), "{table}");
    for (plan, line) in plans[..4].iter().zip(table.lines().skip(3)) {
        let shown = format!(" {:.3} {:9.3} ", number(plan, "hit_rate"), number(plan, "lru_hit_rate"));
        assert!(line.contains(&shown), "{shown} is not in: {table}");
    }
    // Another eviction order is planned as it evicts.
    let lru = &json(&work, &format!("{common} --compare-frames 70% --view-order shuffle --evict lru"))["plans"][0];
    assert_eq!(lru["hit_rate"], lru["lru_hit_rate"], "{lru}");
    assert!(lru["is_belady_bound"] == false && number(lru, "hit_rate") == number(&plans[1], "lru_hit_rate"), "{lru}");
    assert!(number(lru, "bytes_read") > number(&plans[1], "bytes_read"), "{lru}");
    // Default shares hold the largest view.
    let open = json(&work, &format!("{common} --view-order shuffle"));
    let frames = |value: &Value| -> Vec<u64> {
        value["plans"].as_array().unwrap().iter().map(|plan| plan["frames"].as_u64().unwrap()).collect()
    };
    let (most, pages) = (open["pages_of_largest_view"].as_u64().unwrap(), open["pages"].as_u64().unwrap());
    assert!(most > pages / 2 && frames(&open) == [most, pages], "{open}");
    // The exact lists of two steps: evicted pages make room for admitted pages.
    let lists = plan(&work, &format!("{common} --compare-frames 70% --view-order shuffle --lists 700..740"));
    let lines: Vec<&str> = lists.lines().collect();
    assert!(lines[0].starts_with("step 700: ") && lines.iter().any(|line| line.starts_with("step 701: ")), "{lists}");
    let count = |sign: &str| lines.iter().filter_map(|l| l.strip_prefix(sign)).flat_map(str::split_whitespace).count();
    assert!(count("  + ") > 0 && count("  + ") == count("  - "), "{lists}");
}

#[test]
fn pages_on_a_device_are_planned_over_a_bus() {
    let work = Workdir::city(100, 32, 24, 8000);
    let common = "--page-rows 32 --steps 400 --test-every 0 --step-seconds 0.003 --view-order shuffle --compare-frames 100% --bus 1GB/s,10us";
    let of = |more: &str| json(&work, &format!("{common} {more}"));
    let number = |value: &Value, key: &str| value["device"][0][key].as_f64().unwrap();
    let all = of("");
    // Ten copies and the bytes of photo and tables.
    assert_eq!(all["device"][0]["slots"], all["pages"]);
    assert!(number(&all, "hit_rate") == 1.0 && number(&all, "payloads_up_ms") == 0.0, "{all}");
    assert!((number(&all, "photo_ms") - (5.0 * 0.01 + (4.0 * 32.0 * 24.0 + 50e3) / 1e6)).abs() < 1e-9, "{all}");
    let parts =
        |value: &Value| ["photo_ms", "results_ms", "payloads_up_ms", "payloads_down_ms"].map(|key| number(value, key));
    let [photo, results, ..] = parts(&all);
    assert!((number(&all, "step_ms") - (photo + results + 3.0)).abs() < 1e-9, "{all}");
    let few = of("--device-mem 6MiB");
    let [photo, results, up, down] = parts(&few);
    assert!(
        few["device"][0]["slots"].as_u64() < few["pages"].as_u64() && number(&few, "bytes_up_per_step") > 0.0,
        "{few}"
    );
    let bytes = [number(&few, "bytes_up_per_step"), number(&few, "bytes_down_per_step")];
    assert!(up > bytes[0] / 1e6 && down > bytes[1] / 1e6 && up < 2.0 * bytes[0] / 1e6, "{few}");
    assert!((number(&few, "step_ms") - (photo + results + f64::max(3.0, up + down))).abs() < 1e-9, "{few}");
    assert!((number(&few, "step_in_turn_ms") - (photo + results + 3.0 + up + down)).abs() < 1e-9, "{few}");
    let fewest = number(&few, "fewest_bytes_up_per_step");
    assert!(fewest > 0.0 && fewest <= bytes[0], "{few}");
    let table = plan(&work, &format!("{common} --device-mem 6MiB"));
    assert!(table.contains("pages on the device, modelled: a bus of"), "{table}");
    refuses(&work, &format!("scene {common} --bus fast"), &["12GB/s,20us"]);
    refuses(&work, &format!("scene {common} --device-mem 1KiB"), &["--device-mem"]);
}

#[test]
fn a_run_folder_knows_its_scene_and_too_little_memory_is_refused() {
    let work = Workdir::city(12, 64, 48, 800);
    std::fs::create_dir(work.path("run")).unwrap();
    work.write("run/config.toml", "steps = 77\n[resolved]\nscene = \"scene\"\n");
    let output = work.output(PLAN, "run --page-rows 16 --compare-frames 100%");
    assert!(told(&output).contains("of all 77 steps"), "{}", told(&output));
    // Everything fits, so auto is shuffle, and one row says both.
    assert_eq!(stdout(&output).lines().filter(|line| line.starts_with("shuffle")).count(), 1, "{}", stdout(&output));
    // Given frames need no given memory.
    for named in ["--frames 80", "--compare-frames 100%"] {
        plan(&work, &format!("--page-rows 16 --host-mem 1MiB {named}"));
    }
    for (flags, words) in [
        ("--compare-frames many", ["'many'", "25%"]),
        ("--compare-orders random", ["'random'", "groups:N"]),
        ("--drive-read 0", ["--drive-read", "above 0"]),
        ("--endurance 0", ["--endurance", "above 0"]),
        ("--growth 1e30", ["--growth: 1", "use 1 to 1000000"]),
        ("--lists 5..5", ["5..5", "100..110"]),
        ("--step-seconds nan", ["--step-seconds", "use 0 to 1000000"]),
        ("--optimizer dense", ["every page at every step", "deferred"]),
    ] {
        refuses(&work, &format!("run {flags}"), &words);
    }
}

/// The plan equals the run: frames for a budget, bytes read, bytes written.
#[test]
fn a_run_does_what_was_planned() {
    let work = Workdir::city(150, 96, 64, 8000);
    let common = "--page-rows 16 --test-every 0 --strategy none --steps 450 --sh-start 3 --means-lr 1e-9 --scales-lr 1e-9 \
        --view-order groups:9 --prefetch-bytes 1MiB --device cpu";
    let drive = "--spill-dir spill --commit-every 0 --host-mem 45MiB";
    let said = work.train(&format!("scene --out out {common} {drive}"));
    let done = work.summary("out");
    let within = json(&work, &format!("{common} --host-mem 45MiB"));
    assert!(within["pages"] == done["pages"] && within["gaussians"] == done["gaussians"], "{within} {done}");
    let number = |value: &Value| value.as_f64().unwrap();
    let near = |what: &str, planned: &Value, real: f64, tolerance: f64| {
        let off = (number(planned) / real - 1.0).abs();
        assert!(off <= tolerance, "{what}: {planned} planned, {real} in the run, {:.1} % off", 100.0 * off);
    };
    // Threads take their buffers in another order.
    near("frames", &within["plans"][0]["frames"], number(&done["frames"]), 0.02);
    assert!(number(&done["frames"]) < 0.9 * number(&done["pages"]), "everything fits: {done}");
    let plan = json(&work, &format!("{common} --frames {}", done["frames"]));
    // The plan knows all views and assumes that pages stay in place, which nearly holds for these Gaussians.
    let plan = &plan["plans"][0];
    near("the bound", &plan["bytes_read"], number(&done["belady_bytes_read"]), 0.01);
    let read = number(&done["bytes_read"]) - number(&done["other_bytes_read"]);
    near("bytes read", &plan["bytes_read"], read, 0.05);
    // The plan counts every seen page as changed; pages whose rows have no gradient need not be written.
    let (most, written) =
        (number(&plan["bytes_written"]), number(&done["bytes_written"]) - number(&done["commit_bytes"]));
    assert!(written <= most && most <= 1.6 * written, "{most} bytes to be written at most, {written} were");
    // The run prints the same before its first step.
    let told = told_to_be_written(&said);
    assert!((told / most - 1.0).abs() < 0.1, "{told} told by the run, {most} by the plan");
}

/// Bytes that a run announces to write.
fn told_to_be_written(said: &str) -> f64 {
    let line = said.lines().find(|line| line.contains(" to write without commits")).unwrap();
    let text = line.split(" to write without commits").next().and_then(|rest| rest.rsplit("about ").next());
    let (number, unit) = text.and_then(|text| text.split_once(' ')).expect(line);
    let power = ["B", "KiB", "MiB", "GiB", "TiB"].iter().position(|u| *u == unit).expect(line);
    number.parse::<f64>().expect(line) * 1024f64.powi(power as i32)
}

/// The drive wear that a run announces is its bytes to be written over the endurance of a common drive.
#[test]
fn a_run_says_what_it_takes_of_the_life_of_a_drive() {
    let work = Workdir::city(150, 96, 64, 8000);
    let drive = "--page-rows 16 --frames 330 --view-order shuffle --strategy none --spill-dir spill";
    // Enough steps for some 900 GiB.
    let output = work.succeeds(TRAIN, &format!("scene --dry-run --steps 2000000 {drive}"));
    // Long lines are folded.
    let said = told(&output).replace("\n        ", " ");
    let told =
        said.split("without commits, ").nth(1).and_then(|rest| rest.split(" % of the rated").next()).expect(&said);
    let share = told.parse::<f64>().expect(&said) / 100.0;
    let expected = told_to_be_written(&said) / 300e12;
    // Both are rounded for people: the share to a hundredth of a percent, the bytes to three digits.
    assert!(expected > 0.002 && (share - expected).abs() < 0.00005 + 0.005 * expected, "{share}, {expected}: {said}");
}

#[test]
fn the_drive_of_the_pages_is_measured_unless_its_rates_are_named() {
    let work = Workdir::city(12, 64, 48, 800);
    let rates = |more: &str| {
        let value = json(&work, &format!("--page-rows 16 --compare-frames 100% {more}"));
        ["drive_read_bytes_per_second", "drive_write_bytes_per_second"].map(|key| value[key].as_f64().unwrap())
    };
    assert_eq!(rates(""), [3e9, 2e9]);
    assert_eq!(rates("--drive-read 5GB --drive-write 4GB --spill-dir spill"), [5e9, 4e9]);
    let [read, write] = rates("--drive-read 5GB --spill-dir spill");
    assert!(read == 5e9 && write > 1e6 && write != 2e9, "{write} bytes a second");
    let left: Vec<_> = work.path("").read_dir().unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left, ["scene"], "a plan leaves no file");
}

#[test]
fn a_scene_larger_than_memory_is_planned_within_it() {
    let (work, bytes) = (Workdir::wide_city(200_000), 100 << 20);
    let flags =
        "--host-mem 100MiB --page-rows 128 --image-cache 4MiB --prefetch-bytes 1MiB --device cpu --plan-mem 16MiB";
    let value = json(&work, flags);
    assert!(value["gaussians"].as_u64() > Some(190_000) && value["state_bytes"].as_u64() > Some(bytes), "{value}");
    assert!(value["host_bytes_peak"].as_u64() <= Some(bytes), "{value}");
    assert!(value["step_timed_on"].is_string(), "a view of middling size fits: {value}");
    let (plan, pages) = (&value["plans"][0], value["pages"].as_u64());
    assert!(plan["frames"].as_u64() < pages && plan["frames"].as_u64() > value["pages_of_largest_view"].as_u64());
}

/// Step times are measured on the device of the run unless given; steps plus stalls make the time of the run.
#[test]
fn the_time_of_a_run_is_that_of_its_steps_and_what_they_wait() {
    let work = Workdir::city(300, 32, 24, 8000);
    let common =
        "--page-rows 32 --test-every 0 --compare-frames 70% --view-order shuffle --device cpu --drive-write 100MB";
    let planned = |more: &str| json(&work, &format!("{common} {more}"));
    let number = |value: &Value| value.as_f64().unwrap();
    let timed = planned("--steps 1000");
    assert!(number(&timed["step_seconds"]) > 1e-6 && timed["step_timed_on"] == "cpu", "{timed}");
    // As many steps as the simulation plays one by one, and many more, which repeat the later ones.
    for steps in [1200.0, 24_000.0] {
        let of = |rate: &str| planned(&format!("--steps {steps} --step-seconds 0.002 --drive-read {rate}"));
        let (slow, fast) = (of("1MB"), of("1000GB"));
        assert!(slow["step_seconds"] == 0.002 && slow["step_timed_on"].is_null(), "{slow}");
        let [slow, fast] = [&slow, &fast].map(|value| &value["plans"][0]);
        // Reading takes far longer than computing: the run takes as long as its reads and writes.
        let moved = number(&slow["bytes_read"]) / 1e6 + (number(&slow["bytes_written"])) / 100e6;
        let seconds = number(&slow["seconds"]);
        assert!((seconds / moved - 1.0).abs() < 0.05, "{seconds} s to move {slow} in {moved} s");
        assert!(number(&fast["seconds"]) >= 0.002 * steps && number(&fast["seconds"]) < 0.1 * seconds, "{fast}");
    }
    // With all pages in memory no step waits, not even the first.
    let all = planned("--steps 30 --step-seconds 0.5 --compare-frames 70%,100%");
    assert_eq!(number(&all["plans"][1]["seconds"]), 15.0, "{all}");
    let table = plan(&work, &format!("{common} --steps 100 --step-seconds 72"));
    assert!(table.contains("2.0 h") && table.contains("steps of 72.0000 s"), "{table}");
}
