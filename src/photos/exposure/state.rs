//! The values of all photos and cameras of a run: what a commit holds of appearance.
//!
//! Values are fixed-point numbers. Their sums over the photos seen are kept as well, so the mean needs no sweep and has
//! the same bits for any order of steps. A photo counts as seen, and has a value, once a step has seen it. If its file
//! states an exposure ([`first_exposures`]), the photo counts from the start of the run: otherwise each step of the first
//! pass would pull the scene towards the exposure of its own photo. A first exposure counts as one fit only, because camera
//! settings can mislead: if the camera follows a change of light, photos of equal brightness have different settings.
//!
//! Invariants: 1. the sums are exactly those of the values of the photos seen; 2. what acts is within the bounds of
//! [`super::fit::bounded`]; 3. a fit that found nothing changes nothing.

use super::AppearanceMode;
use super::fit::{FittedPair, bounded, bounded_channel};
use super::model::{CHANNEL_VALUES, IMAGE_VALUES};
use super::picture::{LensPlane, Look};
use crate::photos::parameter::PastViews;
use crate::scene::camera::Camera;
use serde::{Deserialize, Serialize};

/// Fixed-point numbers per unit.
const PER_UNIT: f64 = (1 << 24) as f64;
/// Largest stored magnitude, fixed-point: 64 units.
const STORED_MOST: f64 = (1 << 30) as f64;
/// Steps of Gauss-Newton at a sighting.
const ROUNDS: usize = 2;
/// A new fit counts at least this much against the value before it.
const IMAGE_GAIN_LEAST: f64 = 0.05;
const CAMERA_GAIN_LEAST: f64 = 0.01;

/// Weight of a new fit after `sightings` earlier fits; 1 for the first. The values become the mean in which the k-th
/// fit has weight k, so early fits, which saw a rough scene, are forgotten.
fn gain(sightings: u32, least: f64) -> f64 {
    (2.0 / (f64::from(sightings) + 2.0)).max(least)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ImageState {
    /// Exposure and homography, fixed-point, with the mean in them.
    pub values: [i32; IMAGE_VALUES],
    /// Steps that have seen the photo; a first exposure counts as one.
    pub sightings: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct CameraState {
    /// Vignetting by channel.
    pub falloff: [[f64; CHANNEL_VALUES]; 3],
    /// Steps that have seen a photo of the camera.
    pub sightings: u32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    image: [f64; IMAGE_VALUES],
    falloff: Option<[[f64; CHANNEL_VALUES]; 3]>,
}

/// All values; empty for a run without appearance.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct AppearanceState {
    /// By view of the dataset.
    pub images: Vec<ImageState>,
    /// By group of views with the same intrinsics.
    pub cameras: Vec<CameraState>,
    sums: [i64; IMAGE_VALUES],
    seen: u32,
    /// The value at which the mean of the acting corrections is held, fixed-point: zeros, or the mean of another run's values of these photos.
    tied: [f64; IMAGE_VALUES],
}

/// For each camera, the number of its group: cameras that differ only in their pose form one.
pub fn camera_groups<'a>(cameras: impl Iterator<Item = &'a Camera>) -> Vec<usize> {
    let mut known = std::collections::HashMap::new();
    cameras
        .map(|camera| {
            let next = known.len();
            *known.entry(camera.lens_words()).or_insert(next)
        })
        .collect()
}

/// Finds the values of the photo of a view, under the `look` that its picture was corrected with.
pub fn find(pair: &FittedPair<'_>, look: &Look, mode: AppearanceMode) -> Option<Found> {
    let width = pair.photo.width as usize;
    let image = pair.image_values(look, mode.image_values(), 0..width, ROUNDS)?;
    let falloff = match mode {
        AppearanceMode::Full => pair.falloff(&Look { image, ..*look }),
        _ => None,
    };
    Some(Found { image, falloff })
}

impl AppearanceState {
    /// The values of a run that has seen nothing: no change. `groups` as from [`camera_groups`].
    pub fn new(groups: &[usize]) -> AppearanceState {
        let cameras = groups.iter().max().map_or(0, |last| last + 1);
        AppearanceState {
            images: vec![ImageState::default(); groups.len()],
            cameras: vec![CameraState::default(); cameras],
            ..AppearanceState::default()
        }
    }

