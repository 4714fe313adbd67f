//! What the photos say about themselves before training: whether their exposures differ, their poses are off, some of them show something
//! else, and whether the first points fit them.
//!
//! The first points are drawn into each photo, each as one pixel, and the colours of points and pixels are compared. A point of another
//! colour than its pixel may be hidden or shiny; hundreds of them are not. For each photo:
//!
//! - *gain*: by how many stops the photo is brighter than its points, for each colour: the median over the points;
//! - *agreement*: the correlation of brightness over the points. A photo of another place has next to none;
//! - *shift*: where the agreement is best, when all pixels move together by some pixels. Poses that are off have shifts.
//!
//! From these follow the remedies that a run switches on by itself ([`Diagnosis::remedies`]). Where the points say nothing, the run
//! finds out in training whether exposures differ ([`Remedies::of_unknown`]).
//!
//! Not here: what training finds ([`super::outlier`]).
//!
//! Invariants: 1. the result is a function of photos, poses and points; 2. one photo is decoded at a time, and beyond `PHOTOS_LEAST`
//! photos no more than `PIXELS_MOST` pixels are decoded and `DRAWN_MOST` points drawn in all.

use super::exposure::{AppearanceMode, EXPOSURE_SPREAD, PHOTOS_FOR_REMEDIES};
use super::outlier::{is_used, median_and_deviation, spread};
use super::parameter::{Curve, Finding, write_values};
use super::visible::{points_in, visible_points};
use crate::base::error::InputResult;
use crate::base::units::format_grouped;
use crate::dataset::loader::{Dataset, first_error};
use crate::dataset::photo::decode;
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// Pixels of the photo files that are decoded.
const PIXELS_MOST: u64 = 300_000_000;
/// Photos that are looked at however large they are.
const PHOTOS_LEAST: usize = 24;
/// Most points that are kept of a scene: a photo of a city shows a thousandth of it.
pub const POINTS_MOST: usize = 1 << 20;
/// Most points for the estimate of how many points a photo shows. They are enough if a photo shows `POINTS_WANTED` of them.
const POINTS_FIRST: usize = 16_384;
const POINTS_WANTED: f64 = 512.0;
/// Points that are drawn into all photos.
const DRAWN_MOST: usize = 1 << 31;
/// Fewest points in a photo for a finding about it.
const POINTS_LEAST: usize = 24;
/// Shifts are measured in units of the longer side, and tried up to so many units in each direction.
const UNITS: u32 = 400;
const SHIFTS: i32 = 9;
/// Points by which shifts are compared.
const POINTS_FOR_SHIFTS: usize = 1024;
/// Pixel values beyond these are clipped or dark noise: they say nothing about gains.
const VALUES: std::ops::Range<u8> = 10..246;

/// A first point: local frame, sRGB.
pub type ColoredPoint = ([f32; 3], [u8; 3]);

/// What one photo says.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhotoFinding {
    pub name: String,
    /// Points that are drawn in it.
    pub points: usize,
    /// Stops by which its red, green and blue are brighter than its points.
    pub gain: [f64; 3],
    /// Correlation of brightness with the points, at the best shift and without one.
    pub agreement: f64,
    pub agreement_in_place: f64,
    /// Pixels, right and down, and those of a unit.
    pub shift: [i32; 2],
    pub unit: u32,
    /// Share of the points whose brightness is off by more than half a stop after the gain.
    pub off: f64,
}

impl PhotoFinding {
    fn shift_pixels(&self) -> f64 {
        libm::hypot(self.shift[0].into(), self.shift[1].into())
    }
}

/// What the photos say.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Diagnosis {
    /// The training photos that were looked at and show enough points, in the order of their names.
    pub photos: Vec<PhotoFinding>,
    /// Training photos in which a point lies, in the mean, whether or not it is hidden.
    pub photos_per_point: f64,
    /// First points in a training photo, the median.
    pub points_per_photo: f64,
    /// Robust standard deviations over the photos, stops: of the gain of green, and of that of red less that of blue.
    pub exposure_spread: f64,
    pub color_spread: f64,
    /// Medians over the photos.
    pub agreement: f64,
    /// What a shift adds to the agreement.
    pub agreement_by_shift: f64,
    /// Pixels, and in units of each photo.
    pub shift: f64,
    pub shift_units: f64,
    /// Whether the points differ in colour.
    pub are_colored: bool,
    /// Numbers in `photos` of those that show something else.
    pub wrong: Vec<usize>,
}

