//! Wrong views: which photos contradict the scene that all others agree on. Every run names them; `--robust-views` leaves them out.
//!
//! A photo with a wrong pose differs from its picture about as much as two unrelated photos differ. So the measure of a view is the
//! logarithm of the share of its photo's variance that its picture leaves unexplained, which does not depend on the contrast.
//!
//! At the end of each epoch, a measured view gets a strike if its measure lies far above the median of the epoch, in units
//! of the median absolute deviation; otherwise it loses a strike. A view is an outlier from its second strike until it has
//! lost all strikes, so that one bad epoch does not count. Views that are left out are still measured, so they can return.
//!
//! Strikes take epochs, and a short run has few. So a clear contradiction is a first strike at once, and in the first
//! epochs the step does not train on such a photo ([`ViewOutliers::contradicts`]). The measure is compared with those of
//! the last steps, because measures fall fast at first. If views come in large groups, only steps of the same group count.
//!
//! Invariants: 1. measures are stored as fixed-point numbers, and a verdict follows from them alone; 2. fewer than half of
//! the views can be outliers of an epoch; 3. no verdict on fewer than eight views, or before the second epoch.

use super::super::PhotoOptions;
use super::super::parameter::{
    Encoded, Finding, Kind, PastViews, PhotoOutcome, PhotoParameter, PhotoStep, STEPS_AFTER_RESET, ValuesError,
};
use super::{MAD_OF_NORMAL, is_used, median_and_deviation};
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::EncodingError;
use crate::scene::image::{Image, Target};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Fixed-point numbers per unit of a measure.
const PER_UNIT: f64 = 4096.0;
/// Largest stored magnitude of a measure, fixed-point.
const STORED_MOST: f64 = 64.0 * PER_UNIT;
/// Fewest views for a verdict: with fewer, median and deviation are unreliable.
const VIEWS_LEAST: usize = 8;
/// Least variance of a photo, of values in 0..1: two grey levels. A blank photo has none, and any picture would contradict it.
const VARIANCE_LEAST: f64 = 6e-5;
/// Pixels in the estimate of a photo's variance, about.
const SAMPLE: usize = 1 << 16;
/// Strikes from which a view is an outlier, and the most that count.
const STRIKES_NAMED: u8 = 2;
const STRIKES_MOST: u8 = 4;
/// A measure is an outlier if three conditions hold: it exceeds the median by this many standard deviations (estimated from the median
/// absolute deviation), the error is at least this many times the median error, and the picture leaves at least this share of the
/// variance unexplained. A photo of another place leaves more than all of the variance, until the scene adapts to show the photo.
const USUAL: OutlierLimits = OutlierLimits { deviations: 3.0, ratio: 1.6, unexplained: 0.5 };
/// Epochs in which a step compares its picture with its photo before it trains; from then on only strikes decide.
pub const FIRST_EPOCHS: u32 = 3;
/// The last measures that a picture is compared with in these epochs, at most.
const RECENT_MOST: usize = 16;
/// A contradiction is clear if the same three conditions hold with these limits.
const CLEAR: OutlierLimits = OutlierLimits { deviations: 4.0, ratio: 2.0, unexplained: 0.8 };

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ViewState {
    /// The last measure, fixed-point.
    measure: i32,
    /// Whether a step has measured it in this epoch.
    is_measured: bool,
    /// Epochs in which it was an outlier, less those in which it was not.
    strikes: u8,
    /// Whether it is an outlier.
    is_named: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ViewOutliers {
    views: Vec<ViewState>,
    /// Measures of the last steps on views that are no outliers, fixed-point, the newest last; at most [`RECENT_MOST`].
    recent: Vec<i32>,
}

/// Used pixels of a photo, some [`SAMPLE`] of a large one.
fn sample(photo: &Target) -> impl Iterator<Item = (usize, &[u8; 3])> {
    // Odd, so that it runs through the columns of a picture.
    let stride = (photo.pixels() / SAMPLE) | 1;
    let pixels = photo.rgb.as_chunks::<3>().0.iter().enumerate().step_by(stride);
    pixels.filter(|&(i, _)| is_used(photo, i))
}

/// Variance of the sample of a photo over its channels, of values in 0..1; `None` without used pixels.
fn variance(photo: &Target) -> Option<f64> {
    let (mut count, mut sums, mut squares) = (0u64, [0u64; 3], 0u64);
    for (_, rgb) in sample(photo) {
        count += 1;
        for (sum, &value) in sums.iter_mut().zip(rgb) {
            *sum += u64::from(value);
            squares += u64::from(value) * u64::from(value);
        }
    }
    let n = count as f64;
    let of_means: f64 = sums.iter().map(|&sum| sum as f64 * sum as f64).sum::<f64>() / n.max(1.0);
    (count > 0).then(|| ((squares as f64 - of_means) / (3.0 * n * 255.0 * 255.0)).max(VARIANCE_LEAST))
}

/// Mean squared error of a picture `[3][height][width]` over the sample of its photo; `None` without used pixels, or where it is not
/// finite.
fn squared_error(picture: &[f32], photo: &Target) -> Option<f64> {
    let (mut count, mut sum, pixels) = (0u64, 0.0, photo.pixels());
    for (i, rgb) in sample(photo) {
        count += 1;
        for (c, &value) in rgb.iter().enumerate() {
            let difference = f64::from(picture[c * pixels + i]) - f64::from(value) / 255.0;
            sum += difference * difference;
        }
    }
    let mse = sum / (3.0 * count as f64);
    mse.is_finite().then_some(mse)
}

/// The measure of a picture, fixed-point but not rounded.
fn measure(mse: f64, variance: f64) -> f64 {
    (libm::log(mse.max(1e-12) / variance) * PER_UNIT).clamp(-STORED_MOST, STORED_MOST)
}

/// How far a measure may lie above the others, and how large it must be at least, to be an outlier.
struct OutlierLimits {
    deviations: f64,
    ratio: f64,
    unexplained: f64,
}

impl OutlierLimits {
    /// The largest measure that is no outlier among `measures`; `None` if they are too few.
    fn most<'a>(&self, measures: impl Iterator<Item = &'a i32>) -> Option<f64> {
        let mut measures: Vec<f64> = measures.map(|&measure| f64::from(measure)).collect();
        if measures.len() < VIEWS_LEAST {
            return None;
        }
        let (middle, deviation) = median_and_deviation(&mut measures)?;
        let far = (self.deviations * (deviation / MAD_OF_NORMAL)).max(PER_UNIT * libm::log(self.ratio));
        Some((middle + far).max(PER_UNIT * libm::log(self.unexplained)))
    }
}

