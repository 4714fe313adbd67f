//! The page of a sweep: PSNR and SSIM against what each setting takes, with the Pareto front and the spread of the seeds.
//!
//! Every figure of a setting is its mean over seeds; the bar through a point goes from its lowest seed to its highest.

use super::chart::{Chart, Mark};
use super::front::{Setting, Spread, Verdict, against, pareto_front, settings};
use super::html::{Cell, Page};
use super::record::RunRecord;
use crate::base::units::format_bytes;

/// What a run takes, as an axis.
struct Cost {
    title: &'static str,
    axis: &'static str,
    of: fn(&RunRecord) -> Option<f64>,
    /// Whether SSIM is drawn against it as well: it mostly repeats what PSNR says.
    is_for_both: bool,
}

/// Gets PSNR or SSIM of a setting.
type Quality = fn(&Setting) -> Option<Spread>;

const GB: f64 = 1e9;
const COSTS: [Cost; 5] = [
    Cost { title: "seconds", axis: "seconds of training", of: |r| Some(r.seconds), is_for_both: true },
    Cost {
        title: "CPU seconds",
        axis: "CPU seconds of training, all threads",
        of: |r| r.cpu_seconds,
        is_for_both: false,
    },
    Cost {
        title: "bytes moved",
        axis: "GB read from and written to the drive",
        of: |r| Some(r.bytes_moved() as f64 / GB),
        is_for_both: true,
    },
    Cost { title: "Gaussians", axis: "Gaussians at the end", of: |r| Some(r.gaussians as f64), is_for_both: true },
    Cost {
        title: "peak memory",
        axis: "GB of host memory at the peak",
        of: |r| Some(r.host_bytes_peak as f64 / GB),
        is_for_both: false,
    },
];
/// Colour of the front's line: the grey one.
const FRONT_COLOR: usize = 4;

/// The page for the runs of a sweep.
pub fn sweep_page(scene: &str, facts: &str, records: &[RunRecord]) -> String {
    let settings = settings(records);
    let mut page = Page::new(&format!("gsscale: what each setting costs, {scene}"), facts);
    page.tiles(&tiles(&settings));
    page.paragraph(&reading(&settings));
    for (name, quality) in [("PSNR", (|s: &Setting| s.psnr) as Quality), ("SSIM", |s: &Setting| s.ssim)] {
        page.heading(&format!("{name} of the held-out views against"));
        let costs = COSTS.iter().filter(|cost| name == "PSNR" || cost.is_for_both);
        for chart in costs.filter_map(|cost| chart(&settings, name, quality, cost)) {
            page.wide_chart(&chart.svg(), "");
        }
    }
    page.heading("By knob");
    page.table(&HEAD, &settings.iter().map(|s| row(s, settings.first())).collect::<Vec<_>>());
    let failed: Vec<&RunRecord> = records.iter().filter(|r| r.problem.is_some()).collect();
    let is_open = |r: &&&RunRecord| !records.iter().any(|done| done.key == r.key && done.problem.is_none());
    let failed: Vec<Vec<Cell>> = failed
        .iter()
        .filter(is_open)
        .map(|r| [&r.knob, &r.label, r.problem.as_ref().unwrap_or(&r.label)].map(|t| Cell::Text(t.clone())).to_vec())
        .collect();
    if !failed.is_empty() {
        page.heading("Runs that failed");
        page.table(&["knob", "setting", "why"], &failed);
    }
    page.finish()
}

fn tiles(settings: &[Setting]) -> Vec<(String, &'static str)> {
    let runs: usize = settings.iter().map(|s| s.runs.len()).sum();
    let mut tiles = vec![(runs.to_string(), "runs"), (settings.len().to_string(), "settings")];
    let Some(base) = settings.first().filter(|s| s.verdict == Verdict::Base) else { return tiles };
    if let Some(psnr) = base.psnr {
        tiles.push((format!("{:.2} dB", psnr.mean), "PSNR of the base"));
        if base.runs.len() > 1 {
            tiles.push((format!("{:.3} dB", psnr.width()), "its spread over seeds"));
        }
    }
    let free = settings.iter().filter(|s| s.verdict.is_free() && s.verdict != Verdict::Base).count();
    tiles.push((free.to_string(), "settings that cost no accuracy"));
    tiles
}

fn reading(settings: &[Setting]) -> String {
    let base = settings.first().filter(|s| s.verdict == Verdict::Base);
    let seeds = base.map_or(0, |b| b.runs.len());
    let rule = match seeds {
        0 => "The base was not run yet, so nothing is judged.".to_string(),
        1 => "The base has one seed, so its spread is not known: only results with the same bits are called free."
            .to_string(),
        n => format!(
            "Costs no accuracy: PSNR and SSIM are both no lower than the base with the same seeds, less the base's spread \
             (highest less lowest) over {n} seeds; the dashed line is that limit for a setting with all of these seeds."
        ),
    };
    format!(
        "A point is a setting, its place the mean over its seeds, its bars their range both ways: where those of the base \
         are as long as a difference, the difference says nothing. Dots cost no accuracy, rings do or may. The grey line \
         joins the settings that no other one beats. Times are those of the steps alone, without loading and \
         evaluation; bytes written hold those of the commit after the last step. {rule}"
    )
}

