//! `report.html` of a run, made from the files in the run's folder.
//!
//! Invariants: 1. missing or incomplete files (of a run that was stopped) make the report shorter; only a folder
//! without metrics is an error; 2. the number of pictures and of points in a chart is bounded.

use super::chart::{Chart, Mark, short, smoothed};
use super::html::{Cell, Page, slider};
use super::page_map::{PageTile, page_map_legend, page_map_svg};
use super::picture::{ViewPictures, view_pictures};
use super::run_files::{
    CONFIG_FILE, DIAGNOSIS_FILE, METRICS_FILE, PAGES_FILE, PICTURES_FOLDER, REPORT_FILE, SUMMARY_FILE, VIEWS_FILE,
};
use crate::base::error::{InputError, InputResult};
use crate::base::say::{as_called, shell_word};
use crate::base::units::{format_bytes, format_grouped};
use crate::base::whole_file::write_whole;
use crate::photos::parameter::Finding;
use crate::photos::{KINDS, diagnosis};
use serde_json::Value;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// Most views: a file with more opens slowly.
const VIEWS_MAX: usize = 12;
const POINTS_MAX: usize = 600;
/// Size limit of a text file, bytes.
const TEXT_BYTES_MAX: u64 = 256 << 20;
const MIB: f64 = (1 << 20) as f64;

/// The report of the run in `folder` as HTML. `progress(done, all)` is called after each of its pictures.
/// Errors: the folder holds no metrics.
pub fn run_report(folder: &Path, progress: &dyn Fn(usize, usize)) -> InputResult<String> {
    let metrics = read_metrics(folder)?;
    let summary = read_json(&folder.join(SUMMARY_FILE)).unwrap_or(Value::Null);
    let scene = summary["scene"].as_str().unwrap_or("").to_string();
    let name = folder.file_name().map_or("run".into(), |n| n.to_string_lossy().into_owned());
    let mut page = Page::new(&format!("gsscale: {name}"), &scene);
    page.tiles(&tiles(&summary, &metrics));
    if let Some(text) = unfinished_text(folder, &summary) {
        page.paragraph(&text);
    }
    add_views(&mut page, folder, progress);
    page.heading("Training");
    page.charts(&training_charts(&metrics));
    add_growth(&mut page, &summary);
    let more = summary["more_exports"].as_array().map_or(&[][..], Vec::as_slice);
    let mut texts: Vec<String> = [&summary["export"]].into_iter().chain(more).filter_map(export_text).collect();
    if let Some(left_out @ 1..) = summary["gaussians_left_out"].as_u64() {
        let count = format_grouped(left_out);
        texts.push(format!("{count} Gaussians that too few photos see are left out (--export-clean)."));
    }
    if !texts.is_empty() {
        page.heading("For viewers");
        texts.iter().for_each(|text| page.paragraph(text));
    }
    let tiers = tier_charts(&metrics);
    if !tiers.is_empty() {
        page.heading("Memory and disk");
        page.charts(&tiers);
    }
    let diagnosis = read_json(&folder.join(DIAGNOSIS_FILE)).unwrap_or(Value::Null);
    diagnosis::finding(&diagnosis).into_iter().for_each(|finding| add_finding(&mut page, finding));
    for kind in KINDS {
        let file = kind.file.and_then(|name| read_json(&folder.join(name))).unwrap_or(Value::Null);
        (kind.finding)(&file, &summary).into_iter().for_each(|finding| add_finding(&mut page, finding));
    }
    add_page_map(&mut page, &folder.join(PAGES_FILE));
    page.heading("Config");
    if let Some(text) = read_text(&folder.join(CONFIG_FILE)) {
        page.folded("config.toml, every key as it was used", &text);
    }
    if !summary.is_null() {
        let text = serde_json::to_string_pretty(&summary).unwrap_or_default();
        page.folded("summary.json", &text);
    }
    Ok(page.finish())
}

