//! The page of a ladder: the costs of each rung as bars and as a table, and whether the rungs ended with the same bits.

use super::bars::Bars;
use super::html::{Cell, Page};
use super::record::RunRecord;
use crate::base::units::format_bytes;

/// A rung that has run.
#[derive(Debug, Clone)]
pub struct LadderRung {
    /// Short name.
    pub name: String,
    /// The idea that this rung adds.
    pub what: String,
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
    let exact: Vec<&&LadderRung> = done.iter().filter(|r| r.name != "naive").collect();
    let names = |of: &[&&LadderRung]| of.iter().map(|r| r.name.clone()).collect::<Vec<_>>().join(", ");
    let mut text = match exact.first() {
        Some(first) if exact.len() > 1 && exact.iter().all(|r| r.record.ply == first.record.ply) => {
            format!("The results of {} are the same, byte for byte.", names(&exact))
        }
        Some(_) if exact.len() > 1 => format!("The results of {} DIFFER, which is a fault.", names(&exact)),
        _ => String::from("Too few rungs have run to compare their results."),
    };
    let naive = done.iter().find(|r| r.name == "naive").and_then(|r| r.record.psnr);
    if let Some((naive, exact)) = naive.zip(exact.first().and_then(|r| r.record.psnr)) {
        text.push_str(&format!(
            " Dense updates round differently, and training amplifies the difference: {:+.4} dB.",
            naive - exact
        ));
    }
    text
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
        LadderRung { name: name.into(), what: format!("+ {name}"), record }
    }

    #[test]
    fn a_rung_with_other_bits_is_reported() {
        let mut rungs = vec![rung("naive", "x", 26.5), rung("overlap", "a", 26.25), rung("memory", "a", 26.25)];
        assert!(
            equal_bits(&rungs).contains("overlap, memory are the same") && equal_bits(&rungs).contains("+0.2500 dB")
        );
        rungs[1].record.ply = "b".into();
        assert!(equal_bits(&rungs).contains("DIFFER"));
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
