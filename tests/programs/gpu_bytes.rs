//! Bytes that go up to a device that holds a part of the pages (`--optimizer-on device`), through the real binary: in every step hardly
//! more than any order of eviction needs, at most two payloads for each page of a step that is taken again, and
//! none for a round of densification that only clears statistics.

use super::gpu_flights::{Bench, same};
use gsscale::scene::page_layout::capacity_bytes;
use std::fmt::Write;

/// No events: a payload goes up only because the device lacks it.
const STEADY: &str = "--strategy none --sh-every 0";
/// Upper bound on what a step takes up beside payloads: its photo, as often as the step is taken, and tables, lists and uniforms.
const OTHERS: u64 = 3 * 4 * 48 * 36 + (128 << 10);

/// Payload bytes that went up to the end of each step, and the fewest of any order of eviction.
fn loaded(bench: &Bench, name: &str) -> Vec<[u64; 2]> {
    let [loaded, fewest] = ["bytes_loaded", "bytes_loaded_fewest"].map(|key| bench.slots(name, key));
    loaded.into_iter().zip(fewest).map(|(loaded, fewest)| [loaded, fewest]).collect()
}

/// The most bytes that steps which were given up may cost: two payloads for each of their pages. With their number.
fn replays(bench: &Bench, name: &str) -> (usize, u64) {
    let spans = bench.spans(name);
    let pages_of = |step: u64| {
        let recorded = spans.iter().filter(|s| s.name == "record step" && s.args["recorded"].as_u64() == Some(step));
        recorded.filter_map(|s| s.args["pages"].as_u64()).max().unwrap()
    };
    // Those that were not taken, and those behind them.
    let given_up = spans.iter().filter(|s| s.name == "give up");
    let steps = given_up.map(|s| s.step()..=s.step() + s.args["behind"].as_u64().unwrap());
    let pages: Vec<u64> = steps.map(|steps| steps.map(pages_of).sum()).collect();
    (pages.len(), 2 * pages.iter().sum::<u64>() * capacity_bytes(32, 3) as u64)
}

/// Checks the payloads of a run step by step, and returns the last line of its metrics.
fn hardly_more_than_the_fewest(bench: &Bench, name: &str, in_flight: &str, more: &str) -> serde_json::Value {
    assert!(bench.run(name, in_flight, "", more));
    let (steps, last) = (loaded(bench, name), bench.metrics(name).pop().unwrap());
    let (slots, pages) = (&last["slots"], last["pages"].as_u64().unwrap());
    println!("{more}, {in_flight} in flight: {slots}");
    assert!(slots["slots"].as_u64().unwrap() < pages && slots["loads"].as_u64().unwrap() > 2 * pages, "{slots}");
    let replayed = bench.spans(name).iter().filter(|s| s.name == "give up" && s.args["behind"] != 0).count();
    assert_eq!(replayed, 0, "steps were taken again with another one behind them, which costs payloads");
    for (step, [all, _]) in steps.iter().enumerate() {
        // When a step ends, the payloads of two more may have gone up.
        let [_, fewest] = steps[(step + 2).min(steps.len() - 1)];
        assert!(*all as f64 <= 1.02 * fewest as f64, "{name} step {step}: {all} bytes of at least {fewest}");
    }
    last
}

/// Slots for a view, for two views and for more; with steps in flight and without; and with growth, removal, opacity resets and raises of
/// the SH degree. A reset and a raise edit every page; the run knows them ahead.
#[test]
fn in_every_step_hardly_more_than_the_fewest_bytes_went_up() {
    let Some(bench) = Bench::new() else { return };
    let events = "--strategy default --refine-every 15 --reset-every 20 --sh-every 30";
    for (i, (device_mem, order, in_flight, more)) in [
        ("5MiB", "shuffle", "2", STEADY),
        ("4MiB", "shuffle", "2", STEADY),
        ("5MiB", "shuffle", "0", STEADY),
        ("7MiB", "groups:4", "2", events),
    ]
    .into_iter()
    .enumerate()
    {
        let more_of_case = format!("{more} --view-order {order} --device-mem {device_mem}");
        let slots = &hardly_more_than_the_fewest(&bench, &format!("case{i}"), in_flight, &more_of_case)["slots"];
        let share = slots["loads_ahead"].as_f64().unwrap() / slots["loads"].as_f64().unwrap();
        assert!(share > 0.5 || more == events, "{i}: {share} of the payloads went up beside the step before");
    }
}

