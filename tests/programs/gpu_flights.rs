//! Steps in flight on a device that holds the pages (`--optimizer-on device`), through the real binary: the same bytes whatever goes
//! wrong with a step, and what a trace shows of them. That flights change no byte of a run in which nothing goes wrong is in `matrix`.

use crate::support::a_device;
use crate::support::scenes::stderr;
use crate::support::workdir::{TRAIN, Workdir, split_ply};
use gsscale::page::format::slot_header::checksum;
use gsscale::page::tool::reading::{Access, StoreReader, WitnessRule};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::ops::Deref;
use std::process::Command;

/// Two rounds, a reset and raises within 90 steps, with stretches between them.
const RUN: &str = "scene --device gpu --optimizer-on device --steps 90 --refine-start 9 --refine-every 30 --grow-grad2d 0.0005 \
    --reset-every 60 --sh-every 50 --max-gaussians 7000 --page-rows 32 --view-order groups:4 --log-every 1 --quiet --keep-checkpoint";

/// A span of a trace; times in microseconds.
#[derive(Debug, serde::Deserialize)]
pub(super) struct Span {
    pub name: String,
    #[serde(rename = "ts")]
    pub began: f64,
    pub dur: f64,
    pub args: Value,
}

impl Span {
    pub fn of(&self, key: &str) -> u64 {
        self.args[key].as_u64().unwrap_or_else(|| panic!("{key} of {self:?}"))
    }

    /// The step that the host was at.
    pub fn step(&self) -> u64 {
        self.of("step")
    }
}

pub(super) fn spans_of(work: &Workdir, trace: &str) -> Vec<Span> {
    serde_json::from_slice(&work.bytes(trace)).unwrap()
}

#[derive(PartialEq)]
pub(super) struct Result {
    pub ply: Vec<u8>,
    pub losses: Vec<String>,
    /// Label and checksum of the payload of every stored page.
    pub pages: BTreeMap<u64, (Vec<u8>, u128)>,
}

pub(super) struct Bench(Workdir);

impl Deref for Bench {
    type Target = Workdir;

    fn deref(&self) -> &Workdir {
        &self.0
    }
}

impl Bench {
    /// `None` without a device.
    pub fn new() -> Option<Bench> {
        a_device()?;
        Some(Bench(Workdir::wide_city(6000)))
    }

    /// A run with these flags, after which the store is kept.
    pub fn command_of(&self, name: &str, more: &str) -> Command {
        let places = format!("--out {name}.out --spill-dir {name}.spill --trace {name}.trace");
        self.command(TRAIN, &format!("{RUN} {places} {more}"))
    }

    /// Runs with these flags and with at most `in_flight` steps in flight. Whether the run was finished.
    pub fn run(&self, name: &str, in_flight: &str, faults: &str, more: &str) -> bool {
        let mut run = self.command_of(name, more);
        run.env("GSSCALE_STEPS_IN_FLIGHT", in_flight).env("GSSCALE_STEP_FAULT", faults);
        let output = run.output().unwrap();
        let is_done = output.status.success();
        assert!(is_done || stderr(&output).contains("the run diverged"), "{name}: {}", stderr(&output));
        is_done
    }

    pub fn metrics(&self, name: &str) -> Vec<Value> {
        self.0.metrics(&format!("{name}.out"))
    }

    /// A number about the slots, at the end of each step.
    pub fn slots(&self, name: &str, key: &str) -> Vec<u64> {
        self.metrics(name).iter().map(|line| line["slots"][key].as_u64().unwrap()).collect()
    }

    pub fn result(&self, name: &str) -> Result {
        let losses = self.metrics(name).iter().map(|line| line["loss"].to_string()).collect();
        let spill = self.path(&format!("{name}.spill"));
        let store = StoreReader::open(&spill, Access::Pages, WitnessRule::Obeyed).unwrap();
        let (mut reader, mut pages) = (store.slot_reader(), BTreeMap::new());
        for (page, slot, label) in store.live_versions().unwrap() {
            pages.insert(page.to_bits(), (label.to_vec(), checksum(reader.payload(page, &slot).unwrap())));
        }
        Result { ply: self.ply(&format!("{name}.out")), losses, pages }
    }

    pub fn spans(&self, name: &str) -> Vec<Span> {
        spans_of(self, &format!("{name}.trace"))
    }
}

pub(super) fn same(one: &Result, other: &Result, name: &str) {
    assert!(one.ply == other.ply, "{name}: another scene");
    assert_eq!(one.losses, other.losses, "{name}");
    assert!(one.pages == other.pages, "{name}: other pages are stored");
}

