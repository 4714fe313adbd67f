//! A page that sets finished runs side by side: figures, curves, and renders of the same held-out view.
//!
//! Invariant: what a run lacks is left out for it; only a folder without metrics is refused.

use super::chart::{Chart, Mark};
use super::html::{Cell, Page};
use super::run_report::{curve, read_json, read_metrics};
use crate::base::error::InputResult;
use crate::base::units::format_bytes;
use serde_json::Value;
use std::path::PathBuf;

/// A report that sets several runs side by side: what they reached, over steps and over seconds.
///
/// # Errors
/// A folder holds no metrics.
pub fn compare_report(folders: &[PathBuf]) -> InputResult<String> {
    let mut page = Page::new("gsscale: comparison", &format!("{} runs", folders.len()));
    let names: Vec<String> = folders.iter().map(|f| f.display().to_string()).collect();
    let mut runs = Vec::new();
    for folder in folders {
        let summary = read_json(&folder.join("summary.json")).unwrap_or(Value::Null);
        runs.push((read_metrics(folder)?, summary));
    }
    let columns = ["run", "PSNR, dB", "SSIM", "Gaussians", "steps", "seconds", "peak memory", "read", "written"];
    let rows: Vec<Vec<Cell>> = names.iter().zip(&runs).map(|(name, (_, summary))| compare_row(name, summary)).collect();
    page.table(&columns, &rows);
    let mut charts = Vec::new();
    for (x, unit) in [("step", "step"), ("seconds", "seconds of training")] {
        for (title, of) in [
            ("PSNR of held-out views", (|m: &Value| m["test"]["psnr"].as_f64()) as fn(&Value) -> Option<f64>),
            ("PSNR of training views", |m: &Value| m["psnr"].as_f64()),
        ] {
            let mut chart = Chart::new(title, unit, "dB");
            for (name, (metrics, _)) in names.iter().zip(&runs) {
                chart = chart.with(name, curve(metrics, x, of), Mark::Line);
            }
            if !chart.is_empty() {
                charts.push((chart.svg(), format!("{title}, over {unit}.")));
            }
        }
    }
    page.charts(&charts);
    Ok(page.finish())
}

fn compare_row(name: &str, summary: &Value) -> Vec<Cell> {
    let number =
        |value: &Value, digits: usize| Cell::Number(value.as_f64().map_or(String::new(), |v| format!("{v:.digits$}")));
    let bytes = |value: &Value| Cell::Number(value.as_u64().map_or(String::new(), format_bytes));
    vec![
        Cell::Text(name.to_string()),
        number(&summary["test"]["psnr"], 3),
        number(&summary["test"]["ssim"], 4),
        number(&summary["gaussians"], 0),
        number(&summary["steps"], 0),
        number(&summary["train_seconds"], 1),
        bytes(&summary["host_bytes_peak"]),
        bytes(&summary["bytes_read"]),
        bytes(&summary["bytes_written"]),
    ]
}
