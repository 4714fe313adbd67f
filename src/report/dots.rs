//! A chart of named values with their ranges, one row for each name and one colour for each series, as SVG text, drawn by
//! `plotters`.
//!
//! Invariant: values that are not finite are dropped, not an error.

use super::chart::{AXIS, COLORS, Canvas, draw_svg, text};
use super::front::Spread;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

const WIDTH: u32 = 1040;
/// Height of a row.
const ROW: i32 = 34;
/// Height of title and legend.
const TOP: i32 = 64;
/// Height of the axis.
const BOTTOM: i32 = 30;
/// Width of the names.
const NAMES: i32 = 240;
/// Width right of the plot.
const RIGHT: i32 = 30;
/// Distance between the series of a row.
const STEP: i32 = 8;

/// The chart.
#[derive(Debug, Clone)]
pub struct Dots {
    /// Title with the unit.
    pub title: String,
    /// Names of the series.
    pub series: Vec<String>,
    /// The rows from the top: name, and a value for each series that has one.
    pub rows: Vec<(String, Vec<Option<Spread>>)>,
}

impl Dots {
    /// The chart as SVG. A dot is a mean, the line through it reaches from the lowest to the highest value.
    pub fn svg(&self) -> String {
        let height = TOP + ROW * self.rows.len() as i32 + BOTTOM;
        draw_svg((WIDTH, height as u32), |root| self.draw(root, height))
    }

    /// Lowest and highest value of the axis, which shows zero.
    fn range(&self) -> (f64, f64) {
        let of = |spread: &Spread| [spread.low, spread.high].map(|v| if v.is_finite() { v } else { 0.0 });
        let all = self.rows.iter().flat_map(|(_, values)| values).flatten().flat_map(of);
        let (low, high) = all.fold((0.0f64, 0.0f64), |(low, high), v| (low.min(v), high.max(v)));
        if high - low > 1e-9 { (low, high) } else { (0.0, 1.0) }
    }

    fn draw(&self, root: &Canvas<'_>, height: i32) -> Result<(), String> {
        let anchor = |h| Pos::new(h, VPos::Center);
        let style = |size: u32, h| TextStyle::from(("sans-serif", size)).pos(anchor(h));
        root.draw(&Text::new(self.title.clone(), (WIDTH as i32 / 2, 18), style(16, HPos::Center))).map_err(text)?;
        let (low, high) = self.range();
        let room = f64::from(WIDTH as i32 - NAMES - RIGHT);
        let x_of = |value: f64| NAMES + ((value - low) / (high - low) * room).round() as i32;
        for (i, name) in self.series.iter().enumerate() {
            let x = NAMES + 180 * i as i32;
            root.draw(&Circle::new((x, 44), 5, COLORS[i % COLORS.len()].filled())).map_err(text)?;
            root.draw(&Text::new(name.clone(), (x + 12, 44), style(13, HPos::Left))).map_err(text)?;
        }
        let tick = tick_of(high - low);
        let (first, last) = ((low / tick).ceil() as i32, (high / tick).floor() as i32);
        for k in first..=last {
            let value = f64::from(k) * tick;
            let ends = vec![(x_of(value), TOP), (x_of(value), height - BOTTOM)];
            let color = if k == 0 { AXIS } else { RGBColor(222, 222, 222) };
            root.draw(&PathElement::new(ends, color)).map_err(text)?;
            let at = (x_of(value), height - BOTTOM + 12);
            root.draw(&Text::new(format!("{value:.1}"), at, style(12, HPos::Center).color(&AXIS))).map_err(text)?;
        }
        for (row, (name, values)) in self.rows.iter().enumerate() {
            let middle = TOP + ROW * row as i32 + ROW / 2;
            root.draw(&Text::new(name.clone(), (NAMES - 12, middle), style(13, HPos::Right))).map_err(text)?;
            for (i, value) in values.iter().enumerate() {
                let Some(spread) = value.filter(|s| s.mean.is_finite()) else { continue };
                let y = middle + STEP * (2 * i as i32 - (self.series.len() as i32 - 1)) / 2;
                let color = COLORS[i % COLORS.len()];
                let line = vec![(x_of(spread.low), y), (x_of(spread.high), y)];
                root.draw(&PathElement::new(line, color.stroke_width(2))).map_err(text)?;
                root.draw(&Circle::new((x_of(spread.mean), y), 4, color.filled())).map_err(text)?;
            }
        }
        Ok(())
    }
}

/// Distance of the marks on an axis of this length: at most eleven marks.
fn tick_of(length: f64) -> f64 {
    [0.1, 0.2, 0.5, 1.0, 2.0, 5.0].into_iter().find(|tick| length / tick <= 10.0).unwrap_or((length / 10.0).ceil())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dots_lie_where_their_values_are() {
        let spread = |mean: f64| Some(Spread { mean, low: mean - 0.5, high: mean + 0.5 });
        let rows =
            vec![("a <".to_string(), vec![spread(1.5), spread(f64::NAN)]), ("b".into(), vec![None, spread(3.5)])];
        let svg = Dots { title: "lost".into(), series: vec!["none".into(), "own".into()], rows }.svg();
        // The axis reaches from 0 to 4.
        let x = |value: f64| (f64::from(NAMES) + value / 4.0 * f64::from(WIDTH as i32 - NAMES - RIGHT)).round();
        for value in [1.5, 3.5] {
            assert!(svg.contains(&format!("cx=\"{}\"", x(value))), "{value}: {svg}");
        }
        // Two dots and two in the legend.
        assert!(svg.matches("<circle").count() == 4 && svg.contains("a &lt;"), "{svg}");
        assert!(Dots { title: String::new(), series: Vec::new(), rows: Vec::new() }.svg().starts_with("<svg"));
    }
}