/// Photos that a line names.
const NAMED: usize = 3;
/// Below this agreement, points and photos have nothing to do with each other. Measured: 0 to .04 with random points; .6 to .84 on clean
/// scenes, and .7 with the faults of `gsscale-bench sweep stability`.
const AGREEMENT_LEAST: f64 = 0.25;
/// Stops of [`Diagnosis::color_spread`] from which on colours are trained, too. Measured: 0 to .06 on clean scenes; .44 with white balance
/// within .3 stops.
const COLOR_SPREAD: f64 = 0.2;
/// A photo shows something else if its agreement is below the first share of the median, and the share of its points that are off exceeds
/// both the second factor times the median and the third value. Uniform photos have a low agreement, but hardly a point that is off.
const WRONG_AGREEMENT: f64 = 0.5;
const WRONG_OFF: f64 = 1.5;
const WRONG_OFF_LEAST: f64 = 0.1;
/// Poses are refined where the median shift is at least so many units, and the shifts raise the agreement by at least so much (median).
/// Measured: both 0 on nine clean scenes and with other faults, at 132 pixels and at full size; 1 to 6 units and .012 to .13 with poses off by
/// .5 % of the scene's size.
const SHIFT_UNITS: f64 = 1.0;
const AGREEMENT_BY_SHIFT: f64 = 0.01;
/// Least number of photos that show a point (mean) for the remedies of poor points: where photos overlap less, these
/// remedies cost more than they gain. Measured: 38 on cross, which gains; 7 on seneca, which loses.
const PHOTOS_PER_POINT: f64 = 16.0;

/// What a diagnosis asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Remedies {
    pub appearance: AppearanceMode,
    pub robust_views: bool,
    /// Training judges whether photos show moving things.
    pub judge_pixels: bool,
    pub refine_poses: bool,
    pub poor_points: bool,
    /// The run begins from points that the photos agree on.
    pub sweep_points: bool,
}

impl Remedies {
    /// Where nothing is known before training. Not robust views: they cost .3 dB on clean seneca from random points.
    pub fn of_unknown() -> Remedies {
        Remedies { appearance: AppearanceMode::IfNeeded, ..Remedies::default() }
    }
}

#[derive(Serialize)]
struct DiagnosisFile<'a> {
    text: Vec<String>,
    #[serde(flatten)]
    found: &'a Diagnosis,
}

/// What a report says about it, from its file.
pub fn finding(file: &Value) -> Option<Finding> {
    let text: Vec<&str> = file["text"].as_array()?.iter().filter_map(Value::as_str).collect();
    let photos = file["photos"].as_array()?;
    let values: Vec<f64> = photos.iter().filter_map(|photo| photo["gain"][1].as_f64()).collect();
    let caption =
        String::from("By how much each photo is brighter than the first points in it. diagnosis.json has the numbers.");
    let curve = Curve { title: "Photos against first points", unit: "stops", values, caption };
    let curve = (!photos.is_empty()).then_some(curve);
    Some(Finding { title: "Photos before training", text: text.join("; ") + ".", table: None, curve })
}

/// Looks at the training photos. `points` are first points with their colours, evenly drawn from `count` points.
/// Errors: the first photo of those that cannot be read, with the names of the others.
pub fn diagnose(dataset: &Dataset, points: &[ColoredPoint], count: u64) -> InputResult<Diagnosis> {
    let views = dataset.train_views();
    let first = thinned(points, points.len().div_ceil(POINTS_FIRST));
    let in_view = |&view: &usize| points_in(&first, |point| point.0, &dataset.views[view].camera).len() as f64;
    let in_views: Vec<f64> = views.par_iter().map(in_view).collect();
    let share = median(in_views.clone()) / first.len().max(1) as f64;
    let every = (points.len() as f64 * share / POINTS_WANTED) as usize;
    let points = &thinned(points, every.min(points.len().div_ceil(POINTS_FIRST)))[..];
    let header = |view: usize| &dataset.views[view].photo.header;
    let pixels: u64 = views.iter().map(|&view| u64::from(header(view).width) * u64::from(header(view).height)).sum();
    let affordable = (PIXELS_MOST as f64 / (pixels as f64 / views.len() as f64)) as usize;
    let affordable = affordable.min(DRAWN_MOST / points.len().max(1));
    let looked_at = views.len().min(affordable.max(PHOTOS_LEAST));
    let (mut photos, mut errors) = (Vec::with_capacity(looked_at), Vec::new());
    for number in 0..looked_at {
        let view = &dataset.views[views[number * views.len() / looked_at]];
        match decode(&view.photo) {
            Ok(photo) => {
                let found = PhotoLook::new(&photo, &view.camera, points).finding();
                photos.extend(found.map(|found| PhotoFinding { name: view.name.clone(), ..found }));
            }
            Err(error) => errors.push((view.name.as_str(), error)),
        }
    }
    if let Some(error) = first_error(errors) {
        return Err(error);
    }
    let of = |value: &dyn Fn(&PhotoFinding) -> f64| photos.iter().map(value).collect::<Vec<f64>>();
    let agreement = median(of(&|photo| photo.agreement));
    let off_most = (WRONG_OFF * median(of(&|photo| photo.off))).max(WRONG_OFF_LEAST);
    let is_wrong = |photo: &PhotoFinding| photo.agreement < WRONG_AGREEMENT * agreement && photo.off > off_most;
    Ok(Diagnosis {
        photos_per_point: in_views.iter().sum::<f64>() / first.len().max(1) as f64,
        points_per_photo: share * count as f64,
        exposure_spread: spread(of(&|photo| photo.gain[1])),
        color_spread: spread(of(&|photo| photo.gain[0] - photo.gain[2])),
        agreement,
        agreement_by_shift: median(of(&|photo| photo.agreement - photo.agreement_in_place)),
        shift: median(of(&PhotoFinding::shift_pixels)),
        shift_units: median(of(&|photo| photo.shift_pixels() / f64::from(photo.unit))),
        are_colored: points.iter().any(|(_, color)| *color != points[0].1),
        wrong: (0..photos.len()).filter(|&number| is_wrong(&photos[number])).collect(),
        photos,
    })
}