impl ViewOutliers {
    /// The state of `views` views before the first measure.
    pub fn new(views: usize) -> ViewOutliers {
        ViewOutliers { views: vec![ViewState::default(); views], recent: Vec::new() }
    }

    pub fn is_named(&self, view: usize) -> bool {
        self.views.get(view).is_some_and(|view| view.is_named)
    }

    /// The outliers, ascending.
    pub fn named(&self) -> impl Iterator<Item = usize> {
        (0..self.views.len()).filter(|&view| self.views[view].is_named)
    }

    /// Share of its photo's variance that the last picture of a view left unexplained; above 1 where a grey picture would
    /// have been closer.
    pub fn unexplained(&self, view: usize) -> f64 {
        self.views.get(view).map_or(0.0, |view| libm::exp(f64::from(view.measure) / PER_UNIT))
    }

    /// Notes the mean squared error of a view's picture.
    pub fn measure(&mut self, view: usize, mse: f64, photo: &Target) {
        let (Some(state), Some(variance)) = (self.views.get_mut(view), variance(photo)) else { return };
        if !mse.is_finite() {
            return;
        }
        state.measure = measure(mse, variance).round() as i32;
        state.is_measured = true;
        if !state.is_named {
            if CLEAR.most(self.recent.iter()).is_some_and(|most| f64::from(state.measure) > most) {
                state.strikes = state.strikes.max(1);
            }
            self.recent.drain(..(self.recent.len() + 1).saturating_sub(RECENT_MOST));
            self.recent.push(state.measure);
        }
    }

