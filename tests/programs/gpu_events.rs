//! Rounds of densification on pages that lie on a device (`--optimizer-on device`), through the real binary: pages whose statistics a round
//! only clears stay where they are, and the bytes are the same for any slots, frames and threads.

use super::gpu_flights::{Bench, same};

/// A cap that is reached from the start, and rounds: nothing grows. Without a limit of the opacity nothing is removed either.
const CLEARS: &str =
    "--steps 70 --refine-every 10 --reset-every 0 --sh-every 0 --max-gaussians 6000 --view-order shuffle";

#[test]
fn a_round_that_only_clears_statistics_moves_no_payload() {
    let Some(bench) = Bench::new() else { return };
    // A commit would copy all pages back.
    assert!(bench.run("whole", "2", "", &format!("{CLEARS} --prune-opa 0 --commit-every 0")));
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
    let grows = "--steps 70 --refine-every 10 --max-gaussians 6300 --view-order shuffle".to_string();
    for more in [format!("{CLEARS} --prune-opa 0.09"), grows] {
        let of_case = |name: &str, others: &str| {
            let name = format!("{name}{}", more.len());
            assert!(bench.run(&name, "2", "", &format!("{more} {others}")));
            let cleared = bench.metrics(&name).last().unwrap()["slots"]["cleared"].as_u64().unwrap();
            println!("{name}: {cleared} pages were cleared on the device");
            (bench.result(&name), cleared)
        };
        let (want, cleared) = of_case("whole", "--threads 1");
        assert!(cleared > 50, "{cleared} pages were cleared on the device");
        let (few, of_few) = of_case("few", "--device-mem 5MiB --threads 2");
        same(&few, &want, "few slots");
        assert!((1..cleared).contains(&of_few), "{of_few} pages were cleared on the device, {cleared} with all slots");
        same(&of_case("batch", "--device-mem 3MiB --frames 30").0, &want, "one batch");
    }
}