impl Diagnosis {
    /// Writes the findings, and the lines that tell them. Errors: the file cannot be written.
    pub fn write_file(&self, path: &Path) -> InputResult<()> {
        write_values(path, &DiagnosisFile { text: self.text(), found: self })
    }

    /// Whether points and photos agree, so that a photo can be judged by the points.
    pub fn points_fit(&self) -> bool {
        self.agreement >= AGREEMENT_LEAST
    }

    /// Whether the colours of the points say that the points are elsewhere than what the photos show.
    pub fn points_contradict(&self) -> bool {
        self.photos.len() >= PHOTOS_FOR_REMEDIES && self.are_colored && !self.points_fit()
    }

    /// What a run without flags switches on.
    pub fn remedies(&self) -> Remedies {
        if self.photos.len() < PHOTOS_FOR_REMEDIES {
            return Remedies::of_unknown();
        }
        if !self.points_fit() {
            return Remedies { poor_points: self.photos_per_point >= PHOTOS_PER_POINT, ..Remedies::of_unknown() };
        }
        let appearance = match (self.color_spread >= COLOR_SPREAD, self.exposure_spread >= EXPOSURE_SPREAD) {
            (true, _) => AppearanceMode::Full,
            (false, true) => AppearanceMode::Exposure,
            (false, false) => AppearanceMode::Off,
        };
        Remedies {
            appearance,
            robust_views: !self.wrong.is_empty(),
            judge_pixels: true,
            refine_poses: self.shift_units >= SHIFT_UNITS && self.agreement_by_shift >= AGREEMENT_BY_SHIFT,
            poor_points: false,
            sweep_points: false,
        }
    }

    /// Lines of a plan.
    pub fn text(&self) -> Vec<String> {
        let examined = self.photos.len();
        if examined < PHOTOS_FOR_REMEDIES {
            return vec![format!(
                "only {examined} show enough first points to be examined: no remedy is chosen by them"
            )];
        }
        let digits = usize::from(self.photos_per_point < 10.0);
        let points = format!(
            "a photo shows {} first points (median), and {:.digits$} photos show each point (mean)",
            format_grouped(self.points_per_photo as u64),
            self.photos_per_point
        );
        if !self.points_fit() {
            return vec![format!(
                "{examined} examined: the first points have not the colours that photos show there; {points}"
            )];
        }
        let mut lines = vec![format!(
            "{examined} examined: exposures differ by {:.2} stops and colours by {:.2}; {points}",
            self.exposure_spread, self.color_spread
        )];
        if self.shift > 0.0 {
            lines.push(format!("poses are off by {:.0} pixels (median)", self.shift));
        }
        if !self.wrong.is_empty() {
            let named: Vec<&str> =
                self.wrong.iter().take(NAMED).map(|&number| self.photos[number].name.as_str()).collect();
            let more = match self.wrong.len().saturating_sub(NAMED) {
                0 => String::new(),
                more => format!(" and {more} more (see diagnosis.json)"),
            };
            let count = self.wrong.len();
            lines.push(format!("{count} do not show what their poses look at: {}{more}", named.join(", ")));
        }
        lines
    }
}

