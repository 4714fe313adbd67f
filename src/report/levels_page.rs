//! The page of levels of detail: PSNR and SSIM of held-out photos by level.

use super::chart::{Chart, Mark};
use super::html::{Cell, Page};

/// A level of detail, shown everywhere.
#[derive(Debug, Clone, Copy)]
pub struct LevelFigures {
    /// Its number; the finest is 0.
    pub level: u32,
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
        "Each level was drawn everywhere. A viewer mixes levels, finer ones near the camera, so its pictures lie between the finest and \
         the coarsest level that it shows.",
    );
    let chart = |title: &str, unit: &str, of: fn(&LevelFigures) -> Option<f64>| {
        let point = |figures: &LevelFigures| Some((f64::from(figures.level), of(figures)?, figures.gaussians));
        let points: Vec<(f64, f64, u64)> = levels.iter().filter_map(point).collect();
        let line = points.iter().map(|&(level, value, _)| (level, value)).collect();
        let mut chart = Chart::new(title, "level", unit).with("", line, Mark::LineAndDots);
        chart.labels = points.iter().map(|&(level, value, rows)| (level, value, format!("{rows} Gaussians"))).collect();
        (chart.svg(), String::new())
    };
    page.charts(&[chart("PSNR by level", "PSNR, dB", |f| f.psnr), chart("SSIM by level", "SSIM", |f| f.ssim)]);
    let finest = levels.first().and_then(|figures| figures.psnr);
    page.table(
        levels,
        &[
            ("level", &|f| Cell::Number(f.level.to_string())),
            ("Gaussians", &|f| Cell::Number(f.gaussians.to_string())),
            ("PSNR, dB", &|f| Cell::number(f.psnr, 2)),
            ("against the finest", &|f| Cell::difference(f.psnr.zip(finest).map(|(own, finest)| own - finest), 2)),
            ("SSIM", &|f| Cell::number(f.ssim, 3)),
        ],
    );
    page.finish()
}
