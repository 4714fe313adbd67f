//! Rounds of densification on pages that lie on a device (`--optimizer-on device`), through the real binary: pages whose statistics a round
//! only clears stay where they are, and the bytes are the same for any slots, frames and threads.

use super::gpu_flights::{Bench, recorded_behind, same};

/// A cap that is reached from the start, and rounds: nothing grows. Without a limit of the opacity nothing is removed either.
const CLEARS: &[&str] = &[
    "--steps",
    "70",
    "--refine-every",
    "10",
    "--reset-every",
    "0",
    "--sh-every",
    "0",
    "--max-gaussians",
    "6000",
    "--view-order",
    "shuffle",
    "--prune-opa",
];

#[test]
fn a_round_that_only_clears_statistics_moves_no_payload() {
    let Some(bench) = Bench::new() else { return };
    // A commit would copy all pages back.
    let clears = [CLEARS, &["0", "--commit-every", "0"]].concat();
    assert!(bench.run("whole", "2", "", &clears));
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

/// With growth, removal and a cap that is reached on the way.
#[test]
fn rounds_on_the_device_and_on_the_host_leave_the_same_bytes() {
    let Some(bench) = Bench::new() else { return };
    let grows = ["--steps", "70", "--refine-every", "10", "--max-gaussians", "6300", "--view-order", "shuffle"];
    for more in [[CLEARS, &["0.09"]].concat(), grows.to_vec()] {
        let of_case = |name: &str, others: &[&str]| {
            let name = format!("{name}{}", more.len());
            assert!(bench.run(&name, "2", "", &[&more, others].concat()));
            let cleared = bench.metrics(&name).last().unwrap()["slots"]["cleared"].as_u64().unwrap();
            println!("{name}: {cleared} pages were cleared on the device");
            (bench.result(&name), cleared)
        };
        let (want, cleared) = of_case("whole", &["--threads", "1"]);
        assert!(cleared > 50, "{cleared} pages were cleared on the device");
        let (few, of_few) = of_case("few", &["--device-mem", "5MiB", "--threads", "2"]);
        same(&few, &want, "few slots");
        assert!((1..cleared).contains(&of_few), "{of_few} pages were cleared on the device, {cleared} with all slots");
        same(&of_case("one batch", &["--device-mem", "3MiB", "--frames", "30"]).0, &want, "one batch");
    }
}

/// The strategy `long-axis` with its recycling: the device weighs rows, and a round judges them by that.
#[test]
fn rounds_that_recycle_leave_the_same_bytes_for_any_slots() {
    let Some(bench) = Bench::new() else { return };
    let grows = [
        "--strategy",
        "long-axis",
        "--steps",
        "70",
        "--refine-every",
        "10",
        "--max-gaussians",
        "6300",
        "--view-order",
        "shuffle",
    ];
    let run_with = |name: &str, in_flight: &str, recycle: &str, others: &[&str]| {
        assert!(bench.run(name, in_flight, "", &[&grows[..], &["--recycle", recycle], others].concat()));
        let ahead = recorded_behind(&bench.spans(name)).len();
        println!("{name}: {ahead} of 70 steps were recorded behind another one");
        (bench.result(name), ahead)
    };
    let run = |name: &str, in_flight: &str, others: &[&str]| run_with(name, in_flight, "0.05", others);
    let (want, ahead) = run("whole", "2", &["--threads", "1"]);
    // Behind a round a step waits for the pages that it edits.
    assert!(ahead > 4, "steps that weigh rows are recorded ahead as well: {ahead}");
    let last = bench.metrics("whole").pop().unwrap();
    assert!(last["slots"]["cleared"].as_u64().unwrap() > 0, "{last}");
    // Recycling keeps the number and changes the rows: without it the scene is another one.
    let (other, _) = run_with("no recycling", "2", "0", &[]);
    assert!(other.ply != want.ply, "nothing was recycled");
    same(&run("waits", "0", &["--threads", "2"]).0, &want, "no step in flight");
    same(&run("few", "2", &["--device-mem", "5MiB", "--commit-every", "0.1"]).0, &want, "few slots");
    same(&run("one batch", "2", &["--device-mem", "3MiB", "--frames", "30"]).0, &want, "one batch");
}