/// Lists without room and closed gates, at steps that are recorded alone, behind another one, and before one.
#[test]
fn a_step_that_is_not_taken_leaves_no_trace_and_neither_does_the_one_behind_it() {
    let Some(bench) = Bench::new() else { return };
    bench.run("sound", "2", "", "");
    let (want, spans) = (bench.result("sound"), bench.spans("sound"));
    // Those that are finished while another one is in flight, and the others.
    let finished = |behind: bool| {
        let of = move |s: &&Span| s.name == "finish step" && (s.args["in_flight"].as_u64() == Some(2)) == behind;
        spans.iter().filter(of).map(|s| s.step()).collect::<Vec<u64>>()
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
        assert!(bench.run(&name, in_flight, &faults, ""));
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
    bench.run("first", "0", "", "--steps 1 --sh-degree 0");
    let bytes = bench.ply("first.out");
    let (header, rows) = split_ply(&bytes);
    let fields: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let at = bytes.len() - rows.len() + 4 * fields.iter().position(|field| *field == "f_dc_0").unwrap();
    for brightness in [1e20f32, 1e30] {
        let mut bytes = bytes.clone();
        bytes[at..][..4].copy_from_slice(&brightness.to_le_bytes());
        bench.write("bright.ply", bytes);
        let of_run = |in_flight: &str| {
            let name = format!("bright{brightness:e}-{in_flight}");
            let is_done = bench.run(&name, in_flight, "", "--init-ply bright.ply --view-order shuffle --steps 50");
            let summary = bench.summary(&format!("{name}.out"));
            let counts =
                ["steps", "steps_skipped_non_finite", "rows_skipped_non_finite"].map(|key| summary[key].to_string());
            (bench.result(&name), counts, is_done)
        };
        let (want, counts, is_done) = of_run("0");
        println!("{brightness:e}: {counts:?}, finished: {is_done}");
        assert_ne!(counts[1], "0", "no step was skipped");
        for in_flight in if brightness < 1e25 { &["1", "2"][..] } else { &["2"] } {
            let (got, others, other_done) = of_run(in_flight);
            assert_eq!((&others, other_done), (&counts, is_done), "{in_flight} in flight");
            same(&got, &want, &format!("{brightness:e}, {in_flight} in flight"));
        }
    }
}

#[test]
fn the_next_step_is_submitted_before_this_one_is_waited_for() {
    let Some(bench) = Bench::new() else { return };
    assert!(bench.run("steady", "2", "", "--strategy none --sh-every 0 --view-order shuffle"));
    let spans = bench.spans("steady");
    let mut both = 0;
    for step in 0..89 {
        let of = |name: &str, key: &str, value: &str| {
            let is_it = |s: &&Span| s.step() == step && s.name == name && s.args[key].as_str() == Some(value);
            spans.iter().filter(is_it).map(|s| s.began).collect::<Vec<f64>>()
        };
        let is_ahead = |s: &&Span| s.name == "record step" && s.step() == step && s.args["recorded"] == step + 1;
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

/// What a step of several batches does in its last one: the update is submitted, payloads of the next step go up, and then the host waits
/// for the update. `None` for a step of one batch; whether payloads went up.
fn took_payloads_up(spans: &[Span], step: u64) -> Option<bool> {
    let began = |names: [&str; 2], of_update: bool| -> Vec<f64> {
        let is_update = |s: &Span| ["what", "for"].iter().any(|key| s.args[*key].as_str() == Some("update"));
        let is_it = |s: &&Span| s.step() == step && names.contains(&s.name.as_str()) && (!of_update || is_update(s));
        spans.iter().filter(is_it).map(|s| s.began).collect()
    };
    let batches = began(["rows out"; 2], false);
    let last_batch = batches.iter().copied().fold(0.0, f64::max);
    let first = |times: Vec<f64>| times.into_iter().filter(|began| *began > last_batch).fold(f64::MAX, f64::min);
    let up = first(began(["load ahead"; 2], false));
    if up < f64::MAX && batches.len() > 1 {
        let (submitted, read) = (first(began(["submit"; 2], true)), first(began(["wait", "read back"], true)));
        assert!(submitted < up && up < read && read < f64::MAX, "step {step}: {submitted} us, {up} us, {read} us");
    }
    (batches.len() > 1).then_some(up < f64::MAX)
}

/// Views that need more pages than there are slots.
#[test]
fn views_of_several_batches_take_payloads_of_the_next_step_up_ahead() {
    let Some(bench) = Bench::new() else { return };
    assert!(bench.run("whole", "2", "", "--view-order shuffle"));
    let want = bench.result("whole");
    for device_mem in ["3MiB", "2500KiB"] {
        assert!(bench.run(device_mem, "2", "", &format!("--view-order shuffle --device-mem {device_mem}")));
        same(&bench.result(device_mem), &want, device_mem);
        let spans = bench.spans(device_mem);
        // The last step has no next one.
        let several: Vec<bool> = (1..89).filter_map(|step| took_payloads_up(&spans, step)).collect();
        let ahead = several.iter().filter(|is_ahead| **is_ahead).count();
        let last = bench.metrics(device_mem).pop().unwrap();
        let (slots, peak) = (&last["slots"], last["device_bytes_peak"].as_u64().unwrap());
        let several = several.len();
        println!("{device_mem}: {ahead} of {several} steps of several batches took payloads up ahead; {slots}");
        assert!(
            several > 20 && ahead > 10 && slots["loads_ahead"].as_u64().unwrap() > 50,
            "{ahead} of {several}: {slots}"
        );
        assert!(peak <= if device_mem == "3MiB" { 3 << 20 } else { 2500 << 10 }, "{peak} bytes of device memory");
    }
}