/// One point in `every`.
fn thinned(points: &[ColoredPoint], every: usize) -> Vec<ColoredPoint> {
    points.iter().step_by(every.max(1)).copied().collect()
}

/// A photo beside the points that it shows.
struct PhotoLook<'a> {
    photo: &'a Target,
    /// Pixels of one unit of shift.
    unit: i32,
    /// The column and row of each point, and its colour.
    points: Vec<([i32; 2], [u8; 3])>,
}

impl<'a> PhotoLook<'a> {
    fn new(photo: &'a Target, camera: &Camera, points: &[ColoredPoint]) -> PhotoLook<'a> {
        let longer = photo.width.max(photo.height);
        let unit = unit_of(longer) as i32;
        let margin = unit * SHIFTS;
        let inside = |at: i32, size: u32| (margin..size as i32 - margin).contains(&at);
        let counts = |[x, y]: [i32; 2]| {
            let pixel = y as usize * photo.width as usize + x as usize;
            inside(x, photo.width) && inside(y, photo.height) && is_used(photo, pixel)
        };
        let seen = visible_points(points, |point| point.0, camera).into_iter();
        let seen = seen.map(|point| (point.at.map(|x| x as i32), points[point.point].1));
        PhotoLook { photo, unit, points: seen.filter(|(at, _)| counts(*at)).collect() }
    }

    fn pixel(&self, [x, y]: [i32; 2]) -> [u8; 3] {
        let at = 3 * (y as usize * self.photo.width as usize + x as usize);
        [0, 1, 2].map(|channel| self.photo.rgb[at + channel])
    }

    /// Correlation of brightness over one in `every` points, all pixels moved by so many units of shift.
    fn agreement(&self, [right, down]: [i32; 2], every: usize) -> f64 {
        let (mut sums, count) = ([0.0; 5], self.points.len().div_ceil(every));
        for &([x, y], color) in self.points.iter().step_by(every) {
            let a = luminance(self.pixel([x + self.unit * right, y + self.unit * down]));
            let b = luminance(color);
            for (sum, value) in sums.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                *sum += value;
            }
        }
        let [a, b, aa, bb, ab] = sums.map(|sum| sum / count as f64);
        let of_both = ((aa - a * a).max(0.0) * (bb - b * b).max(0.0)).sqrt();
        if of_both > 0.0 { (ab - a * b) / of_both } else { 0.0 }
    }

    /// `None` where the photo shows too few points, or too few that are neither clipped nor dark.
    fn finding(&self) -> Option<PhotoFinding> {
        if self.points.len() < POINTS_LEAST {
            return None;
        }
        let every = self.points.len().div_ceil(POINTS_FOR_SHIFTS);
        let (mut shift, mut best) = ([0, 0], self.agreement([0, 0], every));
        for down in -SHIFTS..=SHIFTS {
            for right in -SHIFTS..=SHIFTS {
                let here = self.agreement([right, down], every);
                if here > best {
                    (shift, best) = ([right, down], here);
                }
            }
        }
        let [agreement_in_place, agreement] = [[0, 0], shift].map(|shift| self.agreement(shift, 1));
        let moved = shift.map(|x| self.unit * x);
        let stops = |channel: usize| {
            let pairs = self
                .points
                .iter()
                .map(|&([x, y], color)| (self.pixel([x + moved[0], y + moved[1]])[channel], color[channel]));
            let is_clear = |(pixel, color): &(u8, u8)| VALUES.contains(pixel) && VALUES.contains(color);
            pairs
                .filter(is_clear)
                .map(|(pixel, color)| libm::log2(f64::from(pixel) / f64::from(color)))
                .collect::<Vec<_>>()
        };
        let gain = [0, 1, 2].map(|channel| median(stops(channel)));
        let green = stops(1);
        let off = green.iter().filter(|&stops| (stops - gain[1]).abs() > 0.5).count() as f64 / green.len() as f64;
        if green.len() < POINTS_LEAST {
            return None;
        }
        Some(PhotoFinding {
            name: String::new(),
            points: self.points.len(),
            gain,
            agreement,
            agreement_in_place,
            shift: moved,
            unit: self.unit as u32,
            off,
        })
    }
}

/// Pixels of a unit of shift.
fn unit_of(longer: u32) -> u32 {
    (longer / UNITS).max(1)
}

fn luminance([r, g, b]: [u8; 3]) -> f64 {
    0.299 * f64::from(r) + 0.587 * f64::from(g) + 0.114 * f64::from(b)
}

