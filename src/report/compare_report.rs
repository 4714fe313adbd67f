//! A page that sets finished runs side by side: figures, curves, and renders of the same held-out view.
//!
//! Invariants: 1. what a run lacks is left out for it; only a folder without metrics is refused; 2. the number of
//! pictures is bounded.

use super::chart::{Chart, Mark};
use super::html::{Cell, Page};
use super::picture::view_pictures;
use super::run_report::{curve, read_json, read_metrics};
use crate::base::error::InputResult;
use crate::base::units::format_bytes;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Sliders shown; more make a file that is slow to open.
const SLIDERS_MAX: usize = 12;

/// A run of the comparison.
struct Compared {
    name: String,
    folder: PathBuf,
    metrics: Vec<Value>,
    summary: Value,
}

/// A report that sets several runs side by side: what they reached, over steps and over seconds, and what they look like.
///
/// # Errors
/// A folder holds no metrics, or a picture in it is none.
pub fn compare_report(folders: &[PathBuf]) -> InputResult<String> {
    let mut runs = Vec::new();
    for (folder, name) in folders.iter().zip(names(folders)) {
        let summary = read_json(&folder.join("summary.json")).unwrap_or(Value::Null);
        runs.push(Compared { name, folder: folder.clone(), metrics: read_metrics(folder)?, summary });
    }
    let scenes: BTreeSet<&str> = runs.iter().filter_map(|r| r.summary["scene"].as_str()).collect();
    let scenes = scenes.into_iter().collect::<Vec<_>>().join(", ");
    let mut page = Page::new("gsscale: comparison", &format!("{} runs; {scenes}", folders.len()));
    page.table(&HEAD, &runs.iter().map(|run| row(run, &runs[0])).collect::<Vec<_>>());
    page.heading("Over steps and seconds");
    for chart in charts(&runs) {
        page.wide_chart(&chart.svg(), "");
    }
    add_views(&mut page, &runs)?;
    Ok(page.finish())
}

/// The folders' own names where those are all different, else their paths.
fn names(folders: &[PathBuf]) -> Vec<String> {
    let short = |folder: &PathBuf| folder.file_name().map(|n| n.to_string_lossy().into_owned());
    let distinct: BTreeSet<Option<String>> = folders.iter().map(short).collect();
    let is_clear = distinct.len() == folders.len();
    let long = |folder: &PathBuf| folder.display().to_string();
    folders.iter().map(|f| short(f).filter(|_| is_clear).unwrap_or_else(|| long(f))).collect()
}

/// A curve of the comparison: its title, its axis, what it shows of a line of metrics.
type Curve = (&'static str, &'static str, fn(&Value) -> Option<f64>);

const CURVES: [Curve; 4] = [
    ("PSNR of held-out views", "dB", |m| m["test"]["psnr"].as_f64()),
    ("PSNR of training views", "dB", |m| m["psnr"].as_f64()),
    ("Gaussians", "", |m| m["gaussians"].as_f64()),
    ("Read from the drive", "GB", |m| m["bytes_read"].as_f64().filter(|b| *b > 0.0).map(|b| b / 1e9)),
];

fn charts(runs: &[Compared]) -> Vec<Chart> {
    let mut charts = Vec::new();
    for (title, unit, of) in CURVES {
        for (x, axis) in [("step", "step"), ("seconds", "seconds of training")] {
            if x == "seconds" && unit != "dB" {
                continue;
            }
            let mut chart = Chart::new(&format!("{title} over {axis}"), axis, unit).wide();
            for run in runs {
                let mut points = curve(&run.metrics, x, of);
                let is_test = title == CURVES[0].0;
                if is_test {
                    // The last evaluation is in the summary, not in the metrics.
                    let end = if x == "step" { &run.summary["steps"] } else { &run.summary["train_seconds"] };
                    points.extend(end.as_f64().zip(run.summary["test"]["psnr"].as_f64()));
                }
                chart = chart.with(&run.name, points, if is_test { Mark::LineAndDots } else { Mark::Line });
            }
            if !chart.is_empty() {
                charts.push(chart);
            }
        }
    }
    charts
}

/// Renders of views that all runs have: each run against the first one.
fn add_views(page: &mut Page, runs: &[Compared]) -> InputResult<()> {
    let Some((first, others)) = runs.split_first().filter(|(_, others)| !others.is_empty()) else { return Ok(()) };
    let pictures = |folder: &Path| -> BTreeSet<String> {
        let entries = std::fs::read_dir(folder.join("renders/test")).into_iter().flatten().flatten();
        let names = entries.map(|e| e.file_name().to_string_lossy().into_owned());
        names.filter(|name| name.ends_with(".png")).collect()
    };
    let mut common = pictures(&first.folder);
    for run in others {
        let own = pictures(&run.folder);
        common.retain(|name| own.contains(name));
    }
    if common.is_empty() {
        return Ok(());
    }
    page.heading("Held-out views that all have");
    let stride = (common.len() * others.len()).div_ceil(SLIDERS_MAX).max(1);
    page.begin_views();
    for name in common.iter().step_by(stride) {
        let left = view_pictures(&first.folder.join("renders/test").join(name))?;
        for run in others {
            let right = view_pictures(&run.folder.join("renders/test").join(name))?;
            let sides = [(first.name.as_str(), left.render.as_str()), (run.name.as_str(), right.render.as_str())];
            page.slider(name.trim_end_matches(".png"), sides, ("photo", &left.photo), "");
        }
    }
    page.end_views();
    Ok(())
}

const HEAD: [&str; 11] = [
    "run",
    "PSNR, dB",
    "against the first",
    "SSIM",
    "Gaussians",
    "steps",
    "seconds",
    "CPU s",
    "peak memory",
    "read",
    "written",
];

fn row(run: &Compared, first: &Compared) -> Vec<Cell> {
    let summary = &run.summary;
    let number =
        |value: &Value, digits: usize| Cell::Number(value.as_f64().map_or(String::new(), |v| format!("{v:.digits$}")));
    let bytes = |value: &Value| Cell::Number(value.as_u64().map_or(String::new(), format_bytes));
    let psnr = |run: &Compared| run.summary["test"]["psnr"].as_f64();
    let against = psnr(run).zip(psnr(first)).filter(|_| run.folder != first.folder);
    vec![
        Cell::Text(run.name.clone()),
        number(&summary["test"]["psnr"], 3),
        Cell::Number(against.map_or(String::new(), |(own, first)| format!("{:+.3}", own - first))),
        number(&summary["test"]["ssim"], 4),
        number(&summary["gaussians"], 0),
        number(&summary["steps"], 0),
        number(&summary["train_seconds"], 1),
        number(&summary["train_cpu_seconds"], 1),
        bytes(&summary["host_bytes_peak"]),
        bytes(&summary["bytes_read"]),
        bytes(&summary["bytes_written"]),
    ]
}
