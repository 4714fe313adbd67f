//! The page of levels of detail: PSNR and SSIM of held-out photos by level.

use super::chart::{Chart, Mark};
use super::html::{Cell, Page};

/// A level of detail, shown everywhere.
#[derive(Debug, Clone, Copy)]
pub struct LevelFigures {
    /// Its Gaussians.
    pub gaussians: u64,
    /// PSNR of held-out photos, dB.
    pub psnr: Option<f64>,
    /// SSIM of held-out photos.
    pub ssim: Option<f64>,
}

/// The page for the levels of `file`, the finest first. `facts` says how they were measured.
pub fn levels_page(file: &str, facts: &str, levels: &[LevelFigures]) -> String {
    let mut page = Page::new(&format!("gsscale: levels of detail of {file}"), facts);
    page.paragraph(
        "Each level was drawn everywhere, also where a viewer would show a finer one: near the camera. A viewer is therefore better than \
         any level but the finest.",
    );
    let chart = |title: &str, unit: &str, of: fn(&LevelFigures) -> Option<f64>| {
        let point = |(level, figures): (usize, &LevelFigures)| Some((level as f64, of(figures)?, figures.gaussians));
        let points: Vec<(f64, f64, u64)> = levels.iter().enumerate().filter_map(point).collect();
        let line = points.iter().map(|&(level, value, _)| (level, value)).collect();
        let mut chart = Chart::new(title, "level", unit).with("", line, Mark::LineAndDots);
        chart.labels = points.iter().map(|&(level, value, rows)| (level, value, format!("{rows} Gaussians"))).collect();
        (chart.svg(), String::new())
    };
    page.charts(&[chart("PSNR by level", "PSNR, dB", |f| f.psnr), chart("SSIM by level", "SSIM", |f| f.ssim)]);
    let rows: Vec<(usize, &LevelFigures)> = levels.iter().enumerate().collect();
    let finest = levels.first().and_then(|figures| figures.psnr);
    page.table(
        &rows,
        &[
            ("level", &|(level, _)| Cell::Number(level.to_string())),
            ("Gaussians", &|(_, f)| Cell::Number(f.gaussians.to_string())),
            ("PSNR, dB", &|(_, f)| Cell::number(f.psnr, 2)),
            ("against the finest", &|(_, f)| Cell::difference(f.psnr.zip(finest).map(|(own, finest)| own - finest), 2)),
            ("SSIM", &|(_, f)| Cell::number(f.ssim, 3)),
        ],
    );
    page.finish()
}
