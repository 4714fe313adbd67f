//! The page of a sweep: PSNR and SSIM of each setting against its costs, with the Pareto front and the spread over
//! seeds.
//!
//! Every value of a setting is the mean over seeds; a bar through a point is the range over seeds.

use super::chart::{Chart, Mark};
use super::front::{Setting, Spread, Verdict, against, pareto_front, settings};
use super::html::{Cell, Page};
use super::record::RunRecord;
use super::results_log::successful_run;

/// A value of a run.
type Value = fn(&RunRecord) -> Option<f64>;
/// PSNR or SSIM of a setting.
type Quality = fn(&Setting) -> Option<Spread>;

const GB: f64 = 1e9;
/// Costs: title, axis, value, and whether SSIM has a chart against the cost as well (it mostly repeats PSNR).
const COSTS: [(&str, &str, Value, bool); 5] = [
    ("seconds", "seconds of training", |r| Some(r.seconds), true),
    ("CPU seconds", "CPU seconds of training, all threads", |r| r.cpu_seconds, false),
    ("bytes moved", "GB read from and written to the drive", |r| Some(r.bytes_moved() as f64 / GB), true),
    ("Gaussians", "Gaussians at the end", |r| Some(r.gaussians as f64), true),
    ("peak memory", "GB of host memory at the peak", |r| Some(r.host_bytes_peak as f64 / GB), false),
];
/// Number of the front's colour, grey.
const FRONT_COLOR: usize = 4;

/// The page for the runs of a sweep.
pub fn sweep_page(scene: &str, facts: &str, records: &[RunRecord]) -> String {
    let settings = settings(records);
    let mut page = Page::new(&format!("gsscale: what each setting costs, {scene}"), facts);
    page.tiles(&tiles(&settings));
    page.paragraph(&explanation(&settings));
    for (name, quality) in [("PSNR", (|s: &Setting| s.psnr) as Quality), ("SSIM", |s: &Setting| s.ssim)] {
        page.heading(&format!("{name} of the held-out views against"));
        for (title, axis, cost, _) in COSTS.iter().filter(|cost| name == "PSNR" || cost.3) {
            if let Some(chart) = chart(&settings, name, quality, (title, axis, *cost)) {
                page.wide_chart(&chart.svg(), "");
            }
        }
    }
    page.heading("By knob");
    add_table(&mut page, &settings);
    let failed = records.iter().filter(|r| r.problem.is_some() && successful_run(records, &r.key).is_none());
    let failed: Vec<&RunRecord> = failed.collect();
    if !failed.is_empty() {
        page.heading("Runs that failed");
        page.table(
            &failed,
            &[
                ("knob", &|r| Cell::text(&r.knob)),
                ("setting", &|r| Cell::text(&r.label)),
                ("why", &|r| Cell::text(r.problem.clone().unwrap_or_default())),
            ],
        );
    }
    page.finish()
}

/// The base, if the sweep has run it.
fn base(settings: &[Setting]) -> Option<&Setting> {
    settings.first().filter(|s| s.verdict == Verdict::Base)
}

fn tiles(settings: &[Setting]) -> Vec<(String, &'static str)> {
    let runs: usize = settings.iter().map(|s| s.runs.len()).sum();
    let mut tiles = vec![(runs.to_string(), "runs"), (settings.len().to_string(), "settings")];
    let Some(base) = base(settings) else { return tiles };
    if let Some(psnr) = base.psnr {
        tiles.push((format!("{:.2} dB", psnr.mean), "PSNR of the base"));
        if base.runs.len() > 1 {
            tiles.push((format!("{:.3} dB", psnr.width()), "its spread over seeds"));
        }
    }
    let is_counted = |s: &&Setting| s.verdict.is_free() && !matches!(s.verdict, Verdict::Base | Verdict::NoEffect);
    let free = settings.iter().filter(is_counted).count();
    tiles.push((free.to_string(), "settings that cost no accuracy"));
    tiles
}

fn explanation(settings: &[Setting]) -> String {
    let rule = match base(settings).map_or(0, |b| b.runs.len()) {
        0 => "The base has not run yet, so no setting is judged.".to_string(),
        1 => "The base has one seed and therefore no known spread: only settings with the same bits count as free."
            .to_string(),
        n => format!(
            "A setting costs no accuracy if its PSNR and SSIM are at least those of the base with the same seeds, minus \
             the spread of the base (highest minus lowest) over {n} seeds. The dashed line is this limit for a \
             setting with all of these seeds."
        ),
    };
    format!(
        "A point is the mean of a setting over its seeds; the bars are the range over seeds in both directions. A \
         difference within the bars of the base means nothing. Dots: no cost in accuracy; rings: a cost, or not known. \
         The grey line joins the settings that no other setting beats. Times are those of the training steps, without \
         loading and evaluation. Bytes written include the commit after the last step. {rule}"
    )
}