/// The median, the lower of two middle values; 0 of nothing.
fn median(mut values: Vec<f64>) -> f64 {
    median_and_deviation(&mut values).map_or(0.0, |(median, _)| median)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(agreement: f64) -> PhotoFinding {
        let name = String::from("a.jpg");
        PhotoFinding {
            name,
            points: 100,
            gain: [0.0; 3],
            agreement,
            agreement_in_place: agreement,
            shift: [0; 2],
            unit: 1,
            off: 0.1,
        }
    }

    fn of(photos: usize, agreement: f64) -> Diagnosis {
        Diagnosis {
            photos: vec![finding(agreement); photos],
            photos_per_point: 30.0,
            points_per_photo: 500.0,
            exposure_spread: 0.05,
            color_spread: 0.05,
            agreement,
            agreement_by_shift: 0.0,
            shift: 0.0,
            shift_units: 0.0,
            are_colored: true,
            wrong: Vec::new(),
        }
    }

    #[test]
    fn a_remedy_takes_photos_that_can_be_judged() {
        let none = Remedies { judge_pixels: true, ..Remedies::default() };
        let exposure = |photos, agreement| Diagnosis { exposure_spread: 0.7, ..of(photos, agreement) }.remedies();
        assert_eq!(exposure(100, 0.7), Remedies { appearance: AppearanceMode::Exposure, ..none });
        let unknown = Remedies::of_unknown();
        assert_eq!((exposure(7, 0.7), of(100, 0.7).remedies()), (unknown, none));
        // Points that do not fit say nothing about exposures, and are poor where photos overlap much.
        assert_eq!(exposure(100, 0.1), Remedies { poor_points: true, ..unknown });
        let sparse = Diagnosis { photos_per_point: 7.0, ..of(100, 0.1) };
        assert_eq!(sparse.remedies(), unknown);
        assert!(sparse.text()[0].contains("have not the colours"));
        // Shifts count in units of each photo, and where they explain something.
        let shifted = |shift_units, by| Diagnosis { shift_units, agreement_by_shift: by, ..of(100, 0.7) }.remedies();
        assert_eq!(shifted(3.0, 0.1), Remedies { refine_poses: true, ..none });
        assert_eq!((shifted(0.75, 0.1), shifted(3.0, 0.005)), (none, none));
    }

    #[test]
    fn a_photo_is_compared_where_it_shows_its_points() {
        let camera = Camera::along_z(0.0, [100.0, 100.0, 50.0, 40.0], [100, 80]);
        // A pattern without repetition, and a point for each fourth pixel; the photo is twice as bright.
        let value = |x: u32, y: u32| (20 + (x * x * 7 + y * y * 13 + x * y * 3) % 90) as u8;
        let mut points: Vec<ColoredPoint> = Vec::new();
        for (x, y) in (0..80).step_by(4).flat_map(|y| (0..100).step_by(4).map(move |x| (x, y))) {
            points.push((camera.unproject([f64::from(x) + 0.5, f64::from(y) + 0.5], 2.0), [value(x, y); 3]));
        }
        let moved = |right: u32, down: u32| {
            let pixels = (0..80).flat_map(|y| (0..100).map(move |x| (x, y)));
            let bright = |(x, y): (u32, u32)| [2 * value((x + 100 - right) % 100, (y + 80 - down) % 80); 3];
            Target::new([100, 80], pixels.flat_map(bright).collect())
        };
        for shift in [[0, 0], [3, 2]] {
            let photo = moved(shift[0] as u32, shift[1] as u32);
            let found = PhotoLook::new(&photo, &camera, &points).finding().unwrap();
            assert_eq!((found.shift, found.off), (shift, 0.0));
            assert!(found.agreement > 0.999 && found.gain.iter().all(|gain| (gain - 1.0).abs() < 1e-9), "{found:?}");
            assert_eq!(found.agreement_in_place < 0.5, shift != [0, 0]);
        }
        // What lies far behind another point of a cell is hidden; masked pixels show nothing.
        let behind: Vec<ColoredPoint> = points
            .iter()
            .map(|&(_, color)| (camera.unproject([48.5, 40.5], 9.0), color))
            .chain(points.clone())
            .collect();
        let mut photo = moved(0, 0);
        assert_eq!(PhotoLook::new(&photo, &camera, &behind).finding().map(|found| found.off), Some(0.0));
        photo.mask = Some(vec![0; 100 * 80]);
        assert_eq!(PhotoLook::new(&photo, &camera, &points).finding(), None);
    }
}