/// Says after how many steps a run was stopped and how it goes on; `None` for a finished run.
fn unfinished_text(folder: &Path, summary: &Value) -> Option<String> {
    if summary["finished"] != false {
        return None;
    }
    let config: toml::Table = read_text(&folder.join(CONFIG_FILE))?.parse().ok()?;
    let planned = config.get("steps").and_then(toml::Value::as_integer).and_then(|steps| u64::try_from(steps).ok())?;
    let done = summary["steps"].as_u64()?;
    let [done, planned] = [done, planned].map(format_grouped);
    let folder = shell_word(folder);
    let text = format!("Stopped after {done} of {planned} steps. To go on: gsscale-train --resume {folder}");
    Some(as_called(&text).into_owned())
}

fn add_finding(page: &mut Page, Finding { title, text, table, curve }: Finding) {
    page.heading(title);
    if !text.is_empty() {
        page.paragraph(&text);
    }
    if let Some((head, rows)) = table {
        let cell = |value: &Value| value.as_str().map_or_else(|| Cell::number(value.as_f64(), 2), Cell::text);
        page.table(head, rows.iter().map(|row| row.iter().map(cell).collect()));
    }
    if let Some(curve) = curve {
        let stride = curve.values.len().div_ceil(POINTS_MAX);
        let points = curve.values.iter().enumerate().step_by(stride).map(|(i, &value)| (i as f64, value)).collect();
        let chart = Chart::new(curve.title, "photo, by name", curve.unit).with("", points, Mark::LineAndDots);
        page.charts(&[(chart.svg(), curve.caption)]);
    }
}

/// Writes the report of the run in `folder` into the folder; returns its path. `progress` as for [`run_report`].
/// Errors: as [`run_report`], or the folder cannot be written.
pub fn write_run_report(folder: &Path, progress: &dyn Fn(usize, usize)) -> InputResult<PathBuf> {
    let html = run_report(folder, progress)?;
    let path = folder.join(REPORT_FILE);
    write_whole(&path, html.as_bytes())?;
    Ok(path)
}

pub(super) fn read_text(path: &Path) -> Option<String> {
    let len = std::fs::metadata(path).ok()?.len();
    (len <= TEXT_BYTES_MAX).then(|| std::fs::read_to_string(path).ok())?
}

/// A file of a run; `None` if it is missing, too large, or no JSON.
pub(super) fn read_json(path: &Path) -> Option<Value> {
    serde_json::from_str(&read_text(path)?).ok()
}

/// The complete lines of metrics.jsonl.
pub(super) fn read_metrics(folder: &Path) -> InputResult<Vec<Value>> {
    let path = folder.join(METRICS_FILE);
    let text = read_text(&path)
        .ok_or_else(|| InputError::new(&path, "cannot be read", "name the output folder of a training run"))?;
    Ok(text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect())
}

/// Points (x, y) of the lines that have both values, evenly thinned to at most about [`POINTS_MAX`].
pub(super) fn curve(metrics: &[Value], x: &str, y: impl Fn(&Value) -> Option<f64>) -> Vec<(f64, f64)> {
    let mut all: Vec<(f64, f64)> = metrics.iter().filter_map(|m| Some((m[x].as_f64()?, y(m)?))).collect();
    // A step may have a second line, with an evaluation.
    all.dedup_by_key(|point| point.0);
    let stride = all.len().div_ceil(POINTS_MAX).max(1);
    let last = all.len().saturating_sub(1);
    all.into_iter().enumerate().filter(|(i, _)| i % stride == 0 || *i == last).map(|(_, p)| p).collect()
}

