//! The trace of a run (`--trace`) and the emulated bus (`GSSCALE_EMULATE_BUS`), through the real binary: what a span says, that bytes
//! take their time, that neither changes a byte of the result, and what is refused.

use super::gpu_flights::{Span, spans_of};
use crate::support::a_device;
use crate::support::scenes::stderr;
use crate::support::workdir::{TRAIN, Workdir, succeeded};
use std::process::Output;

fn on_bus(work: &Workdir, bus: &str, flags: &str) -> Output {
    work.command(TRAIN, flags).env("GSSCALE_EMULATE_BUS", bus).output().unwrap()
}

#[test]
fn an_emulated_bus_takes_its_time_and_changes_no_byte() {
    let Some(()) = a_device() else { return };
    let work = Workdir::city(6, 64, 48, 600);
    for place in ["host", "device"] {
        let flags = format!("scene --overwrite --steps 12 --device gpu --optimizer-on {place} --quiet");
        work.train(&format!("{flags} --out plain"));
        succeeded(on_bus(&work, "100MB/s,300us", &format!("{flags} --out slow --trace {place}.json")));
        assert!(work.ply("plain") == work.ply("slow"), "{place}: a slow bus gives another scene");
        let spans = spans_of(&work, &format!("{place}.json"));
        for span in spans.iter().filter(|span| ["upload", "read back"].contains(&span.name.as_str())) {
            // A hundred bytes take a microsecond. Times have three decimals.
            let least = 300.0 + span.of("bytes") as f64 / 100.0;
            assert!(span.dur >= least - 0.01, "{span:?} took less than {least} us");
        }
        for step in 0..12 {
            let named = |name: &str| spans.iter().filter(|s| s.name == name && s.step() == step).count();
            assert!(
                named("step") == 1 && named("upload") > 0 && named("submit") > 2 && named("wait") > 0,
                "step {step}"
            );
        }
    }
}

#[test]
fn payloads_of_the_next_step_go_up_before_the_gradients_of_this_one_are_waited_for() {
    let Some(()) = a_device() else { return };
    let work = Workdir::wide_city(6000);
    let flags = "scene --steps 60 --strategy none --sh-every 0 --log-every 1 --device gpu --optimizer-on device --page-rows 32 \
        --view-order shuffle --quiet";
    work.train(&format!("{flags} --out whole"));
    succeeded(on_bus(&work, "1GB/s,20us", &format!("{flags} --out few --trace trace --device-mem 5MiB")));
    assert!(work.ply("whole") == work.ply("few"), "copies ahead give another scene");
    let spans = spans_of(&work, "trace");
    // Before its first step a run draws some views to measure them.
    let of_step = |step: u64, name: &str, what: &str| {
        let began = spans.iter().find(|span| span.name == "step" && span.step() == step).unwrap().began;
        let is_it = move |span: &&Span| {
            let of = |key: &str| span.args[key].as_str() == Some(what);
            span.step() == step
                && span.began >= began
                && span.name == name
                && (what.is_empty() || of("for") || of("what"))
        };
        spans.iter().filter(is_it).map(|span| span.began).next()
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
    let last = |out: &str, key: &str| work.metrics(out).last().unwrap()["slots"][key].as_u64().unwrap();
    let [all, before] = ["loads", "loads_ahead"].map(|key| last("few", key));
    println!("{before} of {all} payloads went up a step ahead, in {ahead} of 59 steps");
    // By the plan, although no page leaves host memory: a run whose pages do leave it has one anyway.
    work.train(&format!("{flags} --out planned --spill-dir spill --device-mem 5MiB"));
    let planned = last("planned", "loads");
    assert!(10 * all <= 11 * planned, "{all} payloads went up, {planned} with a plan");
    assert!(ahead > 20 && 2 * before > all, "{before} of {all} payloads went up a step ahead, in {ahead} of 59 steps");
}

#[test]
fn a_bus_or_a_trace_that_cannot_be_is_refused_with_a_remedy() {
    let work = Workdir::city(6, 64, 48, 100);
    let flags = "scene --out out --steps 3 --quiet";
    work.refuses(&format!("{flags} --device cpu --trace none/trace.json"), &["trace.json", "check the path"]);
    assert!(!work.exists("out"));
    let Some(()) = a_device() else { return };
    let output = on_bus(&work, "fast,20us", &format!("{flags} --device gpu"));
    let said = stderr(&output);
    assert!(!output.status.success() && said.contains("GSSCALE_EMULATE_BUS=12GB/s,20us"), "{said}");
    assert!(!work.exists("out"));
}
