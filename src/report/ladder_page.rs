//! The page of a ladder: what each rung took, as bars and as a table, and whether all ended with the same bits.

use super::bars::Bars;
use super::html::{Cell, Page};
use super::record::RunRecord;
use crate::base::units::format_bytes;

/// A rung that was run.
#[derive(Debug, Clone)]
pub struct LadderRung {
    /// Short name.
    pub name: String,
    /// What it adds to the one before.
    pub what: String,
    /// What it took.
    pub record: RunRecord,
}

/// The page for the rungs so far; those of `not_built` are listed without figures.
pub fn ladder_page(facts: &str, rungs: &[LadderRung], not_built: &[&str]) -> String {
    let mut page = Page::new("gsscale: the ladder of out-of-core training", facts);
    if let Some(r) = rungs.first().map(|r| &r.record) {
        page.paragraph(&format!("{} threads of {}. Every rung was a process of its own.", r.threads, r.cpu));
    }
    page.paragraph(&sameness(rungs));
    let seconds = |of: fn(&RunRecord) -> Option<f64>, title: &str| {
        bars(rungs, title, of, &|v| if v >= 100.0 { format!("{v:.0} s") } else { format!("{v:.1} s") })
    };
    let bytes = |of: fn(&RunRecord) -> Option<f64>, title: &str| bars(rungs, title, of, &|v| format_bytes(v as u64));
    page.charts(&[
        (seconds(|r| Some(r.seconds), "Seconds of training"), "Steps alone, without loading and evaluation.".into()),
        (
            seconds(|r| r.cpu_seconds, "CPU seconds of training"),
            "All threads during the steps, those of the drive's engine included.".into(),
        ),
        (bytes(|r| Some(r.bytes_read as f64), "Bytes read from the drive"), "By the steps.".into()),
        (
            bytes(|r| Some(r.bytes_written as f64), "Bytes written to the drive"),
            "Pages, written by the steps and by the commit after the last one, which a run in memory does not make; by \
             other commits only where --commit-every asks for them."
                .into(),
        ),
        (
            bytes(|r| Some(r.host_bytes_peak as f64), "Peak of host memory"),
            "Largest resident size of the process, photos, buffers and evaluation included.".into(),
        ),
        (seconds(|r| Some(r.stall_seconds), "Seconds waiting for the drive"), "In which a step stood still.".into()),
    ]);
    page.heading("All figures");
    let in_memory = rungs.iter().find(|r| r.name == "memory").and_then(|r| r.record.psnr);
    page.table(&HEAD, &rungs.iter().map(|r| row(r, in_memory)).collect::<Vec<_>>());
    page.heading("Rungs that are not built yet");
    let not_built =
        not_built.iter().map(|name| vec![Cell::Text(format!("+ {name}")), Cell::Text("not built yet".into())]);
    page.table(&["rung", ""], &not_built.collect::<Vec<_>>());
    page.finish()
}

fn bars(rungs: &[LadderRung], title: &str, of: fn(&RunRecord) -> Option<f64>, write: &dyn Fn(f64) -> String) -> String {
    let bar = |rung: &LadderRung| {
        let (value, lack) = match rung.record.problem {
            Some(_) => (None, "failed"),
            // Not every system tells every figure.
            None => (of(&rung.record), "–"),
        };
        (rung.name.clone(), value, value.map_or(lack.to_string(), write))
    };
    Bars { title: title.to_string(), bars: rungs.iter().map(bar).collect() }.svg()
}

