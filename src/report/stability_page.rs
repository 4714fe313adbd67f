//! The page of a stability sweep: decibels that each disturbance costs, without a remedy, with its own and with all.
//!
//! Every value is a difference to the clean scene with the same seed and without remedy; a mean over seeds, with the range.

use super::dots::Dots;
use super::front::{Setting, Spread, settings};
use super::html::{Cell, Page};
use super::record::RunRecord;
use super::results_log::successful_run;

/// The knob of the clean scene.
pub const CLEAN: &str = "clean";
/// The label of runs without a remedy.
pub const NO_REMEDY: &str = "none";

/// A disturbance with a remedy.
#[derive(Debug, Clone)]
pub struct Lost {
    /// The disturbance.
    pub knob: String,
    pub remedy: String,
    /// Seeds in the figures.
    pub seeds: usize,
    /// PSNR of the held-out photos, dB.
    pub psnr: f64,
    /// PSNR that is lost, dB.
    pub lost: Spread,
    /// Colour-corrected PSNR that is lost, dB.
    pub cc_lost: Option<Spread>,
    /// Over all seeds: wrong views that were named, wrong views, right views that were named.
    pub named: [usize; 3],
}

impl Lost {
    /// The views that were named; empty where none was and none is wrong.
    pub fn named_text(&self) -> String {
        let [found, wrong, right] = self.named;
        let of_wrong = if wrong > 0 { format!("{found}/{wrong} ") } else { String::new() };
        let text = if wrong > 0 || right > 0 { format!("{of_wrong}+{right}") } else { String::new() };
        text.trim().to_string()
    }
}

/// What is lost in each setting of which the clean scene has a run with the same seed, in the order of the records.
pub fn lost(records: &[RunRecord]) -> Vec<Lost> {
    let settings = settings(records);
    let Some(clean) = settings.iter().find(|s| s.knob == CLEAN && s.label == NO_REMEDY) else { return Vec::new() };
    let of = |setting: &Setting, of: fn(&RunRecord) -> Option<f64>| {
        let of_clean = |seed: u64| clean.runs.iter().find(|run| run.seed == seed).and_then(of);
        Spread::of(setting.runs.iter().filter_map(|run| Some(of_clean(run.seed)? - of(run)?)))
    };
    let of_setting = |setting: &Setting| {
        Some(Lost {
            knob: setting.knob.clone(),
            remedy: setting.label.clone(),
            seeds: setting.runs.len(),
            psnr: setting.psnr?.mean,
            lost: of(setting, |run| run.psnr)?,
            cc_lost: of(setting, |run| run.cc_psnr),
            named: named(&setting.runs),
        })
    };
    settings.iter().filter_map(of_setting).collect()
}

fn named(runs: &[RunRecord]) -> [usize; 3] {
    runs.iter().fold([0; 3], |[found, wrong, right], run| {
        let is_wrong = |name: &&String| run.wrong_views.contains(name);
        let hits = run.outlier_views.iter().filter(is_wrong).count();
        [found + hits, wrong + run.wrong_views.len(), right + run.outlier_views.len() - hits]
    })
}

/// PSNR of the clean scene without remedy: highest less lowest over seeds.
pub fn spread_of_clean(records: &[RunRecord]) -> Option<f64> {
    let is_clean = |r: &&RunRecord| r.knob == CLEAN && r.label == NO_REMEDY && r.problem.is_none();
    Spread::of(records.iter().filter(is_clean).filter_map(|r| r.psnr)).map(|s| s.width())
}

