//! A page that compares finished runs: figures, curves, and renders of the same held-out views.
//!
//! Invariants: 1. missing files of a run make its part shorter; only a folder without metrics is an error; 2. the
//! number of pictures is bounded; 3. PSNR and SSIM of a run with `evaluated.json` are from that file (a sweep evaluates
//! runs on the photos of its base); other settings that make figures incomparable with the first run appear as remarks.

use super::chart::{Chart, Mark};
use super::html::{Cell, Page, slider};
use super::run_files::{CONFIG_FILE, EVALUATED_AS_FILE, EVALUATED_FILE, PICTURES_FOLDER, SUMMARY_FILE, VIEWS_FILE};
use super::run_report::{curve, listed_pictures, read_json, read_metrics, read_text, readable_picture};
use crate::base::error::InputResult;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Most sliders: a file with more opens slowly.
const SLIDERS_MAX: usize = 12;
/// Keys that make photos smaller, and so raise PSNR.
const PHOTO_KEYS: [&str; 2] = ["data-factor", "max-resolution"];
/// Follows the names of runs that have remarks.
const STAR: &str = " *";

/// A run of the comparison.
struct Compared {
    name: String,
    folder: PathBuf,
    metrics: Vec<Value>,
    summary: Value,
    /// Source of the held-out figures: the summary or a later evaluation.
    judged: Value,
    is_evaluated_again: bool,
    /// Values of [`PHOTO_KEYS`] in training.
    trained_on: [Option<f64>; 2],
    /// Values of [`PHOTO_KEYS`] for the held-out figures.
    judged_on: [Option<f64>; 2],
    /// Pictures of the held-out views, if known.
    held_out: Option<BTreeSet<String>>,
    /// Differences to the first run that matter for the comparison.
    remarks: Vec<String>,
}

impl Compared {
    fn read(folder: &Path, name: String) -> InputResult<Compared> {
        let metrics = read_metrics(folder)?;
        let json = |name: &str| read_json(&folder.join(name)).unwrap_or(Value::Null);
        let (summary, evaluated) = (json(SUMMARY_FILE), json(EVALUATED_FILE));
        let is_evaluated_again = evaluated["test"]["psnr"].is_number();
        let trained_on = photos(&folder.join(CONFIG_FILE));
        let (judged, judged_on) = match is_evaluated_again {
            true => (evaluated, photos(&folder.join(EVALUATED_AS_FILE))),
            false => (summary.clone(), trained_on),
        };
        // A later evaluation lists no views.
        let listed = json(VIEWS_FILE).as_array().cloned().filter(|views| !is_evaluated_again && !views.is_empty());
        let held_out = listed.map(|views| views.iter().map(|view| view["picture"].to_string()).collect());
        let (folder, remarks) = (folder.to_path_buf(), Vec::new());
        Ok(Compared {
            name,
            folder,
            metrics,
            summary,
            judged,
            is_evaluated_again,
            trained_on,
            judged_on,
            held_out,
            remarks,
        })
    }