/// Which rungs ended with the same bits.
fn sameness(rungs: &[LadderRung]) -> String {
    let done: Vec<&LadderRung> = rungs.iter().filter(|r| r.record.problem.is_none()).collect();
    let exact: Vec<&&LadderRung> = done.iter().filter(|r| r.name != "naive").collect();
    let names = |of: &[&&LadderRung]| of.iter().map(|r| r.name.clone()).collect::<Vec<_>>().join(", ");
    let mut text = match exact.first() {
        Some(first) if exact.len() > 1 && exact.iter().all(|r| r.record.ply == first.record.ply) => {
            format!("The results of {} are the same, byte for byte.", names(&exact))
        }
        Some(_) if exact.len() > 1 => format!("The results of {} DIFFER, which they must not.", names(&exact)),
        _ => String::from("Too few rungs were run to compare their results."),
    };
    let naive = done.iter().find(|r| r.name == "naive").and_then(|r| r.record.psnr);
    if let Some((naive, exact)) = naive.zip(exact.first().and_then(|r| r.record.psnr)) {
        text.push_str(&format!(
            " Dense updates differ by roundings, which training carries on: {:+.4} dB.",
            naive - exact
        ));
    }
    text
}

const HEAD: [&str; 13] = [
    "rung",
    "seconds",
    "ms a step",
    "CPU s",
    "waited, s",
    "read",
    "written",
    "host peak",
    "device peak",
    "drive peak",
    "PSNR, dB",
    "against memory",
    "SSIM",
];

fn row(rung: &LadderRung, in_memory: Option<f64>) -> Vec<Cell> {
    let record = &rung.record;
    if let Some(problem) = &record.problem {
        let mut row = vec![Cell::Text(format!("{}; failed: {problem}", rung.what))];
        row.resize_with(HEAD.len(), || Cell::Text(String::new()));
        return row;
    }
    let number =
        |value: Option<f64>, digits: usize| Cell::Number(value.map_or(String::new(), |v| format!("{v:.digits$}")));
    let bytes = |b: u64| Cell::Number(if b == 0 { String::from("–") } else { format_bytes(b) });
    vec![
        Cell::Text(rung.what.clone()),
        number(Some(record.seconds), 1),
        number(Some(1e3 * record.seconds / f64::from(record.steps.max(1))), 1),
        number(record.cpu_seconds, 1),
        number(Some(record.stall_seconds), 1),
        bytes(record.bytes_read),
        bytes(record.bytes_written),
        bytes(record.host_bytes_peak),
        bytes(record.device_bytes_peak),
        bytes(record.drive_bytes_peak),
        number(record.psnr, 3),
        Cell::Number(record.psnr.zip(in_memory).map_or(String::new(), |(own, m)| format!("{:+.4}", own - m))),
        number(record.ssim, 4),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rung(name: &str, ply: &str, psnr: f64) -> LadderRung {
        let record = RunRecord { ply: ply.into(), psnr: Some(psnr), seconds: 2.0, steps: 10, ..RunRecord::default() };
        LadderRung { name: name.into(), what: format!("+ {name}"), record }
    }

    #[test]
    fn a_rung_that_ends_with_other_bits_is_not_passed_over() {
        let mut rungs = vec![rung("naive", "x", 26.5), rung("overlap", "a", 26.25), rung("memory", "a", 26.25)];
        assert!(sameness(&rungs).contains("overlap, memory are the same") && sameness(&rungs).contains("+0.2500 dB"));
        rungs[1].record.ply = "b".into();
        assert!(sameness(&rungs).contains("DIFFER"));
        rungs[1].record.problem = Some("no <memory>".into());
        let page = ladder_page("facts", &rungs, &["image splitting"]);
        assert!(page.contains("failed: no &lt;memory&gt;") && page.contains("not built yet"));
    }

    #[test]
    fn a_figure_that_is_missing_is_not_a_rung_that_failed() {
        // No CPU seconds, as where the system does not tell them.
        let mut rungs = vec![rung("naive", "x", 26.5), rung("memory", "a", 26.25)];
        let svg = |rungs: &[LadderRung]| bars(rungs, "CPU seconds", |r| r.cpu_seconds, &|v| format!("{v:.1} s"));
        rungs[1].record.cpu_seconds = Some(7.5);
        assert!(svg(&rungs).contains(">\n–\n") && svg(&rungs).contains("7.5 s") && !svg(&rungs).contains("failed"));
        rungs[0].record.problem = Some("no memory".into());
        assert!(svg(&rungs).contains(">\nfailed\n") && !svg(&rungs).contains('–'));
    }
}
