//! Line, point and bar charts as SVG text, drawn by `plotters`; numbers in few characters.
//!
//! Invariants: 1. points that are not finite are dropped, and a chart without points shows "no data"; 2. the same data
//! give the same text.

use super::html::escape;
use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use serde_json::json;
use std::cell::Cell;

/// Width and height of a chart, SVG units.
const SIZE: (u32, u32) = (560, 320);
/// Width and height of a wide chart, with the legend at the right. A legend with more rows makes the chart higher.
const WIDE: (u32, u32) = (1040, 480);
const LEGEND_WIDTH: u32 = 190;
/// Middle of the first row of the legend.
const LEGEND_TOP: u32 = 40;
const LEGEND_ROW: u32 = 20;
/// Longest name in the legend, characters.
const NAME_MAX: usize = 24;
/// Colours of series. [`color`] finds more where these do not suffice.
const COLORS: [RGBColor; 13] = [
    RGBColor(36, 99, 180),
    RGBColor(205, 92, 32),
    RGBColor(46, 139, 87),
    RGBColor(148, 63, 148),
    RGBColor(120, 120, 120),
    RGBColor(180, 140, 20),
    RGBColor(20, 150, 170),
    RGBColor(190, 50, 80),
    RGBColor(110, 160, 30),
    RGBColor(90, 80, 200),
    RGBColor(150, 100, 60),
    RGBColor(230, 120, 170),
    RGBColor(0, 70, 60),
];
/// Sizes of texts, SVG units: a chart is about 500 pixels wide on a large screen, and 330 on a phone.
const TITLE_SIZE: u32 = 20;
const TEXT_SIZE: u32 = 16;
const LABEL_SIZE: u32 = 13;
/// Width of a character of a label, at most, and height of a label, SVG units.
const LABEL_CHAR: f64 = 7.5;
const LABEL_HEIGHT: i32 = 14;
/// Distances of labels from their points. A label that is not at the first one has a line to its point.
const LABEL_REACH: [i32; 4] = [7, 20, 36, 56];
/// Lines of the grid; the style of the page names this colour, as that of [`AXIS`] and white, for dark screens.
const GRID: RGBColor = RGBColor(224, 224, 224);
/// Points of a curve that [`smoothed`] averages over: this share of them.
const SMOOTH_SHARE: usize = 20;

/// Colour of axes and frames.
const AXIS: RGBColor = RGBColor(97, 97, 97);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    Line,
    /// A pale thin line, behind a line of the same values smoothed.
    Faint,
    Dots,
    LineAndDots,
}

impl Mark {
    fn is_line(self) -> bool {
        matches!(self, Mark::Line | Mark::Faint)
    }
}

/// A named sequence of points.
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend; an empty name has no entry.
    pub name: String,
    /// (x, y).
    pub points: Vec<(f64, f64)>,
    pub mark: Mark,
    /// Number of the colour.
    pub color: usize,
}

#[derive(Debug, Clone, Default)]
pub struct Chart {
    pub title: String,
    /// Name and unit of the x axis.
    pub x: String,
    /// Name and unit of the y axis.
    pub y: String,
    pub series: Vec<Series>,
    /// Labels of points: (x, y, text). A label without a place where it covers no point and no other label is dropped.
    pub labels: Vec<(f64, f64, String)>,
    /// Vertical ranges: (x, lowest y, highest y).
    pub ranges: Vec<(f64, f64, f64)>,
    /// Whether the chart takes the whole width of the page, with the legend at the right.
    pub is_wide: bool,
    /// Whether the y axis starts at zero.
    pub from_zero: bool,
    /// Whether the x axis is logarithmic, for values above zero. Such a chart has no values under the pointer.
    pub is_log: bool,
}

/// Whether an axis can hold a value: the differences of such values are finite.
fn is_drawable(value: f64) -> bool {
    value.abs() < 1e300
}

impl Chart {
    pub fn new(title: &str, x: &str, y: &str) -> Chart {
        let [title, x, y] = [title, x, y].map(str::to_string);
        Chart { title, x, y, ..Chart::default() }
    }

    #[must_use]
    pub fn with(self, name: &str, points: Vec<(f64, f64)>, mark: Mark) -> Chart {
        let color = self.series.len();
        self.with_color(name, points, mark, color)
    }