    /// Why the held-out figures are of other photos than those of the first run, as far as known.
    fn other_photos(&self, first: &Compared) -> Option<&'static str> {
        let scene = |run: &Compared| {
            let path = PathBuf::from(run.judged["scene"].as_str()?);
            Some(path.canonicalize().unwrap_or(path))
        };
        // A relative path may have been meant from another folder.
        let is_other = |(own, first): (PathBuf, PathBuf)| !own.ends_with(&first) && !first.ends_with(&own);
        if scene(self).zip(scene(first)).is_some_and(is_other) {
            return Some("judged on another scene");
        }
        let views = |run: &Compared| run.judged["test"]["views"].as_u64();
        let differ = views(self).zip(views(first)).is_some_and(|(own, first)| own != first)
            || self.held_out.as_ref().zip(first.held_out.as_ref()).is_some_and(|(own, first)| own != first);
        differ.then_some("judged on other held-out photos")
    }

    fn psnr(&self) -> Option<f64> {
        self.judged["test"]["psnr"].as_f64()
    }

    /// Name in tables and charts.
    fn label(&self) -> String {
        format!("{}{}", self.name, if self.remarks.is_empty() { "" } else { STAR })
    }

    /// Differences to the first run that matter for the comparison.
    fn remarks(&self, first: &Compared) -> Vec<String> {
        let mut remarks = Vec::new();
        for (what, own, first) in
            [("trained", self.trained_on, first.trained_on), ("judged", self.judged_on, first.judged_on)]
        {
            let pairs = PHOTO_KEYS.iter().zip(own.into_iter().zip(first));
            let both = pairs.filter_map(|(key, (own, first))| Some((key, own?, first?)));
            let others = both.filter(|(_, own, first)| own != first);
            // In f64, 1.2 * 1.5 differs from 1.8.
            let round = |x: f64| (x * 1e4).round() / 1e4;
            remarks.extend(
                others.map(|(key, own, first)| format!("{what} with {key} {} instead of {}", round(own), round(first))),
            );
        }
        remarks.extend(self.other_photos(first).map(String::from));
        let variant = |run: &Compared| run.judged["ssim_variant"].as_str().map(str::to_string);
        if let Some((own, first)) = variant(self).zip(variant(first)).filter(|(own, first)| own != first) {
            remarks.push(format!("SSIM is {own} instead of {first}"));
        }
        if self.is_evaluated_again {
            remarks.push(format!("PSNR and SSIM are of {EVALUATED_FILE}"));
        }
        remarks
    }
}

/// Values of [`PHOTO_KEYS`] in a config file; `None` for a missing file or key.
fn photos(config: &Path) -> [Option<f64>; 2] {
    let table: Option<toml::Table> = read_text(config).and_then(|text| text.parse().ok());
    let number = |value: &toml::Value| value.as_float().or_else(|| value.as_integer().map(|i| i as f64));
    PHOTO_KEYS.map(|key| table.as_ref().and_then(|table| table.get(key)).and_then(number))
}

/// The page that compares the runs in `folders`. Errors: a folder holds no metrics.
pub fn compare_report(folders: &[PathBuf]) -> InputResult<String> {
    let mut runs = Vec::new();
    for (folder, name) in folders.iter().zip(names(folders)) {
        runs.push(Compared::read(folder, name)?);
    }
    let remarks: Vec<Vec<String>> = runs.iter().map(|run| run.remarks(&runs[0])).collect();
    runs.iter_mut().zip(remarks).for_each(|(run, remarks)| run.remarks = remarks);
    let scenes: BTreeSet<&str> = runs.iter().filter_map(|r| r.summary["scene"].as_str()).collect();
    let scenes = scenes.into_iter().collect::<Vec<_>>().join(", ");
    let mut page = Page::new("gsscale: comparison", &format!("{} runs; {scenes}", folders.len()));
    add_table(&mut page, &runs);
    page.heading("Over steps and seconds");
    let caption = if runs.iter().all(|run| run.remarks.is_empty()) { "" } else { CAPTION };
    for chart in charts(&runs) {
        page.wide_chart(&chart.svg(), caption);
    }
    add_views(&mut page, &runs);
    Ok(page.finish())
}

/// The folder names if they are distinct, else the paths.
fn names(folders: &[PathBuf]) -> Vec<String> {
    let short = |folder: &PathBuf| folder.file_name().map(|n| n.to_string_lossy().into_owned());
    let distinct: BTreeSet<Option<String>> = folders.iter().map(short).collect();
    let is_clear = distinct.len() == folders.len();
    let long = |folder: &PathBuf| folder.display().to_string();
    folders.iter().map(|f| short(f).filter(|_| is_clear).unwrap_or_else(|| long(f))).collect()
}

/// A curve of the comparison: title, unit, and value of a line of metrics.
type RunCurve = (&'static str, &'static str, fn(&Value) -> Option<f64>);

const CURVES: [RunCurve; 4] = [
    ("PSNR of held-out views", "dB", |m| m["test"]["psnr"].as_f64()),
    ("PSNR of training views", "dB", |m| m["psnr"].as_f64()),
    ("Gaussians", "", |m| m["gaussians"].as_f64()),
    ("Read from the drive", "GB", |m| m["bytes_read"].as_f64().filter(|b| *b > 0.0).map(|b| b / 1e9)),
];

