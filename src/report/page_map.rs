//! A map of the pages of a scene, seen along its shortest axis: position, number of views, residency.
//!
//! Invariant: the map has one rectangle per page up to 20,000; a larger scene draws every n-th page.

use serde::{Deserialize, Serialize};
use std::fmt::Write as _;

/// Longest side of the map, SVG units.
const SIDE: f64 = 720.0;
/// Fewest pages of a map: a large page among a few covers it, or leaves it empty.
const TILES_LEAST: usize = 12;
/// Most rectangles: browsers show larger files slowly.
const RECTANGLES_MAX: usize = 20_000;

/// Colours of 0 to the most views: dark blue over grey to yellow, which also those see apart who do not see red or green.
const RAMP: [[f64; 3]; 5] =
    [[0.0, 34.0, 78.0], [53.0, 69.0, 108.0], [124.0, 123.0, 120.0], [187.0, 175.0, 113.0], [254.0, 232.0, 56.0]];
/// Outlines of pages in memory and of others.
const OUTLINES: [&str; 2] = ["#ffffff", "#3a4450"];
/// Behind the pages.
const BACKGROUND: &str = "#10151c";

fn color(heat: f64) -> String {
    let at = heat.clamp(0.0, 1.0) * (RAMP.len() - 1) as f64;
    let low = (at as usize).min(RAMP.len() - 2);
    let [r, g, b] = [0, 1, 2].map(|c| RAMP[low][c] + (at - low as f64) * (RAMP[low + 1][c] - RAMP[low][c]));
    format!("#{:02x}{:02x}{:02x}", r.round() as u8, g.round() as u8, b.round() as u8)
}

/// What the colours and outlines of [`page_map_svg`] mean, as HTML.
pub fn page_map_legend(tiles: &[PageTile]) -> String {
    let most = tiles.iter().map(|t| t.views).max().unwrap_or(0).max(1);
    let stops = (0..=4).map(|i| color(f64::from(i) / 4.0)).collect::<Vec<_>>().join(",");
    let is_mixed = tiles.iter().any(|t| t.resident) && tiles.iter().any(|t| !t.resident);
    let places = match is_mixed {
        true => swatch(OUTLINES[0], "in memory at the end") + &swatch(OUTLINES[1], "on the drive"),
        // Two outlines would name one that the map does not have.
        false => String::new(),
    };
    format!(
        "<p style=\"display:flex;flex-wrap:wrap;align-items:center;gap:6px 14px;margin:8px 0 0;font-size:14px\">\
         <span>needed by 0 views <span style=\"display:inline-block;width:110px;height:14px;\
         vertical-align:-2px;background:linear-gradient(90deg,{stops})\"></span> {most} views</span>{places}</p>"
    )
}

/// A page with this outline on the background of the map, and its meaning.
fn swatch(line: &str, meaning: &str) -> String {
    format!(
        "<span style=\"white-space:nowrap\"><span style=\"display:inline-block;width:14px;height:14px;margin-right:6px;\
         vertical-align:-5px;background:{};border:3px solid {line};outline:3px solid {BACKGROUND}\"></span>{meaning}</span>",
        color(0.5)
    )
}

/// One page, projected along the shortest axis of the scene.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PageTile {
    /// Lower corner of the page's box.
    pub lo: [f32; 2],
    /// Upper corner of the page's box.
    pub hi: [f32; 2],
    pub rows: u32,
    /// Training views that need the page.
    pub views: u32,
    /// Whether the page was in memory at the end.
    pub resident: bool,
}