#[test]
fn a_step_that_is_taken_again_takes_up_at_most_two_payloads_for_each_of_its_pages() {
    let Some(bench) = Bench::new() else { return };
    let more = format!("{STEADY} --view-order shuffle --device-mem 5MiB");
    assert!(bench.run("sound", "2", "", &more));
    let spans = bench.spans("sound");
    let behind = spans.iter().filter(|s| s.name == "finish step" && s.args["in_flight"].as_u64() == Some(2));
    let mut faults = String::new();
    for (i, span) in behind.step_by(4).enumerate() {
        write!(faults, "{}@{},", ["rows", "isects", "closed"][i % 3], span.step()).unwrap();
    }
    assert!(bench.run("faults", "2", &faults, &more));
    same(&bench.result("faults"), &bench.result("sound"), &faults);
    let (given_up, most) = replays(&bench, "faults");
    let [sound, faulty] = ["sound", "faults"].map(|name| loaded(&bench, name));
    let extra = faulty.last().unwrap()[0] - sound.last().unwrap()[0];
    println!("{given_up} replays took {extra} bytes up, of at most {most}");
    assert!(given_up > 8 && extra > 0 && extra <= most, "{given_up} replays, {extra} bytes of at most {most}");
    // Nothing else goes up.
    for (name, steps) in [("sound", sound), ("faults", faulty)] {
        for (i, line) in bench.metrics(name).iter().enumerate().skip(1) {
            let (up, payloads) = (line["bytes_uploaded"].as_u64().unwrap(), steps[i][0] - steps[i - 1][0]);
            assert!(
                (payloads..payloads + OTHERS).contains(&up),
                "{name} step {i}: {up} bytes up, {payloads} of payloads"
            );
        }
    }
}

#[test]
fn a_round_that_only_clears_statistics_moves_no_payload() {
    let Some(bench) = Bench::new() else { return };
    // A cap that is reached from the start, and no limit of the opacity: nothing grows and nothing is removed. A commit would copy all
    // pages back.
    let clears = "--steps 70 --refine-every 10 --reset-every 0 --sh-every 0 --max-gaussians 6000 --view-order shuffle --prune-opa 0";
    assert!(bench.run("whole", "2", "", &format!("{clears} --commit-every 0")));
    let lines = bench.metrics("whole");
    let of = |i: usize, key: &str| lines[i]["slots"][key].as_u64().unwrap();
    // After the first epoch every page that a view needs has been loaded. Rounds follow steps 30, 40, 50 and 60.
    let from = (0..lines.len()).find(|i| of(*i, "bytes_loaded") == of(69, "bytes_loaded")).unwrap();
    assert!(from < 35, "payloads went up until step {from}");
    let [before, after] = [from, 69].map(|i| ["bytes_loaded", "bytes_drained", "cleared"].map(|key| of(i, key)));
    println!("loaded, drained, cleared after step {from}: {before:?}, at the end: {after:?}");
    assert_eq!(before[..2], after[..2], "a payload moved");
    assert_eq!(after[1], 0, "a payload came back");
    assert!(after[2] > before[2] + 50 && before[2] > 0, "{before:?}, {after:?}");
    let pages = lines[69]["pages"].as_u64().unwrap();
    for line in &lines[from + 1..69] {
        let of = |key: &str| line[key].as_u64().unwrap();
        let (up, down) = (of("bytes_uploaded"), of("bytes_read_back"));
        assert!(up <= 4 * 48 * 36 + (128 << 10), "step {}: {up} bytes up", line["step"]);
        // Results and surveys of pages; before a round the bins of growth scores.
        assert!(down <= 80 * pages + 4096 + (4 << 15), "step {}: {down} bytes down", line["step"]);
    }
}
