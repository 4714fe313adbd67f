//! Our figures beside the published figures, as text, as JSON and as a page.
//!
//! Invariant: a difference appears only between figures of the same measure (same SSIM padding, same LPIPS network and
//! input range). Every output lists the differences between this run and the published run.

use gsscale::base::say::aligned;
use gsscale::base::units::format_bytes;
use gsscale::config::file::TrainConfig;
use gsscale::config::published::PublishedRun;
use gsscale::optim::moments::Moments;
use gsscale::render::metrics::SsimVariant;
use gsscale::report::html::{Cell, Page};
use gsscale::report::run_files::PUBLISHED_PAGE_FILE;
use gsscale::train::log::report::{Summary, TestMetrics};
use serde_json::{Value, json};
use std::path::Path;

pub struct Ours {
    /// Means over the held-out views.
    pub test: Option<TestMetrics>,
    pub ssim_variant: SsimVariant,
    pub lpips_variant: Option<String>,
    summary: Summary,
    /// Bytes of all Gaussians with their moments and statistics.
    state_bytes: u64,
}

impl Ours {
    /// The figures of a finished run.
    pub fn new(summary: Summary, config: &TrainConfig) -> Ours {
        let floats = 11 + 3 * (u64::from(config.sh_degree) + 1).pow(2);
        let moment_bytes = match config.moments {
            Moments::F32 => 4,
            Moments::Bf16 => 2,
        };
        Ours {
            test: summary.test,
            ssim_variant: config.ssim_variant,
            lpips_variant: None,
            state_bytes: summary.gaussians * floats * (4 + 2 * moment_bytes),
            summary,
        }
    }

    fn costs(&self) -> String {
        let Summary { gaussians, steps, train_seconds, host_bytes_peak, .. } = self.summary;
        format!(
            "{gaussians} Gaussians after {steps} steps, {train_seconds:.1} s of training; peak host memory {}; Gaussians \
             with their moments {}",
            format_bytes(host_bytes_peak),
            format_bytes(self.state_bytes)
        )
    }

    fn json(&self) -> Value {
        let summary = &self.summary;
        json!({
            "test": self.test,
            "ssim_variant": self.ssim_variant,
            "lpips_variant": self.lpips_variant,
            "gaussians": summary.gaussians,
            "steps": summary.steps,
            "train_seconds": summary.train_seconds,
            "host_bytes_peak": summary.host_bytes_peak,
            "state_bytes": self.state_bytes,
            "bytes_read": summary.tiers.stats.bytes_read,
            "bytes_written": summary.tiers.stats.bytes_written,
        })
    }
}

struct Row {
    measure: String,
    ours: Option<f64>,
    /// Figure of the run with the defaults of gsscale.
    with_defaults: Option<f64>,
    published: Option<f64>,
    /// Figure of the unchanged trainer.
    original: Option<f64>,
    is_same_measure: bool,
    digits: usize,
}

impl Row {
    fn difference(&self) -> Option<f64> {
        Some(self.ours? - self.published?).filter(|_| self.is_same_measure)
    }

    /// The cells, in the order of [`Comparison::head`].
    fn cells(&self, has_defaults: bool) -> Vec<String> {
        let number = |x: Option<f64>| x.map_or("-".to_string(), |x| format!("{x:.*}", self.digits));
        let difference = self.difference().map_or("-".to_string(), |x| format!("{x:+.*}", self.digits));
        let mut cells = vec![self.measure.clone(), number(self.ours)];
        cells.extend(has_defaults.then(|| number(self.with_defaults)));
        cells.extend([number(self.published), number(self.original), difference]);
        cells
    }
}

pub struct Comparison<'a> {
    pub run: &'a PublishedRun,
    /// Densification tier, if the settings are those of a tier.
    pub tier: Option<&'a str>,
    pub layout: &'a str,
    /// Folder of the dataset.
    pub data: &'a Path,
    pub out: &'a Path,
    /// Differences to the published run.
    pub caveats: &'a [String],
    pub ours: &'a Ours,
    /// Our figures with the defaults of gsscale, if such a run was asked for.
    pub with_defaults: Option<&'a Ours>,
}

