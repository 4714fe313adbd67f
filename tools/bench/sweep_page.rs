//! The page and the table of a sweep: the figures of its settings against those of the reference, and charts.
//!
//! Every value of a setting is a mean over seeds. A list says which figures are shown ([`View`]).

use super::front::{Setting, Spread, Verdict, against, pareto_front, settings};
use super::record::{Figure, RunRecord};
use gsscale::base::say::aligned;
use gsscale::report::chart::{Bars, Chart, Mark};
use gsscale::report::html::{Cell, Page};
use serde::Deserialize;

/// Number of the front's colour, grey.
const FRONT_COLOR: usize = 4;

/// What a page shows: the table `[view]` of a list.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct View {
    pub title: String,
    /// Group and name of the run that all others are compared with, `group/name`.
    pub reference: String,
    pub figures: Vec<Figure>,
    pub charts: Vec<ChartOf>,
}

/// A chart of a figure: bars, one for each setting, or points against another figure.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct ChartOf {
    pub figure: Figure,
    /// The other figure: a cost.
    pub against: Option<Figure>,
    /// Show how much lower the figure is than that of the reference with the same seed.
    #[serde(default)]
    pub lost: bool,
    /// Show the other figure on a logarithmic axis.
    #[serde(default)]
    pub log: bool,
}

pub fn sweep_page(view: &View, scene: &str, facts: &str, records: &[RunRecord]) -> String {
    let settings = settings(records, &view.reference);
    let mut page = Page::new(&format!("gsscale: {}, {scene}", view.title), facts);
    page.paragraph(&explanation(view, &settings));
    page.paragraph(&equal_bits(records));
    for chart in &view.charts {
        let svg = match &chart.against {
            Some(cost) => points(&settings, &chart.figure, cost).map(|points| match chart.log {
                true => points.logarithmic().svg(),
                false => points.svg(),
            }),
            None => Some(bars(view, &settings, chart).svg()),
        };
        svg.iter().for_each(|svg| page.wide_chart(svg, ""));
    }
    page.heading("All figures");
    let (names, rows) = cells(view, &settings);
    let last = names.len() - 1;
    let cell = |(i, text): (usize, String)| if i == 0 || i == last { Cell::Text(text) } else { Cell::Number(text) };
    page.table(
        names.iter().map(String::as_str),
        rows.into_iter().map(|row| row.into_iter().enumerate().map(cell).collect()),
    );
    page.finish()
}

/// The table of the page as Markdown, and which runs ended with the same bits.
pub fn sweep_table(view: &View, records: &[RunRecord]) -> String {
    let (names, rows) = cells(view, &settings(records, &view.reference));
    let table = aligned(&[vec![names], rows].concat());
    let rule = table[0].iter().enumerate().map(|(i, cell)| match (i, cell.chars().count()) {
        (0, width) => "-".repeat(width + 2),
        (_, width) => format!("{}:", "-".repeat(width + 1)),
    });
    let mut lines: Vec<String> = table.iter().map(|row| format!("| {} |\n", row.join(" | "))).collect();
    lines.insert(1, format!("|{}|\n", rule.collect::<Vec<_>>().join("|")));
    let said = equal_bits(records);
    lines.concat() + if said.is_empty() { "" } else { "\n" } + &said
}

fn explanation(view: &View, settings: &[Setting]) -> String {
    let seeds = settings.iter().find(|s| s.verdict == Verdict::Reference).map_or(0, |s| s.runs.len());
    let rule = match seeds {
        0 => "The reference has not run yet, so no setting is judged.".to_string(),
        1 => "The reference has one seed and therefore no known spread: only settings with the same bits are judged."
            .to_string(),
        n => format!(
            "A setting costs no accuracy if its PSNR and SSIM are at least those of the reference with the same seeds, \
             minus the spread of the reference (highest minus lowest) over {n} seeds."
        ),
    };
    let is_other_program = |setting: &Setting| setting.runs.iter().any(|run| run.seconds.is_nan());
    let other_programs = match settings.iter().any(is_other_program) {
        true => " Other programs were measured elsewhere, on the same photos.",
        false => "",
    };
    format!(
        "Every run was a process of its own.{other_programs} Values are means over seeds; the reference is {}. Times are those of the \
         training steps, without loading and evaluation. Bytes written include the commit after the last step. A grey \
         line joins the settings that no other setting beats. {rule}",
        view.reference
    )
}