/// `None` where all take the same of it, or there is no such figure.
fn chart(settings: &[Setting], name: &str, quality: Quality, cost: &Cost) -> Option<Chart> {
    let at = |s: &Setting| Some((s.mean(cost.of)?, quality(s)?));
    let points: Vec<(&Setting, f64, Spread)> =
        settings.iter().filter_map(|s| at(s).map(|(x, spread)| (s, x, spread))).collect();
    if points.iter().all(|p| p.1 == points[0].1) {
        return None;
    }
    let unit = if name == "PSNR" { "PSNR, dB" } else { name };
    let mut chart = Chart::new(&format!("{name} against {}", cost.title), cost.axis, unit).wide();
    let front = pareto_front(&points.iter().map(|p| (p.1, p.2.mean)).collect::<Vec<_>>());
    let line: Vec<(f64, f64)> = front.iter().map(|&i| (points[i].1, points[i].2.mean)).collect();
    chart = chart.with_color("Pareto front", line, Mark::Line, FRONT_COLOR);
    let mut knobs: Vec<&str> = Vec::new();
    for (setting, ..) in &points {
        if !knobs.contains(&setting.knob.as_str()) {
            knobs.push(&setting.knob);
        }
    }
    for (i, knob) in knobs.iter().enumerate() {
        // The grey is the front's.
        let color = if i < FRONT_COLOR { i } else { i + 1 };
        for (mark, is_free) in [(Mark::Dots, true), (Mark::Rings, false)] {
            let own = points.iter().filter(|p| p.0.knob == *knob && p.0.verdict.is_free() == is_free);
            let own: Vec<(f64, f64)> = own.map(|p| (p.1, p.2.mean)).collect();
            let name = if own.is_empty() || chart.series.iter().any(|s| s.name == *knob) { "" } else { *knob };
            chart = chart.with_color(name, own, mark, color);
        }
    }
    chart.ranges_x = points.iter().filter_map(|p| across(p.0, p.2.mean, cost)).collect();
    chart.ranges = points.iter().filter(|p| p.2.width() > 0.0).map(|p| (p.1, p.2.low, p.2.high)).collect();
    // Those on the front are named first, so that they have the best places.
    let rest = (0..points.len()).filter(|i| !front.contains(i));
    let label = |i: usize| (points[i].1, points[i].2.mean, clear_label(points[i].0));
    chart.labels = front.iter().copied().chain(rest).map(label).collect();
    let base = settings.first().filter(|s| s.verdict == Verdict::Base && s.runs.len() > 1);
    chart.rule = base.and_then(quality).map(|s| (s.mean - s.width(), "mean of the base less its spread".to_string()));
    Some(chart)
}

/// The range of a cost over the seeds of a setting that has several.
fn across(setting: &Setting, quality: f64, cost: &Cost) -> Option<(f64, f64, f64)> {
    let spread = Spread::of(setting.runs.iter().filter_map(cost.of))?;
    (spread.width() > 0.0).then_some((quality, spread.low, spread.high))
}

/// A number says nothing without its knob.
fn clear_label(setting: &Setting) -> String {
    let is_word = setting.label.len() > 2 && setting.label.starts_with(|c: char| c.is_alphabetic());
    if is_word { setting.label.clone() } else { format!("{} {}", setting.knob, setting.label) }
}

const HEAD: [&str; 15] = [
    "knob",
    "setting",
    "frames of pages",
    "seeds",
    "PSNR, dB",
    "range",
    "against base",
    "SSIM",
    "seconds",
    "CPU s",
    "read",
    "written",
    "peak",
    "Gaussians",
    "accuracy",
];

fn row(setting: &Setting, base: Option<&Setting>) -> Vec<Cell> {
    let number =
        |value: Option<f64>, digits: usize| Cell::Number(value.map_or(String::new(), |v| format!("{v:.digits$}")));
    let bytes = |of: fn(&RunRecord) -> u64| {
        let mean = setting.mean(|r| Some(of(r) as f64));
        Cell::Number(mean.filter(|b| *b > 0.0).map_or(String::from("–"), |b| format_bytes(b as u64)))
    };
    let base = base.filter(|b| b.verdict == Verdict::Base && setting.verdict != Verdict::Base);
    let against = base.and_then(|base| against(setting, base, |r| r.psnr));
    let range = setting.psnr.filter(|_| setting.runs.len() > 1);
    let verdict = match setting.verdict {
        Verdict::Base => "the base",
        Verdict::SameBits => "the same bits",
        Verdict::WithinSpread => "no cost beyond the spread",
        Verdict::Costs => "costs",
        Verdict::Unknown => "",
    };
    vec![
        Cell::Text(setting.knob.clone()),
        Cell::Text(setting.label.clone()),
        Cell::Number(setting.runs.last().map_or(String::new(), |r| format!("{} of {}", r.frames, r.pages))),
        Cell::Number(setting.runs.len().to_string()),
        number(setting.psnr.map(|p| p.mean), 3),
        Cell::Number(range.map_or(String::new(), |p| format!("{:.3} to {:.3}", p.low, p.high))),
        Cell::Number(against.map_or(String::new(), |difference| format!("{difference:+.3}"))),
        number(setting.ssim.map(|s| s.mean), 4),
        number(setting.mean(|r| Some(r.seconds)), 1),
        number(setting.mean(|r| r.cpu_seconds), 1),
        bytes(|r| r.bytes_read),
        bytes(|r| r.bytes_written),
        bytes(|r| r.host_bytes_peak),
        number(setting.mean(|r| Some(r.gaussians as f64)), 0),
        Cell::Text(verdict.to_string()),
    ]
}