impl Comparison<'_> {
    /// Names of the columns.
    fn head(&self) -> Vec<&'static str> {
        let mut head = vec!["held-out photos, mean", "ours"];
        head.extend(self.with_defaults.map(|_| "ours, defaults"));
        head.extend(["GS-Scale", "unchanged gsplat", "ours - GS-Scale"]);
        head
    }

    fn rows(&self) -> Vec<Row> {
        let (test, expected) = (self.ours.test, self.run.facts.expected.as_ref());
        let lpips_variant = self.ours.lpips_variant.as_deref();
        let of_defaults = self.with_defaults.and_then(|run| run.test);
        let row =
            |measure, digits, of: &dyn Fn(&TestMetrics) -> Option<f64>, theirs: Option<[f64; 2]>, is_same_measure| {
                let [ours, with_defaults] = [test, of_defaults].map(|test| test.as_ref().and_then(of));
                let (published, original) = (theirs.map(|t| t[0]), theirs.map(|t| t[1]));
                Row { measure, ours, with_defaults, published, original, is_same_measure, digits }
            };
        let psnr = expected.map(|e| [e.psnr, e.original_psnr]);
        let ssim = expected.map(|e| [e.ssim, e.original_ssim]);
        let lpips = expected.map(|e| [e.lpips, e.original_lpips]);
        let is_same_ssim = expected.is_some_and(|e| e.ssim_variant == self.ours.ssim_variant);
        let is_same_lpips = expected.is_some_and(|e| Some(e.lpips_variant.as_str()) == lpips_variant);
        let (ssim_name, lpips_name) = (self.ours.ssim_variant, lpips_variant.unwrap_or("alex, signed"));
        let mut rows = vec![
            row("PSNR, dB".into(), 2, &|t| Some(t.psnr), psnr, true),
            row(format!("SSIM ({ssim_name})"), 3, &|t| Some(t.ssim), ssim, is_same_ssim),
            row(format!("LPIPS ({lpips_name})"), 3, &|t| t.lpips, lpips, is_same_lpips),
        ];
        if let Some(corrected) = test.and_then(|t| t.color_corrected) {
            let name = format!("colour-corrected PSNR ({}), dB", corrected.method.name());
            rows.push(row(name, 2, &|t| Some(t.color_corrected?.cc_psnr), None, false));
        }
        rows
    }

    /// Further facts, one line each.
    fn facts(&self) -> Vec<String> {
        let mut facts = vec![self.ours.costs()];
        facts.extend(self.with_defaults.map(|run| format!("with the defaults of gsscale: {}", run.costs())));
        if let Some(memory) = &self.run.facts.memory {
            let here = memory.saving.map_or(String::new(), |s| format!("{s} on this scene; "));
            let ([least, most], mean) = (memory.saving_range, memory.saving_mean);
            facts.push(format!(
                "published: GPU memory of the unchanged trainer divided by that of GS-Scale: {here}{least} to {most} on \
                 its scenes, geometric mean {mean}"
            ));
        }
        if self.run.facts.expected.is_none() {
            facts.push("GS-Scale publishes no figures for this scene".to_string());
        }
        facts.extend(self.run.facts.notes.iter().cloned());
        facts
    }

    pub fn json(&self) -> Value {
        let rows = self.rows();
        let difference = |i: usize| rows[i].difference();
        json!({
            "run": self.run.name,
            "title": self.run.facts.title,
            "tier": self.tier,
            "layout": self.layout,
            "data": self.data,
            "out": self.out,
            "comparable": self.caveats.is_empty() && self.run.facts.expected.is_some(),
            "not_the_published_run": self.caveats,
            "ours": self.ours.json(),
            "with_defaults": self.with_defaults.map(Ours::json),
            "published": self.run.facts.expected,
            "published_memory": self.run.facts.memory,
            "difference": { "psnr": difference(0), "ssim": difference(1), "lpips": difference(2) },
            "version": env!("CARGO_PKG_VERSION"),
        })
    }

    /// The table for a terminal.
    pub fn text(&self) -> String {
        let mut table = vec![self.head().into_iter().map(str::to_string).collect::<Vec<_>>()];
        table.extend(self.rows().iter().map(|row| row.cells(self.with_defaults.is_some())));
        let mut lines = vec![format!("{}, tier {}", self.run.facts.title, self.tier.unwrap_or("none"))];
        lines.extend(aligned(&table).iter().map(|row| row.join("  ")));
        lines.extend(self.facts());
        lines.extend(self.caveats.iter().map(|c| format!("not the published run: {c}")));
        lines.push(format!("report: {}", self.out.join(PUBLISHED_PAGE_FILE).display()));
        lines.join("\n")
    }

    pub fn page(&self) -> String {
        let tier = self.tier.unwrap_or("none");
        let title = format!("gsscale: {} beside the published figures", self.run.facts.title);
        let mut page = Page::new(&title, &format!("{}, tier {tier}", self.data.display()));
        let row = |row: &Row| {
            let mut cells = row.cells(self.with_defaults.is_some()).into_iter();
            cells.next().map(Cell::Text).into_iter().chain(cells.map(Cell::Number)).collect()
        };
        page.table(self.head(), self.rows().iter().map(row));
        self.facts().iter().for_each(|fact| page.paragraph(fact));
        if !self.caveats.is_empty() {
            page.heading("Not the published run");
            self.caveats.iter().for_each(|caveat| page.paragraph(caveat));
        }
        page.heading("More");
        page.paragraph("Curves, pictures and settings of this run are in report.html beside this file.");
        page.finish()
    }
}