    /// Adds a series with a colour number.
    #[must_use]
    pub fn with_color(mut self, name: &str, points: Vec<(f64, f64)>, mark: Mark, color: usize) -> Chart {
        let points = points.into_iter().filter(|(x, y)| is_drawable(*x) && is_drawable(*y)).collect();
        self.series.push(Series { name: name.to_string(), points, mark, color });
        self
    }

    #[must_use]
    pub fn zero_based(mut self) -> Chart {
        self.from_zero = true;
        self
    }

    #[must_use]
    pub fn wide(mut self) -> Chart {
        self.is_wide = true;
        self
    }

    /// Makes the x axis logarithmic and drops what is not above zero.
    #[must_use]
    pub fn logarithmic(mut self) -> Chart {
        self.is_log = true;
        self.series.iter_mut().for_each(|series| series.points.retain(|point| point.0 > 0.0));
        self.labels.retain(|label| label.0 > 0.0);
        self.ranges.retain(|range| range.0 > 0.0);
        self
    }

    pub fn is_empty(&self) -> bool {
        self.series.iter().all(|s| s.points.is_empty())
    }

    pub fn svg(&self) -> String {
        let plot = Cell::default();
        let svg = draw_svg(self.size(), |root| self.draw(root, &plot));
        if self.is_log {
            return svg;
        }
        svg.replacen("<svg ", &format!("<svg data-plot=\"{}\" ", escape(&self.values(plot.get()).to_string())), 1)
    }

    /// What the script of a page needs to show the values under the pointer: the edges of the plot in pixels, the ranges of its axes, and
    /// the points of each series.
    fn values(&self, [left, top, right, bottom]: [i32; 4]) -> serde_json::Value {
        let (x, y) = self.ranges();
        let of_series = |series: &Series| {
            let name = if series.mark == Mark::Faint { "one view" } else { &series.name };
            json!({ "name": name, "points": series.points })
        };
        let series: Vec<serde_json::Value> = self.series.iter().map(of_series).collect();
        json!({ "plot": [left, top, right, bottom], "x": x, "y": y, "of": self.x, "series": series })
    }

    fn size(&self) -> (u32, u32) {
        let legend = LEGEND_TOP + LEGEND_ROW * self.named().count() as u32;
        if self.is_wide { (WIDE.0, WIDE.1.max(legend)) } else { SIZE }
    }

    fn named(&self) -> impl Iterator<Item = &Series> {
        self.series.iter().filter(|s| !s.name.is_empty())
    }

    fn draw_legend(&self, root: &Canvas<'_>) -> Result<(), String> {
        let style = TextStyle::from(("sans-serif", TEXT_SIZE)).pos(Pos::new(HPos::Left, VPos::Center));
        for (row, series) in self.named().enumerate() {
            let (y, color) = ((LEGEND_TOP + LEGEND_ROW * row as u32) as i32, color(series.color));
            match series.mark {
                Mark::Line | Mark::Faint => root.draw(&PathElement::new([(0, y), (12, y)], color.stroke_width(2))),
                Mark::Dots | Mark::LineAndDots => root.draw(&Circle::new((6, y), 4, color.filled())),
            }
            .map_err(text)?;
            root.draw(&Text::new(shortened(&series.name), (20, y), style.clone())).map_err(text)?;
        }
        Ok(())
    }

    /// `edges` becomes those of the plot: left, top, right and lower, pixels.
    fn draw(&self, root: &Canvas<'_>, edges: &Cell<[i32; 4]>) -> Result<(), String> {
        root.fill(&WHITE).map_err(text)?;
        if !self.is_wide {
            return self.draw_plot(root, edges);
        }
        let (plot, legend) = root.split_horizontally(WIDE.0 - LEGEND_WIDTH);
        self.draw_legend(&legend)?;
        let (plot, _) = plot.split_vertically(WIDE.1);
        self.draw_plot(&plot, edges)
    }