    /// Whether a picture `[3][height][width]` contradicts its photo so clearly, beside those of the last steps, that the first sightings
    /// count. `false` after fewer than eight steps.
    ///
    /// # Panics
    /// Picture and photo differ in size.
    pub fn contradicts(&self, picture: &[f32], photo: &Target) -> bool {
        let (Some(most), Some(variance)) = (CLEAR.most(self.recent.iter()), variance(photo)) else { return false };
        squared_error(picture, photo).is_some_and(|mse| measure(mse, variance) > most)
    }

    /// Judges the views measured since the last call, at the end of the epoch with this number, from 0. Returns those that
    /// have become outliers, ascending.
    pub fn end_epoch(&mut self, epoch: u32) -> Vec<usize> {
        let measured = self.views.iter().filter(|view| view.is_measured).map(|view| &view.measure);
        let mut found = Vec::new();
        if let (true, Some(most)) = (epoch > 0, USUAL.most(measured)) {
            for (number, view) in self.views.iter_mut().enumerate().filter(|(_, view)| view.is_measured) {
                let (was_named, is_outlier) = (view.is_named, f64::from(view.measure) > most);
                view.strikes =
                    if is_outlier { (view.strikes + 1).min(STRIKES_MOST) } else { view.strikes.saturating_sub(1) };
                view.is_named = if was_named { view.strikes > 0 } else { view.strikes >= STRIKES_NAMED };
                if view.is_named && !was_named {
                    found.push(number);
                }
            }
        }
        self.views.iter_mut().for_each(|view| view.is_measured = false);
        found
    }

    /// Checks values from a file. Errors: names what no run can have written.
    pub fn check(&self) -> Result<(), &'static str> {
        let is_possible = |view: &ViewState| {
            f64::from(view.measure).abs() <= STORED_MOST
                && view.strikes <= STRIKES_MOST
                && (view.is_named || view.strikes < STRIKES_NAMED)
                && !(view.is_named && view.strikes == 0)
        };
        if self.recent.len() > RECENT_MOST {
            return Err("more recent errors of views are stored than a run keeps");
        }
        if self.views.iter().all(is_possible) { Ok(()) } else { Err("the error of a view is out of bounds") }
    }
}

/// In summary.json, the views whose photo contradicts the scene: `name`, `unexplained` (share of the photo's variance that its
/// picture leaves unexplained; above 1 where a grey picture would be closer) and `is_left_out` (whether the run has left it out).
pub const OUTLIER_VIEWS: &str = "outlier_views";

pub(in crate::photos) const KIND: Kind = Kind { name: "outliers", file: None, first, check, finding };

const NAMES_LISTED: usize = 20;
/// In a group of at least so many views, a view is compared with earlier views of its group only. The first eight views
/// of a group are compared with nothing, so in a smaller group hardly any view would be judged.
const COMPARED_WITHIN: usize = 16;
/// A view that is left out is measured once in this many epochs. In the others its turn goes to another view.
const MEASURED_EVERY: usize = 4;

/// A run that trains on such views warns of none before this many epochs, nor before half of its steps.
const WARNED_FROM_EPOCH: u32 = 10;

struct OutlierViews {
    state: ViewOutliers,
    are_left_out: bool,
    train_views: u32,
    looks: bool,
    /// The step is a rehearsal, whose look judges nothing.
    is_rehearsal: bool,
    is_contradicted: bool,
    steps: u32,
    /// Views that this process has warned of, ascending.
    warned: Vec<usize>,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    Some(Box::new(OutlierViews {
        state: ViewOutliers::new(dataset.views.len()),
        are_left_out: options.robust_views,
        train_views: dataset.train_views().len() as u32,
        looks: false,
        is_rehearsal: false,
        is_contradicted: false,
        steps: options.steps,
        warned: Vec::new(),
    }))
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    saved.decoded(ViewOutliers::check).map(drop)
}