/// Explains the star.
const CAPTION: &str = "* trained or judged differently from the first run, see the remarks. Curves are from each run's own \
                       photos. A run that was evaluated again on other photos has a single dot at its end.";

fn charts(runs: &[Compared]) -> Vec<Chart> {
    let mut charts = Vec::new();
    for (title, unit, of) in CURVES {
        for (x, axis) in [("step", "step"), ("seconds", "seconds of training")] {
            if x == "seconds" && unit != "dB" {
                continue;
            }
            let mut chart = Chart::new(&format!("{title} over {axis}"), axis, unit).wide();
            for run in runs {
                let is_test = title == CURVES[0].0;
                // Values from other photos than the final value must not join its line.
                let is_other = is_test && run.is_evaluated_again && run.judged_on != run.trained_on;
                let mut points = if is_other { Vec::new() } else { curve(&run.metrics, x, of) };
                if is_test {
                    // A later evaluation replaces that of the run, which the metrics hold.
                    let end = if x == "step" { &run.summary["steps"] } else { &run.summary["train_seconds"] };
                    points.retain(|&(at, _)| Some(at) != end.as_f64());
                    points.extend(end.as_f64().zip(run.psnr()));
                }
                chart = chart.with(&run.label(), points, if is_test { Mark::LineAndDots } else { Mark::Line });
            }
            if !chart.is_empty() {
                charts.push(chart);
            }
        }
    }
    charts
}

/// Renders of the views that all runs have: each run against the first run.
fn add_views(page: &mut Page, runs: &[Compared]) {
    let Some((first, others)) = runs.split_first().filter(|(_, others)| !others.is_empty()) else { return };
    let mut common = listed_pictures(&first.folder.join(PICTURES_FOLDER));
    for run in others {
        let own = listed_pictures(&run.folder.join(PICTURES_FOLDER));
        common.retain(|name, _| own.contains_key(name));
    }
    if common.is_empty() {
        return;
    }
    page.heading("Held-out views of all runs");
    let shown = others.len().min(SLIDERS_MAX);
    let (runs, views) = (evenly(others.len(), shown), evenly(common.len(), SLIDERS_MAX / shown));
    let (sliders, all) = (runs.len() * views.len(), others.len() * common.len());
    if sliders < all {
        page.paragraph(&format!(
            "{sliders} of {all} pairs of a run and a view are shown, {} are left out. The runs have all pictures in \
             renders/test.",
            all - sliders
        ));
    }
    let common: Vec<&String> = common.keys().collect();
    let mut sliders = Vec::new();
    for name in views.iter().map(|&view| common[view]) {
        let Some(left) = readable_picture(&first.folder, name) else { continue };
        for run in runs.iter().map(|&run| &others[run]) {
            let Some(right) = readable_picture(&run.folder, name) else { continue };
            let sides = [(first.name.as_str(), left.render.as_str()), (run.name.as_str(), right.render.as_str())];
            sliders.push(slider(name.trim_end_matches(".png"), "", sides, ("photo", &left.photo)));
        }
    }
    page.views(&sliders);
}

/// At most `max` of the numbers below `count`, evenly spaced.
fn evenly(count: usize, max: usize) -> Vec<usize> {
    let chosen = max.min(count);
    (0..chosen).map(|i| i * count / chosen).collect()
}