/// The map as SVG: the fill shows the number of views, the outline shows residency. Empty for fewer pages than a map needs to show anything
/// (`TILES_LEAST`).
pub fn page_map_svg(tiles: &[PageTile]) -> String {
    if tiles.len() < TILES_LEAST {
        return String::new();
    }
    let corners = || tiles.iter().flat_map(|t| [t.lo, t.hi]).filter(|c| c.iter().all(|x| x.is_finite()));
    // A few distant pages (sky, giants) would shrink the rest to a dot, so the map spans nine tenths of the corners.
    let Some((lo, hi)) = span(corners().map(|c| c[0])).zip(span(corners().map(|c| c[1]))) else {
        return String::new();
    };
    let (lo, hi) = ([lo.0, hi.0], [lo.1, hi.1]);
    let extent = [0, 1].map(|i| f64::from(hi[i] - lo[i]).max(1e-12));
    let scale = SIDE / extent[0].max(extent[1]);
    let size = extent.map(|e| e * scale);
    let most = tiles.iter().map(|t| t.views).max().unwrap_or(0).max(1);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {:.0} {:.0}\"><rect width=\"100%\" height=\"100%\" fill=\"{BACKGROUND}\"/>\n",
        size[0].max(1.0),
        size[1].max(1.0)
    );
    let stride = tiles.len().div_ceil(RECTANGLES_MAX).max(1);
    let mut drawn: Vec<&PageTile> = tiles.iter().step_by(stride).filter(|t| t.rows > 0).collect();
    // Large pages first, so that small pages stay visible.
    drawn.sort_by(|a, b| area(b).total_cmp(&area(a)));
    for tile in drawn {
        let at = [0, 1].map(|i| (f64::from(tile.lo[i] - lo[i]) * scale).clamp(-1e4, 1e4));
        let side = [0, 1].map(|i| (f64::from(tile.hi[i] - tile.lo[i]) * scale).clamp(1.0, 2e4));
        let heat = (f64::from(tile.views) / f64::from(most)).sqrt();
        let line = OUTLINES[usize::from(!tile.resident)];
        // Writing to a String cannot fail.
        let _ = writeln!(
            svg,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"{}\" fill-opacity=\"0.7\" stroke=\"{line}\" stroke-width=\"0.6\"/>",
            at[0],
            size[1] - at[1] - side[1],
            side[0],
            side[1],
            color(heat),
        );
    }
    svg.push_str("</svg>");
    svg
}

fn area(tile: &PageTile) -> f32 {
    (tile.hi[0] - tile.lo[0]) * (tile.hi[1] - tile.lo[1])
}

/// The 5th and 95th percentiles.
fn span(values: impl Iterator<Item = f32>) -> Option<(f32, f32)> {
    let mut values: Vec<f32> = values.collect();
    if values.is_empty() {
        return None;
    }
    values.sort_unstable_by(f32::total_cmp);
    let last = values.len() - 1;
    Some((values[last / 20], values[last - last / 20]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_draw_every_page_and_survive_far_ones() {
        let tile =
            |x: f32, views: u32| PageTile { lo: [x, 0.0], hi: [x + 1.0, 1.0], rows: 9, views, resident: views > 3 };
        let mut tiles: Vec<PageTile> = (0..200).map(|i| tile(i as f32, i)).collect();
        tiles.push(PageTile { lo: [f32::NEG_INFINITY; 2], hi: [f32::INFINITY; 2], ..tile(0.0, 1) });
        tiles.push(tile(1e30, 0));
        let svg = page_map_svg(&tiles);
        assert_eq!(svg.matches("<rect x=").count(), 202);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert_eq!([page_map_svg(&[]), page_map_svg(&tiles[..TILES_LEAST - 1])], ["", ""]);
        // The legend has the colours of the map: those of no views and of the most.
        let legend = page_map_legend(&tiles);
        assert!(legend.contains(&color(0.0)) && legend.contains(&color(1.0)) && legend.contains("199 views"));
        assert!(OUTLINES.iter().all(|line| legend.matches(&format!("solid {line}")).count() == 1), "{legend}");
        let in_memory: Vec<PageTile> = tiles.iter().map(|tile| PageTile { resident: true, ..*tile }).collect();
        assert!(!page_map_legend(&in_memory).contains("solid"), "one outline needs no words");
        assert!(svg.contains(&format!("fill=\"{}\"", color(0.0))) && svg.contains(&format!("fill=\"{}\"", color(1.0))));
    }
}