impl PhotoParameter for OutlierViews {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&self.state)
    }

    fn restore(&mut self, saved: &Encoded, past: &PastViews) -> Result<(), ValuesError> {
        let ViewOutliers { views, recent } = saved.decoded(ViewOutliers::check)?;
        self.state = ViewOutliers { views: past.of(&views), recent };
        Ok(())
    }

    fn leaves_out(&self, view: usize) -> bool {
        self.are_left_out && self.state.is_named(view)
    }

    /// Every [`MEASURED_EVERY`]th epoch such a view is compared with its photo, so that it can return.
    fn is_replaced_at(&self, view: usize, step: u32) -> bool {
        let epoch = step / self.train_views.max(1);
        self.leaves_out(view) && !(epoch as usize + view).is_multiple_of(MEASURED_EVERY)
    }

    fn needs_host(&self, _: u32) -> bool {
        self.are_left_out
    }

    fn begin_step(&mut self, at: &PhotoStep<'_>) {
        let is_early = at.step < FIRST_EPOCHS * self.train_views && !at.follows_reset();
        self.looks = self.are_left_out && !at.is_left_out && (is_early || at.is_rehearsal);
        (self.is_rehearsal, self.is_contradicted) = (at.is_rehearsal, false);
    }

    fn needs_picture(&self) -> bool {
        self.looks
    }

    fn target<'a>(&'a mut self, picture: Option<&Image>, photo: &'a Target) -> &'a Target {
        if self.looks && !self.is_rehearsal {
            self.is_contradicted = picture.is_some_and(|picture| self.state.contradicts(&picture.rgb, photo));
        }
        photo
    }

    fn leaves_out_now(&self) -> bool {
        self.is_contradicted
    }

    /// Notes the error of the view, also of a step that was skipped, and after an epoch names the views that have become outliers.
    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        // After an opacity reset pictures are dark, whatever the photos show. Each view misses one measurement; in
        // epochs of more than [`STEPS_AFTER_RESET`] steps only some views do.
        let is_dark = outcome.after_reset.is_some_and(|steps| steps <= STEPS_AFTER_RESET.min(self.train_views));
        if !is_dark {
            self.state.measure(outcome.view, outcome.mse, outcome.photo);
        }
        if outcome.ended_group.is_some_and(|views| views >= COMPARED_WITHIN) {
            // The coming steps show another region.
            self.state.recent.clear();
        }
        let (done, views) = (outcome.step + 1, self.train_views);
        if !done.is_multiple_of(views) {
            return Vec::new();
        }
        let mut found = self.state.end_epoch(done / views - 1);
        if !self.are_left_out {
            // Early pictures are rough, and those of sound photos at the rim of the scene stay rough the longest.
            if done < WARNED_FROM_EPOCH * self.train_views || done < self.steps / 2 {
                return Vec::new();
            }
            found = self.state.named().filter(|view| self.warned.binary_search(view).is_err()).collect();
            self.warned.extend(&found);
            self.warned.sort_unstable();
        }
        self.warning(&found, done, outcome.dataset).into_iter().collect()
    }

    fn figures(&self, dataset: &Dataset) -> Vec<(&'static str, Value)> {
        let of_view = |view: usize| {
            let (name, unexplained) = (&dataset.views[view].name, self.state.unexplained(view));
            json!({ "name": name, "unexplained": unexplained, "is_left_out": self.are_left_out })
        };
        // The pictures of a run that is too short for a warning are rough to its end.
        if !self.are_left_out && self.steps < WARNED_FROM_EPOCH * self.train_views {
            return Vec::new();
        }
        let views: Vec<Value> = self.state.named().map(of_view).collect();
        if views.is_empty() { Vec::new() } else { vec![(OUTLIER_VIEWS, views.into())] }
    }
}

impl OutlierViews {
    fn warning(&self, found: &[usize], step: u32, dataset: &Dataset) -> Option<String> {
        if found.is_empty() {
            return None;
        }
        let names: Vec<&str> = found.iter().take(NAMES_LISTED).map(|&view| dataset.views[view].name.as_str()).collect();
        let more = found.len().saturating_sub(NAMES_LISTED);
        let names = names.join(", ") + &if more > 0 { format!(" and {more} more") } else { String::new() };
        let (are, remedy) = match self.are_left_out {
            true => ("are left out from here on", "check them"),
            false => ("contradict the scene", "check them, or leave such views out with --robust-views"),
        };
        Some(format!(
            "step {step}: the photos of {} {are}, because they differ from their pictures far more than \
             others do (a wrong pose, another place, another exposure); {remedy}: {names}",
            if found.len() == 1 { String::from("a view") } else { format!("{} views", found.len()) }
        ))
    }
}