    fn draw_plot(&self, root: &Canvas<'_>, edges: &Cell<[i32; 4]>) -> Result<(), String> {
        let ([x0, x1], [y0, y1]) = self.ranges();
        let mut builder = ChartBuilder::on(root);
        builder.margin(8).margin_right(18).x_label_area_size(48).y_label_area_size(72);
        builder.caption(&self.title, ("sans-serif", TITLE_SIZE));
        let x_axis = match self.is_log {
            true => XAxis::Decades((x0.log10()..x1.log10()).into()),
            false => XAxis::Linear((x0..x1).into()),
        };
        let mut chart = builder.build_cartesian_2d(x_axis, y0..y1).map_err(text)?;
        let ((left, bottom), (right, top)) = (chart.backend_coord(&(x0, y0)), chart.backend_coord(&(x1, y1)));
        edges.set([left, top, right, bottom]);
        let mut mesh = chart.configure_mesh();
        mesh.x_desc(&self.x).y_desc(&self.y).axis_style(AXIS).light_line_style(TRANSPARENT).bold_line_style(GRID);
        mesh.label_style(("sans-serif", TEXT_SIZE)).x_labels(6).y_labels(6);
        let of_x = |v: &f64| if self.is_log { short(*v) } else { tick(*v, x1 - x0) };
        let of_y = |v: &f64| tick(*v, y1 - y0);
        mesh.x_label_formatter(&of_x).y_label_formatter(&of_y);
        mesh.draw().map_err(text)?;
        chart.draw_series(self.bars().map(|ends| PathElement::new(ends, AXIS.mix(0.6)))).map_err(text)?;
        for series in &self.series {
            draw_series(&mut chart, series, !self.is_wide)?;
        }
        self.draw_labels(root, &chart)?;
        // The title tells what a single series is.
        if !self.is_wide && self.series.iter().filter(|s| !s.name.is_empty()).count() > 1 {
            let mut legend = chart.configure_series_labels();
            legend
                .position(SeriesLabelPosition::LowerRight)
                .background_style(WHITE.mix(0.8))
                .border_style(AXIS.mix(0.3))
                .label_font(("sans-serif", TEXT_SIZE));
            legend.draw().map_err(text)?;
        }
        if self.is_empty() {
            let (width, height) = root.dim_in_pixel();
            let at = (width as i32 / 2 - 40, height as i32 / 2);
            root.draw(&Text::new("no data", at, ("sans-serif", TEXT_SIZE))).map_err(text)?;
        }
        Ok(())
    }

    /// Draws each label beside its point, where it covers nothing.
    fn draw_labels(&self, root: &Canvas<'_>, chart: &PlotArea<'_, '_>) -> Result<(), String> {
        let pixel = |&(x, y): &(f64, f64)| chart.backend_coord(&(x, y));
        let ([x0, x1], [y0, y1]) = self.ranges();
        let ((left, bottom), (right, top)) = (pixel(&(x0, y0)), pixel(&(x1, y1)));
        let dots = self.series.iter().filter(|s| !s.mark.is_line()).flat_map(|s| &s.points);
        let lines = self.series.iter().filter(|s| s.mark != Mark::Dots && s.mark != Mark::Faint);
        let lines = lines.flat_map(|s| s.points.windows(2)).map(|ends| [pixel(&ends[0]), pixel(&ends[1])]);
        let lines: Vec<[Pixel; 2]> = lines.chain(self.bars().map(|ends| ends.map(|end| pixel(&end)))).collect();
        let width_most = |text: &str| (LABEL_CHAR * text.chars().count() as f64).ceil() as i32;
        let labels: Vec<(Pixel, i32)> =
            self.labels.iter().map(|(x, y, text)| (pixel(&(*x, *y)), width_most(text))).collect();
        let places = label_places(&labels, &dots.map(pixel).collect::<Vec<_>>(), &lines, [left, top, right, bottom]);
        let (base_x, base_y) = root.get_base_pixel();
        let here = |(x, y): Pixel| (x - base_x, y - base_y);
        for (((point, _), place), (_, _, label)) in labels.iter().zip(places).zip(&self.labels) {
            let Some((place, is_far)) = place else { continue };
            if is_far {
                let end = (point.0.clamp(place[0], place[2]), point.1.clamp(place[1], place[3]));
                root.draw(&PathElement::new([here(*point), here(end)], AXIS.mix(0.5))).map_err(text)?;
            }
            // Texts are narrower than their places: one on the left ends at its point, or at the end of its leader.
            let (side, x) = if place[2] < point.0 { (HPos::Right, place[2]) } else { (HPos::Left, place[0]) };
            let style = TextStyle::from(("sans-serif", LABEL_SIZE)).pos(Pos::new(side, VPos::Top));
            root.draw(&Text::new(label.clone(), here((x, place[1])), style)).map_err(text)?;
        }
        Ok(())
    }

    /// Both ends of each range; ranges that are not finite are dropped.
    fn bars(&self) -> impl Iterator<Item = [(f64, f64); 2]> {
        let all = self.ranges.iter().map(|&(x, low, high)| [(x, low), (x, high)]);
        all.filter(|ends| ends.iter().all(|(x, y)| is_drawable(*x) && is_drawable(*y)))
    }

