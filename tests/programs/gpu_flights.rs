//! Steps in flight on a device that holds the pages (`--optimizer-on device`), through the real binary: the same bytes however many are
//! in flight, whatever goes wrong with a step, and what a trace shows of them.

use crate::support::gpu;
use crate::support::scenes::{CLASSIC, stderr, summary, text, wide_city};
use gsscale::gpu::GpuOptions;
use gsscale::page::format::slot_header::checksum;
use gsscale::page::tool::reading::{Access, StoreReader, WitnessRule};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::PathBuf;
use std::process::Command;
use tempfile::TempDir;

/// Two rounds, a reset and raises within 90 steps, with stretches between them.
const RUN: &[&str] = &[
    "--device",
    "gpu",
    "--optimizer-on",
    "device",
    "--steps",
    "90",
    "--refine-start",
    "9",
    "--refine-every",
    "30",
    "--grow-grad2d",
    "0.0005",
    "--reset-every",
    "60",
    "--sh-every",
    "50",
    "--max-gaussians",
    "7000",
    "--page-rows",
    "32",
    "--view-order",
    "groups:4",
    "--log-every",
    "1",
    "--quiet",
];

/// Events of a trace: name, beginning and end in microseconds, the step that the host was at, and the values of an event.
struct Span {
    name: String,
    began: f64,
    step: u64,
    args: serde_json::Value,
}

/// What a run left behind.
#[derive(PartialEq)]
struct Result {
    ply: Vec<u8>,
    losses: Vec<String>,
    /// Label and checksum of the payload of every stored page.
    pages: BTreeMap<u64, (Vec<u8>, u128)>,
}

struct Bench {
    folder: TempDir,
    scene: PathBuf,
}