pub fn names_in(summary: &Value) -> Vec<String> {
    let views = summary[OUTLIER_VIEWS].as_array().map_or(&[][..], Vec::as_slice);
    views.iter().filter_map(|view| Some(view["name"].as_str()?.to_string())).collect()
}

/// The training views whose photo contradicts the scene, if there are any.
fn finding(_: &Value, summary: &Value) -> Option<Finding> {
    let views = summary[OUTLIER_VIEWS].as_array().filter(|views| !views.is_empty())?;
    let state = |view: &Value| if view["is_left_out"] == true { "left out" } else { "trained on" };
    let row = |view: &Value| {
        [view["name"].as_str().unwrap_or_default().into(), view["unexplained"].clone(), state(view).into()]
    };
    let text = "These training photos differ from their pictures far more than others do: a wrong pose, another place, another \
        exposure. Unexplained is the squared error over the variance of the photo; it is above 1 where a plain grey would be \
        closer. Check these photos and their poses, or leave them out with --robust-views.";
    let table = Some((["photo", "unexplained", ""], views.iter().map(row).collect()));
    Some(Finding { title: "Photos that contradict the scene", text: text.into(), table, ..Finding::default() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::camera::Camera;
    use crate::scene::events::EventLog;

    /// Half of the pixels dark, half bright: variance (contrast / 2)^2 in grey levels.
    fn photo(contrast: u8) -> Target {
        Target::new([8, 4], (0..96).map(|i| if i < 48 { 10 } else { 10 + contrast }).collect())
    }

    /// Epochs of twelve views, of which the last two have `wrong` times the error of the others.
    fn after(epochs: u32, wrong: f64, outliers: &mut ViewOutliers) -> Vec<usize> {
        let mut found = Vec::new();
        for epoch in 0..epochs {
            for view in 0..12 {
                let usual = 0.01 * (1.0 + 0.05 * view as f64);
                outliers.measure(view, if view >= 10 { usual * wrong } else { usual }, &photo(200));
            }
            found.extend(outliers.end_epoch(epoch));
        }
        found
    }

    #[test]
    fn views_far_above_the_others_are_named_after_two_epochs_and_return_when_they_fit() {
        let mut outliers = ViewOutliers::new(12);
        assert_eq!(after(2, 6.0, &mut outliers), [0; 0], "the first epoch does not count, and one is not enough");
        assert_eq!(after(2, 6.0, &mut outliers), [10, 11]);
        assert_eq!(outliers.named().collect::<Vec<_>>(), [10, 11]);
        assert_eq!(outliers.check(), Ok(()));
        after(2, 1.0, &mut outliers);
        assert!(outliers.is_named(10), "it lost one strike of two");
        after(3, 1.0, &mut outliers);
        assert_eq!(outliers.named().count(), 0);
        assert_eq!(after(9, 1.1, &mut outliers), [0; 0], "a tenth more is no contradiction");
    }

    #[test]
    fn a_clear_contradiction_is_named_after_the_second_epoch() {
        // 1.3 of the variance, where the others leave .065; six times that of the others is .39.
        let mut outliers = ViewOutliers::new(12);
        assert_eq!(after(1, 20.0, &mut outliers), [0; 0], "the first epoch does not count");
        assert_eq!((outliers.views[10].strikes, outliers.check()), (1, Ok(())));
        let mut outliers = ViewOutliers::new(12);
        assert_eq!(after(2, 20.0, &mut outliers), [10, 11]);
        assert_eq!(outliers.check(), Ok(()));
        // A view that was far from the last steps alone loses the strike.
        let mut outliers = ViewOutliers::new(12);
        after(1, 20.0, &mut outliers);
        assert_eq!(after(2, 1.0, &mut outliers), [0; 0]);
        assert_eq!(outliers.views[10].strikes, 0);
    }

    #[test]
    fn few_views_masked_photos_and_bad_numbers_say_nothing() {
        let mut few = ViewOutliers::new(7);
        for epoch in 0..6 {
            (0..7).for_each(|view| few.measure(view, if view == 0 { 1.0 } else { 0.001 }, &photo(60)));
            assert_eq!(few.end_epoch(epoch), [0; 0]);
        }
        let mut outliers = ViewOutliers::new(12);
        let masked = Target { mask: Some(vec![0; 32]), ..photo(60) };
        for epoch in 0..6 {
            (0..11).for_each(|view| outliers.measure(view, 0.001, &photo(60)));
            outliers.measure(11, f64::NAN, &photo(60));
            outliers.measure(10, 1.0, &masked);
            assert_eq!(outliers.end_epoch(epoch), [0; 0]);
        }
        outliers.measure(99, 1.0, &photo(60));
    }

    /// A picture of the photo whose pixels are `share` of the contrast away from the photo: with 1, dark and bright have changed places.
    fn picture(photo: &Target, contrast: f32, share: f32) -> Vec<f32> {
        let value = |i: usize| f32::from(photo.rgb[i % photo.pixels() * 3]) / 255.0;
        let away = |i: usize| if value(i) > 20.0 / 255.0 { -contrast } else { contrast } * share / 255.0;
        (0..3 * photo.pixels()).map(|i| value(i) + away(i)).collect()
    }

    #[test]
    fn a_clear_contradiction_shows_at_the_first_sighting() {
        let photo = photo(60);
        let (swapped, grey, near) =
            (picture(&photo, 60.0, 1.0), picture(&photo, 60.0, 0.5), picture(&photo, 60.0, 0.3));
        let usual = 0.2 * variance(&photo).unwrap();
        let mut outliers = ViewOutliers::new(12);
        (0..7).for_each(|view| outliers.measure(view, usual, &photo));
        assert!(!outliers.contradicts(&swapped, &photo), "seven steps are too few");
        outliers.measure(7, usual, &photo);
        assert!(outliers.contradicts(&swapped, &photo), "four times the variance");
        assert!(outliers.contradicts(&grey, &photo), "all of the variance");
        assert!(!outliers.contradicts(&near, &photo), "a third of the variance");
        assert_eq!(outliers.named().count(), 0, "a look names nobody");
        // Where the last pictures are as bad, as in the first steps of a run, none contradicts.
        (0..RECENT_MOST).for_each(|view| outliers.measure(view % 12, 4.0 * variance(&photo).unwrap(), &photo));
        assert!(!outliers.contradicts(&swapped, &photo));
        (0..RECENT_MOST).for_each(|view| outliers.measure(view % 12, usual, &photo));
        assert_eq!((outliers.recent.len(), outliers.check()), (RECENT_MOST, Ok(())));
        outliers.views[3] = ViewState { is_named: true, strikes: 2, ..ViewState::default() };
        (0..RECENT_MOST).for_each(|_| outliers.measure(3, 4.0 * variance(&photo).unwrap(), &photo));
        assert!(outliers.contradicts(&swapped, &photo), "outliers are no measure of others");
        let masked = Target { mask: Some(vec![0; 32]), ..photo.clone() };
        assert!(!outliers.contradicts(&swapped, &masked));
        outliers.recent.clear();
        assert!(!outliers.contradicts(&swapped, &photo), "nothing of this region was seen yet");
    }

    #[test]
    fn variance_is_that_of_the_used_pixels() {
        assert!((variance(&photo(60)).unwrap() - (30.0f64 / 255.0).powi(2)).abs() < 1e-12);
        let half = Target { mask: Some((0..32).map(|i| if i < 16 { 255 } else { 0 }).collect()), ..photo(60) };
        assert_eq!(variance(&half), Some(VARIANCE_LEAST));
        assert_eq!(variance(&Target { mask: Some(vec![0; 32]), ..photo(60) }), None);
    }

    #[test]
    fn impossible_states_are_refused() {
        let refused = |change: fn(&mut ViewState)| {
            let mut outliers = ViewOutliers::new(2);
            change(&mut outliers.views[1]);
            assert!(outliers.check().is_err());
        };
        refused(|view| view.measure = i32::MIN);
        refused(|view| view.strikes = STRIKES_MOST + 1);
        refused(|view| view.strikes = STRIKES_NAMED);
        refused(|view| view.is_named = true);
        let mut outliers = ViewOutliers::new(2);
        outliers.recent = vec![0; RECENT_MOST + 1];
        assert!(outliers.check().is_err());
    }

    fn outliers(named: &[usize]) -> OutlierViews {
        let mut state = ViewOutliers::new(10);
        for &view in named {
            state.views[view] = ViewState { strikes: STRIKES_NAMED, is_named: true, ..ViewState::default() };
        }
        OutlierViews {
            state,
            are_left_out: true,
            train_views: 10,
            looks: false,
            is_rehearsal: false,
            is_contradicted: false,
            steps: 400,
            warned: Vec::new(),
        }
    }

    #[test]
    fn a_step_leaves_a_clear_contradiction_out_in_the_first_epochs_alone() {
        let camera = Camera::along_z(0.0, [20.0, 20.0, 2.0, 2.0], [4, 4]);
        // Black and white in turn; a picture with both exchanged leaves four times the variance.
        let photo = Target::new([4, 4], (0..48).map(|i| if i / 3 % 2 == 0 { 0 } else { 255 }).collect());
        let exchanged: Vec<f32> = (0..48).map(|i| if i % 2 == 0 { 1.0 } else { 0.0 }).collect();
        let mut outliers = outliers(&[]);
        (0..10).for_each(|view| outliers.state.measure(view, 0.02, &photo));
        let events = EventLog::default();
        let mut leaves_out = |step: u32, is_rehearsal: bool, picture: &[f32]| {
            let at = PhotoStep { view: 7, step, camera: &camera, events: &events, is_left_out: false, is_rehearsal };
            outliers.begin_step(&at);
            let picture = Image { rgb: picture.to_vec(), ..Image::new(4, 4) };
            outliers.target(outliers.needs_picture().then_some(&picture), &photo);
            outliers.leaves_out_now()
        };
        assert!(leaves_out(29, false, &exchanged), "three epochs of ten views");
        assert!(!leaves_out(30, false, &exchanged));
        assert!(!leaves_out(29, true, &exchanged), "a rehearsal takes the whole step");
    }

    /// Ends a step on a view, whose picture has this error.
    fn end(outliers: &mut OutlierViews, step: u32, mse: f64, (ended_group, after_reset): (Option<usize>, Option<u32>)) {
        let photo = Target::new([4, 4], (0..48).map(|i| 5 * i).collect());
        let (view, photo, dataset) = (step as usize % 10, &photo, &Dataset::without_views());
        let [is_skipped, is_left_out] = [false; 2];
        let outcome =
            PhotoOutcome { view, step, is_skipped, is_left_out, ended_group, after_reset, mse, photo, dataset };
        outliers.end_step(&outcome);
    }

    #[test]
    fn steps_soon_after_an_opacity_reset_measure_nothing() {
        let unexplained = |after_reset: Option<u32>| {
            let mut outliers = outliers(&[]);
            end(&mut outliers, 3, 0.02, (None, None));
            end(&mut outliers, 13, 0.5, (None, after_reset));
            outliers.state.unexplained(3)
        };
        assert!(unexplained(Some(10)) < 0.5, "dark");
        assert!(unexplained(Some(11)) > 0.5 && unexplained(None) > 0.5);
    }

    #[test]
    fn the_views_of_a_large_group_are_not_compared_with_those_of_the_group_before() {
        let swapped: Vec<f32> = vec![1.0; 48];
        let photo = Target::new([4, 4], vec![0; 48]);
        let contradicts = |ended_group: Option<usize>| {
            let mut outliers = outliers(&[]);
            (0..9).for_each(|step| end(&mut outliers, step, 0.02, (None, None)));
            end(&mut outliers, 9, 0.02, (ended_group, None));
            outliers.state.contradicts(&swapped, &photo)
        };
        assert!(contradicts(None) && contradicts(Some(COMPARED_WITHIN - 1)));
        assert!(!contradicts(Some(COMPARED_WITHIN)));
    }

    #[test]
    fn a_view_that_is_left_out_keeps_one_turn_in_four() {
        let outliers = outliers(&[3]);
        let kept: Vec<u32> = (0..8).filter(|epoch| !outliers.is_replaced_at(3, 10 * epoch + 7)).collect();
        assert_eq!(kept, [1, 5]);
        assert!((0..80).all(|step| !outliers.is_replaced_at(4, step)));
    }
}