    /// The values of the photos that the run has now. Those of cameras begin anew where there are more or fewer of these.
    pub fn of_views(self, past: &PastViews, cameras: usize) -> AppearanceState {
        let images: Vec<ImageState> = past.of(&self.images);
        let seen = || images.iter().filter(|image| image.sightings > 0);
        let sums = std::array::from_fn(|k| seen().map(|image| i64::from(image.values[k])).sum());
        let cameras = if self.cameras.len() == cameras { self.cameras } else { vec![CameraState::default(); cameras] };
        AppearanceState { sums, seen: seen().count() as u32, images, cameras, tied: self.tied }
    }

    /// Gives first exposures (a view and stops within the bounds of [`bounded`]) to photos that no step has seen. They
    /// act from now on. The fit of the first step that sees such a photo weighs twice as much as its first exposure.
    pub fn begin_with(&mut self, exposures: impl IntoIterator<Item = (usize, f64)>) {
        for (view, exposure) in exposures {
            let Some(image) = self.images.get_mut(view).filter(|image| image.sightings == 0) else { continue };
            image.values[0] = (exposure * PER_UNIT).clamp(-STORED_MOST, STORED_MOST).round() as i32;
            image.sightings = 1;
            self.sums[0] += i64::from(image.values[0]);
            self.seen += 1;
        }
    }

    /// Holds the mean correction at the mean of another run's values: each a view, the correction that acted on it
    /// there, and the number of steps that had seen it. Photos that no step has seen start from these values.
    pub fn tie(&mut self, values: &[(usize, [f64; IMAGE_VALUES], u32)]) {
        let mut sums = [0.0; IMAGE_VALUES];
        for &(view, acting, sightings) in values {
            let fixed = acting.map(|x| (x * PER_UNIT).clamp(-STORED_MOST, STORED_MOST).round() as i32);
            (0..IMAGE_VALUES).for_each(|k| sums[k] += f64::from(fixed[k]));
            let Some(image) = self.images.get_mut(view).filter(|image| image.sightings == 0) else { continue };
            *image = ImageState { values: fixed, sightings: sightings.max(1) };
            (0..IMAGE_VALUES).for_each(|k| self.sums[k] += i64::from(fixed[k]));
            self.seen += 1;
        }
        self.tied = sums.map(|sum| sum / values.len().max(1) as f64);
    }

    fn mean(&self) -> [f64; IMAGE_VALUES] {
        std::array::from_fn(|k| self.sums[k] as f64 / f64::from(self.seen.max(1)) - self.tied[k])
    }

    /// What acts on a photo: its values less the mean, the first `used` of them; zeros for a photo that was not seen.
    pub fn acting(&self, view: usize, used: usize) -> [f64; IMAGE_VALUES] {
        let Some(image) = self.images.get(view).filter(|image| image.sightings > 0) else { return [0.0; IMAGE_VALUES] };
        let mean = self.mean();
        let of = |k: usize| if k < used { (f64::from(image.values[k]) - mean[k]) / PER_UNIT } else { 0.0 };
        bounded(std::array::from_fn(of)).unwrap_or_default()
    }

    pub fn look(&self, mode: AppearanceMode, (view, group): (usize, usize), camera: &Camera) -> Look {
        let falloff = match mode {
            AppearanceMode::Full => self.cameras.get(group).map(|camera| camera.falloff).unwrap_or_default(),
            _ => Default::default(),
        };
        Look { image: self.acting(view, mode.image_values()), falloff, lens: LensPlane::of(camera) }
    }

    /// Moves the values of a view's photo and camera towards what a step has found.
    pub fn learn(&mut self, mode: AppearanceMode, (view, group): (usize, usize), found: &Found) {
        let Some(image) = self.images.get(view) else { return };
        self.move_image(mode, view, found, gain(image.sightings, IMAGE_GAIN_LEAST));
        if let (Some(falloff), Some(camera)) = (&found.falloff, self.cameras.get_mut(group)) {
            let weight = gain(camera.sightings, CAMERA_GAIN_LEAST);
            for (values, found) in camera.falloff.iter_mut().zip(falloff) {
                let next = std::array::from_fn(|k| values[k] + weight * (found[k] - values[k]));
                *values = bounded_channel(next).unwrap_or(*values);
            }
            camera.sightings = camera.sightings.saturating_add(1);
        }
    }