/// Says whether the runs of each class ended with the same bits.
fn equal_bits(records: &[RunRecord]) -> String {
    let done = || records.iter().filter(|r| r.problem.is_none() && !r.bits.is_empty());
    let mut classes: Vec<(&str, u64)> = done().map(|r| (r.bits.as_str(), r.seed)).collect();
    classes.sort_unstable();
    classes.dedup();
    let of_class = |(bits, seed)| {
        let runs: Vec<&RunRecord> = done().filter(|r| r.bits == bits && r.seed == seed).collect();
        let names = runs.iter().map(|r| r.name.as_str()).collect::<Vec<_>>().join(", ");
        match runs.iter().all(|r| r.ply == runs[0].ply) {
            _ if runs.len() < 2 => None,
            true => Some(format!("The results of {names} are the same, byte for byte.")),
            false => Some(format!("The results of {names} DIFFER, which is a fault.")),
        }
    };
    let mut said: Vec<String> = classes.into_iter().filter_map(of_class).collect();
    said.dedup();
    said.join(" ")
}

/// Names of the columns, and a row for each setting.
fn cells(view: &View, settings: &[Setting]) -> (Vec<String>, Vec<Vec<String>>) {
    let named: Vec<String> = settings.iter().map(|s| named(&s.runs)).collect();
    let has_named = named.iter().any(|text| !text.is_empty());
    let mut names = vec!["run".to_string(), "seeds".to_string()];
    for (i, figure) in view.figures.iter().enumerate() {
        names.push(figure.title.to_string());
        if i == 0 {
            names.extend(["to reference", "range"].map(str::to_string));
        }
    }
    names.extend(has_named.then(|| "wrong views named, +right ones".to_string()));
    names.push("accuracy".to_string());
    let reference = settings.iter().find(|s| s.verdict == Verdict::Reference);
    let row = |(setting, named): (&Setting, &String)| {
        let mut row = vec![setting.name.clone(), setting.runs.len().to_string()];
        for (i, figure) in view.figures.iter().enumerate() {
            let spread = setting.spread(figure.of);
            row.push(spread.map_or(String::new(), |s| figure.write(s.mean)));
            if i == 0 {
                let difference = reference.and_then(|reference| against(setting, reference, figure.of));
                row.push(difference.map_or(String::new(), |d| figure.write_difference(d.mean)));
                row.push(spread.map_or(String::new(), |s| range(figure, s)));
            }
        }
        row.extend(has_named.then(|| named.clone()));
        row.push(match &setting.problem {
            Some(problem) if setting.runs.is_empty() => format!("failed: {problem}"),
            _ => setting.verdict.words().to_string(),
        });
        row
    };
    (names, settings.iter().zip(&named).map(row).collect())
}

/// Lowest and highest value, if they differ.
fn range(figure: &Figure, spread: Spread) -> String {
    match spread.width() > 0.0 {
        true => format!("{} to {}", figure.write(spread.low), figure.write(spread.high)),
        false => String::new(),
    }
}

/// Over all seeds: wrong views that were named of the wrong views, and right views that were named. Empty if no view is wrong or
/// named.
fn named(runs: &[RunRecord]) -> String {
    let sum = |of: &dyn Fn(&RunRecord) -> usize| runs.iter().map(of).sum::<usize>();
    let found = sum(&|run| run.outlier_views.iter().filter(|name| run.wrong_views.contains(name)).count());
    match (sum(&|run| run.wrong_views.len()), sum(&|run| run.outlier_views.len())) {
        (0, 0) => String::new(),
        (0, named) => format!("+{named}"),
        (wrong, named) => format!("{found}/{wrong} +{}", named - found),
    }
}

/// A bar for each setting. A missing value is a dash.
fn bars(view: &View, settings: &[Setting], chart: &ChartOf) -> Bars {
    let reference = settings.iter().find(|s| s.verdict == Verdict::Reference);
    let figure = &chart.figure;
    let bar = |setting: &Setting| {
        let spread = match chart.lost {
            true => reference.and_then(|r| against(setting, r, |run| Some(-(figure.of)(run)?))),
            false => setting.spread(figure.of),
        };
        let written = spread.map(|s| match range(figure, s) {
            range if range.is_empty() => figure.write(s.mean),
            range => format!("{} ({range})", figure.write(s.mean)),
        });
        let missing = if setting.problem.is_some() { "failed" } else { "–" };
        (setting.name.clone(), spread.map(|s| s.mean), written.unwrap_or_else(|| missing.to_string()))
    };
    let title = match chart.lost {
        true => format!("{}: lost against {}", figure.title, view.reference),
        false => figure.title.to_string(),
    };
    Bars { title, bars: settings.iter().map(bar).collect() }
}