fn tiles(summary: &Value, metrics: &[Value]) -> Vec<(String, &'static str)> {
    let last = metrics.last().unwrap_or(&Value::Null);
    let either = |name: &str, of_line: &str| summary[name].as_f64().or(last[of_line].as_f64());
    let decibels = |value: &Value| value.as_f64().map(|psnr| format!("{psnr:.2} dB"));
    let bytes = |name: &str| either(name, name).map(|bytes| format_bytes(bytes as u64));
    let moved = |name: &str| either(name, name).filter(|&bytes| bytes > 0.0).and_then(|_| bytes(name));
    let test = &summary["test"];
    let (corrected, half) = (&test["color_corrected"], &test["half_fitted"]);
    let tiles = [
        (decibels(&test["psnr"]), "PSNR, held-out views"),
        (test["ssim"].as_f64().map(|ssim| format!("{ssim:.3}")), "SSIM, held-out views"),
        (decibels(&test["predicted"]["predicted_psnr"]), "PSNR, exposures predicted without the photo"),
        (
            decibels(&corrected["cc_psnr"]),
            match corrected["method"].as_str() {
                Some("affine") => "colour-corrected PSNR (affine)",
                _ => "colour-corrected PSNR (quadratic)",
            },
        ),
        (decibels(&half["right_psnr"]), "PSNR, right halves as they are"),
        (
            decibels(&half["fitted_right_psnr"]),
            match half["model"].as_str() {
                Some("exposure") => "PSNR, right halves (exposure fitted on the left)",
                _ => "PSNR, right halves (appearance fitted on the left)",
            },
        ),
        (either("gaussians", "gaussians").map(short), "Gaussians"),
        (either("steps", "step").map(short), "steps"),
        (either("train_seconds", "seconds").map(|seconds| format!("{seconds:.0} s")), "training"),
        (bytes("host_bytes_peak"), "peak memory"),
        (moved("bytes_read"), "read from disk"),
        (moved("bytes_written"), "written to disk"),
    ];
    tiles.into_iter().filter_map(|(value, label)| Some((value?, label))).collect()
}

fn training_charts(metrics: &[Value]) -> Vec<(String, String)> {
    let train = |m: &Value| m["psnr"].as_f64();
    let test = |m: &Value| m["test"]["psnr"].as_f64();
    // A skipped step has the loss f64::MAX.
    let loss = |m: &Value| m["loss"].as_f64().filter(|l| *l < 1e30);
    let mut charts = Vec::new();
    let (mut chart, mean) = with_smooth(Chart::new("PSNR", "step", "dB"), curve(metrics, "step", train));
    let (held_out, mut of) = (curve(metrics, "step", test), "");
    if !held_out.is_empty() {
        chart = chart.with_color("held-out views", held_out, Mark::LineAndDots, 1);
        of = ", and of the held-out views";
    }
    charts.push((chart.svg(), format!("PSNR of the view of each logged step{mean}{of}.")));
    let (chart, mean) = with_smooth(Chart::new("Loss", "step", "loss"), curve(metrics, "step", loss));
    charts.push((chart.zero_based().svg(), format!("Loss of the view of each logged step{mean}.")));
    let rows = over_steps(metrics, "Gaussians", "", |m| m["gaussians"].as_f64());
    charts.push((rows.svg(), "Gaussians in the scene.".to_string()));
    let seconds = over_steps(metrics, "Time", "seconds of training", |m| m["seconds"].as_f64());
    let caption = "Seconds of training, without evaluation. It bends upwards as the scene grows.";
    charts.push((seconds.svg(), caption.to_string()));
    charts
}

/// A chart from zero of one value of the logged steps.
fn over_steps(metrics: &[Value], title: &str, unit: &str, y: impl Fn(&Value) -> Option<f64>) -> Chart {
    Chart::new(title, "step", unit).with("", curve(metrics, "step", y), Mark::Line).zero_based()
}

/// Adds the noisy curve of training views in a pale colour and, where it has enough points, its running mean in front. Also
/// returns the words of the caption on the mean.
fn with_smooth(chart: Chart, points: Vec<(f64, f64)>) -> (Chart, &'static str) {
    let (name, mean) = ("training view", smoothed(&points));
    if mean.is_empty() {
        return (chart.with_color(name, points, Mark::Line, 0), "");
    }
    (chart.with_color("", points, Mark::Faint, 0).with_color(name, mean, Mark::Line, 0), ", and its running mean")
}