/// The page of the runs.
pub fn stability_page(scene: &str, facts: &str, records: &[RunRecord]) -> String {
    let lost = lost(records);
    let mut page = Page::new(&format!("gsscale: what faults of a capture cost, {scene}"), facts);
    let clean = lost.iter().find(|l| l.knob == CLEAN && l.remedy == NO_REMEDY);
    let mut tiles = vec![(records.len().to_string(), "runs")];
    tiles.extend(clean.map(|l| (format!("{:.2} dB", l.psnr), "PSNR of the clean scene")));
    tiles.extend(spread_of_clean(records).map(|s| (format!("{s:.2} dB"), "its spread over seeds")));
    page.tiles(&tiles);
    page.paragraph(
        "Training photos, poses or points are disturbed; the held-out photos are clean. A dot is the PSNR lost against the \
         clean scene without remedy and with the same seed, a mean over seeds; the line is the range over seeds. A \
         difference below the spread of the clean scene means nothing.",
    );
    page.wide_chart(&chart("PSNR lost, dB", &lost, |l| Some(l.lost)).svg(), "");
    if lost.iter().any(|l| l.cc_lost.is_some()) {
        page.wide_chart(&chart("PSNR lost after colour correction, dB", &lost, |l| l.cc_lost).svg(), "");
    }
    page.heading("All figures");
    let range = |s: Spread| format!("{:+.2} to {:+.2}", s.low, s.high);
    page.table(
        &lost,
        &[
            ("disturbance", &|l| Cell::text(&l.knob)),
            ("remedy", &|l| Cell::text(&l.remedy)),
            ("seeds", &|l| Cell::Number(l.seeds.to_string())),
            ("PSNR, dB", &|l| Cell::number(Some(l.psnr), 2)),
            ("lost", &|l| Cell::number(Some(l.lost.mean), 2)),
            ("range", &|l| Cell::Number(range(l.lost))),
            ("lost, colour-corrected", &|l| Cell::number(l.cc_lost.map(|s| s.mean), 2)),
            ("wrong views named, +right ones", &|l| Cell::Number(l.named_text())),
        ],
    );
    let failed = records.iter().filter(|r| r.problem.is_some() && successful_run(records, &r.key).is_none());
    let failed: Vec<&RunRecord> = failed.collect();
    if !failed.is_empty() {
        page.heading("Runs that failed");
        let why = |r: &&RunRecord| Cell::text(r.problem.clone().unwrap_or_default());
        page.table(
            &failed,
            &[("disturbance", &|r| Cell::text(&r.knob)), ("remedy", &|r| Cell::text(&r.label)), ("why", &why)],
        );
    }
    page.finish()
}

fn chart(title: &str, lost: &[Lost], value: fn(&Lost) -> Option<Spread>) -> Dots {
    let unique = |of: fn(&Lost) -> &String| {
        let mut names: Vec<String> = Vec::new();
        lost.iter().map(of).filter(|name| !name.is_empty()).for_each(|name| {
            if !names.contains(name) {
                names.push(name.clone());
            }
        });
        names
    };
    let series = unique(|l| &l.remedy);
    let row = |knob: String| {
        let of = |remedy: &String| lost.iter().find(|l| l.knob == knob && l.remedy == *remedy).and_then(value);
        let values = series.iter().map(of).collect();
        (knob, values)
    };
    let rows = unique(|l| &l.knob).into_iter().map(row).collect();
    Dots { title: title.to_string(), series: series.clone(), rows }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    fn run(knob: &str, remedy: &str, seed: u64, psnr: f64) -> RunRecord {
        let (knob, label, key) = (knob.to_string(), remedy.to_string(), format!("{knob} {remedy} {seed}"));
        RunRecord { key, knob, label, seed, psnr: Some(psnr), ..RunRecord::default() }
    }

    #[test]
    fn what_is_lost_is_paired_by_seed() {
        let mut records = vec![
            run("clean", "none", 1, 26.0),
            run("clean", "none", 2, 25.0),
            run("boxes", "none", 1, 22.0),
            run("boxes", "none", 2, 22.0),
            run("boxes", "own", 2, 24.5),
            run("boxes", "own", 3, 20.0),
        ];
        records[4].wrong_views = vec!["a".into(), "b".into()];
        records[4].outlier_views = vec!["b".into(), "c".into()];
        records.push(RunRecord { problem: Some("no <space>".into()), ..run("boxes", "all", 1, 0.0) });
        let lost = lost(&records);
        let of = |knob: &str, remedy: &str| lost.iter().find(|l| l.knob == knob && l.remedy == remedy).unwrap();
        assert_eq!(of("boxes", "none").lost, Spread { mean: 3.5, low: 3.0, high: 4.0 });
        assert_eq!(of("boxes", "own").lost, Spread { mean: 0.5, low: 0.5, high: 0.5 });
        assert_eq!((of("clean", "none").lost.mean, spread_of_clean(&records)), (0.0, Some(1.0)));
        assert_eq!(of("boxes", "own").named, [1, 2, 1]);
        assert_eq!(
            (of("boxes", "own").named_text().as_str(), of("clean", "none").named_text().as_str()),
            ("1/2 +1", "")
        );
        assert_eq!(lost.len(), 3, "a failed run has no figures");
        let page = stability_page("scene", "facts", &records);
        assert!(page.contains("Runs that failed") && page.contains("no &lt;space&gt;") && page.contains("<svg"));
    }
}