    /// Ranges of the axes, with a margin; never empty.
    fn ranges(&self) -> ([f64; 2], [f64; 2]) {
        let points = || self.series.iter().flat_map(|s| &s.points);
        let range = |values: &mut dyn Iterator<Item = f64>| {
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
            if low > high { [0.0, 1.0] } else { [low, high] }
        };
        let ends = || self.bars().flatten();
        let x = range(&mut points().map(|p| p.0).chain(ends().map(|p| p.0)));
        let mut y = range(&mut points().map(|p| p.1).chain(ends().map(|p| p.1)));
        if self.from_zero {
            y[0] = y[0].min(0.0);
        }
        let widen = |[low, high]: [f64; 2], below: bool| {
            let span = if high > low { high - low } else { high.abs().max(1.0) };
            [if below { low - 0.04 * span } else { low }, high + 0.06 * span]
        };
        let x = match self.is_log {
            true if x[0] > 0.0 => widen(x.map(f64::log10), true).map(|decade| 10f64.powf(decade)),
            true => [1.0, 10.0],
            false => widen(x, x[0] > 0.0 && self.series.iter().any(|s| !s.mark.is_line())),
        };
        (x, widen(y, !self.from_zero))
    }
}

enum XAxis {
    Linear(RangedCoordf64),
    /// Of decimal logarithms.
    Decades(RangedCoordf64),
}

impl Ranged for XAxis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        match self {
            XAxis::Linear(range) => range.map(value, limit),
            XAxis::Decades(range) => range.map(&value.log10(), limit),
        }
    }

    /// In decades: one, two and five times the powers of ten.
    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        let decades = match self {
            XAxis::Linear(range) => return range.key_points(hint),
            XAxis::Decades(range) => range.range(),
        };
        let of_decade = |decade: i32| [1.0, 2.0, 5.0].map(|factor| factor * 10f64.powi(decade));
        let all = (decades.start.floor() as i32..=decades.end.floor() as i32).flat_map(of_decade);
        all.filter(|tick| decades.contains(&tick.log10())).collect()
    }

    fn range(&self) -> std::ops::Range<f64> {
        match self {
            XAxis::Linear(range) => range.range(),
            XAxis::Decades(range) => 10f64.powf(range.range().start)..10f64.powf(range.range().end),
        }
    }
}