/// Charts of memory and of the traffic between the tiers, if the run logged them.
fn tier_charts(metrics: &[Value]) -> Vec<(String, String)> {
    let mib = |name: &'static str| move |m: &Value| m[name].as_f64().map(|b| b / MIB);
    let has = |name: &str| metrics.iter().any(|m| m[name].as_f64().is_some_and(|b| b > 0.0));
    let peak = curve(metrics, "step", mib("host_bytes_peak"));
    let mut memory = Chart::new("Host memory", "step", "MiB").zero_based().with("peak", peak, Mark::Line);
    let budget = curve(metrics, "step", mib("host_bytes_budget"));
    if !budget.is_empty() {
        memory = memory.with("budget", budget, Mark::Line);
    }
    let mut charts = vec![(memory, "Largest resident size so far, and the limit of --host-mem if given.")];
    if has("bytes_read") {
        let [read, written] = ["bytes_read", "bytes_written"].map(|name| curve(metrics, "step", mib(name)));
        let traffic = Chart::new("Disk traffic", "step", "MiB since the start").zero_based();
        let traffic = traffic.with("read", read, Mark::Line).with("written", written, Mark::Line);
        let waiting = |m: &Value| m["stall_seconds"].as_f64();
        let share = |m: &Value| {
            let (hits, misses) = (m["page_hits"].as_f64()?, m["page_misses"].as_f64()?);
            (hits + misses > 0.0).then(|| hits / (hits + misses))
        };
        charts.extend([
            (traffic, "Bytes of pages read from and written to the drive."),
            (
                over_steps(metrics, "Waiting for pages", "seconds since the start", waiting),
                "Time in which a step waited for a page.",
            ),
            (
                over_steps(metrics, "Page hits", "share", share),
                "Share of needed pages that were already in memory, since the start.",
            ),
        ]);
    }
    if has("device_bytes_peak") {
        let device = over_steps(metrics, "Device memory", "MiB", mib("device_bytes_peak"));
        charts.push((device, "Peak device memory so far."));
    }
    let drawn = charts.into_iter().filter(|(chart, _)| !chart.is_empty());
    drawn.map(|(chart, caption)| (chart.svg(), caption.to_string())).collect()
}

/// What the checks of growth measured, from the one that last allowed more Gaussians to the last one.
fn growth_text(checks: &[Value], allowed: f64, gaussians: &Value) -> String {
    let more: Vec<&Value> = checks.iter().filter(|check| check["decision"] == "doubles").collect();
    let mut text = format!(
        "By its last check the run allows up to {} Gaussians (--quality). Some training photos were held out for these checks, {} of which \
         allowed more, {} not. More are allowed while held-out photos gain enough, and nearly as much as photos that the run trains on, up to the \
         number that --quality allows for the pixels of the photos.",
        short(allowed),
        more.len(),
        checks.len() - more.len()
    );
    if let (Some(since), Some(last)) = (more.last(), checks.last()) {
        let gain = |name: &str| last[name].as_f64().unwrap_or(0.0) - since[name].as_f64().unwrap_or(0.0);
        if since["step"] != last["step"] {
            text += &format!(
                " Since the last check that allowed more, held-out photos gained {:.2} dB and {:.3} of SSIM, the others {:.2} dB and {:.3}.",
                gain("psnr"),
                gain("ssim"),
                gain("trained_psnr"),
                gain("trained_ssim")
            );
        }
        if last["decision"] == "undoes" {
            text += " More Gaussians fitted noise, since the SSIM of held-out photos did not rise: the run undid the last doubling.";
        }
    }
    if gaussians.as_f64().is_some_and(|rows| rows > allowed) {
        text += " A cap (--max-gaussians) or a first PLY gave the scene more than that.";
    }
    text
}

/// Why the scene has the number of Gaussians that it has, if the run decided it.
fn add_growth(page: &mut Page, summary: &Value) {
    let checks = summary["growth"].as_array().map_or(&[][..], Vec::as_slice);
    let Some(allowed) = checks.last().and_then(|last| last["allowed"].as_f64()) else { return };
    page.heading("Number of Gaussians");
    page.paragraph(&growth_text(checks, allowed, &summary["gaussians"]));
    let of = |name: &str| checks.iter().filter_map(|c| Some((c["step"].as_f64()?, c[name].as_f64()?))).collect();
    let rows = Chart::new("Gaussians allowed", "step", "").with("", of("allowed"), Mark::LineAndDots).zero_based();
    let psnr = Chart::new("PSNR of training photos", "step", "dB").with("held out", of("psnr"), Mark::LineAndDots);
    let psnr = psnr.with("trained on", of("trained_psnr"), Mark::LineAndDots);
    let ssim = Chart::new("SSIM of training photos", "step", "").with("held out", of("ssim"), Mark::LineAndDots);
    let ssim = ssim.with("trained on", of("trained_ssim"), Mark::LineAndDots);
    let measured = |chart: Chart| (chart.svg(), "Means over as many photos of each kind at each check.".to_string());
    page.charts(&[measured(psnr), measured(ssim), (rows.svg(), "What each check allowed.".to_string())]);
}

