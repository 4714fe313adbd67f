//! Our figures beside the published figures, as text, as JSON and as a page.
//!
//! Invariant: a difference appears only between figures of the same measure (same SSIM padding, same LPIPS network and
//! input range). Every output lists the differences between this run and the published run.

use gsscale::base::units::format_bytes;
use gsscale::config::file::TrainConfig;
use gsscale::config::published::PublishedRun;
use gsscale::optim::moments::Moments;
use gsscale::render::metrics::SsimVariant;
use gsscale::report::html::{Cell, Page};
use gsscale::train::log::report::{Summary, TestMetrics};
use serde_json::{Value, json};
use std::path::Path;

/// Figures of our run.
pub struct Ours {
    /// Means over the held-out views.
    pub test: Option<TestMetrics>,
    /// Variant of SSIM.
    pub ssim_variant: SsimVariant,
    /// Variant of LPIPS.
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
}

/// A row of the table.
struct Row {
    measure: String,
    ours: Option<f64>,
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

    fn cells(&self) -> [String; 5] {
        let number = |x: Option<f64>| x.map_or("-".to_string(), |x| format!("{x:.*}", self.digits));
        let difference = self.difference().map_or("-".to_string(), |x| format!("{x:+.*}", self.digits));
        [self.measure.clone(), number(self.ours), number(self.published), number(self.original), difference]
    }
}

/// The input of the report.
pub struct Comparison<'a> {
    /// The published run.
    pub run: &'a PublishedRun,
    /// Densification tier, if the settings are those of a tier.
    pub tier: Option<&'a str>,
    /// Layout of the dataset.
    pub layout: &'a str,
    /// Folder of the dataset.
    pub data: &'a Path,
    /// Output folder.
    pub out: &'a Path,
    /// Differences to the published run.
    pub caveats: &'a [String],
    /// Our figures.
    pub ours: &'a Ours,
}

const HEAD: [&str; 5] = ["held-out photos, mean", "ours", "GS-Scale", "unchanged gsplat", "ours - GS-Scale"];

impl Comparison<'_> {
    fn rows(&self) -> Vec<Row> {
        let (test, expected) = (self.ours.test, self.run.facts.expected.as_ref());
        let lpips_variant = self.ours.lpips_variant.as_deref();
        let row = |measure, digits, ours, theirs: Option<[f64; 2]>, is_same_measure| {
            let (published, original) = (theirs.map(|t| t[0]), theirs.map(|t| t[1]));
            Row { measure, ours, published, original, is_same_measure, digits }
        };
        let psnr = expected.map(|e| [e.psnr, e.original_psnr]);
        let ssim = expected.map(|e| [e.ssim, e.original_ssim]);
        let lpips = expected.map(|e| [e.lpips, e.original_lpips]);
        let is_same_ssim = expected.is_some_and(|e| e.ssim_variant == self.ours.ssim_variant);
        let is_same_lpips = expected.is_some_and(|e| Some(e.lpips_variant.as_str()) == lpips_variant);
        let (ssim_name, lpips_name) = (self.ours.ssim_variant, lpips_variant.unwrap_or("alex, signed"));
        let mut rows = vec![
            row("PSNR, dB".into(), 2, test.map(|t| t.psnr), psnr, true),
            row(format!("SSIM ({ssim_name})"), 3, test.map(|t| t.ssim), ssim, is_same_ssim),
            row(format!("LPIPS ({lpips_name})"), 3, test.and_then(|t| t.lpips), lpips, is_same_lpips),
        ];
        if let Some(corrected) = test.and_then(|t| t.color_corrected) {
            let name = format!("colour-corrected PSNR ({}), dB", corrected.method.name());
            rows.push(row(name, 2, Some(corrected.cc_psnr), None, false));
        }
        rows
    }

    /// Further facts, one line each.
    fn facts(&self) -> Vec<String> {
        let summary = &self.ours.summary;
        let mut facts = vec![format!(
            "{} Gaussians after {} steps, {:.1} s of training; peak host memory {}; Gaussians with their moments {}",
            summary.gaussians,
            summary.steps,
            summary.train_seconds,
            format_bytes(summary.host_bytes_peak),
            format_bytes(self.ours.state_bytes)
        )];
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

    /// The comparison as JSON.
    pub fn json(&self) -> Value {
        let summary = &self.ours.summary;
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
            "ours": {
                "test": self.ours.test,
                "ssim_variant": self.ours.ssim_variant,
                "lpips_variant": self.ours.lpips_variant,
                "gaussians": summary.gaussians,
                "steps": summary.steps,
                "train_seconds": summary.train_seconds,
                "host_bytes_peak": summary.host_bytes_peak,
                "state_bytes": self.ours.state_bytes,
                "bytes_read": summary.tiers.stats.bytes_read,
                "bytes_written": summary.tiers.stats.bytes_written,
            },
            "published": self.run.facts.expected,
            "published_memory": self.run.facts.memory,
            "difference": { "psnr": difference(0), "ssim": difference(1), "lpips": difference(2) },
            "version": env!("CARGO_PKG_VERSION"),
        })
    }

    /// The table for a terminal.
    pub fn text(&self) -> String {
        let rows: Vec<[String; 5]> = self.rows().iter().map(Row::cells).collect();
        let head = HEAD.map(str::to_string);
        let all = || std::iter::once(&head).chain(&rows);
        let widths: [usize; 5] = std::array::from_fn(|c| all().map(|r| r[c].chars().count()).max().unwrap_or(0));
        let line = |r: &[String; 5]| {
            let [w0, w1, w2, w3, w4] = widths;
            format!("{:<w0$}  {:>w1$}  {:>w2$}  {:>w3$}  {:>w4$}", r[0], r[1], r[2], r[3], r[4])
        };
        let mut lines = vec![format!("{}, tier {}", self.run.facts.title, self.tier.unwrap_or("none"))];
        lines.extend(all().map(line));
        lines.extend(self.facts());
        lines.extend(self.caveats.iter().map(|c| format!("not the published run: {c}")));
        lines.push(format!("report: {}", self.out.join("published.html").display()));
        lines.join("\n")
    }

    /// The page.
    pub fn page(&self) -> String {
        let tier = self.tier.unwrap_or("none");
        let title = format!("gsscale: {} beside the published figures", self.run.facts.title);
        let mut page = Page::new(&title, &format!("{}, tier {tier}", self.data.display()));
        let number = |row: &Row, i: usize| Cell::Number(row.cells()[i].clone());
        page.table(
            &self.rows(),
            &[
                (HEAD[0], &|row| Cell::text(&row.measure)),
                (HEAD[1], &|row| number(row, 1)),
                (HEAD[2], &|row| number(row, 2)),
                (HEAD[3], &|row| number(row, 3)),
                (HEAD[4], &|row| number(row, 4)),
            ],
        );
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
