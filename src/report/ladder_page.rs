//! The page of a ladder: the costs of each rung as bars and as a table, and whether the rungs ended with the same bits.

use super::bars::Bars;
use super::html::{Cell, Page};
use super::record::RunRecord;
use crate::base::units::format_bytes;

/// Which rungs end with the same bits: those that round alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rounding {
    /// Dense updates on the host.
    Dense,
    /// Deferred Adam on the host.
    Host,
    /// Deferred Adam on a device.
    Device,
}

/// A rung that has run.
#[derive(Debug, Clone)]
pub struct LadderRung {
    /// Short name.
    pub name: String,
    /// The idea that this rung adds.
    pub what: String,
    /// How its updates round.
    pub rounding: Rounding,
    /// The figures.
    pub record: RunRecord,
}

/// The page for the rungs so far.
pub fn ladder_page(facts: &str, rungs: &[LadderRung]) -> String {
    let mut page = Page::new("gsscale: the ladder of out-of-core training", facts);
    if let Some(r) = rungs.first().map(|r| &r.record) {
        page.paragraph(&format!("{} threads of {}. Every rung was a process of its own.", r.threads, r.cpu));
    }
    page.paragraph(&equal_bits(rungs));
    let seconds = |of: fn(&RunRecord) -> Option<f64>, title: &str| {
        bars(rungs, title, of, &|v| if v >= 100.0 { format!("{v:.0} s") } else { format!("{v:.1} s") })
    };
    let bytes = |of: fn(&RunRecord) -> Option<f64>, title: &str| bars(rungs, title, of, &|v| format_bytes(v as u64));
    page.charts(&[
        (
            seconds(|r| Some(r.seconds), "Seconds of training"),
            "Training steps only, without loading and evaluation.".into(),
        ),
        (
            seconds(|r| r.cpu_seconds, "CPU seconds of training"),
            "All threads during the steps, including the threads of the I/O engine.".into(),
        ),
        (bytes(|r| Some(r.bytes_read as f64), "Bytes read from the drive"), "By the steps.".into()),
        (
            bytes(|r| Some(r.bytes_written as f64), "Bytes written to the drive"),
            "Pages, written by the steps and by the commit after the last step. A run in memory makes no such commit. \
             Other commits happen only with --commit-every."
                .into(),
        ),
        (
            bytes(|r| Some(r.host_bytes_peak as f64), "Peak of host memory"),
            "Largest resident size of the process, including photos, buffers and evaluation.".into(),
        ),
        (
            seconds(|r| Some(r.stall_seconds), "Seconds waiting for the drive"),
            "Time in which a step waited for pages.".into(),
        ),
    ]);
    page.heading("All figures");
    let in_memory = rungs.iter().find(|r| r.name == "memory").and_then(|r| r.record.psnr);
    add_table(&mut page, rungs, in_memory);
    page.finish()
}

fn bars(rungs: &[LadderRung], title: &str, of: fn(&RunRecord) -> Option<f64>, write: &dyn Fn(f64) -> String) -> String {
    let bar = |rung: &LadderRung| {
        let (value, placeholder) = match rung.record.problem {
            Some(_) => (None, "failed"),
            // Some systems do not report every value.
            None => (of(&rung.record), "–"),
        };
        (rung.name.clone(), value, value.map_or(placeholder.to_string(), write))
    };
    Bars { title: title.to_string(), bars: rungs.iter().map(bar).collect() }.svg()
}

/// Says which rungs ended with the same bits.
fn equal_bits(rungs: &[LadderRung]) -> String {
    let done: Vec<&LadderRung> = rungs.iter().filter(|r| r.record.problem.is_none()).collect();
    let of = |rounding: Rounding| done.iter().copied().filter(move |r| r.rounding == rounding);
    let (host, device): (Vec<_>, Vec<_>) = (of(Rounding::Host).collect(), of(Rounding::Device).collect());
    let mut parts = vec![equal_results(&host)];
    if !device.is_empty() {
        parts.push(equal_results(&device));
    }
    let difference = |rounding: Rounding| Some(of(rounding).next()?.record.psnr? - host.first()?.record.psnr?);
    for (rounding, what) in [(Rounding::Dense, "Dense updates round"), (Rounding::Device, "A device rounds")] {
        if let Some(difference) = difference(rounding) {
            parts.push(format!("{what} differently, and training amplifies the difference: {difference:+.4} dB."));
        }
    }
    parts.retain(|part| !part.is_empty());
    parts.join(" ")
}