impl Bench {
    /// `None` without a device.
    fn new() -> Option<Bench> {
        gpu::open(&GpuOptions::default())?;
        let folder = TempDir::new().unwrap();
        let scene = wide_city(folder.path(), 6000);
        Some(Bench { folder, scene })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Runs with these arguments and with at most `in_flight` steps in flight, after which the store is kept. Whether the run was
    /// finished.
    fn run(&self, name: &str, in_flight: &str, faults: &str, more: &[&str]) -> bool {
        let [out, spill, trace] = ["out", "spill", "trace"].map(|part| self.path(&format!("{name}.{part}")));
        let of_run = [text(&self.scene), "--out", text(&out), "--spill-dir", text(&spill), "--trace", text(&trace)];
        let mut run = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
        // Flags with their values; the last one has none.
        let others = RUN.chunks(2).filter(|flag| !more.contains(&flag[0])).flatten();
        run.args(of_run).arg("--keep-checkpoint").args(others).args(CLASSIC).args(more);
        run.env("GSSCALE_STEPS_IN_FLIGHT", in_flight).env("GSSCALE_STEP_FAULT", faults);
        let output = run.output().unwrap();
        let is_done = output.status.success();
        assert!(is_done || stderr(&output).contains("the run diverged"), "{name}: {}", stderr(&output));
        is_done
    }

    fn result(&self, name: &str) -> Result {
        let out = self.path(&format!("{name}.out"));
        let lines = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
        let loss = |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()["loss"].to_string();
        let store =
            StoreReader::open(&self.path(&format!("{name}.spill")), Access::Pages, WitnessRule::Obeyed).unwrap();
        let (mut reader, mut pages) = (store.slot_reader(), BTreeMap::new());
        for (page, slot, label) in store.live_versions().unwrap() {
            pages.insert(page.to_bits(), (label.to_vec(), checksum(reader.payload(page, &slot).unwrap())));
        }
        let ply = std::fs::read(out.join("point_cloud.ply")).unwrap();
        Result { ply, losses: lines.lines().map(loss).collect(), pages }
    }

    fn spans(&self, name: &str) -> Vec<Span> {
        let trace: Vec<serde_json::Value> =
            serde_json::from_slice(&std::fs::read(self.path(&format!("{name}.trace"))).unwrap()).unwrap();
        let span = |event: &serde_json::Value| {
            Some(Span {
                name: event["name"].as_str()?.to_string(),
                began: event["ts"].as_f64()?,
                step: event["args"]["step"].as_u64()?,
                args: event["args"].clone(),
            })
        };
        trace.iter().filter_map(span).collect()
    }
}

fn same(one: &Result, other: &Result, name: &str) {
    assert!(one.ply == other.ply, "{name}: another scene");
    assert_eq!(one.losses, other.losses, "{name}");
    assert!(one.pages == other.pages, "{name}: other pages are stored");
}

/// Steps that were recorded while another one was in flight.
fn recorded_ahead(spans: &[Span]) -> usize {
    spans.iter().filter(|s| s.name == "record step" && s.args["recorded"].as_u64() > Some(s.step)).count()
}

#[test]
fn steps_in_flight_change_no_byte() {
    let Some(bench) = Bench::new() else { return };
    bench.run("waits", "0", "", &[]);
    let want = bench.result("waits");
    assert_eq!(recorded_ahead(&bench.spans("waits")), 0);
    let frames = summary(&bench.path("waits.out"))["pages_pinned_max"].as_u64().unwrap();
    let [frames, many] = [frames, 2 * frames].map(|frames| frames.to_string());
    // Steps in flight, further flags, and the fewest steps that are recorded behind another one.
    let cases: &[(&str, &[&str], usize)] = &[
        ("1", &["--threads", "2"], 0),
        ("2", &["--threads", "1"], 25),
        ("2", &["--device-mem", "8MiB", "--frames", &many], 10),
        ("2", &["--device-mem", "5MiB", "--frames", &frames, "--commit-every", "0.05"], 0),
        ("2", &["--eval-every", "7", "--save-every", "11", "--commit-every", "0.01"], 5),
    ];
    for (i, (in_flight, more, least)) in cases.iter().enumerate() {
        let name = format!("case{i}");
        assert!(bench.run(&name, in_flight, "", more));
        let mut got = bench.result(&name);
        if more.contains(&"--save-every") {
            // The store has the pages of the saved steps as well.
            got.pages = want.pages.clone();
        }
        same(&got, &want, &format!("{more:?}"));
        let ahead = recorded_ahead(&bench.spans(&name));
        println!("{in_flight} in flight, {more:?}: {ahead} of 90 steps were recorded behind another one");
        assert!(ahead >= *least, "{more:?}: {ahead} of 90 steps were recorded behind another one");
        if let Some(at) = more.iter().position(|flag| *flag == "--device-mem") {
            let most = u64::from(more[at + 1].trim_end_matches("MiB").parse::<u32>().unwrap()) << 20;
            let lines = std::fs::read_to_string(bench.path(&format!("{name}.out")).join("metrics.jsonl")).unwrap();
            let last: serde_json::Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
            let peak = last["device_bytes_peak"].as_u64().unwrap();
            assert!(peak <= most, "{more:?}: {peak} bytes of device memory");
        }
    }
}

/// Lists without room and closed gates, at steps that are recorded alone, behind another one, and before one.
#[test]
fn a_step_that_is_not_taken_leaves_no_trace_and_neither_does_the_one_behind_it() {
    let Some(bench) = Bench::new() else { return };
    bench.run("sound", "2", "", &[]);
    let (want, spans) = (bench.result("sound"), bench.spans("sound"));
    // Those that are finished while another one is in flight, and the others.
    let finished = |behind: bool| {
        let of = move |s: &&Span| s.name == "finish step" && (s.args["in_flight"].as_u64() == Some(2)) == behind;
        spans.iter().filter(of).map(|s| s.step).collect::<Vec<u64>>()
    };
    let [with_other, alone] = [finished(true), finished(false)];
    assert!(with_other.len() > 20 && alone.len() >= 3, "{with_other:?}, {alone:?}");
    let mut faults = String::new();
    for (i, step) in with_other.iter().step_by(3).chain(&alone).enumerate() {
        write!(faults, "{}@{step},", ["rows", "isects", "closed"][i % 3]).unwrap();
    }
    // Two steps one behind the other, both at fault.
    write!(faults, "closed@{},rows@{}", with_other[1], with_other[1] + 1).unwrap();
    for in_flight in ["1", "2"] {
        let name = format!("faults{in_flight}");
        assert!(bench.run(&name, in_flight, &faults, &[]));
        same(&bench.result(&name), &want, &faults);
        let spans = bench.spans(&name);
        let given_up = |behind: u64| {
            spans.iter().filter(|s| s.name == "give up" && s.args["behind"].as_u64() == Some(behind)).count()
        };
        println!("{in_flight} in flight: {} steps given up alone, {} with another one", given_up(0), given_up(1));
        assert!(given_up(0) > 2 && (in_flight == "1" || given_up(1) > 5), "{} and {}", given_up(0), given_up(1));
    }
}

#[test]
fn views_whose_loss_is_not_finite_are_skipped_however_many_steps_are_in_flight() {
    let Some(bench) = Bench::new() else { return };
    bench.run("first", "0", "", &["--steps", "1", "--sh-degree", "0"]);
    let bytes = std::fs::read(bench.path("first.out").join("point_cloud.ply")).unwrap();
    let head = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let names = String::from_utf8_lossy(&bytes[..head]).into_owned();
    let fields: Vec<&str> = names.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let at = 4 * fields.iter().position(|field| *field == "f_dc_0").unwrap();
    let row = 4 * fields.len();
    for (brightness, bright_rows) in [(1e20f32, 1), (1e30, 1)] {
        let (ply, mut bytes) = (bench.path("bright.ply"), bytes.clone());
        for i in 0..bright_rows {
            bytes[head + i * row + at..][..4].copy_from_slice(&brightness.to_le_bytes());
        }
        std::fs::write(&ply, bytes).unwrap();
        let of_run = |in_flight: &str| {
            let name = format!("bright{brightness:e}-{in_flight}");
            let is_done = bench.run(&name, in_flight, "", &["--init-ply", text(&ply), "--view-order", "shuffle"]);
            let summary = summary(&bench.path(&format!("{name}.out")));
            let counts =
                ["steps", "steps_skipped_non_finite", "rows_skipped_non_finite"].map(|key| summary[key].to_string());
            (bench.result(&name), counts, is_done)
        };
        let (want, counts, is_done) = of_run("0");
        println!("{brightness:e}: {counts:?}, finished: {is_done}");
        assert_ne!(counts[1], "0", "no step was skipped");
        for in_flight in ["1", "2"] {
            let (got, others, other_done) = of_run(in_flight);
            assert_eq!((&others, other_done), (&counts, is_done), "{in_flight} in flight");
            same(&got, &want, &format!("{brightness:e}, {in_flight} in flight"));
        }
    }
}

#[test]
fn the_next_step_is_submitted_before_this_one_is_waited_for() {
    let Some(bench) = Bench::new() else { return };
    let more = ["--strategy", "none", "--sh-every", "0", "--view-order", "shuffle"];
    assert!(bench.run("steady", "2", "", &more));
    let spans = bench.spans("steady");
    let mut both = 0;
    for step in 0..89 {
        let of = |name: &str, key: &str, value: &str| {
            let is_it = |s: &&Span| s.step == step && s.name == name && s.args[key].as_str() == Some(value);
            spans.iter().filter(is_it).map(|s| s.began).collect::<Vec<f64>>()
        };
        let is_ahead = |s: &&Span| s.name == "record step" && s.step == step && s.args["recorded"] == step + 1;
        let Some(record) = spans.iter().find(is_ahead).map(|s| s.began) else { continue };
        // The last submission of a recorded step is its backward pass with gate and update.
        let submitted = of("submit", "what", "backward").into_iter().filter(|at| *at > record).fold(f64::MAX, f64::min);
        let read =
            of("wait", "for", "gate").into_iter().chain(of("read back", "what", "gate")).fold(f64::MAX, f64::min);
        assert!(record < submitted && submitted < read && read < f64::MAX, "step {step}: {submitted} us, {read} us");
        both += 1;
    }
    println!("{both} of 89 steps were submitted before the one before them was waited for");
    assert!(both > 70, "{both} of 89 steps were submitted before the one before them was waited for");
}