    /// Moves the values of a photo by this share of the way to what was found.
    ///
    /// A photo that is left out takes the found values whole (weight 1): its next look must not use values that were fitted to a rougher scene.
    pub fn move_image(&mut self, mode: AppearanceMode, view: usize, found: &Found, weight: f64) {
        let (acting, mean) = (self.acting(view, mode.image_values()), self.mean());
        let Some(image) = self.images.get_mut(view) else { return };
        let is_new = image.sightings == 0;
        for k in 0..mode.image_values() {
            let next = acting[k] + weight * (found.image[k] - acting[k]);
            let next = (mean[k] + next * PER_UNIT).clamp(-STORED_MOST, STORED_MOST).round() as i32;
            self.sums[k] += i64::from(next) - if is_new { 0 } else { i64::from(image.values[k]) };
            image.values[k] = next;
        }
        image.sightings = image.sightings.saturating_add(1);
        self.seen += u32::from(is_new);
    }

    /// Checks values from a file. Errors: names what no run can have written.
    pub fn check(&self) -> Result<(), &'static str> {
        let seen = || self.images.iter().filter(|image| image.sightings > 0);
        let sums: [i64; IMAGE_VALUES] = std::array::from_fn(|k| seen().map(|image| i64::from(image.values[k])).sum());
        if self.sums != sums || self.seen as usize != seen().count() {
            return Err("the sums of its exposures are not those of its photos");
        }
        let is_stored = |x: &i32| f64::from(*x).abs() <= STORED_MOST;
        if !self.tied.iter().all(|x| x.abs() <= STORED_MOST) {
            return Err("the mean of its exposures is out of bounds");
        }
        if !self.images.iter().all(|image| image.values.iter().all(is_stored)) {
            return Err("an exposure or colour of a photo is out of bounds");
        }
        let is_right = |channel: &[f64; CHANNEL_VALUES]| bounded_channel(*channel) == Some(*channel);
        match self.cameras.iter().all(|camera| camera.falloff.iter().all(is_right)) {
            true => Ok(()),
            false => Err("the vignetting of a camera is out of bounds"),
        }
    }
}

/// Stops of exposure per stop of light. An exposure multiplies pixel values, and pixel values are stored with a gamma of about
/// 2.2, so a stop of light changes them by 1/2.2 stops.
pub const PER_STOP: f64 = 1.0 / 2.2;

/// First exposures (stops) of photos with these brightnesses (stops of light; `None` where unknown): the difference to the
/// median brightness, within the bounds of the model. `None` unless more than half of the photos have a brightness.
pub fn first_exposures(brightness: &[Option<f64>]) -> Option<Vec<Option<f64>>> {
    let mut known: Vec<f64> = brightness.iter().copied().flatten().collect();
    if 2 * known.len() <= brightness.len() {
        return None;
    }
    known.sort_unstable_by(f64::total_cmp);
    let median = (known[(known.len() - 1) / 2] + known[known.len() / 2]) / 2.0;
    Some(brightness.iter().map(|stops| stops.and_then(|stops| exposure((stops - median) * PER_STOP))).collect())
}

