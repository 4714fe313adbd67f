//! Wrong views: which photos contradict the scene that all others agree on.
//!
//! A photo with a wrong pose differs from its picture about as much as two unrelated photos differ. So a view is judged by
//! the share of its photo's variance that its picture leaves unexplained, which photos of much and of little contrast have in
//! common. The measure is the logarithm of mean squared error over variance.
//!
//! At the end of each epoch the views that were measured in it are judged together. A view whose measure lies far above their median, by
//! the median absolute deviation, gets a strike; any other of them loses one. A view is an outlier from its second strike on, until it
//! has lost all strikes, so that one bad epoch does not count. Views that are left out are still measured, so they can return.
//!
//! Strikes take epochs, and a short run has few. So a clear contradiction is a first strike at once, and in the first epochs the step does not
//! train on the photo ([`ViewOutliers::contradicts`]). The picture is compared with those of the last steps, because measures fall
//! fast at first. Where views come in large groups, these are steps of the same group: a region that has just been trained says nothing
//! about one that has not.
//!
//! Invariants: 1. measures are stored as fixed-point numbers, and a verdict follows from them alone; 2. fewer than half of
//! the views can be outliers of an epoch; 3. no verdict on fewer than eight views, or before the second epoch.

use super::{MAD_OF_NORMAL, median_and_deviation};
use crate::scene::image::Target;
use serde::{Deserialize, Serialize};

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
const USUAL: Limits = Limits { deviations: 3.0, ratio: 1.6, unexplained: 0.5 };
/// Epochs in which a step compares its picture with its photo before it trains; from then on only strikes decide.
pub const FIRST_EPOCHS: u32 = 3;
/// The last measures that a picture is compared with in these epochs, at most.
const RECENT_MOST: usize = 16;
/// A contradiction is clear if the same three conditions hold with these limits.
const CLEAR: Limits = Limits { deviations: 4.0, ratio: 2.0, unexplained: 0.8 };

/// The state of a view.
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

/// All views of a dataset.
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
    pixels.filter(|&(i, _)| photo.mask.as_ref().is_none_or(|mask| mask[i] != 0))
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

/// Measures of the last steps as [`Limits::most`] takes them.
fn recent(measures: &[i32]) -> Vec<f64> {
    measures.iter().map(|&measure| f64::from(measure)).collect()
}

/// How far a measure may lie above the others, and how large it must be at least, to be an outlier.
struct Limits {
    deviations: f64,
    ratio: f64,
    unexplained: f64,
}

impl Limits {
    /// The largest measure that is no outlier among `measures`; `None` if they are too few.
    fn most(&self, mut measures: Vec<f64>) -> Option<f64> {
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
        ViewOutliers::of_views(vec![ViewState::default(); views])
    }

    /// The state of views whose last steps are unknown.
    pub fn of_views(views: Vec<ViewState>) -> ViewOutliers {
        ViewOutliers { views, recent: Vec::new() }
    }

    /// Whether both have the same number of views.
    pub fn has_same_counts(&self, other: &ViewOutliers) -> bool {
        self.views.len() == other.views.len()
    }

    /// Whether a view is an outlier.
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
            if CLEAR.most(recent(&self.recent)).is_some_and(|most| f64::from(state.measure) > most) {
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
        let (Some(most), Some(variance)) = (CLEAR.most(recent(&self.recent)), variance(photo)) else { return false };
        squared_error(picture, photo).is_some_and(|mse| measure(mse, variance) > most)
    }

    /// Forgets the measures of the last steps: the coming ones show another region.
    pub fn forget_recent(&mut self) {
        self.recent.clear();
    }

    /// Judges the views measured since the last call, at the end of the epoch with this number, from 0. Returns those that
    /// have become outliers, ascending.
    pub fn end_epoch(&mut self, epoch: u32) -> Vec<usize> {
        let measured = self.views.iter().filter(|v| v.is_measured);
        let measured = measured.map(|v| f64::from(v.measure)).collect();
        let mut found = Vec::new();
        if let (true, Some(most)) = (epoch > 0, USUAL.most(measured)) {
            for (number, view) in self.views.iter_mut().enumerate().filter(|(_, view)| view.is_measured) {
                if view.count_epoch(f64::from(view.measure) > most) {
                    found.push(number);
                }
            }
        }
        self.views.iter_mut().for_each(|view| view.is_measured = false);
        found
    }

    /// Checks values from a file.
    ///
    /// # Errors
    /// Names what no run can have written.
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

impl ViewState {
    /// Counts an epoch; whether the view has become an outlier.
    fn count_epoch(&mut self, is_outlier: bool) -> bool {
        let was_named = self.is_named;
        self.strikes = if is_outlier { (self.strikes + 1).min(STRIKES_MOST) } else { self.strikes.saturating_sub(1) };
        self.is_named = if was_named { self.strikes > 0 } else { self.strikes >= STRIKES_NAMED };
        self.is_named && !was_named
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    /// Half of the pixels dark, half bright: variance (contrast / 2)^2 in grey levels.
    fn photo(contrast: u8) -> Target {
        let rgb = (0..96).map(|i| if i < 48 { 10 } else { 10 + contrast }).collect();
        Target { width: 8, height: 4, rgb, mask: None }
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
    fn contrast_does_not_make_an_outlier() {
        let mut outliers = ViewOutliers::new(12);
        for epoch in 0..5 {
            for view in 0..12u8 {
                let photo = photo(10 + 20 * view);
                outliers.measure(view.into(), 0.5 * variance(&photo).unwrap(), &photo);
            }
            assert_eq!(outliers.end_epoch(epoch), [0; 0]);
        }
        // A fixed-point number has 12 bits behind the point.
        assert!((outliers.unexplained(3) - 0.5).abs() < 1e-3);
    }

    #[test]
    fn views_that_are_mostly_explained_are_no_outliers() {
        let mut outliers = ViewOutliers::new(12);
        for epoch in 0..6 {
            for view in 0..12 {
                let error = if view == 3 { 0.25 } else { 0.02 };
                outliers.measure(view, error * variance(&photo(60)).unwrap(), &photo(60));
            }
            assert_eq!(outliers.end_epoch(epoch), [0; 0]);
        }
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
        outliers.forget_recent();
        assert!(!outliers.contradicts(&swapped, &photo), "nothing of this region was seen yet");
    }

    #[test]
    fn errors_are_those_of_the_used_pixels() {
        let photo = photo(60);
        let picture = picture(&photo, 60.0, 0.5);
        let share = |photo: &Target| squared_error(&picture, photo).unwrap() / (30.0f64 / 255.0).powi(2);
        assert!((share(&photo) - 1.0).abs() < 1e-5, "f32 pictures");
        let half = Target { mask: Some((0..32).map(|i| if i < 16 { 255 } else { 0 }).collect()), ..photo.clone() };
        assert!((share(&half) - 1.0).abs() < 1e-5);
        assert_eq!(squared_error(&picture, &Target { mask: Some(vec![0; 32]), ..photo.clone() }), None);
        let broken = vec![f32::NAN; 96];
        assert_eq!(squared_error(&broken, &photo), None);
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
}