/// What lies in a file for viewers.
fn export_text(export: &Value) -> Option<String> {
    let (file, bytes) = (export["file"].as_str()?, export["bytes"].as_u64()?);
    let count = |value: &Value| format_grouped(value.as_u64().unwrap_or(0));
    let levels: Vec<String> = export["levels"].as_array().map_or(&[][..], Vec::as_slice).iter().map(count).collect();
    let mut text = format!("{file}: {}, ", format_bytes(bytes));
    text += &match &levels[..] {
        [] => format!("{} Gaussians.", count(&export["gaussians"])),
        levels => format!("levels of detail of {} Gaussians.", levels.join(", ")),
    };
    for (name, what) in [
        ("always_shown", "giants lie in env/, beside every level."),
        ("left_out", "Gaussians of the PLY lie beyond the range of its format and are left out."),
    ] {
        if export[name].as_u64().unwrap_or(0) > 0 {
            text += &format!(" {} {what}", count(&export[name]));
        }
    }
    Some(text)
}

fn add_page_map(page: &mut Page, path: &Path) {
    let tiles: Option<Vec<PageTile>> = read_text(path).and_then(|text| serde_json::from_str(&text).ok());
    let tiles = tiles.unwrap_or_default();
    let svg = page_map_svg(&tiles);
    if svg.is_empty() {
        return;
    }
    page.heading("Pages");
    let caption =
        "The pages of the scene, seen along its shortest axis, coloured by the training views that need them.";
    page.charts(&[(svg + &page_map_legend(&tiles), caption.to_string())]);
}

/// The pictures in a folder that the list of the evaluation names, with the figures of each. Systems leave files of their own beside them,
/// which look like pictures.
pub fn listed_pictures(folder: &Path) -> BTreeMap<String, Value> {
    let list = folder.join(Path::new(VIEWS_FILE).file_name().unwrap_or_default());
    let views = read_json(&list).unwrap_or(Value::Null);
    let views = views.as_array().cloned().unwrap_or_default().into_iter();
    let named = views.filter_map(|view| Some((view["picture"].as_str()?.to_string(), view)));
    // No name leads out of the folder.
    let is_there = |name: &str| Path::new(name).file_name() == Some(OsStr::new(name)) && folder.join(name).is_file();
    named.filter(|(name, _)| is_there(name)).collect()
}

/// A picture of a run; `None`, with a warning, if it cannot be read: that must not cost the page.
pub(super) fn readable_picture(run: &Path, name: &str) -> Option<ViewPictures> {
    let picture = view_pictures(&run.join(PICTURES_FOLDER).join(name));
    picture.map_err(|error| crate::tell!("warning: {error}")).ok()
}

/// PSNR and SSIM of a view for its caption.
fn figures_of(view: &Value) -> String {
    let [psnr, ssim] = ["psnr", "ssim"].map(|name| view[name].as_f64());
    let psnr = psnr.map_or(String::from("all masked"), |psnr| format!("{psnr:.2} dB"));
    psnr + &ssim.map_or(String::new(), |ssim| format!(", SSIM {ssim:.3}"))
}

fn add_views(page: &mut Page, run: &Path, progress: &dyn Fn(usize, usize)) {
    let views = listed_pictures(&run.join(PICTURES_FOLDER));
    if views.is_empty() {
        return;
    }
    page.heading("Held-out views");
    let stride = views.len().div_ceil(VIEWS_MAX);
    if stride > 1 {
        page.paragraph(&format!("{} of {} views; renders/test has all.", views.len().div_ceil(stride), views.len()));
    }
    let mut sliders = Vec::new();
    for (i, (file, view)) in views.iter().step_by(stride).enumerate() {
        if let Some(pictures) = readable_picture(run, file) {
            let sides = [("render", pictures.render.as_str()), ("photo", &pictures.photo)];
            let name = file.trim_end_matches(".png");
            sliders.push(slider(name, &figures_of(view), sides, ("difference", &pictures.difference)));
        }
        progress(i + 1, views.len().div_ceil(stride));
    }
    page.views(&sliders);
}