/// An exposure within the bounds; `None` if it is not finite.
fn exposure(stops: f64) -> Option<f64> {
    let mut values = [0.0; IMAGE_VALUES];
    values[0] = stops;
    bounded(values).map(|values| values[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(exposure: f64) -> Found {
        Found { image: [exposure, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], falloff: None }
    }

    #[test]
    fn what_acts_is_the_value_less_the_mean_of_what_was_seen() {
        let mode = AppearanceMode::Exposure;
        let mut state = AppearanceState::new(&[0, 0, 0]);
        assert_eq!(state.acting(0, 1)[0], 0.0);
        state.learn(mode, (0, 0), &found(1.0));
        assert_eq!(state.acting(0, 1)[0], 0.0, "one photo alone is its own mean");
        state.learn(mode, (1, 0), &found(1.0));
        let [first, second, third] = [0, 1, 2].map(|view| state.acting(view, 1)[0]);
        assert_eq!((first, second, third), (-0.5, 0.5, 0.0));
        assert_eq!(state.check(), Ok(()));
        // A second sighting moves two thirds of the way; a fixed-point number has 24 bits behind the point.
        state.learn(mode, (1, 0), &found(1.1));
        let far = state.acting(1, 1)[0] - state.acting(0, 1)[0];
        assert!((far - (1.0 + 0.6 * 2.0 / 3.0)).abs() < 1e-6, "{far}");
        state.sums[0] += 1;
        assert!(state.check().is_err());
    }

    #[test]
    fn the_values_of_another_run_act_and_their_mean_stays() {
        let mode = AppearanceMode::Exposure;
        let mut state = AppearanceState::new(&[0, 0, 0]);
        let values = |exposure: f64| found(exposure).image;
        state.tie(&[(0, values(0.5), 4), (1, values(0.25), 4)]);
        let exposures = |state: &AppearanceState| [0, 1].map(|view| state.acting(view, 1)[0]);
        assert_eq!((exposures(&state), state.check()), ([0.5, 0.25], Ok(())));
        // As though the scene had become darker: no step moves the mean.
        (0..2).for_each(|view| state.learn(mode, (view, 0), &found(0.9)));
        let [first, second] = exposures(&state);
        assert!((first + second - 0.75).abs() < 1e-6 && first > second, "{first}, {second}");
        state.tied[0] = f64::NAN;
        assert!(state.check().is_err());
    }

    #[test]
    fn first_exposures_act_at_once_and_weigh_half_of_the_first_fit() {
        let mode = AppearanceMode::Exposure;
        let mut state = AppearanceState::new(&[0, 0, 0]);
        state.begin_with([(0, 1.0), (1, 0.0)]);
        let exposures = |state: &AppearanceState| [0, 1, 2].map(|view| state.acting(view, 1)[0]);
        assert_eq!(exposures(&state), [0.5, -0.5, 0.0]);
        assert_eq!((state.check(), state.seen), (Ok(()), 2));
        state.learn(mode, (0, 0), &found(0.8));
        let far = state.acting(0, 1)[0] - state.acting(1, 1)[0];
        assert!((far - (1.0 + 0.3 * 2.0 / 3.0)).abs() < 1e-6, "{far}");
        // A photo that was seen keeps its value.
        let before = state.clone();
        state.begin_with([(0, -2.0)]);
        assert_eq!(state, before);
    }

    #[test]
    fn a_photo_that_is_left_out_has_what_was_found_last_and_teaches_its_camera_nothing() {
        let mode = AppearanceMode::Full;
        let mut state = AppearanceState::new(&[0, 0]);
        state.learn(mode, (0, 0), &found(0.0));
        for exposure in [-2.0, -2.0, 0.5] {
            state.move_image(mode, 1, &Found { falloff: Some([[0.1; CHANNEL_VALUES]; 3]), ..found(exposure) }, 1.0);
        }
        // What is found counts from the mean before: -2, then -1 - 2, then -1.5 + .5. An average of the three would lie at -1.9.
        let far = state.acting(1, 1)[0] - state.acting(0, 1)[0];
        assert_eq!((state.check(), state.cameras[0].sightings, state.images[1].sightings), (Ok(()), 0, 3));
        assert!((far - -1.0).abs() < 1e-6, "{far}");
    }

    #[test]
    fn values_stay_within_bounds() {
        let mut state = AppearanceState::new(&[0, 0]);
        for _ in 0..1000 {
            state.learn(AppearanceMode::Exposure, (0, 0), &found(4.0));
            state.learn(AppearanceMode::Exposure, (1, 0), &found(-4.0));
        }
        assert_eq!(state.check(), Ok(()));
        assert!(state.acting(0, 1)[0].abs() <= 4.0);
        let lost =
            AppearanceState { cameras: vec![CameraState { falloff: [[f64::NAN; 5]; 3], sightings: 1 }], ..state };
        assert!(lost.check().is_err());
    }

    #[test]
    fn exposures_are_differences_to_the_median_within_bounds() {
        let first = first_exposures(&[Some(7.4), Some(5.2), None, Some(3.0), Some(50.0)]).unwrap();
        // The median of 3, 5.2, 7.4 and 50 lies between the two in the middle.
        let want = [Some(0.5), Some(-0.5), None, Some(-1.5), Some(4.0)];
        assert_eq!(first.len(), want.len());
        for (got, want) in first.into_iter().zip(want) {
            let is_near = got.zip(want).is_none_or(|(got, want): (f64, f64)| (got - want).abs() < 1e-12);
            assert!(is_near && got.is_some() == want.is_some(), "{got:?}, not {want:?}");
        }
    }
}
