//! A horizontal bar chart as SVG text, drawn by `plotters`.
//!
//! Invariant: a missing or non-finite value gives an empty bar, not an error.

use super::chart::{AXIS, COLORS, Canvas, draw_svg, text};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

const WIDTH: u32 = 1040;
/// Height of a bar with the gap below it.
const BAR: i32 = 26;
/// Height of the title.
const TITLE: i32 = 40;
/// Width of the names.
const NAMES: i32 = 320;
/// Width of the value beside the longest bar.
const VALUES: i32 = 250;

/// Named values, one bar each.
#[derive(Debug, Clone)]
pub struct Bars {
    /// Title with the unit.
    pub title: String,
    /// Name, value, and text of the value.
    pub bars: Vec<(String, Option<f64>, String)>,
}

impl Bars {
    /// The chart as SVG, the first bar on top.
    pub fn svg(&self) -> String {
        draw_svg((WIDTH, (TITLE + BAR * self.bars.len() as i32 + 6) as u32), |root| self.draw(root))
    }

    fn draw(&self, root: &Canvas<'_>) -> Result<(), String> {
        let anchor = |h| Pos::new(h, VPos::Center);
        let title = TextStyle::from(("sans-serif", 20)).pos(anchor(HPos::Center));
        root.draw(&Text::new(self.title.clone(), (WIDTH as i32 / 2, TITLE / 2), title)).map_err(text)?;
        let finite = |v: &Option<f64>| v.filter(|v| v.is_finite());
        let most = self.bars.iter().filter_map(|(_, v, _)| finite(v)).fold(0.0, f64::max);
        let room = f64::from(WIDTH as i32 - NAMES - VALUES);
        for (i, (name, value, written)) in self.bars.iter().enumerate() {
            let y = TITLE + BAR * i as i32;
            let middle = y + BAR / 2 - 3;
            let style = TextStyle::from(("sans-serif", 15)).pos(anchor(HPos::Right));
            root.draw(&Text::new(name.clone(), (NAMES - 8, middle), style)).map_err(text)?;
            let length =
                finite(value).map_or(0, |v| if most > 0.0 { (v.max(0.0) / most * room).round() as i32 } else { 0 });
            let bar = [(NAMES, y), (NAMES + length.max(1), y + BAR - 6)];
            root.draw(&Rectangle::new(bar, COLORS[0].filled())).map_err(text)?;
            let style = TextStyle::from(("sans-serif", 15)).color(&AXIS).pos(anchor(HPos::Left));
            root.draw(&Text::new(written.clone(), (NAMES + length + 6, middle), style)).map_err(text)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_as_long_as_their_values() {
        let bar = |name: &str, value| (name.to_string(), value, format!("{value:?}"));
        let bars = vec![bar("a <", Some(2.0)), bar("b", Some(1.0)), bar("c", None), bar("d", Some(f64::NAN))];
        let svg = Bars { title: "seconds".into(), bars }.svg();
        let width = |w: i32| format!("width=\"{w}\"");
        let longest = WIDTH as i32 - NAMES - VALUES;
        assert!(svg.contains(&width(longest)) && svg.contains(&width(longest / 2)), "{svg}");
        assert!(svg.contains("a &lt;") && svg.matches(&width(1)).count() == 2);
        assert!(Bars { title: String::new(), bars: Vec::new() }.svg().starts_with("<svg"));
    }
}