/// Whether rungs that round alike ended with the same bits.
fn equal_results(rungs: &[&LadderRung]) -> String {
    let names = || rungs.iter().map(|r| r.name.clone()).collect::<Vec<_>>().join(", ");
    match rungs.first() {
        Some(first) if rungs.len() > 1 && rungs.iter().all(|r| r.record.ply == first.record.ply) => {
            format!("The results of {} are the same, byte for byte.", names())
        }
        Some(_) if rungs.len() > 1 => format!("The results of {} DIFFER, which is a fault.", names()),
        Some(first) if first.rounding == Rounding::Device => String::new(),
        _ => String::from("Too few rungs have run to compare their results."),
    }
}

fn add_table(page: &mut Page, rungs: &[LadderRung], in_memory: Option<f64>) {
    let name = |rung: &LadderRung| match &rung.record.problem {
        Some(problem) => format!("{}; failed: {problem}", rung.what),
        None => rung.what.clone(),
    };
    let number = |rung: &LadderRung, value: Option<f64>, digits: usize| match rung.record.problem {
        Some(_) => Cell::text(""),
        None => Cell::number(value, digits),
    };
    let bytes = |rung: &LadderRung, value: u64| match rung.record.problem {
        Some(_) => Cell::text(""),
        None => Cell::bytes(Some(value as f64)),
    };
    let step_ms = |r: &RunRecord| 1e3 * r.seconds / f64::from(r.steps.max(1));
    page.table(
        rungs,
        &[
            ("rung", &|r| Cell::text(name(r))),
            ("seconds", &|r| number(r, Some(r.record.seconds), 1)),
            ("ms a step", &|r| number(r, Some(step_ms(&r.record)), 1)),
            ("CPU s", &|r| number(r, r.record.cpu_seconds, 1)),
            ("waited, s", &|r| number(r, Some(r.record.stall_seconds), 1)),
            ("read", &|r| bytes(r, r.record.bytes_read)),
            ("written", &|r| bytes(r, r.record.bytes_written)),
            ("host peak", &|r| bytes(r, r.record.host_bytes_peak)),
            ("device peak", &|r| bytes(r, r.record.device_bytes_peak)),
            ("drive peak", &|r| bytes(r, r.record.drive_bytes_peak)),
            ("PSNR, dB", &|r| number(r, r.record.psnr, 3)),
            ("against memory", &|r| Cell::difference(r.record.psnr.zip(in_memory).map(|(own, m)| own - m), 4)),
            ("SSIM", &|r| number(r, r.record.ssim, 4)),
        ],
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rung(name: &str, ply: &str, psnr: f64) -> LadderRung {
        let record = RunRecord { ply: ply.into(), psnr: Some(psnr), seconds: 2.0, steps: 10, ..RunRecord::default() };
        let rounding = match name {
            "naive" => Rounding::Dense,
            "pages" | "resident" => Rounding::Device,
            _ => Rounding::Host,
        };
        LadderRung { name: name.into(), what: format!("+ {name}"), rounding, record }
    }

    #[test]
    fn a_rung_with_other_bits_is_reported() {
        let mut rungs = vec![rung("naive", "x", 26.5), rung("overlap", "a", 26.25), rung("memory", "a", 26.25)];
        assert!(
            equal_bits(&rungs).contains("overlap, memory are the same") && equal_bits(&rungs).contains("+0.2500 dB")
        );
        rungs[1].record.ply = "b".into();
        assert!(equal_bits(&rungs).contains("DIFFER"));
        rungs[1].record.ply = "a".into();
        rungs.extend([rung("pages", "d", 26.0), rung("resident", "d", 26.0)]);
        let text = equal_bits(&rungs);
        assert!(
            text.contains("overlap, memory are the same") && text.contains("pages, resident are the same"),
            "{text}"
        );
        assert!(text.contains("A device rounds differently") && text.contains("-0.2500 dB"), "{text}");
        rungs[3].record.ply = "e".into();
        assert!(equal_bits(&rungs).contains("pages, resident DIFFER"));
        rungs[1].record.problem = Some("no <memory>".into());
        assert!(ladder_page("facts", &rungs).contains("failed: no &lt;memory&gt;"));
    }

    #[test]
    fn a_missing_value_is_not_a_failed_rung() {
        // Some systems report no CPU seconds.
        let mut rungs = vec![rung("naive", "x", 26.5), rung("memory", "a", 26.25)];
        let svg = |rungs: &[LadderRung]| bars(rungs, "CPU seconds", |r| r.cpu_seconds, &|v| format!("{v:.1} s"));
        rungs[1].record.cpu_seconds = Some(7.5);
        assert!(svg(&rungs).contains(">\n–\n") && svg(&rungs).contains("7.5 s") && !svg(&rungs).contains("failed"));
        rungs[0].record.problem = Some("no memory".into());
        assert!(svg(&rungs).contains(">\nfailed\n") && !svg(&rungs).contains('–'));
    }
}
