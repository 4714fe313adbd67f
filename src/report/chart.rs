//! Line and point charts as SVG text, drawn by `plotters`.
//!
//! Invariants: 1. points that are not finite are left out; a chart without any point says so instead of failing; 2. the
//! same data give the same text.

use plotters::coord::Shift;
use plotters::prelude::*;

/// Width and height of a chart, in the units of its SVG.
const SIZE: (u32, u32) = (560, 320);
const COLORS: [RGBColor; 6] = [
    RGBColor(36, 99, 180),
    RGBColor(205, 92, 32),
    RGBColor(46, 139, 87),
    RGBColor(148, 63, 148),
    RGBColor(120, 120, 120),
    RGBColor(180, 140, 20),
];

/// Axes and frames.
const AXIS: RGBColor = RGBColor(97, 97, 97);

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// A line through the points.
    Line,
    /// A dot at every point.
    Dots,
    /// Both.
    LineAndDots,
}

/// One named sequence of points.
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend; empty for none.
    pub name: String,
    /// (x, y).
    pub points: Vec<(f64, f64)>,
    /// How it is drawn.
    pub mark: Mark,
}

/// A chart.
#[derive(Debug, Clone)]
pub struct Chart {
    /// Title.
    pub title: String,
    /// Name and unit of the x axis.
    pub x: String,
    /// Name and unit of the y axis.
    pub y: String,
    /// What is drawn, in the order of colours.
    pub series: Vec<Series>,
    /// Labels of single points: (x, y, text).
    pub labels: Vec<(f64, f64, String)>,
    /// Whether the y axis starts at zero.
    pub from_zero: bool,
}

impl Chart {
    /// A chart without series.
    pub fn new(title: &str, x: &str, y: &str) -> Chart {
        let [title, x, y] = [title, x, y].map(str::to_string);
        Chart { title, x, y, series: Vec::new(), labels: Vec::new(), from_zero: false }
    }

    /// Adds a series.
    #[must_use]
    pub fn with(mut self, name: &str, points: Vec<(f64, f64)>, mark: Mark) -> Chart {
        let points = points.into_iter().filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
        self.series.push(Series { name: name.to_string(), points, mark });
        self
    }

    /// Lets the y axis start at zero.
    #[must_use]
    pub fn zero_based(mut self) -> Chart {
        self.from_zero = true;
        self
    }

    /// Whether there is nothing to draw.
    pub fn is_empty(&self) -> bool {
        self.series.iter().all(|s| s.points.is_empty())
    }

    /// The chart as SVG.
    pub fn svg(&self) -> String {
        let mut text = String::new();
        let drawn = {
            let root = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
            self.draw(&root).and_then(|()| root.present().map_err(|e| e.to_string()))
        };
        match drawn {
            Ok(()) => text,
            Err(problem) => {
                format!("<p class=\"dim\">This chart could not be drawn: {}</p>", super::html::escape(&problem))
            }
        }
    }