/// A chart of a figure against a cost; `None` if all settings cost the same or the cost is unknown.
fn points(settings: &[Setting], figure: &Figure, cost: &Figure) -> Option<Chart> {
    let ((scale, axis), (own_scale, own_axis)) = (cost.axis(), figure.axis());
    let point = |s| {
        let own = Setting::spread(s, figure.of)?;
        Some((s, scale * Setting::spread(s, cost.of)?.mean, [own.mean, own.low, own.high].map(|v| own_scale * v)))
    };
    let points: Vec<(&Setting, f64, [f64; 3])> = settings.iter().filter_map(point).collect();
    if points.iter().all(|p| p.1 == points[0].1) {
        return None;
    }
    let mut chart = Chart::new(&format!("{own_axis} against {axis}"), &axis, &own_axis).wide();
    let front = pareto_front(&points.iter().map(|p| (p.1, p.2[0])).collect::<Vec<_>>());
    let line: Vec<(f64, f64)> = front.iter().map(|&i| (points[i].1, points[i].2[0])).collect();
    chart = chart.with_color("Pareto front", line, Mark::Line, FRONT_COLOR);
    let mut groups: Vec<&str> = Vec::new();
    for group in points.iter().map(|p| p.0.runs[0].group()) {
        if !groups.contains(&group) {
            groups.push(group);
        }
    }
    for (i, group) in groups.iter().enumerate() {
        // Skips the colour of the front.
        let color = if i < FRONT_COLOR { i } else { i + 1 };
        let own = points.iter().filter(|p| p.0.runs[0].group() == *group).map(|p| (p.1, p.2[0])).collect();
        chart = chart.with_color(group, own, Mark::Dots, color);
    }
    chart.ranges = points.iter().filter(|p| p.2[2] > p.2[1]).map(|p| (p.1, p.2[1], p.2[2])).collect();
    // Labels of the front come first and get the best places.
    let rest = (0..points.len()).filter(|i| !front.contains(i));
    let label = |i: usize| (points[i].1, points[i].2[0], points[i].0.name.clone());
    chart.labels = front.iter().copied().chain(rest).map(label).collect();
    Some(chart)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view() -> View {
        let text = "title = \"test\"\nreference = \"clean/none\"\nfigures = [\"psnr\", \"bytes-read\"]\n\
                    charts = [{ figure = \"psnr\", lost = true }, { figure = \"psnr\", against = \"seconds\" }]";
        toml::from_str(text).unwrap()
    }

    fn run(name: &str, seed: u64, psnr: f64, ply: &str) -> RunRecord {
        let (name, bits, ply) = (name.to_string(), "host".to_string(), ply.to_string());
        let key = format!("{name} {seed}");
        RunRecord {
            key,
            name,
            bits,
            ply,
            seed,
            psnr: Some(psnr),
            ssim: Some(0.5),
            seconds: psnr,
            ..RunRecord::default()
        }
    }

    #[test]
    fn differences_are_paired_by_seed_and_failures_are_shown() {
        let mut records = vec![
            run("clean/none", 1, 26.0, "a"),
            run("clean/none", 2, 25.0, "b"),
            run("boxes/none", 1, 22.0, "c"),
            run("boxes/none", 2, 22.0, "d"),
            run("boxes/own", 2, 24.5, "e"),
        ];
        records[4].wrong_views = vec!["a".into(), "b".into()];
        records[4].outlier_views = vec!["b".into(), "c".into()];
        let problem = Some("no <space>".to_string());
        records.push(RunRecord { problem, ..run("boxes/all", 1, 0.0, "") });
        let table = sweep_table(&view(), &records);
        let row = |name: &str| {
            let line = table.lines().find(|line| line.contains(name)).unwrap();
            line.split('|').map(str::trim).filter(|cell| !cell.is_empty()).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(row("clean/none"), "clean/none 2 25.50 +0.00 25.00 to 26.00 0 B the reference", "{table}");
        assert_eq!(row("boxes/none"), "boxes/none 2 22.00 -3.50 0 B costs");
        assert_eq!(row("boxes/own"), "boxes/own 1 24.50 -0.50 0 B 1/2 +1 no cost beyond the spread");
        assert!(row("boxes/all").ends_with("failed: no <space>"));
        let page = sweep_page(&view(), "scene", "facts", &records);
        for part in ["failed: no &lt;space&gt;", "3.50 (3.00 to 4.00)", "Pareto front", "over 2 seeds"] {
            assert!(page.contains(part), "{part}");
        }
    }

    #[test]
    fn a_run_with_other_bits_is_reported() {
        let mut records = vec![run("overlap", 1, 26.0, "a"), run("memory", 1, 26.0, "a"), run("device", 1, 26.1, "x")];
        records[2].bits = "device".into();
        assert_eq!(equal_bits(&records), "The results of overlap, memory are the same, byte for byte.");
        records[1].ply = "b".into();
        assert!(sweep_table(&view(), &records).contains("overlap, memory DIFFER"));
        records[1].problem = Some("died".into());
        assert_eq!(equal_bits(&records), "");
    }

    #[test]
    fn figures_are_known_by_name() {
        assert!(toml::from_str::<View>("figures = [\"psnr\"]\ntitle = \"\"\nreference = \"\"\ncharts = []").is_ok());
        let error = toml::from_str::<View>("figures = [\"beauty\"]\ntitle = \"\"\nreference = \"\"\ncharts = []");
        assert!(error.unwrap_err().to_string().contains("beauty is no figure; the figures are psnr, ssim"));
    }
}