/// A chart of quality against a cost; `None` if all settings cost the same or the cost is unknown.
fn chart(
    settings: &[Setting],
    name: &str,
    quality: Quality,
    (cost_title, cost_axis, cost): (&str, &str, Value),
) -> Option<Chart> {
    let point = |s| Some((s, Setting::mean(s, cost)?, quality(s)?));
    let points: Vec<(&Setting, f64, Spread)> = settings.iter().filter_map(point).collect();
    if points.iter().all(|p| p.1 == points[0].1) {
        return None;
    }
    let unit = if name == "PSNR" { "PSNR, dB" } else { name };
    let mut chart = Chart::new(&format!("{name} against {cost_title}"), cost_axis, unit).wide();
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
        // Skips the colour of the front.
        let color = if i < FRONT_COLOR { i } else { i + 1 };
        for (mark, is_free) in [(Mark::Dots, true), (Mark::Rings, false)] {
            let own = points.iter().filter(|p| p.0.knob == *knob && p.0.verdict.is_free() == is_free);
            let own: Vec<(f64, f64)> = own.map(|p| (p.1, p.2.mean)).collect();
            let name = if own.is_empty() || chart.series.iter().any(|s| s.name == *knob) { "" } else { *knob };
            chart = chart.with_color(name, own, mark, color);
        }
    }
    let cost_range = |(setting, _, quality): &(&Setting, f64, Spread)| {
        let costs = Spread::of(setting.runs.iter().filter_map(cost)).filter(|s| s.width() > 0.0)?;
        Some((quality.mean, costs.low, costs.high))
    };
    chart.ranges_x = points.iter().filter_map(cost_range).collect();
    chart.ranges = points.iter().filter(|p| p.2.width() > 0.0).map(|p| (p.1, p.2.low, p.2.high)).collect();
    // Labels of the front come first and get the best places.
    let rest = (0..points.len()).filter(|i| !front.contains(i));
    let label = |i: usize| (points[i].1, points[i].2.mean, full_label(points[i].0));
    chart.labels = front.iter().copied().chain(rest).map(label).collect();
    let base = base(settings).filter(|s| s.runs.len() > 1).and_then(quality);
    chart.rule = base.map(|s| (s.mean - s.width(), "mean of the base less its spread".to_string()));
    Some(chart)
}

/// The label of a setting, with the knob if the label is a number.
fn full_label(setting: &Setting) -> String {
    let is_word = setting.label.len() > 2 && setting.label.starts_with(|c: char| c.is_alphabetic());
    if is_word { setting.label.clone() } else { format!("{} {}", setting.knob, setting.label) }
}

fn add_table(page: &mut Page, settings: &[Setting]) {
    let range = |s: &Setting| s.psnr.filter(|_| s.runs.len() > 1).map(|p| format!("{:.3} to {:.3}", p.low, p.high));
    let difference = |s: &Setting| {
        let base = base(settings).filter(|_| s.verdict != Verdict::Base)?;
        against(s, base, |r| r.psnr)
    };
    let frames = |s: &Setting| s.runs.last().map(|r| format!("{} of {}", r.frames, r.pages));
    page.table(
        settings,
        &[
            ("knob", &|s| Cell::text(&s.knob)),
            ("setting", &|s| Cell::text(&s.label)),
            ("frames of pages", &|s| Cell::Number(frames(s).unwrap_or_default())),
            ("seeds", &|s| Cell::Number(s.runs.len().to_string())),
            ("PSNR, dB", &|s| Cell::number(s.psnr.map(|p| p.mean), 3)),
            ("range", &|s| Cell::Number(range(s).unwrap_or_default())),
            ("against base", &|s| Cell::difference(difference(s), 3)),
            ("SSIM", &|s| Cell::number(s.ssim.map(|p| p.mean), 4)),
            ("seconds", &|s| Cell::number(s.mean(|r| Some(r.seconds)), 1)),
            ("CPU s", &|s| Cell::number(s.mean(|r| r.cpu_seconds), 1)),
            ("read", &|s| Cell::bytes(s.mean(|r| Some(r.bytes_read as f64)))),
            ("written", &|s| Cell::bytes(s.mean(|r| Some(r.bytes_written as f64)))),
            ("peak", &|s| Cell::bytes(s.mean(|r| Some(r.host_bytes_peak as f64)))),
            ("Gaussians", &|s| Cell::number(s.mean(|r| Some(r.gaussians as f64)), 0)),
            ("accuracy", &|s| Cell::text(s.verdict.words())),
        ],
    );
}