type PlotArea<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<XAxis, RangedCoordf64>>;
type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// The SVG of a drawing, or a paragraph with the error.
fn draw_svg(size: (u32, u32), draw: impl FnOnce(&Canvas<'_>) -> Result<(), String>) -> String {
    let mut svg = String::new();
    let drawn = {
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        draw(&root).and_then(|()| root.present().map_err(text))
    };
    match drawn {
        Ok(()) => svg.replacen("<svg ", "<svg class=\"chart\" ", 1),
        Err(problem) => format!("<p class=\"dim\">This chart could not be drawn: {}</p>", escape(&problem)),
    }
}

/// The text of an error of `plotters`, whose type depends on the backend.
fn text<E: std::fmt::Display>(e: E) -> String {
    e.to_string()
}

type Pixel = (i32, i32);

/// A place for each label, a point and a width: its left, top, right and lower edge, and whether it is far from its point. It is the
/// first one within `plot` that covers no dot, no earlier label and no line; where there is none, the first that covers no dot and no
/// label; `None` without such a place.
fn label_places(
    labels: &[(Pixel, i32)],
    dots: &[Pixel],
    lines: &[[Pixel; 2]],
    plot: [i32; 4],
) -> Vec<Option<([i32; 4], bool)>> {
    let mut taken: Vec<[i32; 4]> = dots.iter().map(|&(x, y)| [x - 4, y - 4, x + 4, y + 4]).collect();
    let place = |&((x, y), width): &(Pixel, i32)| {
        let places = LABEL_REACH.into_iter().flat_map(|reach| {
            let (right, left, middle) = (x + reach, x - reach - width, x - width / 2);
            let (above, level, below) = (y - reach - LABEL_HEIGHT, y - LABEL_HEIGHT / 2, y + reach);
            let all = [
                (right, level),
                (left, level),
                (middle, above),
                (middle, below),
                (right, above),
                (right, below),
                (left, above),
                (left, below),
            ];
            all.map(|(x, y)| ([x, y, x + width, y + LABEL_HEIGHT], reach > LABEL_REACH[0]))
        });
        let is_free = |(b, _): &([i32; 4], bool)| {
            let is_inside = b[0] >= plot[0] && b[1] >= plot[1] && b[2] <= plot[2] && b[3] <= plot[3];
            is_inside && taken.iter().all(|t| b[0] >= t[2] || t[0] >= b[2] || b[1] >= t[3] || t[1] >= b[3])
        };
        let free: Vec<([i32; 4], bool)> = places.filter(is_free).collect();
        let found = free.iter().find(|(b, _)| !lines.iter().any(|line| crosses(line, b))).or(free.first()).copied();
        taken.extend(found.map(|(b, _)| b));
        found
    };
    labels.iter().map(place).collect()
}

/// Whether a line meets a box of left, top, right and lower edge.
fn crosses([a, b]: &[Pixel; 2], edges: &[i32; 4]) -> bool {
    let (mut from, mut to) = (0.0f64, 1.0f64);
    for (start, end, low, high) in [(a.0, b.0, edges[0], edges[2]), (a.1, b.1, edges[1], edges[3])] {
        let [start, end, low, high] = [start, end, low, high].map(f64::from);
        if start == end {
            if start < low || start > high {
                return false;
            }
            continue;
        }
        let [one, other] = [low, high].map(|edge| (edge - start) / (end - start));
        (from, to) = (from.max(one.min(other)), to.min(one.max(other)));
    }
    from <= to
}

/// The colour with this number. Behind [`COLORS`] comes the one of a fixed set that differs most from all before it. Some 150 numbers
/// have colours of their own.
fn color(index: usize) -> RGBColor {
    let hues = |lightness: f64| (0..30).map(move |hue| HSLColor(f64::from(hue) / 30.0, 0.7, lightness));
    let fixed = [0.25, 0.36, 0.47, 0.58, 0.69].into_iter().flat_map(hues).map(|color| color.rgb());
    let mut left: Vec<RGBColor> = fixed.map(|(r, g, b)| RGBColor(r, g, b)).collect();
    let mut palette = COLORS.to_vec();
    while palette.len() <= index && !left.is_empty() {
        let nearest = |color: &RGBColor| palette.iter().map(|other| difference(*color, *other)).min();
        let farthest = (0..left.len()).max_by_key(|&i| (nearest(&left[i]), left.len() - i)).unwrap_or(0);
        palette.push(left.swap_remove(farthest));
    }
    palette[index % palette.len()]
}

/// How much two colours differ to the eye: the squared distance with the weights of "redmean".
fn difference(RGBColor(r, g, b): RGBColor, RGBColor(r2, g2, b2): RGBColor) -> i64 {
    let [red, green, blue] = [(r, r2), (g, g2), (b, b2)].map(|(one, other)| i64::from(one) - i64::from(other));
    let mean = (i64::from(r) + i64::from(r2)) / 2;
    (512 + mean) * red * red + 1024 * green * green + (767 - mean) * blue * blue
}

/// A name that fits the legend. A longer name loses its middle, because names of runs differ at both ends.
fn shortened(name: &str) -> String {
    let length = name.chars().count();
    if length <= NAME_MAX {
        return name.to_string();
    }
    let (before, after) = (NAME_MAX / 2, NAME_MAX - NAME_MAX / 2 - 1);
    name.chars().take(before).chain(['…']).chain(name.chars().skip(length - after)).collect()
}

fn draw_series(chart: &mut PlotArea<'_, '_>, series: &Series, in_legend: bool) -> Result<(), String> {
    let color = color(series.color);
    let is_named = in_legend && !series.name.is_empty();
    if series.mark != Mark::Dots {
        let style = if series.mark == Mark::Faint { color.mix(0.35).stroke_width(1) } else { color.stroke_width(2) };
        let drawn = chart.draw_series(LineSeries::new(series.points.iter().copied(), style)).map_err(text)?;
        if is_named {
            drawn
                .label(&series.name)
                .legend(move |(x, y)| Rectangle::new([(x, y - 4), (x + 12, y + 4)], color.filled()));
        }
    }
    // A line through one point has no length.
    if !series.mark.is_line() || series.points.len() == 1 {
        let dots = series.points.iter().map(|&p| Circle::new(p, 3, color.filled()));
        let drawn = chart.draw_series(dots).map_err(text)?;
        if is_named && series.mark == Mark::Dots {
            drawn.label(&series.name).legend(move |(x, y)| Circle::new((x + 6, y), 4, color.filled()));
        }
    }
    Ok(())
}

/// The curve with every value replaced by the mean over a twentieth of the curve around it, fewer towards the ends; empty
/// for a curve of few points, which needs none.
pub fn smoothed(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let half = points.len() / SMOOTH_SHARE / 2;
    if half == 0 {
        return Vec::new();
    }
    let mean = |i: usize| {
        let reach = half.min(i).min(points.len() - 1 - i);
        let around = &points[i - reach..=i + reach];
        around.iter().map(|p| p.1).sum::<f64>() / around.len() as f64
    };
    (0..points.len()).map(|i| (points[i].0, mean(i))).collect()
}

/// Of a bar chart: height of a bar with the gap below it and of the title, width of the names and of the value beside the longest bar.
const BAR: i32 = 26;
const TITLE: i32 = 40;
const NAMES: i32 = 320;
const VALUES: i32 = 250;

/// Named values, one horizontal bar each; an empty bar for a value that is missing or not finite.
#[derive(Debug, Clone)]
pub struct Bars {
    pub title: String,
    /// Name, value, and text of the value.
    pub bars: Vec<(String, Option<f64>, String)>,
}

impl Bars {
    /// The chart as SVG, the first bar on top.
    pub fn svg(&self) -> String {
        draw_svg((WIDE.0, (TITLE + BAR * self.bars.len() as i32 + 6) as u32), |root| self.draw(root))
    }

    fn draw(&self, root: &Canvas<'_>) -> Result<(), String> {
        let anchor = |h| Pos::new(h, VPos::Center);
        let title = TextStyle::from(("sans-serif", 20)).pos(anchor(HPos::Center));
        root.draw(&Text::new(self.title.clone(), (WIDE.0 as i32 / 2, TITLE / 2), title)).map_err(text)?;
        let finite = |v: &Option<f64>| v.filter(|v| v.is_finite());
        let most = self.bars.iter().filter_map(|(_, v, _)| finite(v)).fold(0.0, f64::max);
        let room = f64::from(WIDE.0 as i32 - NAMES - VALUES);
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

/// Scale and letter that shorten a number.
fn unit(value: f64) -> (f64, &'static str) {
    match value.abs() {
        m if m >= 1e9 => (1e9, "G"),
        m if m >= 1e6 => (1e6, "M"),
        m if m >= 1e4 => (1e3, "k"),
        _ => (1.0, ""),
    }
}

/// A number in few characters, such as 1.2M, 350k, 0.25.
pub fn short(value: f64) -> String {
    let (scale, unit) = unit(value);
    let scaled = value / scale;
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

/// The label of a tick on an axis that covers `span`, with enough digits to tell neighbours apart.
fn tick(value: f64, span: f64) -> String {
    let (scale, unit) = unit(value);
    // About eight ticks; one digit more than their distance needs.
    let digits = (1.0 - (span / scale / 8.0).log10()).floor().clamp(0.0, 12.0) as usize;
    let text = format!("{:.digits$}", value / scale);
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_string() } else { format!("{text}{unit}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_logarithmic_axis_has_equal_steps_for_equal_factors() {
        let points = [0.0, 4.0, 8.0, 500.0, 1000.0].map(|x| (x, 1.0)).to_vec();
        assert!(Chart::new("", "s", "dB").logarithmic().svg().contains("no data"));
        let svg = Chart::new("", "s", "dB").with("", points, Mark::Dots).logarithmic().svg();
        let at = |part: &str| part.split_once('"').and_then(|(value, _)| value.parse::<i32>().ok());
        let dots: Vec<i32> = svg.split("<circle cx=\"").skip(1).filter_map(at).collect();
        assert_eq!(dots.len(), 4, "what is not above zero has no place: {svg}");
        // Pixels are whole.
        assert!((dots[1] - dots[0] - (dots[3] - dots[2])).abs() <= 1, "{dots:?}");
        for tick in ["5", "10", "20", "500", "1000"] {
            assert!(svg.contains(&format!("\n{tick}\n")), "{tick} is no tick: {svg}");
        }
    }

    #[test]
    fn smoothing_keeps_lines_and_evens_out_noise() {
        let line: Vec<(f64, f64)> = (0..100).map(|i| (f64::from(i), 3.0 * f64::from(i))).collect();
        // Sums of five values, divided by five.
        assert!(smoothed(&line).iter().zip(&line).all(|(a, b)| a.0 == b.0 && (a.1 - b.1).abs() < 1e-9));
        let noise: Vec<(f64, f64)> = (0..100).map(|i| (f64::from(i), f64::from(i % 2))).collect();
        assert!(smoothed(&noise)[5..95].iter().all(|p| (0.4..=0.6).contains(&p.1)));
        assert!(smoothed(&line[..39]).is_empty());
    }

    #[test]
    fn a_long_legend_stays_inside_the_chart() {
        let mut chart = Chart::new("a", "b", "c").wide();
        let name = |i: usize| format!("resolution-1-2-seed{i}-0123&{i:04}");
        for i in 0..60 {
            chart = chart.with(&name(i), vec![(0.0, 0.0), (1.0, i as f64)], Mark::Line);
        }
        let svg = chart.with("short", vec![(1.0, 1.0)], Mark::Dots).svg();
        let height = LEGEND_TOP + 61 * LEGEND_ROW;
        assert!(svg.contains(&format!("viewBox=\"0 0 1040 {height}\"")) && svg.trim_end().ends_with("</svg>"), "{svg}");
        assert!(svg.contains(&format!("cy=\"{}\"", height - LEGEND_ROW)), "the last row is inside");
        assert!(svg.contains(">\nresolution-1…7-0123&amp;0007\n") && svg.contains(">\nshort\n"));
        assert_eq!(shortened(&name(7)), "resolution-1…7-0123&0007");
        assert_eq!(shortened("ä".repeat(30).as_str()).chars().count(), NAME_MAX);
        assert_eq!(shortened(&"b".repeat(NAME_MAX)), "b".repeat(NAME_MAX));
        assert!(Chart::new("a", "b", "c").wide().svg().contains("viewBox=\"0 0 1040 480\""));
    }

    #[test]
    fn ranges_are_within_the_axes_and_odd_ones_are_left_out() {
        let chart = Chart::new("a", "b", "c").with("", vec![(1.0, 1.0), (2.0, 2.0)], Mark::Dots);
        let bars = |chart: &Chart| chart.svg().matches("opacity=\"0.6\" stroke=\"#616161\"").count();
        let mut with = chart.clone();
        with.ranges = vec![(1.0, -3.0, 4.0), (f64::NAN, 0.0, 1.0), (1.0, 0.0, f64::INFINITY)];
        assert_eq!([bars(&chart), bars(&with)], [0, 1], "{}", with.svg());
        let (_, [y0, y1]) = with.ranges();
        assert!(y0 <= -3.0 && (4.0..6.0).contains(&y1));
    }

    #[test]
    fn no_two_categories_share_a_colour() {
        let all: Vec<RGBColor> = (0..150).map(color).collect();
        for (i, one) in all.iter().enumerate() {
            let nearest = all[..i].iter().map(|other| difference(*one, *other)).min();
            // Of 20 grey levels at least while a legend is still read, and of some at least.
            assert!(
                nearest.is_none_or(|nearest| nearest > if i < 40 { 20 * 20 * 2303 } else { 0 }),
                "{i}: {one:?}, {nearest:?}"
            );
        }
    }

    #[test]
    fn labels_cover_no_dot_no_line_and_no_other_label() {
        let plot = [0, 0, 600, 400];
        let dots: Vec<Pixel> = (0..40).map(|i| (50 + 12 * i, 200 + 37 * i % 90)).collect();
        let labels: Vec<(Pixel, i32)> = dots.iter().map(|&dot| (dot, 60)).collect();
        let line = [[(0, 180), (600, 180)]];
        let places: Vec<[i32; 4]> =
            label_places(&labels, &dots, &line, plot).into_iter().flatten().map(|p| p.0).collect();
        assert!(places.len() > 30, "{}", places.len());
        let covers = |a: &[i32; 4], b: &[i32; 4]| a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
        for (i, place) in places.iter().enumerate() {
            assert!(place[0] >= 0 && place[1] >= 0 && place[2] <= 600 && place[3] <= 400);
            assert!(places[..i].iter().all(|other| !covers(place, other)));
            assert!(dots.iter().all(|&(x, y)| !covers(place, &[x - 4, y - 4, x + 4, y + 4])));
        }
        let crossed = places.iter().filter(|place| crosses(&line[0], place)).count();
        assert!(crossed <= 2, "{crossed}");
        // Where there is no room, labels are dropped.
        let heap = vec![((300, 200), 60); 90];
        assert!(label_places(&heap, &[(300, 200)], &[], plot).contains(&None));
        let mut chart = Chart::new("a", "b", "c").with("knob", vec![(0.0, 0.0), (1.0, 1.0)], Mark::Dots).wide();
        chart.labels = vec![(1.0, 1.0, "a label".into())];
        let svg = chart.svg();
        assert!(svg.contains(">\na label\n") && svg.contains(">\nknob") && svg.contains("width=\"1040\""), "{svg}");
    }

    #[test]
    fn charts_hold_their_series_and_survive_odd_data() {
        let svg = Chart::new("PSNR <b>", "step", "dB")
            .with("train & test", vec![(0.0, 10.0), (1.0, f64::NAN), (2.0, 20.0)], Mark::Line)
            .with("dots", vec![(1.0, 15.0)], Mark::Dots)
            .svg();
        assert!(svg.starts_with("<svg") && svg.contains("polyline") && svg.contains("circle"));
        let values = svg.split('"').nth(1).unwrap_or_default().replace("&quot;", "\"").replace("&amp;", "&");
        let values: serde_json::Value = serde_json::from_str(&values).unwrap_or_default();
        assert_eq!(
            values["series"][0],
            json!({ "name": "train & test", "points": [[0.0, 10.0], [2.0, 20.0]] }),
            "{values}"
        );
        // The first point lies at the left edge of the plot, less the margin of the axis.
        let [left, right] = [0, 2].map(|edge| values["plot"][edge].as_i64().unwrap_or(-1));
        assert!(0 < left && left < right && right < i64::from(SIZE.0) && values["of"] == "step", "{values}");
        assert!(svg.contains("train &amp; test") && !svg.contains("<b>"));
        assert!(Chart::new("a", "b", "c").svg().contains("no data"));
        let flat = Chart::new("a", "b", "c").with("", vec![(5.0, 1.0), (5.0, 1.0)], Mark::Line).zero_based().svg();
        assert!(flat.contains("polyline"));
        // Axes of any length have few ticks.
        for most in [1e300, 1e308, f64::MAX] {
            let svg = Chart::new("a", "b", "c").with("", vec![(-most, 0.0), (most, most)], Mark::Line).svg();
            assert!(svg.len() < 100_000, "{most:e}: {} bytes", svg.len());
        }
    }

    #[test]
    fn bars_are_as_long_as_their_values() {
        let bar = |name: &str, value| (name.to_string(), value, format!("{value:?}"));
        let bars = vec![bar("a <", Some(2.0)), bar("b", Some(1.0)), bar("c", None), bar("d", Some(f64::NAN))];
        let svg = Bars { title: "seconds".into(), bars }.svg();
        let width = |w: i32| format!("width=\"{w}\"");
        let longest = WIDE.0 as i32 - NAMES - VALUES;
        assert!(svg.contains(&width(longest)) && svg.contains(&width(longest / 2)), "{svg}");
        assert!(svg.contains("a &lt;") && svg.matches(&width(1)).count() == 2);
        assert!(Bars { title: String::new(), bars: Vec::new() }.svg().starts_with("<svg"));
    }

    #[test]
    fn numbers_are_short() {
        let cases = [(0.0, "0"), (0.25, "0.25"), (26.7, "26.7"), (12_345.0, "12.3k"), (2.5e6, "2.5M"), (-3e9, "-3G")];
        for (value, want) in cases {
            assert_eq!(short(value), want);
        }
    }

    #[test]
    fn ticks_of_a_narrow_axis_differ() {
        let ticks = [19.3, 19.35, 19.4].map(|v| tick(v, 0.3));
        assert_eq!(ticks, ["19.3", "19.35", "19.4"]);
        assert_eq!([0.0, 0.0005, 0.001].map(|v| tick(v, 0.003)), ["0", "0.0005", "0.001"]);
        assert_eq!([tick(25_000.0, 1e5), tick(3000.0, 3000.0), tick(-0.0, 1.0)], ["25k", "3000", "0"]);
        let ticks = [149_880.0, 149_890.0, 149_900.0, 149_950.0].map(|v| tick(v, 77.0));
        assert_eq!(ticks, ["149.88k", "149.89k", "149.9k", "149.95k"]);
        assert_eq!([1.5e6, 2e6, -2e6].map(|v| tick(v, 3e6)), ["1.5M", "2M", "-2M"]);
        assert_eq!([2_000_000.0, 2_000_010.0].map(|v| tick(v, 70.0)), ["2M", "2.00001M"]);
    }
}
