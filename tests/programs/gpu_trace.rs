//! The trace of a run (`--trace`) and the emulated bus (`GSSCALE_EMULATE_BUS`), through the real binary: what a span says, that bytes
//! take their time, that neither changes a byte of the result, and what is refused.

use crate::support::gpu;
use crate::support::scenes::{city, classic, stderr, text, train, wide_city};
use gsscale::gpu::GpuOptions;
use std::path::Path;
use std::process::{Command, Output};
use tempfile::TempDir;

/// A span of a trace; times in microseconds.
#[derive(Debug, serde::Deserialize)]
struct Span {
    name: String,
    ts: f64,
    dur: f64,
    args: serde_json::Value,
}

impl Span {
    fn of(&self, key: &str) -> u64 {
        self.args[key].as_u64().unwrap_or_else(|| panic!("{key} of {self:?}"))
    }
}

fn spans(path: &Path) -> Vec<Span> {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// A run on an emulated bus.
fn on_bus(bus: &str, args: &[&str]) -> Output {
    let program = env!("CARGO_BIN_EXE_gsscale-train");
    Command::new(program).args(args).args(classic(args)).env("GSSCALE_EMULATE_BUS", bus).output().unwrap()
}

#[test]
fn an_emulated_bus_takes_its_time_and_changes_no_byte() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 6, 64, 48, 600);
    for place in ["host", "device"] {
        let of = |name: &str| folder.path().join(format!("{name}-{place}"));
        let (plain, slow, trace) = (of("plain"), of("slow"), of("trace"));
        let args = ["--steps", "12", "--device", "gpu", "--optimizer-on", place, "--quiet"];
        let output = train(&[&[text(&scene), "--out", text(&plain)], &args[..]].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        let with_trace = [&[text(&scene), "--out", text(&slow), "--trace", text(&trace)], &args[..]].concat();
        let output = on_bus("100MB/s,300us", &with_trace);
        assert!(output.status.success(), "{}", stderr(&output));
        let [plain, slow] = [plain, slow].map(|out| std::fs::read(out.join("point_cloud.ply")).unwrap());
        assert!(plain == slow, "{place}: a slow bus gives another scene");
        let spans = spans(&trace);
        for span in spans.iter().filter(|span| ["upload", "read back"].contains(&span.name.as_str())) {
            // A hundred bytes take a microsecond. Times have three decimals.
            let least = 300.0 + span.of("bytes") as f64 / 100.0;
            assert!(span.dur >= least - 0.01, "{span:?} took less than {least} us");
        }
        for step in 0..12 {
            let named = |name: &str| spans.iter().filter(|s| s.name == name && s.of("step") == step).count();
            assert!(
                named("step") == 1 && named("upload") > 0 && named("submit") > 2 && named("wait") > 0,
                "step {step}"
            );
        }
    }
}

#[test]
fn payloads_of_the_next_step_go_up_before_the_gradients_of_this_one_are_waited_for() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = wide_city(folder.path(), 6000);
    let [whole, few, trace] = ["whole", "few", "trace"].map(|name| folder.path().join(name));
    let args = ["--steps", "60", "--strategy", "none", "--sh-every", "0", "--log-every", "1", "--device", "gpu"];
    let of_pages = ["--optimizer-on", "device", "--page-rows", "32", "--view-order", "shuffle", "--quiet"];
    let output = train(&[&[text(&scene), "--out", text(&whole)], &args[..], &of_pages[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let of_few = [text(&scene), "--out", text(&few), "--trace", text(&trace), "--device-mem", "5MiB"];
    let output = on_bus("1GB/s,20us", &[&of_few[..], &args[..], &of_pages[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let [ply, other] = [&whole, &few].map(|out| std::fs::read(out.join("point_cloud.ply")).unwrap());
    assert!(ply == other, "copies ahead give another scene");
    let spans = spans(&trace);
    // Before its first step a run draws some views to measure them.
    let of_step = |step: u64, name: &str, what: &str| {
        let began = spans.iter().find(|span| span.name == "step" && span.of("step") == step).unwrap().ts;
        let is_it = move |span: &&Span| {
            let of = |key: &str| span.args[key].as_str() == Some(what);
            span.of("step") == step
                && span.ts >= began
                && span.name == name
                && (what.is_empty() || of("for") || of("what"))
        };
        spans.iter().filter(is_it).map(|span| span.ts).next()
    };
    let mut ahead = 0;
    for step in 0..59 {
        let Some(up) = of_step(step, "load ahead", "") else { continue };
        ahead += 1;
        // A step that was recorded without waiting is waited for at its gate.
        let waits =
            ["rasterize_bwd", "gate"].map(|what| [of_step(step, "wait", what), of_step(step, "read back", what)]);
        let first = waits.into_iter().flatten().flatten().fold(f64::MAX, f64::min);
        assert!(
            up < first && first < f64::MAX,
            "step {step}: payloads go up at {up} us, gradients are there at {first} us"
        );
    }
    let lines = std::fs::read_to_string(few.join("metrics.jsonl")).unwrap();
    let last: serde_json::Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
    let [all, before] = ["loads", "loads_ahead"].map(|key| last["slots"][key].as_u64().unwrap());
    println!("{before} of {all} payloads went up a step ahead, in {ahead} of 59 steps");
    // By the plan, although no page leaves host memory: a run whose pages do leave it has one anyway.
    let (out, spill) = (folder.path().join("planned"), folder.path().join("spill"));
    let of_spill = [text(&scene), "--out", text(&out), "--spill-dir", text(&spill), "--device-mem", "5MiB"];
    let output = train(&[&of_spill[..], &args[..], &of_pages[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let lines = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    let last: serde_json::Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
    let planned = last["slots"]["loads"].as_u64().unwrap();
    assert!(10 * all <= 11 * planned, "{all} payloads went up, {planned} with a plan");
    assert!(ahead > 20 && 2 * before > all, "{before} of {all} payloads went up a step ahead, in {ahead} of 59 steps");
}

#[test]
fn a_bus_or_a_trace_that_cannot_be_is_refused_with_a_remedy() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 6, 64, 48, 100);
    let out = folder.path().join("out");
    let args = [text(&scene), "--out", text(&out), "--steps", "3", "--quiet"];
    let output =
        train(&[&args[..], &["--device", "cpu", "--trace", text(&folder.path().join("none/trace.json"))]].concat());
    let said = stderr(&output);
    assert!(!output.status.success() && said.contains("trace.json") && said.contains("check the path"), "{said}");
    assert!(!out.exists());
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    for bus in ["12GB/s", "fast,20us", "12GB/s,20", ""] {
        let output = on_bus(bus, &[&args[..], &["--device", "gpu"]].concat());
        let said = stderr(&output);
        let names = said.contains("GSSCALE_EMULATE_BUS") && said.contains("GSSCALE_EMULATE_BUS=12GB/s,20us");
        assert!(!output.status.success() && names, "{bus:?}: {said}");
        assert!(!out.exists());
    }
}