    fn draw(&self, root: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), String> {
        fn text<E: std::fmt::Display>(e: E) -> String {
            e.to_string()
        }
        root.fill(&WHITE).map_err(text)?;
        let ([x0, x1], [y0, y1]) = self.ranges();
        let mut builder = ChartBuilder::on(root);
        builder.margin(8).margin_right(18).x_label_area_size(38).y_label_area_size(58);
        builder.caption(&self.title, ("sans-serif", 16));
        let mut chart = builder.build_cartesian_2d(x0..x1, y0..y1).map_err(text)?;
        let mut mesh = chart.configure_mesh();
        mesh.x_desc(&self.x).y_desc(&self.y).axis_style(AXIS).light_line_style(WHITE).x_labels(8).y_labels(7);
        let label = |v: &f64| short(*v);
        mesh.x_label_formatter(&label).y_label_formatter(&label);
        mesh.draw().map_err(text)?;
        for (i, series) in self.series.iter().enumerate() {
            let color = COLORS[i % COLORS.len()];
            if series.mark != Mark::Dots {
                let line = LineSeries::new(series.points.iter().copied(), color.stroke_width(2));
                let drawn = chart.draw_series(line).map_err(text)?;
                if !series.name.is_empty() {
                    drawn
                        .label(&series.name)
                        .legend(move |(x, y)| Rectangle::new([(x, y - 4), (x + 12, y + 4)], color.filled()));
                }
            }
            if series.mark != Mark::Line {
                let dots = series.points.iter().map(|&p| Circle::new(p, 3, color.filled()));
                let drawn = chart.draw_series(dots).map_err(text)?;
                if !series.name.is_empty() && series.mark == Mark::Dots {
                    drawn.label(&series.name).legend(move |(x, y)| Circle::new((x + 6, y), 4, color.filled()));
                }
            }
        }
        let labels = self
            .labels
            .iter()
            .map(|(x, y, t)| EmptyElement::at((*x, *y)) + Text::new(t.clone(), (6, -12), ("sans-serif", 11)));
        chart.draw_series(labels).map_err(text)?;
        if self.series.iter().any(|s| !s.name.is_empty()) {
            let mut legend = chart.configure_series_labels();
            legend
                .position(SeriesLabelPosition::LowerRight)
                .background_style(WHITE.mix(0.8))
                .border_style(AXIS.mix(0.3));
            legend.draw().map_err(text)?;
        }
        if self.is_empty() {
            let at = (SIZE.0 as i32 / 2 - 40, SIZE.1 as i32 / 2);
            root.draw(&Text::new("no data", at, ("sans-serif", 14))).map_err(text)?;
        }
        Ok(())
    }

    /// Ranges of the axes, with a margin; never empty.
    fn ranges(&self) -> ([f64; 2], [f64; 2]) {
        let points = || self.series.iter().flat_map(|s| &s.points);
        let range = |values: &mut dyn Iterator<Item = f64>| {
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
            if low > high { [0.0, 1.0] } else { [low, high] }
        };
        let x = range(&mut points().map(|p| p.0));
        let mut y = range(&mut points().map(|p| p.1));
        if self.from_zero {
            y[0] = y[0].min(0.0);
        }
        let widen = |[low, high]: [f64; 2], below: bool| {
            let span = if high > low { high - low } else { high.abs().max(1.0) };
            [if below { low - 0.04 * span } else { low }, high + 0.06 * span]
        };
        (widen(x, false), widen(y, !self.from_zero))
    }
}

/// A number in few characters: 1.2M, 350k, 0.25.
pub fn short(value: f64) -> String {
    let magnitude = value.abs();
    let (scaled, unit) = match magnitude {
        m if m >= 1e9 => (value / 1e9, "G"),
        m if m >= 1e6 => (value / 1e6, "M"),
        m if m >= 1e4 => (value / 1e3, "k"),
        _ => (value, ""),
    };
    let digits = match scaled.abs() {
        s if s >= 100.0 || s == 0.0 => 0,
        s if s >= 10.0 => 1,
        s if s >= 1.0 => 2,
        _ => 3,
    };
    let mut text = format!("{scaled:.digits$}");
    if text.contains('.') {
        text.truncate(text.trim_end_matches('0').trim_end_matches('.').len());
    }
    text + unit
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let cases = [(0.0, "0"), (0.25, "0.25"), (26.7, "26.7"), (12_345.0, "12.3k"), (2.5e6, "2.5M"), (-3e9, "-3G")];
        for (value, want) in cases {
            assert_eq!(short(value), want);
        }
    }

    #[test]
    fn charts_hold_their_series_and_survive_odd_data() {
        let svg = Chart::new("PSNR <b>", "step", "dB")
            .with("train & test", vec![(0.0, 10.0), (1.0, f64::NAN), (2.0, 20.0)], Mark::Line)
            .with("dots", vec![(1.0, 15.0)], Mark::Dots)
            .svg();
        assert!(svg.starts_with("<svg") && svg.contains("polyline") && svg.contains("circle"));
        assert!(svg.contains("train &amp; test") && !svg.contains("<b>"));
        assert!(Chart::new("a", "b", "c").svg().contains("no data"));
        let flat = Chart::new("a", "b", "c").with("", vec![(5.0, 1.0), (5.0, 1.0)], Mark::Line).zero_based().svg();
        assert!(flat.contains("polyline"));
    }
}