fn add_table(page: &mut Page, runs: &[Compared]) {
    let first = &runs[0];
    let against = |run: &Compared| {
        // PSNR on other photos, or on photos of another size, as far as known, is a different measure.
        let mut sizes = run.judged_on.into_iter().zip(first.judged_on);
        let is_same_size = sizes.all(|(own, first)| own.zip(first).is_none_or(|(own, first)| own == first));
        let is_same_measure = is_same_size && run.other_photos(first).is_none();
        let both = run.psnr().zip(first.psnr()).filter(|_| run.folder != first.folder && is_same_measure);
        both.map(|(own, first)| own - first)
    };
    let row = |run: &Compared| {
        let number = |key: &str, digits: usize| Cell::number(run.summary[key].as_f64(), digits);
        let bytes = |key: &str| Cell::bytes(run.summary[key].as_f64());
        vec![
            Cell::text(run.label()),
            Cell::number(run.psnr(), 3),
            Cell::difference(against(run), 3),
            Cell::number(run.judged["test"]["ssim"].as_f64(), 4),
            number("gaussians", 0),
            number("steps", 0),
            number("train_seconds", 1),
            number("train_cpu_seconds", 1),
            bytes("host_bytes_peak"),
            bytes("bytes_read"),
            bytes("bytes_written"),
            Cell::text(run.remarks.join("; ")),
        ]
    };
    let costs = ["seconds", "CPU s", "peak memory", "read", "written", "remarks"];
    let head = ["run", "PSNR, dB", "against the first", "SSIM", "Gaussians", "steps"];
    page.table(head.into_iter().chain(costs), runs.iter().map(row));
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;
    use tempfile::TempDir;

    /// A finished run with these held-out figures and `views` pictures.
    fn run(parent: &Path, name: &str, (psnr, factor, ssim): (f64, f64, &str), views: usize) -> PathBuf {
        let folder = parent.join(name);
        std::fs::create_dir_all(folder.join(PICTURES_FOLDER)).unwrap();
        let line = json!({"step": 4, "psnr": 20.0, "gaussians": 9, "seconds": 1.0, "test": {"psnr": 77.0}});
        std::fs::write(folder.join("metrics.jsonl"), format!("{line}\n")).unwrap();
        let test = json!({"views": views, "psnr": psnr, "ssim": 0.5});
        let summary = json!({"steps": 10, "train_seconds": 2.0, "test": test, "ssim_variant": ssim});
        std::fs::write(folder.join("summary.json"), summary.to_string()).unwrap();
        std::fs::write(folder.join("config.toml"), config(factor)).unwrap();
        for view in 0..views {
            let picture = image::RgbImage::from_pixel(4, 2, image::Rgb([view as u8, 20, 30]));
            picture.save(folder.join(format!("renders/test/view{view:02}.png"))).unwrap();
        }
        let list: Vec<Value> = (0..views).map(|view| json!({"picture": format!("view{view:02}.png")})).collect();
        std::fs::write(folder.join(VIEWS_FILE), json!(list).to_string()).unwrap();
        folder
    }

    fn config(factor: f64) -> String {
        format!("data-factor = {factor:.1}\nmax-resolution = 0\n\n[resolved]\nversion = \"x\"\n")
    }

    fn evaluate(folder: &Path, psnr: f64, ssim: &str) {
        let report = json!({"ssim_variant": ssim, "test": {"views": 0, "psnr": psnr, "ssim": 0.25}});
        std::fs::write(folder.join(EVALUATED_FILE), report.to_string()).unwrap();
    }

    #[test]
    fn runs_on_smaller_photos_use_their_evaluation_or_have_a_remark() {
        let parent = TempDir::new().unwrap();
        let base = run(parent.path(), "base", (26.0, 1.0, "same"), 0);
        let half = run(parent.path(), "half", (28.5, 2.0, "same"), 0);
        let valid = run(parent.path(), "valid", (26.5, 1.0, "valid"), 0);
        let page = compare_report(&[base.clone(), half.clone(), valid]).unwrap();
        let marks = "<td>trained with data-factor 2 instead of 1; judged with data-factor 2 instead of 1</td>";
        assert!(page.contains("<td>half *</td>") && page.contains("28.500") && page.contains(marks), "{page}");
        assert!(!page.contains("+2.500"), "other photos make another measure");
        assert!(page.contains("<td>SSIM is valid instead of same</td>") && page.contains("+0.500"));
        assert!(page.contains("<td>base</td>") && page.contains(&CAPTION[..40]));

        // The files that a sweep writes.
        evaluate(&half, 25.25, "same");
        std::fs::write(half.join(EVALUATED_AS_FILE), config(1.0)).unwrap();
        let page = compare_report(&[base.clone(), half.clone()]).unwrap();
        assert!(page.contains("25.250") && page.contains("-0.750") && page.contains("0.2500"), "{page}");
        assert!(!page.contains("28.500") && !page.contains("judged with"));
        let marks = "<td>trained with data-factor 2 instead of 1; PSNR and SSIM are of evaluated.json</td>";
        assert!(page.contains(marks), "{page}");

        // Without the config of the evaluation, the photos are unknown.
        std::fs::remove_file(half.join(EVALUATED_AS_FILE)).unwrap();
        assert!(compare_report(&[base.clone(), half]).unwrap().contains("-0.750"));
        let alike = compare_report(&[base.clone(), base]).unwrap();
        assert!(!alike.contains(" *<") && !alike.contains("trained or judged differently"));
    }

    #[test]
    fn other_held_out_photos_have_a_remark_and_no_difference() {
        let parent = TempDir::new().unwrap();
        let of_scene = |name: &str, psnr: f64, views: usize, scene: &str| {
            let folder = run(parent.path(), name, (psnr, 1.0, "same"), views);
            let summary = std::fs::read_to_string(folder.join(SUMMARY_FILE)).unwrap();
            let summary = summary.replacen('{', &format!("{{\"scene\":\"{scene}\","), 1);
            std::fs::write(folder.join(SUMMARY_FILE), summary).unwrap();
            folder
        };
        let base = of_scene("base", 26.0, 2, "scans/a");
        let against = |folder: PathBuf| compare_report(&[base.clone(), folder]).unwrap();
        let fewer = against(of_scene("fewer", 27.5, 1, "scans/a"));
        assert!(fewer.contains("<td>judged on other held-out photos</td>") && !fewer.contains("+1.500"), "{fewer}");
        let elsewhere = against(of_scene("elsewhere", 27.5, 2, "scans/b"));
        assert!(elsewhere.contains("<td>judged on another scene</td>") && !elsewhere.contains("+1.500"));
        let moved = of_scene("moved", 27.5, 2, "/data/scans/a");
        assert!(against(moved.clone()).contains("+1.500"), "the same scene by its absolute path");
        std::fs::write(moved.join(VIEWS_FILE), r#"[{"picture": "view00.png"}, {"picture": "view07.png"}]"#).unwrap();
        assert!(against(moved).contains("<td>judged on other held-out photos</td>"));
    }

    #[test]
    fn the_curve_of_held_out_views_does_not_join_figures_of_other_photos() {
        let parent = TempDir::new().unwrap();
        let half = run(parent.path(), "half", (28.5, 2.0, "same"), 0);
        let points = |folder: &Path| {
            let run = Compared::read(folder, "half".into()).unwrap();
            charts(&[run]).remove(0).series.remove(0).points
        };
        assert_eq!(points(&half), [(4.0, 77.0), (10.0, 28.5)]);
        evaluate(&half, 25.25, "same");
        assert_eq!(points(&half), [(10.0, 25.25)]);
        std::fs::write(half.join(EVALUATED_AS_FILE), config(2.0)).unwrap();
        assert_eq!(points(&half), [(4.0, 77.0), (10.0, 25.25)]);
    }

    #[test]
    fn pages_of_many_runs_are_bounded_and_report_omitted_pairs() {
        let parent = TempDir::new().unwrap();
        let folder = |i: usize, views: usize| {
            let name = format!("resolution-1-2-seed1-{i:08}-of-{views}");
            run(parent.path(), &name, (26.0, 1.0, "same"), views)
        };
        for (runs, views, shown) in [(40, 2, 12), (3, 20, 12), (14, 1, 12), (6, 5, 10), (3, 2, 4), (2, 12, 12)] {
            let folders: Vec<PathBuf> = (0..runs).map(|i| folder(i, views)).collect();
            let page = compare_report(&folders).unwrap();
            assert_eq!(page.matches("class=\"slider\"").count(), shown, "{runs} runs, {views} views");
            let all = (runs - 1) * views;
            let said = format!("{shown} of {all} pairs of a run and a view are shown, {} are left out", all - shown);
            assert_eq!(page.contains(&said), shown < all, "{said}");
            assert!(runs < 40 || page.contains("viewBox=\"0 0 1040 840\""), "charts are as high as their legends");
        }
        assert_eq!(evenly(5, 2), [0, 2]);
        assert_eq!([evenly(3, 9), evenly(0, 9)], [vec![0, 1, 2], vec![]]);
    }
}
